"""Passes over the pixels of data and templates: weights, inner products and their rows.

Maps that lie on disk are read range by range.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fits.compress import wrong_data
from jaxsky import job
from jaxsky.checks import EXACT, UNSEEN, as_array
from jaxsky.io.stacks import Computed, Maps, Stack, empty, ranges
from jaxsky.mesh import SUMS, at_once, maps_of, over_pixels, total

#: Pixels per pass over templates; few enough for the weighted copies to stay in cache.
CHUNK = 1 << 14


def as_maps(name: str, maps: Any) -> Array | Stack:
    """Return maps as an array, or as they are if they lie on disk."""
    return maps if isinstance(maps, Stack) else as_array(name, maps)


def stacked(maps: Sequence[Any]) -> Array | Maps:
    """Return maps (stokes, pix) as one array, which is made when it is read if one is on disk."""
    if not any(isinstance(one, Stack) for one in maps):
        return jnp.stack(maps)

    def read(pixels: Any) -> np.ndarray:
        return np.stack([np.asarray(one[..., pixels]) for one in maps])

    return Computed((len(maps), *maps[0].shape), read)


def summed(sums: Callable[..., Any], *maps: Any) -> Any:
    """Return `sums(*maps)`, sums over pixels; of maps on disk, those of all ranges together."""
    on_disk = [one for one in maps if isinstance(one, Stack)]
    if not on_disk:
        return sums(*maps)
    npix = on_disk[0].shape[-1]

    def of_part(part: slice) -> Any:
        return sums(*(m[..., part] if m.shape[-1:] == (npix,) else m for m in maps))

    return reduce(partial(jax.tree.map, jnp.add), map(of_part, ranges(npix)))


@jax.jit
@over_pixels(SUMS)
def gram(
    data: Float[Array, "band stokes pix"],
    templates: Float[Array, "template stokes pix"],
    weights: Float[Array, "band stokes pix"],
) -> Float[Array, "band stokes row row"]:
    """Return weighted inner products of (data, templates, 1), per band and Stokes parameter.

    After this one pass over the pixels, a fit with constant laws does not depend on their number:
    a model is a sum of templates, so chi^2 is a quadratic form in their coefficients.
    Weights are 1/sigma^2, zero where masked, and broadcast against the data. Results for disjoint
    sets of pixels add up to that of their union.
    """
    bands, _, npix = data.shape
    weights = jnp.broadcast_to(weights, data.shape)

    def products(d, t, w):
        t = jnp.broadcast_to(t, (bands, *t.shape)).swapaxes(1, 2)
        rows = jnp.concatenate([d[:, :, None], t, jnp.ones_like(d)[:, :, None]], axis=2)
        # A masked pixel may contain anything, even NaN.
        rows = jnp.where(w[:, :, None] > 0, rows, 0)
        return jnp.einsum("bsip,bsp,bsjp->bsij", rows, w, rows, precision=EXACT)

    chunk = min(at_once(CHUNK), npix)
    whole = npix // chunk * chunk

    def add(found, start):
        def cut(x):
            return jax.lax.dynamic_slice_in_dim(x, start, chunk, axis=-1)

        return found + products(cut(data), cut(templates), cut(weights)), None

    rest = products(data[..., whole:], templates[..., whole:], weights[..., whole:])
    return total(jax.lax.scan(add, rest, jnp.arange(0, whole, chunk))[0])


@jax.jit
@over_pixels(SUMS)
def weighted(
    weights: Float[Array, "band stokes pix"], maps: Float[Array, "source stokes pix"]
) -> Float[Array, "band stokes source"]:
    """Return sums of maps over pixels with the weights of each band."""
    return total(jnp.einsum("bsp,usp->bsu", weights, maps, precision=EXACT))


def checked_weights(data: Any, sigma: Any) -> tuple[Any, Int[np.ndarray, "band stokes"]]:
    """Return 1/sigma^2 of all data, and how many are not masked per band and Stokes parameter."""
    used, wrong, unseen = summed(_counts, data, sigma)
    if wrong:
        raise ValueError(f"Argument `sigma` has {wrong} of {sigma.size} values that are not > 0.")
    if unseen:
        raise wrong_data(unseen, "sigma")
    if not used.any():
        raise ValueError("No pixel is left: the mask, or an infinite `sigma`, covers the map.")
    if isinstance(data, Stack) or isinstance(sigma, Stack):
        return Computed(data.shape, lambda at: 1 / sigma[..., at] ** 2), np.asarray(used)
    return _weights(data, sigma), np.asarray(used)


@jax.jit
@over_pixels(maps_of(3))
def _weights(data, sigma):
    """Return 1/sigma^2 of all data."""
    return jnp.broadcast_to(1 / sigma**2, data.shape)


@jax.jit
@over_pixels(SUMS)
def _counts(data, sigma):
    """Return counts of used data, bad sigma and bad data."""
    used = jnp.broadcast_to(1 / sigma**2, data.shape) > 0
    unseen = used & (~jnp.isfinite(data) | (data < UNSEEN))
    # A sigma without pixels is the same on all devices, and counts once.
    wrong = jnp.sum(~(sigma > 0))
    wrong = total(wrong) if sigma.shape[-1:] == data.shape[-1:] else wrong
    return total(used.sum(axis=-1)), wrong, total(unseen.sum())


def swapped(maps: Any) -> Any:
    """Exchange Q and U of maps (..., stokes, pix); put any other for I, which no angle changes."""
    if isinstance(maps, Stack):
        return Computed(maps.shape, lambda at: swapped(maps[..., at]))
    return maps[..., [-2, -1, -2][-maps.shape[-2] :], :]


@jax.jit
@over_pixels(maps_of(4))
def one_stokes_each(
    maps: Float[Array, "*band template stokes pix"], weights: Float[Array, "band stokes pix"]
) -> Float[Array, "band row stokes pix"]:
    """Return rows W T of each band and map, zero where masked, each of one Stokes parameter."""
    rows = weights[:, None] * jnp.where(weights[:, None] > 0, maps, 0)
    bands, templates, stokes, npix = rows.shape
    split = jnp.eye(stokes)[None, :, None, :, None] * rows[:, None]
    return split.reshape(bands, stokes * templates, stokes, npix)


class Rows(eqx.Module):
    """Rows of `one_stokes_each`, an array (band, row, stokes, pix) that is made when it is read.

    One band of it exists at a time, with the pixels of all devices; on disk if it is large.
    """

    maps: Float[Array, "template stokes pix"] | Maps
    weights: Float[Array, "band stokes pix"] | Maps

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Numbers of bands, rows, Stokes parameters and pixels."""
        bands, stokes, npix = self.weights.shape
        return bands, stokes * len(self.maps), stokes, npix

    def __len__(self) -> int:
        return len(self.weights)

    def __iter__(self) -> Iterator[Any]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, band: int) -> Any:
        if not isinstance(self.weights, Stack):
            return job.collected(_of_band(self.maps, self.weights, band), self.shape[-1])
        found = empty(self.shape[1:])
        for part in ranges(self.shape[-1]):
            found[..., part] = _of_band(self.maps[..., part], self.weights[..., part], band)
        return found

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.stack([np.asarray(own, dtype) for own in self])


@partial(jax.jit, static_argnames="band")
def _of_band(maps, weights, band):
    return one_stokes_each(maps[None], weights[band : band + 1])[0]
