"""The most probable spectral parameters, by Newton's method with exact second derivatives.

A cell depends on a few parameters only, so its second derivatives are a small matrix; those of
all parameters are put together from them. Steps are damped as by Levenberg and Marquardt, and a
step does not depend on the units of parameters or data.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float

from fits.priors import Prior, Uniform, bounds, check_priors
from fits.separation.algebra import Factor, assembled, degenerate, variances
from fits.separation.likelihood import SpectralLikelihood
from fits.separation.results import SpectralFit
from jaxsky.types import Numeric

__all__ = ["fisher", "fit_spectra", "hessian"]

#: A step this small, in standard deviations, is the last one.
CLOSE = 1e-5
#: An optimum this close to the edge of a uniform prior, in units of its width, is at the edge.
EDGE = 1e-4
#: Pixels whose second derivatives in all parameters are computed at once.
AT_ONCE = 1 << 15


@jax.jit
def _value_and_gradient(like, theta):
    """-ln L and its gradient."""
    return jax.value_and_grad(lambda t: like.total(t[like.index]) / 2)(theta)


@jax.jit
def _cell_hessians(like, theta):
    """Second derivatives of -ln L in the parameters of each cell, (cell, free, free)."""
    local = theta[like.index]
    gradient = jax.grad(lambda x: like.total(x) / 2)

    def column(unit):
        return jax.jvp(gradient, (local,), (jnp.broadcast_to(unit, local.shape),))[1]

    # Cells are independent: one column of all of them at a time.
    units = jnp.eye(local.shape[1])
    pixels = max(part.data.shape[0] * part.data.shape[-1] for part in like.pixels)
    columns = jax.vmap(column)(units) if pixels <= AT_ONCE else jax.lax.map(column, units)
    matrices = jnp.moveaxis(columns, 0, -1)
    return (matrices + jnp.swapaxes(matrices, -1, -2)) / 2


@jax.jit
def _predicted(like, theta):
    return like.predicted(theta[like.index])


def _cell_fishers(like, theta):
    """The same for data that are what the parameters predict: positive semi-definite."""
    return _cell_hessians(_predicted(like, theta), theta)


@jax.jit
def _prior_terms(theta, priors):
    """-log density of priors, first and second derivative, for rows (prior, where it holds)."""
    value = jnp.zeros(())
    first, second = jnp.zeros_like(theta), jnp.zeros_like(theta)
    for prior, where in priors:
        slope = jax.grad(lambda v, p=prior: -p.log_density(v))
        one, two = jax.vmap(slope)(theta), jax.vmap(jax.grad(slope))(theta)
        value += jnp.sum(jnp.where(where, -jax.vmap(prior.log_density)(theta), 0.0))
        first, second = jnp.where(where, one, first), jnp.where(where, two, second)
    return value, first, second


class _Problem:
    """-log posterior of the parameters that any cell has, within bounds."""

    def __init__(self, like: SpectralLikelihood, priors: Mapping[str, Prior]) -> None:
        self.like = like
        sizes = {name: like.start[name].size for name in like.free}
        self.owner = np.repeat(np.arange(len(sizes)), list(sizes.values()))
        self.names = tuple(like.free[i] for i in self.owner)
        self.index = np.asarray(like.index)
        self.present = np.zeros(len(self.owner), bool)
        self.present[self.index] = True
        limits = np.array([bounds(name, priors) for name in like.free]).reshape(-1, 2)
        self.low, self.high = limits[self.owner].T
        # Those of a uniform prior are kept as bounds.
        self.priors = [
            (prior, jnp.asarray(self.present & (self.owner == like.free.index(name))))
            for name, prior in priors.items()
            if not isinstance(prior, Uniform)
        ]

    @property
    def labels(self) -> tuple[str, ...]:
        """Name, and region if it has several, of each parameter."""
        labels = []
        for i, name in enumerate(self.like.free):
            regions = np.flatnonzero(self.owner == i) - np.argmax(self.owner == i)
            single = self.like.start[name].ndim == 0
            labels += [name if single else f"{name}[{k}]" for k in regions]
        return tuple(labels)

    def value(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """The function and its gradient."""
        value, gradient = _value_and_gradient(self.like, theta)
        if self.priors:
            prior, slope, _ = _prior_terms(theta, self.priors)
            value, gradient = value + prior, gradient + slope
        return float(value), np.asarray(gradient)

    def curvature(self, theta: np.ndarray, local: np.ndarray) -> Any:
        """The matrix of all parameters from those of the cells, priors included."""
        diagonal = np.zeros(len(theta))
        if self.priors:
            diagonal = np.asarray(_prior_terms(theta, self.priors)[2])
        return assembled(local, self.index, len(theta), diagonal)

    def exact(self, theta: np.ndarray) -> np.ndarray:
        return np.asarray(_cell_hessians(self.like, theta))

    def convex(self, theta: np.ndarray, exact: np.ndarray) -> np.ndarray:
        """Matrices of cells, those that are not positive replaced by Fisher matrices."""
        usable = np.isfinite(exact).all(axis=(1, 2))
        safe = np.where(usable[:, None, None], exact, 0)
        diagonal = np.einsum("cii->ci", safe)
        usable &= (diagonal > 0).all(axis=1)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        usable &= np.linalg.eigvalsh(safe * scale[:, None] * scale[:, :, None])[:, 0] > 0
        fishers = np.asarray(_cell_fishers(self.like, theta))
        return np.where(usable[:, None, None], exact, fishers)


def _cut(matrix, keep):
    """Rows and columns of a matrix."""
    return matrix[np.ix_(keep, keep)] if isinstance(matrix, np.ndarray) else matrix[keep][:, keep]


def _damped(matrix, damping):
    diagonal = np.abs(matrix.diagonal()) * damping
    if isinstance(matrix, np.ndarray):
        return matrix + np.diag(diagonal)
    return scipy.sparse.csc_matrix(matrix + scipy.sparse.diags(diagonal))


def _minimise(
    problem: _Problem, theta: np.ndarray, max_steps: int
) -> tuple[np.ndarray, int, float]:
    """Damped Newton steps: the optimum, their number, and how far away the last one began."""
    value, gradient = problem.value(theta)
    damping = 1e-4
    distance = np.inf
    for step in range(max_steps):
        blocked = (theta <= problem.low) & (gradient > 0) | (theta >= problem.high) & (gradient < 0)
        moving = np.flatnonzero(problem.present & ~blocked)
        if not moving.size:
            return theta, step, 0.0
        local = problem.exact(theta)
        matrix = _cut(problem.curvature(theta, local), moving)
        factor = Factor(matrix)
        exact = factor.positive
        if not exact:
            local = problem.convex(theta, local)
            matrix = _cut(problem.curvature(theta, local), moving)
            factor = Factor(matrix)
        slope = gradient[moving]
        newton = factor.solve(-slope) if factor.positive else None
        if newton is not None:
            distance = float(np.sqrt(max(-slope @ newton, 0)))
        close = exact and distance < CLOSE * np.sqrt(len(moving))
        for _ in range(40):
            move = newton
            if newton is None or (damping and not close):
                damped = Factor(_damped(matrix, damping or 1e-6))
                move = damped.solve(-slope) if damped.positive else None
            if move is not None:
                trial = theta.copy()
                trial[moving] += move
                trial = np.clip(trial, problem.low, problem.high)
                made = trial[moving] - theta[moving]
                expected = -(slope @ made + made @ (matrix @ made) / 2)
                new, new_gradient = problem.value(trial)
                rounding = 1e-13 * abs(value)
                gained = (value - new + rounding) / (max(expected, 0) + rounding)
                if np.isfinite(new) and np.isfinite(new_gradient).all() and gained > 1e-3:
                    break
            damping = max(10 * damping, 1e-4)
        else:
            return theta, step, distance
        theta, value, gradient = trial, new, new_gradient
        if close:
            return theta, step + 1, distance
        damping = damping / 10 if gained > 0.5 else damping
        damping = 0.0 if damping < 1e-8 else damping
    return theta, max_steps, distance


def hessian(
    like: SpectralLikelihood, params: Mapping[str, Numeric]
) -> Float[np.ndarray, "par par"]:
    """Second derivatives of -ln L in all parameters, regions one after the other."""
    return _dense(_cell_hessians, like, params)


def fisher(like: SpectralLikelihood, params: Mapping[str, Numeric]) -> Float[np.ndarray, "par par"]:
    """Fisher matrix of the parameters, amplitudes marginalised at their best values.

    sum_p s^T A_i^T [N^-1 - N^-1 A (A^T N^-1 A)^-1 A^T N^-1] A_j s with A_i the derivative of the
    mixing matrix (Errard, Stivoli & Stompor 2011, PRD 84, 063005).
    """
    return _dense(_cell_fishers, like, params)


def _dense(function, like, params):
    theta = like.flat(like.check(params))
    local, index = np.asarray(function(like, theta)), np.asarray(like.index)
    matrix = assembled(local, index, len(theta), np.zeros(len(theta)))
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def _start(like: SpectralLikelihood, start: Mapping[str, Numeric], priors) -> np.ndarray:
    params = like.check(start)
    for name in params:
        low, high = bounds(name, priors)
        value = np.asarray(params[name])
        if not np.all((low < value) & (value < high)):
            raise ValueError(
                f"Start value {value[~((low < value) & (value < high))].flat[0]:g} of {name!r} is "
                f"not inside its uniform prior {low:g} ... {high:g}."
            )
    return np.array(like.flat(params))


def fit_spectra(
    like: SpectralLikelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    max_steps: int = 100,
    throw: bool = True,
) -> SpectralFit:
    """The most probable spectral parameters and their covariance.

    Parameters
    ----------
    like : from `fits.separation.spectral_likelihood`
    start : start values by name; by default those of the likelihood
    priors : priors by name, the same in each region; uniform ones bound the search
    max_steps : of the search
    throw : raise if it fails, or the optimum lies at the edge of a uniform prior

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, or start values outside their prior.
    FitError
        If it did not converge, or data and priors do not determine the parameters, unless
        throw=False; the result is in its `.result`.
    """
    priors = check_priors(priors, like.free)
    theta = _start(like, like.start if start is None else start, priors)
    problem = _Problem(like, priors)
    theta, steps, distance = _minimise(problem, theta, max_steps)
    edges = _at_edge(problem, theta)
    keep = np.flatnonzero(problem.present & ~edges)
    matrix = _cut(problem.curvature(theta, problem.exact(theta)), keep)
    labels = problem.labels
    unknown = degenerate(matrix, [labels[i] for i in keep])
    scatter = _cut(problem.curvature(theta, np.asarray(_cell_fishers(like, theta))), keep)
    covariance, sigma = _errors(problem, matrix, scatter, keep, not unknown)

    message = "converged"
    if not distance < 100 * CLOSE * np.sqrt(max(len(keep), 1)):
        message = f"The search stopped after {steps} steps, {distance:.2g} sigma from the optimum."
    if unknown:
        shown = ", ".join(unknown[:6]) + (f" and {len(unknown) - 6} more" if unknown[6:] else "")
        message = f"The data do not determine {shown}: parameters are degenerate."
    if edges.any():
        message = _edge_message(problem, edges)
    values = np.where(problem.present, theta, np.nan)
    dense = isinstance(matrix, np.ndarray)
    return SpectralFit(
        free=like.free,
        best_fit=_by_name(like, values),
        sigma=_by_name(like, sigma),
        labels=labels,
        covariance=covariance,
        hessian=_widened(matrix, keep, len(theta)) if dense else None,
        fisher=_widened(scatter, keep, len(theta)) if dense else None,
        chi2=2 * float(_value_and_gradient(like, theta)[0]),
        dof=like.values - int(problem.present.sum()),
        converged=message == "converged",
        message=message,
        details={"steps": steps, "distance": distance},
    ).checked(throw)


def _by_name(like: SpectralLikelihood, theta: np.ndarray) -> dict[str, Any]:
    named = {name: np.asarray(value) for name, value in like.named(jnp.asarray(theta)).items()}
    return {name: float(v) if v.ndim == 0 else v for name, v in named.items()}


def _widened(matrix: np.ndarray, keep: np.ndarray, size: int) -> np.ndarray:
    """A matrix of all parameters, NaN for those that were left out."""
    wide = np.full((size, size), np.nan)
    wide[np.ix_(keep, keep)] = matrix
    return wide


def _errors(problem, matrix, scatter, keep, determined):
    """Covariance, None for too many parameters, and standard deviations."""
    size = len(problem.present)
    sigma = np.full(size, np.nan)
    dense = isinstance(matrix, np.ndarray)
    factor = Factor(matrix)
    if not determined or not factor.positive:
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


def _at_edge(problem: _Problem, theta: np.ndarray) -> np.ndarray:
    width = np.where(np.isfinite(problem.high), problem.high - problem.low, 0.0)
    near = np.minimum(np.abs(theta - problem.low), np.abs(theta - problem.high))
    return problem.present & (near < EDGE * width)


def _edge_message(problem: _Problem, edges: np.ndarray) -> str:
    first = int(np.argmax(edges))
    name, label = problem.names[first], problem.labels[first]
    owned = problem.owner == problem.owner[first]
    low, high = problem.low[first], problem.high[first]
    count = int(edges[owned].sum())
    where = f"in {count} of {int(owned.sum())} regions" if label != name else ""
    return (
        " ".join(
            f"The best fit of {name!r} lies at the edge of its uniform prior {low:g} ... {high:g} "
            f"{where}".split()
        )
        + "."
    )
