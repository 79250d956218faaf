"""Settings from TOML files and the command line, with a sentence for each mistake."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jaxsky.settings import SettingsError, expand
from jaxsky.settings.experiment import Experiment
from jaxsky.settings.values import mistakes

__all__ = ["load"]


def _assigned(assignment: str) -> dict[str, Any]:
    """The tables of `key=value`, where the value is TOML, or text as it is.

    Raises
    ------
    SettingsError
        If it is none.
    """
    key, equals, value = assignment.partition("=")
    for line in (assignment, f"{key} = {json.dumps(value.strip())}") if equals else ():
        try:
            return tomllib.loads(line)
        except (tomllib.TOMLDecodeError, RecursionError):
            continue
    raise SettingsError(
        f"--set {assignment}: must be KEY=VALUE, as in a settings file, with the table's name "
        f"before the key{'' if equals else '; there is no ='}."
    )


def _merge(raw: Any, changes: Mapping[str, Any]) -> Any:
    """Tables with changes in them; a number is the place in a list."""
    if isinstance(raw, list):
        merged = list(raw)
        for key, value in changes.items():
            if not key.isdecimal() or int(key) >= len(raw):
                raise ValueError(f"{key}: is not among the {len(raw)} entries, 0 to {len(raw) - 1}")
            known = raw[int(key)]
            merged[int(key)] = _merge(known, value) if isinstance(value, dict) else value
        return merged
    if not isinstance(raw, dict):
        return changes
    into = [k for k, v in changes.items() if isinstance(v, dict) and k in raw]
    return {**raw, **changes, **{k: _merge(raw[k], changes[k]) for k in into}}


def load(path: Path, assignments: Sequence[str] = ()) -> Experiment:
    """An experiment from a TOML file.

    Parameters
    ----------
    path : the file; relative paths in it are relative to its `data_dir`, and that to its folder
    assignments : `key=value` with a dotted key, such as "common.nside=32", "bands.0.fwhm=30" or
        "free.'dust.beta_dust'.start=1.5"; they are merged into the file's tables

    Returns
    -------
    The settings, with `data_dir` as an absolute path.

    Raises
    ------
    SettingsError
        If the file is absent, is not TOML, or has a mistake; the message names file and key.
    """
    try:
        raw = tomllib.loads(path.read_text())
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}).") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: is not valid TOML ({error}).") from None
    except RecursionError:
        raise SettingsError(f"{path}: is nested too deeply.") from None
    options: dict[str, str] = {}
    for assignment in assignments:
        changes = _assigned(assignment)
        try:
            raw = _merge(raw, changes)
        except ValueError as error:
            raise SettingsError(f"{path}: --set {assignment}: {error}.") from None
        options[assignment.partition("=")[0].strip()] = " (given with --set)"
    named = raw.get("data_dir", ".")
    try:
        name = expand(named) if isinstance(named, str) else "."
        folder = (path.absolute().parent / name).resolve()
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is not a folder")
        settings = Experiment.model_validate(raw, context={"folder": folder})
    except ValidationError as error:
        raise SettingsError(f"{path}: {mistakes(raw, error, options)}.") from None
    except (ValueError, OSError, RuntimeError) as error:  # RuntimeError: links in a circle
        raise SettingsError(f"{path}: data_dir: {error}.") from None
    return settings.model_copy(update={"data_dir": str(folder)})
