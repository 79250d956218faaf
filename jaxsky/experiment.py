"""Build a simulation from an experiment file, and refuse beams and pixels that do not fit."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.cmb import camb_spectra
from jaxsky.galaxy import EmbeddedSky
from jaxsky.harmonics import beam_ratio, resample
from jaxsky.inputs import Template, bandpass_of, beam_of, read_sky, set_parameters_of
from jaxsky.io import read_spectra
from jaxsky.io.maps import tangents
from jaxsky.noise import realisation_key
from jaxsky.noise_inputs import read_noise
from jaxsky.observation import DTYPES, Observation, ObservedBand, Source
from jaxsky.settings import BandTable, Experiment, NoiseColumns, SettingsError, at_key, find_file
from jaxsky.sky import Sky, get_parameters, observe_band, parameter_names
from jaxsky.small_scales import SmallScales

#: Smallest beam, in pixels, that a map resolves: b_l is then 0.43 at l = 2 nside.
PIXELS = 1.5
#: Where a beam's window is below this, nothing of the sky is visible.
UNSEEN_WINDOW = 1e-8


class SimulationInputs(NamedTuple):
    """Everything that `jaxsky.simulate` takes.

    `cmb` holds the spectra TT, EE, BB, TE [uK_CMB^2]; `leakage` is Q and U [uK_RJ] that leak from
    the intensity into each band, with its beam; `truth` holds the sky's scalar parameters by dotted
    name; `small_scales_seed` is given if all realisations have the same small scales.
    """

    sources: dict[str, Source]
    observation: Observation
    cmb: Float[np.ndarray, "4 ell"] | None
    leakage: dict[str, Float[Array, "2 pix"]]
    truth: dict[str, float]
    small_scales_seed: int | None
    description: str

    def small_scales_key(self, key: Array) -> Array:
        """Return the key of the small scales, given that of the realisation."""
        seed = self.small_scales_seed
        return key if seed is None else realisation_key(seed)


def simulation_inputs(
    settings: Experiment,
    names: Collection[str] | None = None,
    *,
    written: bool = True,
    galaxy: EmbeddedSky | None = None,
) -> SimulationInputs:
    """Read the sky and the bands called `names` (default: all), and check that they fit.

    If `written`, maps have the Stokes parameters and the precision of `simulate`, and pixels that
    resolve all beams; otherwise they are those of `common` in double precision, to be smoothed
    later. The map
    of a band does not depend on which other bands are simulated. `galaxy` is the embedded model, if
    it has been made already.
    """
    spec = settings.simulate
    stokes, precision = spec.stokes, spec.precision
    if not written:
        stokes, precision = settings.common.stokes, "double"
    target = spec.fwhm or None
    included = settings.included()
    tables = settings.sky.components
    foregrounds = [name for name in tables if name in included]
    seen_here = [n for n in foregrounds if written or stokes != "QU" or tables[n].polarized]
    sky, description = read_sky(settings, stokes, DTYPES[precision], names=seen_here, galaxy=galaxy)
    with at_key("truth"):
        templates = set_parameters_of(sky, settings.truth, tables)
    nside = map_nside(settings, templates)
    channels = {
        str(band.name): read_channel(settings, band, nside, stokes, "noise" in included)
        for band in settings.bands_of(stokes)
        if names is None or band.name in names
    }
    if not channels:
        raise SettingsError("bands: there are none.")
    seen = {name: _width(channel.map_beam) for name, channel in channels.items()}
    finest = min(seen, key=seen.__getitem__)
    if written:
        _check_pixels(nside, finest, seen[finest])
    for name, channel in channels.items():
        if target is not None and target < (own := _width(channel.beam)):
            raise SettingsError(
                f"simulate.fwhm: {target:g} arcmin is finer than the beam of band {name!r}, "
                f"{own:g} arcmin."
            )
    _check_templates(settings, templates, finest, seen[finest], written)
    sources = {name: _source(settings, name, template) for name, template in templates.items()}
    # The last multipole that any of the maps shows.
    beams = [c.beam for c in channels.values()] if target is None else [target]
    lmax = int(min(2 * nside, max(2.0, *map(_reach, beams))))
    observation = Observation(channels, nside, stokes, seen[finest], lmax, precision)
    cmb = cmb_spectra(settings, lmax) if "cmb" in included else None
    leakage = _leakage(settings, foregrounds, observation, galaxy)
    truth, seed = _truth(settings, sources, cmb is not None), spec.small_scales_seed
    return SimulationInputs(sources, observation, cmb, leakage, truth, seed, description)


def map_nside(settings: Experiment, templates: Mapping[str, Template]) -> int:
    """Return nside of the simulated maps: the settings', or that of the coarsest template."""
    if settings.simulate.nside is not None:
        return settings.simulate.nside
    if not templates and settings.sky.templates:  # nothing of the sky is simulated
        tables = settings.sky.components
        names = [name for name in settings.sky.templates if tables[name].polarized]
        templates, _ = read_sky(settings, names=names)
    if not templates:
        raise SettingsError("simulate.nside: is missing; there is no map of the sky that has one.")
    return min(healpy.npix2nside(template.used.size) for template in templates.values())


