"""The quasi-likelihood of a power law in a few bands, whose variance follows the law.

The equations that A and alpha solve are linear in the powers: their mean is zero at the true
values, whatever the distribution of the powers (Wedderburn 1974). For one band without noise that
is the likelihood of a chi^2-distributed power.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Float

PIVOT = 80.0
#: The root of the variance of a power never falls below this part of what it is expected to be:
#: where a law predicts nothing in a band, that band alone would decide.
FLOOR = 0.3


def law(ell: ArrayLike, ends: tuple[int, int], mean: ArrayLike, alpha: ArrayLike) -> Array:
    """D_l for A = 1; beyond the bins, where nothing is measured, it goes on with the mean slope."""
    inside = jnp.clip(ell, *ends)
    return (inside / PIVOT) ** (alpha + 2) * (jnp.maximum(ell, 2) / inside) ** (mean + 2)


def decorrelate(
    covariance: Float[np.ndarray, "... bin bin"], expected: Float[np.ndarray, "... bin"]
) -> Float[np.ndarray, "... bin bin"]:
    """Symmetric combinations of bands without correlation, with the expected powers as they are.

    The inverse root of the covariance, after Hamilton & Tegmark (2000). Bands are left alone where
    it would have to be multiplied by negative numbers.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors / np.sqrt(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    sums = np.einsum("...bc,...c->...b", root, expected)
    good = (sums / expected > 0).all(axis=-1)[..., None, None]
    with np.errstate(divide="ignore"):
        return np.where(good, root * (expected / sums)[..., None], np.eye(root.shape[-1]))


class Bands(NamedTuple):
    """Combinations d of bands with variance (2 / nu) ((d + offset)^2 + width^2)."""

    data: Float[Array, "... bin"]
    nu: Float[Array, "... bin"]
    offset: Float[Array, "... bin"]
    width: Float[Array, "... bin"]
    laws: Float[Array, "... bin ell"]  # d of D_l


def variances(
    form: Float[np.ndarray, "patch bin x x"],
    amplitudes: Float[np.ndarray, "patch x"],
    seen: Float[np.ndarray, "patch bin"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """nu, offset and width (`Bands`) of one field, with the amplitudes of all others as given.

    Parameters
    ----------
    form : variances of d as a quadratic form of the amplitudes, that of the field first
    amplitudes : of all fields
    seen : d for an amplitude of 1
    """
    rest = amplitudes[:, 1:]
    square = form[..., 0, 0]
    offset = np.einsum("pbx,px->pb", form[..., 0, 1:], rest) / square * seen
    constant = np.einsum("pbxy,px,py->pb", form[..., 1:, 1:], rest, rest) / square * seen**2
    least = FLOOR * (offset + amplitudes[:, :1] * seen)
    return 2 * seen**2 / square, offset, np.sqrt(np.maximum(constant - offset**2, least**2))


def sandwich(
    derivatives: Float[np.ndarray, "... bin 2"],
    variance: Float[np.ndarray, "... bin"],
    covariance: Float[np.ndarray, "... bin bin"],
    spread: float,
) -> Float[np.ndarray, "... 2 2"]:
    """Covariance of what solves G^T V^-1 (data - model) = 0, with a prior of the second number.

    Parameters
    ----------
    derivatives : G, of the model by the two numbers
    variance : V, that the equations were weighted with
    covariance : of the data
    spread : standard deviation of the prior
    """
    prior = np.diag([0, spread**-2])
    weights = np.swapaxes(derivatives / variance[..., None], -1, -2)
    inverse = np.linalg.inv(weights @ derivatives + prior)
    return inverse @ (weights @ covariance @ np.swapaxes(weights, -1, -2) + prior) @ inverse


def _model(theta, bands, slope, ends):
    """d for A and for alpha in standard deviations of its prior."""
    ell = jnp.arange(bands.laws.shape[-1])
    return theta[0] * (bands.laws @ law(ell, ends, slope[0], slope[0] + slope[1] * theta[1]))


@partial(jax.jit, static_argnames="ends")
def minimise(bands: Bands, slope: Array, ends: tuple[int, int]) -> tuple[Array, ...]:
    """The fit to each row of bands.

    Parameters
    ----------
    bands : powers of order one
    slope : mean and standard deviation of the prior of alpha
    ends : first and last multipole of the bins

    Returns
    -------
    A and alpha, the best A with the mean slope, d, its derivative by alpha for A = 1 and the mean
    slope, and whether a minimum was found.
    """
    solver: optx.AbstractMinimiser = optx.BFGS(1e-8, 1e-8)

    def deviance(theta, row):
        """-2 ln of the quasi-likelihood, 2 int (d - data) / variance dd, and of the prior."""
        power = _model(theta, row, slope, ends) + row.offset
        terms = jnp.log(power**2 + row.width**2) / 2
        terms = terms - (row.data + row.offset) / row.width * jnp.arctan(power / row.width)
        return jnp.sum(row.nu * terms) + theta[1] ** 2

    def minimum(function, start, row):
        found: optx.Solution = optx.minimise(
            function, solver, start, args=row, max_steps=500, throw=False
        )
        good = jnp.isfinite(function(found.value, row))
        return jnp.where(good, found.value, start), good & (found.result == optx.RESULTS.successful)

    def fit(row):
        flat, zero = jnp.mean(row.data), jnp.zeros(())
        level, _ = minimum(lambda A, row: deviance(jnp.stack([A, zero]), row), flat, row)
        theta, good = minimum(deviance, jnp.stack([level, zero]), row)
        slopes = jax.jacfwd(_model)(jnp.array([1.0, 0.0]), row, slope, ends)[:, 1] / slope[1]
        alpha = slope[0] + slope[1] * theta[1]
        return theta[0], alpha, level, _model(theta, row, slope, ends), slopes, good

    return jax.vmap(fit)(bands)
