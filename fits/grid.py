"""The posterior of one or two parameters on a grid: the paper's test."""

from collections.abc import Mapping
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid

from fits.optimize import best_fit
from fits.posterior import Likelihood, Prior, Uniform, check_priors, chi2
from fits.results import Convergence, FitResult
from fits.template_likelihood import PixelLikelihood
from jaxsky.checks import Numeric

#: The points of each axis, and their range, by name.
Axes: TypeAlias = dict[str, np.ndarray]
Ranges: TypeAlias = dict[str, tuple[float, float]]
#: The grid is narrowed to where the posterior exceeds exp(-NARROW/2) of its maximum (6 sigma).
NARROW = 36.0
#: A posterior whose logarithm changes by less than this over the whole prior is flat.
FLAT = 1e-6
#: Probability of one standard deviation to either side.
ONE_SIGMA = 0.6826894921370859
#: Largest change of chi^2 from the highest point of a grid to the next one that resolves the peak.
COARSE = 4.0


@jax.jit
def chi2_on_grid(like, axes):
    """Return chi^2 on the product of the axes, which are arrays by parameter name."""

    def point(params):
        return chi2(like, params)

    if isinstance(like, PixelLikelihood):
        # One point after the other: all at once would need the memory of as many sets of maps.
        mesh = jnp.meshgrid(*axes.values(), indexing="ij")
        flat = jax.lax.map(point, {n: x.ravel() for n, x in zip(axes, mesh, strict=True)})
        return flat.reshape(mesh[0].shape)
    # One vmap per axis, so that what depends on one parameter is computed only along its axis.
    for name in reversed(axes):
        point = jax.vmap(point, in_axes=({n: 0 if n == name else None for n in axes},))
    return point(axes)


def _weights(axis: np.ndarray) -> np.ndarray:
    """Return trapezoid weights of an even axis."""
    weights = np.full(len(axis), axis[1] - axis[0])
    weights[[0, -1]] /= 2
    return weights


def _along(values: np.ndarray, i: int) -> Float[np.ndarray, "point _"]:
    """Return values on the grid, one row per point of axis i."""
    return np.moveaxis(values, i, 0).reshape(values.shape[i], -1)


def _highest(axes: Axes, chi2s: np.ndarray) -> dict[str, float]:
    """Return the point of the grid with the largest posterior."""
    lowest = np.unravel_index(np.argmin(chi2s), chi2s.shape)
    return {name: float(axis[i]) for (name, axis), i in zip(axes.items(), lowest, strict=True)}


def _narrowed(like: Likelihood, ranges: Ranges, points: int) -> tuple[Axes, np.ndarray]:
    """Return axes narrowed to where the posterior is not negligible, and chi^2 on their grid."""
    for _ in range(6):
        axes = {name: np.linspace(low, high, points) for name, (low, high) in ranges.items()}
        chi2s = np.asarray(chi2_on_grid(like, axes))
        narrowed, shrunk = {}, []
        for i, (name, axis) in enumerate(axes.items()):
            # Where the posterior matters, and one step further on either side.
            inside = np.flatnonzero(_along(chi2s, i).min(axis=1) - chi2s.min() < NARROW)
            low, high = axis[max(inside[0] - 1, 0)], axis[min(inside[-1] + 1, points - 1)]
            narrowed[name] = (float(low), float(high))
            shrunk.append((high - low) / (axis[-1] - axis[0]))
        if min(shrunk) > 0.8:
            break
        ranges = narrowed
    return axes, chi2s


def _is_settled(axes: Axes, chi2s: np.ndarray, limits: Ranges) -> bool:
    """Whether the grid contains all of the posterior, and is fine enough for its peak."""
    lowest = np.unravel_index(np.argmin(chi2s), chi2s.shape)
    for i, (name, axis) in enumerate(axes.items()):
        profile = _along(chi2s, i).min(axis=1) - chi2s.min()
        if any(profile[e] < NARROW and axis[e] not in limits[name] for e in (0, -1)):
            return False
        line = chi2s[tuple(slice(None) if j == i else at for j, at in enumerate(lowest))]
        if np.ptp(line[max(lowest[i] - 1, 0) : lowest[i] + 2]) > COARSE:
            return False
    return True