def _width(beam: Array | float) -> float:
    """Return the FWHM [arcmin] of a beam; a table counts as the Gaussian of its half width."""
    table = np.asarray(beam)
    if not table.ndim:
        return float(table)
    below = np.flatnonzero(table < 0.5)
    ell = int(below[0]) if below.size else len(table)
    return float(np.degrees(4 * np.log(2) / np.sqrt(ell * (ell + 1))) * 60)


def _reach(beam: Array | float) -> float:
    """Return the last multipole that is visible through a beam."""
    table = np.asarray(beam)
    if table.ndim:
        return float(np.flatnonzero(np.abs(table) > UNSEEN_WINDOW).max())
    sigma = np.radians(float(table) / 60) / np.sqrt(8 * np.log(2))
    return float(np.sqrt(-2 * np.log(UNSEEN_WINDOW)) / max(sigma, 1e-9))


def _check_pixels(nside: int, band: str, beam: float) -> None:
    pixel = healpy.nside2resol(nside, arcmin=True)
    if beam < PIXELS * pixel:
        needed = nside
        while beam < PIXELS * healpy.nside2resol(needed, arcmin=True) and needed < 2**20:
            needed *= 2
        raise SettingsError(
            f"simulate.nside: pixels of {pixel:.3g} arcmin (nside {nside}) are too wide for the "
            f"beam of {beam:g} arcmin of band {band!r}; that takes nside {needed}, or a common "
            f"simulate.fwhm of at least {PIXELS * pixel:.3g} arcmin."
        )


def _check_templates(
    settings: Experiment, templates: Mapping[str, Template], band: str, beam: float, written: bool
) -> None:
    for name, template in templates.items():
        if missing := int(np.sum(~template.used)):
            raise SettingsError(
                f"sky.{name}: {missing} pixels have no value; a simulation takes maps of the full "
                "sky."
            )
        nside = healpy.npix2nside(template.used.size)
        pixel = healpy.nside2resol(nside, arcmin=True)
        own = max(template.fwhm, PIXELS * pixel) if written else template.fwhm
        if settings.sky.components[name].small_scales is None and beam < own:
            pixels = f", {PIXELS:g} pixels of nside {nside}" if template.fwhm < own else ""
            raise SettingsError(
                f"sky.{name}: its resolution, {own:.3g} arcmin{pixels}, is coarser than "
                f"the {beam:g} arcmin of band {band!r}; add small scales, "
                f"[sky.{name}.small_scales], or bring the maps to a common simulate.fwhm of at "
                f"least {own:.3g} arcmin."
            )


def _source(settings: Experiment, name: str, template: Template) -> Source:
    spec = settings.sky.components[name].small_scales
    if spec is None:
        return Source(template.component, template.fwhm)
    with at_key(f"sky.{name}.small_scales"):
        small = SmallScales(**spec.model_dump(exclude={"correlated_with"}))
    return Source(template.component, template.fwhm, small, spec.correlated_with)


def _truth(settings: Experiment, sources: Mapping[str, Source], cmb: bool) -> dict[str, float]:
    """Return the scalar parameters of the simulated sky by dotted name, and r where it is known."""
    numbers = {"r": settings.cmb.r} if cmb and settings.cmb.file is None else {}
    if not sources:
        return numbers
    sky = Sky({name: source.component for name, source in sources.items()})
    values = get_parameters(sky, parameter_names(sky))
    return {n: float(value) for n, value in values.items() if not jnp.ndim(value)} | numbers


