"""Grid, gradient and MCMC: they agree, respect priors, resume, and say when they fail."""

import json

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from fits.grid import grid_fit
from fits.optimize import Newton, best_fit
from fits.posterior import Gaussian, Likelihood, Uniform
from fits.results import Convergence, FitError, misfit, with_error, write_json
from fits.sampling import sample
from fits.template_likelihood import likelihood
from jaxsky import Dust, Sky, observe, set_parameters
from refusals import cases, raises
from test_likelihood import BANDS, START, fitted, fluctuations, problem

PRIORS = {"dust.beta_dust": Uniform(0.5, 2.5), "synchrotron.beta_syn": Uniform(2.0, 4.5)}


@pytest.fixture(scope="module", params=[pytest.param("diagonal", marks=pytest.mark.slow), "exact"])
def like(request):
    if request.param == "diagonal":
        return fitted()
    # A tenth of the noise, so that the posterior is close to a Gaussian.
    model = fluctuations()
    return fitted(covariance_of=lambda rows: model.covariance(rows) / 100)


def test_the_three_methods_agree(like):
    """Best fits within 0.1 sigma, widths within 5 %."""
    gradient = best_fit(like, START, priors=PRIORS)
    grid = grid_fit(like, START, priors=PRIORS)
    mcmc = sample(like, START, priors=PRIORS, nsteps=4000, progress=False)
    assert gradient.free == grid.free == mcmc.free == tuple(sorted(START))
    for name in START:
        sigma = gradient.sigma[name]
        for other in (grid, mcmc):
            assert abs(other.best_fit[name] - gradient.best_fit[name]) < 0.1 * sigma
            assert other.sigma[name] == pytest.approx(sigma, rel=0.05)
            for a, b in zip(other.interval_68[name], gradient.interval_68[name], strict=True):
                assert abs(a - b) < 0.1 * sigma
    assert grid.chi2 == pytest.approx(gradient.chi2, abs=0.02)
    assert mcmc.chi2 == pytest.approx(gradient.chi2, abs=0.02)
    assert 0.2 < mcmc.details["acceptance"] < 0.9
    assert all(20 < tau < 60 for tau in mcmc.details["tau"].values())


class Ridge(Likelihood):
    """Two correlated numbers with a Gaussian posterior."""

    middle: np.ndarray
    root: np.ndarray

    def residuals(self, params):
        return self.root @ (self.flat(params) - self.middle)

    def check(self, params):
        return {name: jnp.asarray(value, float) for name, value in params.items()}


@pytest.mark.parametrize("points", [30, 200])
@pytest.mark.parametrize("correlation", [0.0, 0.35, -0.9, 0.97, 0.99999])
def test_a_grid_finds_a_narrow_posterior_or_says_that_it_does_not(correlation, points):
    """Narrower than the spacing of the first grid by 100, with its peak anywhere between."""
    sigma, priors = np.array([1e-4, 1e-3]), {"a": Uniform(0.5, 2.5), "b": Uniform(2.0, 4.5)}
    covariance = sigma[:, None] * sigma * [[1, correlation], [correlation, 1]]
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    for middle in np.random.default_rng(0).uniform([1.2, 2.7], [1.8, 3.4], (10, 2)):
        like = Ridge({"a": jnp.array(1.5), "b": jnp.array(3.0)}, 2, middle, root)
        found = grid_fit(like, priors=priors, points=points)
        if correlation > 0.99 or (points < 200 and correlation > 0.95):
            assert found.converged is Convergence.unresolved
            assert f"{points} points per axis are too few" in found.message
            continue
        assert found.converged
        np.testing.assert_allclose(list(found.sigma.values()), sigma, rtol=0.01)
        steps = [axis[1] - axis[0] for axis in found.details["axes"].values()]
        assert np.all(
            np.abs(np.array(list(found.best_fit.values())) - middle) < 2 * np.array(steps)
        )


def test_parameters_are_recovered_without_noise():
    truth = {"dust.beta_dust": 1.7, "synchrotron.beta_syn": 2.8}
    data = observe(set_parameters(problem()[0], truth), list(BANDS.values()))
    like = fitted(data=data)
    for solver in (None, optx.GaussNewton(1e-12, 1e-12), optx.Dogleg(1e-12, 1e-12)):
        found = best_fit(like, START, priors=PRIORS, solver=solver)
        for name, value in truth.items():
            assert found.best_fit[name] == pytest.approx(value, abs=1e-7)
        assert found.chi2 < 1e-9


