"""Reduction of maps to the inner products that a fit needs.

In a template fit with spectral parameters that do not vary over a region, a model is a sum of
templates with coefficients, so chi^2 is a quadratic form in the coefficients. Its matrix, the inner
products of data, templates and a constant, is formed once in one pass over the pixels; afterwards
nothing depends on the number of pixels. The products add up over pixels: over chunks, files or
machines.

The spectral likelihood depends on the data, where noise is separable, a number for each band times
a map, only through the covariance of bands D = sum_p d_p d_p^T / sigma_p^2 of each cell. Any few
vectors with the same covariance give the same chi^2, exactly and at all parameters: the columns of
a square root of D take the place of the pixels.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.amplitudes import Pixels
from fits.noise import Noise, chunks
from fits.regions import Cells
from jaxsky.checks import UNSEEN

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

    Weights are 1/sigma^2, zero where masked, and broadcast against the data; `chunk` pixels are
    taken at once. Results for disjoint sets of pixels add up to that of their union.
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


#: Pixels in a block of the likelihood: few enough for the cache, enough for its loops.
BLOCK = 4096


class Layout(NamedTuple):
    """Stokes parameters, by position, that share a mixing matrix.

    If `joint`, Q and U are in one system, their rows one after the other; else each has its own.
    """

    joint: bool
    stokes: tuple[int, ...]

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Stokes parameters of each system."""
        return (self.stokes,) if self.joint else tuple((s,) for s in self.stokes)

    def rows(self, maps: np.ndarray) -> np.ndarray:
        """Maps (band, stokes, pix) as (group, row, pix)."""
        groups = [np.concatenate([maps[:, s] for s in group]) for group in self.groups]
        return np.stack(groups)

    def maps(self, rows: np.ndarray) -> np.ndarray:
        """The inverse for these Stokes parameters: (row or unknown, stokes, pix)."""
        if self.joint:
            rows = rows.reshape(2, -1, rows.shape[-1])
        return rows.swapaxes(0, 1)


def layouts(stokes: int, joint: bool) -> tuple[Layout, ...]:
    """How the Stokes parameters are grouped; `joint` if Q and U depend on each other."""
    if not joint:
        return (Layout(False, tuple(range(stokes))),)
    polarized = Layout(True, (stokes - 2, stokes - 1))
    return (polarized,) if stokes == 2 else (Layout(False, (0,)), polarized)


def used_pixels(noise: Noise, npix: int, components: int) -> np.ndarray:
    """Pixels that are not masked."""
    used = np.zeros(npix, bool)
    few = 0
    for part in chunks(npix):
        if noise.separable:
            used[part] = noise.pixel_weights(part) > 0
            continue
        seen = (noise.weights(part) > 0).sum(axis=1)
        used[part] = seen.any(axis=0)
        few += int(np.sum(used[part] & (seen < components).any(axis=0)))
    if few:
        raise ValueError(
            f"{few} pixels are seen in fewer bands than the {components} components; mask them "
            "in all bands."
        )
    if not used.any():
        raise ValueError("No pixel is left: the mask, or an infinite `noise`, covers the map.")
    return used


def _refuse(data: np.ndarray, noise: Noise) -> None:
    """Raise the error for data that are not finite in pixels that are used."""
    bad = 0
    for part in chunks(data.shape[-1]):
        values = data[..., part]
        wrong = ~np.isfinite(values) | (values < UNSEEN)
        bad += int(np.sum(wrong & (noise.weights(part) > 0).swapaxes(0, 1)))
    raise ValueError(
        f"Argument `data` has {bad} values that are not finite (or UNSEEN) in pixels that are "
        "used; mask them with an infinite `noise`."
    )


