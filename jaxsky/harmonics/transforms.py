"""Synthesis, analysis and rotation: ducc0 through jaxbind, inside jit and with gradients.

Coefficients are packed as real numbers: for each m the a_lm of l = m ... lmax, real and imaginary
part times sqrt(2) for m > 0, so that the sum of squares of the packed numbers is the sum over all m
of |a_lm|^2.
"""

import atexit
import contextlib
import ctypes
import math
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
from jaxtyping import Array, ArrayLike, Float, Int

from jaxsky.checks import check_choice, check_double


def alm_ell(lmax: int) -> np.ndarray:
    """Multipole l of each packed coefficient, shape (alm,)."""
    ell, m = healpy.Alm.getlm(lmax)
    return np.concatenate([ell[m == 0], np.repeat(ell[m > 0], 2)])


def degrees(lmax: int) -> tuple[Array, Array, Array]:
    """l, m and part (0 real, 1 imaginary) of each packed coefficient, computed in the program.

    As a constant of a program they would be as large as the coefficients.
    """
    i = jnp.arange((lmax + 1) ** 2)
    pair, part = jnp.divmod(jnp.maximum(i - (lmax + 1), 0), 2)
    # Counted from the end, m = lmax has one pair, lmax - 1 two, ...: triangular numbers.
    back = lmax * (lmax + 1) // 2 - 1 - pair
    length = jnp.floor((1 + jnp.sqrt(1.0 + 8 * back)) / 2).astype(i.dtype)
    ell = lmax - (back - length * (length - 1) // 2)
    zonal = i <= lmax
    return jnp.where(zonal, i, ell), jnp.where(zonal, 0, lmax + 1 - length), part


def lmax_of(alm: Array | np.ndarray) -> int:
    """Largest multipole of packed coefficients."""
    return math.isqrt(alm.shape[-1]) - 1


@jax.jit
def expand(values: Float[Array, "... ell"]) -> Float[Array, "... alm"]:
    """A function of l = 0 ... lmax at each packed coefficient."""
    return values[..., degrees(values.shape[-1] - 1)[0]]


@partial(jax.jit, static_argnames="lmax")
def resize(alm: Float[Array, "... alm"], lmax: int) -> Float[Array, "... alm"]:
    """Packed coefficients cut at another lmax, or filled up with zeros."""
    own = lmax_of(alm)
    ell, m, part = degrees(lmax)
    pairs = (m - 1) * (own + 1) - m * (m - 1) // 2 + ell - m
    index = jnp.where(m == 0, ell, own + 1 + 2 * pairs + part)
    return jnp.where(ell <= own, alm[..., jnp.where(ell <= own, index, 0)], 0)


@jax.jit
def power_spectrum(
    alm: Float[Array, "... alm"], other: Float[Array, "... alm"] | None = None
) -> Float[Array, "... ell"]:
    """Spectrum C_l of packed coefficients, or the cross-spectrum with others, row by row."""
    lmax = lmax_of(alm)
    product = (alm * (alm if other is None else other)).reshape(-1, alm.shape[-1])
    ell = degrees(lmax)[0]
    sums = jax.vmap(lambda row: jnp.zeros(lmax + 1, row.dtype).at[ell].add(row))(product)
    return sums.reshape(*alm.shape[:-1], -1) / (2 * jnp.arange(lmax + 1) + 1)


def map_variance(spectrum: Float[Array | np.ndarray, " ell"]) -> float:
    """Variance of a pixel of maps that have a spectrum."""
    return float(np.sum((2 * np.arange(spectrum.size) + 1) * np.asarray(spectrum)) / (4 * np.pi))


def alm_from_healpy(alm: np.ndarray, lmax: int) -> Float[np.ndarray, "... alm"]:
    """healpy's complex coefficients as packed real ones, along the last axis."""
    alm = np.asarray(alm, dtype=complex)
    high = np.sqrt(2) * alm[..., lmax + 1 :]
    pairs = np.stack([high.real, high.imag], axis=-1).reshape(*alm.shape[:-1], -1)
    return np.concatenate([alm[..., : lmax + 1].real, pairs], axis=-1)


def alm_to_healpy(alm: ArrayLike, lmax: int) -> np.ndarray:
    """Packed real coefficients as healpy's complex ones, along the last axis."""
    alm = np.asarray(alm, dtype=float)
    pairs = alm[..., lmax + 1 :] / np.sqrt(2)
    return np.concatenate([alm[..., : lmax + 1], pairs[..., ::2] + 1j * pairs[..., 1::2]], axis=-1)


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
        check_choice(name, value, COORDINATES)
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
