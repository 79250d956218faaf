"""Simulate realisations into files, in any order and number of processes; runs can be resumed.

Each file records how its map was observed, in tables of bandpass, beam, noise, leakage and truth.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Array, Float

import jaxsky
from jaxsky.bandpass import Bandpass
from jaxsky.experiment import SimulationInputs
from jaxsky.harmonics import beam_ratio
from jaxsky.interpolation import Terms
from jaxsky.io import InputError, write_maps, write_text
from jaxsky.io.files import alone, check_guards
from jaxsky.io.tables import open_fits
from jaxsky.noise import realisation_key
from jaxsky.settings import Experiment, changed_settings, check_log, circumstances
from jaxsky.simulation import HarmonicSource, harmonic_sources, observe_bands, plan_terms

LOG = "simulation.json"
#: Settings that do not affect the maps.
LAYOUT: Any = {"simulate": {"sheet"}}
#: Settings that affect only the realisation or the output.
SAME_SKY = {"seed", *(f"simulate.{k}" for k in ("stokes", "unit", "components", "precision"))}
#: Settings and tables of settings that simulations depend on.
CONTENT = {"seed", "sky", "bands", "cmb", "fixed", "truth", "simulate"}


def paths(out: Path, names: tuple[str, ...], index: int) -> dict[str, Path]:
    """Return the file of each band of a realisation."""
    return {name: out / f"sim_{index:05d}" / f"{name}.fits" for name in names}


def _content(settings: Experiment) -> dict[str, Any]:
    return settings.model_dump(mode="json", exclude_none=True, include=CONTENT, exclude=LAYOUT)


def check_folder(
    out: Path,
    settings: Experiment,
    resume: bool,
    overwrite: bool,
    indices: range | None = None,
) -> None:
    """Raise ValueError unless realisations with these settings may be written to a folder.

    Other realisations with the same settings may exist: this is how a Monte Carlo is split over
    processes. `indices` are the numbers of the realisations, by default all.
    """
    log = out / LOG
    if overwrite:
        return
    if log.exists():
        if not resume and any(_maps(out, indices)):
            raise ValueError(
                f"{out}: holds a simulation already; go on with --resume, replace it with "
                "--overwrite, or choose another --out."
            )
        check_log(log, _content(settings), "a simulation")
    elif any(_maps(out)):
        raise ValueError(
            f"{out}: holds maps of unknown settings, for {LOG} is missing; choose another --out, "
            "or start again with --overwrite."
        )


def other_sky(settings: Experiment) -> list[str]:
    """Return a warning if maps were simulated with different settings, else an empty list.

    Without the log next to the folder of the maps no difference is known.
    """
    if (maps := settings.common.maps) is None:
        return []
    now = _content(settings)
    try:
        was = json.loads((Path(settings.data_dir, maps).parent / LOG).read_text())["settings"]
        keys = [key for key in changed_settings(was, now) if key not in SAME_SKY]
        changed = dict.fromkeys(key.split(".")[0] for key in keys)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []
    said = (
        f"The maps in {maps} were simulated with other settings in the tables "
        f"{', '.join(changed)}; bandpass, beam and noise are those of their files."
    )
    return [said] if changed else []


def _maps(out: Path, indices: range | None = None) -> Iterator[Path]:
    """Yield the map files of some realisations, by default all."""
    for path in out.glob("sim_*/*.fits"):
        number = path.parent.name.removeprefix("sim_")
        if indices is None or (number.isdecimal() and int(number) in indices):
            yield path


def _claim(out: Path, settings: Experiment, overwrite: bool) -> None:
    """Create the folder and write the log of its settings, unless it exists."""
    check_guards()
    out.mkdir(parents=True, exist_ok=True)
    with alone(out):
        if overwrite:
            for path in (*_maps(out), *out.glob("sim_*.png"), *out.glob("log*.txt")):
                path.unlink()
        elif (out / LOG).exists():
            # Another process may have written it since the folder was checked.
            check_folder(out, settings, resume=True, overwrite=False)
            return
        content = circumstances(settings) | {"settings": _content(settings)}
        write_text(out / LOG, json.dumps(content, indent=2) + "\n")


def _header(settings: Experiment, setup: SimulationInputs, name: str, index: int) -> dict[str, Any]:
    channel = setup.observation.channels[name]
    nu = np.asarray(channel.band.nu)
    header: dict[str, Any] = {
        "CREATOR": (f"jaxsky {jaxsky.__version__}", "software"),
        "INSTRUME": _ascii(settings.title) or "own bands",  # long words leave no room for a comment
        "BAND": (name, "name of the band"),
        "FREQ": (float(channel.band.center), "[GHz] mean frequency of the band"),
        "FREQMIN": (float(nu.min()), "[GHz] lower end of the band"),
        "FREQMAX": (float(nu.max()), "[GHz] upper end of the band"),
        "LMAX": (setup.observation.lmax, "largest multipole of the sky"),
        "SEED": (settings.seed, "seed of all realisations"),
        "SIM": (index, "number of the realisation"),
        "CONTENT": ", ".join(settings.included()),
    }
    if not np.ndim(channel.map_beam):
        header["FWHM"] = (float(channel.map_beam), "[arcmin] beam of the maps")
    else:
        header["BEAM"] = ("table", "beam, in the table BEAM")
    noise = channel.noise
    if noise is not None and not np.ndim(noise):
        header["NOISE"] = (float(noise), "[uK_RJ arcmin] noise before smoothing")
    to_CMB = float(channel.band.conversion("uK_RJ", "uK_CMB"))
    header["RJ2CMB"] = (to_CMB, "uK_CMB per uK_RJ in this band")
    header["COMMENT"] = _ascii(setup.description)
    return header


def _ascii(text: str) -> str:
    """Convert text to one line of ASCII, as FITS headers require."""
    return " ".join(text.split()).encode("ascii", "replace").decode()


def _columns(
    settings: Experiment, setup: SimulationInputs, name: str, maps: Mapping[str, Array]
) -> tuple[list[str], Float[np.ndarray, "column pix"]]:
    """Return names and values of the columns of a band's file, the total first."""
    spec, total = settings.simulate, maps["total"]
    if (leaked := setup.leakage.get(name)) is not None:
        total = total.at[-2:].add(leaked.astype(total.dtype))
    shown = {"": total} | {f"_{which}": m for which, m in maps.items() if which != "total"}
    names = [s + which for which in shown for s in spec.stokes]
    factor = float(setup.observation.channels[name].band.conversion("uK_RJ", spec.unit))
    if len(shown) == 1 and factor == 1:
        return names, np.asarray(total)
    columns = np.concatenate([np.asarray(one) for one in shown.values()])
    columns *= factor
    return names, columns