def grid_fit(
    like: Likelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior],
    points: int = 200,
) -> FitResult:
    """Compute the posterior on a grid over the ranges of uniform priors: the paper's test.

    The grid first spans the priors, and is then narrowed, with the same number of points, to where
    the posterior is not negligible, until its ranges hardly change. Where it loses the peak of a
    narrow posterior on the way, it starts again around the gradient fit.

    Parameters
    ----------
    like, start : as for `best_fit`, with one or two free parameters; start values do not matter
    priors : a uniform prior for each of them
    points : points per axis

    Returns
    -------
    Result with the values at the highest point, intervals and covariance by integration over the
    grid. `details` has "axes" by name, "log_posterior" relative to its maximum, with axes in the
    order of `free`, and "marginals" by name.

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, more than two of them, one without a uniform prior, or less than
        three points.
    """
    like = like.at(start)
    free = like.free
    priors = check_priors(priors, free)
    if points < 3:
        raise ValueError(f"Argument `points` must be at least 3, not {points}.")
    if len(free) > 2:
        raise ValueError(
            f"A grid takes one or two free parameters, not {len(free)} ({', '.join(free)}); "
            "use the gradient fit or MCMC."
        )
    limits: Ranges = {}
    for name in free:
        if (size := like.start[name].size) > 1:
            raise ValueError(
                f"A grid takes parameters with one value, but {name!r} has {size}, one for "
                "each region; use the gradient fit or MCMC."
            )
        if not isinstance(prior := priors.get(name), Uniform):
            raise ValueError(f"A grid needs a uniform prior for {name!r}, to know its range.")
        limits[name] = (prior.low, prior.high)
    axes, chi2s = _narrowed(like, limits, points)
    settled = _is_settled(axes, chi2s, limits)
    if not settled:
        # A ridge much narrower than the first grid is lost between its points.
        found = best_fit(like, _highest(axes, chi2s), priors=priors, throw=False)
        if np.isfinite(list(found.sigma.values())).all():
            around: Ranges = {}
            for name, (low, high) in limits.items():
                value, reach = found.best_fit[name], 7 * found.sigma[name]
                around[name] = (max(low, value - reach), min(high, value + reach))
            axes, chi2s = _narrowed(like, around, points)
            settled = _is_settled(axes, chi2s, limits)
    log_posterior = (chi2s.min() - chi2s) / 2
    weights = np.exp(log_posterior)
    for axis_weights in np.meshgrid(*map(_weights, axes.values()), indexing="ij"):
        weights = weights * axis_weights
    weights = weights / weights.sum()
    marginals, intervals = {}, {}
    for i, (name, axis) in enumerate(axes.items()):
        marginals[name] = _along(weights, i).sum(axis=1) / _weights(axis)
        cumulative = cumulative_trapezoid(marginals[name], axis, initial=0.0)
        levels = np.array([1 - ONE_SIGMA, 1 + ONE_SIGMA]) / 2
        low, high = np.interp(levels, cumulative / cumulative[-1], axis).tolist()
        intervals[name] = (low, high)
    mesh = np.stack([m.ravel() for m in np.meshgrid(*axes.values(), indexing="ij")])
    covariance = np.atleast_2d(np.cov(mesh, aweights=weights.ravel(), ddof=0))
    values = _highest(axes, chi2s)
    edges = [name for name, value in values.items() if value in limits[name]]
    converged, message = Convergence.converged, "integrated"
    if log_posterior.min() > -FLAT:
        converged = Convergence.undetermined
        message = f"The posterior is flat: the data do not constrain {', '.join(free)}."
    elif edges:
        converged = Convergence.at_edge
        message = f"The highest point lies at the edge of the uniform prior of {', '.join(edges)}."
    elif not settled:
        converged = Convergence.unresolved
        message = f"{points} points per axis are too few for the posterior, or miss part of it."
    result = FitResult(
        method="grid",
        best_fit=values,
        sigma=dict(zip(free, np.sqrt(np.diagonal(covariance)).tolist(), strict=True)),
        interval_68=intervals,
        labels=free,
        covariance=covariance,
        chi2=float(chi2s.min()),
        dof=like.dof(len(free)),
        converged=converged,
        message=message,
        details={"axes": axes, "log_posterior": log_posterior, "marginals": marginals},
    )
    return result.judged(result.chi2, result.dof, like.start)
