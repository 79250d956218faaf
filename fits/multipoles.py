"""Component separation of full-sky maps in multipoles, with its own beam for each band.

With b_l the beam and N_l the noise of a band, its beam-deconvolved coefficients are

    d_lm / b_l = A s_lm + n_lm / b_l,    of noise N_l / b_l^2

(Tegmark & Efstathiou 1996, MNRAS 281, 1297), the same for all m. So a multipole is like a region
of pixels with uniform noise: its 2l + 1 coefficients enter the spectral likelihood only through
their covariance of bands, and are replaced exactly by as many vectors as there are bands. Nothing
is smoothed, so each band keeps its resolution. A rotation of Q + iU by the angle of a band rotates
E + iB in the same way.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fits.common import CommonMaps, window_of
from fits.compress import Layout, bare, check_sigma
from fits.mixing import named_bands, spectral_names
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.systems import Pixels
from jaxsky import Bandpass, Component, Sky, get_parameters
from jaxsky.arrays import STOKES
from jaxsky.checks import UNSEEN, Numeric, check_double, check_finite, check_shape
from jaxsky.harmonics import alm_ell, gaussian_beam, lmax_of, low_multipoles, map_variance, resize

#: A band is left out where its beam is below this: its weight would be lost in rounding.
BEAM = 1e-5


def white_spectrum(level: Numeric) -> Float[np.ndarray, "..."]:
    """Return N_l [u^2 sr] of white noise of a level [u arcmin], u being the unit of the maps.

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
    """Return packed coefficients E, B or I, E, B of the maps of all bands, in double precision.

    They are in the order of `jaxsky.harmonics`, and computed band by band. For a map without
    multipoles above 2 nside their rms error is 1e-6 of their rms at nside 16, and 1e-7 from nside
    64 on; see `jaxsky.harmonics.analysis`. Power of a map above 2 nside leaks into them, most at
    2 nside, where it is 1e-3 of that power. White noise of pixels remains white, with N_l its
    variance times the area of a pixel.

    Parameters
    ----------
    maps : full-sky maps (band, stokes, pix), RING, with Stokes I, or Q, U, or I, Q, U; or a list of
        maps (stokes, pix), which may differ in nside
    lmax : largest multipole; by default 2 nside of the coarsest map, and not above

    Raises
    ------
    RuntimeError : without double precision
    TypeError, ValueError : for units, no maps, an lmax above 2 nside, and masked pixels
    """
    check_double("fits")
    rows = [bare("maps", each) for each in maps]
    shapes = {each.shape for each in rows}
    alike = len({shape[:-1] for shape in shapes}) == 1
    sizes = {12 * 4**k for k in range(30)}  # of maps whose nside is a power of 2
    if not (alike and all(len(s) == 2 and s[0] in STOKES and s[1] in sizes for s in shapes)):
        raise ValueError(
            "Argument `maps` must have shape (band, stokes, pix) with Stokes I, Q, U or all, but "
            f"has {len(rows)} bands of shape {', '.join(map(str, sorted(shapes)))}."
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
        wrong = (~np.isfinite(each) | (each < UNSEEN)).any(axis=0) | (each == 0).all(axis=0)
        if bad := int(wrong.sum()):
            raise ValueError(
                f"Argument `maps` has {bad} pixels of band {i} that are masked (not finite, UNSEEN "
                "or zero), but the harmonic domain takes the full sky; bring maps of a part of it "
                "to a common resolution and separate them pixel by pixel (`spectral_likelihood`)."
            )
        result[i] = low_multipoles(jnp.asarray(each, float), lmax)
    return result


class Multipoles(NamedTuple):
    """Beam-deconvolved coefficients and their weights b_l^2 / N_l at l = 0 ... lmax.

    Both are 0 below lmin, and where a band is left out. `ell` is the multipole of each coefficient.
    """

    lmin: int
    ell: Int[np.ndarray, " alm"]
    alm: Float[np.ndarray, "band stokes alm"]
    weights: Float[np.ndarray, "band stokes ell"]


def check_alm(alm: Numeric, bands: int) -> np.ndarray:
    """Return packed coefficients (band, stokes, alm) unchanged, after checking their shape."""
    array = bare("alm", alm)
    good = array.ndim == 3 and len(array) == bands and array.shape[1] in STOKES
    good = good and math.isqrt(array.shape[2]) ** 2 == array.shape[2]
    form = f"shape (band, stokes, (lmax + 1)^2) with {bands} bands and rows I, or E, B, or I, E, B"
    check_shape("alm", array, good, f"have {form}, as from `harmonic_coefficients`")
    return array


def _windows(beams: Numeric, bands: int, lmax: int) -> Float[np.ndarray, "band ell"]:
    array = bare("beams", beams).astype(float)
    tables = array.ndim == 2 and len(array) == bands and array.shape[1] > lmax
    known = f"({bands},), widths [arcmin], or ({bands}, ell), tables b_l from l = 0 to {lmax}"
    good = tables or array.shape == (bands,)
    check_shape("beams", array, good, f"have shape {known} or above")
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
    good = tables or array.shape in ((bands,), (bands, stokes))
    known = f"({bands},), ({bands}, {stokes}) or ({bands}, {stokes}, ell) from l = 0 to {lmax}"
    check_shape("noise", array, good, f"have shape {known} or above")
    spectra = array[..., lmin : lmax + 1] if tables else array.reshape(bands, -1, 1)
    check_sigma("noise", spectra)
    return spectra


def multipoles_of(
    alm: Float[np.ndarray, "band stokes alm"],
    noise: Numeric,
    beams: Numeric,
    components: int,
    lmin: int,
    lmax: int | None,
) -> Multipoles:
    """Return coefficients of maps as observed without their beams, after checking all of it."""
    (bands, stokes), own = alm.shape[:2], lmax_of(alm)
    lmax = own if lmax is None else lmax
    if not 2 <= lmin <= lmax <= own:
        raise ValueError(
            f"Arguments `lmin` and `lmax` must obey 2 <= lmin <= lmax <= {own}, the last "
            f"multipole of `alm`, but are {lmin} and {lmax}."
        )
    window = _windows(beams, bands, lmax)
    seen = (np.abs(window) > BEAM) & (np.arange(lmax + 1) >= lmin)
    weights = np.zeros((bands, stokes, lmax + 1))
    spectra = _spectra(noise, bands, stokes, lmin, lmax)
    weights[..., lmin:] = np.where(seen, window**2, 0.0)[:, None, lmin:] / spectra
    left = (weights > 0).sum(axis=0).min(axis=0)[lmin:]
    if (left < components).any():
        first = int(np.argmax(left < components))
        raise ValueError(
            f"At l = {lmin + first} only {left[first]} of {bands} bands are left for {components} "
            f"components, the others having `beams` below {BEAM:g} or infinite `noise`; choose "
            f"another `lmin` or `lmax` than {lmin} and {lmax}."
        )
    ell, inverse = alm_ell(lmax), np.where(seen, 1 / np.where(seen, window, 1), 0.0)
    short = np.asarray(resize(jnp.asarray(alm), lmax))
    rows = np.where(ell >= lmin, short * inverse[:, None, ell], 0.0)
    check_finite("alm", rows)
    return Multipoles(lmin, ell, rows, weights)


def _compressed(multipoles: Multipoles, layout: Layout) -> Pixels:
    """Return vectors with the same covariance of bands as the coefficients of each multipole.

    They are the triangular factor of the coefficients (QR), so squares are not formed: signals 1e8
    above the noise leave no trace in chi^2.
    """
    lmin = multipoles.lmin
    weights = np.moveaxis(layout.rows(multipoles.weights[..., lmin:]), -1, 0)[..., None]
    alike = bool(np.all(weights == weights[:, :1]))
    weights = weights[:, :1] if alike else weights
    size = weights.shape[2]
    root = np.zeros((*weights.shape[:3], size))
    order, ends = np.argsort(multipoles.ell, kind="stable"), np.arange(lmin, lmin + len(root) + 1)
    for i, own in enumerate(np.split(order, ends**2)[1:-1]):
        x = layout.rows(multipoles.alm[..., own])
        x = np.concatenate(list(x), axis=1)[None] if alike else x
        triangle = np.asarray(np.linalg.qr(x.swapaxes(1, 2), mode="r"))
        root[i, ..., : triangle.shape[1]] = triangle.swapaxes(1, 2)
    return Pixels(jnp.asarray(root), jnp.asarray(weights))


def harmonic_likelihood(
    sky: Sky | Mapping[str, Component],
    bands: Mapping[str, Bandpass] | Sequence[Bandpass],
    alm: Numeric,
    noise: Numeric,
    start: Mapping[str, Numeric],
    *,
    beams: Numeric,
    unit: str = "uK_RJ",
    lmin: int = 2,
    lmax: int | None = None,
) -> SpectralLikelihood:
    """Return the spectral likelihood of full-sky maps that each have their own beam.

    -2 ln L = sum_lm [d^T W d - (A^T W d)^T (A^T W A)^-1 (A^T W d)] with d = d_lm / b_l and
    W = b_l^2 / N_l: that of Stompor et al. (2009, MNRAS 392, 216) with multipoles for pixels. A
    band is left out where its beam is below 1e-5. Maps of the components come from
    `harmonic_component_maps`.

    Parameters
    ----------
    sky, bands, start, unit : as for `spectral_likelihood`; all parameters must be numbers
    alm : packed coefficients (band, stokes, alm) of the maps as observed, E, B or I, E, B; see
        `harmonic_coefficients`
    noise : N_l of the maps as observed [square of `unit` times sr], shape (band,), (band, stokes)
        or (band, stokes, ell) from l = 0; infinite where a band is not to be used. See
        `white_spectrum`.
    beams : full widths at half maximum of Gaussian beams [arcmin], (band,), or tables b_l,
        (band, ell) from l = 0, with the window of the pixels if the maps have one
    lmin, lmax : smallest and largest multipole that is used; by default 2 and that of `alm`

    Raises
    ------
    RuntimeError, KeyError, TypeError, ValueError : for what `spectral_likelihood` refuses,
        parameters that are maps, and multipoles that too few bands resolve
    """
    sky = sky if isinstance(sky, Sky) else Sky(sky)
    bands = named_bands(bands)
    alm = check_alm(alm, len(bands))
    held = get_parameters(sky, [name for name in spectral_names(sky) if name not in start])
    for name, value in held.items():
        if jnp.ndim(value):
            raise ValueError(
                f"Parameter {name!r} is a map of {value.size} pixels, but in the harmonic domain "
                "it must be a number: laws that vary over the sky mix multipoles."
            )
    # The laws and their parameters, on a pixel without data.
    nothing, one = np.zeros((len(bands), alm.shape[1], 1)), np.ones(len(bands))
    like = spectral_likelihood(sky, bands, nothing, one, start, unit=unit, compress=False)
    components = len(sky.components)
    multipoles = multipoles_of(alm, noise, beams, components, lmin, lmax)
    pixels = tuple(_compressed(multipoles, layout) for layout in like.layout)
    bands_used = (multipoles.weights > 0).sum(axis=0)[..., multipoles.ell]
    values = bands_used - like.unknowns()[:, None] * (multipoles.ell >= lmin)
    cells, number = jnp.zeros(len(pixels[0].data), int), int(values.sum())
    return dataclasses.replace(like, pixels=pixels, block_cell=cells, values=number)


def masked_noise(
    prepared: CommonMaps, mask: Float[np.ndarray, " pix"], factors: Float[np.ndarray, " band"]
) -> Float[np.ndarray, "band stokes ell"]:
    """Return N_l of masked maps: smoothed white noise plus correlated noise.

    They are in a unit of which uK_RJ is `factors`.
    """
    noises = prepared.fluctuations.noises
    lmax = 2 * min(healpy.npix2nside(mask.size), *(n.preparation.nside_in for n in noises))
    stokes = prepared.fluctuations.stokes
    area, spectra = np.mean(mask**2), np.zeros((len(noises), len(stokes), lmax + 1))
    sigma = np.where(mask > 0, prepared.sigma, 0.0) * factors[:, None, None] * mask
    for i, noise in enumerate(noises):
        shape, correlated = np.asarray(window_of(noise.preparation, lmax)) ** 2, np.zeros(lmax + 1)
        if noise.correlated is not None:
            correlated = np.asarray(noise.correlated)[..., : lmax + 1] * factors[i] ** 2
        total = np.mean(sigma[i] ** 2, axis=-1)
        if "QU" in stokes:  # E and B have the mean of both
            total[-2:] = total[-2:].mean()
        of_rows = np.broadcast_to(correlated, spectra[i].shape)
        white = total - area * np.array([map_variance(row) for row in of_rows])
        spectra[i] = white[:, None] / map_variance(shape) * shape + correlated * area
    return spectra
