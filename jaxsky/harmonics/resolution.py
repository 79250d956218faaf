"""Change the resolution of maps: smooth, band-limit or average over pixels; windows in l."""

import math
from collections.abc import Sequence
from functools import cache, partial

import ducc0
import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.arrays import Alm, Beam, Map, StokesMaps, Window
from jaxsky.checks import check_finite, check_shape, is_concrete
from jaxsky.harmonics.transforms import analysis, expand, map_variance, resize, synthesis

#: A window below this is treated as zero: what it lets through is lost in rounding.
NEGLIGIBLE = 1e-12
#: A tabulated target may exceed a map's own window by this fraction, as measured tables do.
FINER = 0.01


@partial(jax.jit, static_argnames="lmax")
def gaussian_beam(fwhm: ArrayLike, lmax: int, own: ArrayLike = 0.0) -> Window:
    """Return the window b_l = exp(-l (l+1) sigma^2 / 2) of a Gaussian beam of `fwhm` [arcmin].

    The same window serves temperature and polarization, as in the paper; healpy's window for
    polarization differs by exp(2 sigma^2), 1.0001 for 1 degree. With a beam `own` it is that of
    sqrt(fwhm^2 - own^2). Differentiable in the widths.
    """
    variance = (jnp.square(fwhm) - jnp.square(own)) * math.radians(1 / 60) ** 2 / (8 * math.log(2))
    ell = jnp.arange(lmax + 1)
    return jnp.exp(-ell * (ell + 1) * variance / 2)


def beam_ratio(target: ArrayLike, own: ArrayLike, lmax: int, what: str = "the map") -> Window:
    """Return the window that takes a map from its own beam to a target, differentiable in both.

    Each beam is the full width at half maximum of a Gaussian [arcmin], or a table b_l, l = 0 ...;
    for two Gaussians the window is that of sqrt(target^2 - own^2). `what` names the map in errors.
    """
    target, own = jnp.asarray(target, float), jnp.asarray(own, float)
    if not target.ndim and not own.ndim:
        if is_concrete(target) and is_concrete(own) and float(target) < float(own):
            raise ValueError(
                f"The target beam of {float(target):g} arcmin is finer than that of {what}, "
                f"{float(own):g} arcmin."
            )
        return gaussian_beam(target, lmax, own)
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


def _window(beam: Array, lmax: int, what: str) -> Window:
    if not beam.ndim:
        return gaussian_beam(beam, lmax)
    if len(beam) <= lmax:
        raise ValueError(f"The beam table of {what} ends at l = {len(beam) - 1}, not at {lmax}.")
    return beam[: lmax + 1]


def needed_lmax(window: Float[Array | np.ndarray, " ell"]) -> int:
    """Return the last multipole at which a window is not negligible."""
    return int(np.flatnonzero(np.abs(np.asarray(window)) > NEGLIGIBLE).max(initial=0))


def shortened(window: Window) -> Window:
    """Cut a window where it becomes negligible for good, unless it is being traced."""
    # Q and U have no multipoles below 2.
    return window[: max(2, needed_lmax(window)) + 1] if is_concrete(window) else window


def pixel_window(nside: int, lmax: int) -> Float[np.ndarray, " ell"]:
    """Return the pixel window, approximated by a disc of the pixel's area, 2 J_1(x)/x."""
    # healpy has tables, but fetches them over the network.
    from scipy.special import j1  # slower to import than most windows are to compute

    ell, radius = np.arange(lmax + 1), math.sqrt(healpy.nside2pixarea(nside) / np.pi)
    x = np.sqrt(ell * (ell + 1)) * radius
    return np.where(x > 0, 2 * j1(x) / np.where(x > 0, x, 1), 1.0)


#: An analysis extends to this times the largest multipole kept, as far as the map resolves it.
MARGIN = 3
#: Up to this fraction of nside, quadrature needs neither iterations nor a margin: a multipole up to
#: three times as high leaks by some 1e-6 at nside 128, and less with finer pixels. Variances, whose
#: spectra are steep, allow a larger fraction.
FINE, FINE_VARIANCE = 0.25, 0.375


def low_multipoles(maps: StokesMaps, lmax: int, iterations: int | None = None) -> Alm:
    """Return coefficients up to lmax of maps that have higher multipoles; zero above 2 nside."""
    # Multipoles beyond those analysed leak into the result, so more are analysed than are kept.
    resolved = 2 * healpy.npix2nside(maps.shape[-1])
    return resize(analysis(maps, min(resolved, MARGIN * lmax), iterations), lmax)


@partial(jax.jit, static_argnames=("nside", "iterations", "fine"))
def resample(
    maps: StokesMaps, window: Window, nside: int, iterations: int | None = None, fine: float = 0.0
) -> StokesMaps:
    """Multiply maps by a window in l and change their nside: smooth and degrade in one step.

    Linear in the maps, with an exact transpose. Multipoles above those of the window are cut,
    so a degraded map is band-limited rather than averaged over pixels; nothing is left above
    2 nside of the input. If the window ends below the fraction `fine` of the maps' nside, only its
    own multipoles are analysed, without Jacobi steps (`iterations`).
    """
    lmax = len(window) - 1
    if lmax <= fine * healpy.npix2nside(maps.shape[-1]):
        alm = analysis(maps, lmax, 0)
    else:
        alm = low_multipoles(maps, lmax, iterations)
    return synthesis(alm * expand(window), nside)


