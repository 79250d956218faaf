"""Spherical harmonic synthesis and analysis by ducc0, inside jit and with gradients.

Coefficients are packed as real numbers: for each m the a_lm of l = m ... lmax, and for m > 0 their
real and imaginary parts times sqrt(2), so that the sum of squares of the packed numbers is the sum
of |a_lm|^2 over all m.
"""

import atexit
import contextlib
import ctypes
import math
import os
import threading
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.arrays import Alm, StokesMaps
from jaxsky.checks import check_double
from jaxsky.harmonics import primitives


def alm_ell(lmax: int) -> np.ndarray:
    """Return the multipole l of each packed coefficient, shape (alm,)."""
    ell, m = healpy.Alm.getlm(lmax)
    return np.concatenate([ell[m == 0], np.repeat(ell[m > 0], 2)])


def degrees(lmax: int) -> tuple[Array, Array, Array]:
    """Return l, m and part (0 real, 1 imaginary) of each packed coefficient."""
    # Computed inside the program: as constants they would be as large as the coefficients.
    i = jnp.arange((lmax + 1) ** 2)
    pair, part = jnp.divmod(jnp.maximum(i - (lmax + 1), 0), 2)
    # Counted from the end, m = lmax has one pair, m = lmax - 1 two, ...: triangular numbers.
    back = lmax * (lmax + 1) // 2 - 1 - pair
    length = jnp.floor((1 + jnp.sqrt(1.0 + 8 * back)) / 2).astype(i.dtype)
    ell = lmax - (back - length * (length - 1) // 2)
    zonal = i <= lmax
    return jnp.where(zonal, i, ell), jnp.where(zonal, 0, lmax + 1 - length), part


def lmax_of(alm: Array | np.ndarray) -> int:
    """Return the largest multipole of packed coefficients."""
    return math.isqrt(alm.shape[-1]) - 1


@jax.jit
def expand(values: Float[Array, "... ell"]) -> Float[Array, "... alm"]:
    """Return the values of a function of l = 0 ... lmax at each packed coefficient."""
    return values[..., degrees(values.shape[-1] - 1)[0]]


@partial(jax.jit, static_argnames="lmax")
def resize(alm: Float[Array, "... alm"], lmax: int) -> Float[Array, "... alm"]:
    """Cut packed coefficients at another lmax, or pad them with zeros."""
    own = lmax_of(alm)
    ell, m, part = degrees(lmax)
    pairs = (m - 1) * (own + 1) - m * (m - 1) // 2 + ell - m
    index = jnp.where(m == 0, ell, own + 1 + 2 * pairs + part)
    return jnp.where(ell <= own, alm[..., jnp.where(ell <= own, index, 0)], 0)


@jax.jit
def power_spectrum(
    alm: Float[Array, "... alm"], other: Float[Array, "... alm"] | None = None
) -> Float[Array, "... ell"]:
    """Return C_l of packed coefficients, or the cross-spectrum with others, row by row."""
    lmax = lmax_of(alm)
    product = (alm * (alm if other is None else other)).reshape(-1, alm.shape[-1])
    ell = degrees(lmax)[0]
    sums = jax.vmap(lambda row: jnp.zeros(lmax + 1, row.dtype).at[ell].add(row))(product)
    return sums.reshape(*alm.shape[:-1], -1) / (2 * jnp.arange(lmax + 1) + 1)


def map_variance(spectrum: Float[Array | np.ndarray, " ell"]) -> float:
    """Return the variance of a pixel in maps with a given spectrum."""
    return float(np.sum((2 * np.arange(spectrum.size) + 1) * np.asarray(spectrum)) / (4 * np.pi))


def alm_from_healpy(alm: np.ndarray, lmax: int) -> Float[np.ndarray, "... alm"]:
    """Convert healpy's complex coefficients to packed real ones, along the last axis."""
    alm = np.asarray(alm, dtype=complex)
    high = np.sqrt(2) * alm[..., lmax + 1 :]
    pairs = np.stack([high.real, high.imag], axis=-1).reshape(*alm.shape[:-1], -1)
    return np.concatenate([alm[..., : lmax + 1].real, pairs], axis=-1)


def alm_to_healpy(alm: ArrayLike, lmax: int) -> np.ndarray:
    """Convert packed real coefficients to healpy's complex ones, along the last axis."""
    alm = np.asarray(alm, dtype=float)
    pairs = alm[..., lmax + 1 :] / np.sqrt(2)
    return np.concatenate([alm[..., : lmax + 1], pairs[..., ::2] + 1j * pairs[..., 1::2]], axis=-1)


def _by_spin(transform: Callable[..., Any], rows: Array, spin: int, **how: Any) -> Array:
    """Transform the rows I, or Q, U (or E, B), or both: the first is scalar, two have a spin."""
    scalar, polarized = (slice(0, 1), 0), (slice(-2, None), spin)
    blocks = {1: [scalar], 2: [polarized], 3: [scalar, polarized]}[len(rows)]
    return jnp.concatenate([transform(rows[block], spin=s, **how)[0] for block, s in blocks])


def _transform(alm: Alm, nside: int, spin: int, weighted: bool) -> StokesMaps:
    """Return the maps of coefficients, each ring times its weight if `weighted`."""
    check_double("A spherical harmonic transform")
    _finish_at_exit()
    how = {"nside": nside, "lmax": lmax_of(alm), "weighted": weighted}
    return _by_spin(primitives.synthesis, alm, spin, **how)


def _transposed(maps: StokesMaps, lmax: int, spin: int = 2, weighted: bool = False) -> Alm:
    nside = healpy.npix2nside(maps.shape[-1])
    alm = jax.ShapeDtypeStruct((maps.shape[0], (lmax + 1) ** 2), maps.dtype)
    forward = partial(_transform, nside=nside, spin=spin, weighted=weighted)
    return jax.linear_transpose(forward, alm)(maps)[0]


@partial(jax.jit, static_argnames=("nside", "spin"))
def synthesis(alm: Alm, nside: int, spin: int = 2) -> StokesMaps:
    """Return maps of I, or Q, U, or I, Q, U from packed coefficients I, or E, B, or I, E, B.

    With lmax > 3 nside - 1 the maps are undersampled. `spin` is that of the last two rows.
    """
    return _transform(alm, nside, spin, weighted=False)


@partial(jax.jit, static_argnames="lmax")
def adjoint_synthesis(maps: StokesMaps, lmax: int) -> Alm:
    """Apply the transpose of `synthesis`: inner products of maps with the spherical harmonics."""
    return _transposed(maps, lmax)


@partial(jax.jit, static_argnames=("lmax", "iterations", "spin"))
def analysis(maps: StokesMaps, lmax: int, iterations: int | None = None, spin: int = 2) -> Alm:
    """Return packed coefficients of maps of I, or Q, U, or I, Q, U: the inverse of `synthesis`.

    Uses ring-weighted quadrature, refined by Jacobi steps on the residual map. For a map without
    multipoles above lmax <= 2 nside the rms error is below 1e-6 of the rms coefficient, and about
    1e-7 at nside 512; for higher lmax no number of steps (`iterations`) suffices. By default there
    is one step up to lmax = 1.5 nside and two above, plus one below nside 128, where the
    quadrature is worse. Maps are in RING order, lmax at most 3 nside - 1.
    """
    nside = healpy.npix2nside(maps.shape[-1])
    if iterations is None:
        iterations = 1 + (2 * lmax > 3 * nside) + (nside < 128)
    alm = _transposed(maps, lmax, spin, weighted=True)
    if not iterations:
        return alm
    how = {"nside": nside, "lmax": lmax, "iterations": iterations}
    return _by_spin(primitives.refined, alm, spin, **how)


# Ending a Python process in which transforms may still run.

#: Linux's record of each thread of this process; on other systems, threads are not unwound.
_THREADS = Path("/proc/self/task")


@cache
def _finish_at_exit() -> None:
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
