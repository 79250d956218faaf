"""Synthesis, analysis and rotation: ducc0 through jaxbind, inside jit and with gradients."""

import atexit
import contextlib
import ctypes
import os
import threading
import time
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import ducc0
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits
from jax.interpreters import mlir
from jaxbind import get_linear_call, jaxbind, load_kwargs
from jaxbind.contrib.jaxducc0 import get_healpix_sht
from jaxtyping import Array, Float, Int

from jaxsky.checks import check_double
from jaxsky.harmonics.packing import alm_from_healpy, alm_to_healpy, lmax_of

#: Coordinates between which coefficients are rotated.
COORDINATES = ("G", "E", "C")


def _lower(ctx: Any, *operands: Any, **parameters: Any) -> Any:
    """Lower a transform, and say that it calls Python: JAX keeps no such program on disk.

    jaxbind writes the address of a Python object into the program, which is another one in the
    next process, where something else may be at this place.
    """
    ctx.module_context.add_host_callback(lambda *_: ())
    return jaxbind._lowering(ctx, *operands, **parameters)


mlir.register_lowering(jaxbind._prim, _lower, platform="cpu")


@cache
def _ring_weights(nside: int) -> np.ndarray:
    """healpy's ring weights times the area of a pixel [sr], shape (ring,)."""
    path = files("healpy") / "data" / f"weight_ring_n{nside:05d}.fits"
    with path.open("rb") as stream, pyfits.open(stream) as hdus:
        north = 1 + hdus[1].data.field(0).astype(float).ravel()
    return np.concatenate([north, north[-2::-1]]) * healpy.nside2pixarea(nside)


