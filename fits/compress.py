"""Reduction of maps to the inner products that a template fit needs.

With spectral parameters that do not vary over a region, a model is a sum of templates with
coefficients, so chi^2 is a quadratic form in the coefficients. Its matrix, the inner products of
data, templates and a constant, is formed once in one pass over the pixels; afterwards nothing
depends on the number of pixels. The products add up over pixels: over chunks, files or machines.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

#: Pixels per pass; small enough that the weighted copies stay in cache.
CHUNK = 1 << 14


@partial(jax.jit, static_argnames="chunk")
def gram(
    data: Float[Array, "band stokes pix"],
    templates: Float[Array, "template stokes pix"],
    weights: Float[Array, "band stokes pix"],
    chunk: int = CHUNK,
) -> Float[Array, "band stokes row row"]:
    """Weighted inner products of (data, templates, 1), for each band and Stokes parameter.

    Parameters
    ----------
    data : observed maps
    templates : maps that the model is a combination of
    weights : 1/sigma^2, zero where masked; broadcasts against the data
    chunk : pixels per pass

    Returns
    -------
    Symmetric matrices with rows data, template 0 ... K-1, constant. Results for disjoint sets
    of pixels add up to that of their union.
    """
    bands, stokes, npix = data.shape
    weights = jnp.broadcast_to(weights, data.shape)
    size = len(templates) + 2

    def products(d, t, w):
        t = jnp.broadcast_to(t, (bands, *t.shape)).swapaxes(1, 2)
        rows = jnp.concatenate([d[:, :, None], t, jnp.ones_like(d)[:, :, None]], axis=2)
        # A masked pixel may hold anything, NaN among it.
        rows = jnp.where(w[:, :, None] > 0, rows, 0)
        return jnp.einsum("bsip,bsp,bsjp->bsij", rows, w, rows)

    chunk = min(chunk, npix)
    whole = npix // chunk * chunk

    def add(total, start):
        def cut(x):
            return jax.lax.dynamic_slice_in_dim(x, start, chunk, axis=-1)

        return total + products(cut(data), cut(templates), cut(weights)), None

    total = products(data[..., whole:], templates[..., whole:], weights[..., whole:])
    total = total + jnp.zeros((bands, stokes, size, size), total.dtype)
    return jax.lax.scan(add, total, jnp.arange(0, whole, chunk))[0]


@jax.jit
def square_root(matrix: Float[Array, "... row row"]) -> Float[Array, "... row row"]:
    """R with R^T R = G for symmetric positive semi-definite G, singular ones included.

    Rows and columns are scaled to a unit diagonal first, so that maps in different units do not
    cost accuracy.
    """
    diagonal = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    scale = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    values, vectors = jnp.linalg.eigh(matrix / scale[..., :, None] / scale[..., None, :])
    root = jnp.sqrt(jnp.maximum(values, 0.0))[..., :, None] * jnp.swapaxes(vectors, -1, -2)
    return root * scale[..., None, :]
