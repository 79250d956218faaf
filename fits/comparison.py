"""Observed maps against the model of foregrounds, CMB and noise: the paper's section 4.

Pixel by pixel: the slope of the observed maps against the model, with an honest error. How far
from the model maps may be by chance is seen in simulated noise and CMB. And on small patches, as
in the paper's figure 10: their power laws against those of the model.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Bool, Float

from fits.common import CommonMaps, common_maps, prepared_spectrum
from fits.discs import EDGES, PreparedPatches, paper_patches, prepare_patches
from fits.full_sky import LMIN, BandSpectra, compare_spectra, polarization_alms
from fits.inputs import Band, Inputs
from fits.kept import fingerprint, kept_realisations
from fits.patches import PatchFits, fit_patches
from fits.pseudo_cl import bin_edges
from fits.writing import probability
from jaxsky.harmonics import (
    average_pixels,
    beam_ratio,
    gaussian_beam,
    pixel_window,
    power_spectrum,
)
from jaxsky.noise import pixel_covariance, realisation_key, stream
from jaxsky.programs import QUIET
from jaxsky.settings import Experiment, SettingsError

#: What is compared, and which of Q and U counts in it.
STOKES, COUNTED = ("Q", "U", "QU"), np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
#: A slope and a correlation take a few pixels.
LEAST_PIXELS = 10


class ComparisonRealisations(NamedTuple):
    """Of each realisation, what is compared with the data.

    chi^2 of the residual maps and the sum of their squares [uK_RJ^2], for Q, U and both; C_l of EE
    and BB of the complete model of foregrounds, CMB, and noise, and of the noise alone [uK_RJ^2].
    """

    chi2: Float[np.ndarray, "sim band region 3"]
    squares: Float[np.ndarray, "sim band region 3"]
    spectra: Float[np.ndarray, "sim band 2 ell"]
    noise: Float[np.ndarray, "sim band 2 ell"]


class Scatter(NamedTuple):
    """Observed against modelled pixels of a band, in one region.

    The slope is that of the observed maps on the model, weighted by 1/sigma^2, through the origin,
    and its error that of noise and CMB together, correlated as they are between pixels; Pearson's
    `correlation`; the rms of observed - model, and that `expected` of noise and CMB [uK_RJ]; chi2
    with the sigma of the noise, and the probability that noise and CMB alone give a larger one,
    from simulations: never below `floor`, one in their number.
    """

    band: str
    region: str
    stokes: str
    pixels: int
    slope: float
    error: float
    correlation: float
    rms: float
    expected: float
    chi2: float
    pte: float
    floor: float

    @property
    def pte_text(self) -> str:
        """The probability in words, an upper limit where no realisation exceeds the maps."""
        if self.pte > self.floor:
            return probability(self.pte)
        return f"<{probability(self.floor)}"

    @property
    def slope_pte(self) -> float:
        """Probability of a slope as far from 1 in either direction."""
        return float(2 * scipy.stats.norm.sf(abs(self.slope - 1) / self.error))


class Comparison(NamedTuple):
    """Observed maps, the model of foregrounds in each band [uK_RJ], and how they compare.

    `regions` are the pixels of each that are used; there are no `spectra` if pixels are missing.
    """

    prepared: CommonMaps
    model: Float[Array, "band stokes pix"]
    regions: dict[str, Bool[np.ndarray, " pix"]]
    scatters: list[Scatter]
    spectra: list[BandSpectra]

    def scatter(self, band: str, region: str, stokes: str) -> Scatter:
        """One of the scatters."""
        wanted = (band, region, stokes)
        return next(s for s in self.scatters if (s.band, s.region, s.stokes) == wanted)


def check_comparison(
    settings: Experiment, prepared: CommonMaps, regions: Mapping[str, Bool[np.ndarray, " pix"]]
) -> None:
    """Refuse at once what `compare` and `compare_patches` would find out late."""
    how = settings.compare
    for name, inside in regions.items():
        if (inside & prepared.used).sum() < LEAST_PIXELS:
            raise SettingsError(
                f"compare.regions: region {name!r} leaves fewer than {LEAST_PIXELS} pixels."
            )
    if how.lmax > (limit := 2 * settings.common.nside):
        raise SettingsError(
            f"compare.lmax: multipoles reach to 2 nside, {limit}, but {how.lmax} is asked for."
        )
    bins = len(bin_edges(LMIN, how.lmax, how.width)) - 1
    if bins > how.nsims / 2:
        raise SettingsError(
            f"compare.width: {how.width} makes {bins} bins up to l = {how.lmax}, and these take "
            f"twice as many realisations; compare.nsims is {how.nsims}."
        )
    if how.patches is None:
        return
    others = tuple(f"band {band!r}" for band in prepared.bands if band != how.patches)
    sources = {what: n for what, n in prepared.sources.items() if not what.endswith(others)}
    coarsest = min(sources, key=sources.__getitem__)
    if how.patches_nside > sources[coarsest]:
        raise SettingsError(
            f"compare.patches_nside: {how.patches_nside} is finer than that of {coarsest}, "
            f"{sources[coarsest]}."
        )
    if 2 * how.patches_nside < EDGES[-1] - 1:
        raise SettingsError(
            f"compare.patches_nside: {how.patches_nside} resolves l = {2 * how.patches_nside}, "
            f"and the patches take {EDGES[-1] - 1}."
        )


def compare(
    settings: Experiment,
    prepared: CommonMaps,
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    simulations: Path | None = None,
    report: Callable[[int, int], None] = QUIET.advance,
) -> Comparison:
    """Compare the maps with the model of foregrounds, CMB and noise.

    Parameters
    ----------
    settings : how; the parameters of the model are those of the prepared sky
    prepared : templates and maps at the common resolution
    regions : pixels of each region
    simulations : file that keeps realisations; those that it has are not made again
    report : called with the number of realisations done, and that of all

    Raises
    ------
    SettingsError, jaxsky.io.InputError
        For a region without pixels, multipoles that the maps do not have, or a file of
        realisations of other data.
    """
    check_comparison(settings, prepared, regions)
    how = settings.compare
    used = {name: inside & prepared.used for name, inside in regions.items()}
    model = prepared.model()
    simulated = simulated_fluctuations(
        prepared,
        model,
        used,
        how.lmax,
        how.nsims,
        settings.seed,
        simulations,
        f"{fingerprint((prepared, used))} {settings.seed} {how.lmax}",
        report,
    )
    scatters = compare_pixels(prepared, model, used, simulated)
    spectra = []
    if prepared.used.all():
        spectra = compare_spectra(prepared, model, simulated.spectra, simulated.noise, how.width)
    return Comparison(prepared, model, used, scatters, spectra)


def simulated_fluctuations(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    lmax: int,
    *kept: Any,
) -> ComparisonRealisations:
    """Noise and CMB on top of the model's foregrounds; `kept` is for `kept_realisations`."""
    foregrounds = polarization_alms(model, lmax)
    inside = jnp.asarray(np.stack(list(regions.values())))

    def make(key):
        noise = prepared.fluctuations.noise_realisation(key)
        cmb = prepared.fluctuations.cmb_realisation(key)
        noise_alms = polarization_alms(noise, lmax)
        spectra = power_spectrum(foregrounds + noise_alms + polarization_alms(cmb, lmax))
        chi2 = _sums_of_squares((noise + cmb) / prepared.sigma, inside)
        squares = _sums_of_squares(noise + cmb, inside)
        return chi2, squares, spectra, power_spectrum(noise_alms)

    return kept_realisations(make, ComparisonRealisations, *kept)


