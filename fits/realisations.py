"""Realisations of a Monte Carlo that are kept in a file, so that a stopped run goes on."""

import os
import time
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Array

from jaxsky.checks import check_seed
from jaxsky.io import InputError, whole
from jaxsky.keys import realisation_key, stream
from jaxsky.progress import QUIET

#: They are written to their file after so many seconds, and when they are stopped.
SAVED_EVERY = 10.0
#: What a damaged archive raises besides: RuntimeError for one that seems encrypted or packed in
#: a way that is not known.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, RuntimeError)


def realisations(
    make: Callable[[Array], Sequence[Array | np.ndarray]],
    names: Sequence[str],
    count: int,
    seed: int,
    path: Path | None = None,
    mark: str = "",
    report: Callable[[int, int], None] = QUIET.advance,
) -> list[np.ndarray]:
    """Results of a function of a random key, stacked over realisations.

    Parameters
    ----------
    make : the function; a realisation depends on the seed and its own number only
    names : of its results
    count, seed : number of realisations, and what their keys are made of
    path : file that keeps what is done; what it holds already is not made again
    mark : of all that the results depend on; a file with another one is refused
    report : called with the number of realisations done, and that of all
    """
    check_seed("seed", seed)
    done = [] if path is None else _load(path, mark, names)
    held, saved = len(done), time.monotonic()
    try:
        report(held, count)
        for result in _made(make, seed, range(held, count)):
            done.append(result)
            report(len(done), count)
            if path is not None and time.monotonic() - saved > SAVED_EVERY:
                _save(path, mark, names, done)
                held, saved = len(done), time.monotonic()
    finally:
        if path is not None and len(done) > held:
            _save(path, mark, names, done)
    return list(map(np.stack, zip(*done[:count], strict=True)))


def _made(
    make: Callable[[Array], Sequence[Array | np.ndarray]], seed: int, numbers: range
) -> Iterator[list[np.ndarray]]:
    """Realisations in order, made by as many threads as there are processors."""

    def one(number: int) -> list[np.ndarray]:
        key = stream(realisation_key(seed, number), "realisation")  # unlike what is observed
        return [np.asarray(x) for x in make(key)]

    first, rest = numbers[:1], numbers[1:]
    yield from map(one, first)  # alone, so that each program is compiled once
    threads = os.cpu_count() or 1
    pool = ThreadPoolExecutor(threads)
    try:
        pending = deque(pool.submit(one, number) for number in rest[:threads])
        for number in rest[threads:]:
            yield pending.popleft().result()
            pending.append(pool.submit(one, number))
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _save(path: Path, mark: str, names: Sequence[str], done: list[list[np.ndarray]]) -> None:
    stacked = dict(zip(names, map(np.stack, zip(*done, strict=True)), strict=True))
    with whole(path) as beside, beside.open("wb") as file:
        np.savez(file, mark=mark, **stacked)  # type: ignore[arg-type]


def _load(path: Path, mark: str, names: Sequence[str]) -> list[list[np.ndarray]]:
    if not path.exists():
        return []
    try:
        with np.load(path) as archive:
            found = str(archive["mark"])
            arrays = [archive[name] for name in names]
        rows = [list(row) for row in zip(*arrays, strict=True)]
    except (OSError, ValueError, KeyError, TypeError, EOFError, *ZIP_ERRORS) as error:
        raise InputError(f"{path}: is damaged ({error}); start again with --overwrite.") from None
    if found != mark:
        raise InputError(
            f"{path}: holds realisations of other data or settings; choose another --out, or "
            "start again with --overwrite."
        )
    return rows
