"""What an analysis starts from: templates and observed maps, from files or embedded."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.settings import Band as BandSettings
from fits.settings import Settings
from fits.template_noise import TemplateNoise, read_template_noise
from jaxsky import (
    Bandpass,
    get_parameters,
    observe_band,
    parameter_names,
    set_parameters,
)
from jaxsky.cmb import camb_spectra
from jaxsky.galaxy import EmbeddedSky, embedded_sky
from jaxsky.harmonics import gaussian_beam, resample
from jaxsky.inputs import (
    Template,
    check_stokes,
    narrow,
    read,
    read_bandpass_spec,
    read_templates,
    set_parameters_of,
    uK_RJ_per,
)
from jaxsky.instrument import Instrument, load_instrument
from jaxsky.keys import realisation_key
from jaxsky.noise import (
    estimate_variance,
    fit_knee,
    knee_spectrum,
    uniform_covariance,
)
from jaxsky.noise_inputs import read_noise
from jaxsky.observation import Observation, Source
from jaxsky.preparation import prepare
from jaxsky.settings_keys import at_key
from jaxsky.simulate import observe_bands

__all__ = [
    "Band",
    "Inputs",
    "Leakage",
    "embedded_inputs",
    "inputs_of",
    "leak",
    "read_band",
    "read_inputs",
]


class Leakage(NamedTuple):
    """Intensity leaked into Q and U of a band [uK_RJ], at the resolution of its own map."""

    maps: Float[Array, "stokes pix"]
    used: Bool[np.ndarray, " pix"]
    fwhm: float


class Band(NamedTuple):
    """Observed Q and U [uK_RJ] of a band at the resolution of the map.

    `noise` is the covariance of Q and U in each pixel, `correlated` the spectrum of noise
    beyond that, if there is any [uK_RJ^2]. `leakage` is in the maps, and subtracted where they
    are brought to a common resolution.
    """

    maps: Float[Array, "stokes pix"]
    used: Bool[np.ndarray, " pix"]
    bandpass: Bandpass
    fwhm: float
    noise: Float[Array, "stokes stokes pix"]
    correlated: Float[Array, " ell"] | None = None
    leakage: Leakage | None = None


class Inputs(NamedTuple):
    """Templates and bands by name, and what is known about them.

    `r` is the tensor-to-scalar ratio of the CMB, None where there is no CMB, `truth` holds the
    parameters of a simulation, and `description` says what the maps are. Templates whose noise is
    not known are missing in `template_noise`.
    """

    templates: dict[str, Template]
    bands: dict[str, Band]
    r: float | None
    truth: dict[str, float] | None
    description: str
    template_noise: Mapping[str, TemplateNoise] = MappingProxyType({})


def inputs_of(settings: Settings, galaxy: EmbeddedSky | None = None) -> Inputs:
    """The embedded sky where the settings have it, else what they name; see there."""
    return embedded_inputs(settings, galaxy) if settings.embedded else read_inputs(settings)


def embedded_inputs(settings: Settings, galaxy: EmbeddedSky | None = None) -> Inputs:
    """The embedded model of the Galaxy, observed with channels of instruments.

    The sky is the paper's baseline with the fixed parameters of the settings; CMB and noise are
    drawn from the seed. `galaxy` is the model at the settings' nside, if it is made already.
    """
    embedded, seed = settings.embedded, settings.analysis.seed
    assert embedded is not None
    galaxy = galaxy or embedded_sky(embedded.nside)
    with at_key("fixed"):
        sky = set_parameters(galaxy.sky("QU"), settings.fixed)
    with at_key("embedded.channels"):
        channels = [
            channel
            for name, chosen in embedded.channels.items()
            for channel in load_instrument(name).select(chosen)
        ]
    observed = Instrument("embedded", channels).observed()
    nside, lmax = embedded.nside, 2 * embedded.nside  # what the pixels resolve without aliasing
    r = settings.cmb.r if settings.cmb.include else None
    observation = Observation(
        observed, nside, finest=min(float(channel.fwhm) for channel in channels)
    )
    key = realisation_key(seed)
    prepared = prepare(key, {name: Source(sky[name]) for name in sky}, observation)
    spectra = None if r is None else jnp.asarray(camb_spectra(lmax, r))
    bands = {}
    used = np.ones(healpy.nside2npix(nside), bool)
    for name, seen in observe_bands(key, prepared, observation, spectra):
        channel, maps, leakage = observed[name], seen["total"], None
        fwhm = float(channel.beam)
        if fraction := embedded.leakage.get(name):
            whole = set_parameters(galaxy.sky("IQU"), settings.fixed)
            leaked = leak(fraction * observe_band(whole, channel.band)[0])
            leakage = Leakage(resample(leaked, gaussian_beam(fwhm, lmax), nside), used, fwhm)
            maps = maps + leakage.maps
        assert channel.noise is not None  # channels of an instrument have some
        noise = uniform_covariance(channel.noise, nside)
        bands[name] = Band(maps, used, channel.band, fwhm, noise, leakage=leakage)
    templates = {name: Template(sky[name], 0.0, used) for name in sky}
    known = parameter_names(sky)
    free = get_parameters(sky, [name for name in settings.free if name in known])
    truth = {name: float(value) for name, value in free.items()}
    exact = dict.fromkeys(templates, TemplateNoise())
    return Inputs(templates, bands, r, truth, galaxy.description, exact)


def leak(intensity: Float[Array, " pix"]) -> Float[Array, "2 pix"]:
    """Q and U of an intensity that is polarized along the meridians of the ecliptic.

    As detectors with different bandpasses see it that turn about the Sun's direction once a
    minute and always have the same angle to the direction in which they move.
    """
    nside = healpy.npix2nside(intensity.size)
    theta, phi = healpy.pix2ang(nside, np.arange(intensity.size))
    pole = healpy.Rotator(coord=["E", "G"])(np.array([0.0, 0.0, 1.0]))
    south = [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)]
    east = [-np.sin(phi), np.cos(phi), np.zeros_like(phi)]
    angle = 2 * np.arctan2(np.einsum("i,ip", pole, east), np.einsum("i,ip", pole, south))
    return intensity * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def read_inputs(settings: Settings) -> Inputs:
    """Templates and maps from the files that the settings name.

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be.
    """
    folder = Path(settings.data_dir)
    templates = read_templates(folder, settings.templates)
    with at_key("fixed"):
        sky = set_parameters_of(templates, settings.fixed)
    bands = {spec.name: read_band(folder, spec) for spec in settings.bands}
    noise = {
        name: read_template_noise(folder, name, spec, sky[name])
        for name, spec in settings.templates.items()
        if spec.noise is not None
    }
    r = settings.cmb.r if settings.cmb.include else None
    return Inputs(sky, bands, r, None, settings.title, noise)


def read_band(folder: Path, spec: BandSettings) -> Band:
    """Map, bandpass and noise of a band from the files that its settings name.

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be.
    """
    found = read(folder, spec)
    check_stokes(f"bands.{spec.name}", found, "QU")
    with at_key(f"bands.{spec.name}.bandpass"):
        bandpass = read_bandpass_spec(folder, spec.bandpass)
    maps = narrow(found.maps[-2:] * uK_RJ_per(found.unit, bandpass, f"bands.{spec.name}"))
    used, unit = np.asarray(found.mask), found.unit
    del found  # as large as all else
    leakage = _read_leakage(folder, spec, bandpass) if spec.leakage else None
    if spec.noise.estimate_above is not None:
        with at_key(f"bands.{spec.name}.noise.estimate_above"):
            noise, correlated = _estimated_noise(spec.noise, maps, used)
        return Band(maps, used, bandpass, spec.fwhm, noise, correlated, leakage)
    noise, known = read_noise(
        folder,
        spec.noise,
        bandpass,
        healpy.npix2nside(used.size),
        where=f"bands.{spec.name}.noise",
        unit=unit,
        own=spec,
        maps=maps,
        used=used,
    )
    maps = maps if known.all() else jnp.where(known, maps, 0)
    return Band(maps, used & known, bandpass, spec.fwhm, noise, leakage=leakage)


def _read_leakage(folder: Path, spec: BandSettings, bandpass: Bandpass) -> Leakage:
    assert spec.leakage is not None  # as called
    found = read(folder, spec.leakage, zeros_are_data=True)
    check_stokes(f"bands.{spec.name}.leakage", found, "QU")
    factor = uK_RJ_per(found.unit, bandpass, f"bands.{spec.name}.leakage")
    maps = narrow(found.maps[-2:] * factor)
    return Leakage(maps, np.asarray(found.mask), spec.leakage.fwhm)


def _estimated_noise(noise, maps, used):
    """Covariance of Q and U in each pixel and spectrum of the rest, from the maps themselves."""
    nside, npix = healpy.npix2nside(maps.shape[-1]), maps.shape[-1]
    latitude = healpy.pix2ang(nside, np.arange(npix), lonlat=True)[1]
    quiet = used & (np.abs(latitude) >= noise.estimate_above)
    if not noise.correlated:
        variance = estimate_variance(maps, quiet)
        return jnp.eye(2)[..., None] * variance[:, None, None] * jnp.ones(npix), None
    white, knee, slope = fit_knee(maps, quiet, 2 * nside)
    covariance = jnp.eye(2)[..., None] * jnp.full(npix, white / healpy.nside2pixarea(nside))
    excess = knee_spectrum(white, knee, slope, 4 * nside) - white
    return covariance, excess.at[:2].set(0.0)
