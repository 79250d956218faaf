"""What `fits.compress` and the separation of components do, for pixels over devices.

Each device arranges its own pixels in blocks of a single cell; everything is a pass over these, or
over the pixels themselves, and ends in sums. Only labels of cells are looked at outside of passes.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fits.compress import BLOCK, PIECE, Layout, Noise, carrying, pixel_rows
from fits.regions import Cells
from fits.systems import Pixels, square_root
from jaxsky.checks import UNSEEN
from jaxsky.mesh import (
    SUMS,
    along,
    at_once,
    from_parts,
    maps_of,
    of_own,
    over_pixels,
    parts_of,
    total,
)

#: All pixels of a device.
ALL = slice(None)


def noise_like(data: Any, noise: Noise) -> Noise:
    """Return noise whose maps are distributed as the data are."""
    return Noise(*(None if each is None else along(data, each) for each in noise))


@partial(jax.jit, static_argnames="components")
def _look(data, noise, components):
    """Return used pixels, their number, those in too few bands, bad data, and sums over bands."""

    @over_pixels((maps_of(1), SUMS, SUMS, SUMS, SUMS, SUMS))
    def look(data, noise):
        weights = jnp.broadcast_to(noise.weights(ALL), data.shape)
        seen = (weights > 0).sum(axis=0)
        used = seen.any(axis=0)
        few = jnp.sum(used & (seen < components).any(axis=0))
        bad = jnp.sum((~jnp.isfinite(data) | (data < UNSEEN)) & (weights > 0))
        own = jnp.where(used, weights, 0.0)
        sums = used.sum(), few, bad, own.sum(axis=(1, 2)), (own > 0).sum(axis=(1, 2))
        return used, *map(total, sums)

    return look(data, noise)


class Looked(NamedTuple):
    """Used pixels, which are distributed, their number, and weights and data in each band."""

    used: Bool[Array, " pix"]
    number: int
    weights: Float[np.ndarray, " band"]
    counts: Int[np.ndarray, " band"]

    def heavy(
        self, squares: Float[np.ndarray, "band component"]
    ) -> tuple[Bool[np.ndarray, " band"], int]:
        """Return the bands that carry weight, and the number of data in them; see `Noise.heavy`."""
        return carrying(self.weights, self.counts, squares)


def look(data: Any, noise: Noise, components: int) -> Looked:
    """Return which pixels are used, or raise for what `fits.compress` refuses."""
    used, number, few, bad, weights, counts = _look(data, noise, components)
    if few:
        raise ValueError(
            f"{few} pixels are seen in fewer bands than the {components} components; mask them "
            "in all bands."
        )
    if not number:
        raise ValueError("No pixel is left: the mask, or an infinite `noise`, covers the map.")
    if bad:
        raise ValueError(
            f"Argument `data` has {bad} values that are not finite (or UNSEEN) in pixels that are "
            "used; mask them with an infinite `noise`."
        )
    return Looked(used, int(number), np.asarray(weights), np.asarray(counts))


@partial(jax.jit, static_argnames="number")
@over_pixels(SUMS)
def counted(of_pixel, *, number: int):
    """Return the number of pixels with each of some numbers; negative ones are not counted."""
    own = jnp.where(of_pixel < 0, number, of_pixel)
    return total(jnp.zeros(number, int).at[own].add(1, mode="drop"))


def check_labels(name: str, labels: Any, used: Bool[Array, " pix"]) -> Int[Array, " pix"]:
    """Return labels distributed as pixels are, 0 where a pixel is not used."""
    array = along(used, labels if isinstance(labels, jax.Array) else np.asarray(labels))
    if array.dtype.kind not in "iu":
        raise TypeError(f"Labels of {name!r} must be integers, but are {array.dtype}.")
    if array.shape != used.shape:
        raise ValueError(
            f"Labels of {name!r} must have shape {used.shape} like a map, but have {array.shape}."
        )
    if bad := int(jnp.sum((array < 0) & used)):
        raise ValueError(f"Labels of {name!r} are negative in {bad} pixels that are used.")
    return jnp.where(used, array, 0)


def intersections(labels: Mapping[str, Int[Array, " pix"]], used: Bool[Array, " pix"]) -> Cells:
    """Return the intersections of the regions of several parameters, among used pixels."""
    if not labels:
        return Cells(None, {}, 1)
    sizes = [int(each.max()) + 1 for each in labels.values()]
    key = jnp.zeros(used.shape, int, device=used.sharding)
    for array, size in zip(labels.values(), sizes, strict=True):
        key = key * size + array
    there = np.flatnonzero(counted(jnp.where(used, key, -1), number=int(np.prod(sizes))))
    found = dict(zip(labels, np.unravel_index(there, sizes), strict=True))
    if len(there) == 1:
        return Cells(None, found, 1)
    return Cells(_numbered(there, key, used), found, len(there))


@jax.jit
@over_pixels(maps_of(1))
def _numbered(there, key, used):
    """Return the cell of each pixel from the sorted keys of all cells."""
    return jnp.where(used, jnp.searchsorted(there, key), -1).astype(jnp.int32)


class Blocks(NamedTuple):
    """Pixels of each device in blocks of a single cell, -1 in the padding, and their cell."""

    pixels: Int[Array, "block size"]
    cell: Int[Array, " block"]


def blocks(cells: Cells, used: Bool[Array, " pix"]) -> Blocks:
    """Arrange the used pixels of each device by cells; all devices have as many blocks."""
    of_pixel: Any = jnp.where(used, 0, -1) if cells.of_pixel is None else cells.of_pixel
    own = parts_of(of_pixel)
    sizes = [np.bincount(each[each >= 0], minlength=cells.number) for each in own]

    def most(numbers: list[int]) -> int:
        return int(from_parts([np.array([n]) for n in numbers], of_pixel).max())

    size = most([min(BLOCK, int(np.median(n[n > 0]))) if n.any() else 1 for n in sizes])
    number = most([int(np.sum(-(-n // size))) for n in sizes])

    def arranged(own: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        counts = -(-sizes // size)
        order = np.argsort(own, kind="stable")
        order = order[own[order] >= 0]
        own = own[order]
        begin = np.concatenate([[0], np.cumsum(counts * size)[:-1]])
        place = begin[own] + np.arange(own.size) - np.searchsorted(own, own)
        flat = np.full(number * size, -1, np.int32)
        flat[place] = order
        cell = np.repeat(np.arange(len(counts)), counts)
        return flat.reshape(-1, size), np.pad(cell, (0, number - len(cell)))

    pixels, cell = zip(*map(arranged, own, sizes), strict=True)
    return Blocks(from_parts(pixels, of_pixel), from_parts(cell, of_pixel))


@jax.jit
@over_pixels(maps_of(1))
def pieces(used: Bool[Array, " pix"]) -> Blocks:
    """Return the pixels of each device as they are, in blocks of one cell; -1 where not used."""
    npix = used.shape[-1]
    size = min(at_once(PIECE), npix)
    own = jnp.arange(-(-npix // size) * size, dtype=jnp.int32)
    own = jnp.where(used[jnp.minimum(own, npix - 1)] & (own < npix), own, -1).reshape(-1, size)
    return Blocks(own, jnp.zeros(len(own), int))


@partial(jax.jit, static_argnames=("layout", "number"))
def _covariance(data, noise, blocks, layout, number):
    @over_pixels(SUMS)
    def summed(data, noise, blocks):
        def add(found, block):
            own, cell = block
            root = jnp.sqrt(noise.pixel_weights(own))
            values = jnp.where(own >= 0, data[..., own].astype(float) * root, 0.0)
            rows = layout.rows(values)
            return found.at[cell].add(jnp.einsum("grp,gqp->grq", rows, rows)), None

        size = len(data) * len(layout.groups[0])
        start = of_own(jnp.zeros((number, len(layout.groups), size, size)))
        return total(jax.lax.scan(add, start, blocks)[0])

    return summed(data, noise, blocks)


def compressed(data: Any, noise: Noise, cells: Cells, blocks: Blocks, layout: Layout) -> Pixels:
    """Replace the pixels of each cell by as many vectors as there are rows; exact."""
    covariance = np.asarray(_covariance(data, noise, blocks, layout, cells.number))
    weights = layout.rows(1 / np.asarray(noise.sigma) ** 2)
    if all(np.array_equal(weights[0], w) for w in weights[1:]):
        covariance, weights = covariance.sum(axis=1, keepdims=True), weights[:1]
    root = jnp.swapaxes(square_root(jnp.asarray(covariance)), -1, -2)
    return Pixels(root, jnp.broadcast_to(weights, (cells.number, *weights.shape)))


@partial(jax.jit, static_argnames="layout")
def gathered(data: Array, noise: Noise, blocks: Blocks, layout: Layout) -> Pixels:
    """Return the pixels in blocks, padded with zeros of unit weight."""

    @over_pixels(maps_of(1))
    def gather(data, noise, pixels):
        def one(own):
            rows = pixel_rows(data, noise, layout, own, own >= 0)
            return tuple(
                None if each is None else jnp.broadcast_to(each, (*each.shape[:-1], own.size))
                for each in rows
            )

        return Pixels(*jax.lax.map(one, pixels))

    return gather(data, noise, blocks.pixels)


@partial(jax.jit, static_argnames=("separate", "layouts", "errors"))
def separated_pixels(separate, of_pixel, known, data, noise, layouts, errors):
    """Return the fields of `ComponentMaps` but the first; `separate` does so for some pixels."""
    bands, stokes, _ = data.shape

    def separated(of_pixel, known, data, noise, own):
        weights = jnp.broadcast_to(noise.weights(own), (bands, stokes, own.size))
        used = (weights > 0).any(axis=(0, 1))
        size = known[0].shape[-1] // (1 + layouts[0].joint)
        amplitude, alone = jnp.zeros((2, size, stokes, own.size))
        blocks, square = jnp.zeros((size, *alone.shape)), jnp.zeros(own.size)
        for layout, matrix in zip(layouts, known, strict=True):
            every = matrix if of_pixel is None else matrix[jnp.maximum(of_pixel[own], 0)]
            pixels = Pixels(*pixel_rows(data, noise, layout, own, used))
            solved, squares, *variances = separate(every, pixels, errors)
            amplitude = amplitude.at[:, np.array(layout.stokes)].set(layout.maps(solved))
            square = square + squares
            for k, s in enumerate(layout.stokes if errors else ()):
                group, first = (0, k * size) if layout.joint else (k, 0)
                cut = slice(first, first + size)
                blocks = blocks.at[:, :, s].set(variances[0][group, cut, cut])
                alone = alone.at[:, s].set(variances[1][group, cut])
        count = (weights > 0).sum(axis=(0, 1)) - 1.0 * size * stokes
        exceeding = jax.scipy.special.gammaincc(jnp.maximum(count, 1) / 2, square / 2)
        probability = jnp.where(count > 0, exceeding, 0.0)
        variances = (blocks, alone) if errors else (None, None)
        found = amplitude, *variances, square, count, probability
        return jax.tree.map(lambda x: jnp.where(used, x, jnp.nan), found)

    @over_pixels((maps_of(3), maps_of(4), maps_of(3), maps_of(1), maps_of(1), maps_of(1)))
    def on_device(of_pixel, known, data, noise):
        npix = data.shape[-1]
        size = min(at_once(PIECE), npix)

        def some(start):
            own = jnp.minimum(start + np.arange(size), npix - 1)
            return separated(of_pixel, known, data, noise, own)

        parts = jax.lax.map(some, jnp.arange(0, npix, size))

        def joined(x):
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)[..., :npix]

        return jax.tree.map(joined, parts)

    return on_device(of_pixel, known, data, noise)
