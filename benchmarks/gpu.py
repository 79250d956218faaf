"""An accelerator next to a copy in its own memory, and its numbers next to those of the CPU.

`python -m benchmarks.gpu` is made to take minutes on a GPU with 80 GB, and has not been run on one
yet. It prints what is measured and what is asked, and ends with exit code 1 if something is missed.
`--nside 64` tries it on any machine: then, and on CPUs, only wrong numbers are a miss, and there is
no verdict on speed. What is timed has been compiled before.
"""

import argparse
import datetime as dt
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from benchmarks.separation_runs import (
    NAMES,
    START,
    TRUTH,
    UNIT,
    litebird,
    maps_in_memory,
    white_sky,
)
from benchmarks.table import Row, rich_table, time_text
from benchmarks.timing import interleave, seconds
from fits.optimize import best_fit
from fits.posterior import value_and_gradient
from fits.profile_likelihood import spectral_likelihood
from fits.results import FitResult
from fits.separated_maps import ComponentMaps, component_maps
from jaxsky import Bandpass, Dust, Sky, observe
from jaxsky.harmonics import gaussian_beam, resample
from jaxsky.sky import interpolation_nodes

NSIDE = 2048
#: Ranges of the maps of PySM's model d1.
BETA_RANGE, T_RANGE = (1.25, 1.80), (14.0, 31.0)
#: Share of the bandwidth of a copy that band averages are to reach, and seconds of a separation.
SHARE, LIMIT = 0.7, 1.0
#: Largest relative differences from the CPU: of maps, by type, and of likelihoods; and of
#: parameters in standard deviations.
ACCURACY = {np.float64: 1e-10, np.float32: 1e-5}
LIKELIHOOD, PARAMETERS = 1e-10, 1e-6
#: Calls of which the device may begin one before another has ended, so that launching is hidden.
CALLS = 5


def _cpu() -> jax.Device:
    return jax.devices("cpu")[0]


def _verdict(right: bool, fast: bool, trial: bool) -> bool | None:
    """Whether a row is passed; None, for no verdict, in a trial whose numbers are right."""
    return None if trial and right else right and fast


def _uniform(number: int, low: float, high: float, npix: int, dtype: Any) -> jax.Array:
    """A map of random numbers that reaches both ends of its range."""
    unit = jax.random.uniform(jax.random.key(number), (npix,), dtype)
    return low + (high - low) * unit.at[:2].set(jnp.array([0, 1], dtype))


def _sky(npix: int, dtype: Any) -> Sky:
    """Dust with maps of index and temperature."""
    amplitude = jax.random.normal(jax.random.key(1), (2, npix), dtype)
    beta_dust, T_dust = _uniform(2, *BETA_RANGE, npix, dtype), _uniform(3, *T_RANGE, npix, dtype)
    return Sky({"dust": Dust(amplitude, beta_dust, T_dust, nu_ref=353.0)})


def _several(function: Callable[[], Any]) -> Callable[[], Any]:
    def repeated() -> Any:
        for _ in range(CALLS):
            result = function()
        return result

    return repeated


