"""The folder of downloads: where it is, hashes of what is in it, and disks that are full."""

import errno
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock
import pooch

from jaxsky.archive.products import Product
from jaxsky.io import InputError
from jaxsky.io.folders import NO_LOCKS

#: Hashes of files that the catalogue has none of, as they were when they were fetched.
CHECKSUMS = "checksums.json"
_HASH = re.compile(r"(sha256|md5):[0-9a-f]+")
_MOVE = "move it away to go on without the hashes in it."
_FULL = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}


class DownloadError(ValueError):
    """A file that could not be had; one sentence."""


def checksums(folder: Path) -> dict[str, str]:
    """Hashes by name, as they were recorded; raises InputError if the record is damaged."""
    path = folder / CHECKSUMS
    try:
        known = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {_MOVE}") from None
    if not isinstance(known, dict) or not all(_HASH.fullmatch(str(h)) for h in known.values()):
        raise InputError(f"{path}: is damaged, it holds other things than hashes; {_MOVE}")
    return known


def known_hash(product: Product, folder: Path) -> str | None:
    """The hash that a file should have: its own when it was fetched, or the catalogue's."""
    return checksums(folder).get(product.name, product.hash)


def file_hash(path: Path, like: str = "sha256:") -> str:
    """The hash of a file by the algorithm of another hash."""
    algorithm = like.partition(":")[0]
    return f"{algorithm}:{pooch.file_hash(str(path), alg=algorithm)}"


def remember(product: Product, folder: Path, value: str) -> None:
    """Record the hash of a product's file."""
    with alone(folder / f".{CHECKSUMS}.lock"):
        known = checksums(folder) | {product.name: value}
        new = folder / f".{CHECKSUMS}.new"
        new.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n")
        os.replace(new, folder / CHECKSUMS)


@contextmanager
def alone(path: Path, waiting: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold a lock, which ends with the process; without one where a file system has none.

    Parameters
    ----------
    path : of the lock
    waiting : called if another process has it
    """
    lock = filelock.FileLock(path, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        waiting()
        lock.acquire()
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    try:
        yield
    finally:
        lock.release()


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """What is wrong with a disk while it is written to, as a DownloadError."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise DownloadError(
                f"{folder}: {_FULL[error.errno]}; make room and fetch it again to resume."
            ) from None
        where = error.filename or folder
        raise DownloadError(
            f"{where}: cannot be written ({error.strerror or error}); give another --dir."
        ) from None
