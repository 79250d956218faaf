"""What a spectral-index fit starts from: templates and observed maps, from files or embedded."""

from pathlib import Path
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.settings import Band as BandSettings
from fits.settings import Settings
from jaxsky import (
    CMB,
    Bandpass,
    Sky,
    get_parameters,
    observe,
    parameter_names,
    set_parameters,
)
from jaxsky.cmb import camb_spectra, realisation
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import gaussian_beam, resample, synthesis
from jaxsky.inputs import Template, check_stokes, read, read_bandpass_spec, read_templates
from jaxsky.instrument import load_instrument
from jaxsky.io import unit_factor
from jaxsky.noise import (
    draw,
    estimate_variance,
    fit_knee,
    knee_spectrum,
    uniform_covariance,
)
from jaxsky.settings import SettingsError

__all__ = ["Band", "Inputs", "embedded_inputs", "read_inputs"]


class Band(NamedTuple):
    """Observed Q and U [uK_RJ] of a band at the resolution of the map.

    `noise` is the covariance of Q and U in each pixel, `correlated` the spectrum of noise
    beyond that, if there is any [uK_RJ^2].
    """

    maps: Float[Array, "stokes pix"]
    used: Bool[np.ndarray, " pix"]
    bandpass: Bandpass
    fwhm: float
    noise: Float[Array, "stokes stokes pix"]
    correlated: Float[Array, " ell"] | None = None


class Inputs(NamedTuple):
    """Templates and bands by name, and what is known about them.

    `cmb` holds the spectra TT, EE, BB, TE [uK_CMB^2] or None, `truth` the parameters of a
    simulation, and `description` says what the maps are.
    """

    templates: dict[str, Template]
    bands: dict[str, Band]
    cmb: Float[np.ndarray, "4 ell"] | None
    truth: dict[str, float] | None
    description: str


def embedded_inputs(settings: Settings) -> Inputs:
    """The embedded model of the Galaxy, observed with an instrument's channels.

    The sky is the paper's baseline with the fixed parameters of the settings; CMB and noise are
    drawn from the seed.
    """
    embedded, seed = settings.embedded, settings.analysis.seed
    assert embedded is not None
    galaxy = embedded_sky(embedded.nside)
    sky = set_parameters(galaxy.sky("QU"), settings.fixed)
    instrument = load_instrument(embedded.instrument).select(embedded.channels)
    lmax = 2 * embedded.nside  # what the pixels resolve without aliasing
    spectra = camb_spectra(2 * lmax, settings.cmb.r) if settings.cmb.include else None
    cmb_key, *noise_keys = jax.random.split(jax.random.key(seed), 1 + len(embedded.channels))
    components = dict(sky.components)
    if spectra is not None:
        alm = realisation(cmb_key, jnp.asarray(spectra)[:, : lmax + 1])
        components["cmb"] = CMB(synthesis(alm, embedded.nside))
    seen = observe(Sky(components), list(instrument.bands().values()))

    bands = {}
    used = np.ones(healpy.nside2npix(embedded.nside), bool)
    for channel, bandpass, maps, key in zip(
        instrument, instrument.bands().values(), seen, noise_keys, strict=True
    ):
        factor = bandpass.conversion(channel.noise_unit, "uK_RJ")
        noise = uniform_covariance(channel.noise * factor, embedded.nside)
        smoothed = resample(maps, gaussian_beam(channel.fwhm, lmax), embedded.nside)
        bands[channel.name] = Band(
            smoothed + draw(key, noise), used, bandpass, float(channel.fwhm), noise
        )
    templates = {name: Template(sky[name], 0.0, used) for name in sky}
    known = parameter_names(sky)
    free = get_parameters(sky, [name for name in settings.free if name in known])
    truth = {name: float(value) for name, value in free.items()}
    return Inputs(templates, bands, spectra, truth, galaxy.description)


