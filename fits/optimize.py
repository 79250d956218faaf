"""Fits by gradient: least squares with optimistix, covariance from the Hessian."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

from fits.priors import (
    Prior,
    at_edge,
    bounds,
    check_priors,
    from_unbounded,
    log_prior,
    prior_residuals,
    to_unbounded,
)
from fits.results import FitResult, help_by_prior
from fits.template_likelihood import Likelihood, chi2
from jaxsky.checks import Numeric

#: What finds an optimum: by residuals, or by a function alone.
Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser
#: Steps of a search, by default.
MAX_STEPS = 500
#: A search has reached an optimum this close to it, in standard deviations.
REACHED = 0.01


def _unscaled(unbounded, priors, scale):
    return from_unbounded({name: v * scale[name] for name, v in unbounded.items()}, priors)


def _scaled(unbounded, everything):
    function, args, priors, scale = everything
    return function(_unscaled(unbounded, priors, scale), args)


def search(
    function: Callable[[dict[str, Any], Any], Any],
    args: Any,
    start: Mapping[str, Numeric],
    *,
    priors: Mapping[str, Prior],
    scale: Mapping[str, Numeric],
    solver: Solver,
    max_steps: int = MAX_STEPS,
    run: Callable[..., optx.Solution] = optx.least_squares,
) -> tuple[dict[str, Any], optx.Solution]:
    """The values that a solver of optimistix finds, within uniform priors.

    Parameters
    ----------
    function : of values by name and `args`: residuals, whose sum of squares is to be small
    args : data of the function
    start : start values by name, numbers or arrays
    priors : by name; uniform ones are bounds, others are left to the function
    scale : by name, size of the unbounded numbers (see `fits.priors.to_unbounded`): the solver
        sees them divided by it, so that its tolerances and first steps do not depend on units
    solver, max_steps : of optimistix
    run : `optx.minimise` if the function is itself the number that is to be small
    """
    unbounded = to_unbounded(start, priors)
    scaled = {name: value / scale[name] for name, value in unbounded.items()}

    def solve(scaled):
        everything = (function, args, priors, dict(scale))
        solution = run(_scaled, solver, scaled, args=everything, max_steps=max_steps, throw=False)
        return solution, _unscaled(solution.value, priors, scale)

    solution, found = solve(scaled)
    edges = {name: at_edge(value, *bounds(name, priors)) for name, value in found.items()}
    if any(edge.any() for edge in edges.values()):
        # The range is flat at its edge, so a step that reached it too early has stuck there.
        solution, found = solve(
            {name: jnp.where(edges[name], 0.0, value) for name, value in solution.value.items()}
        )
    return found, solution


def _residuals(params, args):
    like, priors = args
    return jnp.concatenate([like.residuals(params), prior_residuals(params, priors)])


@jax.jit
def _derivatives(like, params, priors):
    """Gradient and Hessian of -log posterior."""
    flat, unravel = ravel_pytree(params)

    def objective(theta):
        named = unravel(theta)
        return chi2(like, named) / 2 - log_prior(named, priors)

    def gradient(theta):
        first = jax.grad(objective)(theta)
        return first, first

    hessian, first = jax.jacfwd(gradient, has_aux=True)(flat)
    return first, hessian


def best_fit(
    like: Likelihood,
    start: Mapping[str, Numeric],
    *,
    priors: Mapping[str, Prior] | None = None,
    solver: Solver | None = None,
    throw: bool = True,
) -> FitResult:
    """The most probable parameters, by gradient.

    Parameters
    ----------
    like : from `fits.template_likelihood`
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
        If it did not converge, unless throw=False; the result is in its `.result`. It has not
        where the solver failed or stopped away from an optimum, its start included, where the
        data do not constrain a parameter, and where chi^2 is that of no fit (`fits.results`).
    """
    params = like.check(start)
    priors = check_priors(priors, params)
    solver = solver or optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    free = tuple(sorted(params))
    # Parameters of any size become numbers of order one.
    sizes = to_unbounded(params, priors)
    found, solution = search(
        _residuals,
        (like, priors),
        params,
        priors=priors,
        scale={name: np.maximum(np.abs(value), 1e-3) for name, value in sizes.items()},
        solver=solver,
    )
    values = {name: float(found[name]) for name in free}

    gradient, hessian = map(np.asarray, _derivatives(like, found, priors))
    positive = bool(np.isfinite(hessian).all()) and np.linalg.eigvalsh(hessian)[0] > 0
    covariance = np.linalg.inv(hessian) if positive else np.full(hessian.shape, np.nan)
    sigma = dict(zip(free, np.sqrt(np.diagonal(covariance)), strict=True))
    distance = float(np.sqrt(gradient @ covariance @ gradient))
    converged, message = False, "converged"
    if solution.result != optx.RESULTS.successful:
        message = f"The solver stopped: {solution.result}."
    elif not positive:
        message = (
            "The Hessian at the optimum is not positive definite: the data do not constrain "
            f"{', '.join(free)}; {help_by_prior(free)}."
        )
    elif not distance < REACHED * np.sqrt(len(free)):
        still = all(values[name] == float(params[name]) for name in free)
        message = (
            f"The search {'did not leave its start' if still else 'stopped'}, {distance:.2g} "
            "sigma from the optimum."
        )
    else:
        converged = True
    for name, value in values.items():
        low, high = bounds(name, priors)
        if at_edge(value, low, high):
            converged = False
            edge = low if value - low < high - value else high
            message = f"The best fit of {name!r} lies at the edge {edge:g} of its uniform prior."
    result = FitResult(
        method="gradient",
        free=free,
        best_fit=values,
        interval_68={n: (values[n] - float(sigma[n]), values[n] + float(sigma[n])) for n in free},
        covariance=covariance,
        chi2=float(chi2(like, found)),
        converged=converged,
        message=message,
        details={"steps": int(solution.stats["num_steps"])},
    )
    return result.judged(result.chi2, like.dof(len(free)), params).checked(throw)
