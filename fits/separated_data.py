"""The data of a separation, from an experiment: pixels at a common resolution, or multipoles.

Both have the same methods, so that a separation does not ask which one it has.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.common import prepared_maps
from fits.fluctuations import Fluctuations, noise_alm
from fits.inputs import Inputs, inputs_of, modelled_laws
from fits.mixing import nominal
from fits.multipoles import harmonic_coefficients, harmonic_likelihood
from fits.noise import Noise, as_noise
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.regions import apodize, parameter_labels, region_mask
from fits.separated_maps import (
    HarmonicMaps,
    component_maps,
    emission_maps,
    harmonic_component_maps,
)
from jaxsky import Bandpass, Sky
from jaxsky.checks import Numeric
from jaxsky.harmonics import (
    expand,
    gaussian_beam,
    lmax_of,
    low_multipoles,
    map_variance,
    synthesis,
)
from jaxsky.settings import Experiment, SettingsError


@dataclass(frozen=True, kw_only=True)
class _Data:
    """What both kinds have: the laws and bands, start values by name, and the data in `unit`.

    `used` are the pixels that the results are of, and `mask` the weight of each in spectra, 0 to 1,
    its edges smooth. Of a simulation `foregrounds` are those alone, like the data, and `truth` its
    parameters that are numbers, "r" among them; both are None for real maps.
    """

    sky: Sky
    bands: dict[str, Bandpass]
    start: dict[str, float]
    unit: str
    used: Bool[np.ndarray, " pix"]
    mask: Float[np.ndarray, " pix"]
    observed: Float[np.ndarray, "band stokes _"]
    foregrounds: Float[np.ndarray, "band stokes _"] | None
    truth: dict[str, float] | None
    description: str

    #: Whether the likelihood knows all correlations of the noise, whether data are maps, and
    #: whether these are separated pixel by pixel.
    exact: ClassVar[bool] = False
    in_pixels: ClassVar[bool] = True
    by_pixel: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class PixelData(_Data):
    """Maps that are separated pixel by pixel, all at one resolution.

    `labels` are the regions of the free parameters that have them, `noise` is infinite where
    masked, `fluctuations` are the noise there is, correlated between pixels as it is [uK_RJ], and
    `factors` what `unit` is per uK_RJ in each band.
    """

    labels: dict[str, np.ndarray]
    noise: Noise
    fluctuations: Fluctuations
    factors: Float[np.ndarray, " band"]

    def likelihood(self, data: Float[np.ndarray, "band stokes pix"]) -> SpectralLikelihood:
        """The likelihood of data."""
        return spectral_likelihood(
            self.sky, self.bands, data, self.noise, self.start, labels=self.labels, unit=self.unit
        )

    def noise_realisation(self, key: Array) -> Float[np.ndarray, "band stokes pix"]:
        """Noise like that of the data."""
        noise = self.fluctuations.noise_realisation(key)
        return np.asarray(noise) * self.factors[:, None, None]

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        """Amplitudes of the components with all that is known of them."""
        return component_maps(like, params, data, self.noise, **options)

    def maps(self, found: Any, like: SpectralLikelihood, params: Mapping, data):
        """Amplitudes as maps, those of `components` with the same arguments."""
        return found.amplitude

    def residuals(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """Maps (band, stokes, pix) of the data less the components; NaN in masked pixels."""
        return self.observed - emission_maps(like, params, amplitude)

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """What components show in the bands; zero in masked pixels."""
        return emission_maps(like, params, np.where(self.used, amplitude, 0.0))


@dataclass(frozen=True, kw_only=True)
class MaskedSkyData(PixelData):
    """Maps on part of the sky that are separated multipole by multipole, all at one beam.

    All bands have the same beam and mask, so the coefficients of the masked maps are those of the
    masked components, mixed by the laws: what a mask mixes, E and B among it, it mixes alike in
    all. `spectra` is N_l of the noise in them [unit^2 sr], which is what the beam of each band
    leaves. The mask correlates multipoles, so errors come from simulations.
    """

    by_pixel: ClassVar[bool] = False
    spectra: Float[np.ndarray, "band stokes ell"]
    fwhm: float

    def likelihood(self, data: Float[np.ndarray, "band stokes pix"]) -> SpectralLikelihood:
        """The likelihood of data."""
        alm, beams = self._alm(data), np.full(len(data), self.fwhm)
        return harmonic_likelihood(
            self.sky, self.bands, alm, self.spectra, self.start, beams=beams, unit=self.unit
        )

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        """Amplitudes of the components with all that is known of them."""
        alm, beams = self._alm(data), np.full(len(data), self.fwhm)
        return harmonic_component_maps(like, params, alm, self.spectra, beams=beams, **options)

    def maps(self, found: HarmonicMaps, like: SpectralLikelihood, params: Mapping, data):
        """Amplitudes as maps; NaN where masked.

        Those of pixels, plus what multipoles find beyond: the same of all components, so that only
        the noise is another, and nothing of the sky is lost at the last multipole.
        """
        maps = component_maps(like, params, data, self.noise, covariance=False).amplitude
        nside = healpy.npix2nside(self.mask.size)
        known = np.stack([np.asarray(synthesis(jnp.asarray(a), nside)) for a in self._alm(maps)])
        weight = np.where(self.used, self.mask, np.nan)
        return maps + (found.maps(nside, self.fwhm) - known) / weight

    def _alm(self, maps: Numeric) -> Float[np.ndarray, "_ stokes alm"]:
        return _masked_alm(maps, self.mask, self.spectra.shape[-1] - 1)


@dataclass(frozen=True, kw_only=True)
class FullSkyData(_Data):
    """Multipoles of the full sky, each band with its own beam; the likelihood is exact.

    `fwhms` are those of the bands [arcmin], and `noise` is N_l of the maps as observed [unit^2 sr].
    To draw it there is the `white` noise of each band, a level [unit arcmin] or the covariance of Q
    and U in each of its own pixels [unit^2], and the part of N_l that is `correlated` between
    pixels. Maps of components have `nside` and `fwhm` [arcmin].
    """

    exact: ClassVar[bool] = True
    in_pixels: ClassVar[bool] = False
    by_pixel: ClassVar[bool] = False
    fwhms: Float[np.ndarray, " band"]
    noise: Float[np.ndarray, "band stokes ell"]
    white: tuple[Numeric, ...]
    correlated: Float[np.ndarray, "band ell"]
    nside: int
    fwhm: float

    def likelihood(self, data: Float[np.ndarray, "band stokes alm"]) -> SpectralLikelihood:
        """The likelihood of data."""
        return harmonic_likelihood(
            self.sky, self.bands, data, self.noise, self.start, beams=self.fwhms, unit=self.unit
        )

    def noise_realisation(self, key: Array) -> Float[np.ndarray, "band stokes alm"]:
        """Noise like that of the data."""
        window = jnp.ones(self.noise.shape[-1])
        noises = zip(self.bands, self.white, jnp.asarray(self.correlated), strict=True)
        return np.stack([noise_alm(key, *band, window) for band in noises])

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        """Amplitudes of the components with all that is known of them."""
        return harmonic_component_maps(like, params, data, self.noise, beams=self.fwhms, **options)

    def maps(self, found: HarmonicMaps, like: SpectralLikelihood, params: Mapping, data):
        """Amplitudes as maps."""
        return found.maps(self.nside, self.fwhm)

    def residuals(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """Maps (band, stokes, pix) of the data less the components, each with its own beam."""
        rest = self.observed - self.emission(like, params, amplitude)
        return np.stack([np.asarray(synthesis(jnp.asarray(alm), self.nside)) for alm in rest])

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """What components show in the bands, with their beams."""
        windows = jnp.stack([gaussian_beam(f, lmax_of(amplitude)) for f in self.fwhms])
        return emission_maps(like, params, amplitude) * np.asarray(expand(windows))[:, None]


def _masked_alm(
    maps: Numeric, mask: Float[np.ndarray, " pix"], lmax: int
) -> Float[np.ndarray, "_ stokes alm"]:
    """Coefficients of maps times the mask."""
    seen = np.where(mask > 0, maps, 0.0) * mask
    return np.stack([np.asarray(low_multipoles(jnp.asarray(rows), lmax)) for rows in seen])


def separation_data(settings: Experiment) -> PixelData | FullSkyData:
    """Read or simulate what the settings name, and check that it can work."""
    spec, common = settings.separate, settings.common
    if not settings.cmb.include:
        raise SettingsError("cmb.include: is false, but a separation has a CMB.")
    if not common.fwhm:
        raise SettingsError("common.fwhm: must be positive for a separation.")
    free = settings.free_in("separate")
    if not free:
        raise SettingsError("free: name at least one parameter to fit.")
    if spec.domain == "harmonic":
        for name, parameter in free.items():
            if parameter.regions:
                raise SettingsError(
                    f"free.{name}: regions are those of pixels; the domain 'harmonic' takes one "
                    "value for the whole sky."
                )
    inside = region_mask(settings, spec.region, common.nside)
    _check_some(inside)
    sky, known = modelled_laws(settings)
    inside &= known
    _check_some(inside, " in which parameters are known")
    inputs = inputs_of(settings, templates=False, foregrounds=True)
    truth = inputs.truth
    if truth is not None:  # bands are simulated as they are described
        truth |= nominal(free)
    shared = {
        "sky": sky,
        "bands": {name: band.bandpass for name, band in inputs.bands.items()},
        "start": settings.start("separate"),
        "unit": spec.unit,
        "truth": truth,
        "description": inputs.description,
    }
    factors = [float(b.bandpass.conversion("uK_RJ", spec.unit)) for b in inputs.bands.values()]
    whole = inside.all() and all(np.all(band.used) for band in inputs.bands.values())
    make = _full_sky_data if spec.domain == "harmonic" and whole else _pixel_data
    return make(settings, inputs, inside, np.array(factors), shared)


def _check_some(pixels: np.ndarray, words: str = "") -> None:
    if not pixels.any():
        raise SettingsError(f"separate.region: leaves no pixel{words}.")


def _mask(settings: Experiment, used: Bool[np.ndarray, " pix"]) -> Float[np.ndarray, " pix"]:
    mask = apodize(used, settings.separate.apodization)
    _check_some(mask)
    return mask


def _pixel_data(
    settings: Experiment,
    inputs: Inputs,
    inside: Bool[np.ndarray, " pix"],
    factors: Float[np.ndarray, " band"],
    shared: dict[str, Any],
) -> PixelData:
    """Maps at the common resolution; `factors` are the unit of the data per uK_RJ."""
    prepared = prepared_maps(settings, inputs)
    used = prepared.used & inside
    _check_some(used)
    mask, sigma = _mask(settings, used), np.asarray(prepared.sigma) * factors[:, None, None]

    def scaled(maps):
        return np.where(used, np.asarray(maps) * factors[:, None, None], 0.0)

    alone, fluctuations = None, prepared.fluctuations
    if inputs.foregrounds is not None:
        pairs = zip(fluctuations.preparations, inputs.foregrounds.values(), strict=True)
        alone = scaled(jnp.stack([operator(maps) for operator, maps in pairs]))
    shared |= {
        "mask": mask,
        "observed": scaled(prepared.data),
        "foregrounds": alone,
        "labels": parameter_labels(settings, used),
        "fluctuations": fluctuations,
        "factors": factors,
    }
    if settings.separate.domain == "harmonic":
        used = mask > 0
    noise = as_noise(np.where(used, sigma, np.inf), sigma.shape)
    if settings.separate.domain == "pixel":
        return PixelData(**shared, used=used, noise=noise)
    spectra = _masked_noise(fluctuations, np.where(used, sigma, 0.0), factors, mask)
    return MaskedSkyData(
        **shared, used=used, noise=noise, spectra=spectra, fwhm=settings.common.fwhm
    )


def _masked_noise(
    fluctuations: Fluctuations,
    sigma: Float[np.ndarray, "band stokes pix"],
    factors: Float[np.ndarray, " band"],
    mask: Float[np.ndarray, " pix"],
) -> Float[np.ndarray, "band stokes ell"]:
    """N_l of masked noise: white as the beam of each band leaves it, and what is correlated."""
    preparations = fluctuations.preparations
    lmax = 2 * min(op.nside_in for op in preparations)
    lmax, area = min(lmax, 2 * healpy.npix2nside(mask.size)), np.mean(mask**2)
    spectra = np.zeros((len(sigma), 2, lmax + 1))
    for i, (op, spectrum) in enumerate(zip(preparations, fluctuations.correlated, strict=True)):
        assert op.window is not None  # there is a common beam
        shape, correlated = np.asarray(op.window[: lmax + 1]) ** 2, np.zeros(lmax + 1)
        if spectrum is not None:
            correlated = np.asarray(spectrum[: lmax + 1]) * factors[i] ** 2
        white = np.mean((sigma[i] * mask) ** 2) - map_variance(correlated) * area
        spectra[i] = white / map_variance(shape) * shape + correlated * area
    return spectra


def _full_sky_data(
    settings: Experiment,
    inputs: Inputs,
    inside: Bool[np.ndarray, " pix"],
    factors: Float[np.ndarray, " band"],
    shared: dict[str, Any],
) -> FullSkyData:
    """Coefficients of the bands as observed."""
    bands, common = inputs.bands, settings.common
    for name, band in bands.items():
        if np.ndim(band.beam):
            raise SettingsError(
                f"bands.{name}.beam: is a table; the domain 'harmonic' takes Gaussian beams, fwhm, "
                "on the full sky."
            )
        if band.leakage is not None:
            raise SettingsError(
                "bands.leakage: has a beam of its own and is subtracted at a common resolution "
                "only; choose the domain 'pixel'."
            )
    nsides = [healpy.npix2nside(band.used.size) for band in bands.values()]
    lmax = 2 * min(common.nside, *nsides)
    white: list[Numeric] = []
    correlated = np.zeros((len(nsides), lmax + 1))
    noise = np.zeros((len(nsides), 1, lmax + 1))
    for i, (band, factor) in enumerate(zip(bands.values(), factors, strict=True)):
        if np.ndim(band.noise):
            white.append(jnp.asarray(band.noise) * factor**2)
            level = jnp.diagonal(white[i]).mean() * healpy.nside2pixarea(nsides[i])
        else:
            white.append(band.noise * factor)
            level = (white[i] * np.radians(1 / 60)) ** 2
        if band.correlated is not None:
            correlated[i] = band.correlated[: lmax + 1] * factor**2
        noise[i] = level + correlated[i]

    def coefficients(maps):
        scaled = [np.asarray(m) * f for m, f in zip(maps, factors, strict=True)]
        return harmonic_coefficients(scaled, lmax)

    alone = inputs.foregrounds
    return FullSkyData(
        **shared,
        used=inside,
        mask=_mask(settings, inside),
        observed=coefficients([band.maps for band in bands.values()]),
        foregrounds=None if alone is None else coefficients(alone.values()),
        fwhms=np.array([float(band.beam) for band in bands.values()]),
        noise=np.broadcast_to(noise, (len(nsides), 2, lmax + 1)),
        white=tuple(white),
        correlated=correlated,
        nside=common.nside,
        fwhm=common.fwhm,
    )
