"""Make realisations in other processes: on this machine, on a Dask cluster, by any executor.

An executor of `concurrent.futures` decides what runs where and when. What all realisations are made
from (maps, a likelihood) is written to a file, which each process reads once.
"""

import contextlib
import dis
import logging
import multiprocessing
import os
import pickle
import pkgutil
import signal
import socket
import sys
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import jax

import jaxsky
from jaxsky.io import files
from jaxsky.programs import keep_programs, return_memory

#: Realisations are divided into this many tasks of an executor, of at most so many each.
TASKS, LARGEST = 256, 16
#: Time in which the scheduler of a cluster has to answer [s].
PATIENCE = 10.0
#: Variables that tell libraries (numpy, ducc0, XLA) how many threads to start.
THREADS = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"),
    *("DUCC0_NUM_THREADS", "PJRT_NPROC"),
)
#: A word for this process, on any machine.
_HERE = uuid.uuid4().hex[:8]
#: What a worker was given last, by its file, and the lock of that.
_HELD: dict[Path, Callable[[int], Any]] = {}
_ONE = threading.Lock()


def realised(
    work: Callable[[int], Any], numbers: Sequence[int], executor: Executor, folder: Path
) -> Iterator[Any]:
    """Yield `work(number)` for each number, in order, made by an executor.

    Parameters
    ----------
    work : makes a realisation; it is pickled once, so a function or class of a module
    numbers : of the realisations
    executor : of `concurrent.futures`, Dask (`Client.get_executor`) or mpi4py
    folder : a folder that exists, and that all workers see under this name

    Raises
    ------
    TypeError, ValueError
        If `work` cannot be pickled, or a worker has another version of jaxsky or JAX.
    OSError
        If workers do not see the folder, or are lost; what was yielded before is complete.
    """
    size = min(max(1, len(numbers) // TASKS), LARGEST)
    left = deque(numbers[i : i + size] for i in range(0, len(numbers), size))
    tasks = deque[Future[list[Any]]]()
    with _written(work, folder) as task:
        broken = False
        try:
            while left:
                try:
                    if not tasks:
                        tasks.extend(executor.submit(task, part) for part in left)
                    while not futures.wait([tasks[0]], PATIENCE).done:
                        if _lost(executor):
                            raise CancelledError
                    done = tasks[0].result()
                except BrokenExecutor:
                    if broken:
                        raise
                    broken = True  # tasks that are submitted anew may find new processes
                    tasks.clear()
                    continue
                left.popleft()
                tasks.popleft()
                yield from done
        except Exception as error:
            if isinstance(error, CancelledError) or _lost(executor):
                raise ConnectionError(
                    "The connection to the scheduler of the workers was lost. What was complete is "
                    "kept; go on with --resume once it is there again."
                ) from None
            # Dask has tried a task several times before it raises this.
            if not isinstance(error, BrokenExecutor) and type(error).__name__ != "KilledWorker":
                raise
            raise ChildProcessError(
                "Workers died more than once: were they killed, or is memory short? What was "
                "complete is kept; go on with --resume, perhaps with fewer workers."
            ) from None
        finally:
            for future in tasks:
                future.cancel()


def _lost(executor: Executor) -> bool:
    """Return whether the client of a Dask cluster has lost its scheduler, and what it had asked."""
    # Dask neither finishes nor cancels tasks whose results were on their way then.
    client = getattr(executor, "_client", None)
    return client is not None and (client.status != "running" or not client.futures)


@contextlib.contextmanager
def _written(work: Callable[[int], Any], folder: Path) -> Iterator["_Task"]:
    """Write what workers need to a file, removed at the end, and yield their task."""
    path = folder.absolute() / f"{files.PARTIAL}{os.getpid()}-{uuid.uuid4().hex}"
    try:
        with path.open("wb") as file:
            try:
                pickle.dump(work, file, pickle.HIGHEST_PROTOCOL)
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise TypeError(
                    f"Argument `work` cannot be sent to workers ({error}); it has to be made of "
                    "functions and classes of modules."
                ) from None
        yield _Task(path)
    finally:
        path.unlink(missing_ok=True)


def _versions() -> dict[str, str]:
    """Return the versions that have to be the same in all processes."""
    return {"jaxsky": jaxsky.__version__, "jax": jax.__version__}


def _check_versions(worker: str, there: Mapping[str, Any], here: Mapping[str, str]) -> None:
    for name, wanted in here.items():
        if (found := there[name]) != wanted:
            has = f"has {name} {found}" if isinstance(found, str) else f"cannot import {name}"
            raise ValueError(
                f"The worker {worker} {has}, but {wanted} is needed; install the same everywhere."
            )


class _Task:
    """Makes realisations in a worker as in the process that asks for them."""

    def __init__(self, state: Path) -> None:
        self.state = state  # the file of the function that makes one
        self.owner = os.getpid(), _HERE  # the process that asks
        self.versions = _versions()
        self.modules = *sys.path, os.getcwd()  # a law of one's own may be in the current folder
        self.double = jax.config.jax_enable_x64  # type: ignore[attr-defined]
        cached = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
        self.programs = files.cache_folder() / "programs" if cached else None

    def __call__(self, numbers: Sequence[int]) -> list[Any]:
        try:
            with _ONE:
                work = self._begun()
            return [work(number) for number in numbers]
        except Exception as error:
            error.raised_in = raised_in(error)  # type: ignore[attr-defined]
            raise

    def _begun(self) -> Callable[[int], Any]:
        """Prepare this process, unless it is, and return what makes a realisation."""
        worker = f"process {os.getpid()} on {socket.gethostname()}"
        _check_versions(worker, _versions(), self.versions)
        if self.state not in _HELD:
            _HELD.clear()
            sys.path += [folder for folder in self.modules if folder not in sys.path]
            jax.config.update("jax_enable_x64", self.double)
            if self.programs is not None:
                keep_programs(self.programs)
            if self.owner != (os.getpid(), _HERE):  # and not threads of that process
                files.writer = f"{self.owner[0]}-{uuid.uuid4().hex[:8]}"
            if not self.state.exists():
                raise FileNotFoundError(
                    f"{self.state.parent}: {worker} does not see this folder, in which workers "
                    "find what they need; they have to see it under this name."
                )
            with self.state.open("rb") as file:
                _HELD[self.state] = pickle.load(file)
        return _HELD[self.state]


def raised_in(error: BaseException) -> tuple[str, bool]:
    """Return the package where an error arose, in any process; True if its own code raised it."""
    if (known := getattr(error, "raised_in", None)) is not None:
        return known
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return "", False
    package = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
    return package, trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


def processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


class Processes(Executor):
    """Processes of this machine that share its processors; if one dies, all are replaced once.

    They end with the process that has started them, however it ends, and do not hear Ctrl-C. A
    script has to start them under `if __name__ == "__main__":`, as for `multiprocessing`.
    """

    def __init__(self, count: int) -> None:
        if count < 1:
            raise ValueError(f"Argument `count` must be at least 1, but is {count}.")
        self._count, self._renewed = count, False
        self._threads = dict.fromkeys(THREADS, str(max(1, processors() // count)))
        self._begin()

    def _begin(self) -> None:
        ended, self._running = multiprocessing.Pipe(duplex=False)
        context = multiprocessing.get_context("spawn")  # one that is forked after JAX ran hangs
        self._pool = ProcessPoolExecutor(self._count, context, _attend, (ended,))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **options: Any) -> Future[Any]:
        """Call a function in one of the processes, which are started when they are needed."""
        # A process inherits the variables and the signals that are blocked.
        before = {name: os.environ.get(name) for name in THREADS}
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        os.environ.update(self._threads)
        try:
            return self._pool.submit(fn, *args, **options)
        except BrokenExecutor:
            if self._renewed:
                raise
            self._renewed = True
            self.shutdown()
            self._begin()
            return self._pool.submit(fn, *args, **options)
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """End the processes, and with them what they do."""
        self._running.close()
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


def _attend(ended: Connection) -> None:
    """End this process when the other end of a pipe is closed, by intent or by a death."""

    def watch() -> None:
        wait([ended])
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
    return_memory()


def workers_of(
    text: str | None, note: Callable[[str], None] = lambda sentence: None
) -> contextlib.AbstractContextManager[Executor | None]:
    """Return the executor that `--workers` names: a number of processes, or the address of Dask.

    To be entered by `with`, which gives None for None. `note` is called with sentences for the
    user. ValueError if it is neither, Dask is not installed or its workers have another version;
    ConnectionError if no scheduler answers.
    """
    if text is None:
        return contextlib.nullcontext()
    if "://" in text:
        return _cluster(text, note)
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(
            f"--workers {text}: must be a number of processes, at least 1, or the address of a "
            "Dask scheduler, tcp://host:port."
        )
    if int(text) > (most := processors()):
        note(f"--workers {text}: more than the {most} processors there are.")
    return Processes(int(text))


@contextlib.contextmanager
def _cluster(address: str, note: Callable[[str], None]) -> Iterator[Executor]:
    """Yield the executor of a Dask cluster, whose workers are checked."""
    try:
        from distributed import Client
        from distributed.comm.registry import get_backend
    except ImportError:
        raise ValueError(
            f"--workers {address}: takes Dask, which is missing: pip install 'jaxsky[dask]'."
        ) from None
    # What these have to say is said here.
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        get_backend(address.partition("://")[0])
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConnectionError(
            f"--workers {address}: no Dask scheduler answers there ({error})."
        ) from None
    try:
        here = _versions()
        found = {
            name: client.run(pkgutil.resolve_name, f"{name}:__version__", on_error="return")
            for name in here
        }
        for worker in found["jaxsky"]:
            _check_versions(worker, {name: each[worker] for name, each in found.items()}, here)
        if not found["jaxsky"]:
            note(f"--workers {address}: there are no workers yet; they are waited for.")
        yield client.get_executor(pure=False)
    finally:
        with contextlib.suppress(Exception):  # a scheduler that is lost cannot be told
            client.close()
