"""Realisations of a simulation as files: in any order, in any number of processes, resumed."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

import jaxsky
from jaxsky.experiment import SimulationInputs
from jaxsky.io import write_maps, write_text
from jaxsky.io.files import check_guards
from jaxsky.io.folders import alone
from jaxsky.io.observations import observed_tables
from jaxsky.keys import realisation_key
from jaxsky.observation import harmonic_sources, plan_terms
from jaxsky.settings import Experiment, circumstances
from jaxsky.simulation import observe_bands

LOG = "simulation.json"
#: Settings that do not change what a realisation is.
LAYOUT: Any = {"simulate": {"sheet"}}
#: Tables of settings that simulations depend on.
CONTENT = {"seed", "sky", "bands", "cmb", "fixed", "truth", "simulate"}


class Written(NamedTuple):
    """A file of a realisation, and the seconds since the one before it; None if it was there."""

    path: Path
    seconds: float | None


def paths(out: Path, names: tuple[str, ...], index: int) -> dict[str, Path]:
    """The file of each band of a realisation."""
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
    """Whether realisations with these settings may be written to a folder.

    Others of the same settings may be there: a Monte Carlo is split over processes so. Indices are
    the numbers of the realisations, by default all.
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
        try:
            there = json.loads(log.read_text())["settings"]
        except (ValueError, KeyError, TypeError):
            raise ValueError(f"{log}: is damaged; start again with --overwrite.") from None
        if there != _content(settings):
            raise ValueError(
                f"{out}: holds a simulation with other settings; choose another --out, or start "
                "again with --overwrite."
            )
    elif any(_maps(out)):
        raise ValueError(
            f"{out}: holds maps of unknown settings, for {LOG} is missing; choose another --out, "
            "or start again with --overwrite."
        )


