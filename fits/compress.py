"""Compress maps and their noise for the spectral likelihood.

Where noise is separable, a number per band times a map, the likelihood depends on the data only
through the covariance of bands D = sum_p d_p d_p^T / sigma_p^2 of each cell. Any few vectors with
the same covariance give the same chi^2, exactly and at all parameters: the columns of a square root
of D replace the pixels. Everything else is streamed over pixels, from disk if need be.

Other pixels are arranged in blocks of one cell each. They are gathered in memory, or read anew
whenever they are needed if the maps are on disk.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fits.regions import Cells
from fits.systems import Pixels, square_root
from jaxsky.checks import UNSEEN, Numeric, check_shape
from jaxsky.io.stacks import Maps, Stack, ranges
from jaxsky.mesh import as_double, module_of, spread, typed
from jaxsky.public import refuse_unit, takes_quantities

#: Pixels per pass over data, and in a block of the likelihood: few enough for the cache, enough for
#: its loops.
PIECE, BLOCK = 1 << 15, 4096
#: Pixels in memory at once if the maps are on disk.
STREAM = 1 << 17
#: Ratios of sigma between bands that are constant to this accuracy make noise separable: smoothed
#: maps of the variance of uniform noise ring by 1e-7.
ROUNDING = 1e-6


@takes_quantities
def bare(name: str, value: object) -> np.ndarray:
    """Return a numeric array without a copy, in its own precision; those on disk stay there."""
    refuse_unit(name, value)
    if isinstance(value, Stack):
        return value  # type: ignore[return-value]
    array: Any = typed(value) if spread(value) else np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"Argument `{name}` must be a real array, but is {array.dtype}.")
    return array


class Noise(NamedTuple):
    """Gaussian noise, independent between pixels and bands; see `as_noise`.

    It has standard deviations, times a factor in each pixel that is infinite where masked, or
    covariances of Q and U instead.
    """

    sigma: Float[np.ndarray, "band stokes #pix"] | None
    pixel_sigma: Float[np.ndarray, " pix"] | None = None
    covariance: Float[np.ndarray, "band 2 2 pix"] | None = None

    @property
    def separable(self) -> bool:
        """True if it is a number per band and Stokes parameter times a map."""
        return self.sigma is not None and self.sigma.shape[-1] == 1

    def at(self, pixels: Any) -> "Noise":
        """Return the noise of some of the pixels."""
        return jax.tree.map(lambda x: x if x.shape[-1] == 1 else x[..., pixels], self)

    def pixel_weights(self, pixels: slice | np.ndarray) -> Float[np.ndarray, " pix"] | float:
        """Return 1 / pixel_sigma^2 in some of the pixels."""
        if self.pixel_sigma is None:
            return 1.0
        return 1 / as_double(self.pixel_sigma[pixels]) ** 2

    def weights(self, pixels: slice | np.ndarray) -> Float[np.ndarray, "band stokes #pix"]:
        """Return inverse variances, or the diagonal of inverse covariances; 0 where masked."""
        return self.inverse(pixels)[0]

    def inverse(self, pixels: Any) -> tuple[np.ndarray, Float[np.ndarray, "band pix"] | None]:
        """Return `weights`, and element QU of the inverse covariances, None without these."""
        if self.covariance is not None:
            QQ, UU, QU, determinant = self._elements(pixels)
            weights = module_of(QQ).stack([UU / determinant, QQ / determinant], axis=1)
            return weights, -QU / determinant
        assert self.sigma is not None
        sigma = self.sigma if self.separable else self.sigma[..., pixels]
        return 1 / as_double(sigma) ** 2 * self.pixel_weights(pixels), None

    def _elements(self, pixels):
        """Return QQ, UU and QU of the covariances, and the determinants; infinite where masked."""
        assert self.covariance is not None
        block = as_double(self.covariance[..., pixels])
        xp = module_of(block)
        masked = ~xp.isfinite(block[:, 0, 0]) | ~xp.isfinite(block[:, 1, 1])
        QQ, UU = (xp.where(masked, 1.0, block[:, s, s]) for s in range(2))
        QU = xp.where(masked, 0.0, block[:, 0, 1])
        return QQ, UU, QU, xp.where(masked, np.inf, QQ * UU - QU**2)


def as_noise(
    noise: Noise | Numeric,
    shape: tuple[int, int, int],
    pixel_sigma: Numeric | None = None,
) -> Noise:
    """Return the noise of data from standard deviations or covariances.

    Standard deviations whose ratios between bands and Stokes parameters are the same in all pixels
    are recognised: then the likelihood does not depend on the number of pixels.

    Parameters
    ----------
    noise : standard deviations in the unit of the data, of shape (band,), (band, stokes) or
        (band, stokes, pix), infinite where masked; or covariances of Q and U (band, 2, 2, pix),
        with an infinite diagonal where masked
    shape : (band, stokes, pix) of the data
    pixel_sigma : factor on the standard deviations in each pixel, (pix,)
    """
    if isinstance(noise, Noise):
        return noise
    array = bare("noise", noise)
    if np.shape(shape) != (3,):
        raise ValueError(
            "Argument `shape` must be the shape (band, stokes, pix) of the data, but has itself "
            f"shape {np.shape(shape)}."
        )
    bands, stokes, npix = shape
    known = [(bands,), (bands, stokes), shape, (bands, 2, 2, npix)]
    good = array.shape in known and (array.ndim < 4 or stokes == 2)
    shapes = "(band,), (band, stokes), (band, stokes, pix) or, for Q and U, (band, 2, 2, pix)"
    check_shape("noise", array, good, f"have shape {shapes} for data of shape {shape}")
    pixel = None if pixel_sigma is None else bare("pixel_sigma", pixel_sigma)
    if pixel is not None:
        if pixel.shape != (npix,) or array.ndim > 2:
            raise ValueError(
                f"Argument `pixel_sigma` must have shape ({npix},) and go with `noise` of shape "
                f"(band,) or (band, stokes), but they have shapes {pixel.shape} and {array.shape}."
            )
        check_sigma("pixel_sigma", pixel)
    if array.ndim == 4:
        return _covariance(array)
    check_sigma("noise", array)
    if spread(array):
        return Noise(array)
    if array.ndim < 3:
        if not np.isfinite(array).all():
            raise ValueError("Argument `noise` must be finite for a whole band; leave it out.")
        sigma = array.reshape(bands, -1)[..., None]
        return Noise(np.broadcast_to(sigma, (bands, stokes, 1)), pixel)
    return _separated(array) or Noise(array)


def check_sigma(name: str, sigma: np.ndarray) -> None:
    """Raise ValueError, with their number, for values that are not > 0; infinite ones are."""
    parts = ranges(sigma.shape[-1], PIECE) if isinstance(sigma, Stack) else [slice(None)]
    if bad := int(sigma.size - sum((sigma[..., part] > 0).sum() for part in parts)):
        raise ValueError(f"Argument `{name}` has {bad} of {sigma.size} values that are not > 0.")


def _separated(sigma: np.ndarray) -> Noise | None:
    """Return separable noise, or None if the noise is not separable."""
    first = np.empty(sigma.shape[-1])
    for part in ranges(first.size, PIECE):
        first[part] = sigma[..., part][0, 0]
    finite = np.isfinite(first)
    if not finite.any():
        return None
    at = int(np.argmax(finite))
    ratio = sigma[..., at : at + 1] / first[at]
    if not np.isfinite(ratio).all():
        return None
    for part in ranges(first.size, PIECE):
        expected, own = ratio * first[part], sigma[..., part]
        with np.errstate(invalid="ignore"):
            off = np.abs(own - expected) > ROUNDING * expected
        if off.any() or np.any(np.isfinite(own) != finite[part]):
            return None
    return Noise(ratio, first)


def _covariance(covariance: np.ndarray) -> Noise:
    noise = Noise(None, None, covariance)
    bad, xp = 0, module_of(covariance)
    for part in [slice(None)] if spread(covariance) else ranges(covariance.shape[-1], PIECE):
        QQ, UU, _, determinant = noise._elements(part)
        block = covariance[..., part]
        asymmetric = xp.isfinite(determinant) & (block[:, 0, 1] != block[:, 1, 0])
        bad += int(xp.sum(~((QQ > 0) & (UU > 0) & (determinant > 0)) | asymmetric))
    if bad:
        size = covariance.shape[0] * covariance.shape[-1]
        raise ValueError(
            f"Argument `noise` is not positive definite in {bad} of {size} values (band, pix)."
        )
    return noise


class Layout(NamedTuple):
    """Stokes parameters, by position, that share a mixing matrix.

    If `joint`, Q and U form one system, with the rows of Q before those of U; else one each.
    `columns` are the components that they have, by position; None for all.
    """

    joint: bool
    stokes: tuple[int, ...]
    columns: tuple[int, ...] | None = None

    @classmethod
    def of(cls, stokes: int, joint: bool, polarized: Sequence[bool] = ()) -> tuple["Layout", ...]:
        """Return those of all Stokes parameters; `joint` if Q and U depend on each other.

        `polarized` says whether each component is, by default all; those that are not are absent
        from Q and U next to I.
        """
        some = stokes == 3 and not all(polarized)
        if not (joint or some):
            return (cls(False, tuple(range(stokes))),)
        columns = tuple(i for i, own in enumerate(polarized) if own) if some else None
        of_QU = cls(joint, (stokes - 2, stokes - 1), columns)
        return (of_QU,) if stokes == 2 else (cls(False, (0,)), of_QU)

    def own(self, values: Any, axis: int = 0) -> Any:
        """Return the entries of the components that these Stokes parameters have."""
        if self.columns is None:
            return values
        return module_of(values).take(values, np.array(self.columns), axis=axis)

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Stokes parameters of each system."""
        return (self.stokes,) if self.joint else tuple((s,) for s in self.stokes)

    def rows(self, maps: np.ndarray) -> np.ndarray:
        """Return maps (band, stokes, pix) as (group, row, pix)."""
        xp = module_of(maps)
        return xp.stack([xp.concatenate([maps[:, s] for s in group]) for group in self.groups])

    def maps(self, rows: np.ndarray) -> np.ndarray:
        """Return the inverse for these Stokes parameters: (row or unknown, stokes, pix)."""
        if self.joint:
            rows = rows.reshape(2, -1, rows.shape[-1])
        return rows.swapaxes(0, 1)


