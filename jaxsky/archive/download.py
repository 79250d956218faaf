"""Download of products into a cache: resumed, checked, whole or not at all."""

import contextlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import filelock
import pooch
import requests
import urllib3

from jaxsky.archive.products import Product
from jaxsky.io.files import write_text

__all__ = ["CHECKSUMS", "DownloadError", "cache_folder", "fetch", "file_hash", "known_hash"]

#: Hashes of files that the catalogue has none of, as they were when they were fetched.
CHECKSUMS = "checksums.json"
#: Seconds to wait for a connection, and for more bytes.
TIMEOUT = (10.0, 60.0)
CHUNK = 2**20


class DownloadError(ValueError):
    """A file that could not be had; one sentence."""


class _CutError(Exception):
    """A transfer that ended early."""


def cache_folder() -> Path:
    """Where products are kept: $JAXSKY_CACHE, or the platform's folder for caches."""
    given = os.environ.get("JAXSKY_CACHE")
    return Path(given or pooch.os_cache("jaxsky")).expanduser().absolute()


def _checksums(folder: Path) -> dict[str, str]:
    try:
        return dict(json.loads((folder / CHECKSUMS).read_text()))
    except (OSError, ValueError):
        return {}


def known_hash(product: Product, folder: Path) -> str | None:
    """The hash that a file should have: its own when it was fetched, or the catalogue's."""
    return _checksums(folder).get(product.name, product.hash)


def file_hash(path: Path, like: str = "sha256:") -> str:
    """The hash of a file by the algorithm of another hash."""
    algorithm = like.partition(":")[0]
    return f"{algorithm}:{pooch.file_hash(str(path), alg=algorithm)}"


def _remember(product: Product, folder: Path, value: str) -> None:
    with filelock.FileLock(folder / f".{CHECKSUMS}.lock"):
        known = _checksums(folder) | {product.name: value}
        write_text(folder / CHECKSUMS, json.dumps(known, indent=2, sort_keys=True) + "\n")


def _stream(address: str, part: Path, report: Callable[[int, int | None], None]) -> None:
    """Append what is missing of a file; raises what `requests` does, and _CutError."""
    have = part.stat().st_size if part.exists() else 0
    headers = {"Range": f"bytes={have}-"} if have else {}
    # Compressed transfers would have other lengths than the file.
    headers["Accept-Encoding"] = "identity"
    with requests.get(address, headers=headers, stream=True, timeout=TIMEOUT) as answer:
        if answer.status_code == requests.codes.requested_range_not_satisfiable:
            # All of it is there already, or something else is.
            if answer.headers.get("Content-Range", "").endswith(f"/{have}"):
                return
            part.unlink()
            raise _CutError
        answer.raise_for_status()
        resumed = answer.status_code == requests.codes.partial_content
        have = have if resumed else 0
        length = answer.headers.get("Content-Length")
        total = None if length is None else have + int(length)
        with part.open("ab" if resumed else "wb") as file:
            report(have, total)
            try:
                # What has come counts, also before a break.
                answer.raw.enforce_content_length = False
                while chunk := answer.raw.read1(CHUNK):
                    file.write(chunk)
                    have += len(chunk)
                    report(have, total)
            except (urllib3.exceptions.HTTPError, OSError):
                raise _CutError from None
        if total is not None and have != total:
            raise _CutError


def _reason(error: Exception) -> str:
    if isinstance(error, requests.HTTPError) and error.response is not None:
        return f"answers {error.response.status_code}"
    if isinstance(error, requests.Timeout):
        return "does not answer in time"
    return "cannot be reached"


def _check_kind(product: Product, part: Path) -> None:
    """Refuse a page of words in place of a file, as servers that are down send it."""
    with part.open("rb") as file:
        start = file.read(512)
    if product.name.endswith(".fits") and not start.startswith(b"SIMPLE"):
        part.unlink()
        shown = " ".join(start[:60].decode("ascii", "replace").split())
        raise DownloadError(
            f"{product.name}: what came is no FITS file, it begins with {shown!r}; try again "
            "later, or another --mirror."
        )


def _download(
    product: Product, addresses: tuple[str, ...], part: Path, report: Callable[..., None]
) -> None:
    failures = []
    for address in addresses:
        try:
            _stream(address, part, report)
        except _CutError:
            size = part.stat().st_size if part.exists() else 0
            raise DownloadError(
                f"{product.name}: the transfer from {address} ended early, after {size} bytes; "
                "fetch it again to go on from there."
            ) from None
        except requests.RequestException as error:
            failures.append(f"{address} {_reason(error)}")
        else:
            _check_kind(product, part)
            return
    raise DownloadError(
        f"{product.name}: {'; '.join(failures)}. Without a network, put the file into "
        f"{part.parent} by hand, or name a --mirror."
    )


def fetch(
    product: Product,
    folder: Path | None = None,
    *,
    mirror: str | None = None,
    accept: bool = False,
    report: Callable[[int, int | None], None] = lambda have, total: None,
    waiting: Callable[[], None] = lambda: None,
) -> Path:
    """A product's file, downloaded unless it is there.

    What has come of a file that was cut is kept beside its place and gone on with. Processes
    that want the same file wait for the one that fetches it.

    Parameters
    ----------
    product : from the catalogue
    folder : where files are kept, by default `cache_folder`
    mirror : address of a folder with the files, instead of the archives
    accept : take a file of another size or hash than the catalogue says
    report : called with the bytes that are there, and all bytes or None
    waiting : called if another process fetches the file

    Raises
    ------
    DownloadError
        If no address answers, a transfer is cut, or what came is not the file.
    """
    folder = cache_folder() if folder is None else folder
    path = folder / product.name
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{product.name}.part"
    addresses = product.addresses if mirror is None else (f"{mirror.rstrip('/')}/{product.name}",)
    with _alone(folder / f".{product.name}.lock", waiting):
        if path.exists():  # another process has brought it
            return path
        _download(product, addresses, part, report)
        found = _checked(product, part, accept)
        # A cached file is never anything but whole.
        os.replace(part, path)
        if accept or product.hash is None:
            _remember(product, folder, found)
    return path


@contextlib.contextmanager
def _alone(lock: Path, waiting: Callable[[], None]) -> Iterator[None]:
    alone = filelock.FileLock(lock)
    try:
        alone.acquire(blocking=False)
    except filelock.Timeout:
        waiting()
        alone.acquire()
    try:
        yield
    finally:
        alone.release()


def _checked(product: Product, part: Path, accept: bool) -> str:
    """The hash of a file that came; refuses it if size or hash are others than they should be."""
    size = part.stat().st_size
    found = file_hash(part, product.hash or "sha256:")
    wrong: list[Any] = []
    if product.size is not None and size != product.size:
        wrong = [f"{size} bytes", f"{product.size} bytes"]
    elif product.hash is not None and found != product.hash:
        wrong = [found, product.hash]
    if wrong and not accept:
        part.unlink()
        raise DownloadError(
            f"{product.name}: what came has {wrong[0]}, but should have {wrong[1]}; if the archive "
            "has issued the file anew, --accept takes it."
        )
    return found
