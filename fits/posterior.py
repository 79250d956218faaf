"""The spectral posterior as a function of a vector, with derivatives of first and second order.

A cell depends on a few parameters only, so its second derivatives are a small matrix; those of
all parameters are put together from them.
"""

from collections.abc import Mapping
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from fits.amplitudes import Derivatives
from fits.priors import Gaussian, Prior, Uniform, at_edge, bounds
from fits.profile_likelihood import SpectralLikelihood
from fits.systems import assembled

#: Dense, or sparse for many parameters.
Matrix: TypeAlias = np.ndarray | scipy.sparse.csc_matrix


@jax.jit
def value_and_gradient(like, theta):
    """-ln L and its gradient."""
    return jax.value_and_grad(lambda t: like.total(t[like.index]) / 2)(theta)


@jax.jit
def cell_derivatives(like, theta) -> Derivatives:
    """-ln L of each cell and its derivatives in the parameters of the cell."""
    return like.derivatives(theta[like.index])


@jax.jit
def prior_terms(theta, priors):
    """-log density of priors, first and second derivative, for rows (prior, where it holds)."""
    value = jnp.zeros(())
    first, second = jnp.zeros_like(theta), jnp.zeros_like(theta)
    for prior, where in priors:
        slope = jax.grad(lambda v, p=prior: -p.log_density(v))
        one, two = jax.vmap(slope)(theta), jax.vmap(jax.grad(slope))(theta)
        value += jnp.sum(jnp.where(where, -jax.vmap(prior.log_density)(theta), 0.0))
        first, second = jnp.where(where, one, first), jnp.where(where, two, second)
    return value, first, second


class Problem:
    """-log posterior of the parameters that any cell has, within bounds.

    Parameters
    ----------
    like : the likelihood
    priors : priors by name, the same in each region; uniform ones are bounds

    Attributes
    ----------
    names, labels : of each parameter: its name, and name and region ("dust.beta_dust[3]")
    present : True for parameters of regions with pixels
    low, high : bounds of each parameter
    priors : the others, with the parameters that they are for
    """

    def __init__(self, like: SpectralLikelihood, priors: Mapping[str, Prior]) -> None:
        self.like = like
        #: The last vector that derivatives were asked for, and what they are.
        self._last: tuple[bytes, Derivatives] | None = None
        sizes = {name: like.start[name].size for name in like.free}
        self.owner = np.repeat(np.arange(len(sizes)), list(sizes.values()))
        self.names = tuple(like.free[i] for i in self.owner)
        self.index = np.asarray(like.index)
        self.present = np.zeros(len(self.owner), bool)
        self.present[self.index] = True
        limits = np.array([bounds(name, priors) for name in like.free]).reshape(-1, 2)
        self.low, self.high = limits[self.owner].T
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

    def where(self, bad: Bool[np.ndarray, " par"]) -> str:
        """Names of parameters, with the regions and pixels that they are of."""
        of_cell = np.zeros(len(self.index), int)
        if self.like.of_pixel is not None:
            of_pixel = np.asarray(self.like.of_pixel)
            of_cell = np.bincount(of_pixel[of_pixel >= 0], minlength=len(self.index))
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
        return ", ".join(named[:6]) + (f" and {len(named) - 6} more" if named[6:] else "")

    def derivatives(self, theta: np.ndarray) -> Derivatives:
        """-ln L of each cell and its derivatives, as arrays of numpy; priors left out."""
        key = theta.tobytes()
        if self._last is None or self._last[0] != key:
            found = cell_derivatives(self.like, jnp.asarray(theta))
            self._last = (key, jax.tree.map(np.asarray, found))
        return self._last[1]

    def value(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """The function and its gradient."""
        cells = self.derivatives(theta)
        value, gradient = float(np.sum(cells.value)), np.zeros(len(theta))
        np.add.at(gradient, self.index, cells.gradient)
        if self.priors:
            prior, slope, _ = prior_terms(theta, self.priors)
            value, gradient = value + float(prior), gradient + np.asarray(slope)
        return value, gradient

    def curvature(
        self, theta: np.ndarray, local: np.ndarray, keep: np.ndarray | None = None
    ) -> Matrix:
        """The matrix of all parameters, or those to keep, from those of the cells and priors."""
        diagonal = np.zeros(len(theta))
        if self.priors:
            diagonal = np.asarray(prior_terms(theta, self.priors)[2])
        matrix = assembled(local, self.index, len(theta), diagonal)
        if keep is None:
            return matrix
        return (
            matrix[np.ix_(keep, keep)] if isinstance(matrix, np.ndarray) else matrix[keep][:, keep]
        )

    def exact(self, theta: np.ndarray) -> np.ndarray:
        """Second derivatives of -ln L in each cell."""
        return np.asarray(self.derivatives(theta).hessian)

    def convex(self, theta: np.ndarray, exact: np.ndarray) -> np.ndarray:
        """Matrices of cells, those that are not positive replaced by Fisher matrices."""
        usable = np.isfinite(exact).all(axis=(1, 2))
        safe = np.where(usable[:, None, None], exact, 0)
        diagonal = np.einsum("cii->ci", safe)
        usable &= (diagonal > 0).all(axis=1)
        scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        usable &= np.linalg.eigvalsh(safe * scale[:, None] * scale[:, :, None])[:, 0] > 0
        return np.where(usable[:, None, None], exact, self.derivatives(theta).fisher)

    def reach(self) -> Float[np.ndarray, " par"]:
        """The longest step of each parameter: beyond what its prior says lie other optima."""
        width = np.where(np.isfinite(self.high), self.high - self.low, np.inf) / 4
        for prior, where in self.priors:
            if isinstance(prior, Gaussian):
                width = np.where(where, 2 * prior.sigma, width)
        return width

    def edges(self, theta: np.ndarray) -> Bool[np.ndarray, " par"]:
        """Parameters that lie at an edge of their uniform prior."""
        return self.present & at_edge(theta, self.low, self.high)
