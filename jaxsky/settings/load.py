"""Settings from TOML files and the command line, with a sentence for each mistake."""

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jaxsky.settings.experiment import Experiment
from jaxsky.settings.files import SettingsError, expand
from jaxsky.settings.values import mistakes


def _assigned(assignment: str) -> tuple[list[str], Any]:
    """The key and the value of `key=value`, where the value is TOML, or text as it is."""
    key, equals, value = assignment.partition("=")
    text = f"{key} = {json.dumps(value.strip(), ensure_ascii=False)}"
    for line in (assignment, text) if equals else ():
        try:
            found, place = tomllib.loads(line), tomllib.loads(f"{key} = 0")
        except (tomllib.TOMLDecodeError, RecursionError):
            continue
        path: list[str] = []
        while isinstance(place, dict) and len(found) == 1:
            ((name, place),) = place.items()
            path, found = [*path, name], found[name]
            if place == 0:
                return path, found
    raise SettingsError(
        f"--set {assignment}: must be KEY=VALUE, as in a settings file, with the table's name "
        f"before the key{'' if equals else '; there is no ='}."
    )


def _replaced(raw: Any, path: Sequence[str], value: Any) -> Any:
    """Tables with one key replaced; a number is the place in a list."""
    if not path:
        return value
    key, *rest = path
    if isinstance(raw, list):
        if not key.isdecimal() or int(key) >= len(raw):
            there = f"the {len(raw)} entries, 0 to {len(raw) - 1}" if raw else "the entries of []"
            raise ValueError(f"{key}: is not among {there}")
        return [_replaced(one, rest, value) if i == int(key) else one for i, one in enumerate(raw)]
    known = raw if isinstance(raw, dict) else {}
    return {**known, key: _replaced(known.get(key), rest, value)}


def load(path: Path, assignments: Sequence[str] = ()) -> Experiment:
    """An experiment from a TOML file.

    Parameters
    ----------
    path : the file; relative paths in it are relative to its `data_dir`, and that to its folder
    assignments : `key=value` with a dotted key, such as "common.nside=32", "bands.0.fwhm=30" or
        "free.'dust.beta_dust'.start=1.5", in place of what the file says; a table is replaced whole

    Returns
    -------
    The settings, with `data_dir` as an absolute path.
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
        path_of_key, value = _assigned(assignment)
        try:
            raw = _replaced(raw, path_of_key, value)
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
