"""Pulls of the fit over skies that the commands simulate: one seed, one sky."""

import numpy as np
import pytest

from fits.inputs import inputs_of
from fits.optimize import best_fit
from fits.resolution import prepare
from fits.settings import EMBEDDED, load_settings
from jaxsky.galaxy import embedded_sky

SKIES = 200


@pytest.fixture(scope="module")
def pulls():
    """(best fit - truth) / sigma of both indices in each sky."""
    settings = load_settings(EMBEDDED, {"nside": 16, "fwhm": 300.0})
    embedded = settings.embedded.model_copy(update={"nside": 32})
    settings, galaxy = settings.model_copy(update={"embedded": embedded}), embedded_sky(32)
    rows = []
    for seed in range(SKIES):
        analysis = settings.analysis.model_copy(update={"seed": seed})
        inputs = inputs_of(settings.model_copy(update={"analysis": analysis}), galaxy)
        like = prepare(inputs, 16, 300.0).likelihood(settings.start())
        found = best_fit(like, settings.start())
        rows.append(
            [(found.best_fit[name] - inputs.truth[name]) / found.sigma(name) for name in found.free]
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
