"""Linear systems: small ones in many pixels at once, and large ones of parameters in many cells.

In the small ones the unknowns are amplitudes of components. In each pixel d = M s + n, with M the
same for all pixels of a call, and inverse noise covariance W. Generalised least squares gives
s = (M^T W M)^-1 M^T W d (Stompor et al. 2009) and leaves chi^2 = r^T W r with r = d - M s. Sums
over bands are products of matrices; the small systems are factorised element by element, each
element an array over pixels. chi^2 has a derivative in closed form: it is stationary in s, so only
explicit dependences count.

The large ones are symmetric, and dense or sparse, since few of their parameters share a cell.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

#: Matrices up to this size are dense.
DENSE = 1500
#: Least eigenvalue of a matrix scaled to a unit diagonal whose parameters are not degenerate.
DEGENERATE = 1e-10
#: Columns solved at a time, and most columns for the variances of a sparse matrix.
COLUMNS, MOST = 64, 4096


class Pixels(NamedTuple):
    """Data in pixels that are treated in the same way.

    Rows are bands, or Q of each band and then U of each band. Weights are the inverse variance of
    the noise, or the diagonal of its inverse covariance, and `cross` is the QU element of that.
    """

    data: Float[Array, "*batch group row pix"]
    weights: Float[Array, "*batch group row #pix"]
    cross: Float[Array, "*batch group band #pix"] | None = None


def _weighted(pixels: Pixels, maps: Array) -> Array:
    """Return W times maps (group, row, pix)."""
    result = pixels.weights * maps
    if pixels.cross is None:
        return result
    half = maps.shape[1] // 2
    return result + jnp.concatenate(
        [pixels.cross * maps[:, half:], pixels.cross * maps[:, :half]], axis=1
    )


def _gram(mixing: Float[Array, "row unknown"], pixels: Pixels) -> list[list[Array]]:
    """Return the lower triangle of M^T W M, each element an array (group, pix)."""
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
    """Return the lower factor, with the inverse of its diagonal on the diagonal."""
    lower: list[list[Array]] = []
    for i, row in enumerate(matrix):
        lower.append([])
        for j in range(i + 1):
            rest = row[j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            lower[i].append(jax.lax.rsqrt(rest) if i == j else rest * lower[j][j])
    return lower


def _back_substituted(lower: list[list[Array]], right: Array) -> Array:
    """Return the solution x of L L^T x = right (group, unknown, pix)."""
    size = len(lower)
    y: list[Array] = []
    for i in range(size):
        y.append((right[:, i] - sum(lower[i][k] * y[k] for k in range(i))) * lower[i][i])
    x: list[Any] = [None] * size
    for i in reversed(range(size)):
        x[i] = (y[i] - sum(lower[k][i] * x[k] for k in range(i + 1, size))) * lower[i][i]
    return jnp.stack(x, axis=1)


def _projected(mixing: Array, maps: Array) -> Array:
    """Return M^T times maps (group, row, pix)."""
    return jnp.einsum("ru,krn->kun", mixing, maps)


def _model(mixing: Array, amplitudes: Array) -> Array:
    return jnp.einsum("ru,kun->krn", mixing, amplitudes)


def _solved(mixing: Array, pixels: Pixels) -> tuple[Array, list[list[Array]]]:
    """Return the solution of M^T W M s = M^T W d, and the factors of the matrix."""
    right = _projected(mixing, _weighted(pixels, pixels.data))
    lower = _cholesky(_gram(mixing, pixels))
    return _back_substituted(lower, right), lower


def _along(function, primals, tangents):
    """Return the derivative of a function along tangents; zero tangents cost nothing."""
    leaves, structure = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents, is_leaf=lambda x: isinstance(x, SymbolicZero))
    moving = [i for i, slope in enumerate(slopes) if not isinstance(slope, SymbolicZero)]

    def moved(*values):
        given = dict(enumerate(leaves)) | dict(zip(moving, values, strict=True))
        return function(*jax.tree.unflatten(structure, list(given.values())))

    return jax.jvp(moved, [leaves[i] for i in moving], [slopes[i] for i in moving])[1]


@jax.custom_jvp
def solve(mixing: Float[Array, "row unknown"], pixels: Pixels) -> Float[Array, "group unknown pix"]:
    """Return amplitudes s = (M^T W M)^-1 M^T W d; NaN where a system is singular."""
    return _solved(mixing, pixels)[0]


@partial(solve.defjvp, symbolic_zeros=True)
def _solve_jvp(primals, tangents):
    """Differentiate M^T W (d - M s) = 0: one more solution, no derivative of the factors."""
    amplitudes, lower = _solved(*primals)

    def zero(mixing, pixels):
        return _projected(mixing, _weighted(pixels, pixels.data - _model(mixing, amplitudes)))

    return amplitudes, _back_substituted(lower, _along(zero, primals, tangents))


def inverse_gram(
    mixing: Float[Array, "row unknown"], pixels: Pixels
) -> Float[Array, "group unknown unknown pix"]:
    """Return the covariance (M^T W M)^-1 of amplitudes; one pixel if weights are uniform."""
    lower = _cholesky(_gram(mixing, pixels))
    one, units = jnp.ones_like(lower[0][0])[:, None], jnp.eye(len(lower))[:, :, None]
    return jnp.stack([_back_substituted(lower, one * unit) for unit in units], axis=2)


def residuals(mixing: Float[Array, "row unknown"], pixels: Pixels) -> Float[Array, "group row pix"]:
    """Return whitened residuals: their sum of squares is chi^2."""
    _, rest, _ = fitted(mixing, pixels)
    if pixels.cross is None:
        return jnp.sqrt(pixels.weights) * rest
    half = rest.shape[1] // 2
    QQ, UU = pixels.weights[:, :half], pixels.weights[:, half:]
    root = jnp.sqrt(QQ)
    first = root * rest[:, :half] + pixels.cross / root * rest[:, half:]
    second = jnp.sqrt(UU - pixels.cross**2 / QQ) * rest[:, half:]
    return jnp.concatenate([first, second], axis=1)


class Derivatives(NamedTuple):
    """-ln L and its derivatives in the parameters that a mixing matrix depends on.

    `fisher` has the second derivatives for data that equal the prediction of the parameters: the
    Fisher matrix of the fitted amplitudes, positive semi-definite.
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
    """Return chi^2 / 2 and its derivatives in closed form, from one factorisation.

    With A the matrix, A_i its derivatives, G = A^T W A, amplitudes s, residuals r, B_i = A_i s and
    D_i = A_i^T W r - A^T W B_i,

        gradient_i = -r^T W B_i
        fisher_ij = B_i^T W B_j - (A^T W B_i)^T G^-1 (A^T W B_j)
        hessian_ij = B_i^T W B_j - r^T W A_ij s - D_i^T G^-1 D_j.
    """
    amplitudes, lower = _solved(mixing, pixels)
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


