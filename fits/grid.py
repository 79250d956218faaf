"""The posterior of one or two parameters on a grid."""

from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid

from fits.posterior import Likelihood, chi2
from fits.priors import Prior, Uniform, check_priors
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
def chi2_on_grid(like, axes):
    """chi^2 on the product of the axes, which are arrays by name of parameter.

    One vmap an axis, so that what depends on one parameter is computed along its axis only.
    """
    names = list(axes)

    def point(*values):
        return chi2(like, dict(zip(names, values, strict=True)))

    if isinstance(like, PixelLikelihood):
        # One point after the other: all at once would hold the maps once for each of them.
        mesh = jnp.meshgrid(*axes.values(), indexing="ij")
        flat = jax.lax.map(lambda values: point(*values), tuple(axis.ravel() for axis in mesh))
        return flat.reshape(mesh[0].shape)
    mapped = point
    for i in reversed(range(len(names))):
        mapped = jax.vmap(mapped, in_axes=tuple(0 if j == i else None for j in range(len(names))))
    return mapped(*axes.values())


def _weights(axis: np.ndarray) -> np.ndarray:
    """Trapezoid weights of an even axis."""
    weights = np.full(len(axis), axis[1] - axis[0])
    weights[[0, -1]] /= 2
    return weights


def _along(values: np.ndarray, i: int) -> Float[np.ndarray, "point _"]:
    """Values on the grid, a row for each point of axis i."""
    return np.moveaxis(values, i, 0).reshape(values.shape[i], -1)


def grid_is_possible(free: Iterable[str], priors: Mapping[str, Prior]) -> bool:
    """True for one or two parameters that each have a uniform prior."""
    names = list(free)
    return len(names) <= 2 and all(isinstance(priors.get(name), Uniform) for name in names)


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
    ranges = {}
    for name in free:
        if not isinstance(prior := priors.get(name), Uniform):
            raise ValueError(f"A grid needs a uniform prior for {name!r}, to know its range.")
        ranges[name] = (prior.low, prior.high)
    limits = ranges
    for _ in range(6):
        axes = {name: np.linspace(low, high, points) for name, (low, high) in ranges.items()}
        chi2s = np.asarray(chi2_on_grid(like, axes))
        narrowed, shrunk = {}, []
        for i, (name, axis) in enumerate(axes.items()):
            # To where the posterior matters, and one step wider on either side.
            inside = np.flatnonzero(_along(chi2s, i).min(axis=1) - chi2s.min() < NARROW)
            low, high = axis[max(inside[0] - 1, 0)], axis[min(inside[-1] + 1, points - 1)]
            narrowed[name] = (float(low), float(high))
            shrunk.append((high - low) / (axis[-1] - axis[0]))
        if min(shrunk) > 0.8:
            break
        ranges = narrowed
    result = _summary(axes, chi2s, limits, like.dof(len(free)))
    return result.judged(result.chi2, result.dof, like.start)


def _summary(
    axes: dict[str, np.ndarray],
    chi2s: np.ndarray,
    limits: dict[str, tuple[float, float]],
    dof: int,
) -> FitResult:
    """What chi^2 on a grid says of the parameters, whose priors have these limits."""
    free, log_posterior = tuple(axes), (chi2s.min() - chi2s) / 2
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
    best = int(np.argmin(chi2s))
    best_fit = dict(zip(free, mesh[:, best].tolist(), strict=True))
    covariance = np.atleast_2d(np.cov(mesh, aweights=weights.ravel(), ddof=0))
    edges = [name for name, value in best_fit.items() if value in limits[name]]
    message = "integrated"
    if edges:
        message = f"The highest point lies at the edge of the uniform prior of {', '.join(edges)}."
    if flat := log_posterior.min() > -FLAT:
        message = f"The posterior is flat: the data do not constrain {', '.join(free)}."
    return FitResult(
        method="grid",
        best_fit=best_fit,
        sigma=dict(zip(free, np.sqrt(np.diagonal(covariance)).tolist(), strict=True)),
        interval_68=intervals,
        labels=free,
        covariance=covariance,
        chi2=float(chi2s.ravel()[best]),
        dof=dof,
        converged=not edges and not flat,
        message=message,
        details={"axes": axes, "log_posterior": log_posterior, "marginals": marginals},
    )
