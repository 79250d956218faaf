"""Maps at another resolution: smoothed, band-limited, or averaged over pixels; windows in l."""

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

from jaxsky.checks import check_finite, is_concrete
from jaxsky.harmonics.transforms import analysis, expand, map_variance, resize, synthesis

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


#: Multipoles analysed in units of those kept, as far as the map resolves them.
MARGIN = 3
#: Up to this fraction of nside the quadrature of an analysis is good without steps or margin: what
#: a multipole adds to another, up to three times as high, is some 1e-6 of it at nside 128, and the
#: less, the finer the pixels are. Variances, whose spectra are steep, take a larger fraction.
FINE, FINE_VARIANCE = 0.25, 0.375


def low_multipoles(
    maps: Float[Array, "stokes pix"], lmax: int, iterations: int | None = None
) -> Float[Array, "stokes alm"]:
    """Packed coefficients up to lmax of maps that have higher multipoles, too.

    Multipoles beyond those that are analysed leak into them, so more are than are kept. Above
    2 nside of the maps coefficients are zero.
    """
    resolved = 2 * healpy.npix2nside(maps.shape[-1])
    return resize(analysis(maps, min(resolved, MARGIN * lmax), iterations), lmax)


@partial(jax.jit, static_argnames=("nside", "iterations", "fine"))
def resample(
    maps: Float[Array, "stokes pix"],
    window: Float[Array, " ell"],
    nside: int,
    iterations: int | None = None,
    fine: float = 0.0,
) -> Float[Array, "stokes pix"]:
    """Maps times a window in l, at another resolution: smoothing and degrading in one.

    Linear in the maps, with an exact transpose. Multipoles above those of the window are cut,
    so a degraded map is band-limited rather than averaged over pixels; above 2 nside of the input
    nothing is left. A window that ends below the fraction `fine` of the nside of the maps takes an
    analysis without steps (`iterations`), of its own multipoles only.
    """
    lmax = len(window) - 1
    if lmax <= fine * healpy.npix2nside(maps.shape[-1]):
        alm = analysis(maps, lmax, 0)
    else:
        alm = low_multipoles(maps, lmax, iterations)
    return synthesis(alm * expand(window), nside)


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
    return resample(maps, shortened(window) if lmax is None else window, nside)


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


class Preparation(eqx.Module):
    """Smooth to a common beam and degrade to a common nside, or average pixels only.

    The window has a factor for each multipole; None averages pixels and leaves the beam as it is.
    """

    window: Float[Array, " ell"] | None
    nside_in: int = eqx.field(static=True)
    nside: int = eqx.field(static=True)

    @classmethod
    def smoothing(
        cls,
        nside_in: int,
        own: float | Array,
        nside: int,
        fwhm: float,
        lmax: int,
        what: str = "map",
    ) -> "Preparation":
        """Smooth from an own beam to one of fwhm [arcmin], by sqrt(fwhm^2 - own^2).

        `own` is the FWHM of a Gaussian [arcmin], or a table b_l.
        """
        _check_nside(nside_in, nside, what)
        return cls(beam_ratio(fwhm, own, lmax, what), nside_in, nside)

    @classmethod
    def averaging(cls, nside_in: int, nside: int, what: str = "map") -> "Preparation":
        """Average over pixels."""
        _check_nside(nside_in, nside, what)
        return cls(None, nside_in, nside)

    def __call__(self, maps: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """The maps at the common resolution."""
        if self.window is None:
            return average_pixels(maps, self.nside)
        return resample(maps, self.window, self.nside, fine=FINE)

    @eqx.filter_jit
    def transpose(self, maps: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """The transposed operator, from the common resolution to that of the maps."""
        shape = (len(maps), healpy.nside2npix(self.nside_in))
        return jax.linear_transpose(self, jax.ShapeDtypeStruct(shape, maps.dtype))(maps)[0]

    def variance(self, variance: Sequence[Float[Array, " pix"]]) -> Float[Array, "stokes pix"]:
        """Variance of prepared white noise, from that of each pixel before.

        The variance of a smoothed map is the map of variances smoothed by the square of the
        kernel. The square is formed exactly, on Gauss-Legendre nodes.
        """
        if self.window is None:
            mean = average_pixels(jnp.asarray(variance, float), self.nside)
            return mean * (self.nside / self.nside_in) ** 2
        squared = jnp.asarray(_squared_window(np.asarray(self.window), 2 * self.nside_in))
        area = healpy.nside2pixarea(self.nside_in)
        rows = []
        for row in variance:  # one by one: a row may be as large as all else
            values = jnp.asarray(row[None], float)
            smoothed = resample(values, squared, self.nside, fine=FINE_VARIANCE)
            rows.append(smoothed[0].block_until_ready())
        return area * jnp.stack(rows)

    def uniform_variance(self, level: float) -> float:
        """Variance of prepared white noise of a level [u arcmin]."""
        if self.window is None:
            return (level / healpy.nside2resol(self.nside, arcmin=True)) ** 2
        return map_variance((level * np.radians(1 / 60) * np.asarray(self.window)) ** 2)


def _check_nside(nside_in: int, nside: int, what: str) -> None:
    if nside > nside_in:
        raise ValueError(f"The common nside {nside} is larger than that of {what}, {nside_in}.")


def _squared_window(window: np.ndarray, highest: int) -> np.ndarray:
    """Window of the square of the kernel that has the given window."""
    lmax = min(2 * (len(window) - 1), highest)
    order = 2 * len(window) + lmax
    x = np.cos(ducc0.misc.GL_thetas(order))
    weights = ducc0.misc.GL_weights(order, 1) / (2 * np.pi)
    ell = np.arange(len(window))
    kernel = np.polynomial.legendre.legval(x, (2 * ell + 1) / (4 * np.pi) * window)
    return 2 * np.pi * (weights * kernel**2) @ np.polynomial.legendre.legvander(x, lmax)