def _rings(nside: int) -> Int[Array, " pix"]:
    """Ring of each pixel, from 0, computed in the program: a constant would be a map."""
    npix, cap = 12 * nside**2, 2 * nside * (nside - 1)
    pixel = jnp.arange(npix)
    mirrored = jnp.minimum(pixel, npix - 1 - pixel)
    ring = jnp.floor((jnp.sqrt(1.0 + 2 * mirrored) + 1) / 2).astype(pixel.dtype) - 1
    ring = jnp.where(pixel < npix // 2, ring, 4 * nside - 2 - ring)
    belt = (pixel >= cap) & (pixel < npix - cap)
    return jnp.where(belt, (pixel - cap) // (4 * nside) + nside - 1, ring)


def _blocks(stokes: int, spin: int) -> list[tuple[slice, int]]:
    """Rows of I, of Q, U or of I, Q, U maps that are transformed together, with their spin."""
    scalar, polarized = (slice(0, 1), 0), (slice(stokes - 2, stokes), spin)
    return {1: [scalar], 2: [polarized], 3: [scalar, polarized]}[stokes]


@cache
def _transform(nside: int, lmax: int, spin: int):
    # jaxbind passes the geometry of the rings as 64-bit numbers, whatever the maps are.
    check_double("A spherical harmonic transform")
    _finish_at_exit()
    return get_healpix_sht(nside, lmax, lmax, spin, nthreads=0)


@partial(jax.jit, static_argnames=("nside", "spin"))
def synthesis(
    alm: Float[Array, "stokes alm"], nside: int, spin: int = 2
) -> Float[Array, "stokes pix"]:
    """Maps I, or Q, U, or I, Q, U from packed coefficients I, or E, B, or I, E, B.

    Above lmax = 3 nside - 1 the maps are samples. `spin` is that of the last two rows.
    """
    lmax = lmax_of(alm)
    return jnp.concatenate(
        [_transform(nside, lmax, s)(alm[rows])[0] for rows, s in _blocks(len(alm), spin)]
    )


@partial(jax.jit, static_argnames=("lmax", "spin"))
def adjoint_synthesis(
    maps: Float[Array, "stokes pix"], lmax: int, spin: int = 2
) -> Float[Array, "stokes alm"]:
    """Transpose of `synthesis`: inner products of maps with the spherical harmonics."""
    nside = healpy.npix2nside(maps.shape[-1])
    empty = jax.ShapeDtypeStruct((len(maps), (lmax + 1) ** 2), maps.dtype)
    return jax.linear_transpose(partial(synthesis, nside=nside, spin=spin), empty)(maps)[0]


@partial(jax.jit, static_argnames=("lmax", "iterations", "spin"))
def analysis(
    maps: Float[Array, "stokes pix"],
    lmax: int,
    iterations: int | None = None,
    spin: int = 2,
) -> Float[Array, "stokes alm"]:
    """Packed coefficients of maps I, or Q, U, or I, Q, U: the inverse of `synthesis`.

    Ring-weighted quadrature, refined by Jacobi steps on the residual map. For a map without
    multipoles above lmax the rms error is below 1e-6 of the rms coefficient up to lmax = 2 nside,
    at nside 512 about 1e-7; above, no number of steps (`iterations`) is enough. There are by
    default one up to lmax = 1.5 nside and two above, and one more below nside 128, where the
    quadrature is worse. Maps are in RING order, lmax at most 3 nside - 1.
    """
    nside = healpy.npix2nside(maps.shape[-1])
    if iterations is None:
        iterations = 1 + (2 * lmax > 3 * nside) + (nside < 128)
    weights = jnp.asarray(_ring_weights(nside), maps.dtype)[_rings(nside)]
    alm = adjoint_synthesis(weights * maps, lmax, spin)
    for _ in range(iterations):
        residual = maps - synthesis(alm, nside, spin=spin)
        alm = alm + adjoint_synthesis(weights * residual, lmax, spin)
    return alm


def _turn(out, args, kwargs_dump, inverse=False):
    lmax, angles = (load_kwargs(kwargs_dump)[key] for key in ("lmax", "angles"))
    if inverse:
        angles = [-angle for angle in reversed(angles)]
    alm = ducc0.sht.rotate_alm(alm_to_healpy(args[0], lmax), lmax, *angles, nthreads=0)
    out[0][:] = alm_from_healpy(alm, lmax)


def _same(alm, **_):
    return ((alm.shape, alm.dtype),)


# A rotation keeps the norm, so its transpose is its inverse.
_rotation = get_linear_call(_turn, partial(_turn, inverse=True), _same, _same)


@partial(jax.jit, static_argnames=("source", "target"))
def rotate(alm: Float[Array, "stokes alm"], source: str, target: str) -> Float[Array, "stokes alm"]:
    """Packed coefficients in other coordinates; those of polarization as scalars E and B.

    These are "G" Galactic, "E" ecliptic or "C" celestial (equatorial), both J2000.
    """
    for name, value in {"source": source, "target": target}.items():
        if value not in COORDINATES:
            known = ", ".join(COORDINATES)
            raise ValueError(f"Argument `{name}` must be one of {known}, not {value!r}.")
    check_double("A rotation")
    _finish_at_exit()
    angles = tuple(map(float, healpy.rotator.coordsys2euler_zyz((source, target))))
    return _rotation(alm, lmax=lmax_of(alm), angles=angles)[0]


# The end of a Python process in which transforms run.

#: What Linux says of each thread of this process; elsewhere, threads are not unwound.
_THREADS = Path("/proc/self/task")


@cache
def _finish_at_exit() -> None:
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
    if _THREADS.is_dir() and not _calm(seconds=1.0 if daemons else 60.0):
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
    for thread in set(os.listdir(_THREADS)) - {own}:
        with contextlib.suppress(OSError):  # it has just ended
            state = (_THREADS / thread / "stat").read_text().rpartition(")")[2].split()[0]
            if state in "RD":
                return True
    return False


def _end(thread: threading.Thread) -> None:
    """Have a thread end where it next runs Python code, which is now or never."""
    ident, error = ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, error)
