"""Coefficients of full-sky maps, and the beams and noise of bands at each multipole."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.amplitudes import Pixels
from fits.compress import Layout
from fits.noise import bare
from jaxsky.checks import UNSEEN, Numeric, check_double, check_finite
from jaxsky.harmonics import gaussian_beam, lmax_of, low_multipoles

#: A band is left out where its beam is below this: its weight would be lost in rounding.
BEAM = 1e-5


def white_spectrum(level: Numeric) -> Float[np.ndarray, "..."]:
    """N_l [u^2 sr] of white noise of a level [u arcmin], u being the unit of the maps.

    Examples
    --------
    >>> (white_spectrum([1.0, 2.0]) * 1e8).round(4)
    array([ 8.4616, 33.8464])
    """
    values = bare("level", level).astype(float)
    if not np.all(values > 0):
        raise ValueError(f"Argument `level` must be positive, but has {values.min():g}.")
    return np.deg2rad(values / 60) ** 2


def harmonic_coefficients(
    maps: Sequence[Numeric] | Array | np.ndarray, lmax: int | None = None
) -> Float[np.ndarray, "band stokes alm"]:
    """Packed coefficients of the maps of all bands, one band after the other.

    Of a map without multipoles above 2 nside they have an rms error of 1e-6 of their rms at
    nside 16, and 1e-7 from nside 64 on; see `jaxsky.harmonics.analysis`. Power that a map has
    above leaks into them, the most at 2 nside, where it is 1e-3 of it. White noise of pixels
    remains white, N_l being its variance times the area of a pixel.

    Parameters
    ----------
    maps : full-sky maps (band, stokes, pix), RING, with Stokes Q, U or I, Q, U; or a list of maps
        (stokes, pix), which may differ in nside
    lmax : largest multipole; by default 2 nside of the coarsest map, and not above

    Returns
    -------
    Coefficients E, B or I, E, B in double precision, in the order of `jaxsky.harmonics`.

    Raises
    ------
    RuntimeError
        If JAX is not in double precision.
    TypeError, ValueError
        For units, shapes that are no maps, an lmax above 2 nside, and masked pixels.
    """
    check_double("fits.separation")
    rows = [bare("maps", each) for each in maps]
    shapes = {each.shape for each in rows}
    if len({shape[:-1] for shape in shapes}) != 1 or not all(map(_is_map, shapes)):
        raise ValueError(
            "Argument `maps` must have shape (band, stokes, pix) with Stokes Q, U or I, Q, U, "
            f"but has {len(rows)} bands of shape {', '.join(map(str, sorted(shapes)))}."
        )
    nside = min(healpy.npix2nside(shape[1]) for shape in shapes)
    lmax = 2 * nside if lmax is None else lmax
    if not 2 <= lmax <= 2 * nside:
        raise ValueError(
            f"Argument `lmax` must lie between 2 and 2 nside = {2 * nside}, up to which "
            f"coefficients are accurate, but is {lmax}."
        )
    result = np.empty((len(rows), len(rows[0]), (lmax + 1) ** 2))
    for i, each in enumerate(rows):
        _check_full_sky(i, each)
        result[i] = low_multipoles(jnp.asarray(each, float), lmax)
    return result


def _is_map(shape: tuple[int, ...]) -> bool:
    """True for two or three Stokes parameters at an nside that is a power of 2."""
    if len(shape) != 2 or shape[0] not in (2, 3) or not healpy.isnpixok(shape[1]):
        return False
    return healpy.isnsideok(healpy.npix2nside(shape[1]), nest=True)


def _check_full_sky(band: int, maps: np.ndarray) -> None:
    wrong = (~np.isfinite(maps) | (maps < UNSEEN)).any(axis=0) | (maps == 0).all(axis=0)
    if bad := int(wrong.sum()):
        raise ValueError(
            f"Argument `maps` has {bad} pixels of band {band} that are masked (not finite, UNSEEN "
            "or zero), but the harmonic domain takes the full sky; bring maps of a part of it to "
            "a common resolution and separate them pixel by pixel (`spectral_likelihood`)."
        )


class Multipoles(NamedTuple):
    """Beams and noise of the bands at l = lmin ... lmax.

    Parameters
    ----------
    lmin, lmax : smallest and largest multipole
    inverse : 1 / b_l; 0 where a band is left out
    weights : b_l^2 / N_l, likewise
    """

    lmin: int
    lmax: int
    inverse: Float[np.ndarray, "band ell"]
    weights: Float[np.ndarray, "band stokes ell"]

    @property
    def ell(self) -> np.ndarray:
        """The multipoles."""
        return np.arange(self.lmin, self.lmax + 1)

    def dof(self, components: int) -> Float[np.ndarray, " ell"]:
        """Number of coefficients that are used, less that of amplitudes."""
        bands = (self.weights > 0).sum(axis=0) - components
        return (2 * self.ell + 1.0) * bands.sum(axis=0)

    def coefficients(self, alm: np.ndarray) -> Iterator[Float[np.ndarray, "band stokes m"]]:
        """Coefficients without their beam, for one multipole after the other."""
        for i, ell in enumerate(self.ell):
            yield alm[..., positions(ell, lmax_of(alm))] * self.inverse[:, None, i : i + 1]


def positions(ell: int, lmax: int) -> np.ndarray:
    """Where the 2l + 1 coefficients of a multipole are among packed ones."""
    m = np.arange(1, ell + 1)
    real = lmax + 1 + 2 * ((m - 1) * (lmax + 1) - m * (m - 1) // 2 + ell - m)
    return np.concatenate([[ell], real, real + 1])


def check_alm(alm: Numeric, bands: int) -> np.ndarray:
    """Packed coefficients (band, stokes, alm), as they are."""
    array = bare("alm", alm)
    shape = array.shape
    known = array.ndim == 3 and shape[0] == bands and shape[1] in (2, 3)
    if not known or (lmax_of(array) + 1) ** 2 != shape[2]:
        raise ValueError(
            f"Argument `alm` must have shape (band, stokes, (lmax + 1)^2) with {bands} bands and "
            f"rows E, B or I, E, B, as from `harmonic_coefficients`, but has shape {shape}."
        )
    return array


def _windows(beams: Numeric, bands: int, lmax: int) -> Float[np.ndarray, "band ell"]:
    array = bare("beams", beams).astype(float)
    tables = array.ndim == 2 and len(array) == bands and array.shape[1] > lmax
    if array.shape != (bands,) and not tables:
        raise ValueError(
            f"Argument `beams` must have shape ({bands},), widths [arcmin], or ({bands}, ell), "
            f"tables b_l from l = 0 to {lmax} or above, but has shape {array.shape}."
        )
    check_finite("beams", array)
    if tables:
        return array[:, : lmax + 1]
    if not np.all(array >= 0):
        raise ValueError(f"Argument `beams` must not be negative, but has {array.min():g} arcmin.")
    return np.stack([np.asarray(gaussian_beam(fwhm, lmax)) for fwhm in array])


def _spectra(
    noise: Numeric, bands: int, stokes: int, lmin: int, lmax: int
) -> Float[np.ndarray, "band stokes #ell"]:
    array = bare("noise", noise).astype(float)
    tables = array.ndim == 3 and array.shape[:2] == (bands, stokes) and array.shape[2] > lmax
    if array.shape not in ((bands,), (bands, stokes)) and not tables:
        raise ValueError(
            f"Argument `noise` must have shape ({bands},), ({bands}, {stokes}) or ({bands}, "
            f"{stokes}, ell) from l = 0 to {lmax} or above, but has shape {array.shape}."
        )
    spectra = array[..., lmin : lmax + 1] if tables else array.reshape(bands, -1, 1)
    if bad := int(np.sum(~(spectra > 0))):
        raise ValueError(f"Argument `noise` has {bad} of {spectra.size} values that are not > 0.")
    return spectra


def multipoles_of(
    shape: tuple[int, ...],
    noise: Numeric,
    beams: Numeric,
    components: int,
    lmin: int,
    lmax: int | None,
) -> Multipoles:
    """Checked beams and noise for coefficients of a shape."""
    (bands, stokes), own = shape[:2], lmax_of(np.broadcast_to(0, shape))
    lmax = own if lmax is None else lmax
    if not 2 <= lmin <= lmax <= own:
        raise ValueError(
            f"Arguments `lmin` and `lmax` must obey 2 <= lmin <= lmax <= {own}, the last "
            f"multipole of `alm`, but are {lmin} and {lmax}."
        )
    window = _windows(beams, bands, lmax)[:, lmin:]
    spectra = _spectra(noise, bands, stokes, lmin, lmax)
    seen = np.abs(window) > BEAM
    weights = np.where(seen, window**2, 0.0)[:, None] / spectra
    weights = np.broadcast_to(weights, (bands, stokes, weights.shape[-1]))
    left = (weights > 0).sum(axis=0).min(axis=0)
    if (left < components).any():
        first = int(np.argmax(left < components))
        raise ValueError(
            f"At l = {lmin + first} only {left[first]} of {bands} bands are left for {components} "
            f"components, the others having `beams` below {BEAM:g} or infinite `noise`; choose "
            f"another `lmin` or `lmax` than {lmin} and {lmax}."
        )
    return Multipoles(lmin, lmax, np.where(seen, 1 / np.where(seen, window, 1), 0.0), weights)


def compressed(alm: np.ndarray, multipoles: Multipoles, layout: Layout) -> Pixels:
    """Vectors with the same covariance of bands as the coefficients of each multipole.

    They are the triangular factor of the coefficients (QR), so squares are not formed: signals 1e8
    above the noise leave no trace in chi^2.
    """
    weights = np.moveaxis(layout.rows(multipoles.weights), -1, 0)[..., None]
    alike = bool(np.all(weights == weights[:, :1]))
    weights = weights[:, :1] if alike else weights
    rows = weights.shape[2]
    root = np.zeros((*weights.shape[:3], rows))
    for i, values in enumerate(multipoles.coefficients(alm)):
        x = layout.rows(values)
        x = np.concatenate(list(x), axis=1)[None] if alike else x
        triangle = np.asarray(np.linalg.qr(x.swapaxes(1, 2), mode="r"))
        root[i, ..., : triangle.shape[1]] = triangle.swapaxes(1, 2)
    if not np.isfinite(root).all():
        bad = int(np.sum(~np.isfinite(alm)))
        raise ValueError(f"Argument `alm` has {bad} of {alm.size} values that are not finite.")
    return Pixels(jnp.asarray(root), jnp.asarray(weights))
