"""Gaussian fields with given auto- and cross-spectra, after Brown & Battye (2011)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsky.harmonics import expand
from jaxsky.keys import normal
from jaxsky.noise import cholesky

#: Smallest eigenvalue that a repaired matrix of correlations keeps.
LEAST = 1e-10


@jax.custom_jvp
def _positive(
    matrix: Float[Array, "ell field field"],
) -> tuple[Float[Array, "ell field field"], Float[Array, " ell"]]:
    """Symmetric matrices with eigenvalues of at least `LEAST`, and the smallest that they had."""
    values, vectors = jnp.linalg.eigh(matrix)
    kept = jnp.maximum(values, LEAST)
    return (vectors * kept[:, None]) @ vectors.mT, values[:, 0]


@_positive.defjvp
def _positive_jvp(primals, tangents):
    """Derivative of a function of a matrix (Daleckii & Krein): no eigenvectors to differentiate.

    Those have no derivative where eigenvalues coincide, as without correlations they all do.
    """
    values, vectors = jnp.linalg.eigh(primals[0])
    kept = jnp.maximum(values, LEAST)
    above = values > LEAST
    both, one = above[:, :, None] & above[:, None], above[:, :, None] != above[:, None]
    gap = jnp.where(one, values[:, :, None] - values[:, None], 1.0)
    slope = jnp.where(one, (kept[:, :, None] - kept[:, None]) / gap, both)
    turned = vectors.mT @ tangents[0] @ vectors
    return (
        ((vectors * kept[:, None]) @ vectors.mT, values[:, 0]),
        (vectors @ (slope * turned) @ vectors.mT, turned[:, 0, 0]),
    )


@jax.jit
def repair(
    spectra: Float[Array, "field field ell"],
) -> tuple[Float[Array, "field field ell"], Int[Array, ""]]:
    """Spectra whose matrix at each multipole is positive semi-definite, and how many were not.

    Extrapolated cross-spectra may exceed what the auto-spectra allow. Such a matrix keeps its
    auto-spectra; of its correlation coefficients the negative eigenvalues are set to zero and
    the diagonal is scaled back to one. No multipole is left out. Differentiable in the spectra.

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
    mended, least = _positive(matrix.transpose(2, 0, 1))
    norm = jnp.sqrt(jnp.einsum("lii->li", mended))
    mended = (mended / (norm[:, :, None] * norm[:, None])).transpose(1, 2, 0)
    matrix = jnp.where(least < LEAST, mended, matrix)
    # A field without power has no correlations.
    matrix = jnp.where(there, matrix, 0.0)
    return matrix * scale[:, None] * scale[None], jnp.sum(least < -LEAST)


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
    white = normal(key, (n, (lmax + 1) ** 2), spectra.dtype)
    return jnp.stack([sum(expand(lower[i, j]) * white[j] for j in range(i + 1)) for i in range(n)])
