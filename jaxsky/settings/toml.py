"""Read settings from TOML files and the command line, and find the files that they name."""

import json
import os
import platform
import re
import sys
import tomllib
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from pydantic import ValidationError

from jaxsky.io import InputError, MissingFileError, check_file
from jaxsky.io.files import cache_folder
from jaxsky.settings.experiment import Experiment
from jaxsky.settings.types import NamedFile, SettingsError, mistakes

PACKAGES = "jaxsky jax numpy healpy ducc0 jaxbind camb optimistix emcee blackjax getdist"


@contextmanager
def at_key(name: str) -> Iterator[None]:
    """Add the key of a setting to errors that its value causes in the numerical code."""
    try:
        yield
    except (InputError, SettingsError):
        raise
    except (ValueError, TypeError, KeyError, ArithmeticError) as error:
        message = str(error.args[0] if isinstance(error, KeyError) else error)
        if (unknown := re.search(r"unexpected keyword argument ('\w+')", message)) is not None:
            message = f"there is no parameter {unknown[1]}"
        raise SettingsError(f"{name}: {message.rstrip('.')}.") from error


@contextmanager
def of_file(path: Path) -> Iterator[None]:
    """Add the path of the settings file to errors about settings."""
    try:
        yield
    except SettingsError as error:
        if str(error).startswith(f"{path}: "):
            raise
        raise SettingsError(f"{path}: {error}") from error


def _assigned(assignment: str) -> tuple[list[str], Any]:
    """Split `key=value` into key and value; a value that is not TOML is plain text."""
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
    """Return the tables with the value at `path` replaced; a number in it is an index of a list."""
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
    """Read an experiment from a TOML file; its `data_dir` becomes an absolute path.

    Assignments `key=value` with a dotted key, such as "common.nside=32", "bands.0.fwhm=30" or
    "free.'dust.beta_dust'.start=1.5", override the file; a table is replaced as a whole.
    """
    try:
        raw = tomllib.loads(path.read_text())
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}).") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: is not valid TOML ({error}).") from None
    except RecursionError:
        raise SettingsError(f"{path}: is nested too deeply.") from None
    assigned: list[str] = []
    for assignment in assignments:
        keys, value = _assigned(assignment)
        try:
            raw = _replaced(raw, keys, value)
        except ValueError as error:
            raise SettingsError(f"{path}: --set {assignment}: {error}.") from None
        assigned.append(".".join(keys))
    named = raw.get("data_dir", ".")
    try:
        name = _expand(named) if isinstance(named, str) else "."
        folder = (path.absolute().parent / name).resolve()
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is not a folder")
        settings = Experiment.model_validate(raw, context={"folder": folder})
    except ValidationError as error:
        raise SettingsError(f"{path}: {mistakes(raw, error, assigned)}.") from None
    except (ValueError, OSError, RuntimeError) as error:  # RuntimeError: links in a circle
        raise SettingsError(f"{path}: data_dir: {error}.") from None
    return settings.model_copy(update={"data_dir": str(folder)})


def _expand(text: str) -> str:
    """Expand `~` and environment variables, $NAME or ${NAME:-default}, in a path."""

    def value(match: re.Match[str]) -> str:
        name, default = match["braced"] or match["plain"], match["default"]
        found = os.environ.get(name) or default
        if found is None:
            raise ValueError(f"the environment variable {name} is not set")
        return found

    pattern = r"\$(?:\{(?P<braced>\w+)(?::-(?P<default>[^}]*))?\}|(?P<plain>\w+))"
    return os.path.expanduser(re.sub(pattern, value, text))


def find_file(folder: Path, name: str) -> Path:
    """Find a file that settings name; `folder` is their `data_dir`.

    A name without a folder is looked for there, then in the cache of `jaxsky data fetch`; with one,
    it is relative to it. `~`, `$NAME` and `${NAME:-default}` are expanded, unless a file has that
    very name.
    """
    if not os.path.lexists(folder / name):
        try:
            name = _expand(name)
        except ValueError as error:
            raise InputError(f"{name}: {error}.") from None
    path, cache = folder / name, None
    if not os.path.dirname(name) and not os.path.lexists(path):
        cache = cache_folder()
        if os.path.lexists(cache / name):
            path = cache / name
    try:
        check_file(path)
    except MissingFileError:
        raise MissingFileError(f"{path}: {_missing(path, cache)}.") from None
    return path


def _missing(path: Path, cache: Path | None) -> str:
    """Say that a file is missing, and how to get it."""
    from jaxsky.products import catalogue, product_sets  # slow to import, and seldom needed

    said = "no such file" if path.parent.is_dir() else "no such file, nor folder"
    if cache is not None:
        said += f", and none in the cache {cache}"
    if path.name in catalogue():
        said += f"; fetch it with `jaxsky data fetch {path.name}`"
        if cache is None:
            said += f" into {cache_folder()}, and name it without a folder"
    if sets := [name for name, found in product_sets().items() if path.name in found.files]:
        said += f" (all files of such an analysis: `jaxsky data fetch {sets[0]}`)"
    return said


def named_files(settings: Experiment) -> list[str]:
    """Return every file name among the values of the settings."""
    values = jax.tree.leaves(settings.model_dump())
    return [str(value) for value in values if isinstance(value, NamedFile)]


def circumstances(settings: Experiment) -> dict[str, Any]:
    """Record date, command, machine, versions and existing input files (name -> path) of a run."""
    paths = {}
    for name in named_files(settings):
        with suppress(InputError):  # not needed, or a folder of maps
            paths[name] = str(find_file(Path(settings.data_dir), name))
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "python": platform.python_version(),
        "machine": platform.platform(),
        "versions": {name: version(name) for name in PACKAGES.split()},
        "files": paths,
    }


def changed_settings(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the keys, with their tables, that differ between two written experiments."""
    old, new = (
        {
            f"{table}.{key}".rstrip("."): value
            for table, entry in said.items()
            for key, value in (entry if isinstance(entry, dict) else {"": entry}).items()
        }
        for said in (was, now)
    )
    return [key for key in {**old, **new} if old.get(key) != new.get(key)]


def check_log(
    log: Path, now: Mapping[str, Any], what: str, may_differ: Container[str] = ()
) -> None:
    """Raise ValueError if a folder's log has other settings, except keys that may differ."""
    try:
        changed = changed_settings(json.loads(log.read_text())["settings"], now)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ValueError(f"{log}: is damaged; start again with --overwrite.") from None
    if words := ", ".join(key for key in changed if key not in may_differ):
        raise ValueError(
            f"{log.parent}: holds {what} of other settings ({words}); choose another --out, or "
            "start again with --overwrite."
        )