def band_covariance(
    data: np.ndarray, noise: Noise, cells: Cells, used: np.ndarray, layout: Layout
) -> Float[np.ndarray, "cell group row row"]:
    """D = sum_p d_p d_p^T / sigma_p^2 over the pixels of each cell, in one pass.

    `data` are maps (band, stokes, pix), of any precision and on disk if need be; `noise` is
    separable, and its part of the bands is not applied.
    """
    groups = layout.groups
    size = len(data) * len(groups[0])
    total = np.zeros((cells.number, len(groups), size, size))
    for part in chunks(data.shape[-1]):
        root = np.sqrt(noise.pixel_weights(part))
        for g, group in enumerate(groups):
            rows = [data[:, s, part].astype(float, copy=False) for s in group]
            x = rows[0] if len(rows) == 1 else np.concatenate(rows)
            if noise.pixel_sigma is not None:
                x = np.where(used[part], x * root, 0)
            if x.min() < UNSEEN:
                _refuse(data, noise)
            if cells.of_pixel is None:
                total[0, g] += x @ x.T
                continue
            own = cells.of_pixel[part]
            order = np.argsort(own, kind="stable")
            order = order[own[order] >= 0]
            ends = np.flatnonzero(np.diff(own[order], append=-1)) + 1
            x = x[:, order]
            for begin, end in zip([0, *ends[:-1]], ends, strict=True):
                piece = x[:, begin:end]
                total[own[order[begin]], g] += piece @ piece.T
    if not np.isfinite(total).all():
        _refuse(data, noise)
    return total


def compressed(
    data: np.ndarray, noise: Noise, cells: Cells, used: np.ndarray, layout: Layout
) -> Pixels:
    """As many vectors in place of the pixels of a cell as there are rows; exact."""
    covariance = band_covariance(data, noise, cells, used, layout)
    weights = layout.rows(noise.band_weights().T[..., None])
    if all(np.array_equal(weights[0], w) for w in weights[1:]):
        covariance, weights = covariance.sum(axis=1, keepdims=True), weights[:1]
    root = jnp.swapaxes(square_root(jnp.asarray(covariance)), -1, -2)
    return Pixels(root, jnp.broadcast_to(weights, (cells.number, *weights.shape)))


def gathered(
    data: np.ndarray, noise: Noise, cells: Cells, used: np.ndarray, layout: Layout
) -> tuple[Pixels, Array | None]:
    """The pixels in blocks, each of a single cell and filled up with zeros of unit weight.

    With the cell of each block, None if they are in order.
    """
    pixels = np.flatnonzero(used)
    own = np.zeros(len(pixels), np.int32) if cells.of_pixel is None else cells.of_pixel[pixels]
    order = np.argsort(own, kind="stable")
    pixels, own = pixels[order], own[order]
    counts = np.bincount(own, minlength=cells.number)
    size = int(min(BLOCK, np.median(counts)))
    blocks = -(-counts // size)
    first = np.concatenate([[0], np.cumsum(blocks * size)[:-1]])
    place = first[own] + np.arange(len(own)) - (np.cumsum(counts) - counts)[own]
    flat = np.full(int(blocks.sum()) * size, -1)
    flat[place] = pixels
    where = flat.reshape(-1, size)

    rows = len(data) * len(layout.groups[0])
    shape = (len(where), len(layout.groups), rows, size)
    values, weights = np.empty(shape), np.empty(shape)
    correlated = layout.joint and noise.covariance is not None
    cross = np.zeros((len(where), 1, len(data), size)) if correlated else None
    step = max(1, BLOCK // size)
    for begin in range(0, len(where), step):
        block = slice(begin, begin + step)
        index = where[block]
        w = np.broadcast_to(noise.weights(index.ravel()), (*data.shape[1::-1], index.size))
        w = np.where(index.ravel() >= 0, w, 1.0)
        x = data[..., index.ravel()]
        x = np.where((index.ravel() >= 0) & (w.swapaxes(0, 1) > 0), x, 0.0)
        if not np.isfinite(x).all() or x.min() < UNSEEN:
            _refuse(data, noise)
        for target, maps in ((values, x), (weights, w.swapaxes(0, 1))):
            split = layout.rows(maps).reshape(*shape[1:3], -1, size)
            target[block] = np.moveaxis(split, 2, 0)
        if cross is not None:
            QU = np.where(index.ravel() >= 0, np.asarray(noise.cross(index.ravel())), 0.0)
            cross[block, 0] = np.moveaxis(QU.reshape(len(data), -1, size), 1, 0)
    in_order = bool(np.all(blocks == 1))
    cell = None if in_order else jnp.asarray(np.repeat(np.arange(cells.number), blocks))
    part = Pixels(
        jnp.asarray(values), jnp.asarray(weights), None if cross is None else jnp.asarray(cross)
    )
    return part, cell
