"""Read or simulate the input of an analysis: templates and observed maps, with their noise."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.regions import absolute_latitude
from jaxsky import Bandpass, job
from jaxsky import inputs as reading
from jaxsky.arrays import STOKES, stokes_rows
from jaxsky.checks import Numeric, listed
from jaxsky.experiment import SimulationInputs, cmb_spectra, simulation_inputs
from jaxsky.galaxy import EmbeddedSky
from jaxsky.harmonics import gaussian_beam
from jaxsky.io import MissingFileError
from jaxsky.io.stacks import Maps, stored
from jaxsky.job import by_turns
from jaxsky.noise import (
    estimate_variance,
    fit_knee,
    knee_spectrum,
    pixel_covariance,
    realisation_key,
)
from jaxsky.noise_inputs import read_noise
from jaxsky.observation import Observation, ObservedBand
from jaxsky.observed import Observed, observed_band, read_observed
from jaxsky.settings import (
    BandTable,
    ComponentTable,
    Experiment,
    MapKeys,
    SettingsError,
    at_key,
    find_file,
)
from jaxsky.simulation import harmonic_sources, observe_bands


class Leakage(NamedTuple):
    """Intensity leaked into Q and U of a band [uK_RJ], at the resolution of its own map."""

    maps: Float[Array, "stokes pix"]
    used: Bool[np.ndarray, " pix"]
    beam: float | Float[Array, " ell"]

    def into(self, stokes: str) -> "Leakage | None":
        """Return what leaks into maps of some Stokes parameters: into I, nothing."""
        if stokes == "I":
            return None
        return self._replace(maps=jnp.pad(self.maps, ((len(stokes) - 2, 0), (0, 0))))


class Band(NamedTuple):
    """Observed maps [uK_RJ] of a band at their own resolution.

    `beam` is the FWHM of a Gaussian [arcmin] or a table b_l. `noise` is a level [uK_RJ arcmin] or
    the covariance of the Stokes parameters in each pixel; `correlated` is the spectrum of
    additional noise, if any [uK_RJ^2].
    `leakage` is in the maps, and is subtracted when they are brought to a common resolution.
    Large maps of many bands lie on disk (`jaxsky.io.stacks`).
    """

    maps: Float[Array, "stokes pix"] | Maps
    used: Bool[np.ndarray, " pix"]
    bandpass: Bandpass
    beam: float | Float[Array, " ell"]
    noise: Numeric | Maps
    correlated: Float[Array, "*stokes ell"] | None = None
    leakage: Leakage | None = None

    def of_many(self, number: int) -> "Band":
        """Return the band, of which there are as many, with its maps on disk if all are large."""
        used = np.broadcast_to(True, self.used.shape) if self.used.all() else self.used
        return reading.of_many(self._replace(used=used), number)


class TemplateNoise(NamedTuple):
    """Noise of a template; without any of these it has none.

    `noise` is that of the pixels of its map, a level [uK_RJ arcmin] or the covariance of the Stokes
    parameters in each [uK_RJ^2]; `correlated` the spectrum C_l of noise that is correlated between
    pixels [uK_RJ^2]. `shared` are factors by which the noise of bands, by name, is in the template,
    too.
    """

    noise: Numeric = 0.0
    correlated: Float[Array, " ell"] | None = None
    shared: Mapping[str, float] = MappingProxyType({})

    @property
    def own(self) -> bool:
        """True if there is noise that is not a band's."""
        return bool(np.ndim(self.noise)) or bool(self.noise) or self.correlated is not None


class Inputs(NamedTuple):
    """Templates and bands by name, and what is known about them.

    `cmb` gives spectra TT, EE, BB, TE of the CMB up to a multipole, None where there is no CMB.
    `truth` are the parameters of a simulated sky that are numbers, including "r"; None where maps
    are not simulated. `description` says what the maps are. Templates whose noise is not known are
    missing from `template_noise`. `foregrounds` are maps of simulated bands with nothing else. What
    all bands have of large maps lies on disk. `stokes` are the rows of all maps.
    """

    templates: dict[str, reading.Template]
    bands: dict[str, Band]
    cmb: Callable[[int], np.ndarray] | None
    truth: dict[str, float] | None
    description: str
    template_noise: Mapping[str, TemplateNoise] = MappingProxyType({})
    foregrounds: dict[str, Float[Array, "stokes pix"] | Maps] | None = None
    stokes: str = "QU"


