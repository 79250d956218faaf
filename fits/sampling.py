"""Posterior samples with emcee: vectorised, stored in HDF5, resumable."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import emcee
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fits.chains import ChainFile
from fits.optimize import best_fit
from fits.priors import Prior, bounds, check_priors, log_prior
from fits.results import FitResult
from fits.template_likelihood import Likelihood, chi2
from jaxsky.checks import Numeric, check_seed

#: A chain shorter than this many autocorrelation times is reported as too short.
ENOUGH = 50


@partial(jax.jit, static_argnames=("structure", "free"))
def _log_probs(theta, leaves, structure, free):
    like, priors = jax.tree.unflatten(structure, leaves)

    def one(values):
        params = dict(zip(free, values, strict=True))
        prior = log_prior(params, priors)
        # Outside the prior the model may not even be finite.
        value = -chi2(like, params) / 2 + prior
        return jnp.where(jnp.isfinite(prior) & jnp.isfinite(value), value, -jnp.inf)

    return jax.vmap(one)(theta)


def _walkers(result: FitResult, priors: Mapping[str, Prior], nwalkers: int, rng) -> np.ndarray:
    """Start positions drawn around the best fit, inside the uniform priors."""
    center = np.array([result.best_fit[name] for name in result.free])
    limits = np.array([bounds(name, priors) for name in result.free])
    covariance = np.asarray(result.covariance)
    if not np.isfinite(covariance).all():
        width = np.where(np.isfinite(limits).all(axis=1), np.ptp(limits, axis=1) / 10, 1e-2)
        covariance = np.diag(width**2)
    theta = rng.multivariate_normal(center, covariance, size=nwalkers)
    for _ in range(100):
        outside = ((theta <= limits[:, 0]) | (theta >= limits[:, 1])).any(axis=1)
        if not outside.any():
            return theta
        theta[outside] = rng.multivariate_normal(center, covariance, size=outside.sum())
    # A narrow corner of the prior: spread evenly there instead.
    low = np.where(np.isfinite(limits[:, 0]), limits[:, 0], center - 1)
    high = np.where(np.isfinite(limits[:, 1]), limits[:, 1], center + 1)
    theta[outside] = rng.uniform(low, high, size=(outside.sum(), len(center)))
    return theta


def ensemble(
    log_probs: Callable[[np.ndarray], np.ndarray],
    initial: Callable[[np.random.Generator], np.ndarray],
    size: int,
    *,
    nwalkers: int,
    nsteps: int,
    seed: int,
    backend: ChainFile | None = None,
    progress: bool | Callable[[int, int], None] = True,
) -> emcee.EnsembleSampler:
    """Steps of emcee's ensemble; those that a file already holds are not made again.

    Parameters
    ----------
    log_probs : log posterior of positions (walker, par)
    initial : start positions (walker, par) from a generator of random numbers
    size : number of parameters
    nwalkers, nsteps, seed, backend, progress : see `sample`
    """
    check_seed("seed", seed)
    if nwalkers < 2 * size or nsteps < 1:
        raise ValueError(
            f"MCMC needs at least {2 * size} walkers and a step for {size} parameters, "
            f"not nwalkers={nwalkers}, nsteps={nsteps}."
        )
    rng = np.random.default_rng(seed)
    sampler = emcee.EnsembleSampler(nwalkers, size, log_probs, vectorize=True, backend=backend)
    # emcee's own wrapper prints a traceback when it is interrupted.
    sampler.log_prob_fn = sampler.log_prob_fn.f
    done = sampler.iteration
    state = None
    if not done:
        state = emcee.State(
            initial(rng),
            random_state=np.random.RandomState(rng.integers(2**32)).get_state(),
        )
    try:
        steps = sampler.sample(
            sampler.get_last_sample() if state is None else state,
            iterations=max(0, nsteps - done),
            progress=progress is True,
            progress_kwargs={"leave": False},
        )
        for i, _ in enumerate(steps, done + 1):
            if callable(progress):
                progress(i, nsteps)
    finally:
        if backend is not None:
            backend.flush()
    return sampler


def sample(
    like: Likelihood,
    start: Mapping[str, Numeric],
    *,
    priors: Mapping[str, Prior] | None = None,
    nwalkers: int = 32,
    nsteps: int = 5000,
    seed: int = 0,
    backend: ChainFile | None = None,
    progress: bool | Callable[[int, int], None] = True,
    throw: bool = True,
) -> FitResult:
    """Samples of the posterior by emcee's affine-invariant ensemble.

    Parameters
    ----------
    like : from `fits.template_likelihood`
    start : start values of the free parameters by name; the walkers start around the best fit
    priors : priors by name
    nwalkers, nsteps : size of the ensemble, and its steps in all
    seed : of the start positions and the proposals
    backend : file of the chain; one that already holds steps is gone on with up to `nsteps`,
        with the very steps an uninterrupted run would have made
    progress : show a progress bar, or call a function with the steps done and those in all
    throw : raise if the chain is shorter than 50 autocorrelation times

    Returns
    -------
    Result with the most probable sample, central intervals and covariance of the samples after
    two autocorrelation times. `details` holds "chain" (step, walker, par), "log_prob", "tau"
    by name, "acceptance", "discard" and "thin".

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, start values outside their prior, or fewer than twice as many
        walkers as parameters.
    FitError
        If the chain is too short, chi^2 is that of no fit, or the data do not constrain a
        parameter (`fits.results`), unless throw=False; the result is in its `.result`.
    """
    check_seed("seed", seed)
    params = like.check(start)
    free = tuple(sorted(params))
    priors = check_priors(priors, free)
    # Taken apart once rather than at each step, where it takes a third of the time.
    leaves, structure = jax.tree.flatten((like, priors))

    def log_probs(theta: np.ndarray) -> np.ndarray:
        # At the start, too, in the halves that emcee moves: one program instead of two.
        parts = np.split(theta, 2) if len(theta) == nwalkers and nwalkers % 2 == 0 else [theta]
        return np.concatenate([_log_probs(part, leaves, structure, free) for part in parts])

    sampler = ensemble(
        log_probs,
        lambda rng: _walkers(
            best_fit(like, start, priors=priors, throw=False), priors, nwalkers, rng
        ),
        len(free),
        nwalkers=nwalkers,
        nsteps=nsteps,
        seed=seed,
        backend=backend,
        progress=progress,
    )
    result = ensemble_summary(sampler, free, lambda values: float(chi2(like, values)))
    return result.judged(result.chi2, like.dof(len(free)), params).checked(throw)


def ensemble_summary(
    sampler: emcee.EnsembleSampler,
    free: tuple[str, ...],
    chi2_of: Callable[[dict[str, float]], float],
) -> FitResult:
    """The result of an ensemble, which has to be 50 autocorrelation times long.

    Parameters
    ----------
    sampler : after its steps
    free : names of the parameters
    chi2_of : chi^2 of parameters by name
    """
    chain = sampler.get_chain()
    tau = emcee.autocorr.integrated_time(chain, tol=0)
    worst = float(np.nanmax(tau)) if np.isfinite(tau).any() else float(len(chain))
    enough = len(chain) >= ENOUGH * worst
    message = f"{len(chain)} steps are {len(chain) / worst:.0f} autocorrelation times ({worst:.0f})"
    return summary(
        "mcmc",
        free,
        chain,
        sampler.get_log_prob(),
        chi2_of,
        tau=tau,
        discard=min(int(np.ceil(2 * worst)), len(chain) // 2),
        converged=enough,
        message=message + ("" if enough else f", of which at least {ENOUGH} are needed") + ".",
        thin=max(1, int(worst / 2)),
        details={"acceptance": float(np.mean(sampler.acceptance_fraction))},
    )


def summary(
    method: str,
    free: tuple[str, ...],
    chain: Float[np.ndarray, "step walker par"],
    log_prob: Float[np.ndarray, "step walker"],
    chi2_of: Callable[[dict[str, float]], float],
    *,
    tau: Float[np.ndarray, " par"],
    discard: int,
    thin: int,
    converged: bool,
    message: str,
    details: dict[str, Any],
) -> FitResult:
    """The result of a chain.

    Parameters
    ----------
    method, free, converged, message : see `FitResult`
    chain, log_prob : all steps
    chi2_of : chi^2 of parameters by name
    tau : autocorrelation time of each parameter
    discard, thin : steps at the beginning that are not used, and of which one is enough
    details : what not all chains have
    """
    flat = chain[discard:].reshape(-1, len(free))
    best = np.unravel_index(np.argmax(log_prob), log_prob.shape)
    values = {name: float(v) for name, v in zip(free, chain[best], strict=True)}
    low, high = np.percentile(flat, [15.865525, 84.134475], axis=0)
    return FitResult(
        method=method,
        free=free,
        best_fit=values,
        interval_68={n: (float(low[i]), float(high[i])) for i, n in enumerate(free)},
        covariance=np.atleast_2d(np.cov(flat.T)),
        chi2=chi2_of(values),
        converged=converged,
        message=message,
        details={
            "chain": chain,
            "log_prob": log_prob,
            "tau": {name: float(t) for name, t in zip(free, tau, strict=True)},
            "discard": discard,
            "thin": thin,
        }
        | details,
    )
