"""Download of products into a cache: resumed, checked, whole or not at all."""

import contextlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import requests
import urllib3

from jaxsky.archive import transfer
from jaxsky.archive.cache import (
    DownloadError,
    alone,
    checksums,
    file_hash,
    remember,
    writing,
)
from jaxsky.archive.checking import check_size, check_structure
from jaxsky.archive.products import Product
from jaxsky.io import InputError
from jaxsky.io.folders import cache_folder


def fetch(
    product: Product,
    folder: Path | None = None,
    *,
    mirror: str | None = None,
    accept: bool = False,
    report: transfer.Report = lambda have, total: None,
    waiting: Callable[[], None] = lambda: None,
) -> Path:
    """A product's file, downloaded unless it is there; of either, size and structure are checked.

    What has come of a file that was cut is kept next to its place (`.part`, and `.part.json` for
    its version) and resumed if the server still has that version. Processes that want the same
    file wait for the one that fetches it (`.lock`). All three go when the file is complete. The
    hash is checked when a file comes; that of one that is there by `verify`. Hashes that the
    catalogue has none of are recorded in `checksums.json` (with a lock that stays).

    Parameters
    ----------
    product : from the catalogue
    folder : where files are kept, by default `cache_folder`
    mirror : address of a folder with the files, instead of the archives
    accept : take a file of another size or hash than the catalogue says; its structure counts
    report : called with the bytes that are there, and all bytes or None
    waiting : called if another process fetches the file

    Raises
    ------
    DownloadError
        If no address answers, a transfer is cut, what came is not the file, or it cannot be
        written.
    jaxsky.io.InputError
        If the file that is there is not the product, or the record of hashes is damaged; both are
        left as they are.
    ValueError
        If the mirror is no http or https address.
    """
    folder = cache_folder() if folder is None else folder
    path, part = folder / product.name, folder / f"{product.name}.part"
    addresses = product.addresses if mirror is None else (_join(mirror, product.name),)
    checksums(folder)  # a damaged record is said before anything is transferred
    if os.path.lexists(path):
        return _kept(product, path, part)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with alone(folder / f".{product.name}.lock", waiting):
            if path.exists():  # another process has brought it
                return _kept(product, path, part)
            found = _download(product, addresses, part, accept, report)
            if accept or product.hash is None:
                remember(product, folder, found)
            # A cached file is never anything but whole.
            os.replace(part, path)
            _tidy(part)
    return path


def _join(mirror: str, name: str) -> str:
    if not mirror.lower().startswith(("http://", "https://")):
        raise ValueError(f"--mirror must begin with https:// or http://, but is {mirror!r}.")
    return f"{mirror.rstrip('/')}/{name}"


def _kept(product: Product, path: Path, part: Path) -> Path:
    """A file that is there, after a check that takes no time."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: is no file, or a link to none.")
        check_size(product, path.parent)
        check_structure(product, path)
    except InputError as error:
        raise InputError(f"{error} It is left as it is; move it away and fetch it again.") from None
    with contextlib.suppress(OSError):  # the cache may be of someone else
        _tidy(part)
    return path


def _tidy(part: Path) -> None:
    """Remove what a download needs beside its file; processes that wait look for that first."""
    transfer.discard(part)
    part.with_name(f".{part.stem}.lock").unlink(missing_ok=True)


def _download(
    product: Product,
    addresses: Sequence[str],
    part: Path,
    accept: bool,
    report: transfer.Report,
) -> str:
    """Bring the file from the first address that has it; returns its hash."""
    failures = []
    begun = transfer.source(part)
    for address in sorted(addresses, key=lambda a: a != begun):
        try:
            transfer.transfer(address, part, report, None if accept else product.size)
            return _checked(product, part, accept)
        except transfer.CutError as cut:
            raise DownloadError(
                f"{product.name}: the transfer from {address} ended early, after {cut} bytes; "
                "fetch it again to resume."
            ) from None
        except requests.RequestException as error:
            failures.append(f"{address} {transfer.reason(error)}")
        except (transfer.RefusedError, urllib3.exceptions.HTTPError) as error:
            failures.append(f"{address} {error}")
    raise DownloadError(
        f"{product.name}: {'; '.join(failures)}. Try again later, give another --mirror, or put "
        f"the file into {part.parent} by hand."
    )


def _checked(product: Product, part: Path, accept: bool) -> str:
    """The hash of a file that came; removed and refused if it is not what it should be."""
    try:
        check_structure(product, part)
        size, found = part.stat().st_size, file_hash(part, product.hash or "sha256:")
        if not accept and product.size not in (None, size):
            raise InputError(f"has {size} bytes, but should have {product.size}{transfer.ANEW}.")
        if not accept and product.hash not in (None, found):
            raise InputError(f"has {found}, but should have {product.hash}{transfer.ANEW}.")
    except InputError as error:
        transfer.discard(part)
        said = str(error).replace(str(part), product.name).rstrip(".")
        raise transfer.RefusedError(f"sent another file ({said})") from None
    return found