def inputs_of(
    settings: Experiment,
    *,
    templates: bool = True,
    foregrounds: bool = False,
    galaxy: EmbeddedSky | None = None,
) -> Inputs:
    """Read the templates of the model, and maps: from files, or simulated where there is none.

    `foregrounds` adds maps of these alone, if all bands are simulated. `galaxy` is the embedded
    model, if it has been made already.
    """
    folder = Path(settings.data_dir)
    stokes = settings.common.stokes
    specs = settings.bands_of(stokes)
    if not specs:
        raise SettingsError("bands: there are none.")
    components, own = settings.sky.components, settings.sky.templates
    if galaxy is None and any(components[name].file is None for name in own):
        galaxy = reading.embedded_galaxy(settings)
    sky, description, many = dict[str, reading.Template](), settings.title, len(specs)
    if templates:
        given: Any = {"names": settings.modelled(), "galaxy": galaxy, "number": many}
        sky, description = reading.read_sky(settings, stokes, **given)

    filed = [s for s in specs if s.file is not None or settings.common.maps is not None]
    found = list(by_turns(partial(_from_file, settings), filed))
    bands = {str(spec.name): band for spec, (band, _) in zip(filed, found, strict=True)}
    truths, alone = [truth for _, truth in found], None
    if missing := [str(spec.name) for spec in specs if str(spec.name) not in bands]:
        if "noise" not in settings.included():
            raise SettingsError("simulate.include: leaves out the noise, which errors are made of.")
        setup = simulation_inputs(settings, missing, written=False, galaxy=galaxy)
        made, alone = _simulated(settings, setup, foregrounds and not bands)
        bands = {str(s.name): (bands | made)[str(s.name)] for s in specs}
        truths.append(setup.truth)
        description = setup.description
    noises = {
        n: read_template_noise(folder, n, components[n], one, stokes) for n, one in sky.items()
    }
    return Inputs(
        sky,
        bands,
        partial(cmb_spectra, settings) if settings.cmb.include else None,
        dict(truths[0]) if truths[0] and all(t == truths[0] for t in truths) else None,
        description,
        {name: noise for name, noise in noises.items() if noise is not None},
        alone,
        stokes,
    )


def level_spectrum(
    level: float, fwhm: float, lmax: int, stokes: str = "QU"
) -> Float[Array, " ell"]:
    """Return the spectrum of white noise [uK_RJ arcmin] seen through a beam of fwhm [arcmin]."""
    white = (level * np.radians(1 / 60)) ** 2 * jnp.asarray(gaussian_beam(fwhm, lmax)) ** 2
    return white.at[:2].set(0.0) if stokes == "QU" else white


def read_template_noise(
    folder: Path, name: str, spec: ComponentTable, template: reading.Template, stokes: str = "QU"
) -> TemplateNoise | None:
    """Read the noise of a template from the settings; None if they do not state it."""
    noise, where = spec.noise, f"sky.{name}.noise"
    if noise is None:
        return TemplateNoise() if spec.file is None else None  # the embedded maps are exact
    if noise.rms == 0 or noise.level == 0:
        return TemplateNoise(shared=noise.shared)
    if spec.angles is not None:
        raise SettingsError(
            f"{where}: is not known for a template with the angles of another; write "
            "{ rms = 0.0 } to take it as exact."
        )
    nside, unit = healpy.npix2nside(template.used.size), noise.unit or template.unit
    at, level = spec.reference(stokes[-1]), noise.level_of(stokes[-1])
    if (spec.reference(stokes[0]), noise.level_of(stokes[0])) != (at, level):
        raise SettingsError(
            f"{where}: is not known where I has a frequency or level of its own; choose I or QU "
            "as common.stokes, or write { rms = 0.0 } to take the template as exact."
        )
    if level is not None:
        level = level * reading.uK_RJ_per(unit, at, where)
        spectrum = level_spectrum(level, template.fwhm, 4 * nside, stokes)
        return TemplateNoise(correlated=spectrum, shared=noise.shared)
    maps = template.component.amplitude
    found, _ = read_noise(
        folder, spec, at, nside, where, template.unit, stokes, maps=maps, used=template.used
    )
    return TemplateNoise(found, shared=noise.shared)


