"""Priors, and posteriors as functions of a vector of parameters, with their derivatives.

Parameters are numbers, or arrays with a value for each region. A cell, an intersection of regions,
depends on only a few of them, so its second derivatives are a small matrix; the matrix of all
parameters is assembled from these. A likelihood without regions is a single cell.
"""

import dataclasses
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int

from fits.distributed import counted
from fits.systems import Derivatives, assembled
from jaxsky.checks import Numeric, as_array
from jaxsky.settings import Experiment

#: Dense matrix, or sparse for many parameters.
Matrix: TypeAlias = np.ndarray | scipy.sparse.csc_matrix
#: A value this close to the edge of a uniform prior, in units of its width, is at the edge.
EDGE = 1e-4


class Prior(eqx.Module):
    """Base class of priors on a parameter."""

    def log_density(self, value: Numeric) -> Array:
        """Return the log-density up to a constant; -inf outside the range."""
        raise TypeError(f"{type(self).__name__} must define `log_density`.")


class Uniform(Prior):
    """Constant density in low <= value <= high; ValueError if low is not below high.

    Examples
    --------
    >>> float(Uniform(1.0, 2.0).log_density(1.5))
    0.0
    """

    low: float
    high: float

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = float(low), float(high)
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise ValueError(f"A uniform prior needs finite low < high, not {low} and {high}.")

    def log_density(self, value):
        return jnp.where((value >= self.low) & (value <= self.high), 0.0, -jnp.inf)


class Gaussian(Prior):
    """Gaussian density; ValueError if the mean is not finite, or sigma not positive.

    Examples
    --------
    >>> float(Gaussian(1.0, 0.5).log_density(2.0))
    -2.0
    """

    mean: float
    sigma: float

    def __init__(self, mean: float, sigma: float) -> None:
        self.mean, self.sigma = float(mean), float(sigma)
        if not (np.isfinite([self.mean, self.sigma]).all() and self.sigma > 0):
            raise ValueError(
                f"A Gaussian prior needs a finite mean and positive sigma, not {mean} and {sigma}."
            )

    def log_density(self, value):
        return -0.5 * ((value - self.mean) / self.sigma) ** 2


def priors_of(settings: Experiment, command: str) -> dict[str, Prior]:
    """Return the priors of the free parameters of a command."""
    priors: dict[str, Prior] = {}
    for name, one in settings.free_in(command).items():
        if one.uniform:
            priors[name] = Uniform(*one.uniform)
        elif one.gaussian:
            priors[name] = Gaussian(*one.gaussian)
    return priors


def check_priors(priors: Mapping[str, Prior] | None, free: Sequence[str]) -> dict[str, Prior]:
    """Return the priors, after checking that each belongs to a free parameter."""
    priors = dict(priors or {})
    for name in priors:
        if name not in free:
            raise KeyError(
                f"There is a prior for {name!r}, which is not free; free are {', '.join(free)}."
            )
    return priors