def _write(path: Path, columns: Float[np.ndarray, "column pix"], **options: Any) -> None:
    check_guards()
    log = path.parents[1] / LOG
    if not log.exists():
        raise FileNotFoundError(
            f"{log}: was removed while the simulation ran; start again with --overwrite."
        )
    path.parent.mkdir(exist_ok=True)
    write_maps(path, columns, overwrite=True, **options)


def run(
    settings: Experiment,
    setup: SimulationInputs,
    out: Path,
    indices: range,
    overwrite: bool = False,
    note: Callable[[str], None] = lambda message: None,
    begun: Callable[[], None] = lambda: None,
) -> Iterator[bool]:
    """Simulate realisations into files, one per band; existing files are kept.

    Yields for each file whether it was written. A realisation depends only on the seed and its
    number. The folder is first changed when the first map is ready, so an earlier failure leaves it
    untouched. Sources are removed from `setup` once used, if no other realisation needs them.
    `note` is called with sentences for the user, `begun` once the folder has its log and the old
    files have been removed (`overwrite`).
    """
    observation = setup.observation
    terms: Mapping[str, Terms | None] | None = None
    prepared: Mapping[str, HarmonicSource] | None = None
    # Templates without small scales, or with the same for all realisations, are prepared once.
    random = setup.small_scales_seed is None and any(
        source.small_scales is not None for source in setup.sources.values()
    )
    correlated = [name for name, source in setup.sources.items() if source.correlated_with]
    claimed, writing = False, list[Future[None]]()
    with ThreadPoolExecutor(1) as thread:
        for index in indices:
            files = paths(out, observation.names, index)
            stale = overwrite and not claimed
            missing = [name for name, path in files.items() if stale or not path.exists()]
            yield from [False] * (len(files) - len(missing))
            if not missing:
                continue
            key = realisation_key(settings.seed, index)
            if prepared is None or random:
                terms = plan_terms(setup.sources, observation) if terms is None else terms
                scales = setup.small_scales_key(key)
                prepared = harmonic_sources(
                    scales, setup.sources, observation, terms, release=not random
                )
                for name in correlated:
                    if repaired := int(prepared[name].repaired):
                        note(
                            f"{name}: its extrapolated cross-spectra exceed what the auto-spectra "
                            f"allow at {repaired} multipoles; correlations were reduced there."
                        )
            apart = settings.simulate.components
            seen = observe_bands(
                key, prepared, observation, setup.cmb, components=apart, names=missing
            )
            for name, maps in seen:
                names, columns = _columns(settings, setup, name, maps)
                if not claimed:
                    _claim(out, settings, overwrite)
                    begun()
                    claimed = True
                # Write this file while the next band is being made.
                while writing:
                    writing.pop().result()
                    yield True
                job = thread.submit(
                    _write,
                    files[name],
                    columns,
                    names=names,
                    unit=settings.simulate.unit,
                    extra_header=_header(settings, setup, name, index),
                    single=settings.simulate.precision == "single",
                    tables=observed_tables(observed_band(setup, name)),
                )
                writing.append(job)
                del maps, columns  # or they would stay in memory while the next band is made
            while writing:
                writing.pop().result()
                yield True


