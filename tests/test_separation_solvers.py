"""Solvers of optimistix for spectral parameters: the same optimum, and honest failures."""

from functools import cache

import numpy as np
import optimistix as optx
import pytest

from fits.optimize import Newton, best_fit
from fits.posterior import Gaussian, Posterior, Prior, Uniform
from fits.profile_likelihood import spectral_likelihood
from fits.results import Convergence, FitError
from test_separation import BANDS, START, problem, random_sky
from test_separation_regions import with_empty_regions

TOLERANCES = {"rtol": 1e-10, "atol": 1e-8}
SOLVERS = {
    "LevenbergMarquardt": optx.LevenbergMarquardt(**TOLERANCES),
    "Dogleg": optx.Dogleg(**TOLERANCES),
    "BFGS": optx.BFGS(**TOLERANCES),
}
FAR = {"dust.beta_dust": 0.8, "dust.T_dust": 35.0, "synchrotron.beta_syn": 4.2}
BOTH = {"dust.T_dust": Uniform(10.0, 40.0), "synchrotron.beta_syn": Gaussian(3.0, 0.02)}


@cache
def constant(size: float = 1.0):
    """With maps in a unit of this size."""
    _, data, given, _ = problem()
    return spectral_likelihood(random_sky(), BANDS, data / size, given / size, START)


@cache
def regions():
    data, given, labels = with_empty_regions()
    return spectral_likelihood(random_sky(), BANDS, data, given, START, labels=labels)


def deviation(fit, reference) -> float:
    """The largest difference in standard deviations."""
    return max(
        np.nanmax(np.abs(np.asarray(fit.best_fit[n]) - reference.best_fit[n]) / reference.sigma[n])
        for n in reference.free
    )


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("make", "start", "priors"),
    [(constant, FAR, {}), pytest.param(regions, None, BOTH, marks=pytest.mark.slow)],
    ids=["far", "regions"],
)
def test_every_solver_finds_the_same_optimum(make, start, priors, solver):
    like = make()
    default = best_fit(like, start, priors=priors)
    assert default.details["solver"] == "Newton"
    fit = best_fit(like, start, priors=priors, solver=SOLVERS[solver])
    assert fit.details["solver"] == solver
    # The least-squares solvers square their last step; BFGS stops at the tolerance.
    assert deviation(fit, default) < 1e-6
    assert fit.details["distance"] < 1e-6
    for name in fit.free:
        np.testing.assert_allclose(fit.sigma[name], default.sigma[name], rtol=1e-6)
    assert fit.chi2 == pytest.approx(default.chi2, rel=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_units_of_the_maps_do_not_matter(solver):
    small, large = (best_fit(constant(s), FAR, solver=SOLVERS[solver]) for s in (1e6, 1.0))
    assert deviation(small, large) < 1e-6
    # Rounding differs, and with it where BFGS turns.
    assert small.details["steps"] == pytest.approx(large.details["steps"], abs=20)


def test_units_of_parameters_do_not_matter():
    """A shift near zero, and a gain of one."""
    _, data, given, _ = problem()
    start = {"dust.beta_dust": 1.5, "shift.220": 0.0, "gain.145": 1.0}
    like = spectral_likelihood(random_sky(), BANDS, data, given, start)
    fit = best_fit(like, solver=SOLVERS["BFGS"])
    assert deviation(fit, best_fit(like)) < 1e-6


class Wide(Prior):
    def log_density(self, value):
        return -(((value - 3.0) / 0.1) ** 4)


class Flat(Prior):
    def log_density(self, value):
        return 0.0 * value


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"solver": SOLVERS["BFGS"], "max_steps": 3}, FitError,
         r"The search stopped after 3 steps, .* sigma from the optimum"),
        ({"start": FAR | {"dust.T_dust": 60.0, "dust.beta_dust": 3.0}, "max_steps": 0}, FitError,
         "The search stopped after 0 steps, and not at an optimum"),
        ({"start": FAR, "max_steps": 0}, FitError, r"after 0 steps, 1\.3e\+02 sigma from"),
        ({"solver": "BFGS"}, TypeError, "`solver` must be a least-squares solver.*, not str"),
        ({"solver": optx.Newton(1e-8, 1e-8)}, TypeError, "`solver` must be .*, not Newton"),
        ({"solver": SOLVERS["LevenbergMarquardt"], "priors": {"synchrotron.beta_syn": Wide()}},
         TypeError, "takes uniform and Gaussian priors, not the Wide of 'synchrotron.beta_syn'"),
        ({"solver": SOLVERS["BFGS"], "priors": {"gain.23": Flat()}}, KeyError,
         "'gain.23', which is not free"),
    ],
)  # fmt: skip
def test_failures_say_what_they_are(options, error, words):
    with pytest.raises(error, match=words) as caught:
        best_fit(constant(), **options)
    if error is FitError:
        result = caught.value.result
        assert not result.converged
        assert best_fit(constant(), throw=False, **options).message == result.message


def test_a_search_that_leaves_the_finite_numbers_says_so(monkeypatch):
    monkeypatch.setattr(Newton, "minimise", lambda _, posterior, __: (posterior.start * np.nan, 7))
    with pytest.raises(FitError, match="left the finite numbers within 7 steps") as caught:
        best_fit(constant())
    assert caught.value.result.converged is Convergence.not_finite


def test_a_minimiser_takes_any_prior():
    priors = {"synchrotron.beta_syn": Wide()}
    fit = best_fit(constant(), priors=priors, solver=SOLVERS["BFGS"])
    assert deviation(fit, best_fit(constant(), priors=priors)) < 1e-6


def test_priors_hold_in_each_region_with_pixels():
    like = regions()
    posterior = Posterior(like, BOTH)
    theta = np.array(like.flat({"dust.T_dust": 40.0, "synchrotron.beta_syn": 3.05}))
    labels = np.array(posterior.labels)
    assert labels[posterior.edges(theta)].tolist() == ["dust.T_dust[2]"]
    count = sum(label.startswith("synchrotron") for label in labels[posterior.present])
    of_priors = posterior.value(theta)[0] - Posterior(like, {}).value(theta)[0]
    assert of_priors == pytest.approx(count * 2.5**2 / 2, rel=1e-6)
    start = {"dust.T_dust": np.array([20.0, 20.0, 45.0])}
    with pytest.raises(ValueError, match=r"Start value 45 of 'dust.T_dust' is not inside"):
        best_fit(like, start, priors=BOTH)
