"""Check input files, write output files atomically, cache arrays, and lock folders of results.

Several processes may share a folder of results if each works on its own part.
"""

import errno
import hashlib
import os
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import filelock
import numpy as np
import platformdirs


class InputError(ValueError):
    """A file that cannot be used, or not as asked; one sentence that names file and value."""


class MissingFileError(InputError):
    """A file that does not exist."""


class UnfitError(Exception):
    """A problem with the file being read, without its name; see `in_file`."""


@contextmanager
def in_file(where: Path | str) -> Iterator[None]:
    """Turn an UnfitError into an InputError that names the file, or a part of it."""
    try:
        yield
    except UnfitError as error:
        raise InputError(f"{where}: {error}") from None


def check_file(path: Path) -> None:
    """Raise InputError unless a path is a readable file; the message says what it is instead."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            aim = os.readlink(path)
            raise InputError(f"{path}: is a link to {aim}, which is not there.") from None
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


#: Prefix of the names of incomplete files, followed by the id of the process that writes them.
PARTIAL = ".partial-"
#: In a worker, the id of the process that it works for and a word of its own; else nothing.
writer = ""
#: Functions called before anything is written; if one raises, nothing is written.
guards: list[Callable[[], None]] = []


def partial(name: str) -> str:
    """Return the name of an incomplete file of this process."""
    return f"{PARTIAL}{writer or os.getpid()}-{name}"


def check_guards() -> None:
    """Raise if something forbids writing, for example if the folder was removed."""
    for guard in guards:
        guard()


def is_fits(path: Path) -> bool:
    """Return whether a file is FITS, compressed or not; raise InputError if there is no file."""
    check_file(path)
    with path.open("rb") as stream:
        return stream.read(6).startswith((b"SIMPLE", b"\x1f\x8b"))


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path next to it, which replaces it on success.

    An existing file survives a killed process and a full disk. Data are flushed to disk before the
    file is renamed, as some file systems report only then that there was no room.
    """
    beside = path.with_name(partial(path.name))
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
    """Return the operating system's message, which libraries wrap in their own."""
    first: BaseException | None = error
    while first is not None:
        if isinstance(first, OSError) and first.strerror:
            return first.strerror
        first = first.__context__
    return str(error).rstrip(".")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with whole(path) as beside:
        beside.write_text(text)


#: File locked only briefly, while the list of processes in a folder is read or changed.
GATE = ".lock"
#: Prefix of the file that a process keeps locked as long as it works in a folder.
OWNER = ".running"
#: The part of a process that does not share its folder.
ALL = range(sys.maxsize)
#: Errors by which a file system says that it has no locks.
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EPROTONOSUPPORT}


def cache_folder() -> Path:
    """Return the folder for files that can be made again: $JAXSKY_CACHE or the system's cache."""
    given = os.environ.get("JAXSKY_CACHE")
    return Path(given or platformdirs.user_cache_path("jaxsky")).expanduser().absolute()


def kept(
    kind: str, mark: object, shape: tuple[int, ...], make: Callable[[], np.ndarray]
) -> np.ndarray:
    """Return an array that is slow to make, from the cache if it was made before.

    `mark` contains everything it depends on. It is made again if the cached file is missing,
    damaged or has another shape.
    """
    name = hashlib.sha256(repr(mark).encode()).hexdigest()
    path = cache_folder() / kind / f"{name}.npy"
    with suppress(OSError, ValueError, EOFError):
        found = np.load(path)
        if found.shape == shape:
            return found
    made = make()
    with suppress(OSError):  # caching is optional
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as beside, beside.open("wb") as file:
            np.save(file, made)
    return made


class Owner(NamedTuple):
    """A process that works on a part of a folder; `started` is in ns since 1970."""

    pid: int
    started: int
    first: int
    stop: int
    host: str

    @property
    def name(self) -> str:
        """Name of the process's file."""
        return "-".join((OWNER, *map(str, self)))

    @classmethod
    def named(cls, name: str) -> "Owner":
        """Return the process that a file name describes."""
        _, pid, started, first, stop, host = name.split("-", 5)
        return cls(int(pid), int(started), int(first), int(stop), host)

    def __str__(self) -> str:
        """Return process id, host if it is another one, and start time."""
        when = datetime.fromtimestamp(self.started / 1e9).isoformat(" ", "seconds")
        where = "" if self.host == socket.gethostname() else f" on {self.host}"
        return f"process {self.pid}{where}, started {when}"


