"""The data of a separation, from an experiment: pixels at a common resolution, or multipoles.

Both have the same methods, so that a separation does not ask which one it has.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.common import prepared_maps
from fits.fluctuations import Fluctuations, noise_alm
from fits.inputs import Inputs, inputs_of
from fits.mixing import NOMINAL
from fits.multipoles import harmonic_coefficients, harmonic_likelihood
from fits.noise import Noise, as_noise
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.regions import apodize, parameter_labels, region_mask
from fits.separated_maps import (
    ComponentMaps,
    HarmonicMaps,
    component_maps,
    emission_maps,
    harmonic_component_maps,
)
from jaxsky import Bandpass, Component, Sky, set_parameters
from jaxsky.checks import Numeric
from jaxsky.components import component_class
from jaxsky.harmonics import expand, gaussian_beam, lmax_of, synthesis
from jaxsky.inputs import read_parameters
from jaxsky.settings import Experiment, MapFile, SettingsError, at_key


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

    def maps(self, found: ComponentMaps) -> Float[np.ndarray, "component stokes pix"]:
        """Amplitudes as maps."""
        return found.amplitude

    def residuals(self, like: SpectralLikelihood, params: Mapping, found: ComponentMaps):
        """Maps (band, stokes, pix) of the data less the components; NaN in masked pixels."""
        return self.observed - emission_maps(like, params, found.amplitude)

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """What components show in the bands; zero in masked pixels."""
        return emission_maps(like, params, np.where(self.used, amplitude, 0.0))


@dataclass(frozen=True, kw_only=True)
class MultipoleData(_Data):
    """Coefficients that are separated multipole by multipole, each band with its own beam.

    `fwhms` are those of the bands [arcmin], and `noise` is N_l of the maps as observed [unit^2 sr].
    To draw it there is the `white` noise of each band, a level [unit arcmin] or the covariance of Q
    and U in each of its own pixels [unit^2], and the part of N_l that is `correlated` between
    pixels. Maps of components have `nside` and `fwhm` [arcmin].
    """

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

    def maps(self, found: HarmonicMaps) -> Float[np.ndarray, "component stokes pix"]:
        """Amplitudes as maps."""
        return found.maps(self.nside, self.fwhm)

    def residuals(self, like: SpectralLikelihood, params: Mapping, found: HarmonicMaps):
        """Maps (band, stokes, pix) of the data less the components, each with its own beam."""
        rest = self.observed - self.emission(like, params, found.amplitude)
        return np.stack([np.asarray(synthesis(jnp.asarray(alm), self.nside)) for alm in rest])

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """What components show in the bands, with their beams."""
        windows = jnp.stack([gaussian_beam(f, lmax_of(amplitude)) for f in self.fwhms])
        return emission_maps(like, params, amplitude) * np.asarray(expand(windows))[:, None]


def separation_data(settings: Experiment) -> PixelData | MultipoleData:
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
    sky, known = _sky(settings)
    inside &= known
    _check_some(inside, " in which parameters are known")
    inputs = inputs_of(settings, templates=False, foregrounds=True)
    truth = inputs.truth
    if truth is not None:  # bands are simulated as they are described
        words = {name: name.split(".")[0] for name in free}
        truth |= {name: NOMINAL[word] for name, word in words.items() if word in NOMINAL}
    shared = {
        "sky": sky,
        "bands": {name: band.bandpass for name, band in inputs.bands.items()},
        "start": settings.start("separate"),
        "unit": spec.unit,
        "truth": truth,
        "description": inputs.description,
    }
    factors = [float(b.bandpass.conversion("uK_RJ", spec.unit)) for b in inputs.bands.values()]
    make = _pixel_data if spec.domain == "pixel" else _multipole_data
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

    sigma = np.asarray(prepared.sigma) * factors[:, None, None]

    def scaled(maps):
        return np.where(used, np.asarray(maps) * factors[:, None, None], 0.0)

    alone, fluctuations = None, prepared.fluctuations
    if inputs.foregrounds is not None:
        pairs = zip(fluctuations.preparations, inputs.foregrounds.values(), strict=True)
        alone = scaled(jnp.stack([operator(maps) for operator, maps in pairs]))
    return PixelData(
        **shared,
        used=used,
        mask=_mask(settings, used),
        observed=scaled(prepared.data),
        foregrounds=alone,
        labels=parameter_labels(settings, used),
        noise=as_noise(np.where(used, sigma, np.inf), sigma.shape),
        fluctuations=fluctuations,
        factors=factors,
    )


def _multipole_data(
    settings: Experiment,
    inputs: Inputs,
    inside: Bool[np.ndarray, " pix"],
    factors: Float[np.ndarray, " band"],
    shared: dict[str, Any],
) -> MultipoleData:
    """Coefficients of the bands; `factors` are the unit of the data per uK_RJ."""
    bands, common = inputs.bands, settings.common
    for name, band in bands.items():
        if missing := int(np.sum(~np.asarray(band.used))):
            raise SettingsError(
                f"bands.{name}: {missing} pixels have no value; the domain 'harmonic' takes maps "
                "of the full sky."
            )
        if np.ndim(band.beam):
            raise SettingsError(
                f"bands.{name}.beam: is a table; the domain 'harmonic' takes Gaussian beams, fwhm."
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
    return MultipoleData(
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


def _sky(settings: Experiment) -> tuple[Sky, Bool[np.ndarray, " pix"]]:
    """The laws, on one pixel, or on all if parameters are maps; and where these are known."""
    folder, nside = Path(settings.data_dir), settings.common.nside
    laws = {name: settings.sky.components[name] for name in settings.modelled()}
    given = laws.values()
    maps = any(isinstance(value, MapFile) for c in given for value in c.parameters.values())
    amplitude = jnp.ones((2, 12 * nside**2 if maps else 1))
    components: dict[str, Component] = {"cmb": component_class("cmb")(amplitude)}
    known = np.ones(12 * nside**2, bool)
    for name, spec in laws.items():
        numbers, has = read_parameters(folder, name, spec, nside, "common.nside")
        known &= has
        with at_key(f"sky.{name}"):
            assert spec.law is not None  # as the settings see to
            components[name] = component_class(spec.law)(amplitude, **numbers)
    fixed = {n: v for n, v in settings.fixed.items() if n.split(".")[0] not in _others(settings)}
    with at_key("fixed"):
        return set_parameters(Sky(components), fixed), known


def _others(settings: Experiment) -> set[str]:
    """Components that are not modelled."""
    return set(settings.sky.components) - set(settings.modelled())