@jax.jit
def _sums_of_squares(
    maps: Float[Array, "band stokes pix"], regions: Bool[Array, "region pix"]
) -> Float[Array, "band region 3"]:
    """Sum over the pixels of each region of the squares of Q, of U and of both."""
    return jnp.einsum("bsp,rp,ts->brt", maps**2, regions.astype(maps.dtype), COUNTED)


def _slopes(
    prepared: CommonMaps, model: Float[Array, "band stokes pix"], inside: Bool[Array, "region pix"]
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes and their errors, shape (band, region, 3).

    m^T W d / m^T W m, whose error follows from the covariance C of what the maps d hold besides
    the model m: m^T W C W m / (m^T W m)^2.
    """
    weighted = jnp.where(jnp.isfinite(prepared.sigma), model / prepared.sigma**2, 0.0)
    # A row for each region, of Q, of U and of both.
    rows = jnp.einsum("bsp,rp,ts->brtsp", weighted, inside.astype(model.dtype), COUNTED)
    shape = rows.shape[:3]
    total = prepared.fluctuations.covariance(rows.reshape(shape[0], -1, *rows.shape[3:]))
    variance = np.einsum("brtbrt->brt", total.reshape(*shape, *shape))
    norm, product = (np.einsum("brtsp,bsp->brt", rows, maps) for maps in (model, prepared.data))
    return product / norm, np.sqrt(variance) / norm


def compare_pixels(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    simulated: ComparisonRealisations,
) -> list[Scatter]:
    """The observed maps against the model, in each region, for Q, U and both."""
    inside = jnp.asarray(np.stack(list(regions.values())))
    slopes, errors = _slopes(prepared, model, inside)
    residual = prepared.data - model
    found = np.asarray(_sums_of_squares(residual / prepared.sigma, inside))
    floor = 1 / (1 + len(simulated.chi2))
    pte = floor * (1 + (simulated.chi2 >= found).sum(axis=0))
    squares = simulated.squares.mean(axis=0)
    names = itertools.product(prepared.bands, regions, STOKES)
    scatters = []
    for (band, region, stokes), at in zip(names, np.ndindex(slopes.shape), strict=True):
        both = (np.asarray(maps[at[0]])[:, regions[region]] for maps in (model, prepared.data))
        x, y = (maps[["QU".index(s) for s in stokes]].ravel() for maps in both)
        scatters.append(
            Scatter(
                band,
                region,
                stokes,
                x.size,
                float(slopes[at]),
                float(errors[at]),
                float(np.corrcoef(x, y)[0, 1]),
                float(np.sqrt(np.mean((y - x) ** 2))),
                math.sqrt(float(squares[at]) / x.size),
                float(found[at]),
                float(pte[at]),
                floor,
            )
        )
    return scatters


class PatchComparison(NamedTuple):
    """A and alpha of the patches in one band.

    Fits to the map, and to the model: foregrounds with a realisation of CMB and noise. `overlap` is
    the fraction of modes that patches have in common.
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


def _patch_noise(
    band: Band, prepared: CommonMaps, patches: PreparedPatches
) -> Float[np.ndarray, "patch 2 ell"]:
    """Spectrum of the noise in the prepared maps, on each patch that of its own pixels."""
    (preparation,), lmax = prepared.fluctuations.preparations, patches.spectra[0].lmax
    covariance = pixel_covariance(band.noise, preparation.nside_in)
    variance = average_pixels(jnp.stack([covariance[0, 0], covariance[1, 1]]), preparation.nside)
    weights = np.stack([one.mask**2 for one in patches.spectra])
    # Q and U turn into each other on a patch, and E and B have the mean of both.
    mean = np.asarray(variance).mean(axis=0) @ weights.T / weights.sum(axis=1)
    white = mean * healpy.nside2pixarea(preparation.nside_in)
    total = white[:, None] * np.asarray(prepared_spectrum(jnp.ones(lmax + 1), preparation, lmax))
    if (correlated := prepared.fluctuations.correlated[0]) is not None:
        total[:, : correlated.size] += np.asarray(correlated)[: lmax + 1]
    return np.repeat(total[:, None], 2, axis=1)


def compare_patches(settings: Experiment, inputs: Inputs) -> PatchComparison:
    """The paper's 48 discs and the field of BICEP2, in the band that the settings name."""
    name, nside = str(settings.compare.patches), settings.compare.patches_nside
    fwhm = settings.common.fwhm
    band = inputs.bands[name]
    prepared = common_maps(inputs._replace(bands={name: band}), nside, fwhm)
    window = beam_ratio(fwhm or band.beam, 0.0, 2 * nside)
    if not fwhm:  # averages of pixels, with the beam of the map
        window = window * pixel_window(nside, 2 * nside)
    patches = prepare_patches(paper_patches(nside), np.asarray(window))
    # Correlations of the powers of a field that has all scales alike, 1 for a patch itself.
    squares = np.stack([one.mask**2 for one in patches.spectra])
    squares /= np.linalg.norm(squares, axis=1, keepdims=True)
    noise = _patch_noise(band, prepared, patches)
    # Realisations of their own, unlike those of what is observed.
    key = stream(realisation_key(settings.seed), "patches")
    model = prepared.model()[0]
    fluctuations = prepared.fluctuations
    model = model + fluctuations.noise_realisation(key)[0] + fluctuations.cmb_realisation(key)[0]
    return PatchComparison(
        name,
        fit_patches(prepared.data[0], patches, noise=noise),
        fit_patches(model, patches, noise=noise),
        squares @ squares.T,
    )


def template_patches(maps: Float[Array, "2 pix"], fwhm: float) -> PatchFits:
    """The same patches in Q and U of a template, at its own beam, taken to be without noise."""
    nside = healpy.npix2nside(maps.shape[-1])
    patches = prepare_patches(paper_patches(nside), np.asarray(gaussian_beam(fwhm, 2 * nside)))
    return fit_patches(maps, patches)