def read_channel(
    settings: Experiment, spec: BandTable, nside: int, stokes: str = "QU", noisy: bool = True
) -> ObservedBand:
    """Read how a band observes the sky from its table; if `noisy`, with its noise [uK_RJ]."""
    folder, where = Path(settings.data_dir), f"bands.{spec.name}"
    band, given = bandpass_of(folder, spec), spec.noise
    if (beam := beam_of(folder, spec, 2 * nside)) is None:
        raise SettingsError(f"{where}: give the beam either as fwhm or as a window, beam.")
    noise: Array | float | None = None
    if given is not None and noisy:
        where = f"{where}.noise"
        if given.estimate_above is not None:
            raise SettingsError(f"{where}.estimate_above: is of a map, but here none is read.")
        with_unit = isinstance(given.rms, NoiseColumns) or given.covariance or spec.file is None
        unit = given.unit or spec.unit or ("uK_CMB" if with_unit else None)
        if unit is None:
            raise SettingsError(
                f"{where}.unit: is missing; it is that of the map, which is not read here."
            )
        noise, known = read_noise(folder, spec, band, nside, where, unit, stokes)
        if missing := int(np.sum(~known)):
            raise SettingsError(
                f"{where}: {missing} pixels have no noise; a simulation takes maps of the full sky."
            )
    target = settings.simulate.fwhm or None
    return ObservedBand(band, jnp.asarray(beam), target, noise, settings.simulate.diagonal_noise)


def cmb_spectra(settings: Experiment, lmax: int, r: float | None = None) -> np.ndarray:
    """Return TT, EE, BB, TE of the CMB [uK_CMB^2], shape (4, ell); `r` overrides the settings."""
    spec = settings.cmb
    if spec.file is None:
        with at_key("cmb.cosmology"):
            total = camb_spectra(lmax, spec.r if r is None else r, **spec.cosmology)
            if spec.A_lens == 1:
                return total
            lensed = camb_spectra(lmax, **spec.cosmology)
            return total + (spec.A_lens - 1) * np.array([0, 0, 1, 0])[:, None] * lensed
    if r is not None:
        raise SettingsError("cmb.file: here r is changed, which takes spectra of CAMB.")
    with at_key("cmb"):
        path = find_file(Path(settings.data_dir), spec.files[0])
        return read_spectra(path, lmax, fields=spec.fields, unit=spec.unit)


def _leakage(
    settings: Experiment, names: list[str], observation: Observation, galaxy: EmbeddedSky | None
) -> dict[str, Float[Array, "2 pix"]]:
    """Return what leaks from the foregrounds' intensity into Q and U of each band [uK_RJ]."""
    fractions = {
        str(band.name): band.leakage
        for band in settings.bands
        if band.name in observation.names and isinstance(band.leakage, float)
    }
    if observation.stokes == "I" or not names or not any(fractions.values()):
        return {}
    with at_key("bands.leakage"):
        whole, _ = read_sky(settings, "IQU", names=names, galaxy=galaxy)
        whole = set_parameters_of(whole, settings.truth, settings.sky.components)
        sky = Sky({name: one.component for name, one in whole.items()})
        maps = {}
        for name, fraction in fractions.items():
            channel = observation.channels[name]
            leaked = leak(fraction * observe_band(sky, channel.band)[0])
            window = beam_ratio(channel.map_beam, 0.0, 2 * observation.nside)
            maps[name] = resample(leaked, window, observation.nside)
    return maps


def leak(intensity: Float[Array, " pix"]) -> Float[Array, "2 pix"]:
    """Return Q and U of an intensity that is polarized along the meridians of the ecliptic.

    This is the pattern of bandpass mismatch: the spacecraft spins once a minute about the direction
    of the Sun, and its detectors keep a fixed angle to their direction of motion.
    """
    nside = healpy.npix2nside(intensity.size)
    pole = healpy.Rotator(coord=["E", "G"])(np.array([0.0, 0.0, 1.0]))
    south, east = tangents(*healpy.pix2ang(nside, np.arange(intensity.size)))
    angle = 2 * np.arctan2(np.einsum("i,ip", pole, east), np.einsum("i,ip", pole, south))
    return intensity * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
