"""Find the most probable parameters by gradient, with solvers of optimistix or Newton's method.

Solvers of optimistix take the residuals, and so need only their first derivatives: the default of
template fits. Newton's method takes the exact second derivatives of each cell, in a program that
the checks and the covariance need in any case: the default of spectral likelihoods, where a first
fit takes half the time of one with optimistix. With hundreds of regions LBFGS and BFGS take a
little longer, LevenbergMarquardt on normal equations twice as long, and Dogleg, which factorises
the residuals of all cells together, fifty times. Levenberg and Marquardt's steps converge from
farthest away.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.sparse

from fits.posterior import Gaussian, Likelihood, Matrix, Posterior, Prior
from fits.results import Convergence, FitResult, help_by_prior
from fits.systems import Factor, degenerate, variances
from jaxsky.checks import Numeric
from jaxsky.mesh import mesh_of

#: Most steps of a search with optimistix and with Newton's method, by default.
MAX_STEPS, NEWTON_STEPS = 500, 100
#: Distance from the optimum that counts as reached, in standard deviations of a parameter.
REACHED = 1e-3


def _damped(matrix: Matrix, damping: float) -> Matrix:
    diagonal = np.abs(matrix.diagonal()) * damping
    if isinstance(matrix, np.ndarray):
        return matrix + np.diag(diagonal)
    return scipy.sparse.csc_matrix(matrix + scipy.sparse.diags(diagonal))


class Newton(NamedTuple):
    """Newton's method with exact second derivatives, damped as by Levenberg and Marquardt.

    A step does not depend on the units of parameters or data, and is clipped at the bounds.

    Parameters
    ----------
    last : a step this small, in standard deviations, is the last one
    """

    last: float = 1e-5

    def minimise(self, posterior: Posterior, max_steps: int) -> tuple[np.ndarray, int]:
        """Return the optimum within bounds, and the number of steps to it."""
        theta = posterior.start
        value, gradient = posterior.value(theta)
        damping, reach = 1e-4, posterior.reach()
        for step in range(max_steps):
            at_low, at_high = theta <= posterior.low, theta >= posterior.high
            blocked = at_low & (gradient > 0) | at_high & (gradient < 0)
            moving = np.flatnonzero(posterior.present & ~blocked)
            if not moving.size:
                return theta, step
            matrix = posterior.curvature(theta, posterior.derivatives(theta).hessian, moving)
            factor = Factor(matrix)
            if not (exact := factor.positive):
                matrix = posterior.curvature(theta, posterior.convex(theta), moving)
                factor = Factor(matrix)
            slope = gradient[moving]
            newton = factor.solve(-slope) if factor.positive else None
            close = exact and np.sqrt(max(-slope @ newton, 0)) < self.last * np.sqrt(len(moving))
            for _ in range(40):
                move = newton
                if newton is None or (damping and not close):
                    damped = Factor(_damped(matrix, damping or 1e-6))
                    move = damped.solve(-slope) if damped.positive else None
                if move is not None:
                    trial = theta.copy()
                    trial[moving] += np.clip(move, -reach[moving], reach[moving])
                    trial = np.clip(trial, posterior.low, posterior.high)
                    made = trial[moving] - theta[moving]
                    expected = -(slope @ made + made @ (matrix @ made) / 2)
                    new, new_gradient = posterior.value(trial)
                    rounding = 1e-13 * abs(value)
                    gained = (value - new + rounding) / (max(expected, 0) + rounding)
                    if np.isfinite(new) and np.isfinite(new_gradient).all() and gained > 1e-3:
                        break
                damping = max(10 * damping, 1e-4)
            else:
                return theta, step
            theta, value, gradient = trial, new, new_gradient
            if close:
                return theta, step + 1
            damping = damping / 10 if gained > 0.5 else damping
            damping = 0.0 if damping < 1e-8 else damping
        return theta, max_steps


#: Solvers: on residuals, on a function alone, or on its derivatives.
Solver = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | Newton


@jax.jit
def _values(numbers, density, scale):
    """Return parameters from scaled numbers u; in uniform priors low + (high-low)(1+sin u)/2.

    As in MINUIT: smooth, and flat at the edge, so that an optimum at the edge is a minimum in u.
    """
    u = numbers * scale
    inside = density.low + (density.high - density.low) * (1 + jnp.sin(u)) / 2
    return jnp.where(density.bounded, inside, u)


def _residuals(numbers, args):
    like, priors, *_ = density = args[0]
    theta = density.full(_values(numbers, *args))
    of_priors = [jnp.where(own, (theta - p.mean) / p.sigma, 0.0) for p, own in priors]
    return jnp.concatenate([like.residuals(like.named(theta)), *of_priors])


def _objective(numbers, args):
    return -args[0].log_prob(_values(numbers, *args))


def _sizes(posterior: Posterior) -> np.ndarray:
    """Return standard deviations at the start, in numbers where uniform priors have no bounds."""
    theta = posterior.start
    diagonal = posterior.curvature(theta, posterior.convex(theta)).diagonal()
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(diagonal > 0, 1 / np.sqrt(diagonal), np.maximum(np.abs(theta), 1.0))
        slope = np.sqrt((theta - posterior.low) * (posterior.high - theta))
        return np.where(np.isfinite(slope), np.minimum(size / slope, 1.0), size)


def _searched(posterior: Posterior, solver: Solver, max_steps: int) -> tuple[np.ndarray, int]:
    """Return the optimum of a solver of optimistix, and the number of its steps."""
    least_squares = isinstance(solver, optx.AbstractLeastSquaresSolver)
    for prior, own in posterior.priors:
        if least_squares and not isinstance(prior, Gaussian):
            raise TypeError(
                f"Least squares takes uniform and Gaussian priors, not the {type(prior).__name__} "
                f"of {posterior.names[int(np.argmax(own))]!r}."
            )
    # Regions without a pixel are left out: some solvers fail on parameters without effect.
    density = posterior.density(posterior.start)
    present, bounded, low, high = map(np.asarray, density[3:])
    start = posterior.start[present]
    unit = np.where(bounded, (start - low) / (high - low), 0.5)
    u = np.where(bounded, np.arcsin(2 * unit - 1), start)
    scale = np.maximum(np.abs(u), 1e-3) if least_squares else _sizes(posterior)[present]
    args = (density, jnp.asarray(scale))

    def solve(numbers):
        run: Callable[..., optx.Solution] = optx.least_squares if least_squares else optx.minimise
        function = _residuals if least_squares else _objective
        solution = run(function, solver, numbers, args=args, max_steps=max_steps, throw=False)
        theta = posterior.start.copy()
        theta[present] = _values(solution.value, *args)
        return solution, theta

    solution, found = solve(jnp.asarray(u / scale))
    edges = posterior.edges(found)[present]
    if edges.any():
        # The map is flat at the edge of a range, so a step that got there too early is stuck.
        solution, found = solve(jnp.where(edges, 0.0, solution.value))
    return found, int(solution.stats["num_steps"])


def best_fit(
    like: Likelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    solver: Solver | None = None,
    max_steps: int | None = None,
    throw: bool = True,
) -> FitResult:
    """Find the most probable parameters and their covariance.

    Parameters
    ----------
    like : from `fits.likelihood` or `fits.spectral_likelihood`
    start : start values of the free parameters by name; by default those of the likelihood
    priors : priors by name, the same in each region; uniform ones bound the search
    solver : of optimistix: a least-squares solver, which works on the residuals, or a minimiser,
        which works on their sum of squares. Parameters, and so tolerances, are in units of their
        values at the start for the first, and of their standard deviations there for the second;
        with uniform priors, those of numbers without bounds. Or `fits.Newton()`, the default for
        spectral likelihoods and distributed pixels, which take no other; else the default is
        `LevenbergMarquardt`
    max_steps : largest number of steps; by default 100 for Newton's method, 500 for optimistix
    throw : raise if it fails, or the optimum lies at the edge of a uniform prior

    Returns
    -------
    Result whose intervals are one standard deviation to either side. Its covariance is the inverse
    of the curvature H of -log posterior; for spectral likelihoods H^-1 S H^-1 with S the
    covariance of its gradient, the same where signals are well above the noise of each pixel.
    `details` has "solver" by name, its "steps", the "distance" to the optimum that remained, in
    standard deviations, and "hessian" and "fisher", H and the Fisher matrix of the fitted
    amplitudes, both with the curvature of the priors; None for too many parameters.

    Raises
    ------
    KeyError, TypeError, ValueError
        For unknown parameters, start values outside their prior, other objects as solver, negative
        max_steps, and priors that are neither uniform nor Gaussian with a least-squares solver.
    FitError
        If it did not converge, unless throw=False; the result is in its `.result`: if the search
        stopped away from an optimum, even at its start, if data and priors do not determine a
        parameter, and if chi^2 is far too large for a fit (`fits.results`). The message says in how
        many regions and pixels, and which prior would help.
    """
    if not (solver is None or isinstance(solver, Solver)):
        raise TypeError(
            "Argument `solver` must be a least-squares solver or a minimiser of optimistix, or "
            f"fits.Newton(), not {type(solver).__name__}."
        )
    if max_steps is not None and max_steps < 0:
        raise ValueError(f"Argument `max_steps` must not be negative, but is {max_steps}.")
    like = like.at(start)
    posterior = Posterior(like, priors)
    distributed = mesh_of(like) is not None
    if solver is None:
        exact = like.profiled or distributed
        solver = Newton() if exact else optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    if isinstance(solver, Newton):
        max_steps = NEWTON_STEPS if max_steps is None else max_steps
        theta, steps = solver.minimise(posterior, max_steps)
    elif distributed:
        raise ValueError(
            f"Argument `solver` is {type(solver).__name__}, and optimistix does not take "
            "distributed pixels; take fits.Newton()."
        )
    else:
        max_steps = MAX_STEPS if max_steps is None else max_steps
        theta, steps = _searched(posterior, solver, max_steps)

    # From here on, nothing depends on how the optimum was found.
    keep = np.flatnonzero(posterior.present & ~posterior.edges(theta))
    found = posterior.derivatives(theta)
    hessian, fisher = (posterior.curvature(theta, x, keep) for x in (found.hessian, found.fisher))
    unknown = degenerate(hessian, [posterior.labels[i] for i in keep]) if keep.size else []
    factor = Factor(hessian)
    covariance, sigma = _errors(posterior, keep, hessian, fisher, None if unknown else factor)
    slope = posterior.value(theta)[1][keep]
    distance = float(np.sqrt(slope @ factor.solve(slope))) if factor.positive else np.inf
    close = REACHED * float(np.sqrt(max(len(keep), 1)))
    far = np.zeros(len(theta), bool)
    far[keep] = ~(np.abs(slope) <= close * np.sqrt(np.abs(hessian.diagonal())))
    converged, message = _ended(posterior, theta, steps, max_steps, distance, close, unknown, far)
    values, errors = posterior.named(theta), posterior.named(sigma)
    result = FitResult(
        method="gradient",
        best_fit=values,
        sigma=errors,
        interval_68={n: (values[n] - errors[n], values[n] + errors[n]) for n in values},
        labels=posterior.labels,
        covariance=covariance,
        chi2=2 * float(found.value.sum()),
        dof=like.dof(int(posterior.present.sum())),
        converged=converged,
        message=message,
        details={
            "solver": type(solver).__name__,
            "steps": steps,
            "distance": distance,
            "hessian": _widened(hessian, keep, len(theta)),
            "fisher": _widened(fisher, keep, len(theta)),
        },
    )
    return result.judged(result.chi2, result.dof, like.start).checked(throw)


def _widened(matrix: Matrix | None, keep: np.ndarray, size: int) -> np.ndarray | None:
    """Return a matrix of all parameters, NaN for those left out; None if it is not dense."""
    if not isinstance(matrix, np.ndarray):
        return None
    wide = np.full((size, size), np.nan)
    wide[np.ix_(keep, keep)] = matrix
    return wide


def _errors(posterior, keep, hessian, fisher, factor):
    """Return the covariance, None for too many parameters, and standard deviations.

    `factor` is that of the Hessian, None if it does not determine all parameters.
    """
    dense, sigma = isinstance(hessian, np.ndarray), np.full(len(posterior.present), np.nan)
    covariance = np.full_like(hessian, np.nan) if dense else None
    scatter = fisher if posterior.like.profiled else hessian
    if factor is not None and factor.positive:
        if dense:
            inverse = factor.solve(np.eye(len(keep)))
            covariance = inverse if scatter is hessian else inverse @ scatter @ inverse
            covariance = (covariance + covariance.T) / 2
            variance = np.diagonal(covariance)
        else:
            owner = posterior.owner[keep]
            number = np.bincount(owner, minlength=len(posterior.like.free))
            few = number * 10 < len(posterior.index)
            variance = variances(factor, scatter, few[owner])
        sigma[keep] = np.sqrt(variance)
    return _widened(covariance, keep, len(sigma)), sigma


def _ended(posterior, theta, steps, max_steps, distance, close, unknown, far):
    """Return how a search ended, also in words; the most serious reason comes first.

    A search within `close` of an optimum has reached it. `unknown` are labels of degenerate
    parameters, and `far` is True for those neither at an optimum nor at an edge of their prior.
    """
    where = posterior.where

    def advice(bad: np.ndarray) -> str:
        return help_by_prior(tuple(dict.fromkeys(np.array(posterior.names)[bad])))

    if (wrong := posterior.present & ~np.isfinite(theta)).any():
        message = f"The search left the finite numbers within {steps} steps: {where(wrong)}; "
        return Convergence.not_finite, f"{message}{advice(wrong)}."
    if (edges := posterior.edges(theta)).any():
        first = int(np.argmax(edges))
        name, low, high = posterior.names[first], posterior.low[first], posterior.high[first]
        near = low if theta[first] - low < high - theta[first] else high
        own = edges & (posterior.owner == posterior.owner[first])
        return Convergence.at_edge, (
            f"The best fit of {name!r} lies at the edge {near:g} of its uniform prior "
            f"{low:g} ... {high:g}{where(own).removeprefix(name)}; {advice(own)}."
        )
    if unknown and not far.any():
        open_ = np.isin(posterior.labels, unknown)
        message = f"The data do not determine {where(open_)}: parameters are degenerate; "
        return Convergence.undetermined, f"{message}{advice(open_)}."
    if not unknown and distance < close:
        return Convergence.converged, "converged"
    off = "and not at an optimum" if unknown else f"{distance:.2g} sigma from the optimum"
    still = steps and np.allclose(theta, posterior.start, rtol=1e-12, atol=0.0)
    ended = "did not leave its start" if still else f"stopped after {steps} steps"
    message = f"The search {ended}, {off}"
    message += f": {where(far)}; {advice(far)}." if far.any() else "."
    return Convergence.stalled if steps < max_steps else Convergence.max_steps, message
