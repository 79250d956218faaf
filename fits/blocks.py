"""Pixels in blocks of one cell each, for likelihoods whose noise cannot be compressed.

They are gathered in memory, or read anew whenever they are needed if the maps are on disk.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from fits.compress import BLOCK, Layout, Noise, pixel_rows, refuse_data
from fits.regions import Cells
from fits.systems import Pixels
from jaxsky.checks import UNSEEN
from jaxsky.io.stacks import Maps, ranges

#: Pixels in memory at once if the maps are on disk.
STREAM = 1 << 17
ON_DISK = (
    "Maps on disk whose noise differs from pixel to pixel and from band to band can be fitted by "
    'fits.Newton() only, and not sampled (separate.sampler = "none").'
)


def block_size(counts: np.ndarray) -> int:
    """Return the number of pixels in a block, from those in each cell."""
    return min(BLOCK, int(np.median(counts[counts > 0]))) if counts.any() else 1


def arranged(
    own: np.ndarray, counts: np.ndarray, size: int, number: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of each block, -1 in the padding, and the cell of each block.

    `own` is the cell of each pixel, -1 where not used, and `counts` are the pixels of each cell;
    there are at least `number` blocks.
    """
    blocks = -(-counts // size)
    order = np.argsort(own, kind="stable")[len(own) - counts.sum() :]
    own = own[order]
    begin, first = (np.cumsum(n) - n for n in (blocks * size, counts))
    cell = np.repeat(np.arange(len(counts)), blocks)
    cell = np.pad(cell, (0, max(0, number - len(cell))))
    flat = np.full(len(cell) * size, -1, np.int32)
    flat[(begin - first)[own] + np.arange(own.size)] = order
    return flat.reshape(-1, size), cell


class Blocks:
    """Used pixels in blocks, each of a single cell and padded with zeros of unit weight.

    `where` are the pixels of each block, -1 for padding, and `cell` is the cell of each block.
    """

    def __init__(self, data: Maps, noise: Noise, cells: Cells, used: np.ndarray) -> None:
        self._data, self._noise = data, noise
        own = np.where(used, 0, -1).astype(np.int32) if cells.of_pixel is None else cells.of_pixel
        counts = np.bincount(own[own >= 0], minlength=cells.number)
        self.where, self.cell = arranged(own, counts, block_size(counts))

    def read(self, layout: Layout, blocks: slice) -> Pixels:
        """Return the pixels of some blocks, (block, group, row, pix), as arrays of numpy."""
        index = self.where[blocks].ravel()
        used, size = index >= 0, self.where.shape[1]
        whole = used.all() and index[-1] - index[0] == len(index) - 1 and np.all(np.diff(index) > 0)
        where = slice(int(index[0]), int(index[-1]) + 1) if whole else index
        found = pixel_rows(self._data, self._noise, layout, where, used)
        if not np.isfinite(found.data).all() or found.data.min() < UNSEEN:
            refuse_data(self._data, self._noise)

        def shaped(rows: np.ndarray) -> np.ndarray:
            rows = np.broadcast_to(rows, (*rows.shape[:2], index.size))
            return np.moveaxis(rows.reshape(*rows.shape[:2], -1, size), 2, 0)

        return jax.tree.map(shaped, found)

    def pieces(self, like: Any) -> Iterator[Any]:
        """Yield a `SpectralLikelihood` with a few blocks at a time, as many but for the last."""
        number, size = self.where.shape
        for blocks in ranges(number, max(1, STREAM // size)):
            read = tuple(self.read(each, blocks) for each in like.layout)
            pixels, cells = jax.tree.map(jnp.asarray, (read, self.cell[blocks]))
            yield dataclasses.replace(like, pixels=pixels, block_cell=cells, source=None)

    def gathered(self, layout: Layout) -> tuple[Pixels, Array | None]:
        """Return all pixels, and the cell of each block, None if they are in order."""
        number, size = self.where.shape
        every: Any = None
        for some in ranges(number, max(1, BLOCK // size)):
            read = self.read(layout, some)
            if every is None:
                every = jax.tree.map(lambda own: np.empty((number, *own.shape[1:])), read)
            for target, own in zip(*map(jax.tree.leaves, (every, read)), strict=True):
                target[some] = own
        in_order = np.array_equal(self.cell, np.arange(number))
        return jax.tree.map(jnp.asarray, every), None if in_order else jnp.asarray(self.cell)
