"""Download public data products into a cache: transfers resume, are checked, and are atomic."""

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

from jaxsky import products
from jaxsky.io import InputError, check_file
from jaxsky.io.files import cache_folder, locked
from jaxsky.products import DownloadError, Product, in_words

#: Seconds to wait for a connection, and for more bytes.
TIMEOUT = (10.0, 60.0)
CHUNK = 2**20
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")

#: Hint for a file whose size or hash differs from the catalogue's.
ANEW = "; if the archive has issued the file anew, --accept takes it"

#: Disk errors in words.
_FULL = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}


Report = Callable[..., None]


class RefusedError(Exception):
    """A response that is not the file; its argument says what it is instead."""


class _State(NamedTuple):
    """The origin of a partial file, stored next to it."""

    address: str
    #: The file's strong ETag or modification date, from the server; "" if it gave neither.
    version: str
    #: Size of the complete file in bytes, None if the server did not say.
    total: int | None


def _state(part: Path) -> _State | None:
    """Return the origin of a partial file, or None if the download has to start afresh."""
    try:
        state = _State(**json.loads(part.with_name(f"{part.name}.json").read_text()))
        have = part.stat().st_size
    except (OSError, ValueError, TypeError):
        return None
    return None if not have or (state.total is not None and have > state.total) else state


def discard(part: Path) -> None:
    """Remove a partial file and its record, in an order that is safe to interrupt."""
    part.with_name(f"{part.name}.json").unlink(missing_ok=True)
    part.unlink(missing_ok=True)


def _transfer(address: str, part: Path, size: int | None, report: Report) -> None:
    """Download a file (`size` in bytes, if known), resuming from a partial file if there is one."""
    state = _state(part)
    if state is not None and state.address == address:
        have = part.stat().st_size
        if have == state.total:
            return
        with _get(address, {"Range": f"bytes={have}-", "If-Range": state.version}) as answer:
            if rest := _rest(answer, state, have):
                _receive(answer, part, rest, have, size, report)
                return
    with _get(address, {}) as answer:
        answer.raise_for_status()
        if answer.status_code != requests.codes.ok:
            raise RefusedError(f"answers {answer.status_code}")
        text = answer.headers.get("Content-Length", "")
        plain = text.isdecimal() and "Transfer-Encoding" not in answer.headers
        state = _State(address, _version(answer), int(text) if plain else None)
        _receive(answer, part, state, 0, size, report)


def _rest(answer: requests.Response, state: _State, have: int) -> _State | None:
    """Return the state of a partial file if the response is its remainder, otherwise None."""
    if answer.status_code == requests.codes.range_not_satisfiable:
        return None
    answer.raise_for_status()
    found = _RANGE.fullmatch(answer.headers.get("Content-Range", ""))
    if answer.status_code != requests.codes.partial_content or found is None:
        return None
    total = state.total if found[2] == "*" else int(found[2])
    dated = not state.version.startswith('"')  # a date need not be repeated, an ETag must
    same = _version(answer) in ("" if dated else state.version, state.version)
    fits = int(found[1]) == have and state.total in (None, total)
    return state._replace(total=total) if same and fits else None


def _get(address: str, headers: dict[str, str]) -> requests.Response:
    # A compressed transfer would have a different length from the file.
    headers = {"Accept-Encoding": "identity", **headers}
    try:
        return requests.get(
            address, headers=headers, stream=True, timeout=TIMEOUT, hooks={"response": _stay_safe}
        )
    except requests.RequestException:
        raise
    except ValueError:  # from an address that cannot be parsed
        raise RefusedError("sends on to no address") from None


def _stay_safe(answer: requests.Response, **_: object) -> None:
    """Refuse a redirect from https to an address that is not https."""
    if answer.is_redirect and urlsplit(answer.url).scheme == "https":
        there = urljoin(answer.url, answer.headers["Location"])
        if urlsplit(there).scheme != "https":
            raise RefusedError(f"sends on to {there}, which is not https")


def _version(answer: requests.Response) -> str:
    """Return what identifies this version of the file: a strong ETag, else the date, or ""."""
    tag = answer.headers.get("ETag", "")
    return tag if tag.startswith('"') else answer.headers.get("Last-Modified", "")


def _receive(
    answer: requests.Response,
    part: Path,
    state: _State,
    have: int,
    size: int | None,
    report: Report,
) -> None:
    """Receive a file, or the rest of one after `have` bytes, unless it cannot be the right one."""
    total, encoding = state.total, answer.headers.get("Content-Encoding", "identity")
    if encoding not in ("", "identity"):
        raise RefusedError(f"sends the file compressed ({encoding}), unasked")
    if size is not None and total not in (None, size):
        raise RefusedError(f"has {total} bytes, but should have {size}{ANEW}")
    free = shutil.disk_usage(part.parent).free
    if total is not None and total - have > free:
        more = f"{in_words(free)} are free, but {part.stem} takes {in_words(total - have)} more"
        raise DownloadError(f"{part.parent}: {more}; make room, or give another --dir.")
    if not have:
        discard(part)
        if state.version:
            part.with_name(f"{part.name}.json").write_text(json.dumps(state._asdict()))
    report(completed=have, total=total)
    # Keep the bytes received before a connection breaks.
    answer.raw.enforce_content_length = False
    ended = False
    with part.open("ab" if have else "wb") as file:
        while not ended:
            try:
                chunk = answer.raw.read1(CHUNK, decode_content=False)
            except (urllib3.exceptions.HTTPError, OSError):
                break
            file.write(chunk)
            file.flush()
            have, ended = have + len(chunk), not chunk
            report(completed=have, total=total)
    if not ended or total not in (None, have):
        raise DownloadError(
            f"{part.stem}: the transfer from {state.address} ended early, after {have} bytes; "
            "fetch it again to resume."
        )


