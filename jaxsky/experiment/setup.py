"""What the settings of a simulation name, brought together; refusals with the numbers."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.bandpass import Bandpass
from jaxsky.cmb import camb_spectra
from jaxsky.experiment.settings import BandTable, Experiment
from jaxsky.galaxy import GalaxyModel, embedded_sky
from jaxsky.inputs import (
    Template,
    read_bandpass_spec,
    read_templates,
    set_parameters_of,
)
from jaxsky.instrument import load_instrument
from jaxsky.io import read_beam, read_spectra
from jaxsky.lookup import find_file
from jaxsky.noise_inputs import read_noise
from jaxsky.observation import DTYPES, Observation, ObservedBand, Source
from jaxsky.settings import SettingsError
from jaxsky.settings_keys import at_key
from jaxsky.small_scales import SmallScales

__all__ = ["Setup", "build"]

#: A map resolves beams of so many pixels: there b_l is down to 0.43 at l = 2 nside.
PIXELS = 1.5
#: A beam below this lets nothing through that would be seen.
UNSEEN_WINDOW = 1e-8


class Setup(NamedTuple):
    """What is simulated, ready for `jaxsky.simulate`.

    Parameters
    ----------
    sources : components by name
    observation : the experiment
    cmb : spectra TT, EE, BB, TE [uK_CMB^2], or None
    description : what the templates are
    """

    sources: dict[str, Source]
    observation: Observation
    cmb: Float[np.ndarray, "4 ell"] | None
    description: str


def build(settings: Experiment) -> Setup:
    """Read what the settings name, and check that it can work.

    Raises
    ------
    jaxsky.io.InputError, SettingsError, KeyError
        For files that are not what they should be, names that do not exist, pixels too wide for
        a beam, a beam finer than a template without small scales, or one that is finer than the
        beam of a band.
    """
    main, included = settings.experiment, settings.included()
    channels = _channels(settings)
    target = None if main.fwhm == "own" else float(main.fwhm)
    seen = {
        name: _width(channel.beam) if target is None else target
        for name, channel in channels.items()
    }
    _check_pixels(main.nside, seen)
    if target is not None:
        for name, channel in channels.items():
            if target < (own := _width(channel.beam)):
                raise SettingsError(
                    f"experiment.fwhm: {target:g} arcmin is finer than the beam of band {name!r}, "
                    f"{own:g} arcmin."
                )
    used = [name for name in included if name in settings.foregrounds()]
    templates, description = _templates(settings) if used else ({}, "No foregrounds.")
    templates = {name: templates[name] for name in used}
    _check_templates(settings, templates, seen)
    sources = {name: _source(settings, name, template) for name, template in templates.items()}
    lmax = _lmax(channels, target, main.nside)
    finest = min(seen.values())
    observation = Observation(channels, main.nside, main.stokes, finest, lmax, main.precision)
    cmb = _cmb(settings, lmax) if "cmb" in included else None
    return Setup(sources, observation, cmb, description)


def _width(beam: Array | float) -> float:
    """FWHM [arcmin] of a Gaussian beam, or of the Gaussian that falls to 1/2 where a table does."""
    table = np.asarray(beam)
    if not table.ndim:
        return float(table)
    below = np.flatnonzero(table < 0.5)
    ell = int(below[0]) if below.size else len(table)
    return float(np.degrees(4 * np.log(2) / np.sqrt(ell * (ell + 1))) * 60)


def _lmax(channels: Mapping[str, ObservedBand], target: float | None, nside: int) -> int:
    """The last multipole that any of the maps shows, at most 2 nside."""
    beams = [c.beam for c in channels.values()] if target is None else [target]
    return int(min(2 * nside, max(2.0, *map(_reach, beams))))


def _reach(beam: Array | float) -> float:
    """The last multipole that a beam lets through; a table may fall less fast than a Gaussian."""
    table = np.asarray(beam)
    if table.ndim:
        return float(np.flatnonzero(np.abs(table) > UNSEEN_WINDOW).max())
    sigma = np.radians(float(table) / 60) / np.sqrt(8 * np.log(2))
    return float(np.sqrt(-2 * np.log(UNSEEN_WINDOW)) / max(sigma, 1e-9))


def _check_pixels(nside: int, beams: Mapping[str, float]) -> None:
    name = min(beams, key=beams.__getitem__)
    pixel, beam = healpy.nside2resol(nside, arcmin=True), beams[name]
    if beam < PIXELS * pixel:
        needed = nside
        while beam < PIXELS * healpy.nside2resol(needed, arcmin=True) and needed < 2**20:
            needed *= 2
        raise SettingsError(
            f"experiment.nside: pixels of {pixel:.3g} arcmin (nside {nside}) are too wide for the "
            f"beam of {beam:g} arcmin of band {name!r}; that takes nside {needed}, or a common "
            f"fwhm of at least {PIXELS * pixel:.3g} arcmin."
        )


def _templates(settings: Experiment) -> tuple[dict[str, Template], str]:
    stokes = settings.experiment.stokes
    if settings.embedded is None:
        dtype = DTYPES[settings.experiment.precision]
        templates = read_templates(Path(settings.data_dir), settings.templates, stokes, dtype)
        description = settings.title or "Templates from files."
    else:
        embedded = settings.embedded
        numbers: dict[str, Any] = embedded.model
        known = GalaxyModel.__dataclass_fields__
        for name in set(numbers) - set(known):
            raise SettingsError(f"embedded.model: {name!r} is none of {', '.join(known)}.")
        with at_key("embedded.model"):
            model = GalaxyModel(**numbers)
        galaxy = embedded_sky(embedded.nside, embedded.seed, model)
        sky = galaxy.sky(stokes)
        used = np.ones(sky.shape[1], bool)
        templates = {name: Template(sky[name], 0.0, used) for name in sky}
        description = galaxy.description
    with at_key("fixed"):
        return set_parameters_of(templates, settings.fixed), description


def _check_templates(
    settings: Experiment, templates: Mapping[str, Template], beams: Mapping[str, float]
) -> None:
    band = min(beams, key=beams.__getitem__)
    for name, template in templates.items():
        if missing := int(np.sum(~template.used)):
            raise SettingsError(
                f"templates.{name}: {missing} pixels have no value; a simulation takes maps of "
                "the full sky."
            )
        nside = healpy.npix2nside(template.used.size)
        pixel = healpy.nside2resol(nside, arcmin=True)
        own = max(template.fwhm, PIXELS * pixel)
        if name not in settings.small_scales and beams[band] < own:
            why = (
                f"{template.fwhm:g} arcmin"
                if template.fwhm == own
                else (f"{own:.3g} arcmin, {PIXELS:g} pixels of nside {nside}")
            )
            raise SettingsError(
                f"templates.{name}: its resolution, {why}, is coarser than the {beams[band]:g} "
                f"arcmin of band {band!r}; add small scales, [small_scales.{name}], or bring the "
                f"maps to a common fwhm of at least {own:.3g} arcmin."
            )


def _source(settings: Experiment, name: str, template: Template) -> Source:
    spec = settings.small_scales.get(name)
    if spec is None:
        return Source(template.component, template.fwhm)
    numbers = spec.model_dump(exclude={"correlated_with"})
    with at_key(f"small_scales.{name}"):
        small = SmallScales(**numbers)
    return Source(template.component, template.fwhm, small, spec.correlated_with)


def _channels(settings: Experiment) -> dict[str, ObservedBand]:
    """The bands with their noise [uK_RJ], if that is included."""
    main, folder = settings.experiment, Path(settings.data_dir)
    target = None if main.fwhm == "own" else float(main.fwhm)
    noisy = "noise" in settings.included()
    channels = {}
    if main.instrument is not None:
        with at_key("experiment.instrument"):
            instrument = load_instrument(main.instrument)
        if main.channels is not None:
            with at_key("experiment.channels"):
                instrument = instrument.select(main.channels)
        with at_key("experiment.samples"):
            observed = instrument.observed(target, main.samples)
        if noisy:
            return observed
        return {name: dataclasses.replace(seen, noise=None) for name, seen in observed.items()}
    for spec in settings.bands:
        band = _band(folder, spec)
        noise = None
        if noisy and spec.noise is not None:
            if spec.noise.level is not None:
                with at_key(f"bands.{spec.name}.noise.unit"):
                    noise = spec.noise.level * band.conversion(spec.noise.unit, "uK_RJ")
            else:
                noise, known = read_noise(
                    folder,
                    spec.noise,
                    band,
                    main.nside,
                    main.stokes,
                    where=f"bands.{spec.name}.noise",
                    unit=spec.noise.unit,
                )
                if missing := int(np.sum(~known)):
                    raise SettingsError(
                        f"bands.{spec.name}.noise: {missing} pixels have no noise; a simulation "
                        "takes maps of the full sky."
                    )
        if spec.beam is None:
            beam = jnp.asarray(spec.fwhm)
        else:
            with at_key(f"bands.{spec.name}.beam"):
                beam = jnp.asarray(read_beam(find_file(folder, spec.beam), 2 * main.nside))
        channels[spec.name] = ObservedBand(band, beam, target, noise, main.diagonal_noise)
    return channels


def _band(folder: Path, spec: BandTable) -> Bandpass:
    with at_key(f"bands.{spec.name}.bandpass"):
        return read_bandpass_spec(folder, spec.bandpass)


def _cmb(settings: Experiment, lmax: int) -> Float[np.ndarray, "4 ell"]:
    spec = settings.cmb
    if spec.spectra is None:
        with at_key("cmb.cosmology"):
            return camb_spectra(lmax, spec.r, **spec.cosmology)
    with at_key("cmb.spectra"):
        path = find_file(Path(settings.data_dir), spec.spectra)
        return read_spectra(path, lmax, format=spec.format, unit=spec.unit)