def read_inputs(settings: Settings) -> Inputs:
    """Templates and maps from the files that the settings name.

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be.
    """
    folder = Path(settings.data_dir)
    sky = set_parameters_of(read_templates(folder, settings.templates), settings.fixed)
    bands = {spec.name: _read_band(folder, spec) for spec in settings.bands}
    nside = max(healpy.npix2nside(band.maps.shape[-1]) for band in bands.values())
    spectra = camb_spectra(4 * nside, settings.cmb.r) if settings.cmb.include else None
    return Inputs(sky, bands, spectra, None, settings.title)


def set_parameters_of(
    templates: dict[str, Template], fixed: dict[str, float]
) -> dict[str, Template]:
    """Templates with some of their parameters set, by dotted name."""
    by_template: dict[str, dict[str, float]] = {}
    for name, value in fixed.items():
        by_template.setdefault(name.split(".")[0], {})[name] = value
    for name, values in by_template.items():
        if name not in templates:
            raise SettingsError(
                f"fixed: there is no template {name!r}; templates are {', '.join(templates)}."
            )
        alone = Sky({name: templates[name].component})
        component = set_parameters(alone, values)[name]
        templates[name] = templates[name]._replace(component=component)
    return templates


def _read_band(folder: Path, spec: BandSettings) -> Band:
    found = read(folder, spec)
    if len(found.maps) < 2:
        raise SettingsError(f"bands.{spec.name}: fields must name Q and U.")
    check_stokes(f"bands.{spec.name}", found.names, "QU")
    bandpass = read_bandpass_spec(folder, spec.bandpass)
    factor = bandpass.conversion(found.unit, "uK_RJ")
    maps, used = jnp.asarray(found.maps[-2:]) * factor, np.asarray(found.mask)
    if spec.noise.estimate_above is not None:
        noise, correlated = _estimated_noise(spec.noise, maps, used)
        return Band(maps, used, bandpass, spec.fwhm, noise, correlated)
    noise, known = _given_noise(folder, spec, maps, factor, bandpass)
    return Band(jnp.where(known, maps, 0), used & known, bandpass, spec.fwhm, noise)


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


def _given_noise(folder, spec, maps, factor, bandpass):
    """Covariance of Q and U in each pixel [uK_RJ^2], and where it is known."""
    npix = maps.shape[-1]
    read_nside = healpy.npix2nside(npix)
    noise, eye = spec.noise, jnp.eye(2)[..., None]
    if noise.rms is not None:
        return eye * jnp.full(npix, (noise.rms * factor) ** 2), np.ones(npix, bool)
    if noise.map is not None:
        rms = read(folder, noise.map)
        known = np.asarray(rms.mask)
        if rms.nside != read_nside:
            raise SettingsError(
                f"bands.{spec.name}.noise: the map of the noise has nside {rms.nside}, "
                f"that of the band {read_nside}."
            )
        to_RJ = bandpass.conversion(rms.unit, "uK_RJ")
        rows = jnp.asarray(rms.maps) * to_RJ
        _check_noise(spec, rows, known)
        return eye * jnp.broadcast_to(rows[-2:], maps.shape) ** 2, known
    columns = spec.model_copy(update={"fields": list(noise.covariance), "unit": None})
    found = read(folder, columns)
    known = np.asarray(found.mask)
    QQ, QU, UU = jnp.asarray(found.maps) * unit_factor(found.unit, "uK_RJ^2", bandpass)
    _check_noise(spec, jnp.stack([QQ, UU, QQ * UU - QU**2]), known)
    return jnp.stack([jnp.stack([QQ, QU]), jnp.stack([QU, UU])]), known


def _check_noise(spec: BandSettings, rows: Array, known: np.ndarray) -> None:
    if bad := int(jnp.sum((rows <= 0).any(axis=0) & known)):
        raise SettingsError(
            f"bands.{spec.name}.noise: {bad} pixels have a noise that is not positive definite."
        )
