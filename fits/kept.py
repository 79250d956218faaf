"""Files from which a stopped run is resumed: chains of emcee, and realisations, with a mark.

Writes are atomic, and a file is refused if it is damaged or was made from other data.
"""

import hashlib
import os
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import emcee
import jax
import numpy as np
from jaxtyping import Array

from jaxsky import job
from jaxsky.checks import check_seed
from jaxsky.io import InputError, whole
from jaxsky.io.files import cache_folder
from jaxsky.io.stacks import Stack, ranges
from jaxsky.mesh import parts_of, spread
from jaxsky.noise import realisation_key, stream
from jaxsky.programs import QUIET
from jaxsky.workers import realised

#: Interval at which files are written [s]; they also are when a run is stopped.
SAVED_EVERY = 10.0
#: Arrays of a chain in its file; the last two are numpy's random state.
CHAIN = ("chain", "log_prob", "accepted", "random_keys", "random_rest")
#: Further errors of a damaged archive: RuntimeError if it seems encrypted or compressed in an
#: unknown way.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, RuntimeError)
Kind = TypeVar("Kind", bound=NamedTuple)


def fingerprint(tree: Any) -> str:
    """Return a hash of all arrays of a tree; functions are left out."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, Stack):
            for part in ranges(leaf.shape[-1]):
                digest.update(leaf[..., part].tobytes())
            continue
        if spread(leaf):  # the pixels of all processes, or these would differ in what is the same
            parts = [hashlib.sha256(own.tobytes()).digest() for own in parts_of(leaf)]
            digest.update(repr(job.exchanged(parts)).encode())
            continue
        array = np.ascontiguousarray(leaf)
        if array.dtype != object:
            digest.update(array.reshape(-1).view(np.uint8).data)  # without a copy
        elif not callable(leaf):
            raise TypeError(f"{leaf!r} is neither an array nor a function.")
    return digest.hexdigest()


def remembered(function: Callable[[Array], np.ndarray]) -> Callable[[Array], np.ndarray]:
    """Return a function that caches its last result, for an equal array."""
    last: dict[str, np.ndarray] = {}

    def found(rows: Array) -> np.ndarray:
        mark = fingerprint(rows)
        if mark not in last:
            last.clear()
            last[mark] = function(rows)
        return last[mark]

    return found


class KeptChain(emcee.backends.Backend):
    """A chain of emcee in memory, written to its file every few seconds.

    The file contains a state from which the chain is resumed exactly as if it had not stopped; a
    file with another mark, which stands for all that the chain depends on, is refused.
    """

    def __init__(self, path: Path, mark: str = "", every: float = SAVED_EVERY) -> None:
        super().__init__()
        self.path, self.mark, self.every = path, mark, every
        self._written, self._due = 0, time.monotonic() + every
        #: Number of complete steps, acceptance and random state; replaced together.
        self._state: tuple[int, np.ndarray, Any] | None = None
        held = job.of_first(lambda: _load(path, mark, CHAIN, "a chain", alike=2))
        if held is None:
            return
        self.reset(*held[0].shape[1:])
        self.chain, self.log_prob, self.accepted, keys, rest = held
        self.random_state = ("MT19937", keys, int(rest[0]), int(rest[1]), float(rest[2]))
        self.iteration = self._written = len(self.chain)

    def save_step(self, state: emcee.State, accepted: np.ndarray) -> None:
        """Keep a step, and write the file when it is due."""
        super().save_step(state, accepted)
        self._state = self.iteration, self.accepted.copy(), state.random_state
        if time.monotonic() > self._due:
            self.flush()

    def flush(self) -> None:
        """Write the file, if there are steps that it does not have."""
        if self._state is None or self._state[0] == self._written:
            return
        start, (steps, accepted, (_, keys, *rest)) = time.monotonic(), self._state
        arrays = self.chain[:steps], self.log_prob[:steps], accepted, keys, np.array(rest, float)
        _save(self.path, self.mark, dict(zip(CHAIN, arrays, strict=True)))
        self._written, now = steps, time.monotonic()
        self._due = now + max(self.every, 20 * (now - start))


def _realisation(
    make: Callable[[Array], Sequence[Array | np.ndarray]], seed: int, number: int
) -> list[np.ndarray]:
    """Return a realisation by its number."""
    key = stream(realisation_key(seed, number), "realisation")  # not that of observed maps
    return [np.asarray(x) for x in make(key)]


def kept_realisations(
    make: Callable[[Array], Sequence[Array | np.ndarray]],
    kind: type[Kind],
    count: int,
    seed: int,
    path: Path | None = None,
    mark: str = "",
    report: Callable[[int, int], None] = QUIET.advance,
    executor: Executor | None = None,
) -> Kind:
    """Return results of a function of a random key, stacked over realisations, as a NamedTuple.

    A realisation depends only on the seed and its own number. Those in the file are not made again;
    a file with another mark, which stands for all that the results depend on, is refused. `report`
    is called with the number of realisations done, and of all. They are made in this process, or
    by an executor, see `jaxsky.workers.realised`, through the folder of the file, or the cache's.
    """
    check_seed("seed", seed)
    names = kind._fields
    there = None if path is None else job.of_first(lambda: _load(path, mark, names, "realisations"))
    done = [] if there is None else [list(row) for row in zip(*there, strict=True)]
    held, saved = len(done), time.monotonic()
    one = partial(_realisation, make, seed)

    def made(numbers: range) -> Iterator[list[np.ndarray]]:
        """Yield realisations in order, made by one thread per processor, or by the executor."""
        if executor is not None:
            yield from realised(one, numbers, executor, path.parent if path else cache_folder())
        elif (step := job.number()) > 1:
            for start in range(0, len(numbers), step):
                yield from job.by_turns(one, numbers[start : start + step])
        else:
            yield from map(one, numbers[:1])  # alone, so that each program is compiled once
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                yield from pool.map(one, numbers[1:])

    def stacked() -> dict[str, np.ndarray]:
        return dict(zip(names, map(np.stack, zip(*done, strict=True)), strict=True))

    try:
        report(held, count)
        for result in made(range(held, count)):
            done.append(result)
            report(len(done), count)
            if path is not None and time.monotonic() - saved > SAVED_EVERY:
                _save(path, mark, stacked())
                held, saved = len(done), time.monotonic()
    finally:
        if path is not None and len(done) > held:
            _save(path, mark, stacked())
    return kind._make(array[:count] for array in stacked().values())


def _save(path: Path, mark: str, arrays: Mapping[str, np.ndarray]) -> None:
    if job.index():
        return
    with whole(path) as beside, beside.open("wb") as file:
        np.savez(file, mark=mark, **arrays)  # type: ignore[arg-type]


def _load(
    path: Path, mark: str, names: Sequence[str], what: str, alike: int | None = None
) -> list[np.ndarray] | None:
    """Load the arrays of a file, the first `alike` (or all) of equal length; None if there is none.

    `what` names its content in the error about another mark.
    """
    if not path.exists():
        return None
    try:
        with np.load(path) as archive:
            found = str(archive["mark"])
            arrays = [archive[name] for name in names]
        if len(set(map(len, arrays[:alike]))) > 1:
            raise ValueError("its arrays do not belong together")
    except (OSError, ValueError, KeyError, TypeError, EOFError, *ZIP_ERRORS) as error:
        raise InputError(f"{path}: is damaged ({error}); start again with --overwrite.") from None
    if found != mark:
        raise InputError(
            f"{path}: holds {what} of other data or settings; choose another --out, or start again "
            "with --overwrite."
        )
    return arrays
