"""What a spectral-index fit starts from: templates and observed maps, from files or embedded."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.settings import Band as BandSettings
from fits.settings import BandpassSpec, MapFile, Settings, SettingsError
from fits.settings import Template as TemplateSettings
from jaxsky import (
    AME,
    CMB,
    Bandpass,
    Component,
    Dust,
    Sky,
    Synchrotron,
    get_parameters,
    observe,
    parameter_names,
    set_parameters,
)
from jaxsky.cmb import camb_spectra, realisation
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import gaussian_beam, resample, synthesis
from jaxsky.instrument import load_instrument
from jaxsky.io import Maps, read_bandpass, read_maps, unit_factor
from jaxsky.io.tables import stokes
from jaxsky.noise import (
    draw,
    estimate_variance,
    fit_knee,
    knee_spectrum,
    uniform_covariance,
)
from jaxsky.units import conversion

__all__ = ["Band", "Inputs", "Template", "embedded_inputs", "read_inputs"]

LAWS: dict[str, type[Component]] = {"dust": Dust, "synchrotron": Synchrotron, "ame": AME}


class Template(NamedTuple):
    """A component at the resolution of its map."""

    component: Component
    fwhm: float
    used: Bool[np.ndarray, " pix"]


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
    templates: dict[str, Template] = {}
    for name, spec in sorted(settings.templates.items(), key=lambda item: item[1].law == "ame"):
        templates[name] = _read_template(folder, name, spec, templates)
    sky = set_parameters_of(templates, settings.fixed)
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


def _read(folder: Path, spec: MapFile) -> Maps:
    return read_maps(
        folder / spec.file,
        fields=spec.fields,
        hdu=spec.hdu,
        unit=spec.unit,
        ordering=spec.ordering,
        coordinates=spec.coordinates,
        polarization=spec.polarization,
    )


def _read_template(
    folder: Path, name: str, spec: TemplateSettings, others: dict[str, Template]
) -> Template:
    read = _read(folder, spec)
    _check_stokes(f"templates.{name}", read.names, "I" if spec.angles else "QU")
    maps = jnp.asarray(read.maps) * conversion(read.unit, "uK_RJ", spec.nu_ref)
    used = np.asarray(read.mask)
    parameters: dict[str, Any] = {"nu_ref": spec.nu_ref}
    for key, value in spec.parameters.items():
        if isinstance(value, MapFile):
            column = _read(folder, value)
            parameters[key], used = jnp.asarray(column.maps)[0], used & np.asarray(column.mask)
        else:
            parameters[key] = tuple(value) if isinstance(value, list) else value
    try:
        if spec.angles:
            if len(maps) != 1:
                raise ValueError(f"fields must name one intensity map, not {len(maps)} maps")
            component: Component = AME.from_dust_angles(
                maps[0], others[spec.angles].component.amplitude, **parameters
            )
        else:
            component = LAWS[spec.law](maps[-2:], **parameters)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"templates.{name}: {error}") from None
    return Template(component, spec.fwhm, used)


def _check_stokes(where: str, names: Sequence[str], wanted: str) -> None:
    """Refuse columns whose names say that they are other Stokes parameters than is wanted."""
    said = [stokes(name) for name in names[-len(wanted) :]]
    if any(s and s != w for s, w in zip(said, wanted, strict=False)):
        raise SettingsError(
            f"{where}.fields: {', '.join(names)} are not {' and '.join(wanted)} by their names."
        )


def _bandpass(folder: Path, spec: BandpassSpec) -> Bandpass:
    if spec.file is not None:
        return read_bandpass(
            folder / spec.file, spec.band, detectors=spec.detectors, convention=spec.convention
        )
    assert spec.center is not None  # one of file and center is given
    if not spec.width:
        return Bandpass.delta(spec.center)
    return Bandpass.top_hat(spec.center, spec.width, spec.convention or "RJ")


def _read_band(folder: Path, spec: BandSettings) -> Band:
    read = _read(folder, spec)
    if len(read.maps) < 2:
        raise SettingsError(f"bands.{spec.name}: fields must name Q and U.")
    _check_stokes(f"bands.{spec.name}", read.names, "QU")
    bandpass = _bandpass(folder, spec.bandpass)
    factor = bandpass.conversion(read.unit, "uK_RJ")
    maps, used = jnp.asarray(read.maps[-2:]) * factor, np.asarray(read.mask)
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
        rms = _read(folder, noise.map)
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
    read = _read(folder, columns)
    known = np.asarray(read.mask)
    QQ, QU, UU = jnp.asarray(read.maps) * unit_factor(read.unit, "uK_RJ^2", bandpass)
    _check_noise(spec, jnp.stack([QQ, UU, QQ * UU - QU**2]), known)
    return jnp.stack([jnp.stack([QQ, QU]), jnp.stack([QU, UU])]), known


def _check_noise(spec: BandSettings, rows: Array, known: np.ndarray) -> None:
    if bad := int(jnp.sum((rows <= 0).any(axis=0) & known)):
        raise SettingsError(
            f"bands.{spec.name}.noise: {bad} pixels have a noise that is not positive definite."
        )
