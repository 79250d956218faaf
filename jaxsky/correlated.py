"""Gaussian fields with given auto- and cross-spectra, after Brown & Battye (2011)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsky.harmonics import expand
from jaxsky.noise import cholesky

__all__ = ["realisation", "repair"]

#: Smallest eigenvalue that a repaired matrix of correlations keeps.
LEAST = 1e-10


@jax.jit
def repair(
    spectra: Float[Array, "field field ell"],
) -> tuple[Float[Array, "field field ell"], Int[Array, ""]]:
    """Spectra whose matrix at each multipole is positive semi-definite, and how many were not.

    Extrapolated cross-spectra may exceed what the auto-spectra allow. Such a matrix keeps its
    auto-spectra; of its correlation coefficients the negative eigenvalues are set to zero and
    the diagonal is scaled back to one. No multipole is left out. Gradients pass through as if
    nothing had been repaired.

    Parameters
    ----------
    spectra : auto- and cross-spectra C_l of each pair of fields, symmetric

    Returns
    -------
    The spectra, and the number of multipoles that were repaired.
    """
    n = len(spectra)
    power = jnp.diagonal(spectra).T  # (field, ell)
    scale = jnp.sqrt(jnp.where(power > 0, power, 1.0))
    there = (power[:, None] > 0) & (power[None] > 0)
    ones = jnp.eye(n, dtype=spectra.dtype)[..., None]
    matrix = jnp.where(there, spectra / (scale[:, None] * scale[None]), ones)
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(matrix.transpose(2, 0, 1)))
    indefinite = values[:, 0] < LEAST
    kept = jnp.maximum(values, LEAST)
    mended = jnp.einsum("lij,lj,lkj->ikl", vectors, kept, vectors)
    norm = jnp.sqrt(jnp.diagonal(mended).T)
    mended = mended / (norm[:, None] * norm[None])
    matrix = matrix + jnp.where(indefinite, mended - jax.lax.stop_gradient(matrix), 0.0)
    # A field without power has no correlations.
    matrix = jnp.where(there, matrix, 0.0)
    return matrix * scale[:, None] * scale[None], jnp.sum(values[:, 0] < -LEAST)


@jax.jit
def realisation(key: Array, spectra: Float[Array, "field field ell"]) -> Float[Array, "field alm"]:
    """Packed coefficients of Gaussian fields with given auto- and cross-spectra.

    Parameters
    ----------
    key : of jax.random
    spectra : C_l of each pair of fields, positive semi-definite at each l (see `repair`)
    """
    n, lmax = len(spectra), spectra.shape[-1] - 1
    lower = cholesky(spectra)
    white = jax.random.normal(key, (n, (lmax + 1) ** 2), spectra.dtype)
    return jnp.stack([sum(expand(lower[i, j]) * white[j] for j in range(i + 1)) for i in range(n)])