class Likelihood(eqx.Module):
    """Base class: -2 log L is the sum of squares of `residuals(params)`, up to a constant.

    A subclass defines `residuals` and `check`, and `total` and `derivatives` if it has them in
    closed form. `start` has start values of the free parameters, and `values` is the number of data
    with weight minus that of amplitudes.
    """

    start: dict[str, Array]
    values: Int[Array, ""] | int
    #: Whether amplitudes are fitted in each pixel: then the inverse curvature alone
    #: underestimates errors where signals are near the noise of a pixel.
    profiled: ClassVar[bool] = False

    def residuals(self, params: Mapping[str, Numeric]) -> Float[Array, " row"]:
        """Return residuals for parameters by name; others keep their values."""
        raise TypeError(f"{type(self).__name__} must define `residuals`.")

    def check(self, params: Mapping[str, Numeric]) -> dict[str, Array]:
        """Return the free parameters as arrays, after checking their names."""
        raise TypeError(f"{type(self).__name__} must define `check`.")

    def dof(self, free: int) -> int:
        """Return the degrees of freedom: data with weight - amplitudes - free parameters."""
        return int(self.values) - free

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the vector."""
        return tuple(sorted(self.start))

    def at(self, start: Mapping[str, Numeric] | None) -> "Likelihood":
        """Return the likelihood with other start values; unchanged for None."""
        start = self.check(self.start if start is None else start)
        return dataclasses.replace(self, start=start)

    def flat(self, params: Mapping[str, Numeric]) -> Float[Array, " par"]:
        """Return the vector of all free parameters; those not given are at their start."""
        rows = [
            jnp.broadcast_to(params.get(name, self.start[name]), self.start[name].shape).ravel()
            for name in self.free
        ]
        return jnp.concatenate(rows) if rows else jnp.zeros(0)

    def named(self, theta: Float[Array, " par"]) -> dict[str, Array]:
        """Return parameters by name from the vector, the inverse of `flat`."""
        start = [self.start[name] for name in self.free]
        ends = np.cumsum([own.size for own in start])
        parts = jnp.split(jnp.asarray(theta), ends[:-1]) if start else []
        return {n: p.reshape(s.shape) for n, p, s in zip(self.free, parts, start, strict=True)}

    def cells(self) -> Int[Array | np.ndarray, "cell free"]:
        """Return the position of each free parameter of each cell in the vector of all."""
        return np.arange(len(self.free))[None]

    def total(self, local: Float[Array, "cell free"]) -> Float[Array, ""]:
        """Return -2 ln L for parameters of each cell."""
        return jnp.sum(self.residuals(self.named(local[0])) ** 2)

    def pieces(self) -> Iterator["Likelihood"]:
        """Yield likelihoods that add up to this one, each with its data in memory."""
        yield self

    def derivatives(self, local: Float[Array, "cell free"]) -> Derivatives:
        """Return -ln L of each cell, and its derivatives in the parameters of the cell."""

        def gradient(theta):
            value, slope = jax.value_and_grad(lambda t: self.total(t[None]) / 2)(theta)
            return slope, (value, slope)

        hessian, (value, slope) = jax.jacfwd(gradient, has_aux=True)(local[0])
        rows = jax.jacfwd(lambda theta: self.residuals(self.named(theta)))(local[0])
        return jax.tree.map(lambda x: x[None], Derivatives(value, slope, hessian, rows.T @ rows))


def chi2(like: Likelihood, params: Mapping[str, Numeric]) -> Float[Array, ""]:
    """Return the sum of squares of the residuals: chi^2, or -2 log L up to a constant."""
    # All of one type, or Python numbers would be compiled again.
    values = {name: as_array(name, value).astype(float) for name, value in params.items()}
    return _chi2(like, values)


@jax.jit
def _chi2(like, params):
    return jnp.sum(like.residuals(params) ** 2)


@jax.jit
def _value_and_gradient(like, theta):
    return jax.value_and_grad(lambda t: like.total(t[like.cells()]) / 2)(theta)


@jax.jit
def _cell_derivatives(like, theta) -> Derivatives:
    return like.derivatives(theta[like.cells()])


def _summed(function: Callable, like: Likelihood, theta: Numeric) -> Any:
    """Return the sum over the pieces of a likelihood of a function that is additive."""
    parts = (function(piece, theta) for piece in like.pieces())
    return reduce(partial(jax.tree.map, operator.add), parts)


def value_and_gradient(
    like: Likelihood, theta: Float[Array | np.ndarray, " par"]
) -> tuple[Float[np.ndarray, ""], Float[np.ndarray, " par"]]:
    """Return -ln L and its gradient."""
    return _summed(_value_and_gradient, like, theta)


def hessian(like: Likelihood, params: Mapping[str, Numeric]) -> Float[np.ndarray, "par par"]:
    """Return second derivatives of -ln L in all parameters, regions one after the other."""
    return _dense("hessian", like, params)


def fisher_matrix(like: Likelihood, params: Mapping[str, Numeric]) -> Float[np.ndarray, "par par"]:
    """Return the Fisher matrix of the parameters, amplitudes marginalised at their best values.

    sum_p s^T A_i^T [N^-1 - N^-1 A (A^T N^-1 A)^-1 A^T N^-1] A_j s with A_i the derivative of the
    mixing matrix (Errard, Stivoli & Stompor 2011, PRD 84, 063005).
    """
    return _dense("fisher", like, params)


def _dense(which, like, params):
    theta = like.flat(like.check(params))
    local = np.asarray(getattr(_summed(_cell_derivatives, like, theta), which))
    matrix = assembled(local, np.asarray(like.cells()), len(theta), np.zeros(len(theta)))
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


@jax.jit
def prior_terms(theta, priors):
    """Return -log density of priors, given as (prior, where it applies), and two derivatives."""
    value = jnp.zeros(())
    first, second = jnp.zeros_like(theta), jnp.zeros_like(theta)
    for prior, where in priors:
        slope = jax.grad(lambda v, p=prior: -p.log_density(v))
        one, two = jax.vmap(slope)(theta), jax.vmap(jax.grad(slope))(theta)
        value += jnp.sum(jnp.where(where, -jax.vmap(prior.log_density)(theta), 0.0))
        first, second = jnp.where(where, one, first), jnp.where(where, two, second)
    return value, first, second


def first_few(names: Sequence[str]) -> str:
    """Return the first six names, and the number of others, for messages."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if names[6:] else "")


