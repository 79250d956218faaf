"""Posterior samples of spectral parameters: the no-U-turn sampler, or emcee's ensemble.

The no-U-turn sampler (Hoffman & Gelman 2014, JMLR 15, 1593) follows the gradient, so it takes a
few evaluations for a sample that does not depend on the last one, however many parameters there
are. It moves in numbers without bounds whose covariance is about the unit matrix: a uniform prior
becomes the logistic map of its range, whose Jacobian is part of the density, and the curvature of
-log posterior at the best fit gives the rest.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.step_size import dual_averaging_adaptation
from jaxtyping import Array, Bool, Float, Int
from tqdm import tqdm

from fits.priors import Prior, check_priors
from fits.results import FitResult
from fits.sample import ChainFile, ensemble, ensemble_summary, summary
from fits.separation.agreement import agreement
from fits.separation.algebra import degenerate
from fits.separation.fit import fit_spectra
from fits.separation.likelihood import SpectralLikelihood
from fits.separation.problem import Problem, prior_terms, value_and_gradient
from jaxsky.types import Numeric

__all__ = ["sample_spectra"]

#: What each sampler takes, with the values if they are not given.
OPTIONS: dict[str, dict[str, Any]] = {
    "nuts": {"nsteps": 1000, "nwarmup": 300, "nchains": 4},
    "emcee": {"nsteps": 5000, "nwalkers": 32, "backend": None},
}
#: Mean acceptance that the step size of the no-U-turn sampler is tuned to.
ACCEPTANCE = 0.8
#: Width of the start positions of its chains, in standard deviations.
SPREAD = 2.0
#: Its steps in one call of a program: what progress is counted in.
BLOCK = 100
#: R-hat of chains that agree, and effective samples that each of them needs, after Vehtari et al.
#: (2021, Bayesian Analysis 16, 667).
AGREEMENT, EFFECTIVE = 1.01, 100


class _Posterior(NamedTuple):
    """The posterior of the parameters of regions with pixels, and numbers to move in.

    Parameters
    ----------
    like, priors : the likelihood, and priors that are not uniform
    theta, present : the vector of all parameters, and positions of those that are sampled
    bounded, low, high : whether they have a uniform prior, and its range (any other number if not)
    center, root : the unbounded numbers are center + root z, or root times z if it is a vector
    """

    like: SpectralLikelihood
    priors: list[tuple[Prior, Array]]
    theta: Float[Array, " all"]
    present: Int[Array, " par"]
    bounded: Bool[Array, " par"]
    low: Float[Array, " par"]
    high: Float[Array, " par"]
    center: Float[Array, " par"]
    root: Float[Array, "*par par"]

    def log_prob(self, values: Float[Array, " par"]) -> Float[Array, ""]:
        """Log posterior of parameters within their uniform priors, without constants."""
        theta = self.theta.at[self.present].set(values)
        value = prior_terms(theta, self.priors)[0]
        return -self.like.total(theta[self.like.index]) / 2 - value

    def values(self, z: Float[Array, " par"]) -> tuple[Float[Array, " par"], Float[Array, ""]]:
        """Parameters, and the log of the Jacobian of the logistic map."""
        y = self.center + (self.root @ z if self.root.ndim == 2 else self.root * z)
        width = self.high - self.low
        inside = self.low + width * jax.nn.sigmoid(y)
        jacobian = jnp.log(width) + jax.nn.log_sigmoid(y) + jax.nn.log_sigmoid(-y)
        values = jnp.where(self.bounded, inside, y)
        return values, jnp.sum(jnp.where(self.bounded, jacobian, 0.0))

    def density(self, z: Float[Array, " par"]) -> Float[Array, ""]:
        """Log density of z."""
        values, jacobian = self.values(z)
        return self.log_prob(values) + jacobian


def _posterior(problem: Problem, theta: np.ndarray) -> tuple[_Posterior, list[str]]:
    """The posterior, scaled by its curvature near the best fit; parameters it does not determine.

    Parameters
    ----------
    problem : the function
    theta : the best fit
    """
    present = np.flatnonzero(problem.present)
    bounded = np.isfinite(problem.low[present])
    low = np.where(bounded, problem.low[present], 0.0)
    high = np.where(bounded, problem.high[present], 1.0)
    width = high - low

    def derivatives(theta):
        local = problem.convex(theta, problem.exact(theta))
        return problem.curvature(theta, local, present), problem.value(theta)[1][present]

    # Away from the edges by what the density falls over there.
    matrix, slope = derivatives(theta)
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.stack([1 / np.sqrt(matrix.diagonal()), 1 / np.abs(slope), width / 4])
    margin = np.nanmin(scales, axis=0)
    theta = theta.copy()
    near = np.clip(theta[present], low + margin, high - margin)
    theta[present] = np.where(bounded, near, theta[present])
    matrix, slope = derivatives(theta)

    unit = np.where(bounded, (theta[present] - low) / width, 0.5)
    jacobian = np.where(bounded, width * unit * (1 - unit), 1.0)
    bend = np.maximum(slope * jacobian * (1 - 2 * unit), 0) + 2 * unit * (1 - unit)
    diagonal = matrix.diagonal() * jacobian**2 + np.where(bounded, bend, 0.0)
    unknown = []
    if isinstance(matrix, np.ndarray):
        matrix = matrix * jacobian * jacobian[:, None]
        np.fill_diagonal(matrix, diagonal)
        unknown = degenerate(matrix, [problem.labels[i] for i in present])
    elif (flat := ~(diagonal > 0)).any():
        unknown = [problem.labels[i] for i in present[flat]]
    root = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    if isinstance(matrix, np.ndarray) and not unknown:
        scaled = np.linalg.cholesky(matrix * root * root[:, None])
        root = root[:, None] * np.linalg.inv(scaled).T
    center = np.where(bounded, np.log(unit / (1 - unit)), theta[present])
    numbers = (theta, present, bounded, low, high, center, root)
    return _Posterior(problem.like, problem.priors, *map(jnp.asarray, numbers)), unknown


@jax.jit
def _log_probs(posterior, values):
    def one(x):
        inside = (x >= posterior.low) & (x <= posterior.high) | ~posterior.bounded
        value = posterior.log_prob(x)
        return jnp.where(inside.all() & jnp.isfinite(value), value, -jnp.inf)

    return jax.vmap(one)(values)


@jax.jit
def _values(posterior, z):
    return jax.vmap(posterior.values)(z)[0]


@jax.jit
def _begun(posterior, z):
    return jax.vmap(lambda x: blackjax.nuts.init(x, posterior.density))(z)


@partial(jax.jit, static_argnames="steps")
def _advanced(posterior, begun, key, first, nwarmup, steps):
    """Some steps of all chains, from the number `first` on: where they end, and their course."""
    kernel = blackjax.nuts.build_kernel()
    metric = jnp.ones(posterior.center.size)
    _, tuned, _ = dual_averaging_adaptation(ACCEPTANCE)

    def step(state, number):
        chains, tuning = state
        warming = number < nwarmup
        size = jnp.exp(jnp.where(warming, tuning.log_step_size, tuning.log_step_size_avg))
        keys = jax.random.split(jax.random.fold_in(key, number), len(chains.logdensity))
        chains, info = jax.vmap(lambda k, c: kernel(k, c, posterior.density, size, metric))(
            keys, chains
        )
        new = tuned(tuning, jnp.mean(jnp.nan_to_num(info.acceptance_rate)))
        tuning = jax.tree.map(partial(jnp.where, warming), new, tuning)
        values, jacobian = jax.vmap(posterior.values)(chains.position)
        course = {
            "chain": values,
            "log_prob": chains.logdensity - jacobian,
            "acceptance": info.acceptance_rate,
            "diverged": info.is_divergent,
            "gradients": info.num_integration_steps,
            "step_size": size,
        }
        return (chains, tuning), course

    return jax.lax.scan(step, begun, first + jnp.arange(steps))


def _nuts(posterior, labels, chi2_of, *, seed, nsteps, nwarmup, nchains, progress) -> FitResult:
    z = SPREAD * np.random.default_rng(seed).normal(size=(nchains, len(labels)))
    for _ in range(30):
        chains = _begun(posterior, z)
        bad = ~np.isfinite(np.asarray(chains.logdensity))
        if not bad.any():
            break
        # Far out the laws may not be finite.
        z[bad] /= 2
    begin, _, _ = dual_averaging_adaptation(ACCEPTANCE)
    # Of one type from the first call on, so that there is one program.
    tuning = jax.tree.map(lambda x: jnp.asarray(x, float), begin(len(labels) ** -0.25))
    state, key = (chains, tuning), jax.random.key(seed)
    total = nwarmup + nsteps
    courses = []
    with tqdm(total=total, disable=not progress, delay=2, leave=False) as bar:
        for first in range(0, total, BLOCK):
            state, course = _advanced(posterior, state, key, first, nwarmup, BLOCK)
            courses.append(jax.tree.map(np.asarray, course))
            bar.update(min(BLOCK, total - first))
    course = {k: np.concatenate([c[k] for c in courses])[nwarmup:total] for k in courses[0]}
    rhat, effective = agreement(course["chain"])
    worst, least = int(np.argmax(rhat)), float(np.min(effective))
    diverged = int(course["diverged"].sum())
    message = (
        f"{nchains} chains of {nsteps} steps: R-hat {rhat[worst]:.3f} of {labels[worst]!r}, at "
        f"least {least:.0f} effective samples, {diverged} divergent steps"
    )
    failed = []
    if not rhat[worst] < AGREEMENT:
        failed.append(f"an R-hat below {AGREEMENT}")
    if not least >= EFFECTIVE * nchains:
        failed.append(f"{EFFECTIVE * nchains} effective samples")
    if diverged:
        failed.append("no divergent step")
    return summary(
        "nuts",
        labels,
        course["chain"],
        course["log_prob"],
        chi2_of,
        tau=nsteps * nchains / effective,
        discard=0,
        thin=1,
        converged=not failed,
        message=message + (f"; needed are {', '.join(failed)}." if failed else "."),
        details={
            "acceptance": float(np.mean(course["acceptance"])),
            "divergences": diverged,
            "rhat": dict(zip(labels, rhat.tolist(), strict=True)),
            "ess": dict(zip(labels, effective.tolist(), strict=True)),
            "gradients": float(np.mean(course["gradients"])),
            "step_size": float(course["step_size"][-1]),
        },
    )


def _undetermined(method: str, labels: tuple[str, ...], unknown: list[str], chi2: float):
    """The result where there is no posterior to draw from."""
    shown = ", ".join(unknown[:6]) + (f" and {len(unknown) - 6} more" if unknown[6:] else "")
    size = len(labels)
    return FitResult(
        method=method,
        free=labels,
        best_fit=dict.fromkeys(labels, np.nan),
        interval_68=dict.fromkeys(labels, (np.nan, np.nan)),
        covariance=np.full((size, size), np.nan),
        chi2=chi2,
        converged=False,
        message=f"Data and priors do not determine {shown}: there is nothing to draw from.",
        details={},
    )


def _options(sampler: str, given: dict[str, Any]) -> dict[str, Any]:
    """What the sampler is called with.

    Raises
    ------
    ValueError
        For another sampler, and what this one does not take.
    """
    if sampler not in OPTIONS:
        names = " or ".join(map(repr, OPTIONS))
        raise ValueError(f"Argument `sampler` must be {names}, not {sampler!r}.")
    known = OPTIONS[sampler]
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in known:
            raise ValueError(f"Argument `{name}` is not one of the sampler {sampler!r}.")
    options = known | given
    if sampler == "nuts" and (
        options["nsteps"] < 4 or options["nwarmup"] < 0 or options["nchains"] < 1
    ):
        shown = ", ".join(f"{name}={value}" for name, value in options.items())
        raise ValueError(f"The sampler 'nuts' needs at least 4 steps and a chain, not {shown}.")
    return options


def sample_spectra(
    like: SpectralLikelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    sampler: str = "nuts",
    nsteps: int | None = None,
    nwarmup: int | None = None,
    nchains: int | None = None,
    nwalkers: int | None = None,
    seed: int = 0,
    backend: ChainFile | None = None,
    progress: bool = True,
    throw: bool = True,
) -> FitResult:
    """Samples of the posterior of spectral parameters.

    The posterior is the spectral likelihood times the priors. Where signals are near the noise of
    a pixel, that likelihood is narrower than the scatter of its maximum, and so are its samples:
    see `SpectralFit.covariance`.

    Parameters
    ----------
    like : from `fits.separation.spectral_likelihood`
    start : start values of the best fit by name; chains and walkers start around that
    priors : priors by name, the same in each region
    sampler : "nuts", the no-U-turn sampler of blackjax, or "emcee". For a few parameters the first
        takes seconds, nearly all of them to compile, and gives ten times as many independent
        samples a second afterwards; for hundreds of regions, where the second fails, minutes. It
        cannot be resumed, the second can.
    nsteps : steps of each chain (1000) or walker (5000) that are kept
    nwarmup : "nuts": steps before that, in which the step size is tuned (300)
    nchains : "nuts": number of chains (4)
    nwalkers : "emcee": size of the ensemble (32)
    seed : of the start positions and the moves
    backend : "emcee": file of the chain, as for `fits.sample.sample`
    progress : show a progress bar
    throw : raise if the chains are too short or do not agree

    Returns
    -------
    Result of method "nuts" or "mcmc", with the most probable sample, central intervals and
    covariance of the samples. Its parameters are called as in `SpectralFit.labels`
    ("dust.beta_dust[3]"); those of regions without a pixel are left out. `details` holds "chain"
    (step, chain or walker, par), "log_prob", "tau" by name, "acceptance", "discard" and "thin" as
    for `fits.sample.sample`; of "nuts" also "divergences", their number, "rhat" and "ess", the
    number of effective samples, by name, "gradients", their mean number for a step, and
    "step_size".

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, start values outside their prior, an unknown sampler, arguments of
        the other one, and fewer than twice as many walkers as parameters.
    FitError
        If data and priors do not determine the parameters, R-hat is 1.01 or more, there are fewer
        than 100 effective samples for each chain, or a step diverged; with "emcee", if the chain
        is shorter than 50 autocorrelation times. Not if throw=False; the result is in its
        `.result`.
    """
    options = _options(
        sampler,
        {
            "nsteps": nsteps,
            "nwarmup": nwarmup,
            "nchains": nchains,
            "nwalkers": nwalkers,
            "backend": backend,
        },
    )
    priors = check_priors(priors, like.free)
    fit = fit_spectra(like, start, priors=priors, throw=False)
    problem = Problem(like, priors)
    best = np.array(like.flat(like.check(fit.best_fit)))
    posterior, unknown = _posterior(problem, best)
    labels = tuple(np.array(problem.labels)[problem.present].tolist())
    if unknown:
        method = {"nuts": "nuts", "emcee": "mcmc"}[sampler]
        return _undetermined(method, labels, unknown, fit.chi2).checked(throw)

    def chi2_of(values: dict[str, float]) -> float:
        theta = posterior.theta.at[posterior.present].set(jnp.array(list(values.values())))
        return 2 * float(value_and_gradient(like, theta)[0])

    if sampler == "nuts":
        result = _nuts(posterior, labels, chi2_of, seed=seed, progress=progress, **options)
        return result.checked(throw)
    walkers = options["nwalkers"]
    chains = ensemble(
        lambda values: np.asarray(_log_probs(posterior, values)),
        lambda rng: np.asarray(_values(posterior, rng.normal(size=(walkers, len(labels))))),
        len(labels),
        seed=seed,
        progress=progress,
        **options,
    )
    return ensemble_summary(chains, labels, chi2_of).checked(throw)
