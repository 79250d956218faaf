"""Primitives of JAX for ducc's transforms, with exact transposes: group by group of rings.

Only the Fourier coefficients of one group of rings are in memory, next to maps and coefficients;
those of all rings would take more than a map. Coefficients are packed as in `jaxsky.harmonics`.
"""

import atexit
import contextlib
import ctypes
import math
import os
import pickle
import threading
import time
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import ducc0
import healpy
import jax
import numpy as np
from astropy.io import fits as pyfits
from jax.interpreters import mlir
from jaxbind import get_linear_call, jaxbind, load_kwargs
from jaxbind.contrib.jaxducc0 import _alm2realalm, _realalm2alm
from jaxtyping import Array

#: Rings are transformed in groups whose Fourier coefficients take as many bytes at most.
GROUP = 1 << 27


def _lower(ctx: Any, *operands: Any, **parameters: Any) -> Any:
    """Lower a transform, and tell JAX that it calls Python, so that it is not cached on disk."""
    # jaxbind writes the address of a Python object into the program: another one elsewhere.
    ctx.module_context.add_host_callback(lambda *_: ())
    return jaxbind._lowering(ctx, *operands, **parameters)


def _through_callback(*operands: Any, _func: Any, **parameters: Any) -> Any:
    """Call a function of jaxbind, whose gradients and batches stay, on the host of a GPU."""
    found = jaxbind._exec_abstract(*operands, _func=_func, **parameters)
    shapes = [jax.ShapeDtypeStruct(one.shape, one.dtype) for one in found]
    if _func.can_batch:
        parameters["batch_axes"] = _func.batch_axes
    dump = np.frombuffer(pickle.dumps(parameters), dtype=np.uint8)

    def call(*arrays: Array) -> list[np.ndarray]:
        out = [np.empty(shape.shape, shape.dtype) for shape in shapes]
        _func.f(tuple(out), tuple(map(np.asarray, arrays)), dump)
        return out

    return jax.pure_callback(call, shapes, *operands)


#: How a transform is lowered on an accelerator; jaxbind's own way needs a function for CUDA that
#: its packages do not have.
_lower_callback = mlir.lower_fun(_through_callback, multiple_results=True)

mlir.register_lowering(jaxbind._prim, _lower, platform="cpu")
mlir.register_lowering(jaxbind._prim, _lower_callback, platform="gpu")


@cache
def _ring_weights(nside: int) -> np.ndarray:
    """Return healpy's ring weights times the area of a pixel [sr], shape (ring,)."""
    path = files("healpy") / "data" / f"weight_ring_n{nside:05d}.fits"
    with path.open("rb") as stream, pyfits.open(stream) as hdus:
        north = 1 + hdus[1].data.field(0).astype(float).ravel()
    return np.concatenate([north, north[-2::-1]]) * healpy.nside2pixarea(nside)


@cache
def _groups(nside: int, lmax: int, spin: int, size: int, weighted: bool) -> list[dict[str, Any]]:
    """Return groups of rings, each symmetric about the equator, as arguments of ducc."""
    geometry = ducc0.healpix.Healpix_Base(nside, "RING").sht_info()
    if weighted:
        geometry["ringfactor"] = _ring_weights(nside)
    # Each ring has coefficients of this size [bytes] at each m.
    number = math.ceil((4 * nside - 1) * (lmax + 1) * size / GROUP)
    shared = {"lmax": lmax, "mmax": lmax, "spin": spin, "nthreads": 0}
    groups = []
    for north in np.array_split(np.arange(2 * nside), number):
        rings = np.union1d(north, 4 * nside - 2 - north)
        groups.append(shared | {key: values[rings] for key, values in geometry.items()})
    return groups


def _unpacked(alm: np.ndarray, lmax: int) -> np.ndarray:
    return _realalm2alm(alm, lmax, np.result_type(alm.dtype, np.complex64))


def _inner_products(maps: Iterable[np.ndarray], groups: Iterable[dict[str, Any]]) -> np.ndarray:
    """Return the sum over groups of rings of their inner products with the harmonics."""
    total: Any = None
    for values, rings in zip(maps, groups, strict=True):
        one = ducc0.sht.adjoint_synthesis(map=values, **rings)
        total = one if total is None else np.add(total, one, out=total)
    return total


def _synthesise(out, args, kwargs_dump):
    """Write the maps of packed coefficients."""
    how = load_kwargs(kwargs_dump)
    alm = _unpacked(args[0], how["lmax"])
    for rings in _groups(**how, size=len(alm) * alm.itemsize):
        ducc0.sht.synthesis(map=out[0], alm=alm, **rings)


