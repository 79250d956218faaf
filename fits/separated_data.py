"""The data of a component separation: pixels at a common resolution, or multipoles."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.common import Fluctuations, MapNoise, prepared_maps
from fits.compress import Noise
from fits.inputs import inputs_of
from fits.mixing import nominal
from fits.multipoles import harmonic_coefficients, harmonic_likelihood, masked_noise
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.regions import apodize, parameter_labels, region_mask
from fits.separated_maps import component_maps, emission_maps, harmonic_component_maps, synthesised
from jaxsky import Bandpass, Component, Sky, job, set_parameters
from jaxsky import inputs as reading
from jaxsky.checks import Numeric
from jaxsky.components import component_class
from jaxsky.harmonics import Preparation, expand, gaussian_beam, lmax_of, low_multipoles
from jaxsky.io.stacks import Maps, computed
from jaxsky.job import by_turns, filled
from jaxsky.mesh import distribute
from jaxsky.settings import Experiment, SettingsError, at_key


@dataclass(frozen=True, kw_only=True)
class _Data:
    """Base class: the laws and bands, start values by name, and the data in `unit`.

    Maps of the components have `nside` and `fwhm` [arcmin]. `used` are the pixels of the results,
    and `mask` the weight of each in spectra, 0 to 1, with smooth edges. For a simulation,
    `foregrounds` are data with nothing else in them, and `truth` the parameters that are numbers,
    including "r"; both are None for real maps.

    All kinds have the same methods, so that a separation works on any of them: `distributed`, the
    data as a process of a job takes them, its own pixels of maps, or all; `likelihood` of data;
    `noise_realisation` like that of the data; `components`, their amplitudes with errors and their
    maps; `emission` of amplitudes in the bands; and `residuals`, maps (band, stokes, pix) of the
    data minus that. The last two are NaN where amplitudes are, in masked pixels.
    """

    sky: Sky
    bands: dict[str, Bandpass]
    start: dict[str, float]
    unit: str
    nside: int
    fwhm: float
    used: Bool[np.ndarray, " pix"]
    mask: Float[np.ndarray, " pix"]
    observed: Float[np.ndarray, "band stokes _"] | Maps
    foregrounds: Float[np.ndarray, "band stokes _"] | Maps | None
    truth: dict[str, float] | None
    description: str

    #: Whether data are multipoles of the full sky, for which the likelihood is exact.
    exact: ClassVar[bool] = False

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude: Maps) -> Maps:
        return emission_maps(like, params, amplitude)


@dataclass(frozen=True, kw_only=True)
class PixelData(_Data):
    """Maps that are separated pixel by pixel, all at one resolution.

    `labels` are the regions of the free parameters that have them, `noise` is infinite where
    masked, `fluctuations` are the actual noise, correlated between pixels [uK_RJ], and `factors`
    are `unit` per uK_RJ in each band.
    """

    labels: dict[str, np.ndarray]
    noise: Noise
    fluctuations: Fluctuations
    factors: Float[np.ndarray, " band"]

    def distributed(self) -> Self:
        # Distributed pixels do not take laws with maps of parameters.
        maps = any(np.ndim(leaf) == 1 for leaf in jax.tree.leaves(self.sky))
        if job.number() == 1 or maps:
            return self
        npix = self.observed.shape[-1]

        def shared(array):
            return distribute(array) if np.shape(array)[-1:] == (npix,) else array

        noise = Noise(*map(shared, self.noise))
        labels = {name: shared(each) for name, each in self.labels.items()}
        observed = shared(self.observed)
        return dataclasses.replace(self, observed=observed, noise=noise, labels=labels)

    def likelihood(self, data: Float[np.ndarray, "band stokes pix"]) -> SpectralLikelihood:
        given = self.sky, self.bands, data, self.noise, self.start
        return spectral_likelihood(*given, labels=self.labels, unit=self.unit)

    def noise_realisation(self, key: Array) -> Maps:
        noise = self.fluctuations.noise_realisation(key)
        factors = self.factors[:, None, None]
        return computed(noise.shape, lambda part: noise[..., part] * factors)

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        found = component_maps(like, params, data, self.noise, **options)
        return found, found.amplitude

    def residuals(self, like: SpectralLikelihood, params: Mapping, amplitude):
        emission = self.emission(like, params, amplitude)
        shape = self.observed.shape
        return computed(shape, lambda part: self.observed[..., part] - emission[..., part])


@dataclass(frozen=True, kw_only=True)
class _Multipoles(_Data):
    """Data that are separated multipole by multipole.

    `spectra` is N_l of the noise in the data [unit^2 sr], and `fwhms` are their beams [arcmin].
    """

    spectra: Float[np.ndarray, "band stokes ell"]
    fwhms: Float[np.ndarray, " band"]

    def distributed(self) -> Self:
        return self

    def alm(self, data: Numeric) -> Float[np.ndarray, "_ stokes alm"]:
        """Return the coefficients of data."""
        return np.asarray(data)

    def likelihood(self, data: Float[np.ndarray, "band stokes _"]) -> SpectralLikelihood:
        given = self.sky, self.bands, self.alm(data), self.spectra, self.start
        return harmonic_likelihood(*given, beams=self.fwhms, unit=self.unit)

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        given = self.alm(data), self.spectra
        found = harmonic_component_maps(like, params, *given, beams=self.fwhms, **options)
        return found, found.maps(self.nside, self.fwhm)


@dataclass(frozen=True, kw_only=True)
class MaskedSkyData(_Multipoles, PixelData):
    """Maps on part of the sky that are separated multipole by multipole, all at one beam.

    All bands have the same beam and mask, so the coefficients of the masked maps are those of the
    masked components, mixed by the laws: the mask mixes multipoles, and E with B, equally in all
    bands. It correlates multipoles, so errors come from simulations.
    """

    def alm(self, data):
        """Return the coefficients of maps times the mask."""
        lmax = self.spectra.shape[-1] - 1
        seen = (np.where(self.mask > 0, data[i], 0.0) * self.mask for i in range(len(data)))
        return np.stack([np.asarray(low_multipoles(jnp.asarray(rows), lmax)) for rows in seen])

    def components(self, like, params, data, **options):
        # Maps are those of pixels, their multipoles replaced by the harmonic ones: signals are the
        # same, so only the noise changes, and no signal is lost beyond the last multipole.
        found, whole = super().components(like, params, data, **options)
        _, maps = PixelData.components(self, like, params, data, covariance=False)
        weight = np.where(self.used, self.mask, np.nan)
        return found, maps + (whole - synthesised(self.alm(maps), self.nside)) / weight


@dataclass(frozen=True, kw_only=True)
class FullSkyData(_Multipoles):
    """Multipoles of the full sky, each band with its own beam; the likelihood is exact.

    `noises` are those of the bands as observed, in `unit`, for realisations; emission and residuals
    of each band have its own beam.
    """

    exact: ClassVar[bool] = True
    noises: dict[str, MapNoise]

    def noise_realisation(self, key: Array) -> Float[np.ndarray, "band stokes alm"]:
        return np.stack([noise.alm(key, name) for name, noise in self.noises.items()])

    def residuals(self, like: SpectralLikelihood, params: Mapping, amplitude):
        return synthesised(self.observed - self.emission(like, params, amplitude), self.nside)

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        windows = jnp.stack([gaussian_beam(f, lmax_of(amplitude)) for f in self.fwhms])
        return super().emission(like, params, amplitude) * np.asarray(expand(windows))[:, None]


def modelled_laws(settings: Experiment) -> tuple[Sky, Bool[np.ndarray, " pix"]]:
    """Return laws, on one pixel, or on all if parameters are maps; and where these are known."""
    folder, nside = Path(settings.data_dir), settings.common.nside
    laws = {name: settings.sky.components[name] for name in settings.modelled()}
    maps = any(spec.maps for spec in laws.values())
    stokes = settings.common.stokes
    amplitude = jnp.ones((len(stokes), 12 * nside**2 if maps else 1))
    components: dict[str, Component] = {"cmb": component_class("cmb")(amplitude)}
    known = np.ones(12 * nside**2, bool)
    for name, spec in laws.items():
        # One reference frequency for all amplitudes: that of polarization, if there is any.
        row = stokes[-1] if spec.polarized else "I"
        given = folder, name, spec, nside, "common.nside", row
        numbers, has = reading.read_parameters(*given)
        known &= has
        with at_key(f"sky.{name}"):
            assert spec.law is not None  # the settings ensure this
            rows = amplitude
            if stokes == "IQU" and not spec.polarized:
                rows = amplitude.at[1:].set(0.0)
            components[name] = component_class(spec.law)(rows, **numbers)
    others = set(settings.sky.components) - set(laws)
    fixed = {name: v for name, v in settings.fixed.items() if name.split(".")[0] not in others}
    with at_key("fixed"):
        return set_parameters(Sky(components), fixed), known


def separation_data(settings: Experiment) -> PixelData | FullSkyData:
    """Read or simulate the data of a separation, and check that the settings allow it."""
    spec, common = settings.separate, settings.common
    if not settings.cmb.include:
        raise SettingsError("cmb.include: is false, but a separation has a CMB.")
    if not common.fwhm:
        raise SettingsError("common.fwhm: must be positive for a separation.")
    free = settings.free_in("separate")
    if not free:
        raise SettingsError("free: name at least one parameter to fit.")
    regions = [name for name, parameter in free.items() if parameter.regions]
    if spec.domain == "harmonic" and regions:
        raise SettingsError(
            f"free.{regions[0]}: regions are those of pixels; the domain 'harmonic' takes one "
            "value for the whole sky."
        )
    inside = region_mask(settings, spec.region, common.nside)
    _check_some(inside)
    sky, known = modelled_laws(settings)
    inside &= known
    _check_some(inside, " in which parameters are known")
    inputs = inputs_of(settings, templates=False, foregrounds=True)
    truth = inputs.truth
    if truth is not None:  # simulated bands have nominal parameters
        truth |= nominal(free)
    shared = {
        "sky": sky,
        "bands": {name: band.bandpass for name, band in inputs.bands.items()},
        "start": settings.start("separate"),
        "unit": spec.unit,
        "nside": common.nside,
        "fwhm": common.fwhm,
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


def _pixel_data(settings, inputs, inside, factors, shared) -> PixelData:
    """Return maps at the common resolution; `factors` are the unit of the data per uK_RJ."""
    prepared = prepared_maps(settings, inputs)
    used = prepared.used & inside
    _check_some(used)
    mask = apodize(used, settings.separate.apodization)
    _check_some(mask)
    fluctuations = prepared.fluctuations

    def scaled(maps):
        def inside(part):
            return np.where(used[part], np.asarray(maps[..., part]) * factors[:, None, None], 0.0)

        return computed(maps.shape, inside)

    alone = None
    if inputs.foregrounds is not None:
        each = list(inputs.foregrounds.values())

        def brought(i):
            return fluctuations.noises[i].preparation(jnp.asarray(np.asarray(each[i])))

        alone = scaled(filled(prepared.data.shape, brought))
    by_pixel = settings.separate.domain == "pixel"
    left = used if by_pixel else mask > 0
    shared |= {
        "used": left,
        "mask": mask,
        "observed": scaled(prepared.data),
        "foregrounds": alone,
        "labels": parameter_labels(settings, used),
        "noise": prepared.pixel_noise(left, factors),
        "fluctuations": fluctuations,
        "factors": factors,
    }
    if by_pixel:
        return PixelData(**shared)
    return MaskedSkyData(
        **shared,
        spectra=masked_noise(prepared, mask, factors),
        fwhms=np.full(len(factors), settings.common.fwhm),
    )


def _full_sky_data(settings, inputs, inside, factors, shared) -> FullSkyData:
    """Return coefficients of the bands as observed."""
    bands, nside = inputs.bands, settings.common.nside
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
    lmax, stokes = 2 * min(nside, *nsides), inputs.stokes
    spectra, noises = np.zeros((len(nsides), len(stokes), lmax + 1)), {}
    for i, (name, band) in enumerate(bands.items()):
        size, noise, correlated = factors[i], band.noise, None
        if np.ndim(noise):
            noise = jnp.asarray(noise) * size**2
            each = np.diagonal(noise).mean(axis=0)
            if "QU" in stokes:  # E and B have the mean of both
                each[-2:] = each[-2:].mean()
            level = each[:, None] * healpy.nside2pixarea(nsides[i])
        else:
            noise = noise * size
            level = (noise * np.radians(1 / 60)) ** 2
        spectra[i] = level
        if band.correlated is not None:
            correlated = band.correlated[..., : lmax + 1] * size**2
            spectra[i] += correlated
        as_observed = Preparation(jnp.ones(lmax + 1), nsides[i], nside)
        noises[name] = MapNoise(as_observed, noise, correlated, stokes)

    def coefficients(maps):
        def of_band(pair):
            own, factor = pair
            return harmonic_coefficients([np.asarray(own) * factor], lmax)[0]

        return np.stack(list(by_turns(of_band, list(zip(maps, factors, strict=True)))))

    alone = inputs.foregrounds
    return FullSkyData(
        **shared,
        used=inside,
        mask=inside.astype(float),
        observed=coefficients([band.maps for band in bands.values()]),
        foregrounds=None if alone is None else coefficients(alone.values()),
        fwhms=np.array([float(band.beam) for band in bands.values()]),
        spectra=spectra,
        noises=noises,
    )
