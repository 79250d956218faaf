"""Files: what is wrong with those that are read, and how others are written whole."""

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class InputError(ValueError):
    """A file that cannot be used, as it is or as it was asked for; one sentence with the names."""


class MissingFileError(InputError):
    """A file that is not there."""


class UnfitError(Exception):
    """What is wrong with a file that is being read; see `in_file`."""


@contextmanager
def in_file(where: Path | str) -> Iterator[None]:
    """Say what is wrong with a file as an InputError that names it, or its part."""
    try:
        yield
    except UnfitError as error:
        raise InputError(f"{where}: {error}") from None


def check_file(path: Path) -> None:
    """Raise InputError unless a path is a file that can be read; says what else it is."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            link = f"is a link to {os.readlink(path)}, which is not there"
            raise InputError(f"{path}: {link}.") from None
        raise MissingFileError(f"{path}: no such file.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    except ValueError:
        raise InputError(f"{str(path)!r}: is no name of a file.") from None
    if not stat.S_ISREG(mode):
        kind = "a folder, not a file" if stat.S_ISDIR(mode) else "no regular file"
        raise InputError(f"{path}: is {kind}.")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: cannot be read (no permission).")


#: How names of files begin that are not complete; the number of their process follows.
PARTIAL = ".partial-"
#: Called before anything is written; an exception of theirs keeps it from being written.
guards: list[Callable[[], None]] = []


def check_guards() -> None:
    """Raise what keeps this process from writing, as that its folder was removed."""
    for guard in guards:
        guard()


def is_fits(path: Path) -> bool:
    """True for a FITS file, compressed or not; raises InputError if there is no file."""
    check_file(path)
    with path.open("rb") as stream:
        return stream.read(6).startswith((b"SIMPLE", b"\x1f\x8b"))


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A place beside a file to write to; it takes the file's place unless there is an error.

    What is there survives a process that is killed and a full disk. Data are on the disk before
    they get their name, as some file systems tell only then that there was no room.
    """
    beside = path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")
    check_guards()
    try:
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        check_guards()
        beside.replace(path)
    except OSError as error:
        check_guards()
        raise OSError(
            f"{path}: cannot be written ({_reason(error)}); what was complete before is kept."
        ) from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


def _reason(error: OSError) -> str:
    """The system's own words; libraries put theirs on top."""
    first: BaseException | None = error
    while first is not None:
        if isinstance(first, OSError) and first.strerror:
            return first.strerror
        first = first.__context__
    return str(error).rstrip(".")


def write_text(path: Path, text: str) -> None:
    """Write a text file whole."""
    with whole(path) as beside:
        beside.write_text(text)