def _lock(path: Path) -> filelock.BaseFileLock:
    # The operating system releases such a lock when a process dies; filelock's soft lock stays.
    return filelock.FileLock(path, timeout=0, fallback_to_soft=False)


def _acquire(lock: filelock.BaseFileLock, timeout: float = 0) -> bool:
    """Acquire a lock; return False if the file system has no locks."""
    try:
        lock.acquire(timeout)
        return True
    except OSError as error:
        if error.errno in NO_LOCKS:
            return False
        raise


@contextmanager
def locked(
    path: Path, timeout: float = -1, waiting: Callable[[], None] = lambda: None
) -> Iterator[bool]:
    """Hold a lock; yield False where the file system has none.

    `timeout` is in seconds, -1 to wait forever; `waiting` is called if another process has it.
    """
    lock = _lock(path)
    try:
        held = _acquire(lock)
    except filelock.Timeout:
        waiting()
        held = _acquire(lock, timeout)
    try:
        yield held
    finally:
        lock.release()


@contextmanager
def alone(out: Path) -> Iterator[bool]:
    """Lock the list of a folder's processes, briefly; yield False without file locks."""
    with locked(out / GATE, 60) as held:
        try:
            yield held
        finally:
            if held and not any(out.glob(f"{OWNER}-*")):
                (out / GATE).unlink(missing_ok=True)


def _owners(out: Path) -> Iterator[Owner]:
    """Yield the processes that work in a folder, and remove the files of those that have died."""
    for path in out.glob(f"{OWNER}-*"):
        lock = _lock(path)
        try:
            lock.acquire()
        except filelock.Timeout:
            yield Owner.named(path.name)
        else:
            path.unlink(missing_ok=True)
            lock.release()


class Folder:
    """A folder in which this process works on a part of the results; see `occupied`."""

    def __init__(self, path: Path, part: range) -> None:
        self.path, self.locked = path, False
        me, now, host = os.getpid(), time.time_ns(), socket.gethostname()
        self._owner = Owner(me, now, part.start, part.stop, host)

    @property
    def place(self) -> Path:
        """File that this process keeps locked as long as it works in the folder."""
        return self.path / self._owner.name

    def check(self) -> None:
        """Raise FileNotFoundError if the folder was removed or replaced."""
        if not self.place.exists():
            raise FileNotFoundError(
                f"{self.path}: was removed while the command worked in it; the rest of its "
                "results is not written."
            )

    def narrow(self, part: range) -> None:
        """Reduce the part that this process works on."""
        with alone(self.path):
            before = self.place
            self._owner = self._owner._replace(first=part.start, stop=part.stop)
            before.rename(self.place)

    def remove(self, patterns: Sequence[str]) -> None:
        """Remove the files whose names match any of the patterns."""
        self.check()
        for pattern in patterns:
            for path in self.path.glob(pattern):
                path.unlink(missing_ok=True)

    def clean(self) -> None:
        """Remove incomplete files left by processes that have died or worked for this one."""
        with alone(self.path) as locked:
            if not locked:
                return
            living = {str(other.pid) for other in _owners(self.path) if other != self._owner}
            for path in (*self.path.glob(f"{PARTIAL}*"), *self.path.glob(f"*/{PARTIAL}*")):
                if path.name.split("-")[1] not in living:
                    path.unlink(missing_ok=True)


@contextmanager
def occupied(out: Path, part: range = ALL) -> Iterator[Folder]:
    """Work in a folder, which is created if missing, and then removed again if it stays empty.

    Several processes may share it if they make different parts of the results.
    """
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{out}: cannot be made ({error.strerror}); choose another --out.") from error
    folder = Folder(out, part)
    lock = _lock(folder.place)
    try:
        with alone(out) as locks:
            for other in _owners(out) if locks else ():
                if other.first < part.stop and part.start < other.stop:
                    raise ValueError(
                        f"{out}: is being written to by another command ({other}); wait for its "
                        "end, or choose another --out."
                    )
            folder.locked = locks and _acquire(lock)
            folder.place.touch()
        guards.append(folder.check)
        try:
            yield folder
        except (OSError, ValueError):
            folder.check()  # if the folder was removed, that is the reason for the error
            raise
        finally:
            guards.remove(folder.check)
            with suppress(OSError):
                folder.check()
                folder.clean()  # what workers have left that were stopped
                with alone(out):
                    folder.place.unlink()
            lock.release()
    finally:
        for made in missing:
            with suppress(OSError):
                made.rmdir()  # fails unless the folder is empty