def refuse_data(data: np.ndarray, noise: Noise) -> None:
    """Raise the error for data that are not finite in used pixels."""
    bad = 0
    for part in ranges(data.shape[-1], PIECE):
        values = data[..., part]
        wrong = ~np.isfinite(values) | (values < UNSEEN)
        bad += int(np.sum(wrong & (noise.weights(part) > 0)))
    raise wrong_data(bad)


def wrong_data(bad: int, noise: str = "noise") -> ValueError:
    """Return the error for a number of data that are not finite where `noise` is."""
    return ValueError(
        f"Argument `data` has {bad} values that are not finite (or UNSEEN) in pixels that are "
        f"used; mask them with an infinite `{noise}`."
    )


def band_covariance(
    data: np.ndarray, noise: Noise, cells: Cells, used: np.ndarray, layout: Layout
) -> Float[np.ndarray, "cell group row row"]:
    """Return D = sum_p d_p d_p^T / sigma_p^2 over the pixels of each cell, in one pass.

    `data` are maps (band, stokes, pix), of any precision and on disk if need be; `noise` is
    separable, and its factor per band is not applied.
    """
    size = len(data) * len(layout.groups[0])
    total = np.zeros((cells.number, len(layout.groups), size, size))
    for part in ranges(data.shape[-1], PIECE):
        root = np.sqrt(noise.pixel_weights(part))
        values = np.asarray(data[..., part], float)
        for g, x in enumerate(layout.rows(values)):
            if noise.pixel_sigma is not None:
                x = np.where(used[part], x * root, 0)
            if x.min() < UNSEEN:
                refuse_data(data, noise)
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
        refuse_data(data, noise)
    return total


