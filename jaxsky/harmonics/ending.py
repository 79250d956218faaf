"""The end of a Python process in which transforms run."""

import atexit
import contextlib
import ctypes
import os
import threading
import time
from functools import cache
from pathlib import Path

import jax
import numpy as np

#: What Linux says of each thread of this process; elsewhere, threads are not unwound.
THREADS = Path("/proc/self/task")


@cache
def finish_at_exit() -> None:
    """Have the interpreter wait for transforms that still run when it ends.

    JAX returns before a computation is done. A transform is Python code that a thread of JAX
    calls, and a thread that asks for the interpreter while that ends is unwound by Python, through
    frames of C++ that do not allow it: the process aborts ("terminate called without an active
    exception", exit code 134).
    """
    atexit.register(_finish)  # handlers run in reverse order, so this one before JAX's own


def _finish() -> None:
    """Wait for the computations of this thread, then for those of others."""
    with contextlib.suppress(Exception), jax.default_device(jax.devices("cpu")[0]):
        # JAX runs the computations of a thread one after the other, those whose results nobody
        # has kept among them; only the cheapest skip the queue, and none that calls Python.
        jax.jit(lambda: jax.pure_callback(lambda: np.int32(0), np.int32(0)))().block_until_ready()
    daemons = [thread for thread in threading.enumerate() if thread.daemon]
    if THREADS.is_dir() and not _calm(seconds=1.0 if daemons else 60.0):
        for thread in daemons:
            _end(thread)
        _calm(seconds=10.0)


def _calm(seconds: float) -> bool:
    """Wait until no other thread computes; False if some still do after so many seconds."""
    end, looks = time.monotonic() + seconds, 0
    while looks < 5 and time.monotonic() < end:  # a thread may just have waited for this one
        time.sleep(0.003)
        looks = 0 if _computing() else looks + 1
    return looks == 5


def _computing() -> bool:
    """Whether a thread other than this one runs or waits for a processor."""
    own = str(threading.get_native_id())
    for thread in set(os.listdir(THREADS)) - {own}:
        with contextlib.suppress(OSError):  # it has just ended
            state = (THREADS / thread / "stat").read_text().rpartition(")")[2].split()[0]
            if state in "RD":
                return True
    return False


def _end(thread: threading.Thread) -> None:
    """Have a thread end where it next runs Python code, which is now or never."""
    ident, error = ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, error)
