"""Pulls of the fit over skies that the commands simulate: one seed, one sky."""

import numpy as np
import pytest

from fits.commands.run import DEFAULTS
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.optimize import best_fit
from jaxsky.galaxy import embedded_sky
from jaxsky.settings import load

SKIES = 200


@pytest.fixture(scope="module")
def pulls():
    """(best fit - truth) / sigma of both indices in each sky."""
    values = ["common.nside=16", "common.fwhm=300.0", "sky.embedded.nside=32"]
    settings, galaxy = load(DEFAULTS / "fit.toml", values), embedded_sky(32)
    start, rows = settings.start("fit"), []
    for seed in range(SKIES):
        inputs = inputs_of(settings.model_copy(update={"seed": seed}), galaxy=galaxy)
        found = best_fit(common_maps(inputs, 16, 300.0).likelihood(start), start)
        rows.append(
            [(found.best_fit[name] - inputs.truth[name]) / found.sigma[name] for name in found.free]
        )
    return np.array(rows)


def test_pulls_are_standard_normal(pulls):
    # Of N standard normal values the mean scatters by 1 / sqrt(N), the deviation by 1 / sqrt(2 N).
    assert np.all(np.abs(pulls.mean(axis=0)) < 3 / np.sqrt(SKIES))
    assert np.all(np.abs(pulls.std(axis=0) - 1) < 3 / np.sqrt(2 * SKIES))


def test_skies_of_other_seeds_are_independent(pulls):
    for values in pulls.T:
        correlation = np.corrcoef(values[:-1], values[1:])[0, 1]
        assert abs(correlation) < 3 / np.sqrt(SKIES)