def unknown_noise(names: Sequence[str]) -> str:
    """Return a warning about templates without stated noise, with the size of the effect."""
    return (
        f"Nothing is said about the noise of the templates ({listed(names)}), which attenuates "
        "them and moves the indices. At about the level of Commander's maps, 34 uK_RJ arcmin for "
        "dust and 200 for synchrotron, fits to Planck's 44 and 70 GHz get beta_dust wrong by "
        "-0.007 (-0.8 sigma) and beta_syn by +0.036 (+2.7 sigma) at |b| < 20 deg, -0.019 (-2.1 "
        "sigma) and +0.076 (+5.3 sigma) on the full sky. State it in the templates, noise = "
        "{ level = 34.0 }, and the fit is corrected for it, or noise = { rms = 0.0 } for exact "
        "templates."
    )


def _simulated(
    settings: Experiment, setup: SimulationInputs, foregrounds: bool
) -> tuple[dict[str, Band], dict[str, Array] | None]:
    """Return the bands of the first realisation of `jaxsky simulate`, and their foregrounds."""
    observation, key = setup.observation, realisation_key(settings.seed)
    sky = harmonic_sources(setup.small_scales_key(key), setup.sources, observation)
    used = np.ones(healpy.nside2npix(observation.nside), bool)
    names = observation.names
    many = len(settings.bands_of(observation.stokes))
    own = names[job.index() :: job.number()]
    made = observe_bands(key, sky, observation, setup.cmb, names=own)

    def band_of(name: str) -> Band:
        observed, total = observed_band(setup, name), next(made)[1]["total"]
        where = f"bands.{name}.noise"
        noise, correlated = _noise_of(observed, observation.nside, where, observation.stokes)
        if (leakage := _leakage_of(observed, used, observation.stokes)) is not None:
            total = total + leakage.maps
        own = Band(total, used, observed.bandpass, observed.beam, noise, correlated, leakage)
        return own.of_many(many)

    bands = dict(zip(names, by_turns(band_of, names), strict=True))
    if not foregrounds or not sky:
        return bands, None
    quiet = {n: ObservedBand(c.band, c.beam, c.target) for n, c in observation.channels.items()}
    alone = Observation(quiet, observation.nside, observation.stokes, lmax=observation.lmax)
    seen = observe_bands(key, sky, alone, names=own)
    each = by_turns(lambda _: stored(next(seen)[1]["total"], many), names)
    return bands, dict(zip(names, each, strict=True))


def _noise_of(
    observed: Observed, nside: int, where: str, stokes: str
) -> tuple[Numeric, Float[Array, "*stokes ell"] | None]:
    """Return the white noise of a simulation, or the spectrum of noise that was smoothed."""
    spectrum = observed.spectrum
    if observed.noise is not None:
        noise: Any = np.asarray(observed.noise)
        if not noise.ndim:
            return observed.noise, None
        rows = stokes_rows(stokes, STOKES[len(noise)])
        return pixel_covariance(noise, nside, len(noise))[rows, rows], None
    if spectrum is None:
        raise SettingsError(
            f"{where}: is missing, or is of pixels that were smoothed with the map."
        )
    if spectrum.ndim > 1 and stokes != "IQU":
        spectrum = spectrum["IQU".index(stokes)]  # Q and U have the same
    beyond = max(0, 4 * nside + 1 - spectrum.shape[-1])
    return 0.0, jnp.asarray(np.pad(spectrum, [(0, 0)] * (spectrum.ndim - 1) + [(0, beyond)]))


def _leakage_of(
    observed: Observed | None, used: Bool[np.ndarray, " pix"], stokes: str
) -> Leakage | None:
    if observed is None or observed.leakage is None:
        return None
    return Leakage(jnp.asarray(observed.leakage), used, observed.beam).into(stokes)


def _from_file(settings: Experiment, spec: BandTable) -> tuple[Band, Mapping[str, float] | None]:
    """Read a band from its file, or from simulated maps, and the true parameters of its sky."""
    folder = Path(settings.data_dir)
    if spec.file is not None:
        observed = read_observed(find_file(folder, spec.files[0]))
        if observed is not None:
            _check_beam(folder, spec, observed)
    else:
        name = f"{settings.common.maps}/{spec.name}.fits"
        try:
            observed = read_observed(find_file(folder, name))
        except MissingFileError as error:
            raise SettingsError(f"common.maps: {error}") from None
        if observed is None:
            raise SettingsError(f"common.maps: {name} was not written by jaxsky simulate.")
        # The file describes its map, which may have another beam than the band.
        spec = BandTable(name=spec.name, file=name, fields=list(settings.common.stokes))
    stokes = settings.common.stokes
    band = read_band(folder, spec, observed, stokes).of_many(len(settings.bands_of(stokes)))
    return band, None if observed is None else observed.truth