def compressed(
    covariance: Float[np.ndarray, "cell group row row"], noise: Noise, layout: Layout
) -> Pixels:
    """Return as many vectors as there are rows in place of the pixels of each cell; exact.

    `covariance` is that of bands, see `band_covariance`.
    """
    weights = layout.rows(1 / np.asarray(noise.sigma) ** 2)
    if all(np.array_equal(weights[0], w) for w in weights[1:]):
        covariance, weights = covariance.sum(axis=1, keepdims=True), weights[:1]
    root = jnp.swapaxes(square_root(jnp.asarray(covariance)), -1, -2)
    return Pixels(root, jnp.broadcast_to(weights, (len(covariance), *weights.shape)))


def pixel_rows(data: Any, noise: Noise, layout: Layout, pixels: Any, used: Any) -> Pixels:
    """Return some pixels, as arrays of the module of the data; unused ones are zero, of weight 1.

    If noise is the same in all pixels and all are used, for which `used` is None, the weights are
    those of a single pixel.
    """
    (weights, cross), xp = noise.inverse(pixels), module_of(data)
    values = xp.where(weights > 0, as_double(data[..., pixels]), 0.0)
    if used is not None:
        values, weights = xp.where(used, values, 0.0), xp.where(used, weights, 1.0)
        cross = None if cross is None else xp.where(used, cross, 0.0)
    rows: Any = layout.rows(values), layout.rows(weights), None if cross is None else cross[None]
    return Pixels(*rows)


