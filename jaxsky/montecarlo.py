"""Simulate realisations into files, in any order and number of processes; runs can be resumed."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array

import jaxsky
from jaxsky.experiment import SimulationInputs
from jaxsky.interpolation import Terms
from jaxsky.io import write_maps, write_text
from jaxsky.io.files import alone, check_guards
from jaxsky.noise import realisation_key
from jaxsky.observed import observed_band, observed_tables
from jaxsky.settings import Experiment, changed_settings, check_log, circumstances
from jaxsky.simulation import HarmonicSource, harmonic_sources, observe_bands, plan_terms
from jaxsky.workers import realised

#: Settings of the realisations in a folder, and the pattern of their maps.
LOG, MAPS = "simulation.json", "sim_*/*.fits"
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
    out: Path, settings: Experiment, resume: bool, overwrite: bool, indices: range
) -> None:
    """Raise ValueError unless realisations may be written to a folder."""
    # Others with the same settings may exist: this is how a Monte Carlo is split over processes.
    log = out / LOG
    if overwrite:
        return
    if log.exists():
        if not resume and any(any(out.glob(f"sim_{index:05d}/*.fits")) for index in indices):
            raise ValueError(
                f"{out}: holds a simulation already; go on with --resume, replace it with "
                "--overwrite, or choose another --out."
            )
        check_log(log, _content(settings), "a simulation")
    elif any(out.glob(MAPS)):
        raise ValueError(
            f"{out}: holds maps of unknown settings, for {LOG} is missing; choose another --out, "
            "or start again with --overwrite."
        )


def other_sky(settings: Experiment) -> list[str]:
    """Return a warning if maps were simulated with other settings by the log next to them."""
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


def _claim(out: Path, settings: Experiment, overwrite: bool) -> None:
    """Create the folder and write the log of its settings, unless it exists."""
    check_guards()
    out.mkdir(parents=True, exist_ok=True)
    with alone(out):
        if overwrite:
            for path in (*out.glob(MAPS), *out.glob("sim_*.png"), *out.glob("log*.txt")):
                path.unlink()
        elif (out / LOG).exists():
            # Another process may have written it since the folder was checked.
            check_log(out / LOG, _content(settings), "a simulation")
            return
        content = circumstances(settings) | {"settings": _content(settings)}
        write_text(out / LOG, json.dumps(content, indent=2) + "\n")


def _header(settings: Experiment, setup: SimulationInputs, name: str, index: int) -> dict[str, Any]:
    channel = setup.observation.channels[name]
    nu, noise = np.asarray(channel.band.nu), channel.noise
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
    if np.ndim(channel.map_beam):
        header["BEAM"] = ("table", "beam, in the table BEAM")
    else:
        header["FWHM"] = (float(channel.map_beam), "[arcmin] beam of the maps")
    if noise is not None and not np.ndim(noise):
        header["NOISE"] = (float(noise), "[uK_RJ arcmin] noise before smoothing")
    to_CMB = float(channel.band.conversion("uK_RJ", "uK_CMB"))
    header["RJ2CMB"] = (to_CMB, "uK_CMB per uK_RJ in this band")
    return header | {"COMMENT": _ascii(setup.description)}


def _ascii(text: str) -> str:
    """Convert text to one line of ASCII, as FITS headers require."""
    return " ".join(text.split()).encode("ascii", "replace").decode()


def _columns(
    settings: Experiment, setup: SimulationInputs, name: str, maps: Mapping[str, Array]
) -> tuple[list[str], np.ndarray]:
    """Return names and values (column, pix) of a band's file, the total first."""
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


def _write(path: Path, columns: np.ndarray, **options: Any) -> None:
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
    executor: Executor | None = None,
) -> Iterator[bool]:
    """Simulate realisations into files, one per band; existing files are kept.

    Yields for each file whether it was written. The folder is first changed when the first map is
    ready (with an executor, see `jaxsky.workers.realised`, when the templates are), so an earlier
    failure leaves it untouched. Sources are removed from `setup` once used, if no other realisation
    needs them. `note` is called with sentences for the user, `begun` once the folder has its log
    and the old files have been removed (`overwrite`).
    """
    names = setup.observation.names
    make = _Maker(settings, setup, out if executor is None else out.absolute())

    @cache
    def claim() -> None:
        _claim(out, settings, overwrite)
        begun()

    if executor is None:
        yield from make.files(indices, note, claim, overwrite)
        return
    there = [all(path.exists() for path in paths(out, names, i).values()) for i in indices]
    missing = [i for i, kept in zip(indices, there, strict=True) if overwrite or not kept]
    yield from [False] * (len(names) * (len(indices) - len(missing)))
    if missing:
        make.prepare(note)
        claim()
        for written, notes in realised(make, missing, executor, out):
            for sentence in notes:
                note(sentence)
            yield from written


class _Maker:
    """Makes the files of realisations, in this process or a worker, of templates prepared once."""

    def __init__(self, settings: Experiment, setup: SimulationInputs, out: Path) -> None:
        self.settings, self.setup, self.out = settings, setup, out
        self._random = setup.small_scales_seed is None and any(
            source.small_scales is not None for source in setup.sources.values()
        )
        self._correlated = [name for name, one in setup.sources.items() if one.correlated_with]
        self._sources: Mapping[str, HarmonicSource] | None = None

    @cached_property
    def _terms(self) -> Mapping[str, Terms | None]:
        return plan_terms(self.setup.sources, self.setup.observation)

    def __call__(self, index: int) -> tuple[list[bool], list[str]]:
        """Return for each file of a realisation whether it was written, and notes."""
        notes = list[str]()
        return list(self.files([index], notes.append)), notes

    def prepare(self, note: Callable[[str], None]) -> None:
        """Make what all realisations share."""
        _ = self._terms
        if not self._random:
            self.sources(realisation_key(self.settings.seed), note)

    def sources(self, key: Array, note: Callable[[str], None]) -> Mapping[str, HarmonicSource]:
        """Return the sources of the realisation with this key in harmonic space."""
        setup = self.setup
        if self._sources is None or self._random:
            self._sources = None  # or there would be two of them in memory
            given = setup.small_scales_key(key), setup.sources, setup.observation, self._terms
            ready = harmonic_sources(*given, release=not self._random)
            for name in self._correlated:
                if repaired := int(ready[name].repaired):
                    note(
                        f"{name}: its extrapolated cross-spectra exceed what the auto-spectra "
                        f"allow at {repaired} multipoles; correlations were reduced there."
                    )
            self._sources = ready
        return self._sources

    def files(
        self,
        indices: Iterable[int],
        note: Callable[[str], None],
        claim: Callable[[], None] = lambda: None,
        overwrite: bool = False,
    ) -> Iterator[bool]:
        """Write the missing files, or all; `claim` is called when a map is ready."""
        settings, setup, observation = self.settings, self.setup, self.setup.observation
        writing = list[Future[None]]()
        with ThreadPoolExecutor(1) as thread:
            for index in indices:
                files = paths(self.out, observation.names, index)
                missing = [name for name, path in files.items() if overwrite or not path.exists()]
                yield from [False] * (len(files) - len(missing))
                if not missing:
                    continue
                key = realisation_key(settings.seed, index)
                seen = observe_bands(
                    key,
                    self.sources(key, note),
                    observation,
                    setup.cmb,
                    components=settings.simulate.components,
                    names=missing,
                )
                for name, maps in seen:
                    names, columns = _columns(settings, setup, name, maps)
                    claim()
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
