"""Realisations of a simulation as files: in any order, in any number of processes, resumed."""

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float

import jaxsky
from jaxsky.experiment import SimulationInputs
from jaxsky.interpolation import Terms
from jaxsky.io import write_maps, write_text
from jaxsky.io.files import check_guards
from jaxsky.io.folders import alone
from jaxsky.io.observations import observed_tables
from jaxsky.keys import realisation_key
from jaxsky.observation import HarmonicSource, harmonic_sources, plan_terms
from jaxsky.settings import Experiment, circumstances
from jaxsky.simulation import observe_bands

LOG = "simulation.json"
#: Settings that do not change what a realisation is.
LAYOUT: Any = {"simulate": {"sheet"}}
#: Tables of settings that simulations depend on.
CONTENT = {"seed", "sky", "bands", "cmb", "fixed", "truth", "simulate"}


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
        for key in ("stokes", "unit", "components", "precision"):  # of what is written only
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
    settings: Experiment, setup: SimulationInputs, name: str, maps: Mapping[str, Array]
) -> tuple[list[str], Float[np.ndarray, "column pix"]]:
    """Names of the columns of a band's file, and the columns: the total first."""
    spec, total = settings.simulate, maps["total"]
    if (leaked := setup.leakage.get(name)) is not None:
        total = total.at[-2:].add(leaked)
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
    """Simulate realisations into files, one for each band; files that are there are kept.

    For each file, in turn, whether it was written. A realisation depends on the seed and its number
    only. The folder is touched when the first map is ready: what goes wrong before costs nothing.
    Sources are removed from `setup` when they have served. `note` is called with sentences that a
    user should know, `begun` when the folder has its log, and what was to be removed from it
    (`overwrite`) is.
    """
    observation = setup.observation
    terms = prepared = None
    # Templates without random small scales, or with the same for all, are prepared once.
    random = setup.small_scales_seed is None and any(
        source.small_scales is not None for source in setup.sources.values()
    )
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
                prepared = _prepared(setup, setup.small_scales_key(key), terms, not random, note)
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
                # A file is written while the next band is made.
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
                    tables=observed_tables(setup.observed(name)),
                )
                writing.append(job)
                del maps, columns  # or they would be there when those of the next band are made
            while writing:
                writing.pop().result()
                yield True


def _prepared(
    setup: SimulationInputs,
    key: Array,
    terms: Mapping[str, Terms | None],
    release: bool,
    note: Callable[[str], None],
) -> dict[str, HarmonicSource]:
    """The sources in harmonic space, with the small scales of a key."""
    correlated = [n for n, source in setup.sources.items() if source.correlated_with]
    prepared = harmonic_sources(key, setup.sources, setup.observation, terms, release=release)
    for name in correlated:
        if repaired := int(prepared[name].repaired):
            note(
                f"{name}: its extrapolated cross-spectra exceed what the auto-spectra allow at "
                f"{repaired} multipoles; correlations were reduced there."
            )
    return prepared
