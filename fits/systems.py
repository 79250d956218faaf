"""Symmetric systems of many parameters, of which few share a cell: dense or sparse."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

#: Matrices up to this size are treated as dense ones.
DENSE = 1500
#: Columns solved for at a time, and the most of them for variances of a sparse matrix.
COLUMNS, MOST = 64, 4096


def assembled(
    local: Float[np.ndarray, "cell free free"],
    index: np.ndarray,
    size: int,
    diagonal: Float[np.ndarray, " par"],
) -> np.ndarray | scipy.sparse.csc_matrix:
    """The matrix of all parameters from those of each cell, plus a diagonal."""
    if size <= DENSE:
        total = np.diag(np.asarray(diagonal, float))
        np.add.at(total, (index[:, :, None], index[:, None, :]), local)
        return total
    rows = np.broadcast_to(index[:, :, None], local.shape).ravel()
    columns = np.broadcast_to(index[:, None, :], local.shape).ravel()
    matrix = scipy.sparse.coo_matrix((local.ravel(), (rows, columns)), (size, size))
    return scipy.sparse.csc_matrix(matrix + scipy.sparse.diags(diagonal))


def _independent(matrix: np.ndarray) -> list[np.ndarray]:
    """Positions of the independent blocks that a matrix falls into, as regions do."""
    graph = scipy.sparse.csr_matrix(matrix != 0)
    count, block = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(block, kind="stable")
    return np.split(order, np.cumsum(np.bincount(block, minlength=count))[:-1])


class Factor:
    """Factors of a symmetric matrix, a dense one block by block; `positive` if it is definite."""

    def __init__(self, matrix: np.ndarray | scipy.sparse.csc_matrix) -> None:
        diagonal = matrix.diagonal()
        self.positive = bool(np.all(diagonal > 0) and np.isfinite(diagonal).all())
        self._scale = 1 / np.sqrt(diagonal) if self.positive else np.ones_like(diagonal)
        if not self.positive:
            return
        if isinstance(matrix, np.ndarray):
            scaled = matrix * self._scale * self._scale[:, None]
            self._blocks = _independent(scaled)
            try:
                self._factors = [
                    scipy.linalg.cho_factor(scaled[np.ix_(at, at)]) for at in self._blocks
                ]
            except (scipy.linalg.LinAlgError, ValueError):
                self.positive = False
            return
        scale = scipy.sparse.diags(self._scale)
        try:
            # Without pivoting the factors are those of L D L^T, and the signs of D tell.
            self._sparse = scipy.sparse.linalg.splu(
                scipy.sparse.csc_matrix(scale @ matrix @ scale),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            self.positive = False
            return
        self.positive = bool(np.all(self._sparse.U.diagonal() > 0))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution for one right-hand side, or for several as columns."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        if hasattr(self, "_sparse"):
            return scale * self._sparse.solve(scale * right)
        scaled = scale * right
        solution = np.empty_like(scaled)
        for at, factor in zip(self._blocks, self._factors, strict=True):
            solution[at] = scipy.linalg.cho_solve(factor, scaled[at])
        return scale * solution


def degenerate(
    matrix: np.ndarray | scipy.sparse.csc_matrix, names: Sequence[str], threshold: float = 1e-10
) -> list[str]:
    """Names of parameters that the data do not tell apart, from the curvature of -log posterior.

    `threshold` is the least eigenvalue of the matrix scaled to a unit diagonal.
    """
    diagonal = matrix.diagonal()
    if (bad := ~(diagonal > 0)).any():
        return [name for name, wrong in zip(names, bad, strict=True) if wrong]
    if not isinstance(matrix, np.ndarray):
        return [] if Factor(matrix).positive else list(names)
    scale = 1 / np.sqrt(diagonal)
    scaled = matrix * scale * scale[:, None]
    found = []
    for at in _independent(scaled):
        values, vectors = np.linalg.eigh(scaled[np.ix_(at, at)])
        if values[0] > threshold:
            continue
        share = np.abs(vectors[:, 0])
        found += at[share > 0.05 * share.max()].tolist()
    return [names[i] for i in sorted(found)]


def variances(
    factor: Factor, scatter: scipy.sparse.csc_matrix, shared: np.ndarray
) -> Float[np.ndarray, " par"]:
    """Diagonal of H^-1 S H^-1 for sparse H, given by its factor, and S; NaN if it takes too long.

    Without parameters that many cells share H falls into small independent parts, so a few
    solutions serve all of them at once.
    """
    size = len(shared)
    if shared.any():
        # Everything hangs together: column by column, if there are not too many.
        if size > MOST:
            return np.full(size, np.nan)
        position = np.arange(size)
        component = np.zeros(size, int)
    else:
        count, component = scipy.sparse.csgraph.connected_components(scatter, directed=False)
        order = np.argsort(component, kind="stable")
        first = np.searchsorted(component[order], np.arange(count))
        position = np.empty(size, int)
        position[order] = np.arange(size) - first[component[order]]
        if position.max() >= MOST:
            return np.full(size, np.nan)
    result = np.empty(size)
    for begin in range(0, int(position.max()) + 1, COLUMNS):
        columns = np.arange(begin, min(begin + COLUMNS, int(position.max()) + 1))
        solved = factor.solve((position[:, None] == columns).astype(float))
        terms = solved * (scatter @ solved)
        for j, column in enumerate(columns):
            here = position == column
            sums = np.bincount(component, terms[:, j], minlength=component.max() + 1)
            result[here] = sums[component[here]]
    return result
