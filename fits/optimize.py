"""Fits by gradient: least squares with optimistix, covariance from the Hessian."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

from fits.likelihood import Likelihood, chi2
from fits.priors import (
    Prior,
    bounds,
    check_priors,
    from_unbounded,
    log_prior,
    prior_residuals,
    to_unbounded,
)
from fits.results import FitResult
from jaxsky.types import Numeric

__all__ = ["best_fit"]

#: An optimum this close to the edge of a uniform prior, in units of its width, is at the edge.
EDGE = 1e-4


def _residuals(unbounded, args):
    like, priors, scale = args
    params = from_unbounded({k: v * scale[k] for k, v in unbounded.items()}, priors)
    return jnp.concatenate([like.residuals(params), prior_residuals(params, priors)])


@jax.jit
def _half_hessian(like, params, priors):
    flat, unravel = ravel_pytree(params)

    def objective(theta):
        named = unravel(theta)
        return chi2(like, named) / 2 - log_prior(named, priors)

    return jax.hessian(objective)(flat)


def best_fit(
    like: Likelihood,
    start: Mapping[str, Numeric],
    *,
    priors: Mapping[str, Prior] | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    throw: bool = True,
) -> FitResult:
    """The most probable parameters, by gradient.

    Parameters
    ----------
    like : from `fits.likelihood`
    start : start values of the free parameters by name
    priors : priors by name; uniform ones bound the search
    solver : of optimistix, default `LevenbergMarquardt`
    throw : raise if the solver fails, or the optimum lies at the edge of a uniform prior

    Returns
    -------
    Result whose covariance is the inverse of the Hessian of -log posterior at the optimum, and
    whose intervals are one standard deviation to either side.

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, or start values outside their prior.
    FitError
        If it did not converge, unless throw=False; the result is in its `.result`.
    """
    params = like.check(start)
    priors = check_priors(priors, params)
    solver = solver or optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    free = tuple(sorted(params))
    unbounded = to_unbounded(params, priors)
    # Parameters of any size become numbers of order one, so that the solver's tolerances and
    # first steps do not depend on units.
    scale = {name: jnp.maximum(jnp.abs(value), 1e-3) for name, value in unbounded.items()}
    scaled = {name: value / scale[name] for name, value in unbounded.items()}

    def solve(start):
        args = (like, priors, scale)
        solution: optx.Solution = optx.least_squares(
            _residuals, solver, start, args=args, max_steps=500, throw=False
        )
        found = from_unbounded({k: v * scale[k] for k, v in solution.value.items()}, priors)
        return solution, found, {name: float(found[name]) for name in free}

    solution, found, values = solve(scaled)
    if edges := _at_edge(values, priors):
        # The range is flat at its edge, so a step that reached it too early has stuck there.
        middle = solution.value | {name: jnp.zeros(()) for name in edges}
        solution, found, values = solve(middle)

    hessian = np.asarray(_half_hessian(like, found, priors))
    positive = bool(np.isfinite(hessian).all()) and np.linalg.eigvalsh(hessian)[0] > 0
    covariance = np.linalg.inv(hessian) if positive else np.full(hessian.shape, np.nan)
    sigma = dict(zip(free, np.sqrt(np.diagonal(covariance)), strict=True))
    converged = solution.result == optx.RESULTS.successful
    message = "converged" if converged else f"The solver stopped: {solution.result}."
    if converged and not positive:
        converged = False
        message = (
            "The Hessian at the optimum is not positive definite: the data do not constrain "
            + (", ".join(free) + ".")
        )
    for name, edge in _at_edge(values, priors).items():
        converged = False
        message = f"The best fit of {name!r} lies at the edge {edge:g} of its uniform prior."
    return FitResult(
        method="gradient",
        free=free,
        best_fit=values,
        interval_68={n: (values[n] - float(sigma[n]), values[n] + float(sigma[n])) for n in free},
        covariance=covariance,
        chi2=float(chi2(like, found)),
        converged=bool(converged),
        message=message,
        details={"steps": int(solution.stats["num_steps"])},
    ).checked(throw)


def _at_edge(values: Mapping[str, float], priors: Mapping[str, Prior]) -> dict[str, float]:
    edges = {}
    for name, value in values.items():
        low, high = bounds(name, priors)
        for edge in (low, high):
            if abs(value - edge) < EDGE * (high - low) < np.inf:
                edges[name] = edge
    return edges
