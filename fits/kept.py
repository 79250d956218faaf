"""What a stopped run resumes from: chains of emcee and realisations, kept in files with a mark.

A file is whole at any moment, and refused if it is damaged or holds what was made of other data.
"""

import hashlib
import os
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import emcee
import h5py
import jax
import numpy as np
from jaxtyping import Array

from jaxsky.checks import check_seed
from jaxsky.io import InputError, whole
from jaxsky.keys import realisation_key, stream
from jaxsky.progress import QUIET

#: Files are written after so many seconds, and when a run is stopped.
SAVED_EVERY = 10.0
#: Entries of numpy's random state, each an attribute of a chain in its file.
RANDOM_STATE = 5
#: What a damaged archive raises besides: RuntimeError for one that seems encrypted or packed in
#: a way that is not known.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, RuntimeError)
Kind = TypeVar("Kind", bound=NamedTuple)


def fingerprint(tree: Any) -> str:
    """A hash of all arrays of a tree; functions, which work with them, are left out."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        if array.dtype != object:
            digest.update(array.tobytes())
        elif not callable(leaf):
            raise TypeError(f"{leaf!r} is neither an array nor a function.")
    return digest.hexdigest()


def _other(path: Path, what: str) -> InputError:
    """The error for a file of a run with other data or settings."""
    return InputError(
        f"{path}: holds {what} of other data or settings; choose another --out, or start again "
        "with --overwrite."
    )


class ChainFile(emcee.backends.HDFBackend):
    """emcee's HDF5 file, replaced by one with more steps every few seconds.

    HDF5 damages a file if it is stopped while it changes it, or finds the disk full. So changes
    are made in memory, and what is on disk is always a whole file: a state from which the chain
    goes on exactly as if it had not stopped. Steps are written `every` so many seconds.
    """

    def __init__(
        self, filename: str | Path, name: str = "mcmc", every: float = SAVED_EVERY
    ) -> None:
        super().__init__(str(filename), name=name)
        self.every = every
        self._changed: h5py.File | None = None
        self._pending: list[tuple[Any, np.ndarray]] = []
        self._written, self._due = -1, time.monotonic() + every

    @contextmanager
    def open(self, mode: str = "r") -> Iterator[h5py.File]:
        """The file to read from, or to change: what is changed in one `with` is written at once."""
        if self._changed is not None:
            yield self._changed
            return
        path = Path(self.filename)
        if mode == "r":
            if not path.exists():
                raise FileNotFoundError(f"{path}: is not there, or not any more.")
            with h5py.File(path) as file:
                yield file
            return
        with h5py.File.in_memory(path.read_bytes() if path.exists() else None) as file:
            self._changed = file
            try:
                yield file
            finally:
                self._changed = None
            file.flush()
            image = file.id.get_file_image()
        with whole(path) as beside:
            beside.write_bytes(image)

    def save_step(self, state: Any, accepted: np.ndarray) -> None:
        """Keep a step, and write when it is time."""
        if not self._pending:
            self._written = int(self.iteration)
        # emcee goes on to change the arrays of the state it hands over.
        kept = emcee.State(
            state.coords.copy(), state.log_prob.copy(), random_state=state.random_state
        )
        self._pending.append((kept, accepted.copy()))
        if time.monotonic() > self._due:
            self.flush()

    def flush(self) -> None:
        """Write the steps that are kept in memory."""
        if not self._pending:
            return
        start, found = time.monotonic(), self.iteration
        if found == self._written:
            self._append()
        # Otherwise an interrupted call has written them already.
        elif found != self._written + len(self._pending):
            raise InputError(f"{self.filename}: was changed by another process meanwhile.")
        self._pending, now = [], time.monotonic()
        self._due = now + max(self.every, 20 * (now - start))

    def _append(self) -> None:
        states = [state for state, _ in self._pending]
        with self.open("a") as file:
            group = file[self.name]
            new = slice(self._written, self._written + len(states))
            group["chain"][new] = [state.coords for state in states]
            group["log_prob"][new] = [state.log_prob for state in states]
            group["accepted"][:] += sum(accepted for _, accepted in self._pending)
            for i, value in enumerate(states[-1].random_state):
                group.attrs[f"random_state_{i}"] = value
            group.attrs["iteration"] = new.stop


def kept_chain(path: Path, name: str, size: tuple[int, int], mark: str) -> ChainFile:
    """The place of a chain in its file, to begin there or to go on.

    Its size is the number of walkers and of parameters, its mark that of all that it depends on.
    """
    backend, mark = ChainFile(path, name), f"{mark} {size}"
    held = _held(path, name)
    if held is None:
        with backend.open("a") as file:
            backend.reset(*size)
            file[name].attrs["fingerprint"] = mark
    elif held != mark:
        raise _other(path, "a chain")
    return backend


def _held(path: Path, name: str) -> str | None:
    """The mark of a chain that is in a file and whole, None if there is none."""
    if not path.exists():
        return None
    try:
        with h5py.File(path) as file:
            if name not in file:
                return None
            group = file[name]
            done = int(group.attrs["iteration"])
            size = int(group.attrs["nwalkers"]), int(group.attrs["ndim"])
            chain, log_prob = group["chain"][:done], group["log_prob"][:done]
            accepted, states = group["accepted"][:], [a for a in group.attrs if "random" in a]
            mark = str(group.attrs.get("fingerprint"))
        intact = (
            chain.shape == (done, *size)
            and log_prob.shape == (done, size[0])
            and bool(np.isfinite(chain).all() and not np.isnan(log_prob).any())
            # Steps that were counted but not written are zeros.
            and bool(chain.any(axis=(1, 2)).all() and (accepted <= done).all())
            and len(states) == (RANDOM_STATE if done else 0)
        )
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        intact = False
    if not intact:
        raise InputError(f"{path}: is damaged; start again with --overwrite.")
    return mark


def kept_realisations(
    make: Callable[[Array], Sequence[Array | np.ndarray]],
    kind: type[Kind],
    count: int,
    seed: int,
    path: Path | None = None,
    mark: str = "",
    report: Callable[[int, int], None] = QUIET.advance,
) -> Kind:
    """Results of a function of a random key, stacked over realisations, as a NamedTuple.

    A realisation depends on the seed and its own number only. What the file holds already is not
    made again; one with another mark, that of all that the results depend on, is refused. `report`
    is called with the number of realisations done, and that of all.
    """
    check_seed("seed", seed)
    names = kind._fields
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
    return kind._make(map(np.stack, zip(*done[:count], strict=True)))


def _made(
    make: Callable[[Array], Sequence[Array | np.ndarray]], seed: int, numbers: range
) -> Iterator[list[np.ndarray]]:
    """Realisations in order, made by as many threads as there are processors."""

    def one(number: int) -> list[np.ndarray]:
        key = stream(realisation_key(seed, number), "realisation")  # unlike what is observed
        return [np.asarray(x) for x in make(key)]

    yield from map(one, numbers[:1])  # alone, so that each program is compiled once
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(one, numbers[1:])


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
        raise _other(path, "realisations")
    return rows