class Blocks(NamedTuple):
    """Pixels in blocks of a single cell, -1 in the padding, and the cell of each block."""

    pixels: Int[Array | np.ndarray, "block size"]
    cell: Int[Array | np.ndarray, " block"]


def arranged(
    parts: Sequence[np.ndarray], cells: int, most: Callable[[list[int]], int] = max
) -> list[Blocks]:
    """Return the pixels of each part in blocks; all parts have as many, of one size.

    A part has the cell of each pixel, -1 where not used. `most` returns the largest of numbers.
    """
    counts = [np.bincount(own[own >= 0], minlength=cells) for own in parts]
    size = most([min(BLOCK, int(np.median(n[n > 0]))) if n.any() else 1 for n in counts])
    blocks = [-(-n // size) for n in counts]
    number = most([int(n.sum()) for n in blocks])
    found = []
    for own, pixels, of_cell in zip(parts, counts, blocks, strict=True):
        order = np.argsort(own, kind="stable")[len(own) - pixels.sum() :]
        own = own[order]
        begin, first = (np.cumsum(n) - n for n in (of_cell * size, pixels))
        cell = np.repeat(np.arange(cells), of_cell)
        cell = np.pad(cell, (0, number - len(cell)))
        flat = np.full(number * size, -1, np.int32)
        flat[(begin - first)[own] + np.arange(own.size)] = order
        found.append(Blocks(flat.reshape(-1, size), cell))
    return found


def blocks(cells: Cells, used: np.ndarray) -> Blocks:
    """Arrange the used pixels by cells."""
    own = np.where(used, 0, -1).astype(np.int32) if cells.of_pixel is None else cells.of_pixel
    return arranged([own], cells.number)[0]


def _read(data: Maps, noise: Noise, layout: Layout, where: Any) -> Pixels:
    """Return the pixels of some blocks, (block, group, row, pix), as arrays of numpy."""
    index = where.ravel()
    used = index >= 0
    whole = used.all() and index[-1] - index[0] == len(index) - 1 and np.all(np.diff(index) > 0)
    pixels = slice(int(index[0]), int(index[-1]) + 1) if whole else index
    found = pixel_rows(data, noise, layout, pixels, used)
    if not np.isfinite(found.data).all() or found.data.min() < UNSEEN:
        refuse_data(data, noise)
    return jax.tree.map(lambda x: np.moveaxis(x.reshape(*x.shape[:2], *where.shape), 2, 0), found)


def streamed(
    data: Maps, noise: Noise, blocks: Blocks, layouts: Sequence[Layout]
) -> Iterator[tuple[tuple[Pixels, ...], Array]]:
    """Yield the pixels of a few blocks at a time, for each layout, and the cells of the blocks.

    Pixels in the padding are zero, of weight 1. There are as many blocks each time but the last.
    """
    number, size = blocks.pixels.shape
    for some in ranges(number, max(1, STREAM // size)):
        read = tuple(_read(data, noise, layout, blocks.pixels[some]) for layout in layouts)
        yield jax.tree.map(jnp.asarray, (read, blocks.cell[some]))


def gathered(data: np.ndarray, noise: Noise, blocks: Blocks, *, layout: Layout) -> Pixels:
    """Return the pixels in blocks, padded with zeros of unit weight."""
    number, size = blocks.pixels.shape
    every: Any = None
    for some in ranges(number, max(1, BLOCK // size)):
        read = _read(data, noise, layout, blocks.pixels[some])
        if every is None:
            every = jax.tree.map(lambda own: np.empty((number, *own.shape[1:])), read)
        for target, own in zip(*map(jax.tree.leaves, (every, read)), strict=True):
            target[some] = own
    return jax.tree.map(jnp.asarray, every)