def _check_beam(folder: Path, spec: BandTable, observed: Observed) -> None:
    """Refuse a beam that differs from that of the simulated map."""
    own = np.asarray(observed.beam)
    given = reading.beam_of(folder, spec, own.size - 1)
    if given is None or (np.shape(given) == own.shape and np.allclose(given, own, 0, 1e-6)):
        return
    said = f"fwhm: {spec.fwhm:g} arcmin" if spec.beam is None else f"beam: {spec.beam}"
    raise SettingsError(
        f"bands.{spec.name}.{said}, but the map {spec.label} says that its beam is "
        f"{'another table' if own.ndim else f'{own:g} arcmin'}."
    )


def read_band(
    folder: Path, spec: BandTable, observed: Observed | None = None, stokes: str = "QU"
) -> Band:
    """Read map, bandpass and noise of a band from the files named in its settings.

    By default they are those of the simulation that made the map, `observed`.
    """
    where = f"bands.{spec.name}"
    if spec.bandpass is None and observed is not None:
        bandpass = observed.bandpass
    else:
        bandpass = reading.bandpass_of(folder, spec)
    maps, used, unit = _read_maps(folder, spec, bandpass, where, stokes)
    nside = healpy.npix2nside(used.size)
    if (beam := reading.beam_of(folder, spec, 2 * nside)) is None:
        beam = 0.0 if observed is None else observed.beam
    leakage = _leakage_of(observed, used, stokes)
    if isinstance(given := spec.leakage, MapKeys):
        own, known, _ = _read_maps(folder, given, bandpass, f"{where}.leakage", "QU", True)
        leakage = Leakage(own, known, given.fwhm or 0.0).into(stokes)
    elif given and (observed is None or observed.leakage is None):
        words = f"{given:g} is of a simulation, but {spec.label} holds none"
        raise SettingsError(f"{where}.leakage: {words}; give the map that is subtracted.")
    where, correlated = f"{where}.noise", None
    if spec.noise is None:
        if observed is None:
            raise SettingsError(f"{where}: is missing.")
        noise, correlated = _noise_of(observed, nside, where, stokes)
    elif spec.noise.estimate_above is not None:
        with at_key(f"{where}.estimate_above"):
            noise, correlated = _estimated_noise(spec.noise, maps, used)
    else:
        given_maps: Any = {"maps": maps, "used": used}
        noise, known = read_noise(folder, spec, bandpass, nside, where, unit, stokes, **given_maps)
        maps, used = maps if known.all() else jnp.where(known, maps, 0), used & known
    return Band(maps, used, bandpass, beam, noise, correlated, leakage)


def _read_maps(
    folder: Path,
    spec: MapKeys,
    bandpass: Bandpass,
    where: str,
    stokes: str,
    zeros_are_data: bool = False,
) -> tuple[Array, Bool[np.ndarray, " pix"], str]:
    """Read maps of Stokes parameters [uK_RJ], where they are known, and the unit of the file."""
    found = reading.read(folder, spec, zeros_are_data=zeros_are_data)
    rows = reading.check_stokes(where, found, stokes)
    maps = reading.narrow(found.maps[rows] * reading.uK_RJ_per(found.unit, bandpass, where))
    return maps, np.asarray(found.mask), found.unit


def _estimated_noise(noise, maps, used):
    """Estimate white noise, and the spectrum of the rest, from the maps themselves."""
    nside = healpy.npix2nside(used.size)
    quiet = used & (absolute_latitude(nside) >= noise.estimate_above)
    if not noise.correlated:
        variance = estimate_variance(maps, quiet)
        return jnp.eye(len(maps))[..., None] * variance[:, None, None] * jnp.ones(used.size), None
    white, knee, slope = fit_knee(maps, quiet, 2 * nside)
    excess = knee_spectrum(white, knee, slope, 4 * nside) - white
    return float(np.degrees(np.sqrt(white)) * 60), excess.at[:2].set(0.0)