#: Marks the tables written by this module.
CREATOR = "jaxsky"
#: Numeric columns of each table.
TABLES = {
    "BANDPASS": ("NU", "WEIGHT"),
    "BEAM": ("BEAM",),
    "NOISE_SPECTRUM": ("N_L",),
    "NOISE": ("QQ", "QU", "UU"),
    "LEAKAGE": ("Q", "U"),
    "TRUTH": ("VALUE",),
}


class Observed(NamedTuple):
    """How a map was observed.

    `beam` is the FWHM of a Gaussian [arcmin], or a table b_l. `noise` is a level [uK_RJ arcmin]
    or the covariance of Q and U in each pixel [uK_RJ^2]. If it was smoothed with the map, `noise`
    is None and `spectrum` is N_l [uK_RJ^2], where known. `leakage` is Q and U leaked from the
    intensity [uK_RJ], with the beam of the map; `truth` has spectral parameters by dotted name.
    """

    bandpass: Bandpass
    beam: float | Float[Array, " ell"]
    noise: float | Float[Array | np.ndarray, "2 2 pix"] | None = None
    spectrum: Float[np.ndarray, " ell"] | None = None
    leakage: Float[np.ndarray, "2 pix"] | None = None
    truth: Mapping[str, float] = {}


def observed_band(setup: SimulationInputs, name: str) -> Observed:
    """Return how the maps of a band are observed."""
    channel = setup.observation.channels[name]
    beam = channel.map_beam
    noise, spectrum = channel.noise, None
    if noise is not None and channel.target is not None:
        if not jnp.ndim(noise):
            lmax = setup.observation.lmax
            window = np.asarray(beam_ratio(beam, channel.beam, lmax, f"band {name!r}"))
            spectrum = (float(noise) * np.radians(1 / 60) * window) ** 2
            spectrum[:2] = 0.0
        noise = None
    return Observed(
        channel.band,
        jnp.asarray(beam) if jnp.ndim(beam) else float(beam),
        noise if noise is None or jnp.ndim(noise) else float(noise),
        spectrum,
        None if name not in setup.leakage else np.asarray(setup.leakage[name]),
        setup.truth,
    )