def test_covariance_is_the_inverse_hessian_of_a_linear_fit():
    sky, data, sigma = problem()
    names = {"gain.44": 1.0, "gain.70": 1.0}
    found = best_fit(likelihood(sky, BANDS, data, sigma, names), names)
    model = np.asarray(observe(sky, list(BANDS.values())))
    information = np.sum((model / np.asarray(sigma)) ** 2, axis=(1, 2))
    np.testing.assert_allclose(found.covariance, np.diag(1 / information), rtol=1e-9, atol=1e-18)


def test_fits_do_not_depend_on_units():
    """Maps in K instead of uK, templates and noise with them, give the same indices."""
    sky, data, sigma = problem()
    small = {f"{n}.amplitude": 1e-6 * sky[n].amplitude for n in sky}
    a = best_fit(fitted())
    b = best_fit(fitted(sky=set_parameters(sky, small), data=1e-6 * data, sigma=1e-6 * sigma))
    for name in START:
        assert b.best_fit[name] == pytest.approx(a.best_fit[name], abs=1e-6)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6)


def test_a_gaussian_prior_pulls_by_its_weight():
    name = "gain.44"
    like = fitted(start={name: 1.0})
    free = best_fit(like, {name: 1.0})
    prior = Gaussian(free.best_fit[name] + 1.0, free.sigma[name])
    pulled = best_fit(like, {name: 1.0}, priors={name: prior})
    assert pulled.best_fit[name] == pytest.approx(free.best_fit[name] + 0.5, abs=1e-6)
    assert pulled.sigma[name] == pytest.approx(free.sigma[name] / np.sqrt(2), rel=1e-6)


@pytest.mark.slow
def test_more_free_parameters_by_name():
    start = {**START, "dust.T_dust": 20.0, "synchrotron.curvature": 0.0, "offset.44.Q": 0.0}
    priors = {"dust.T_dust": Gaussian(21.0, 1.0), "synchrotron.curvature": Gaussian(0.0, 0.1)}
    found = best_fit(fitted(start=start), priors=priors)
    for name, value in (("dust.beta_dust", 1.53), ("offset.44.Q", 0.0), ("dust.T_dust", 21.0)):
        assert abs(found.best_fit[name] - value) < 4 * found.sigma[name]


@pytest.mark.parametrize(("prior", "numbers", "words"), cases("methods/priors"))
def test_priors_that_make_no_sense_are_refused(prior, numbers, words):
    raises(ValueError, words, {"uniform": Uniform, "gaussian": Gaussian}[prior], *numbers)


def test_an_optimum_at_the_edge_of_a_prior_is_reported(like):
    narrow = PRIORS | {"dust.beta_dust": Uniform(2.2, 2.5)}
    start = START | {"dust.beta_dust": 2.3}
    with pytest.raises(FitError, match=r"'dust.beta_dust' lies at the edge 2.2") as caught:
        best_fit(like, start, priors=narrow)
    assert caught.value.result.best_fit["dust.beta_dust"] == pytest.approx(2.2, abs=1e-3)
    at_edge = best_fit(like, start, priors=narrow, throw=False).converged
    assert at_edge is Convergence.at_edge
    assert not at_edge
    # The grid and the chain pile up at the same edge instead of failing.
    grid = grid_fit(like, start, priors=narrow)
    assert grid.best_fit["dust.beta_dust"] == pytest.approx(2.2)
    assert grid.converged is Convergence.at_edge
    assert grid.interval_68["dust.beta_dust"][0] >= 2.2


def test_a_parameter_without_effect_is_reported():
    sky, data, sigma = problem(sky=Sky({"dust": Dust(problem()[0]["dust"].amplitude)}))
    start = {"dust.nu_ref": 353.0, "gain.44": 1.0, "gain.70": 1.0}
    like = likelihood(sky, BANDS, data, sigma, start)
    raises(FitError, r"determine dust.nu_ref, gain.*: parameters are degen", best_fit, like, start)