def other_sky(settings: Experiment) -> list[str]:
    """A warning about maps that were simulated with other settings than these.

    Without the log next to the folder of the maps nothing is known to be different.
    """
    if (maps := settings.common.maps) is None:
        return []
    now = _content(settings)
    try:
        was = json.loads((Path(settings.data_dir, maps).parent / LOG).read_text())["settings"]
        for key in ("stokes", "unit", "outputs", "precision"):  # of what is written only
            was["simulate"].pop(key, None)
            now["simulate"].pop(key, None)
        changed = [name for name in now if name != "seed" and was.get(name) != now[name]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []
    said = (
        f"The maps in {maps} were simulated with other settings in the tables "
        f"{', '.join(changed)}; bandpass, beam and noise are those of their files."
    )
    return [said] if changed else []


def _maps(out: Path, indices: range | None = None) -> Iterator[Path]:
    """The maps of some realisations, by default all."""
    for path in out.glob("sim_*/*.fits"):
        number = path.parent.name.removeprefix("sim_")
        if indices is None or (number.isdecimal() and int(number) in indices):
            yield path


def _claim(out: Path, settings: Experiment, overwrite: bool) -> None:
    """Make the folder and leave a log of what is in it, unless that is there."""
    check_guards()
    out.mkdir(parents=True, exist_ok=True)
    with alone(out):
        if overwrite:
            for path in (*_maps(out), *out.glob("sim_*.png"), *out.glob("log*.txt")):
                path.unlink()
        elif (out / LOG).exists():
            # Another process may have left it since the folder was checked.
            check_folder(out, settings, resume=True, overwrite=False)
            return
        content = circumstances(settings) | {"settings": _content(settings)}
        write_text(out / LOG, json.dumps(content, indent=2) + "\n")


def _header(settings: Experiment, setup: SimulationInputs, name: str, index: int) -> dict[str, Any]:
    channel = setup.observation.channels[name]
    nu = np.asarray(channel.band.nu)
    header: dict[str, Any] = {
        "CREATOR": (f"jaxsky {jaxsky.__version__}", "software"),
        "INSTRUME": (_ascii(settings.title) or "own bands", "experiment"),
        "BAND": (name, "name of the band"),
        "FREQ": (float(channel.band.center), "[GHz] mean frequency of the band"),
        "FREQMIN": (float(nu.min()), "[GHz] lower end of the band"),
        "FREQMAX": (float(nu.max()), "[GHz] upper end of the band"),
        "LMAX": (setup.observation.lmax, "largest multipole of the sky"),
        "SEED": (settings.seed, "seed of all realisations"),
        "SIM": (index, "number of the realisation"),
        "CONTENT": (", ".join(settings.included()), "what the total is made of"),
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
    """Text as FITS headers take it: one line of ASCII."""
    return " ".join(text.split()).encode("ascii", "replace").decode()


def _columns(
    maps: Mapping[str, Array], stokes: str, factor: float
) -> tuple[list[str], Float[np.ndarray, "column pix"]]:
    """Names of the columns of a file, and the columns: the total first."""
    wanted = ["total", *(n for n in maps if n != "total")]
    names = [s if name == "total" else f"{s}_{name}" for name in wanted for s in stokes]
    if len(wanted) == 1 and factor == 1:
        return names, np.asarray(maps["total"])
    columns = np.concatenate([np.asarray(maps[name]) for name in wanted])
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


def _write_behind(jobs: Iterator[tuple[Path, Callable[[], None]]]) -> Iterator[Written]:
    """Do each job while the next one is being made; the files, as they are done."""
    start = time.perf_counter()
    doing: list[tuple[Path, Future[None]]] = []

    def done() -> Written:
        nonlocal start
        path, future = doing.pop(0)
        future.result()
        start, before = time.perf_counter(), start
        return Written(path, start - before)

    with ThreadPoolExecutor(1) as thread:
        for path, job in jobs:
            doing.append((path, thread.submit(job)))
            del job  # and its maps with it, when it is done
            if len(doing) > 1:
                yield done()
        if doing:
            yield done()


def _jobs(
    settings: Experiment,
    setup: SimulationInputs,
    seen: Iterator[tuple[str, dict[str, Array]]],
    files: Mapping[str, Path],
    index: int,
    claim: Callable[[], None],
) -> Iterator[tuple[Path, Callable[[], None]]]:
    """Each file of a realisation, and what writes it; `claim` is called when a map is ready."""
    spec = settings.simulate
    for name, maps in seen:
        band = setup.observation.channels[name].band
        if (leaked := setup.leakage.get(name)) is not None:
            maps = {**maps, "total": maps["total"].at[-2:].add(leaked)}
        factor = float(band.conversion("uK_RJ", spec.unit))
        names, columns = _columns(maps, spec.stokes, factor)
        claim()
        job = partial(
            _write,
            files[name],
            columns,
            names=names,
            unit=spec.unit,
            extra_header=_header(settings, setup, name, index),
            single=spec.precision == "single",
            tables=observed_tables(setup.observed(name)),
        )
        del maps, columns  # or they would still be there when those of the next band are made
        yield files[name], job
        del job


def run(
    settings: Experiment,
    setup: SimulationInputs,
    out: Path,
    indices: range,
    overwrite: bool = False,
    note: Callable[[str], None] = lambda message: None,
    begun: Callable[[], None] = lambda: None,
) -> Iterator[Written]:
    """Simulate realisations into files, one for each band; files that are there are kept.

    A realisation depends on the seed and its number only. The folder is touched when the first
    map is ready: what goes wrong before costs nothing. Sources are removed from `setup` when they
    have served. `note` is called with sentences that a user should know, `begun` when the folder
    has its log, and what was to be removed from it (`overwrite`) is.
    """
    observation = setup.observation
    terms = prepared = None
    # Templates without random small scales, or with the same for all, are prepared once.
    random = setup.small_scales_seed is None and any(
        source.small_scales is not None for source in setup.sources.values()
    )
    claimed = False

    def claim() -> None:
        nonlocal claimed
        if not claimed:
            _claim(out, settings, overwrite)
            begun()
            claimed = True

    for index in indices:
        files = paths(out, observation.names, index)
        stale = overwrite and not claimed
        missing = [name for name, path in files.items() if stale or not path.exists()]
        yield from (Written(files[n], None) for n in files if n not in missing)
        if not missing:
            continue
        key = realisation_key(settings.seed, index)
        if prepared is None or random:
            terms = plan_terms(setup.sources, observation) if terms is None else terms
            small = key if random else setup.small_scales_key(key)
            correlated = [n for n, source in setup.sources.items() if source.correlated_with]
            prepared = harmonic_sources(
                small, setup.sources, observation, terms, release=not random
            )
            for name in correlated:
                if repaired := int(prepared[name].repaired):
                    note(
                        f"{name}: its extrapolated cross-spectra exceed what the auto-spectra "
                        f"allow at {repaired} multipoles; correlations were reduced there."
                    )
        apart = "components" in settings.simulate.outputs
        seen = observe_bands(key, prepared, observation, setup.cmb, components=apart, names=missing)
        yield from _write_behind(_jobs(settings, setup, seen, files, index, claim))
