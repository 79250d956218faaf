"""The posterior of one or two parameters on a grid."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fits.posterior import Likelihood, chi2
from fits.priors import Prior, bounds, check_priors, log_prior
from fits.results import FitResult
from fits.template_likelihood import PixelLikelihood
from jaxsky.checks import Numeric

#: The grid is narrowed to where the posterior exceeds exp(-NARROW/2) of its maximum (6 sigma).
NARROW = 36.0
#: A posterior that changes by less over the whole prior, in its logarithm, is flat.
FLAT = 1e-6
#: Probability of one standard deviation to either side.
ONE_SIGMA = 0.6826894921370859


@jax.jit
def _log_posterior(like, axes, priors):
    """-(chi^2)/2 + log prior on the product of the axes, and chi^2.

    One vmap an axis, so that what depends on one parameter is computed along its axis only.
    """
    names = list(axes)

    def point(*values):
        params = dict(zip(names, values, strict=True))
        value = chi2(like, params)
        return -value / 2 + log_prior(params, priors), value

    if isinstance(like, PixelLikelihood):
        # One point after the other: all at once would hold the maps once for each of them.
        mesh = [axis.ravel() for axis in jnp.meshgrid(*axes.values(), indexing="ij")]
        shape = tuple(axis.size for axis in axes.values())
        flat = jax.lax.map(lambda values: point(*values), tuple(mesh))
        return jax.tree.map(lambda x: x.reshape(shape), flat)
    mapped = point
    for i in reversed(range(len(names))):
        mapped = jax.vmap(mapped, in_axes=tuple(0 if j == i else None for j in range(len(names))))
    return mapped(*axes.values())


def _weights(axis: np.ndarray) -> np.ndarray:
    """Trapezoid weights of an even axis."""
    weights = np.full(len(axis), axis[1] - axis[0])
    weights[[0, -1]] /= 2
    return weights


def _marginal(density: np.ndarray, axes: list[np.ndarray], i: int) -> np.ndarray:
    for j in reversed(range(len(axes))):
        if j != i:
            density = np.tensordot(density, _weights(axes[j]), axes=(j, 0))
    return density / np.sum(density * _weights(axes[i]))


def _quantiles(axis: np.ndarray, density: np.ndarray, levels: list[float]) -> list[float]:
    steps = np.diff(axis) * (density[1:] + density[:-1]) / 2
    cumulative = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return [float(q) for q in np.interp(levels, cumulative, axis)]


def _narrow(axis: np.ndarray, profile: np.ndarray) -> tuple[float, float]:
    """Range of an axis in which the profile matters, one step wider on either side."""
    inside = np.flatnonzero(profile > -NARROW / 2)
    return float(axis[max(inside[0] - 1, 0)]), float(axis[min(inside[-1] + 1, len(axis) - 1)])


def grid_is_possible(free: Iterable[str], priors: Mapping[str, Prior]) -> bool:
    """True for one or two parameters that each have a uniform prior."""
    names = list(free)
    return len(names) <= 2 and all(np.isfinite(bounds(name, priors)).all() for name in names)


def grid_fit(
    like: Likelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior],
    points: int = 200,
) -> FitResult:
    """The posterior on a grid over the ranges of the uniform priors: the paper's test.

    The grid first spans the priors, then is narrowed, again with all its points, to where the
    posterior is not negligible, until that no longer changes it much.

    Parameters
    ----------
    like : from `fits.likelihood` or `fits.spectral_likelihood`
    start : the free parameters by name (the values do not matter), one or two; by default those
        of the likelihood
    priors : a uniform prior for each of them
    points : points an axis

    Returns
    -------
    Result with the values at the highest point, intervals and covariance by integration over
    the grid. `details` holds "axes" by name, "log_posterior" relative to its maximum, with
    axes in the order of `free`, and "marginals" by name.

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, more than two of them, or one without a uniform prior.
    """
    like = like.at(start)
    free = like.free
    priors = check_priors(priors, free)
    for name, value in like.start.items():
        if value.size > 1:
            raise ValueError(
                f"A grid takes parameters with one value, but {name!r} has {value.size}, one for "
                "each region; use the gradient fit or MCMC."
            )
    if len(free) > 2:
        raise ValueError(
            f"A grid takes one or two free parameters, not {len(free)} ({', '.join(free)}); "
            "use the gradient fit or MCMC."
        )
    ranges = {name: bounds(name, priors) for name in free}
    for name, (low, high) in ranges.items():
        if not np.isfinite([low, high]).all():
            raise ValueError(f"A grid needs a uniform prior for {name!r}, to know its range.")
    limits = dict(ranges)
    for _ in range(6):
        axes = {name: np.linspace(low, high, points) for name, (low, high) in ranges.items()}
        log_posterior, chi2s = (np.asarray(a) for a in _log_posterior(like, axes, priors))
        log_posterior = log_posterior - log_posterior.max()
        values = list(axes.values())
        narrowed = {}
        for i, name in enumerate(free):
            others = tuple(j for j in range(len(free)) if j != i)
            narrowed[name] = _narrow(values[i], log_posterior.max(axis=others))
        shrunk = [(narrowed[n][1] - narrowed[n][0]) / (ranges[n][1] - ranges[n][0]) for n in free]
        if min(shrunk) > 0.8:
            break
        ranges = narrowed
    result = _summary(free, axes, log_posterior, chi2s, limits, like.dof(len(free)))
    return result.judged(result.chi2, result.dof, like.start)


def _summary(
    free: tuple[str, ...],
    axes: dict[str, np.ndarray],
    log_posterior: np.ndarray,
    chi2s: np.ndarray,
    limits: dict[str, tuple[float, float]],
    dof: int,
) -> FitResult:
    values = list(axes.values())
    density = np.exp(log_posterior)
    marginals = {name: _marginal(density, values, i) for i, name in enumerate(free)}
    tail = (1 - ONE_SIGMA) / 2
    intervals = {}
    for name, axis in axes.items():
        low, high = _quantiles(axis, marginals[name], [tail, 1 - tail])
        intervals[name] = (low, high)
    mesh = np.stack([m.ravel() for m in np.meshgrid(*values, indexing="ij")])
    best = int(np.argmax(log_posterior))
    weights = density.ravel()
    for axis_weights in np.meshgrid(*[_weights(a) for a in values], indexing="ij"):
        weights = weights * axis_weights.ravel()
    details: dict[str, Any] = {
        "axes": axes,
        "log_posterior": log_posterior,
        "marginals": marginals,
    }
    values_at_best = {name: float(mesh[i, best]) for i, name in enumerate(free)}
    flat = log_posterior.min() > -FLAT
    edges = [name for name, value in values_at_best.items() if value in limits[name]]
    covariance = np.atleast_2d(np.cov(mesh, aweights=weights / weights.sum(), ddof=0))
    return FitResult(
        method="grid",
        best_fit=values_at_best,
        sigma=dict(zip(free, np.sqrt(np.diagonal(covariance)).tolist(), strict=True)),
        interval_68=intervals,
        labels=free,
        covariance=covariance,
        chi2=float(chi2s.ravel()[best]),
        dof=dof,
        converged=not edges and not flat,
        message=(
            f"The posterior is flat: the data do not constrain {', '.join(free)}."
            if flat
            else f"The highest point lies at the edge of the uniform prior of {', '.join(edges)}."
            if edges
            else "integrated"
        ),
        details=details,
    )