def fitted(mixing: Float[Array, "row unknown"], pixels: Pixels) -> tuple[Array, Array, Array]:
    """Return amplitudes (group, unknown, pix), residuals (group, row, pix), and W times them."""
    amplitudes = solve(mixing, pixels)
    rest = pixels.data - _model(mixing, amplitudes)
    return amplitudes, rest, _weighted(pixels, rest)


@jax.custom_jvp
def least_chi2(mixing: Float[Array, "row unknown"], pixels: Pixels) -> Float[Array, ""]:
    """Return the sum over pixels of r^T W r = d^T W d - (M^T W d)^T (M^T W M)^-1 (M^T W d).

    It is computed from residuals, so nothing cancels where signals are far above the noise.
    """
    _, rest, weighted = fitted(mixing, pixels)
    return jnp.sum(rest * weighted)


@partial(least_chi2.defjvp, symbolic_zeros=True)
def _chi2_jvp(primals, tangents):
    amplitudes, rest, weighted = fitted(*primals)

    def linear(mixing, pixels):
        """Return a number with the derivative of chi^2 at constant amplitudes."""
        moved = pixels.data - _model(mixing, amplitudes)
        return 2 * jnp.sum(weighted * moved) + jnp.sum(rest * _weighted(pixels, rest))

    return jnp.sum(rest * weighted), _along(linear, primals, tangents)


@jax.jit
def square_root(matrix: Float[Array, "... row row"]) -> Float[Array, "... row row"]:
    """Return R with R^T R = G for symmetric positive semi-definite G, even singular.

    Rows and columns are scaled to a unit diagonal first, so that maps in different units do not
    cost accuracy.
    """
    diagonal = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    scale = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    values, vectors = jnp.linalg.eigh(matrix / scale[..., :, None] / scale[..., None, :])
    root = jnp.sqrt(jnp.maximum(values, 0.0))[..., :, None] * jnp.swapaxes(vectors, -1, -2)
    return root * scale[..., None, :]


