"""Chebyshev interpolation of smooth functions of a few variables, as fast array code."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def nodes(n: int) -> Float[np.ndarray, " n"]:
    """The n Chebyshev points of the first kind in (-1, 1)."""
    return np.polynomial.chebyshev.chebpts1(n)


def coefficients(values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Chebyshev coefficients of the tensor of values at the nodes, along every axis."""
    for axis, n in enumerate(values.shape):
        inverse = np.polynomial.chebyshev.chebvander(nodes(n), n - 1).T * 2 / n
        inverse[0] /= 2
        moved = jnp.tensordot(jnp.asarray(inverse, values.dtype), values, axes=(1, axis))
        values = jnp.moveaxis(moved, 0, axis)
    return values


def polynomials(n: int, point: Float[Array, "..."]) -> Float[Array, "n ..."]:
    """The first n Chebyshev polynomials at points in [-1, 1]."""
    rows = [jnp.ones_like(point), point]
    for _ in range(n - 2):
        rows.append(2 * point * rows[-1] - rows[-2])
    return jnp.stack(rows[:n])


def evaluate(coefs: Float[Array, "..."], *points: Float[Array, " pix"]) -> Float[Array, " pix"]:
    """The series at points in [-1, 1]^d (one array a dimension), by Clenshaw's recurrence.

    The loops are unrolled: the node counts are small and the whole becomes one fused pass.
    """
    if not points:
        return coefs
    t, *rest = points
    terms = [evaluate(c, *rest) for c in coefs]
    if len(terms) == 1:
        return terms[0] * jnp.ones_like(t)
    high, higher = terms[-1], jnp.zeros_like(t)
    for term in terms[-2:0:-1]:
        high, higher = 2 * t * high - higher + term, high
    return t * high - higher + terms[0]
