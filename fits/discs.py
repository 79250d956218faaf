"""The paper's small patches of the sky: discs at high latitude, and the field of BICEP2.

The power laws of observed maps there, against those of the model, are the paper's figure 10.
"""

from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.polynomial import legendre

from fits.common import CommonMaps, common_maps, window_of
from fits.inputs import Band, Inputs
from fits.patches import PatchFits, PreparedPatches, fit_patches, prepare_patches
from jaxsky.harmonics import average_pixels, beam_ratio, gaussian_beam, pixel_window, smooth
from jaxsky.noise import pixel_covariance, realisation_key, stream
from jaxsky.settings import Experiment

#: Radius of the paper's discs: 400 square degrees.
RADIUS = 11.3
#: Largest nside of its maps.
FINEST = 256
#: FWHM of the Gaussian with which masks are smoothed [deg].
APODIZATION = 2.0
#: The field of BICEP2 and Keck: right ascension within +-50 deg, declination -65 to -50 deg.
BICEP2 = (50.0, -65.0, -50.0)


def disc_centers(nside: int = 4, latitude: float = 45.0) -> Float[np.ndarray, "2 disc"]:
    """Return Galactic longitude and latitude [deg] of pixels at |b| above a latitude.

    The paper has 48 discs there and says that they are pixels of nside 8; but nside 4 has 48, and
    nside 8 has 224.
    """
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    return np.stack([lon, lat])[:, np.abs(lat) > latitude]


def _smoothed_disc(radius: float, fwhm: float, angle: np.ndarray) -> np.ndarray:
    """Return a disc smoothed by a Gaussian, at angles from its centre [deg]; closed form."""
    lmax = int(np.ceil(6.0 / np.radians(fwhm) * np.sqrt(8 * np.log(2))))
    ell = np.arange(lmax + 2)
    P = legendre.legvander(np.array([np.cos(np.radians(radius))]), lmax + 2)[0]
    # 2 pi int P_l over the disc, times (2l+1)/4 pi of the sum over harmonics; P_-1 is 1
    coefs = (P[np.maximum(ell - 1, 0)] - P[ell + 1]) / 2
    window = np.asarray(gaussian_beam(60 * fwhm, lmax + 1))
    return legendre.legval(np.cos(np.radians(angle)), coefs * window)


def disc_mask(
    nside: int, lon: float, lat: float, radius: float = RADIUS, fwhm: float = APODIZATION
) -> Float[np.ndarray, " pix"]:
    """Return a disc about Galactic coordinates, smoothed by a Gaussian, all in degrees.

    Values below 1e-5 are set to zero.
    """
    if not (np.isfinite(lon) and -90 <= lat <= 90):
        raise ValueError(
            f"Arguments `lon` and `lat` must be a direction in degrees, not {lon} and {lat}."
        )
    if not 0 < fwhm <= radius <= 180:
        raise ValueError(
            f"Argument `fwhm`, {fwhm:g} deg, must be positive and not wider than the disc's "
            f"`radius`, {radius:g} deg."
        )
    middle = healpy.ang2vec(lon, lat, lonlat=True)
    reach = radius + 2 * fwhm
    near = healpy.query_disc(nside, middle, np.radians(reach))
    directions = np.stack(healpy.pix2vec(nside, near))
    across = np.linalg.norm(np.cross(middle, directions, axisb=0), axis=-1)
    angle = np.degrees(np.arctan2(across, middle @ directions))
    grid = np.linspace(0, reach, 4000)
    profile = _smoothed_disc(radius, fwhm, grid)
    profile = np.where(profile > 1e-5, np.minimum(profile, 1.0), 0.0)
    mask = np.zeros(healpy.nside2npix(nside))
    mask[near] = np.interp(angle, grid, profile)
    return mask


def bicep2_mask(nside: int, fwhm: float = APODIZATION) -> Float[np.ndarray, " pix"]:
    """Return the field of BICEP2 and Keck, smoothed like the discs."""
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    ra, dec = healpy.Rotator(coord=["G", "C"])(lon, lat, lonlat=True)
    half, south, north = BICEP2
    inside = (np.abs((ra + 180) % 360 - 180) < half) & (dec > south) & (dec < north)
    mask = np.asarray(smooth(inside[None].astype(float), 60 * fwhm))[0]
    return np.where(mask > 1e-3, np.minimum(mask, 1.0), 0.0)


def paper_patches(nside: int) -> dict[str, Float[np.ndarray, " pix"]]:
    """Return the paper's 48 discs at |b| > 45 deg, and the field of BICEP2, by name."""
    centers = disc_centers().T
    discs = {f"l {lon:.0f}, b {lat:.0f}": disc_mask(nside, lon, lat) for lon, lat in centers}
    return discs | {"BICEP2": bicep2_mask(nside)}