def assembled(
    local: Float[np.ndarray, "cell free free"],
    index: np.ndarray,
    size: int,
    diagonal: Float[np.ndarray, " par"],
) -> np.ndarray | scipy.sparse.csc_matrix:
    """Return the matrix of all parameters from those of each cell, plus a diagonal."""
    if size <= DENSE:
        total = np.diag(np.asarray(diagonal, float))
        np.add.at(total, (index[:, :, None], index[:, None, :]), local)
        return total
    rows = np.broadcast_to(index[:, :, None], local.shape).ravel()
    columns = np.broadcast_to(index[:, None, :], local.shape).ravel()
    matrix = scipy.sparse.coo_matrix((local.ravel(), (rows, columns)), (size, size))
    return scipy.sparse.csc_matrix(matrix + scipy.sparse.diags(diagonal))


def _independent(matrix: np.ndarray, scale: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return positions and scaled values of independent blocks, such as those of regions."""
    scaled = matrix * scale * scale[:, None]
    graph = scipy.sparse.csr_matrix(scaled != 0)
    count, block = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(block, kind="stable")
    every = np.split(order, np.cumsum(np.bincount(block, minlength=count))[:-1])
    return [(at, scaled[np.ix_(at, at)]) for at in every]


class Factor:
    """Factors of a symmetric matrix, if dense in blocks; `positive` if it is positive definite."""

    def __init__(self, matrix: np.ndarray | scipy.sparse.csc_matrix) -> None:
        self._matrix, diagonal = matrix, matrix.diagonal()
        self.positive = bool(np.all(diagonal > 0) and np.isfinite(diagonal).all())
        if not self.positive:
            return
        self._scale = 1 / np.sqrt(diagonal)
        try:
            if isinstance(matrix, np.ndarray):
                blocks = _independent(matrix, self._scale)
                self._blocks = [(at, scipy.linalg.cho_factor(block)) for at, block in blocks]
                return
            scale = scipy.sparse.diags(self._scale)
            # Without pivoting the factors are those of L D L^T, and the signs of D tell.
            self._sparse = scipy.sparse.linalg.splu(
                scipy.sparse.csc_matrix(scale @ matrix @ scale),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            self.positive = bool(np.all(self._sparse.U.diagonal() > 0))
        except (ValueError, RuntimeError):  # errors of linear algebra are ValueErrors
            self.positive = False

    def __reduce__(self) -> tuple[Any, ...]:  # sparse factors cannot be sent to a process
        return Factor, (self._matrix,)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for one right-hand side, or for several as columns."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        if hasattr(self, "_sparse"):
            return scale * self._sparse.solve(scale * right)
        scaled = scale * right
        solution = np.empty_like(scaled)
        for at, factor in self._blocks:
            solution[at] = scipy.linalg.cho_solve(factor, scaled[at])
        return scale * solution


def degenerate(matrix: np.ndarray | scipy.sparse.csc_matrix, names: Sequence[str]) -> list[str]:
    """Return names of degenerate parameters, from the curvature of -log posterior."""
    diagonal = matrix.diagonal()
    if (bad := ~(diagonal > 0)).any():
        return [name for name, wrong in zip(names, bad, strict=True) if wrong]
    if not isinstance(matrix, np.ndarray):
        return [] if Factor(matrix).positive else list(names)
    found = []
    for at, block in _independent(matrix, 1 / np.sqrt(diagonal)):
        values, vectors = np.linalg.eigh(block)
        if not values[0] > DEGENERATE:
            share = np.abs(vectors[:, 0])
            found += at[share > 0.05 * share.max()].tolist()
    return [names[i] for i in sorted(found)]


def variances(
    factor: Factor, scatter: scipy.sparse.csc_matrix, shared: np.ndarray
) -> Float[np.ndarray, " par"]:
    """Return the diagonal of H^-1 S H^-1 for sparse H, given as factor; NaN if it takes too long.

    Without parameters that many cells share, H consists of small independent parts, so a few
    solutions serve all of them at once: one for each position in a part.
    """
    size = len(shared)
    part = np.zeros(size, int)
    if not shared.any():
        part = scipy.sparse.csgraph.connected_components(scatter, directed=False)[1]
    order = np.argsort(part, kind="stable")
    position = np.empty(size, int)
    position[order] = np.arange(size) - np.searchsorted(part[order], part[order])
    if (largest := int(position.max()) + 1) > MOST:
        return np.full(size, np.nan)
    result = np.empty(size)
    for begin in range(0, largest, COLUMNS):
        columns = np.arange(begin, min(begin + COLUMNS, largest))
        solved = factor.solve((position[:, None] == columns).astype(float))
        terms = solved * (scatter @ solved)
        for j, column in enumerate(columns):
            here = position == column
            result[here] = np.bincount(part, terms[:, j])[part[here]]
    return result
