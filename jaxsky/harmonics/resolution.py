"""Maps at another resolution: smoothed, band-limited, or averaged over pixels."""

from collections.abc import Sequence
from functools import cache, partial

import ducc0
import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.checks import check_finite
from jaxsky.harmonics.packing import expand, map_variance, resize
from jaxsky.harmonics.transforms import analysis, synthesis
from jaxsky.harmonics.windows import beam_ratio, shortened

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
