"""Download of products into a cache: resumed, checked, whole or not at all."""

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urljoin, urlsplit

import requests
import urllib3

from jaxsky.io import InputError
from jaxsky.io.files import cache_folder, locked
from jaxsky.products import (
    DownloadError,
    Product,
    check_product,
    checksums,
    in_words,
    recorded,
    remember,
)

#: Seconds to wait for a connection, and for more bytes.
TIMEOUT = (10.0, 60.0)
CHUNK = 2**20
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")

#: What may be done about a file of another size or hash.
ANEW = "; if the archive has issued the file anew, --accept takes it"

#: What is wrong with a disk.
_FULL = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}


Report = Callable[..., None]


class CutError(Exception):
    """A transfer that ended early, after so many bytes."""


class RefusedError(Exception):
    """An answer that is not the file; what it is."""


class _State(NamedTuple):
    """What a partial file is of, kept next to it."""

    address: str
    #: The server's strong ETag or date of the file.
    version: str
    #: Bytes of the whole file, None if the server did not say.
    total: int | None


def _state(part: Path) -> _State | None:
    """What is known of a partial file; None if it has to be begun anew."""
    try:
        state = _State(**json.loads(part.with_name(f"{part.name}.json").read_text()))
        have = part.stat().st_size
    except (OSError, ValueError, TypeError):
        return None
    return None if not have or (state.total is not None and have > state.total) else state


def discard(part: Path) -> None:
    """Remove a partial file and what is known of it, in an order that allows to be interrupted."""
    part.with_name(f"{part.name}.json").unlink(missing_ok=True)
    part.unlink(missing_ok=True)


def _transfer(address: str, part: Path, size: int | None, report: Report) -> None:
    """Bring a file of so many bytes, or what is missing of the part that is there."""
    state = _state(part)
    if state is not None and state.address == address:
        have = part.stat().st_size
        if have == state.total:
            return
        with _get(address, {"Range": f"bytes={have}-", "If-Range": state.version}) as answer:
            if rest := _rest(answer, state, have):
                _check(answer, part, have, rest.total, size)
                _receive(answer, part, have, rest.total, report)
                return
    with _get(address, {}) as answer:
        answer.raise_for_status()
        if answer.status_code != requests.codes.ok:
            raise RefusedError(f"answers {answer.status_code}")
        text = answer.headers.get("Content-Length", "")
        plain = text.isdecimal() and "Transfer-Encoding" not in answer.headers
        total = int(text) if plain else None
        _check(answer, part, 0, total, size)
        discard(part)
        if version := _version(answer):
            state = _State(address, version, total)
            part.with_name(f"{part.name}.json").write_text(json.dumps(state._asdict()))
        _receive(answer, part, 0, total, report)


def _rest(answer: requests.Response, state: _State, have: int) -> _State | None:
    """The version of a file of which an answer is the rest; None if it is that of another."""
    if answer.status_code == requests.codes.range_not_satisfiable:
        return None
    answer.raise_for_status()
    found = _RANGE.fullmatch(answer.headers.get("Content-Range", ""))
    if answer.status_code != requests.codes.partial_content or found is None:
        return None
    total = state.total if found[2] == "*" else int(found[2])
    dated = not state.version.startswith('"')  # a date need not be said again, a tag must
    same = _version(answer) in (None if dated else state.version, state.version)
    fits = int(found[1]) == have and state.total in (None, total)
    return state._replace(total=total) if same and fits else None


def _get(address: str, headers: dict[str, str]) -> requests.Response:
    # Compressed transfers would have other lengths than the file.
    headers = {"Accept-Encoding": "identity", **headers}
    try:
        return requests.get(
            address, headers=headers, stream=True, timeout=TIMEOUT, hooks={"response": _stay_safe}
        )
    except requests.RequestException:
        raise
    except ValueError:  # of an address that cannot be taken apart
        raise RefusedError("sends on to no address") from None


def _stay_safe(answer: requests.Response, **_: object) -> None:
    """Refuse to be sent from https to an address that is not."""
    if answer.is_redirect and urlsplit(answer.url).scheme == "https":
        there = urljoin(answer.url, answer.headers["Location"])
        if urlsplit(there).scheme != "https":
            raise RefusedError(f"sends on to {there}, which is not https")


def _version(answer: requests.Response) -> str | None:
    """What tells this version of the file from others; weak tags do not."""
    tag = answer.headers.get("ETag", "")
    return tag if tag.startswith('"') else answer.headers.get("Last-Modified")


def _check(
    answer: requests.Response, part: Path, have: int, total: int | None, size: int | None
) -> None:
    """Refuse what need not be transferred to know that it is wrong, or has no room."""
    encoding = answer.headers.get("Content-Encoding", "identity")
    if encoding not in ("", "identity"):
        raise RefusedError(f"sends the file compressed ({encoding}), unasked")
    if size is not None and total not in (None, size):
        raise RefusedError(f"has {total} bytes, but should have {size}{ANEW}")
    free = shutil.disk_usage(part.parent).free
    if total is not None and total - have > free:
        more = f"{in_words(free)} are free, but {part.stem} takes {in_words(total - have)} more"
        raise DownloadError(f"{part.parent}: {more}; make room, or give another --dir.")


