"""The most probable spectral parameters: Newton's method, or a solver of optimistix.

Newton's method is the default because its program is that which the checks and the covariance need
in any case: a first fit, nearly all of it compilation, takes half the time of one with a solver of
optimistix, and later ones the same few milliseconds. With hundreds of regions its second
derivatives are those of each cell alone; LBFGS and BFGS take a little longer, LevenbergMarquardt on
normal equations twice as long, and Dogleg, which factorises the residuals of all cells together,
fifty times. Levenberg and Marquardt's steps converge from farthest away.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Bool, Float

from fits import newton
from fits.optimize import MAX_STEPS, Solver, search
from fits.posterior import (
    Problem,
    cell_derivatives,
    prior_terms,
)
from fits.priors import Prior, check_priors, prior_residuals, to_unbounded
from fits.profile_likelihood import SpectralLikelihood
from fits.results import astray, help_by_prior, misfit
from fits.separation.results import SpectralFit
from fits.systems import Factor, assembled, degenerate, variances
from jaxsky.checks import Numeric

#: The optimum is reached this close to it, in standard deviations of a parameter.
REACHED = 1e-3
#: Newton steps, by default.
NEWTON_STEPS = 100


def hessian(
    like: SpectralLikelihood, params: Mapping[str, Numeric]
) -> Float[np.ndarray, "par par"]:
    """Second derivatives of -ln L in all parameters, regions one after the other."""
    return _dense("hessian", like, params)


def fisher(like: SpectralLikelihood, params: Mapping[str, Numeric]) -> Float[np.ndarray, "par par"]:
    """Fisher matrix of the parameters, amplitudes marginalised at their best values.

    sum_p s^T A_i^T [N^-1 - N^-1 A (A^T N^-1 A)^-1 A^T N^-1] A_j s with A_i the derivative of the
    mixing matrix (Errard, Stivoli & Stompor 2011, PRD 84, 063005).
    """
    return _dense("fisher", like, params)


def _dense(which, like, params):
    theta = like.flat(like.check(params))
    local = np.asarray(getattr(cell_derivatives(like, theta), which))
    index = np.asarray(like.index)
    matrix = assembled(local, index, len(theta), np.zeros(len(theta)))
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def start_vector(
    like: SpectralLikelihood, start: Mapping[str, Numeric] | None, priors: Mapping[str, Prior]
) -> Float[np.ndarray, " par"]:
    """The vector to start from."""
    params = like.check(like.start if start is None else start)
    to_unbounded(params, priors)
    return np.array(like.flat(params))


def _vector(params, args):
    like, _, theta, present = args
    return theta.at[present].set(jnp.concatenate([params[name] for name in like.free]))


def _residuals(params, args):
    like, priors, *_ = args
    own = like.residuals(like.named(_vector(params, args)))
    return jnp.concatenate([own, prior_residuals(params, priors)])


def _objective(params, args):
    like, priors, *_ = args
    theta = _vector(params, args)
    return like.total(theta[like.index]) / 2 + prior_terms(theta, priors)[0]


def _searched(
    problem: Problem,
    theta: np.ndarray,
    priors: Mapping[str, Prior],
    solver: Solver,
    max_steps: int,
) -> tuple[np.ndarray, int]:
    """What a solver of optimistix finds, and the number of its steps."""
    diagonal = problem.curvature(theta, problem.convex(theta, problem.exact(theta))).diagonal()
    with np.errstate(divide="ignore", invalid="ignore"):
        # A standard deviation, in the numbers in which uniform priors have no bounds.
        size = np.where(diagonal > 0, 1 / np.sqrt(diagonal), np.maximum(np.abs(theta), 1.0))
        slope = np.sqrt((theta - problem.low) * (problem.high - theta))
        size = np.where(np.isfinite(slope), np.minimum(size / slope, 1.0), size)
    # Regions without a pixel are left out: some solvers do not bear what has no effect.
    like, present = problem.like, np.flatnonzero(problem.present)
    where = {n: present[problem.owner[present] == i] for i, n in enumerate(like.free)}
    by_function = isinstance(solver, optx.AbstractMinimiser)
    found, solution = search(
        _objective if by_function else _residuals,
        (like, problem.priors if by_function else priors, jnp.asarray(theta), present),
        {name: theta[own] for name, own in where.items()},
        priors=priors,
        scale={name: size[own] for name, own in where.items()},
        solver=solver,
        max_steps=max_steps,
        run=optx.minimise if by_function else optx.least_squares,
    )
    theta = theta.copy()
    for name, own in where.items():
        theta[own] = found[name]
    return theta, int(solution.stats["num_steps"])


def fit_spectra(
    like: SpectralLikelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    solver: Solver | None = None,
    max_steps: int | None = None,
    throw: bool = True,
) -> SpectralFit:
    """The most probable spectral parameters and their covariance.

    Parameters
    ----------
    like : from `fits.separation.spectral_likelihood`
    start : start values by name; by default those of the likelihood
    priors : priors by name, the same in each region; uniform ones bound the search
    solver : of optimistix: a least-squares solver, which works on the residuals of all pixels or
        the vectors in their place, or a minimiser, which works on their sum. Parameters are in
        units of their standard deviations at the start, and so are tolerances; with uniform
        priors, in those of numbers without bounds. By default (None), damped steps of Newton's
        method with exact second derivatives, region by region, and clipped at the bounds
    max_steps : of the search; by default 100 of Newton's method, or 500 of optimistix
    throw : raise if it fails, or the optimum lies at the edge of a uniform prior

    Raises
    ------
    KeyError, TypeError, ValueError
        For unknown parameters, start values outside their prior, something that is no solver, and
        priors that are neither uniform nor Gaussian with a least-squares solver.
    FitError
        If it did not converge, data and priors do not determine the parameters, or chi^2 is that
        of no fit (`fits.results`), unless throw=False; the result is in its `.result`. The message
        says in how many regions and pixels, and which prior would help.
    """
    if not (solver is None or isinstance(solver, Solver)):
        raise TypeError(
            f"Argument `solver` must be a least-squares solver or a minimiser of optimistix, "
            f"not {type(solver).__name__}."
        )
    priors = check_priors(priors, like.free)
    theta = start_theta = start_vector(like, start, priors)
    problem = Problem(like, priors)
    if max_steps is None:
        max_steps = NEWTON_STEPS if solver is None else MAX_STEPS
    if solver is None:
        theta, steps = newton.minimise(problem, theta, max_steps)
    else:
        theta, steps = _searched(problem, theta, priors, solver, max_steps)

    # From here on, nothing depends on how the optimum was found.
    edges = problem.edges(theta)
    keep = np.flatnonzero(problem.present & ~edges)
    labels = problem.labels
    matrix = problem.curvature(theta, problem.exact(theta), keep)
    scatter = problem.curvature(theta, np.asarray(problem.derivatives(theta).fisher), keep)
    unknown = degenerate(matrix, [labels[i] for i in keep])
    factor = Factor(matrix)
    covariance, sigma = _errors(problem, matrix, factor, scatter, keep, not unknown)
    slope = problem.value(theta)[1][keep]
    distance = float(np.sqrt(slope @ factor.solve(slope))) if factor.positive else np.inf
    close = REACHED * np.sqrt(max(len(keep), 1))
    chi2 = 2 * float(problem.derivatives(theta).value.sum())
    dof = like.dof(int(problem.present.sum()))
    far = np.zeros(len(theta), bool)
    far[keep] = ~(np.abs(slope) <= close * np.sqrt(np.abs(matrix.diagonal())))
    lost = problem.present & _astray(problem, theta, sigma, start_theta)
    message = "converged"
    if lost.any():
        message = f"The data do not constrain {problem.where(lost)}{_help(problem, lost)}"
    if unknown and not far.any():
        open_ = np.isin(labels, unknown)
        message = (
            f"The data do not determine {problem.where(open_)}: parameters are degenerate"
            f"{_help(problem, open_)}"
        )
    elif unknown or not distance < close:
        off = "and not at an optimum" if unknown else f"{distance:.2g} sigma from the optimum"
        which = f": {problem.where(far)}{_help(problem, far)}" if far.any() else "."
        message = f"The search stopped after {steps} steps, {off}{which}"
    if edges.any():
        message = _edge_message(problem, edges)
    if (wrong := problem.present & ~np.isfinite(theta)).any():
        message = (
            f"The search left the finite numbers within {steps} steps: {problem.where(wrong)}"
            f"{_help(problem, wrong)}"
        )
    if wrong_inputs := misfit(chi2, dof):
        message = wrong_inputs if message == "converged" else f"{wrong_inputs} {message}"
    dense = isinstance(matrix, np.ndarray)
    return SpectralFit(
        free=like.free,
        best_fit=_by_name(like, np.where(problem.present, theta, np.nan)),
        sigma=_by_name(like, sigma),
        labels=labels,
        covariance=covariance,
        hessian=_widened(matrix, keep, len(theta)) if dense else None,
        fisher=_widened(scatter, keep, len(theta)) if dense else None,
        chi2=chi2,
        dof=dof,
        converged=message == "converged",
        message=message,
        details={
            "solver": "Newton" if solver is None else type(solver).__name__,
            "steps": steps,
            "distance": distance,
        },
    ).checked(throw)


def _by_name(like: SpectralLikelihood, theta: np.ndarray) -> dict[str, Any]:
    named = {name: np.asarray(value) for name, value in like.named(jnp.asarray(theta)).items()}
    return {name: float(v) if v.ndim == 0 else v for name, v in named.items()}


def _widened(matrix: np.ndarray, keep: np.ndarray, size: int) -> np.ndarray:
    """A matrix of all parameters, NaN for those that were left out."""
    wide = np.full((size, size), np.nan)
    wide[np.ix_(keep, keep)] = matrix
    return wide


def _errors(problem, matrix, factor, scatter, keep, determined):
    """Covariance, None for too many parameters, and standard deviations."""
    size = len(problem.present)
    sigma = np.full(size, np.nan)
    dense = isinstance(matrix, np.ndarray)
    if not (determined and factor.positive):
        return (np.full((size, size), np.nan) if dense else None), sigma
    if not dense:
        owner = problem.owner[keep]
        few = np.bincount(owner, minlength=len(problem.like.free)) * 10 < len(problem.index)
        sigma[keep] = np.sqrt(variances(factor, scatter, few[owner]))
        return None, sigma
    inverse = factor.solve(np.eye(len(keep)))
    covariance = inverse @ scatter @ inverse
    covariance = _widened((covariance + covariance.T) / 2, keep, size)
    return covariance, np.sqrt(np.diagonal(covariance))


def _astray(
    problem: Problem, theta: np.ndarray, sigma: np.ndarray, start: np.ndarray
) -> Bool[np.ndarray, " par"]:
    return np.concatenate(
        [
            astray(name, theta[own], sigma[own], start[own])
            for i, name in enumerate(problem.like.free)
            for own in [problem.owner == i]
        ]
    )


def _help(problem: Problem, bad: np.ndarray) -> str:
    return f"; {help_by_prior(tuple(dict.fromkeys(np.array(problem.names)[bad])))}."


def _edge_message(problem: Problem, edges: np.ndarray) -> str:
    first = int(np.argmax(edges))
    low, high = problem.low[first], problem.high[first]
    own = edges & (problem.owner == problem.owner[first])
    where = problem.where(own).removeprefix(problem.names[first])
    return (
        f"The best fit of {problem.names[first]!r} lies at the edge of its uniform prior "
        f"{low:g} ... {high:g}{where}{_help(problem, own)}"
    )