def test_a_grid_needs_one_or_two_parameters_with_ranges(like):
    with pytest.raises(ValueError, match=r"one or two free parameters, not 3"):
        grid_fit(like, START | {"gain.44": 1.0}, priors=PRIORS)
    with pytest.raises(ValueError, match=r"uniform prior for 'synchrotron.beta_syn'"):
        grid_fit(like, START, priors={"dust.beta_dust": Uniform(1, 2)})
    with pytest.raises(ValueError, match="`points` must be at least 3, not 1"):
        grid_fit(like, START, priors=PRIORS, points=1)


def test_a_grid_of_one_parameter(like):
    start = {"dust.beta_dust": 1.6}
    priors = {"dust.beta_dust": PRIORS["dust.beta_dust"]}
    grid, gradient = grid_fit(like, start, priors=priors), best_fit(like, start, priors=priors)
    assert grid.sigma["dust.beta_dust"] == pytest.approx(gradient.sigma["dust.beta_dust"], rel=0.03)


def test_samples_stay_inside_the_prior(like):
    narrow = PRIORS | {"dust.beta_dust": Uniform(1.9, 2.5)}
    start = START | {"dust.beta_dust": 2.0}
    chain = sample(like, start, priors=narrow, nsteps=200, progress=False, throw=False)
    values = chain.details["chain"][..., chain.free.index("dust.beta_dust")]
    assert values.min() >= 1.9
    assert bool(jnp.isfinite(chain.details["log_prob"]).all())


def by_each(like, start):
    """Gradient, grid and, as far as it goes, chain."""
    yield best_fit(like, start, priors=PRIORS, throw=False)
    yield grid_fit(like, start, priors=PRIORS, points=50)
    yield sample(like, start, priors=PRIORS, nsteps=4000, progress=False, throw=False)


def test_results_are_printed_written_and_given_to_getdist(like):
    fit = best_fit(like, START, priors=PRIORS)
    heading, first, second, last = str(fit).splitlines()
    value, sigma = fit.best_fit["dust.beta_dust"], fit.sigma["dust.beta_dust"]
    assert heading == "Fit by gradient, converged"
    assert first.split(maxsplit=1) == ["dust.beta_dust", with_error(value, sigma)]
    assert second.startswith("  synchrotron.beta_syn  ")
    assert last.split(maxsplit=1) == ["chi2", f"{fit.chi2:.1f} for {fit.dof} degrees of freedom"]
    assert f"<td>{with_error(value, sigma)}</td>" in fit._repr_html_()
    numbers = fit.to_dict()
    assert numbers["free"] == tuple(sorted(START))
    assert numbers["sigma"] is fit.sigma
    assert "details" not in numbers
    raises(ValueError, "method 'gradient' has no samples", fit.to_getdist)
    chain = sample(like, START, priors=PRIORS, nsteps=100, progress=False, throw=False)
    assert chain.converged is Convergence.unmixed
    assert "not converged: 100 steps are" in str(chain)
    samples = chain.to_getdist("a chain", symbol=lambda name: name[-4:])
    assert [p.label for p in samples.paramNames.names] == ["dust", "_syn"]
    used = chain.details["chain"][chain.details["discard"] :: chain.details["thin"]]
    assert samples.samples.shape == (used.shape[0] * used.shape[1], 2)


@pytest.mark.slow
def test_templates_take_newtons_method_and_the_no_u_turn_sampler(like):
    default = best_fit(like, START, priors=PRIORS)
    newton = best_fit(like, priors=PRIORS, solver=Newton())
    chain = sample(like, priors=PRIORS, sampler="nuts", progress=False)
    assert chain.converged
    for name, sigma in default.sigma.items():
        assert abs(newton.best_fit[name] - default.best_fit[name]) < 1e-6 * sigma
        assert newton.sigma[name] == pytest.approx(sigma, rel=1e-6)
        low, high = chain.interval_68[name]
        assert (low + high) / 2 == pytest.approx(default.best_fit[name], abs=0.15 * sigma)
        assert chain.sigma[name] == pytest.approx(sigma, rel=0.1)


def test_a_chi2_that_is_astronomical_is_no_fit():
    """Missing values of integer columns, -32768, in one pixel of a hundred."""
    _, data, sigma = problem()
    marred = np.array(data)
    marred[0, :, ::100] = -32768.0
    for result in by_each(fitted(data=marred), START):
        assert not result.converged
        assert "missing values that are read as data, a wrong unit" in result.message
    well = best_fit(fitted(), START)
    assert well.judged(1e9, 24, START).converged is Convergence.misfit
    with pytest.raises(FitError, match="degrees of freedom, so the model does not describe"):
        best_fit(fitted(data=marred), START, priors=PRIORS)
    # Errors three times too small, and bright pixels that no law describes, are those of real maps.
    for other in (fitted(sigma=np.asarray(sigma) / 3), fitted(data=np.asarray(data) * 1.02)):
        assert best_fit(other, START, priors=PRIORS).converged


