"""Solvers and samplers of spectral parameters: one optimum, known densities, honest failures."""

import builtins
import inspect
from functools import cache

import blackjax
import jax
import numpy as np
import optimistix as optx
import pytest
import scipy.special
import scipy.stats

from fits.kept import KeptChain
from fits.optimize import Newton, best_fit
from fits.posterior import Gaussian, Posterior, Prior, Uniform, value_and_gradient
from fits.profile_likelihood import spectral_likelihood
from fits.results import Convergence, FitError
from fits.sampling import agreement, sample
from fits.unbounded import unbounded_posterior
from refusals import cases, raises
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


@pytest.mark.slow
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


SAMPLERS = ("nuts", "emcee")
NAMES = tuple(sorted(START))


def draw(like, sampler, **options):
    steps = {"nuts": {}, "emcee": {"nsteps": 2500}}[sampler]
    return sample(like, sampler=sampler, **({"progress": False} | steps | options))


@cache
def strong(size: float = 300.0):
    """Signals far above the noise: close to a Gaussian."""
    _, data, given, _ = problem(sky=random_sky(size=size))
    return spectral_likelihood(random_sky(), BANDS, data, given, START)


@cache
def empty():
    """Data that say nothing: no signal, no noise."""
    _, data, given, _ = problem()
    return spectral_likelihood(random_sky(), BANDS, 0 * data, given, START)


def samples(result):
    chain = result.details["chain"][result.details["discard"] :]
    return chain.reshape(-1, chain.shape[-1])


def check(result, mean, width, within=0.1):
    """Means within 0.1 sigma and widths within 10 %: 4 errors of 1000 independent samples."""
    flat = samples(result)
    assert np.abs((flat.mean(axis=0) - mean) / width).max() < within
    assert np.abs(flat.std(axis=0) / width - 1).max() < 0.1


@pytest.mark.parametrize("sampler", [pytest.param("nuts", marks=pytest.mark.slow), "emcee"])
def test_samples_of_a_well_determined_problem_are_those_of_the_curvature(sampler):
    like = strong()
    fit = best_fit(like)
    result = draw(like, sampler)
    assert result.method == {"nuts": "nuts", "emcee": "mcmc"}[sampler]
    assert result.converged
    assert result.labels == fit.labels == NAMES
    width = np.sqrt(np.diagonal(np.linalg.inv(fit.details["hessian"])))
    # The posterior is skewed, and its mean 0.09 sigma from its maximum.
    check(result, [fit.best_fit[n] for n in NAMES], width, within=0.17)
    for i, name in enumerate(NAMES):
        assert abs(result.best_fit[name] - fit.best_fit[name]) < 0.5 * width[i]
        low, high = result.interval_68[name]
        assert high - low == pytest.approx(2 * width[i], rel=0.1)
        assert result.sigma[name] == pytest.approx(width[i], rel=0.1)
    np.testing.assert_allclose(result.covariance, np.cov(samples(result).T))
    assert result.chi2 == pytest.approx(fit.chi2, abs=0.5)
    assert result.details["log_prob"].max() == pytest.approx(-result.chi2 / 2, abs=1e-8)
    assert set(result.details["tau"]) == set(NAMES)
    assert 0.2 < result.details["acceptance"] < 0.95
    if sampler == "nuts":
        assert result.details["chain"].shape == (1000, 4, 3)
        assert result.details["divergences"] == 0
        assert max(result.details["rhat"].values()) < 1.01
        assert min(result.details["ess"].values()) > 1000
        assert result.details["gradients"] < 10


