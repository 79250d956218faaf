"""Power laws on small patches, observed against the complete model: the paper's figure 10."""

from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.common import CommonMaps, common_maps
from fits.discs import PreparedPatches, paper_patches, prepare_patches
from fits.inputs import Band, Inputs
from fits.patches import PatchFits, fit_patches
from jaxsky.harmonics import average_pixels, beam_ratio, gaussian_beam, pixel_window
from jaxsky.keys import realisation_key, stream
from jaxsky.settings import Experiment


class PatchComparison(NamedTuple):
    """A and alpha of the patches in one band.

    Parameters
    ----------
    band : name
    observed, model : fits to the map, and to foregrounds with a realisation of CMB and noise
    overlap : fraction of modes that patches have in common
    """

    band: str
    observed: PatchFits
    model: PatchFits
    overlap: Float[np.ndarray, "patch patch"]

    def detected(self, index: int) -> np.ndarray:
        """Patches that show EE (0) or BB (1) in both."""
        return self.observed.detected[:, index] & self.model.detected[:, index]

    def ratio(self, index: int) -> tuple[float, float]:
        """Mean logarithm of A observed over A of the model, as a factor, and its error.

        The error is that of the scatter over the patches that show EE (0) or BB (1), with what
        these have in common.
        """
        both = self.detected(index)
        logs = np.log(self.observed.A[both, index] / self.model.A[both, index])
        mean, error = self._mean(logs, both)
        return float(np.exp(mean)), float(np.exp(mean)) * error

    def _mean(self, values: np.ndarray, patches: np.ndarray) -> tuple[float, float]:
        """Mean over patches, and its error; NaN for less than two."""
        if (count := len(values)) < 2:
            return float("nan"), float("nan")
        shared = self.overlap[np.ix_(patches, patches)].sum() / count
        return float(values.mean()), float(values.std(ddof=1) * np.sqrt(shared / count))

    def slope_difference(self, index: int) -> tuple[float, float]:
        """Mean of alpha observed less alpha of the model, and its error, over the same patches."""
        both = self.detected(index)
        difference = (self.observed.alpha - self.model.alpha)[both, index]
        return self._mean(difference, both)

    def correlation(self, index: int) -> tuple[float, float]:
        """Pearson's coefficient of log A and of alpha between map and model."""
        both = self.detected(index)
        if both.sum() < 3:
            return float("nan"), float("nan")
        pairs = (
            np.log([self.observed.A[both, index], self.model.A[both, index]]),
            [self.observed.alpha[both, index], self.model.alpha[both, index]],
        )
        A, alpha = (float(np.corrcoef(*pair)[0, 1]) for pair in pairs)
        return A, alpha


def _window(band: Band, nside: int, fwhm: float, lmax: int) -> Float[Array, " ell"]:
    """Window of prepared maps: the common beam, or the band's own and that of averaged pixels."""
    if fwhm:
        return gaussian_beam(fwhm, lmax)
    return beam_ratio(band.beam, 0.0, lmax) * pixel_window(nside, lmax)


def _noise(
    band: Band, prepared: CommonMaps, patches: PreparedPatches
) -> Float[np.ndarray, "patch 2 ell"]:
    """Spectrum of the noise in the prepared maps, on each patch that of its own pixels."""
    (preparation,), lmax = prepared.fluctuations.preparations, patches.spectra[0].lmax
    nside = preparation.nside
    variance = average_pixels(jnp.stack([band.noise[0, 0], band.noise[1, 1]]), nside)
    weights = np.stack([one.mask**2 for one in patches.spectra])
    # Q and U turn into each other on a patch, and E and B have the mean of both.
    mean = np.asarray(variance).mean(axis=0) @ weights.T / weights.sum(axis=1)
    white = mean * healpy.nside2pixarea(preparation.nside_in)
    if preparation.window is None:
        power = (pixel_window(nside, lmax) / pixel_window(preparation.nside_in, lmax)) ** 2
    else:
        power = np.zeros(lmax + 1)
        known = np.asarray(preparation.window)[: lmax + 1] ** 2
        power[: known.size] = known
    total = white[:, None] * power
    if (correlated := prepared.fluctuations.correlated[0]) is not None:
        total[:, : correlated.size] += np.asarray(correlated)[: lmax + 1]
    return np.repeat(total[:, None], 2, axis=1)


def _overlap(patches: PreparedPatches) -> Float[np.ndarray, "patch patch"]:
    """Correlation of the powers of a field that has all scales alike, 1 for a patch itself."""
    squares = np.stack([one.mask**2 for one in patches.spectra])
    products = squares @ squares.T
    own = np.sqrt(np.diag(products))
    return products / np.outer(own, own)


def compare_patches(settings: Experiment, inputs: Inputs) -> PatchComparison:
    """The paper's 48 discs and the field of BICEP2, in the band that the settings name.

    Parameters
    ----------
    settings : `compare.patches` is the band
    inputs : templates and maps
    """
    name, nside = str(settings.compare.patches), settings.compare.patches_nside
    fwhm = settings.common.fwhm
    band = inputs.bands[name]
    prepared = common_maps(inputs._replace(bands={name: band}), nside, fwhm)
    lmax = 2 * nside
    window = np.asarray(_window(band, nside, fwhm, lmax))
    patches = prepare_patches(paper_patches(nside), window)
    noise = _noise(band, prepared, patches)
    # Realisations of their own, unlike those of what is observed.
    key = stream(realisation_key(settings.seed), "patches")
    model = prepared.model()[0]
    fluctuations = prepared.fluctuations
    model = model + fluctuations.noise_realisation(key)[0] + fluctuations.cmb_realisation(key)[0]
    return PatchComparison(
        name,
        fit_patches(prepared.data[0], patches, noise=noise),
        fit_patches(model, patches, noise=noise),
        _overlap(patches),
    )


def template_patches(maps: Float[Array, "2 pix"], fwhm: float) -> PatchFits:
    """The same patches in a template, at its own resolution and taken to be without noise.

    Parameters
    ----------
    maps : Q and U, RING
    fwhm : of their beam [arcmin]
    """
    nside = healpy.npix2nside(maps.shape[-1])
    patches = prepare_patches(paper_patches(nside), np.asarray(gaussian_beam(fwhm, 2 * nside)))
    return fit_patches(maps, patches)
