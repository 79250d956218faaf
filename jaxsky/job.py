"""Processes of a job that do the same: what they tell each other, and which of them does what.

Without `processes`, and within what a process does alone, there is one.
"""

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jaxtyping import Array

from jaxsky.io.stacks import Maps, Stored, empty, ranges
from jaxsky.mesh import spread
from jaxsky.workers import raised_in

#: Seconds after which a process that does not answer is taken to have ended.
HEARTBEAT = 10
#: Variables of steps of SLURM, and of Open MPI up to version 4, which JAX knows, and the number of
#: their processes.
LAUNCHED = {
    "SLURM_STEP_NODELIST": "SLURM_STEP_NUM_TASKS",
    "OMPI_MCA_orte_hnp_uri": "OMPI_COMM_WORLD_SIZE",
}
#: Environment variables: address of the first process, their number, and which of them this is.
VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
Item = TypeVar("Item")
Made = TypeVar("Made")
_alone = False
#: Whether an error was raised in all processes, so that one of them may say it.
told = False


@contextmanager
def processes() -> Iterator[None]:
    """Join the processes of a job, before anything else is done with JAX; all have to do the same.

    `jaxsky.mesh.pixel_mesh` then has the devices of all of them. Processes that SLURM or Open MPI
    start find each other. Others are told by the environment, `VARIABLES`: the "host:port" of the
    first one, where the port is a free one, their number, and which of them this is, from 0.
    Without any of this there is one process.

    Raises
    ------
    RuntimeError
        If another process has ended, which exchanges of pixels notice at once, and all others
        after `HEARTBEAT` seconds: then JAX ends the process with a text of its own.
    ValueError
        If only some of the environment variables are set.
    """
    env = os.environ
    lacking = [word for word in VARIABLES if word not in env]
    if 0 < len(lacking) < len(VARIABLES):
        raise ValueError(f"{lacking[0]} is missing: set all of {', '.join(VARIABLES)}, or none.")
    launched = [int(env.get(count, 2)) for word, count in LAUNCHED.items() if word in env]
    if not lacking or max(launched, default=1) > 1:
        # JAX looks up the address itself, and the rest where a scheduler has it.
        number, index = (None if lacking else int(env[word]) for word in VARIABLES[1:])
        jax.distributed.initialize(
            num_processes=number,
            process_id=index,
            heartbeat_timeout_seconds=HEARTBEAT,
            shutdown_timeout_seconds=HEARTBEAT,
        )
    try:
        yield
    except Exception as error:
        if told:
            _end()
        lost = any(word in str(error) for word in ("Gloo", "NCCL", "coordination service"))
        if jax.process_count() == 1 or not lost:
            raise
        raise RuntimeError(
            f"Another of the {jax.process_count()} processes has ended, and number "
            f"{jax.process_index()} cannot go on without it; what it said tells why."
        ) from error
    except SystemExit:  # of the command line, in all processes alike
        _end()
        raise
    _end()


def _end() -> None:
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def _joined() -> bool:
    """Return whether others do the same; JAX, which takes time to begin, is not asked in vain."""
    return jax.distributed.is_initialized() and not _alone


def number() -> int:
    """Return the number of processes."""
    return jax.process_count() if _joined() else 1


def index() -> int:
    """Return which of them this is; the first, 0, writes the results."""
    return jax.process_index() if _joined() else 0


def exchanged(value: Any) -> list[Any]:
    """Return the values of all processes, in their order; arrays on disk stay there."""
    if number() == 1:
        return [value]
    own = np.frombuffer(pickle.dumps(value, pickle.HIGHEST_PROTOCOL), np.uint8)
    sizes = process_allgather(np.array(own.size))
    rows = process_allgather(np.pad(own, (0, int(sizes.max()) - own.size)))
    values = [pickle.loads(row[:size].tobytes()) for row, size in zip(rows, sizes, strict=True)]
    values[index()] = value
    process_allgather(np.array(0))  # before anyone can remove a file that another has not opened
    return values


def by_turns(make: Callable[[Item], Made], items: Sequence[Item]) -> Iterator[Made]:
    """Yield `make(item)` for each item, in order; each process makes some, and all get them.

    What `make` raises in one of them is raised in all.
    """
    global _alone, told
    count = number()
    if count == 1:
        yield from map(make, items)
        return
    made, failed = list[Any](), None
    _alone = True
    try:
        made = [make(item) for item in items[jax.process_index() :: count]]
    except Exception as error:
        failed = _as_sent(error)
    finally:
        _alone = False
    every = exchanged((made, failed))
    for _, failed in every:
        if failed is not None:
            told = True
            raise failed
    for k in range(len(items)):
        yield every[k % count][0][k // count]


def _as_sent(error: Exception) -> Exception:
    """Return an error that other processes can raise: itself, or its words if it is not pickled."""
    where = raised_in(error)
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        kind = ValueError if isinstance(error, ValueError) else RuntimeError
        error = kind(f"{type(error).__name__}: {error}")
    error.raised_in = where  # type: ignore[attr-defined]
    return error


def of_first(make: Callable[[], Made]) -> Made:
    """Return what `make` returns in the first process, or raise what it raises there."""
    return next(iter(by_turns(lambda _: make(), [None])))


def filled(shape: tuple[int, ...], make: Callable[[int], Any]) -> Maps:
    """Return an array whose rows are made by turns; on disk, where all see it, if it is large."""
    found = of_first(lambda: empty(shape))

    def row(i: int) -> Any:
        values = np.asarray(make(i))
        if not isinstance(found, Stored):
            return values
        found[i] = values
        return None

    for i, values in enumerate(by_turns(row, range(shape[0]))):
        if values is not None:
            found[i] = values
    return found


def collected(tree: Any, npix: int) -> Any:
    """Return distributed maps (..., pix) of a tree as arrays that each process can read whole.

    They lie on disk if they are large; other leaves are unchanged.
    """

    def one(leaf: Array) -> Any:
        if not spread(leaf):
            return leaf
        shape = (*leaf.shape[:-1], npix)
        found = of_first(lambda: empty(shape, leaf.dtype))
        if not isinstance(found, Stored):
            return process_allgather(leaf, tiled=True)[..., :npix]
        for shard in leaf.addressable_shards:
            start, stop, _ = shard.index[-1].indices(npix)
            values = np.asarray(shard.data)
            for part in ranges(max(0, stop - start)):
                found[..., start + part.start : start + part.stop] = values[..., part]
        exchanged(None)
        return found

    return jax.tree.map(one, tree)