class Density(NamedTuple):
    """The posterior of the parameters of regions with pixels, for compiled programs.

    `theta` is a vector of all parameters, and `present` the positions of these in it; `bounded` is
    True for those with a uniform prior, from `low` to `high`; the others have dummies there.
    """

    like: Likelihood
    priors: list[tuple[Prior, Array]]
    theta: Float[Array, " all"]
    present: Int[Array, " par"]
    bounded: Bool[Array, " par"]
    low: Float[Array, " par"]
    high: Float[Array, " par"]

    def full(self, values: Float[Array, " par"]) -> Float[Array, " all"]:
        """Return the vector of all parameters."""
        return self.theta.at[self.present].set(values)

    def log_prob(self, values: Float[Array, " par"]) -> Float[Array, ""]:
        """Return the log posterior within uniform priors, without constants."""
        theta = self.full(values)
        value = prior_terms(theta, self.priors)[0]
        return -self.like.total(theta[self.like.cells()]) / 2 - value


class Posterior:
    """The -log posterior as a function of the vector of parameters, within bounds.

    `names` has the name of each parameter, `labels` name and region if there are several
    ("dust.beta_dust[3]"); `present` is true for regions with pixels; `low` and `high` are bounds
    from uniform priors, and `priors` are the other priors, with the parameters that they apply to.
    """

    def __init__(self, like: Likelihood, priors: Mapping[str, Prior] | None) -> None:
        self.like = like
        self.start = np.array(like.flat({}))
        #: The last vector at which derivatives were computed, and these.
        self._last: tuple[bytes, Derivatives] | None = None
        self.owner = np.repeat(np.arange(len(like.free)), [like.start[n].size for n in like.free])
        self.names = tuple(like.free[i] for i in self.owner)
        self.labels = tuple(
            f"{name}[{k}]" if like.start[name].ndim else name
            for name in like.free
            for k in range(like.start[name].size)
        )
        self.index = np.asarray(like.cells())
        self.present = np.zeros(len(self.owner), bool)
        self.present[self.index] = True
        self.low, self.high = np.full((2, len(self.owner)), [[-np.inf], [np.inf]])
        self.priors: list[tuple[Prior, Array]] = []
        for name, prior in check_priors(priors, like.free).items():
            own = self.owner == like.free.index(name)
            if not isinstance(prior, Uniform):
                self.priors.append((prior, jnp.asarray(self.present & own)))
                continue
            self.low[own], self.high[own] = prior.low, prior.high
            outside = own & ~((prior.low < self.start) & (self.start < prior.high))
            if outside.any():
                raise ValueError(
                    f"Start value {self.start[outside][0]:g} of {name!r} is not inside its uniform "
                    f"prior {prior.low:g} ... {prior.high:g}."
                )

    def named(self, theta: Float[np.ndarray, " par"]) -> dict[str, Any]:
        """Return values by name, numbers or arrays; NaN for regions without pixels."""
        shaped = self.like.named(jnp.asarray(np.where(self.present, theta, np.nan)))
        return {name: np.asarray(v) if v.ndim else float(v) for name, v in shaped.items()}

    def where(self, bad: Bool[np.ndarray, " par"]) -> str:
        """Return names of parameters, with numbers of regions and pixels, for messages."""
        of_cell = np.zeros(len(self.index), int)
        if (of_pixel := getattr(self.like, "of_pixel", None)) is not None:
            of_cell = np.asarray(counted(of_pixel, number=len(self.index)))
        pixels = np.zeros(len(self.owner), int)
        np.add.at(pixels, self.index, of_cell[:, None])
        named = []
        for i, name in enumerate(self.like.free):
            own = self.present & (self.owner == i)
            if not (bad & own).any():
                continue
            if self.like.start[name].ndim:
                counts = f"{(bad & own).sum()} of {own.sum()} regions"
                name += f" in {counts} ({pixels[bad & own].sum()} of {pixels[own].sum()} pixels)"
            named.append(name)
        return first_few(named)

    def density(self, theta: np.ndarray) -> Density:
        """Return the posterior for compiled programs, with a vector of all parameters."""
        present = np.flatnonzero(self.present)
        low, high = self.low[present], self.high[present]
        bounded = np.isfinite(low)
        limits = (bounded, np.where(bounded, low, 0.0), np.where(bounded, high, 1.0))
        return Density(self.like, self.priors, *map(jnp.asarray, (theta, present, *limits)))

    def derivatives(self, theta: np.ndarray) -> Derivatives:
        """Return -ln L of each cell and its derivatives as numpy arrays, without priors."""
        key = theta.tobytes()
        if self._last is None or self._last[0] != key:
            found = _summed(_cell_derivatives, self.like, jnp.asarray(theta))
            self._last = (key, jax.tree.map(np.asarray, found))
        return self._last[1]

    def value(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Return -log posterior and its gradient."""
        cells = self.derivatives(theta)
        value, gradient = float(np.sum(cells.value)), np.zeros(len(theta))
        np.add.at(gradient, self.index, cells.gradient)
        if self.priors:
            prior, slope, _ = prior_terms(theta, self.priors)
            value, gradient = value + float(prior), gradient + np.asarray(slope)
        return value, gradient

    def curvature(
        self, theta: np.ndarray, local: Array | np.ndarray, keep: np.ndarray | None = None
    ) -> Matrix:
        """Assemble the matrix of all parameters, or those to keep, from cells and priors."""
        diagonal = np.zeros(len(theta))
        if self.priors:
            diagonal = np.asarray(prior_terms(theta, self.priors)[2])
        matrix = assembled(np.asarray(local), self.index, len(theta), diagonal)
        return matrix if keep is None else matrix[np.ix_(keep, keep)]

    def convex(self, theta: np.ndarray) -> np.ndarray:
        """Return second derivatives of each cell, or its Fisher matrix if not positive."""
        exact = np.asarray(self.derivatives(theta).hessian)
        usable = np.isfinite(exact).all(axis=(1, 2))
        safe = np.where(usable[:, None, None], exact, 0)
        diagonal = np.einsum("cii->ci", safe)
        usable &= (diagonal > 0).all(axis=1)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        usable &= np.linalg.eigvalsh(safe * scale[:, None] * scale[:, :, None])[:, 0] > 0
        return np.where(usable[:, None, None], exact, self.derivatives(theta).fisher)

    def reach(self) -> Float[np.ndarray, " par"]:
        """Return the longest step of each parameter: far beyond its prior lie other optima."""
        width = (self.high - self.low) / 4
        for prior, where in self.priors:
            if isinstance(prior, Gaussian):
                width = np.where(where, 2 * prior.sigma, width)
        return width

    def edges(self, theta: np.ndarray) -> Bool[np.ndarray, " par"]:
        """Return True for parameters that lie at an edge of their uniform prior."""
        near = np.minimum(np.abs(theta - self.low), np.abs(theta - self.high))
        return self.present & (near < EDGE * (self.high - self.low))
