"""Amplitudes of components in many pixels at once, and what they leave of the data.

In each pixel d = M s + n, with M the same for all pixels of a call, and inverse noise covariance
W. Generalised least squares gives s = (M^T W M)^-1 M^T W d (Stompor et al. 2009) and leaves
chi^2 = r^T W r with r = d - M s. Sums over bands are products of matrices; the small systems are
factorised element by element, each element an array over pixels.

chi^2 has a closed derivative: s is where it is stationary, so only explicit dependences count.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float


class Pixels(NamedTuple):
    """Data in pixels that are treated in the same way.

    Rows are bands, or Q of each band and then U of each band. Weights are the inverse variance of
    the noise, or the diagonal of its inverse covariance, and `cross` is the element QU of that.
    """

    data: Float[Array, "*batch group row pix"]
    weights: Float[Array, "*batch group row #pix"]
    cross: Float[Array, "*batch group band #pix"] | None = None


def _weighted(pixels: Pixels, maps: Array) -> Array:
    """W times maps (group, row, pix)."""
    result = pixels.weights * maps
    if pixels.cross is None:
        return result
    half = maps.shape[1] // 2
    return result + jnp.concatenate(
        [pixels.cross * maps[:, half:], pixels.cross * maps[:, :half]], axis=1
    )


def _gram(mixing: Float[Array, "row unknown"], pixels: Pixels) -> list[list[Array]]:
    """Lower triangle of M^T W M, each element an array (group, pix)."""
    size = mixing.shape[1]
    i, j = np.tril_indices(size)
    products = mixing[:, i] * mixing[:, j]
    elements = jnp.einsum("rq,krn->qkn", products, pixels.weights)
    if pixels.cross is not None:
        half = len(mixing) // 2
        Q, U = mixing[:half], mixing[half:]
        products = Q[:, i] * U[:, j] + U[:, i] * Q[:, j]
        elements = elements + jnp.einsum("bq,kbn->qkn", products, pixels.cross)
    rows = iter(elements)
    return [[next(rows) for _ in range(i + 1)] for i in range(size)]


def _cholesky(matrix: list[list[Array]]) -> list[list[Array]]:
    """Lower factor with the inverses of its diagonal on the diagonal."""
    lower: list[list[Array]] = []
    for i, row in enumerate(matrix):
        lower.append([])
        for j in range(i + 1):
            rest = row[j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            lower[i].append(jax.lax.rsqrt(rest) if i == j else rest * lower[j][j])
    return lower


def _back_substituted(lower: list[list[Array]], right: Array) -> Array:
    """The solution x of L L^T x = right (group, unknown, pix)."""
    size = len(lower)
    y: list[Array] = []
    for i in range(size):
        y.append((right[:, i] - sum(lower[i][k] * y[k] for k in range(i))) * lower[i][i])
    x: list[Any] = [None] * size
    for i in reversed(range(size)):
        x[i] = (y[i] - sum(lower[k][i] * x[k] for k in range(i + 1, size))) * lower[i][i]
    return jnp.stack(x, axis=1)


def _projected(mixing: Array, maps: Array) -> Array:
    """M^T times maps (group, row, pix)."""
    return jnp.einsum("ru,krn->kun", mixing, maps)


def _model(mixing: Array, amplitudes: Array) -> Array:
    return jnp.einsum("ru,kun->krn", mixing, amplitudes)


def _solved(mixing: Array, pixels: Pixels, right: Array) -> tuple[Array, list[list[Array]]]:
    """The solution of M^T W M x = right (group, unknown, pix), and the factors of the matrix."""
    lower = _cholesky(_gram(mixing, pixels))
    return _back_substituted(lower, right), lower


def _along(function, primals, tangents):
    """The derivative of a function along tangents, of which those that are zero cost nothing."""
    leaves, structure = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents, is_leaf=lambda x: isinstance(x, SymbolicZero))
    moving = [i for i, slope in enumerate(slopes) if not isinstance(slope, SymbolicZero)]

    def moved(*values):
        given = dict(enumerate(leaves)) | dict(zip(moving, values, strict=True))
        return function(*jax.tree.unflatten(structure, list(given.values())))

    return jax.jvp(moved, [leaves[i] for i in moving], [slopes[i] for i in moving])[1]


@jax.custom_jvp
def solve(mixing: Float[Array, "row unknown"], pixels: Pixels) -> Float[Array, "group unknown pix"]:
    """Amplitudes s = (M^T W M)^-1 M^T W d; NaN where a system is singular."""
    return _solved(mixing, pixels, _projected(mixing, _weighted(pixels, pixels.data)))[0]


def _solve_jvp(primals, tangents):
    """From M^T W (d - M s) = 0: one more solution, and no derivative of the factors."""
    mixing, pixels = primals
    right = _projected(mixing, _weighted(pixels, pixels.data))
    amplitudes, lower = _solved(mixing, pixels, right)

    def zero(mixing, pixels):
        return _projected(mixing, _weighted(pixels, pixels.data - _model(mixing, amplitudes)))

    return amplitudes, _back_substituted(lower, _along(zero, primals, tangents))


solve.defjvp(_solve_jvp, symbolic_zeros=True)


def inverse_gram(
    mixing: Float[Array, "row unknown"], pixels: Pixels
) -> Float[Array, "group unknown unknown pix"]:
    """Covariance (M^T W M)^-1 of the amplitudes; one pixel if the weights are uniform."""
    lower = _cholesky(_gram(mixing, pixels))
    size, one = len(lower), jnp.ones_like(lower[0][0])[:, None]
    units = jnp.eye(size)[:, :, None]
    columns = [_back_substituted(lower, one * unit) for unit in units]
    return jnp.stack(columns, axis=2)


def residuals(mixing: Float[Array, "row unknown"], pixels: Pixels) -> Float[Array, "group row pix"]:
    """Whitened residuals: their sum of squares is chi^2."""
    rest = pixels.data - _model(mixing, solve(mixing, pixels))
    if pixels.cross is None:
        return jnp.sqrt(pixels.weights) * rest
    half = rest.shape[1] // 2
    QQ, UU = pixels.weights[:, :half], pixels.weights[:, half:]
    root = jnp.sqrt(QQ)
    first = root * rest[:, :half] + pixels.cross / root * rest[:, half:]
    second = jnp.sqrt(UU - pixels.cross**2 / QQ) * rest[:, half:]
    return jnp.concatenate([first, second], axis=1)


def explained(
    mixing: Float[Array, "row unknown"], pixels: Pixels
) -> tuple[Float[Array, "group unknown pix"], Float[Array, " pix"]]:
    """Amplitudes, and chi^2 of each pixel."""
    amplitudes, rest, weighted = _parts(mixing, pixels)
    return amplitudes, jnp.sum(rest * weighted, axis=(0, 1))


class Derivatives(NamedTuple):
    """-ln L and its derivatives in the parameters that a mixing matrix depends on.

    `fisher` has second derivatives for data that are what the parameters predict: the Fisher
    matrix of the fitted amplitudes, positive semi-definite.
    """

    value: Float[Array, "*batch"]
    gradient: Float[Array, "*batch free"]
    hessian: Float[Array, "*batch free free"]
    fisher: Float[Array, "*batch free free"]


def derivatives(
    mixing: Float[Array, "row unknown"],
    first: Float[Array, "free row unknown"],
    second: Float[Array, "free free row unknown"],
    pixels: Pixels,
) -> Derivatives:
    """chi^2 / 2 and its derivatives in closed form, from one factorisation.

    With A the matrix, A_i its derivatives, G = A^T W A, amplitudes s, residuals r, B_i = A_i s and
    D_i = A_i^T W r - A^T W B_i,

        gradient_i = -r^T W B_i
        fisher_ij = B_i^T W B_j - (A^T W B_i)^T G^-1 (A^T W B_j)
        hessian_ij = B_i^T W B_j - r^T W A_ij s - D_i^T G^-1 D_j.
    """
    right = _projected(mixing, _weighted(pixels, pixels.data))
    amplitudes, lower = _solved(mixing, pixels, right)
    rest = pixels.data - _model(mixing, amplitudes)
    weighted = _weighted(pixels, rest)
    moved = jax.vmap(lambda m: _model(m, amplitudes))(first)
    weighted_moved = jax.vmap(lambda maps: _weighted(pixels, maps))(moved)
    along = jax.vmap(lambda maps: _projected(mixing, maps))(weighted_moved)
    across = jax.vmap(lambda m: _projected(m, weighted))(first) - along
    squares = jnp.einsum("ikrn,jkrn->ij", moved, weighted_moved)
    # Products of residuals and amplitudes, summed over pixels once for both orders.
    products = jnp.einsum("krn,kun->ru", weighted, amplitudes)

    def inner(x):
        return jnp.einsum("ikun,jkun->ij", x, jax.vmap(lambda y: _back_substituted(lower, y))(x))

    return Derivatives(
        jnp.sum(rest * weighted) / 2,
        -jnp.einsum("ru,iru->i", products, first),
        squares - jnp.einsum("ru,ijru->ij", products, second) - inner(across),
        squares - inner(along),
    )


def _parts(mixing, pixels):
    """Amplitudes, residuals and weighted residuals."""
    amplitudes = solve(mixing, pixels)
    rest = pixels.data - _model(mixing, amplitudes)
    return amplitudes, rest, _weighted(pixels, rest)


@jax.custom_jvp
def least_chi2(mixing: Float[Array, "row unknown"], pixels: Pixels) -> Float[Array, ""]:
    """Sum over pixels of r^T W r = d^T W d - (M^T W d)^T (M^T W M)^-1 (M^T W d).

    Formed from the residuals, so nothing cancels where signals are far above the noise.
    """
    _, rest, weighted = _parts(mixing, pixels)
    return jnp.sum(rest * weighted)


def _chi2_jvp(primals, tangents):
    amplitudes, rest, weighted = _parts(*primals)

    def linear(mixing, pixels):
        """With the derivative of chi^2, in which amplitudes count as constant."""
        moved = pixels.data - _model(mixing, amplitudes)
        return 2 * jnp.sum(weighted * moved) + jnp.sum(rest * _weighted(pixels, rest))

    return jnp.sum(rest * weighted), _along(linear, primals, tangents)


least_chi2.defjvp(_chi2_jvp, symbolic_zeros=True)
