"""Windows in l of beams and pixels."""

import math
from functools import partial

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.checks import is_concrete

#: A window below this is nothing: what it lets through is lost in rounding.
NEGLIGIBLE = 1e-12
#: By this much a tabulated target may exceed a map's own window, as measured tables do.
FINER = 0.01


def gaussian_beam(fwhm: ArrayLike, lmax: int) -> Float[Array, " ell"]:
    """Window b_l = exp(-l (l+1) sigma^2 / 2) of a Gaussian beam, differentiable in its width.

    The same window serves temperature and polarization, as in the paper; healpy's polarized
    one differs by exp(2 sigma^2), 1.0001 for 1 degree. The width is in arcmin.
    """
    return _gaussian(fwhm, 0.0, lmax)


@partial(jax.jit, static_argnames="lmax")
def _gaussian(fwhm: ArrayLike, own: ArrayLike, lmax: int) -> Float[Array, " ell"]:
    """Window of a Gaussian, divided by that of another."""
    variance = (jnp.square(fwhm) - jnp.square(own)) * math.radians(1 / 60) ** 2 / (8 * math.log(2))
    ell = jnp.arange(lmax + 1)
    return jnp.exp(-ell * (ell + 1) * variance / 2)


def beam_ratio(
    target: ArrayLike, own: ArrayLike, lmax: int, what: str = "the map"
) -> Float[Array, " ell"]:
    """Window that takes a map from its own beam to a target, differentiable in both.

    Each is the full width at half maximum of a Gaussian [arcmin], or a table b_l, l = 0 ...;
    between two Gaussians that is the Gaussian of sqrt(target^2 - own^2). `what` has its own beam.
    """
    target, own = jnp.asarray(target, float), jnp.asarray(own, float)
    if not target.ndim and not own.ndim:
        if is_concrete(target) and is_concrete(own) and float(target) < float(own):
            raise ValueError(
                f"The target beam of {float(target):g} arcmin is finer than that of {what}, "
                f"{float(own):g} arcmin."
            )
        return _gaussian(target, own, lmax)
    over, under = _window(target, lmax, "the target"), _window(own, lmax, what)
    empty = jnp.abs(under) < NEGLIGIBLE
    ratio = jnp.where(empty, 0.0, over / jnp.where(empty, 1.0, under))
    if is_concrete(ratio) and float(jnp.abs(ratio).max()) > 1 + FINER:
        at = int(jnp.abs(ratio).argmax())
        raise ValueError(
            f"The target beam is finer than that of {what}: at l = {at} their windows are "
            f"{float(over[at]):.3g} and {float(under[at]):.3g}."
        )
    return ratio


def _window(beam: Array, lmax: int, what: str) -> Float[Array, " ell"]:
    if not beam.ndim:
        return gaussian_beam(beam, lmax)
    if len(beam) <= lmax:
        raise ValueError(f"The beam table of {what} ends at l = {len(beam) - 1}, not at {lmax}.")
    return beam[: lmax + 1]


def needed_lmax(window: Float[Array, " ell"]) -> int:
    """The last multipole that a window does not make negligible."""
    return int(np.flatnonzero(np.abs(np.asarray(window)) > NEGLIGIBLE).max(initial=0))


def shortened(window: Float[Array, " ell"]) -> Float[Array, " ell"]:
    """A window without the multipoles beyond which it is negligible, unless it is being traced."""
    return window[: needed_lmax(window) + 1] if is_concrete(window) else window


def pixel_window(nside: int, lmax: int) -> Float[np.ndarray, " ell"]:
    """Window of averaging over pixels, that of a disc of the pixel's area, 2 J_1(x)/x.

    healpy has its own tables, but fetches them over the network.
    """
    from scipy.special import j1  # takes longer to import than most windows take

    x = np.sqrt(np.arange(lmax + 1) * np.arange(1, lmax + 2)) * math.sqrt(
        healpy.nside2pixarea(nside) / np.pi
    )
    return np.where(x > 0, 2 * j1(x) / np.where(x > 0, x, 1), 1.0)
