"""Coefficients as real numbers: their order, their spectra, and healpy's complex ones.

For each m the a_lm of l = m ... lmax, real and imaginary part times sqrt(2) for m > 0, so that
the sum of squares of the packed numbers is the sum over all m of |a_lm|^2.
"""

import math
from functools import partial

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float


def alm_ell(lmax: int) -> np.ndarray:
    """Multipole l of each packed coefficient, shape (alm,)."""
    ell, m = healpy.Alm.getlm(lmax)
    return np.concatenate([ell[m == 0], np.repeat(ell[m > 0], 2)])


def degrees(lmax: int) -> tuple[Array, Array, Array]:
    """l, m and part (0 real, 1 imaginary) of each packed coefficient, computed in the program.

    As a constant of a program they would be as large as the coefficients.
    """
    i = jnp.arange((lmax + 1) ** 2)
    pair, part = jnp.divmod(jnp.maximum(i - (lmax + 1), 0), 2)
    # Counted from the end, m = lmax has one pair, lmax - 1 two, ...: triangular numbers.
    back = lmax * (lmax + 1) // 2 - 1 - pair
    length = jnp.floor((1 + jnp.sqrt(1.0 + 8 * back)) / 2).astype(i.dtype)
    ell = lmax - (back - length * (length - 1) // 2)
    zonal = i <= lmax
    return jnp.where(zonal, i, ell), jnp.where(zonal, 0, lmax + 1 - length), part


def lmax_of(alm: Array | np.ndarray) -> int:
    """Largest multipole of packed coefficients."""
    return math.isqrt(alm.shape[-1]) - 1


@jax.jit
def expand(values: Float[Array, "... ell"]) -> Float[Array, "... alm"]:
    """A function of l = 0 ... lmax at each packed coefficient."""
    return values[..., degrees(values.shape[-1] - 1)[0]]


@partial(jax.jit, static_argnames="lmax")
def resize(alm: Float[Array, "... alm"], lmax: int) -> Float[Array, "... alm"]:
    """Packed coefficients cut at another lmax, or filled up with zeros."""
    own = lmax_of(alm)
    ell, m, part = degrees(lmax)
    pairs = (m - 1) * (own + 1) - m * (m - 1) // 2 + ell - m
    index = jnp.where(m == 0, ell, own + 1 + 2 * pairs + part)
    return jnp.where(ell <= own, alm[..., jnp.where(ell <= own, index, 0)], 0)


@jax.jit
def power_spectrum(
    alm: Float[Array, "... alm"], other: Float[Array, "... alm"] | None = None
) -> Float[Array, "... ell"]:
    """Spectrum C_l of packed coefficients, or the cross-spectrum with others, row by row."""
    lmax = lmax_of(alm)
    product = (alm * (alm if other is None else other)).reshape(-1, alm.shape[-1])
    ell = degrees(lmax)[0]
    sums = jax.vmap(lambda row: jnp.zeros(lmax + 1, row.dtype).at[ell].add(row))(product)
    return sums.reshape(*alm.shape[:-1], -1) / (2 * jnp.arange(lmax + 1) + 1)


def map_variance(spectrum: Float[Array | np.ndarray, " ell"]) -> float:
    """Variance of a pixel of maps that have a spectrum."""
    return float(np.sum((2 * np.arange(spectrum.size) + 1) * np.asarray(spectrum)) / (4 * np.pi))


def alm_from_healpy(alm: np.ndarray, lmax: int) -> Float[np.ndarray, "... alm"]:
    """healpy's complex coefficients as packed real ones, along the last axis."""
    alm = np.asarray(alm, dtype=complex)
    high = np.sqrt(2) * alm[..., lmax + 1 :]
    pairs = np.stack([high.real, high.imag], axis=-1).reshape(*alm.shape[:-1], -1)
    return np.concatenate([alm[..., : lmax + 1].real, pairs], axis=-1)


def alm_to_healpy(alm: ArrayLike, lmax: int) -> np.ndarray:
    """Packed real coefficients as healpy's complex ones, along the last axis."""
    alm = np.asarray(alm, dtype=float)
    pairs = alm[..., lmax + 1 :] / np.sqrt(2)
    return np.concatenate([alm[..., : lmax + 1], pairs[..., ::2] + 1j * pairs[..., 1::2]], axis=-1)