def smooth(
    maps: StokesMaps, fwhm: ArrayLike, own: ArrayLike = 0.0, lmax: int | None = None
) -> StokesMaps:
    """Smooth maps from their own beam to another; differentiable in maps and widths.

    The maps are I, or Q, U, or I, Q, U, shape (stokes, pix), RING; for the beams see `beam_ratio`.
    Multipoles are kept up to lmax, by default 2 nside, or less where the beam leaves nothing.

    Raises
    ------
    ValueError
        For a wrong shape, a target finer than the maps' own beam, or values that are not finite.
    """
    good = maps.ndim == 2 and healpy.isnpixok(maps.shape[-1])
    check_shape("maps", maps, good, "have shape (stokes, pix) with 12 nside^2 pixels")
    check_finite("maps", maps)
    nside = healpy.npix2nside(maps.shape[-1])
    window = beam_ratio(fwhm, own, 2 * nside if lmax is None else lmax)
    return resample(maps, shortened(window) if lmax is None else window, nside)


@cache
def _children(nside_in: int, nside_out: int) -> np.ndarray:
    """Return RING indices at nside_in of the pixels inside each at nside_out, (pix_out, child)."""
    parents = healpy.ring2nest(nside_out, np.arange(healpy.nside2npix(nside_out)))
    ratio = (nside_in // nside_out) ** 2
    return healpy.nest2ring(nside_in, parents[:, None] * ratio + np.arange(ratio))


def children(maps: Float[Array, "... pix"], nside: int) -> Float[Array, "... parent child"]:
    """Group the pixels of maps by the pixel of a lower resolution that contains them (RING)."""
    nside_in = healpy.npix2nside(maps.shape[-1])
    return maps[..., _children(nside_in, nside)]


def average_pixels(maps: Float[Array, "... pix"], nside: int) -> Float[Array, "... pix"]:
    """Degrade maps by averaging over pixels, like healpy's ud_grade (RING)."""
    return children(maps, nside).mean(axis=-1)


class Preparation(eqx.Module):
    """Operator that takes maps to a common beam and nside, or averages over pixels only."""

    window: Window | None  # None averages pixels and leaves the beam unchanged
    nside_in: int = eqx.field(static=True)
    nside: int = eqx.field(static=True)

    @classmethod
    def smoothing(
        cls, nside_in: int, own: Beam, nside: int, fwhm: float | None, lmax: int, what: str = "map"
    ) -> "Preparation":
        """Smooth from the maps' own beam to a Gaussian up to lmax or less (see `beam_ratio`).

        With None for `fwhm`, pixels are averaged instead.
        """
        if nside > nside_in:
            raise ValueError(f"The common nside {nside} is larger than that of {what}, {nside_in}.")
        window = None if fwhm is None else shortened(beam_ratio(fwhm, own, lmax, what))
        return cls(window, nside_in, nside)

    def __call__(self, maps: StokesMaps) -> StokesMaps:
        """Return the maps at the common resolution."""
        if self.window is None:
            return average_pixels(maps, self.nside)
        return resample(maps, self.window, self.nside, fine=FINE)

    @eqx.filter_jit
    def transpose(self, maps: StokesMaps) -> StokesMaps:
        """Apply the transposed operator, from the common resolution to that of the maps."""
        shape = (len(maps), healpy.nside2npix(self.nside_in))
        return jax.linear_transpose(self, jax.ShapeDtypeStruct(shape, maps.dtype))(maps)[0]

    def variance(self, variance: Sequence[Map]) -> StokesMaps:
        """Return the variance of prepared white noise, given the variance of each input pixel."""
        if self.window is None:
            mean = average_pixels(jnp.asarray(variance, float), self.nside)
            return mean * (self.nside / self.nside_in) ** 2
        # That of a smoothed map is the map of variances smoothed by the square of the kernel.
        squared = jnp.asarray(_squared_window(np.asarray(self.window), 2 * self.nside_in))
        area = healpy.nside2pixarea(self.nside_in)
        rows = []
        for row in variance:  # one by one: a row may be as large as everything else
            values = jnp.asarray(row[None], float)
            smoothed = resample(values, squared, self.nside, fine=FINE_VARIANCE)
            rows.append((area * smoothed[0]).block_until_ready())
        return jnp.stack(rows)

    def uniform_variance(self, level: float) -> float:
        """Return the variance of prepared white noise of a level [u arcmin]."""
        if self.window is None:
            return (level / healpy.nside2resol(self.nside, arcmin=True)) ** 2
        return map_variance((level * np.radians(1 / 60) * np.asarray(self.window)) ** 2)


def _squared_window(window: np.ndarray, highest: int) -> np.ndarray:
    """Return the window of the squared kernel, exact on Gauss-Legendre nodes, given its window."""
    lmax = min(2 * (len(window) - 1), highest)
    order = 2 * len(window) + lmax
    x = np.cos(ducc0.misc.GL_thetas(order))
    weights = ducc0.misc.GL_weights(order, 1) / (2 * np.pi)
    ell = np.arange(len(window))
    kernel = np.polynomial.legendre.legval(x, (2 * ell + 1) / (4 * np.pi) * window)
    return 2 * np.pi * (weights * kernel**2) @ np.polynomial.legendre.legvander(x, lmax)