@pytest.mark.parametrize(("chi2", "dof", "fits"), cases("methods/astronomical"))
def test_what_is_astronomical(chi2, dof, fits):
    assert (misfit(chi2, dof) is None) == fits


def test_degrees_of_freedom_are_data_with_weight():
    _, data, sigma = problem()
    masked = np.array(np.broadcast_to(sigma, data.shape))
    masked[0, 0, :7] = np.inf
    for pixelwise in (False, True):
        one = fitted(sigma=masked, pixelwise=pixelwise)
        assert one.dof(2) == data.size - 7 - 2
        U = fitted(sigma=masked, stokes="U", pixelwise=pixelwise)
        assert U.dof(2) == data.size // 2 - 2


def test_a_start_at_the_optimum_is_told_from_a_search_that_does_not_move():
    sky, _, _ = problem()
    truth = {"dust.beta_dust": 1.7, "synchrotron.beta_syn": 2.8}
    data = observe(set_parameters(sky, truth), list(BANDS.values()))
    assert best_fit(fitted(data=data), truth, priors=PRIORS).converged
    # Steps of nothing, which optimistix takes for success.
    still = optx.GradientDescent(learning_rate=0.0, rtol=1e-3, atol=1e-3)
    with pytest.raises(FitError, match=r"did not leave its start, .* sigma from the opt") as caught:
        best_fit(fitted(data=data), START, solver=still)
    assert caught.value.result.converged is Convergence.stalled


@pytest.mark.parametrize("solver", [Newton(), optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)])
def test_how_a_fit_ended_is_said_once_and_written_as_true_or_false(solver, tmp_path):
    like = fitted()
    ended = {
        Convergence.converged: best_fit(like, START, solver=solver),
        Convergence.max_steps: best_fit(like, START, solver=solver, max_steps=1, throw=False),
    }
    for state, result in ended.items():
        assert result.converged is state
        assert bool(result.converged) == (state is Convergence.converged)
        assert result.to_dict()["converged"] is bool(state)
        write_json(tmp_path / "result.json", result.to_dict())
        written = json.loads((tmp_path / "result.json").read_text())
        assert written["converged"] is bool(state)
        assert written["message"] == result.message
    assert f"Fit by gradient, not converged: {result.message}" in str(result)
    assert (
        str(Convergence.max_steps) == "The search made all its steps without reaching an optimum."
    )


def test_weights_of_nothing_are_no_fit():
    flat = fitted(sigma=np.asarray(problem()[2]) * 1e12)
    raises(FitError, r"do not constrain .*a Gaussian prior on .* would help", best_fit, flat, START)
    grid = grid_fit(flat, START, priors=PRIORS)
    assert grid.converged is Convergence.undetermined
    assert "The posterior is flat" in grid.message


def test_a_parameter_that_runs_away_is_no_fit():
    """Data in proportion to the frequency squared times more: the hotter, the better."""
    sky, _, sigma = problem()
    dust = Sky({"dust": Dust(sky["dust"].amplitude, T_dust=19.6)})
    data = observe(set_parameters(dust, {"dust.T_dust": 1e12}), list(BANDS.values()))
    like = likelihood(dust, BANDS, data, np.asarray(sigma) / 1e6, {"dust.T_dust": 19.6})
    result = best_fit(like, {"dust.T_dust": 19.6}, throw=False)
    assert not result.converged
    away = result._replace(converged=Convergence.converged, best_fit={"dust.T_dust": 1e12})
    judged = away.judged(1.0, 10, {"dust.T_dust": 19.6})
    assert judged.converged is Convergence.undetermined
    assert "do not constrain 'dust.T_dust': from 19.6 it went to 1e+12" in judged.message
    offset = result._replace(
        converged=Convergence.converged, best_fit={"offset.44.Q": 900.0}, sigma={"offset.44.Q": 1.0}
    )
    assert offset.judged(1.0, 10, {"offset.44.Q": 0.0}).converged