def observed_tables(observed: Observed) -> list[pyfits.BinTableHDU]:
    """Return the tables of a FITS file that `read_observed` reads back exactly."""
    band = observed.bandpass
    rows: dict[str, list[Any]] = {"BANDPASS": [band.nu, band.weights]}
    if np.ndim(observed.beam):
        rows["BEAM"] = [observed.beam]
    if observed.spectrum is not None:
        rows["NOISE_SPECTRUM"] = [observed.spectrum]
    if not (observed.noise is None or isinstance(observed.noise, float)):
        (QQ, QU), (_, UU) = np.asarray(observed.noise)[-2:, -2:]
        rows["NOISE"] = [QQ, QU, UU]
    if observed.leakage is not None:
        rows["LEAKAGE"] = list(observed.leakage)
    if observed.truth:
        rows["TRUTH"] = [list(observed.truth.values())]
    tables = []
    for name, values in rows.items():
        named = zip(TABLES[name], map(np.asarray, values), strict=True)
        columns = [pyfits.Column(n, "D", array=array) for n, array in named]
        if name == "TRUTH":
            length = max(map(len, observed.truth))
            columns.insert(0, pyfits.Column("NAME", f"{length}A", array=list(observed.truth)))
        tables.append(pyfits.BinTableHDU.from_columns(columns, name=name))
    header = tables[0].header
    header["CREATOR"] = CREATOR
    header["CONVENT"] = (band.convention, "convention of the weights")
    if not np.ndim(observed.beam):
        header["FWHM"] = (float(observed.beam), "[arcmin] beam of the map")
    if isinstance(observed.noise, float):
        header["NOISE"] = (observed.noise, "[uK_RJ arcmin] uniform noise")
    return tables


def read_observed(path: Path) -> Observed | None:
    """Read how the map in a file was observed; None if it has no `observed_tables`."""
    with open_fits(path) as hdus:
        tables = {hdu.name: hdu for hdu in hdus[1:]}
        if "BANDPASS" not in tables or tables["BANDPASS"].header.get("CREATOR") != CREATOR:
            return None
        header, npix = tables["BANDPASS"].header, hdus[1].header["NAXIS2"]
        found: dict[str, np.ndarray] = {}
        for table, names in TABLES.items():
            if table not in tables:
                continue
            values = found[table] = np.array([tables[table].data[n] for n in names], float)
            if not np.isfinite(values).all():
                raise InputError(f"{path}: its table {table} has values that are not finite.")
            if table in ("NOISE", "LEAKAGE") and values.shape[1] != npix:
                raise InputError(
                    f"{path}: its table {table} has {values.shape[1]} pixels, its map {npix}."
                )
        stated = {key: float(header[key]) for key in ("FWHM", "NOISE") if key in header}
        for key, value in stated.items():
            if not 0 <= value < np.inf:
                raise InputError(f"{path}: {key} of its table BANDPASS is {value}.")
        if "FWHM" not in stated and "BEAM" not in found:
            raise InputError(f"{path}: the table of its beam is missing.")
        truth: dict[str, float] = {}
        if "TRUTH" in tables:
            parameters = map(str, tables["TRUTH"].data["NAME"])
            truth = dict(zip(parameters, found["TRUTH"][0].tolist(), strict=True))
        nu, weights = found["BANDPASS"]
        spectrum, noise = found.get("NOISE_SPECTRUM"), found.get("NOISE")
        return Observed(
            Bandpass(nu, weights, header["CONVENT"]),
            stated["FWHM"] if "FWHM" in stated else jnp.asarray(found["BEAM"][0]),
            stated.get("NOISE") if noise is None else np.array([noise[:2], noise[1:]]),
            None if spectrum is None else spectrum[0],
            found.get("LEAKAGE"),
            truth,
        )
