"""Maps at another resolution: smoothed, band-limited, or averaged over pixels."""

from functools import cache, partial

import healpy
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.checks import check_finite, is_concrete
from jaxsky.harmonics.packing import expand, resize
from jaxsky.harmonics.transforms import analysis, synthesis
from jaxsky.harmonics.windows import beam_ratio, needed_lmax

#: Multipoles analysed by `low_multipoles`, in units of those kept, as far as the map resolves them.
MARGIN = 3


def low_multipoles(
    maps: Float[Array, "stokes pix"], lmax: int, iterations: int | None = None
) -> Float[Array, "stokes alm"]:
    """Packed coefficients up to lmax of maps that have higher multipoles, too.

    Multipoles beyond those that are analysed leak into them, so more are than are kept.

    Parameters
    ----------
    maps : shape (stokes, pix), RING; one row is I, two are Q, U, three are I, Q, U
    lmax : largest multipole kept; above 2 nside of the maps coefficients are zero
    iterations : of `analysis`
    """
    resolved = 2 * healpy.npix2nside(maps.shape[-1])
    return resize(analysis(maps, min(resolved, MARGIN * lmax), iterations), lmax)


@partial(jax.jit, static_argnames="nside")
def resample(
    maps: Float[Array, "stokes pix"], window: Float[Array, " ell"], nside: int
) -> Float[Array, "stokes pix"]:
    """Maps times a window in l, at another resolution: smoothing and degrading in one.

    Linear in the maps, with an exact transpose. Multipoles above those of the window are cut,
    so a degraded map is band-limited rather than averaged over pixels.

    Parameters
    ----------
    maps : shape (stokes, pix), RING; one row is I, two are Q, U, three are I, Q, U
    window : factor for each multipole 0 ... lmax; above 2 nside of the input nothing is left
    nside : resolution of the result
    """
    return synthesis(low_multipoles(maps, len(window) - 1) * expand(window), nside)


def smooth(
    maps: Float[Array, "stokes pix"],
    fwhm: ArrayLike,
    own: ArrayLike = 0.0,
    lmax: int | None = None,
) -> Float[Array, "stokes pix"]:
    """Maps with their own beam, smoothed to another; differentiable in maps and widths.

    Parameters
    ----------
    maps : shape (stokes, pix), RING; one row is I, two are Q, U, three are I, Q, U
    fwhm, own : the target and what the maps have already, see `beam_ratio`
    lmax : largest multipole kept; by default 2 nside, or what the beam leaves if that is known

    Raises
    ------
    ValueError
        If the target is finer than the maps' own beam, or values are not finite or UNSEEN.
    """
    check_finite("maps", maps)
    nside = healpy.npix2nside(maps.shape[-1])
    window = beam_ratio(fwhm, own, 2 * nside if lmax is None else lmax)
    if lmax is None and is_concrete(window):
        window = window[: needed_lmax(window) + 1]
    return resample(maps, window, nside)


@cache
def _children(nside_in: int, nside_out: int) -> np.ndarray:
    """RING indices at nside_in of the pixels inside each pixel at nside_out, (pix_out, child)."""
    parents = healpy.ring2nest(nside_out, np.arange(healpy.nside2npix(nside_out)))
    ratio = (nside_in // nside_out) ** 2
    return healpy.nest2ring(nside_in, parents[:, None] * ratio + np.arange(ratio))


def children(maps: Float[Array, "... pix"], nside: int) -> Float[Array, "... parent child"]:
    """Pixels of maps, grouped by the pixel of a lower resolution that they lie in (RING)."""
    nside_in = healpy.npix2nside(maps.shape[-1])
    return maps[..., _children(nside_in, nside)]


def average_pixels(maps: Float[Array, "... pix"], nside: int) -> Float[Array, "... pix"]:
    """Maps at a lower resolution as means over pixels, like healpy's ud_grade (RING)."""
    return children(maps, nside).mean(axis=-1)