def _synthesise_transposed(out, args, kwargs_dump):
    """Write the inner products of maps with the harmonics."""
    how, (maps,) = load_kwargs(kwargs_dump), args
    groups = _groups(**how, size=2 * len(maps) * maps.itemsize)
    alm = _inner_products([maps] * len(groups), groups)
    _alm2realalm(alm, how["lmax"], maps.dtype, out[0])


def _refine(out, args, kwargs_dump):
    """Write coefficients after Jacobi steps, given the weighted inner products of the maps.

    With Y the synthesis and W the weights, a step adds given - Y^T W Y alm; the sum of the steps
    is symmetric. Of the maps Y alm there is one group of rings at a time.
    """
    how, (given,), (alm,) = dict(load_kwargs(kwargs_dump)), args, out
    iterations, lmax = how.pop("iterations"), how["lmax"]
    groups = _groups(**how, weighted=True, size=2 * len(alm) * alm.itemsize)
    alone = [rings | {"ringstart": np.cumsum(rings["nphi"]) - rings["nphi"]} for rings in groups]
    plain = [{key: rings[key] for key in rings if key != "ringfactor"} for rings in alone]
    alm[:] = given
    for _ in range(iterations):
        found = _unpacked(alm, lmax)
        change = _inner_products((ducc0.sht.synthesis(alm=found, **r) for r in plain), alone)
        change = _alm2realalm(change, lmax, alm.dtype)
        alm += np.subtract(given, change, out=change)
        del found, change  # or they would be there twice in the next step


def _pixels(alm, *, nside, **_):
    return (((alm.shape[0], 12 * nside**2), alm.dtype),)


def _coefficients(maps, *, lmax, **_):
    return (((maps.shape[0], (lmax + 1) ** 2), maps.dtype),)


def _same(alm, **_):
    return ((alm.shape, alm.dtype),)


#: Maps of coefficients, each ring times its weight if `weighted`, the transpose, and Jacobi steps.
synthesis = get_linear_call(_synthesise, _synthesise_transposed, _pixels, _coefficients)
adjoint_synthesis = get_linear_call(_synthesise_transposed, _synthesise, _coefficients, _pixels)
refined = get_linear_call(_refine, _refine, _same, _same)


# Ending a Python process in which transforms may still run.

#: Linux's record of each thread of this process; on other systems, threads are not unwound.
_THREADS = Path("/proc/self/task")


@cache
def finish_at_exit() -> None:
    """Make the interpreter wait at exit for transforms that are still running.

    JAX returns before a computation is done. A transform is Python code called by a thread of JAX.
    If that thread asks for the interpreter while it shuts down, Python unwinds the thread through
    C++ frames that do not allow it, and the process aborts ("terminate called without an active
    exception", exit code 134).
    """
    atexit.register(_finish)  # handlers run in reverse order, so this one before JAX's own


def _finish() -> None:
    """Wait for the computations of this thread, then for those of others."""
    # JAX runs the computations of a thread on a device one after the other, even those whose
    # results were dropped; only the cheapest skip the queue, and none that calls Python.
    last = jax.jit(lambda: jax.pure_callback(lambda: np.int32(0), np.int32(0)))
    for platform in {jax.default_backend(), "cpu"}:
        with contextlib.suppress(Exception):
            for device in jax.local_devices(backend=platform):
                with jax.default_device(device):
                    last().block_until_ready()
    daemons = [thread for thread in threading.enumerate() if thread.daemon]
    if _THREADS.is_dir() and not _calm(seconds=1.0 if daemons else 60.0):
        for thread in daemons:  # they end where they next run Python code
            ident, error = ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, error)
        _calm(seconds=10.0)


def _calm(seconds: float) -> bool:
    """Wait until no other thread computes; False if some still do after `seconds`."""
    end, looks = time.monotonic() + seconds, 0
    while looks < 5 and time.monotonic() < end:  # a thread may just have waited for this one
        time.sleep(0.003)
        looks = 0 if _computing() else looks + 1
    return looks == 5


def _computing() -> bool:
    """Whether a thread other than this one runs or waits for a processor."""
    own = str(threading.get_native_id())
    for thread in set(os.listdir(_THREADS)) - {own}:
        with contextlib.suppress(OSError):  # it has just ended
            state = (_THREADS / thread / "stat").read_text().rpartition(")")[2].split()[0]
            if state in "RD":
                return True
    return False
