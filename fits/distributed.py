"""Which pixels are used, and what `fits.compress` does, for pixels over devices.

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

from fits.compress import PIECE, Blocks, Layout, Noise, arranged, pixel_rows, wrong_data
from fits.regions import Cells
from fits.systems import Pixels
from jaxsky import mesh
from jaxsky.checks import UNSEEN
from jaxsky.io.stacks import ranges

#: All pixels of a device.
ALL = slice(None)
#: A band with less than this share of the weight of every component counts as weightless.
LEAST_SHARE = 1e-6


def carry_weight(weights: Float[np.ndarray, "band component"]) -> Bool[np.ndarray, " band"]:
    """Return True for the bands that carry weight for any component, next to the others."""
    total = weights.sum(axis=0)
    return (weights / np.where(total > 0, total, 1.0)).max(axis=1) >= LEAST_SHARE


def _seen(weights, components):
    """Return used pixels, their number, those in too few bands, and sums over bands."""
    seen = (weights > 0).sum(axis=0)
    used = seen.any(axis=0)
    own = mesh.module_of(weights).where(used, weights, 0.0)
    few = (used & (seen < components).any(axis=0)).sum()
    return used, used.sum(), few, own.sum(axis=(1, 2)), (own > 0).sum(axis=(1, 2))


@partial(jax.jit, static_argnames="components")
@mesh.over_pixels((mesh.maps_of(1), *[mesh.SUMS] * 5))
def _look(data, noise, *, components):
    """Return the same, and the number of bad data."""
    weights = jnp.broadcast_to(noise.weights(ALL), data.shape)
    used, *sums = _seen(weights, components)
    bad = jnp.sum((~jnp.isfinite(data) | (data < UNSEEN)) & (weights > 0))
    return used, *map(mesh.total, (*sums, bad))


class Looked(NamedTuple):
    """Used pixels, distributed like the data, their number, and weights and data in each band."""

    used: Bool[Array | np.ndarray, " pix"]
    number: int
    weights: Float[np.ndarray, " band"]
    counts: Int[np.ndarray, " band"]


def look(data: Any, noise: Noise, components: int) -> Looked:
    """Return which pixels are used; ValueError if that cannot be separated.

    Data that are not finite are refused here if they are distributed, and else where they are read.
    """
    bands, stokes, npix = data.shape
    if mesh.spread(data):
        used, *sums, bad = _look(data, noise, components=components)
    else:
        used, sums, bad = np.empty(npix, bool), [0, 0, np.zeros(bands), np.zeros(bands, int)], 0
        for part in ranges(npix, PIECE):
            shape = bands, stokes, part.stop - part.start
            used[part], *own = _seen(np.broadcast_to(noise.weights(part), shape), components)
            sums = [one + more for one, more in zip(sums, own, strict=True)]
    number, few, weights, counts = sums
    if few:
        raise ValueError(
            f"{few} pixels are seen in fewer bands than the {components} components; mask them "
            "in all bands."
        )
    if not number:
        raise ValueError("No pixel is left: the mask, or an infinite `noise`, covers the map.")
    if bad:
        raise wrong_data(bad)
    return Looked(used, int(number), np.asarray(weights), np.asarray(counts))


@partial(jax.jit, static_argnames="number")
@mesh.over_pixels(mesh.SUMS)
def counted(of_pixel, *, number: int):
    """Return the number of pixels with each of some numbers; negative ones are not counted."""
    own = jnp.where(of_pixel < 0, number, of_pixel)
    return mesh.total(jnp.zeros(number, int).at[own].add(1, mode="drop"))


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
    return Cells(_numbered(there, key, used) if len(there) > 1 else None, found, len(there))


@jax.jit
@mesh.over_pixels(mesh.maps_of(1))
def _numbered(there, key, used):
    """Return the cell of each pixel from the sorted keys of all cells."""
    return jnp.where(used, jnp.searchsorted(there, key), -1).astype(jnp.int32)


def blocks(cells: Cells, used: Bool[Array, " pix"]) -> Blocks:
    """Arrange the used pixels of each device by cells; all devices have as many blocks."""
    of_pixel: Any = jnp.where(used, 0, -1) if cells.of_pixel is None else cells.of_pixel

    def most(numbers: list[int]) -> int:
        return int(mesh.from_parts([np.array([n]) for n in numbers], of_pixel).max())

    each = arranged(mesh.parts_of(of_pixel), cells.number, most)
    return jax.tree.map(lambda *parts: mesh.from_parts(parts, of_pixel), *each)


@jax.jit
@mesh.over_pixels(mesh.maps_of(1))
def pieces(used: Bool[Array, " pix"]) -> Blocks:
    """Return the pixels of each device as they are, in blocks of one cell; -1 where not used."""
    npix = used.shape[-1]
    size = min(mesh.at_once(PIECE), npix)
    own = jnp.arange(-(-npix // size) * size, dtype=jnp.int32)
    own = jnp.where(used[jnp.minimum(own, npix - 1)] & (own < npix), own, -1).reshape(-1, size)
    return Blocks(own, jnp.zeros(len(own), int))


def band_covariance(
    data: Array, noise: Noise, cells: Cells, used: Bool[Array, " pix"], layout: Layout
) -> Float[np.ndarray, "cell group row row"]:
    """Return what `fits.compress.band_covariance` does."""
    # A sum over all pixels needs no order.
    own = pieces(used) if cells.of_pixel is None else blocks(cells, used)
    return np.asarray(_band_covariance(data, noise, own, layout=layout, number=cells.number))


@partial(jax.jit, static_argnames=("layout", "number"))
@mesh.over_pixels(mesh.SUMS)
def _band_covariance(data, noise, blocks, *, layout, number):
    """Return the sums over blocks, for a number of cells."""

    def add(found, block):
        own, cell = block
        root = jnp.sqrt(noise.pixel_weights(own))
        values = jnp.where(own >= 0, data[..., own].astype(float) * root, 0.0)
        rows = layout.rows(values)
        return found.at[cell].add(jnp.einsum("grp,gqp->grq", rows, rows)), None

    size = len(data) * len(layout.groups[0])
    start = mesh.of_own(jnp.zeros((number, len(layout.groups), size, size)))
    return mesh.total(jax.lax.scan(add, start, blocks)[0])


@partial(jax.jit, static_argnames="layout")
@mesh.over_pixels(mesh.maps_of(1))
def gathered(data: Array, noise: Noise, blocks: Blocks, *, layout: Layout) -> Pixels:
    """Return the pixels in blocks, padded with zeros of unit weight."""
    return jax.lax.map(lambda own: pixel_rows(data, noise, layout, own, own >= 0), blocks.pixels)
