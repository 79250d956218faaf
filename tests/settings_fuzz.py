"""Mutations of settings: each key of each format with values that it cannot have."""

import json
import tomllib
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import fits.forecast.settings
import fits.paper.settings
import fits.separate.settings
import fits.settings

import fits.forecast.setup
import fits.inputs
import fits.regions
import fits.resolution
import fits.separate.setup
from jaxsky import experiment
from jaxsky.io import InputError
from jaxsky.settings import SettingsError
from jaxsky.settings.keys import at_key, of_file

VALUES = (-1, 0, 1.5, 1e30, -1e300, 2**40, True, "", "unknown", "[/] $x_$", [], [1], [-1, "a"], {},
          {"unknown": 1})  # fmt: skip


class Kind(NamedTuple):
    """A format of settings: the base of its mutations, what loads and what builds it."""

    base: Path
    load: Callable[[Path], Any]
    build: Callable[[Any], Any]


def _fit(settings) -> None:
    fits.regions.region_masks(settings)
    inputs = fits.inputs.inputs_of(settings)
    with at_key("analysis"):
        fits.resolution.prepare(inputs, settings.analysis.nside, settings.analysis.fwhm)


KINDS = {
    "experiment": Kind(experiment.DEFAULT, experiment.load_experiment, experiment.build),
    "fit": Kind(fits.settings.EMBEDDED, fits.settings.load_settings, _fit),
    "compare": Kind(fits.settings.EMBEDDED_COMPARISON, fits.settings.load_settings, _fit),
    "separate": Kind(
        fits.separate.settings.EMBEDDED,
        fits.separate.settings.load_separate,
        fits.separate.setup.build,
    ),
    "forecast": Kind(
        fits.forecast.settings.DEFAULT,
        fits.forecast.settings.load_forecast,
        fits.forecast.setup.build,
    ),
    "paper": Kind(fits.paper.settings.EMBEDDED, fits.paper.settings.load_paper, _fit),
}


def small(kind: str) -> dict[str, Any]:
    """The embedded settings of a format at a low resolution."""
    raw = tomllib.loads(KINDS[kind].base.read_text())
    for table in raw.values():
        if isinstance(table, dict):
            table |= {"nside": 8} if "nside" in table else {}
            table |= {"fwhm": 1200.0} if "fwhm" in table else {}
    if kind == "forecast":
        raw["spectra"]["lmax"] = 15
    if kind == "separate":
        raw["separation"]["nsims"] = 20
    return raw


def paths(table: Any, at: tuple = ()) -> Iterator[tuple]:
    """Where values are, tables and entries of lists among them."""
    if at:
        yield at
    if isinstance(table, dict | list):
        for key in table if isinstance(table, dict) else range(len(table)):
            yield from paths(table[key], (*at, key))


def changed(raw: dict[str, Any], at: tuple, value: Any) -> dict[str, Any]:
    """Settings with another value at a place."""
    raw = deepcopy(raw)
    table: Any = raw
    for key in at[:-1]:
        table = table[key]
    table[at[-1]] = value
    return raw


def toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def fault(kind: str, raw: dict[str, Any], at: tuple, path: Path, build: bool = True) -> str | None:
    """What is wrong with the answer to settings; None if they work or are refused well."""
    path.write_text("".join(f"{json.dumps(key)} = {toml(v)}\n" for key, v in raw.items()))
    known = [str(key) for key in at if not isinstance(key, int)]
    known += [f"{other[0]}.{other[1]}" for other in paths(raw) if len(other) > 1]
    try:
        with of_file(path):
            settings = KINDS[kind].load(path)
            if build:
                KINDS[kind].build(settings)
    except (SettingsError, InputError) as error:
        said = str(error)
        if "\n" in said or not said.startswith(str(path)):
            return f"does not name the file: {said}"
        if not any(key in said for key in known):
            return f"does not name the key: {said}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def faults(kind: str, path: Path, every: int = 1, build: bool = True) -> list[str]:
    """What is wrong with the answers to one of so many mutations of a format's settings."""
    raw = small(kind)
    mutations = [(at, value) for at in paths(raw) for value in VALUES]
    found = []
    for at, value in mutations[::every]:
        if what := fault(kind, changed(raw, at, value), at, path, build):
            found.append(f"{kind}: {'.'.join(map(str, at))} = {toml(value)}: {what}")
    return found
