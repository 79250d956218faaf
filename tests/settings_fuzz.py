"""Mutations of settings: each key, for each command, with values that it cannot have."""

import json
import tomllib
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import fits.separated_data
from fits.commands.forecast import forecast_inputs
from fits.commands.run import DEFAULTS
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.regions import region_masks
from jaxsky import experiment
from jaxsky.io import InputError
from jaxsky.settings import Experiment, SettingsError, at_key, load, of_file

VALUES = (-1, 0, 1.5, 1e30, -1e300, 2**40, True, "", "unknown", "[/] $x_$", [], [1], [-1, "a"], {},
          {"unknown": 1})  # fmt: skip


class Kind(NamedTuple):
    """What a command starts from: the base of mutations, and what builds it."""

    base: Path
    build: Callable[[Experiment], Any]


def _prepared(settings: Experiment, regions: str) -> None:
    region_masks(settings, getattr(settings, regions).regions)
    inputs = inputs_of(settings)
    with at_key("common"):
        common_maps(inputs, settings.common.nside, settings.common.fwhm)


KINDS = {
    "experiment": Kind(DEFAULTS / "experiment.toml", experiment.simulation_inputs),
    "simulate": Kind(DEFAULTS / "simulate.toml", experiment.simulation_inputs),
    "fit": Kind(DEFAULTS / "fit.toml", partial(_prepared, regions="fit")),
    "compare": Kind(DEFAULTS / "compare.toml", partial(_prepared, regions="compare")),
    "separate": Kind(DEFAULTS / "separate.toml", fits.separated_data.separation_data),
    "forecast": Kind(DEFAULTS / "forecast.toml", forecast_inputs),
    "paper": Kind(DEFAULTS / "paper.toml", partial(_prepared, regions="compare")),
}


def small(kind: str) -> dict[str, Any]:
    """The settings of a command at a low resolution; those of "experiment" with all defaults."""
    raw = tomllib.loads(KINDS[kind].base.read_text())
    if kind == "experiment":
        bands = {"bands": raw["bands"]}
        raw = json.loads(load(KINDS[kind].base).model_dump_json(exclude_none=True)) | bands
    for table in (raw["sky"]["embedded"], *raw.values()):
        if isinstance(table, dict):
            table |= {"nside": 8} if "nside" in table else {}
            table |= {"fwhm": 1200.0} if "fwhm" in table else {}
    if "forecast" in raw:
        raw["forecast"] |= {"lmax": 15}
    return raw


def paths(table: Any, at: tuple = ()) -> Iterator[tuple]:
    """Where values are, tables and entries of lists among them."""
    if at:
        yield at
    if isinstance(table, dict | list):
        for key in table if isinstance(table, dict) else range(len(table)):
            yield from paths(table[key], (*at, key))


def changed(raw: dict[str, Any], at: tuple, value: Any) -> dict[str, Any]:
    """Settings with another value at a place, or none, in a table that need not be there."""
    raw = deepcopy(raw)
    table: Any = raw
    for key in at[:-1]:
        table = table.setdefault(key, {}) if isinstance(table, dict) else table[key]
    table[at[-1]] = value
    if value is None:
        del table[at[-1]]
    return raw


def changed_at(raw: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Settings with one entry changed, "/" between the parts of its key ("bands/0/noise")."""
    return changed(raw, tuple(int(k) if k.isdecimal() else k for k in key.split("/")), value)


def toml(value: Any) -> str:
    """A value as TOML has it, on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value).replace("Infinity", "inf").replace("NaN", "nan")


def written(path: Path, raw: dict[str, Any]) -> Path:
    """The path, to which settings are written."""
    path.write_text("".join(f"{json.dumps(key)} = {toml(v)}\n" for key, v in raw.items()))
    return path


def fault(kind: str, raw: dict[str, Any], at: tuple, path: Path, build: bool = True) -> str | None:
    """What is wrong with the answer to settings; None if they work or are refused well."""
    written(path, raw)
    known = [str(key) for key in at if not isinstance(key, int)]
    known += [f"{other[0]}.{other[1]}" for other in paths(raw) if len(other) > 1]
    try:
        with of_file(path):
            settings = load(path)
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
    """What is wrong with the answers to one of so many mutations of a command's settings."""
    raw = small(kind)
    mutations = [(at, value) for at in paths(raw) for value in VALUES]
    found = []
    for at, value in mutations[::every]:
        if what := fault(kind, changed(raw, at, value), at, path, build):
            found.append(f"{kind}: {'.'.join(map(str, at))} = {toml(value)}: {what}")
    return found