PRIORS = {
    # Cuts through the middle, and the two others far out.
    "dust.T_dust": (-0.5, 6.0),
    "dust.beta_dust": (-8.0, 8.0),
    "synchrotron.beta_syn": (-8.0, 8.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_cut_posterior_is_that_of_integrals_on_a_grid(sampler):
    """Correlated, with a long tail, and cut half a standard deviation below the maximum."""
    like = constant()
    fit = best_fit(like)
    priors = {
        name: Uniform(*(fit.best_fit[name] + fit.sigma[name] * np.array(ends)))
        for name, ends in PRIORS.items()
    }
    result = draw(like, sampler, priors=priors, nsteps={"nuts": 1000, "emcee": 6000}[sampler])
    nodes, weights = scipy.special.roots_legendre(48)
    axes = [p.low + (p.high - p.low) * (1 + nodes) / 2 for p in (priors[n] for n in NAMES)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    value = jax.jit(
        lambda like, theta: jax.lax.map(lambda t: -like.total(t[like.index]) / 2, theta)
    )
    density = np.asarray(value(like, grid.reshape(-1, 3))).reshape(grid.shape[:3])
    density = np.exp(density - density.max())
    density *= np.einsum("i,j,k->ijk", weights, weights, weights)
    density /= density.sum()
    mean = np.einsum("ijk,ijkp->p", density, grid)
    width = np.sqrt(np.einsum("ijk,ijkp->p", density, (grid - mean) ** 2))
    check(result, mean, width)
    # Not the Gaussian of the fit: a third of it is cut off.
    T = NAMES.index("dust.T_dust")
    assert abs(width[T] / fit.sigma["dust.T_dust"] - 1) > 0.1
    assert mean[T] - fit.best_fit["dust.T_dust"] > 0.3 * fit.sigma["dust.T_dust"]
    below = density.sum(axis=tuple({0, 1, 2} - {T})).cumsum()
    median = np.interp(0.5, below, axes[T])
    assert np.median(samples(result)[:, T]) == pytest.approx(median, abs=0.15 * width[T])
    assert samples(result)[:, T].min() > priors["dust.T_dust"].low


@pytest.mark.slow
def test_a_cut_through_a_narrow_ridge_is_a_truncated_normal():
    """One standard deviation above the maximum; temperature and index are correlated by 0.99."""
    like = strong(1000.0)
    fit = best_fit(like)
    covariance = np.linalg.inv(fit.details["hessian"])
    sigma = np.sqrt(np.diagonal(covariance))
    T = NAMES.index("dust.T_dust")
    edge = fit.best_fit["dust.T_dust"] + sigma[T]
    result = draw(
        like,
        "nuts",
        start={"dust.T_dust": edge + sigma[T]},
        priors={"dust.T_dust": Uniform(edge, 60.0)},
    )
    # Mean and variance of a normal variable beyond one.
    mean, variance = scipy.stats.truncnorm.stats(1, np.inf)
    shift = covariance[T] / sigma[T] * mean
    cut = covariance - np.outer(covariance[T], covariance[T]) / sigma[T] ** 2 * (1 - variance)
    check(result, [fit.best_fit[n] for n in NAMES] + shift, np.sqrt(np.diagonal(cut)))
    assert min(result.details["ess"].values()) > 1000


def test_numbers_without_bounds_have_unit_covariance_and_go_back():
    """Of samples with a cut, a curved and a free parameter; the Jacobian is the derivative."""
    priors = {"dust.T_dust": Uniform(15.0, 60.0), "dust.beta_dust": Uniform(1.0, 2.0)}
    posterior, unknown = unbounded_posterior(
        Posterior(strong(), priors), np.array([20.0, 1.5, 3.0])
    )
    assert not unknown
    rng = np.random.default_rng(3)
    T = 15 + rng.exponential(5, 2000) % 45
    beta = 1.5 + 0.005 * (T - 20) + 0.02 * np.log(T - 15) + 0.001 * rng.normal(size=2000)
    values = np.stack([T, beta, 3 + beta + 0.01 * rng.normal(size=2000)], axis=1)
    assert posterior.adapted(values[:20]) is posterior
    assert posterior.adapted(values[:1].repeat(2000, axis=0)) is posterior
    adapted = posterior.adapted(values)
    z = adapted.coordinates(values)
    np.testing.assert_allclose(np.cov(z.T), np.eye(3), atol=0.01)
    for each in (posterior, adapted):
        z = each.coordinates(values)
        back, jacobian = jax.jit(jax.vmap(each.values))(z)
        np.testing.assert_allclose(back, values, rtol=1e-9)
        slopes = jax.jit(jax.vmap(jax.jacobian(lambda x, each=each: each.values(x)[0])))(z[:5])
        constant = np.log(np.abs(np.linalg.det(slopes))) - jacobian[:5]
        np.testing.assert_allclose(constant, constant[0], atol=1e-8)


def test_without_data_the_posterior_is_the_prior():
    """The Jacobian of bounded parameters: their samples are uniform up to the edges."""
    priors = {
        "dust.T_dust": Uniform(10.0, 30.0),
        "dust.beta_dust": Uniform(1.4, 1.6),
        "synchrotron.beta_syn": Uniform(2.0, 3.5),
    }
    flat = samples(draw(empty(), "nuts", priors=priors))
    unit = np.stack(
        [
            (flat[:, i] - priors[n].low) / (priors[n].high - priors[n].low)
            for i, n in enumerate(NAMES)
        ]
    )
    shares = np.stack([np.histogram(u, 10, (0, 1))[0] for u in unit]) / unit.shape[1]
    # 0.1 +- 0.007 with 2000 independent samples.
    assert np.abs(shares - 0.1).max() < 0.03
    for sampler in SAMPLERS:
        with pytest.raises(FitError, match=r"do not determine dust.T_dust, .*: there is nothing"):
            draw(empty(), sampler)
        nothing = draw(empty(), sampler, throw=False)
        assert nothing.converged is Convergence.undetermined
        assert np.isnan(nothing.covariance).all()
        assert not nothing.details


@pytest.mark.slow
def test_regions_have_labels_and_those_without_pixels_none():
    priors = {"dust.T_dust": Gaussian(19.5, 0.5)}
    like = regions()
    fit = best_fit(like, priors=priors)
    result = draw(like, "nuts", priors=priors)
    present = [label for label in fit.labels if label not in ("dust.T_dust[0]", "dust.T_dust[1]")]
    assert result.labels == tuple(present)
    assert np.isnan(result.sigma["dust.T_dust"]).tolist() == [True, True, False]
    keep = [fit.labels.index(label) for label in present]
    width = np.sqrt(np.diagonal(np.linalg.inv(fit.details["hessian"][np.ix_(keep, keep)])))
    check(result, np.concatenate([np.ravel(fit.best_fit[n]) for n in fit.free])[keep], width)
    # The density is that of the likelihood and of the prior.
    theta = result.details["chain"][-1, 0]
    T = theta[present.index("dust.T_dust[2]")]
    full = np.array(like.flat({}))
    full[keep] = theta
    expected = -float(value_and_gradient(like, full)[0]) - ((T - 19.5) / 0.5) ** 2 / 2
    assert result.details["log_prob"][-1, 0] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_seeds_matter_and_repeat(sampler):
    options = {"nsteps": 20, "throw": False}
    chains = [draw(strong(), sampler, seed=s, **options).details["chain"] for s in (1, 1, 2)]
    np.testing.assert_array_equal(chains[0], chains[1])
    assert not np.array_equal(chains[0], chains[2])


def test_how_steps_are_counted_does_not_matter():
    long, short = (draw(strong(), "nuts", nsteps=n, throw=False) for n in (150, 40))
    np.testing.assert_array_equal(long.details["chain"][:40], short.details["chain"])
    one = draw(strong(), "nuts", nsteps=40, nwarmup=0, throw=False).details["chain"]
    assert one.shape == (40, 4, 3)
    assert not np.array_equal(one, short.details["chain"])


def test_a_stopped_ensemble_goes_on_as_if_it_had_not(tmp_path):
    whole = draw(strong(), "emcee", nsteps=40, throw=False)
    path = tmp_path / "chain.npz"
    draw(strong(), "emcee", nsteps=25, backend=KeptChain(path), throw=False)
    for _ in ("gone on with", "read: it is finished"):
        again = draw(strong(), "emcee", nsteps=40, backend=KeptChain(path), throw=False)
        np.testing.assert_array_equal(again.details["chain"], whole.details["chain"])


def test_short_chains_are_reported():
    with pytest.raises(FitError, match=r"4 chains of 20 steps: R-hat .*; needed are .*400") as e:
        draw(strong(), "nuts", nsteps=20, nwarmup=10)
    assert e.value.result.details["chain"].shape == (20, 4, 3)
    with pytest.raises(FitError, match=r"100 steps are \d+ autocorrelation times .* at least 50"):
        draw(strong(), "emcee", nsteps=100)


@pytest.mark.parametrize(("options", "error", "words"), cases("separation_sample/bad_input"))
def test_bad_input_is_refused(options, error, words):
    raises(getattr(builtins, error), words, sample, strong(), **({"sampler": "nuts"} | options))


def test_priors_of_other_parameters_or_without_the_start_are_refused():
    for priors, error, words in (
        ({"dust.T_dust": Uniform(30.0, 40.0)}, ValueError, "Start value 21 of 'dust.T_dust' is"),
        ({"gain.23": Gaussian(1, 1)}, KeyError, "'gain.23', which is not free"),
    ):
        raises(error, words, sample, strong(), sampler="nuts", priors=priors)


def test_every_argument_is_described():
    for name in inspect.signature(sample).parameters:
        assert f"{name} :" in sample.__doc__ or f" {name}, " in sample.__doc__


def test_agreement_is_that_of_blackjax_and_of_autoregressive_chains():
    rng = np.random.default_rng(1)
    correlation = np.array([-0.4, 0.0, 0.9])
    chain = rng.normal(size=(2000, 3, 3))
    for i in range(1, len(chain)):
        chain[i] = correlation * chain[i - 1] + np.sqrt(1 - correlation**2) * chain[i]
    rhat, effective = agreement(chain)
    # Of alternating chains, squares are the worse ones.
    worse = np.maximum(correlation, correlation**2)
    np.testing.assert_allclose(effective, 6000 * (1 - worse) / (1 + worse), rtol=0.2)
    chain[:, 0] += 0.2
    rhat, _ = agreement(chain)
    np.testing.assert_allclose(rhat, jax.jit(blackjax.rhat)(np.swapaxes(chain, 0, 1)), rtol=1e-6)
    assert np.all(rhat[:2] > 1.005)
    chain[..., 1] = 3.0
    assert np.isnan(agreement(chain)[0]).tolist() == [False, True, False]
