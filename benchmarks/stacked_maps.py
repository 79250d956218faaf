"""Fit and separation of 15 bands whose maps lie on disk: time and memory against nside.

`python -m benchmarks.stacked_maps NSIDE uniform|pixel FOLDER` is one run in a process of its own.
The maps are those of a white sky, so that no transform is part of it.
"""

import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import healpy
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.separation_runs import litebird
from benchmarks.table import Row, time_text
from benchmarks.timing import usage
from fits import best_fit, component_maps, spectral_likelihood
from fits.compress import Noise
from fits.separated_maps import emission_maps
from jaxsky import CMB, Dust, Synchrotron, observe
from jaxsky.io import write_maps
from jaxsky.io.stacks import computed, empty, ranges, scratch
from jaxsky.programs import return_memory
from jaxsky.sky import Sky

START = {"dust.beta_dust": 1.6, "dust.T_dust": 19.0, "synchrotron.beta_syn": 3.0}
SIZES = (50.0, 100.0, 60.0)


def _laws() -> Sky:
    amplitudes = [jnp.full((2, 1), size) for size in SIZES]
    kinds = (CMB, Dust, Synchrotron)
    made = [kind(amplitude) for kind, amplitude in zip(kinds, amplitudes, strict=True)]
    return Sky(dict(zip(("cmb", "dust", "synchrotron"), made, strict=True)))


def run(nside: int, noise: str, folder: Path) -> dict[str, tuple[float, float]]:
    """Return seconds and peak memory [GiB] of each step."""
    jax.config.update("jax_enable_x64", True)
    return_memory()
    steps: dict[str, tuple[float, float]] = {}

    def timed(name: str, function: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        found = function()
        unit = 1 if sys.platform == "darwin" else 1024
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
        steps[name] = time.perf_counter() - start, peak
        print(json.dumps({name: steps[name]}), flush=True)
        return found

    bands, sigma = experiment = litebird(nside)
    npix, rng = healpy.nside2npix(nside), np.random.default_rng(0)
    factors = np.asarray(experiment.conversion)[:, None]
    laws = _laws()
    single = [
        np.asarray(observe(Sky({name: laws[name]}), list(bands.values())))[:, 0, 0] for name in laws
    ]
    matrix = np.stack(single, axis=1) * factors
    shape = (len(bands), 2, npix)

    def scatter(part: Any) -> np.ndarray:
        pixels = np.arange(part.start, part.stop) if isinstance(part, slice) else part
        # One of three patterns of hits, so that ratios of noise between bands vary.
        hits = [1 + 0.5 * np.cos(pixels * (k + 1) * 6 / npix) for k in range(3)]
        each = [sigma[b] / np.sqrt(hits[b % 3]) for b in range(len(bands))]
        return np.broadcast_to(np.stack(each)[:, None], (len(bands), 2, pixels.size))

    def filled() -> Any:
        maps = empty(shape)
        for part in ranges(npix):
            sky = rng.standard_normal((3, 2, part.stop - part.start))
            own = scatter(part) if noise == "pixel" else sigma[:, None, None]
            white = rng.standard_normal((len(bands), *sky.shape[1:]))
            maps[..., part] = np.tensordot(matrix, sky, 1) + own * white
        return maps

    with scratch(folder):
        data = timed("maps written", filled)
        used = np.abs(np.arange(npix) - npix / 2) > npix / 8
        masked = np.where(used, 1.0, np.inf)
        if noise == "pixel":
            known = Noise(computed(shape, scatter), masked)
        else:
            known = Noise(np.broadcast_to(sigma[:, None, None], (len(bands), 2, 1)), masked)
        given = data, known
        like = timed(
            "likelihood",
            lambda: spectral_likelihood(laws, bands, *given, START, unit="uK_CMB"),
        )
        fit = timed("fit", lambda: best_fit(like))
        found = timed("components", lambda: component_maps(like, fit.best_fit, *given))
        emission = emission_maps(like, fit.best_fit, found.amplitude)
        rest = computed(shape, lambda part: data[..., part] - emission[..., part])
        columns = computed(
            (2 * len(bands), npix), lambda part: rest[..., part].reshape(2 * len(bands), -1)
        )
        names = [f"{name}_{s}" for name in bands for s in "QU"]
        timed(
            "residuals written",
            lambda: write_maps(
                folder / "rest.fits", columns, names=names, unit="uK_CMB", mask=used, single=True
            ),
        )
    return steps


def separation(quick: bool) -> list[Row]:
    """Time and memory against nside, for uniform noise and noise of each pixel."""
    nsides = (256, 512) if quick else (512, 1024, 2048)
    rows = []
    for noise in ("uniform", "pixel"):
        seconds, peaks = [], []
        for nside in nsides:
            with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
                name = "benchmarks.stacked_maps"
                used = usage([sys.executable, "-m", name, str(nside), noise, folder])
            seconds.append(used.seconds)
            peaks.append(used.peak)
        slope = np.polyfit(np.log(nsides), np.log(seconds), 1)[0] / 2
        each = ", ".join(
            f"{nside}: {time_text(wall)}, {peak:.2f} GiB"
            for nside, wall, peak in zip(nsides, seconds, peaks, strict=True)
        )
        rows.append(
            Row(
                f"15 bands on disk, {noise} noise, nside {nsides[0]} to {nsides[-1]}: peak memory",
                f"{max(peaks):.2f} GiB",
                "<= 4 GiB",
                max(peaks) <= 4,
                f"{each}; pixels^{slope:.2f}",
            )
        )
    return rows


if __name__ == "__main__":
    run(int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
