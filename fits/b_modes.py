"""Spectra of foregrounds outside a mask, against those of primordial gravitational waves."""

from collections.abc import Mapping
from typing import NamedTuple

import healpy
import numpy as np
from jaxtyping import Float

from fits.pseudo_cl import PIVOT, MaskedSpectra, band_powers
from jaxsky import Bandpass, Sky, observe_band
from jaxsky.harmonics import beam_ratio
from jaxsky.observation import ObservedBand

#: Bins whose middle is up to this multipole are taken for the bump of reionisation.
REIONISATION = 10


class BandLaw(NamedTuple):
    """A power law of band powers: D_l = amplitude (l / 80)^(slope + 2), and C_l ~ l^slope."""

    amplitude: float
    slope: float


def foreground_powers(
    sky: Sky, bands: Mapping[str, Bandpass], spectra: MaskedSpectra
) -> dict[str, Float[np.ndarray, "2 bin"]]:
    """Band powers D_b of EE and BB of a sky as each band sees it [uK_CMB^2].

    All foregrounds have the beam that is in the window of `spectra`.
    """
    return {
        name: band_powers(spectra, observe_band(sky, band) * band.conversion("uK_RJ", "uK_CMB"))
        for name, band in bands.items()
    }


def noise_level(band: ObservedBand) -> float:
    """Noise of Q and U of a band [uK_CMB rad]; of noise that varies, pixels by their weights."""
    noise = np.asarray(band.noise)
    if noise.ndim:
        pixel = healpy.nside2resol(healpy.npix2nside(noise.shape[-1]))
        level = pixel / np.sqrt(np.mean([1 / noise[-2, -2], 1 / noise[-1, -1]]))
    else:
        level = float(noise) * np.radians(1 / 60)
    return level * float(band.band.conversion("uK_RJ", "uK_CMB"))


def noise_weights(band: ObservedBand, lmax: int) -> Float[np.ndarray, " ell"]:
    """Beam over noise of a band, b_l / sqrt(N_l) [1 / uK_CMB]; its inverse square is the noise."""
    return np.asarray(beam_ratio(band.beam, 0.0, lmax)) / noise_level(band)


def _modes(spectra: MaskedSpectra) -> Float[np.ndarray, " bin"]:
    """Number of multipoles in each bin, each counted 2 l + 1 times."""
    return np.diff(np.square(spectra.edges)).astype(float)


def _inside(spectra: MaskedSpectra, fit: tuple[int, int], what: str) -> np.ndarray:
    """True for the bins that are within the multipoles of a fit."""
    edges = np.array(spectra.edges)
    inside = (edges[:-1] >= fit[0]) & (edges[1:] - 1 <= fit[1])
    if inside.sum() < 3:
        raise ValueError(
            f"The law of {what} takes three bins, but {inside.sum()} of those from l = {edges[0]} "
            f"to {edges[-1] - 1} are within the `fit` from {fit[0]} to {fit[1]}."
        )
    return inside


def fit_law(
    spectra: MaskedSpectra, powers: Float[np.ndarray, " bin"], fit: tuple[int, int], what: str
) -> BandLaw:
    """A straight line through log D_b against log l, bins counted as they have modes.

    `fit` has the first and last multipole of the bins that are fitted; messages name `what` it is.
    """
    inside = _inside(spectra, fit, what)
    D, ell = powers[inside], spectra.centers[inside]
    if D.min() <= 0:
        raise ValueError(
            f"The law of {what} takes positive band powers, but at l = {ell[D.argmin()]:g} that is "
            f"{D.min():.3g}; give another range or wider bins."
        )
    weights = np.sqrt(_modes(spectra)[inside])
    slope, logarithm = np.polyfit(np.log(ell / PIVOT), np.log(D), 1, w=weights)
    return BandLaw(float(np.exp(logarithm)), float(slope) - 2)


def band_correlation(
    spectra: MaskedSpectra,
    cross: Float[np.ndarray, " bin"],
    first: Float[np.ndarray, " bin"],
    second: Float[np.ndarray, " bin"],
    fit: tuple[int, int],
) -> float:
    """Mean correlation coefficient of two fields: that of the bins, counted as they have modes."""
    inside = _inside(spectra, fit, "correlated components")
    coefficients = cross[inside] / np.sqrt(first[inside] * second[inside])
    return float(np.average(coefficients, weights=_modes(spectra)[inside]))


def equal_r(
    spectra: MaskedSpectra,
    powers: Float[np.ndarray, "2 bin"],
    law: BandLaw,
    tensors: Float[np.ndarray, "4 ell"],
) -> dict[str, float]:
    """The r whose primordial BB equals a band's foregrounds, at l = 80 and at reionisation.

    At l = 80 the foregrounds are those of the power law; at reionisation the band powers of the
    lowest bins against those that tensors have in them. `tensors` are C_l of TT, EE, BB, TE for
    r = 1 [uK_CMB^2], up to `spectra.lmax` and 80; `law` was fitted to BB.
    """
    primordial = PIVOT * (PIVOT + 1) / (2 * np.pi) * tensors[2, PIVOT]
    found = {f"l = {PIVOT}": float(law.amplitude / primordial)}
    low = spectra.centers <= REIONISATION
    if low.any():
        binned = np.einsum("bjl,jl->b", spectra.windows[1], tensors[1:3, : spectra.lmax + 1])
        weights = _modes(spectra)[low]
        found["reionisation"] = float(weights @ powers[1, low] / (weights @ binned[low]))
    return found