def _receive(
    answer: requests.Response, part: Path, have: int, total: int | None, report: Report
) -> None:
    report(completed=have, total=total)
    # What has come counts, also before a break.
    answer.raw.enforce_content_length = False
    with part.open("ab" if have else "wb") as file:
        while True:
            try:
                chunk = answer.raw.read1(CHUNK, decode_content=False)
            except (urllib3.exceptions.HTTPError, OSError):
                raise CutError(have) from None
            if not chunk:
                break
            file.write(chunk)
            file.flush()
            have += len(chunk)
            report(completed=have, total=total)
    if total is not None and have != total:
        raise CutError(have)


def _reason(error: requests.RequestException) -> str:
    """What is wrong with an address, to follow it in a sentence."""
    if isinstance(error, requests.HTTPError) and error.response is not None:
        later = error.response.headers.get("Retry-After")
        said = f"answers {error.response.status_code}"
        wait = f"{later} s" if later and later.isdecimal() else f"until {later}"
        return f"{said}, and asks to wait {wait}" if later else said
    for kind, words in {
        requests.Timeout: "does not answer in time",
        requests.exceptions.SSLError: "has a certificate that cannot be checked",
        requests.TooManyRedirects: "sends on and on",
        requests.exceptions.InvalidSchema: "is, or sends on to, no http or https address",
        requests.exceptions.InvalidURL: "is no address",
        requests.exceptions.MissingSchema: "is no address",
    }.items():
        if isinstance(error, kind):
            return words
    return "cannot be reached"


def fetch(
    product: Product,
    folder: Path | None = None,
    *,
    mirror: str | None = None,
    accept: bool = False,
    report: Report = lambda completed, total: None,
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
    report : called with the bytes that are there as `completed`, and all or None as `total`
    waiting : called if another process fetches the file

    Raises
    ------
    DownloadError
        If no address has the file, a transfer is cut, or it cannot be written.
    jaxsky.io.InputError
        If what is there, file or record of hashes, is damaged; it is left as it is.
    ValueError
        If the mirror is no http or https address.
    """
    folder = cache_folder() if folder is None else folder
    path, part = folder / product.name, folder / f"{product.name}.part"
    wanted = product._replace(size=None, hash=None) if accept else product
    if mirror is not None:
        if not mirror.lower().startswith(("http://", "https://")):
            raise ValueError(f"--mirror must begin with https:// or http://, but is {mirror!r}.")
        wanted = wanted._replace(addresses=(f"{mirror.rstrip('/')}/{product.name}",))
    checksums(folder)  # a damaged record is said before anything is transferred
    if os.path.lexists(path):
        return _kept(product, path, part)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / f".{product.name}.lock", waiting=waiting):
            if path.exists():  # another process has brought it
                return _kept(product, path, part)
            _download(wanted, part, report)
            if wanted.hash is None:
                remember(product, folder, part)
            # A cached file is never anything but whole.
            os.replace(part, path)
            _tidy(part)
    except OSError as error:
        if error.errno in _FULL:
            said = f"{folder}: {_FULL[error.errno]}; make room and fetch it again to resume."
        else:
            where, why = error.filename or folder, error.strerror or error
            said = f"{where}: cannot be written ({why}); give another --dir."
        raise DownloadError(said) from None
    return path


def _kept(product: Product, path: Path, part: Path) -> Path:
    """A file that is there, after a check that takes no time."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: is no file, or a link to none.")
        check_product(recorded(product, path.parent)._replace(hash=None), path)
    except InputError as error:
        raise InputError(f"{error} It is left as it is; move it away and fetch it again.") from None
    with suppress(OSError):  # the cache may be of someone else
        _tidy(part)
    return path


def _tidy(part: Path) -> None:
    """Remove what a download needs beside its file; processes that wait look for that first."""
    discard(part)
    part.with_name(f".{part.stem}.lock").unlink(missing_ok=True)


def _download(product: Product, part: Path, report: Report) -> None:
    """Bring the file from the first address that has it."""
    failures, begun = [], _state(part)
    for address in sorted(product.addresses, key=lambda a: begun is None or a != begun.address):
        try:
            _transfer(address, part, product.size, report)
            check_product(product, part, ANEW)
            return
        except InputError as error:
            discard(part)
            said = str(error).replace(str(part), product.name).rstrip(".")
            failures.append(f"{address} sent another file ({said})")
        except CutError as cut:
            raise DownloadError(
                f"{product.name}: the transfer from {address} ended early, after {cut} bytes; "
                "fetch it again to resume."
            ) from None
        except requests.RequestException as error:
            failures.append(f"{address} {_reason(error)}")
        except (RefusedError, urllib3.exceptions.HTTPError) as error:
            failures.append(f"{address} {error}")
    raise DownloadError(
        f"{product.name}: {'; '.join(failures)}. Try again later, give another --mirror, or put "
        f"the file into {part.parent} by hand."
    )