def _reason(error: requests.RequestException) -> str:
    """Return what went wrong with an address, as a predicate for a sentence about it."""
    if isinstance(error, requests.HTTPError) and error.response is not None:
        later = error.response.headers.get("Retry-After")
        said = f"answers {error.response.status_code}"
        wait = f"{later} s" if later and later.isdecimal() else f"until {later}"
        return f"{said}, and asks to wait {wait}" if later else said
    sentences = {
        requests.Timeout: "does not answer in time",
        requests.exceptions.SSLError: "has a certificate that cannot be checked",
        requests.TooManyRedirects: "sends on and on",
        requests.exceptions.InvalidSchema: "is, or sends on to, no http or https address",
        requests.exceptions.InvalidURL: "is no address",
        requests.exceptions.MissingSchema: "is no address",
    }
    found = (words for kind, words in sentences.items() if isinstance(error, kind))
    return next(found, "cannot be reached")


def fetch(
    product: Product | str,
    folder: Path | None = None,
    *,
    mirror: str | None = None,
    accept: bool = False,
    report: Report = lambda completed, total: None,
    waiting: Callable[[], None] = lambda: None,
) -> Path:
    """Return the path of a product's file, downloading it if needed; check size and structure.

    An interrupted download is kept next to its destination (`.part`, and `.part.json` for its
    version) and resumed if the server still has that version. Processes that want the same file
    wait for the one that fetches it (`.lock`). All three are removed once the file is complete.
    The hash is checked after a download; `verify` checks that of a file already present. Hashes
    missing from the catalogue are recorded in `checksums.json` (whose lock file stays).

    Parameters
    ----------
    product : from the catalogue, or its name there
    folder : where files are kept, by default `cache_folder`
    mirror : address of a folder with the files, used instead of the archives
    accept : take a file whose size or hash differs from the catalogue's, if its structure is right
    report : called with the bytes received as `completed`, and all (or None) as `total`
    waiting : called if another process is fetching the file

    Raises
    ------
    DownloadError
        If no address has the file, a transfer ends early, or the file cannot be written.
    jaxsky.io.InputError
        If the existing file or the record of hashes is damaged; it is left unchanged.
    """
    if not isinstance(product, Product):
        if product not in list(products.catalogue()):
            raise ValueError(
                "Argument `product` must be the name of a file in jaxsky.products.catalogue(), "
                f"but is {product!r}."
            )
        product = products.catalogue()[product]
    folder = cache_folder() if folder is None else folder
    path, part = folder / product.name, folder / f"{product.name}.part"
    wanted = product._replace(size=None, hash=None) if accept else product
    if mirror is not None:
        if not mirror.lower().startswith(("http://", "https://")):
            raise ValueError(f"--mirror must begin with https:// or http://, but is {mirror!r}.")
        wanted = wanted._replace(addresses=(f"{mirror.rstrip('/')}/{product.name}",))
    products.checksums(folder)  # raises for a damaged record before anything is transferred
    if os.path.lexists(path):
        return _kept(product, path, part)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / f".{product.name}.lock", waiting=waiting):
            if path.exists():  # another process has downloaded it
                return _kept(product, path, part)
            _download(wanted, part, report)
            if wanted.hash is None:
                products.remember(product, folder, part)
            # The final name appears only once the file is complete.
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
    """Return the path of an existing file after a quick check (not of its hash)."""
    try:
        check_file(path)
        products.check_product(products.recorded(product, path.parent)._replace(hash=None), path)
    except InputError as error:
        raise InputError(f"{error} It is left as it is; move it away and fetch it again.") from None
    with suppress(OSError):  # the cache may belong to someone else
        _tidy(part)
    return path


def _tidy(part: Path) -> None:
    """Remove a download's auxiliary files; waiting processes look for the product first."""
    discard(part)
    part.with_name(f".{part.stem}.lock").unlink(missing_ok=True)


def _download(product: Product, part: Path, report: Report) -> None:
    """Download the file from the first address that has it."""
    failures, begun = [], _state(part)
    for address in sorted(product.addresses, key=lambda a: begun is None or a != begun.address):
        try:
            _transfer(address, part, product.size, report)
            products.check_product(product, part, ANEW)
            return
        except InputError as error:
            discard(part)
            said = str(error).replace(str(part), product.name).rstrip(".")
            failures.append(f"{address} sent another file ({said})")
        except requests.RequestException as error:
            failures.append(f"{address} {_reason(error)}")
        except (RefusedError, urllib3.exceptions.HTTPError) as error:
            failures.append(f"{address} {error}")
    raise DownloadError(
        f"{product.name}: {'; '.join(failures)}. Try again later, give another --mirror, or put "
        f"the file into {part.parent} by hand."
    )
