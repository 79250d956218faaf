"""Passes over the pixels of data and templates: weights, inner products and their rows."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsky import job
from jaxsky.checks import EXACT, UNSEEN
from jaxsky.mesh import SUMS, at_once, maps_of, over_pixels, total

#: Pixels per pass over templates; few enough for the weighted copies to stay in cache.
CHUNK = 1 << 14


@partial(jax.jit, static_argnames="chunk")
@over_pixels(SUMS)
def gram(
    data: Float[Array, "band stokes pix"],
    templates: Float[Array, "template stokes pix"],
    weights: Float[Array, "band stokes pix"],
    chunk: int | None = None,
) -> Float[Array, "band stokes row row"]:
    """Return weighted inner products of (data, templates, 1), per band and Stokes parameter.

    After this one pass over the pixels, a fit with constant laws does not depend on their number:
    a model is a sum of templates, so chi^2 is a quadratic form in their coefficients.
    Weights are 1/sigma^2, zero where masked, and broadcast against the data; `chunk` pixels are
    taken at once. Results for disjoint sets of pixels add up to that of their union.
    """
    bands, _, npix = data.shape
    weights = jnp.broadcast_to(weights, data.shape)

    def products(d, t, w):
        t = jnp.broadcast_to(t, (bands, *t.shape)).swapaxes(1, 2)
        rows = jnp.concatenate([d[:, :, None], t, jnp.ones_like(d)[:, :, None]], axis=2)
        # A masked pixel may contain anything, even NaN.
        rows = jnp.where(w[:, :, None] > 0, rows, 0)
        return jnp.einsum("bsip,bsp,bsjp->bsij", rows, w, rows, precision=EXACT)

    chunk = min(chunk or at_once(CHUNK), npix)
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


def checked_weights(data: Array, sigma: Array) -> tuple[Array, Int[np.ndarray, "band stokes"]]:
    """Return 1/sigma^2 of all data, and how many are not masked per band and Stokes parameter."""
    weights, used, wrong, unseen = _weights(data, sigma)
    if wrong:
        raise ValueError(f"Argument `sigma` has {wrong} of {sigma.size} values that are not > 0.")
    if unseen:
        raise ValueError(
            f"Argument `data` has {unseen} values that are not finite (or UNSEEN) in pixels that "
            "are used; mask them with an infinite `sigma`."
        )
    if not used.any():
        raise ValueError("No pixel is left: the mask, or an infinite `sigma`, covers the map.")
    return weights, np.asarray(used)


@jax.jit
@over_pixels((maps_of(3), SUMS, SUMS, SUMS))
def _weights(data, sigma):
    """Return 1/sigma^2 of all data, and counts of used data, bad sigma and bad data."""
    weights = jnp.broadcast_to(1 / sigma**2, data.shape)
    used = weights > 0
    unseen = used & (~jnp.isfinite(data) | (data < UNSEEN))
    # A sigma without pixels is the same on all devices, and counts once.
    wrong = jnp.sum(~(sigma > 0))
    wrong = total(wrong) if sigma.shape[-1:] == data.shape[-1:] else wrong
    return weights, total(used.sum(axis=-1)), wrong, total(unseen.sum())


def swapped(maps: Float[Array, "*maps stokes x"]) -> Float[Array, "*maps stokes x"]:
    """Exchange Q and U; in place of I, which no angle changes, put any other."""
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

    One band of it is in memory at a time, with the pixels of all devices.
    """

    maps: Float[Array, "template stokes pix"]
    weights: Float[Array, "band stokes pix"]

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
        return job.collected(_of_band(self.maps, self.weights, band), self.shape[-1])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.stack([np.asarray(own, dtype) for own in self])


@partial(jax.jit, static_argnames="band")
def _of_band(maps, weights, band):
    return one_stokes_each(maps[None], weights[band : band + 1])[0]
