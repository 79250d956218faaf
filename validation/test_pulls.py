"""Pulls of the fit over skies that the commands simulate: one seed, one sky."""

import numpy as np
import pytest

from fits.commands.run import DEFAULTS
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.optimize import best_fit
from jaxsky.galaxy import embedded_sky
from jaxsky.settings import load

SKIES = 500
KINDS = [("exact", "Q"), ("exact", "U"), ("exact", "QU"), ("diagonal", "QU")]


@pytest.fixture(scope="module")
def pulls():
    """(best fit - truth) / sigma of both indices in each sky, by likelihood and Stokes."""
    values = ["common.nside=16", "common.fwhm=300.0", "sky.embedded.nside=32"]
    settings, galaxy = load(DEFAULTS / "fit.toml", values), embedded_sky(32)
    start, rows = settings.start("fit"), {how: [] for how in KINDS}
    for seed in range(SKIES):
        inputs = inputs_of(settings.model_copy(update={"seed": seed}), galaxy=galaxy)
        prepared = common_maps(inputs, 16, 300.0)
        for kind, stokes in KINDS:
            found = best_fit(prepared.likelihood(start, kind=kind, stokes=stokes), start)
            rows[kind, stokes].append(
                [(found.best_fit[n] - inputs.truth[n]) / found.sigma[n] for n in found.free]
            )
    return {how: np.array(row) for how, row in rows.items()}


@pytest.mark.parametrize("stokes", ["Q", "U", "QU"])
def test_pulls_are_standard_normal(pulls, stokes):
    # Of N standard normal values the mean scatters by 1 / sqrt(N), the deviation by 1 / sqrt(2 N).
    exact = pulls["exact", stokes]
    print(f"{stokes}: means {exact.mean(axis=0).round(3)}, deviations {exact.std(axis=0).round(3)}")
    assert np.all(np.abs(exact.mean(axis=0)) < 3 / np.sqrt(SKIES))
    assert np.all(np.abs(exact.std(axis=0) - 1) < 3 / np.sqrt(2 * SKIES))


def test_the_diagonal_likelihood_misstates_its_errors(pulls):
    """Why it is only the named option: correlated noise and the CMB are left out of it."""
    assert pulls["diagonal", "QU"].std(axis=0).max() > 1.2


def test_skies_of_other_seeds_are_independent(pulls):
    for values in pulls["exact", "QU"].T:
        correlation = np.corrcoef(values[:-1], values[1:])[0, 1]
        assert abs(correlation) < 3 / np.sqrt(SKIES)