def band_average(nside: int, dtype: Any, trial: bool) -> Row:
    """A band of 30 samples, maps of index and temperature, next to a copy of as many bytes."""
    npix = 12 * nside**2
    band = Bandpass(np.linspace(300.0, 410.0, 30), np.hanning(32)[1:-1], "power")
    # All numbers, as one in double precision makes the maps double.
    sky, band = jax.tree.map(lambda x: x.astype(dtype), (_sky(npix, dtype), band))
    nodes = interpolation_nodes(sky, [band], ACCURACY[dtype])
    # Four maps are read and two written, or three and three.
    copied, copy = jnp.ones((3, npix), dtype), jax.jit(jnp.copy)

    def ours() -> jax.Array:
        return observe(sky, [band], nodes=nodes)

    found = ours()
    assert found.dtype == dtype
    part = slice(0, max(npix // 64, 192))
    few = jax.device_put(jax.tree.map(lambda x: x[..., part] if x.ndim else x, sky), _cpu())
    expected = np.asarray(observe(few, [band], tolerance=0))
    error = float(np.abs(np.asarray(found[..., part]) / expected - 1).max())
    del found
    jax.block_until_ready(copy(copied))
    calls = {"ours": _several(ours), "copy": _several(lambda: copy(copied))}
    times = interleave(calls, 2 if trial else 7)
    share, moved = times.ratio("copy", "ours"), 6 * npix * np.dtype(dtype).itemsize
    speeds = {name: moved * CALLS / times[name] / 1e9 for name in calls}
    return Row(
        f"band average, 30 samples, maps of beta and T, nside {nside}, {np.dtype(dtype).name}",
        f"{share:.0%} of a copy's bandwidth",
        f">= {SHARE:.0%}",
        _verdict(error <= ACCURACY[dtype], share >= SHARE, trial),
        f"{time_text(times['ours'] / CALLS)}, {speeds['ours']:.0f} GB/s; copy "
        f"{speeds['copy']:.0f} GB/s; {nodes[0].counts if nodes[0] else 'no'} nodes; differs from "
        f"the CPU's direct sum by {error:.0e} (<= {ACCURACY[dtype]:.0e})",
    )


def pixel_likelihood(nside: int, trial: bool) -> Row:
    """A spectral likelihood with noise of each pixel, and its gradient."""
    bands, sigma = litebird(nside)
    data, laws = maps_in_memory(nside), white_sky(1, np.random.default_rng(0))
    noise = sigma[:, None, None] * np.random.default_rng(2).uniform(0.5, 2.0, data.shape)
    like = spectral_likelihood(laws, bands, data, noise, START, unit=UNIT)
    theta = jnp.array([TRUTH[name] for name in NAMES])
    moved = sum(leaf.nbytes for leaf in jax.tree.leaves(like.pixels))
    copied, copy = jnp.ones(moved // 16), jax.jit(jnp.copy)

    def ours() -> Any:
        return value_and_gradient(like, theta)

    found = ours()
    expected = value_and_gradient(*jax.device_put((like, theta), _cpu()))
    error = max(map(_difference, found, expected))
    jax.block_until_ready(copy(copied))
    times = interleave({"ours": ours, "copy": lambda: copy(copied)}, 2 if trial else 7)
    return Row(
        f"likelihood and gradient, 15 bands, noise of each pixel, nside {nside}, float64",
        f"{times['ours'] / (2 * 12 * nside**2) * 1e9:.2g} ns a pixel of Q or U",
        f"as the CPU to {LIKELIHOOD:.0e}",
        error <= LIKELIHOOD,
        f"{time_text(times['ours'])}; a copy of as many bytes takes {time_text(times['copy'])}; "
        f"differs from the CPU by {error:.0e}",
    )


def _difference(found: jax.Array, expected: jax.Array) -> float:
    """Largest difference relative to the largest number."""
    found, expected = np.asarray(found), np.asarray(expected)
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def _separated(maps: jax.Array, nside: int) -> tuple[FitResult, ComponentMaps]:
    """Spectral parameters, and maps of CMB, dust and synchrotron."""
    bands, sigma = litebird(nside)
    laws = white_sky(1, np.random.default_rng(0))
    like = spectral_likelihood(laws, bands, maps, sigma, START, unit=UNIT)
    fit = best_fit(like)
    return fit, component_maps(like, fit.best_fit, maps, sigma, covariance=False)


def separation(nside: int, trial: bool) -> Row:
    """Maps on the device to parameters and maps of the components."""
    low = max(nside // 16, 8)
    few = jnp.asarray(maps_in_memory(low))
    fit, found = _separated(few, low)
    with jax.default_device(_cpu()):
        expected, wanted = _separated(jax.device_put(few, _cpu()), low)
    off = max(abs(fit.best_fit[n] - expected.best_fit[n]) / expected.sigma[n] for n in NAMES)
    error = _difference(found.amplitude, wanted.amplitude)
    maps = jnp.asarray(maps_in_memory(nside), jnp.float32)
    fit, _ = _separated(maps, nside)  # compiles
    deviation = max(abs(fit.best_fit[n] - TRUTH[n]) / fit.sigma[n] for n in NAMES)
    took = [seconds(lambda: _separated(maps, nside)) for _ in range(1 if trial else 5)]
    return Row(
        f"15 bands separated at nside {nside}, float32, maps on the device",
        time_text(min(took)),
        f"< {LIMIT:g} s",
        _verdict(off <= PARAMETERS and deviation < 5, min(took) < LIMIT, trial),
        f"three components; parameters within {deviation:.1f} sigma of the truth; at nside "
        f"{low} they differ from the CPU's by {off:.0e} sigma "
        f"(<= {PARAMETERS:.0e}), maps by {error:.0e} of the largest pixel",
    )


def smoothing(nside: int) -> Row:
    """A smoothing, which goes through the host."""
    maps = jax.random.normal(jax.random.key(4), (2, 12 * nside**2))
    window = gaussian_beam(60.0, 2 * nside)

    def smoothed(maps: jax.Array) -> jax.Array:
        return resample(maps, window, nside)

    found = smoothed(maps)
    error = _difference(found, smoothed(jax.device_put(maps, _cpu())))
    slope = jax.grad(lambda m: jnp.sum(smoothed(m) ** 2))(maps)
    error = max(error, float(abs(jnp.vdot(slope, maps) / (2 * jnp.sum(found**2)) - 1)))
    return Row(
        f"smoothing of Q, U, nside {nside}, by the host",
        time_text(seconds(lambda: smoothed(maps))),
        f"as the CPU to {LIKELIHOOD:.0e}",
        error <= LIKELIHOOD,
        f"values and gradient differ by {error:.0e}",
    )


def measured(nside: int, trial: bool) -> list[Row]:
    """Return all rows: band averages at a resolution and at twice that, the rest up to it."""
    ways = [(n, dtype) for n in (nside, 2 * nside) for dtype in ACCURACY]
    return [
        *(band_average(n, dtype, trial) for n, dtype in ways),
        pixel_likelihood(nside // 4, trial),
        separation(nside, trial),
        smoothing(nside // 2),
    ]


def main() -> None:
    parser = argparse.ArgumentParser("python -m benchmarks.gpu", description="Times on a GPU.")
    parser.add_argument("--nside", type=int, default=NSIDE, help=f"resolution, {NSIDE} by default")
    nside = parser.parse_args().nside
    jax.config.update("jax_enable_x64", True)
    (device, *_), console = jax.devices(), Console(width=None if sys.stdout.isatty() else 160)
    trial = nside < NSIDE or device.platform == "cpu"
    rows = measured(nside, trial)
    console.print(rich_table(rows))
    console.print(f"{device.device_kind}, jax {jax.__version__}, {dt.datetime.now(dt.UTC).date()}.")
    if trial:
        console.print("A trial: no verdicts on speed.")
    sys.exit(0 if all(row.met is not False for row in rows) else 1)


if __name__ == "__main__":
    main()
