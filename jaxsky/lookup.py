"""Find the files that settings name: next to the settings, or in the cache of downloads."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from jaxsky.io import InputError, MissingFileError, check_file
from jaxsky.io.folders import cache_folder
from jaxsky.settings.files import NamedFile, SettingsFile, expand


def find_file(folder: Path, name: str) -> Path:
    """Find a file that settings name.

    A name without a folder is looked for in `folder`, then in the cache of `jaxsky data fetch`;
    with one, it is relative to `folder`. `~`, `$NAME` and `${NAME:-default}` are expanded, unless
    a file has that very name.

    Parameters
    ----------
    folder : the settings' `data_dir`
    name : as in the settings
    """
    if not os.path.lexists(folder / name):
        try:
            name = expand(name)
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
    """Why a file is not there, and how it comes."""
    from jaxsky.archive import catalogue, product_sets  # slow to import, and seldom needed

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


def found_files(settings: SettingsFile) -> dict[str, str]:
    """The files that settings name and that are there: name -> path."""
    found = {}
    for name in named_files(settings):
        try:
            found[str(name)] = str(find_file(Path(settings.data_dir), name))
        except InputError:
            continue  # not needed, or a folder of maps
    return found


def named_files(value: Any) -> Iterator[str]:
    """All names of files among the values of settings."""
    if isinstance(value, NamedFile):
        yield value
    elif isinstance(value, BaseModel | dict):
        for _, entry in value if isinstance(value, BaseModel) else value.items():
            yield from named_files(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from named_files(entry)