class PatchComparison(NamedTuple):
    """A and alpha of the patches in one band.

    Fits to the map, and to the model: foregrounds with one realisation of CMB and noise. `overlap`
    is the fraction of modes that pairs of patches share.
    """

    band: str
    observed: PatchFits
    model: PatchFits
    overlap: Float[np.ndarray, "patch patch"]

    @property
    def detected(self) -> Bool[np.ndarray, "patch 2"]:
        """True where EE, or BB, of a patch is detected in both."""
        return self.observed.detected & self.model.detected

    def _pairs(self, name: str, index: int) -> Float[np.ndarray, "2 patch"]:
        """Return A or alpha, observed and of the model, where EE (0) or BB (1) is detected."""
        both = self.detected[:, index]
        return np.array([getattr(fit, name)[both, index] for fit in (self.observed, self.model)])

    def _mean(self, values: np.ndarray, index: int) -> tuple[float, float]:
        """Return the mean over these patches, and its error; NaN for fewer than two."""
        if (count := len(values)) < 2:
            return float("nan"), float("nan")
        both = self.detected[:, index]
        shared = self.overlap[np.ix_(both, both)].sum() / count
        return float(values.mean()), float(values.std(ddof=1) * np.sqrt(shared / count))

    def ratio(self, index: int) -> tuple[float, float]:
        """Return the geometric mean of A observed over A of the model, and its error.

        The error is from the scatter over patches where EE (0) or BB (1) is detected, with
        allowance for their overlap.
        """
        observed, model = self._pairs("A", index)
        mean, error = self._mean(np.log(observed / model), index)
        return float(np.exp(mean)), float(np.exp(mean)) * error

    def slope_difference(self, index: int) -> tuple[float, float]:
        """Return the mean of alpha observed - alpha of the model, and its error, likewise."""
        observed, model = self._pairs("alpha", index)
        return self._mean(observed - model, index)

    def correlation(self, index: int) -> tuple[float, float]:
        """Return Pearson's coefficients of log A and of alpha between map and model."""
        if self.detected[:, index].sum() < 3:
            return float("nan"), float("nan")
        pairs = np.log(self._pairs("A", index)), self._pairs("alpha", index)
        A, alpha = (float(np.corrcoef(pair)[0, 1]) for pair in pairs)
        return A, alpha


def _patch_noise(
    band: Band, prepared: CommonMaps, patches: PreparedPatches
) -> Float[np.ndarray, "patch 2 ell"]:
    """Return the noise spectrum in the prepared maps on each patch, from its own pixels."""
    (noise,), lmax = prepared.fluctuations.noises, patches.spectra[0].lmax
    preparation = noise.preparation
    covariance = pixel_covariance(band.noise, preparation.nside_in)
    variance = average_pixels(jnp.stack([covariance[0, 0], covariance[1, 1]]), preparation.nside)
    weights = np.stack([one.mask**2 for one in patches.spectra])
    # Q and U mix on a patch, so that E and B have the mean of both.
    mean = np.asarray(variance).mean(axis=0) @ weights.T / weights.sum(axis=1)
    white = mean * healpy.nside2pixarea(preparation.nside_in)
    total = white[:, None] * np.asarray(window_of(preparation, lmax)) ** 2
    if noise.correlated is not None:
        total[:, : noise.correlated.size] += np.asarray(noise.correlated)[: lmax + 1]
    return np.repeat(total[:, None], 2, axis=1)


def compare_patches(settings: Experiment, inputs: Inputs) -> PatchComparison:
    """Compare the paper's 48 discs and the field of BICEP2, in the band of the settings.

    They have the nside of the coarsest map, up to 256.
    """
    name, fwhm = str(settings.compare.patches), settings.common.fwhm
    band = inputs.bands[name]
    pixels = [one.used.size for one in inputs.templates.values()]
    pixels += [one.used.size for one in (band, band.leakage) if one is not None]
    nside = healpy.npix2nside(min(12 * FINEST**2, *pixels))
    prepared = common_maps(inputs._replace(bands={name: band}), nside, fwhm)
    window = beam_ratio(fwhm or band.beam, 0.0, 2 * nside)
    if not fwhm:  # averages of pixels, with the beam of the map
        window = window * pixel_window(nside, 2 * nside)
    patches = prepare_patches(paper_patches(nside), np.asarray(window))
    # Correlations of the powers of white noise on two patches; 1 on the diagonal.
    squares = np.stack([one.mask**2 for one in patches.spectra])
    squares /= np.linalg.norm(squares, axis=1, keepdims=True)
    noise = _patch_noise(band, prepared, patches)
    # Not the realisations of the observed maps.
    key = stream(realisation_key(settings.seed), "patches")
    model, added = prepared.model()[0], prepared.fluctuations
    model = model + added.noise_realisation(key)[0] + added.cmb_realisation(key)[0]
    return PatchComparison(
        name,
        fit_patches(prepared.data[0], patches, noise=noise),
        fit_patches(model, patches, noise=noise),
        squares @ squares.T,
    )


def template_patches(maps: Float[Array, "2 pix"], fwhm: float) -> PatchFits:
    """Fit the same patches in Q and U of a template at its own beam, without noise."""
    nside = healpy.npix2nside(maps.shape[-1])
    patches = prepare_patches(paper_patches(nside), np.asarray(gaussian_beam(fwhm, 2 * nside)))
    return fit_patches(maps, patches)
