"""Maps larger than memory: 15 bands from files, separated and fitted at their own resolution.

`python -m benchmarks.large_maps FOLDER NSIDE uniform|pixel separate|fit` is one run in a process of
its own, which prints time and peak memory after each step.
"""

import argparse
import itertools
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import healpy
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.table import Row, time_text
from fits.cleaning import separate_data
from fits.commands import separate
from fits.common import prepared_maps
from fits.inputs import inputs_of
from fits.regions import region_masks
from fits.separated_data import separation_data
from fits.spectral_index import fit_regions
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import resample
from jaxsky.io import write_maps
from jaxsky.io.stacks import scratch
from jaxsky.programs import Progress
from jaxsky.settings import Experiment, load

#: Simulations of noise in a run: each takes as long as any other.
NSIMS = 2
#: Hits per pixel have one of these patterns, so that ratios of noise between bands vary.
PATTERNS = 3
EXPERIMENT = """
seed = 1
{sky}
[simulate]
nside = {nside}
{bands}
[common]
nside = {nside}
fwhm = 90.0
[free]
"dust.beta_dust" = {{ start = 1.6, uniform = [0.5, 2.5] }}
"dust.T_dust" = {{ start = 19.0, uniform = [10.0, 40.0] }}
"synchrotron.beta_syn" = {{ start = 3.0, uniform = [2.0, 4.5] }}
[separate]
lmax = 120
sampler = "none"
[fit]
regions = ["full"]
stokes = ["QU"]
methods = ["gradient", "mcmc"]
"""
LITEBIRD = '[[bands]]\ninstrument = "litebird"'


def experiment(folder: Path, nside: int, noise: str) -> Path:
    """Write maps of LiteBIRD's bands and templates, unless they are there, and an experiment."""
    sky, jaxsky = min(nside, 512), [sys.executable, "-m", "jaxsky"]
    made = folder / f"simulate_{nside}.toml"
    maps = folder / f"maps_{nside}"
    embedded = f"[sky]\nembedded = {{ nside = {sky} }}"
    made.write_text(EXPERIMENT.format(nside=nside, sky=embedded, bands=LITEBIRD))
    galaxy = embedded_sky(sky).sky("QU").components.items()
    templates = [_template(folder, name, component, nside) for name, component in galaxy]
    if not maps.exists():
        subprocess.run(
            [*jaxsky, "simulate", str(made), "--out", str(maps)], check=True, capture_output=True
        )
    tables = []
    for i, (name, channel) in enumerate(sorted(load_channels().items())):
        path = maps / "sim_00000" / f"{name}.fits"
        table = f'[[bands]]\nname = "{name}"\nfile = "{path}"\nfields = ["Q", "U"]\n'
        if noise == "pixel":
            hits = folder / f"hits_{nside}_{i % PATTERNS}.fits"
            sigma = channel.noise / healpy.nside2resol(nside, arcmin=True)
            table += (
                f'noise = {{ unit = "uK_RJ", hits = {{ file = "{hits}", fields = ["HITS"], '
                f"sigma0 = {sigma} }} }}\n"
            )
        tables.append(table)
    for i in range(PATTERNS if noise == "pixel" else 0):
        theta, phi = healpy.pix2ang(nside, np.arange(12 * nside**2))
        hits = (1 + 0.5 * np.cos(theta + i) * np.cos((i + 1) * phi)).astype(np.float32)
        path = folder / f"hits_{nside}_{i}.fits"
        write_maps(path, hits, names="HITS", unit="", single=True, overwrite=True)
    settings = folder / f"{noise}_{nside}.toml"
    own = {"sky": "\n".join(templates), "bands": "\n".join(tables)}
    settings.write_text(EXPERIMENT.format(nside=nside, **own))
    return settings


def _template(folder: Path, name: str, component: Any, nside: int) -> str:
    """Write the map of a component of the embedded model at nside, and return its table."""
    own = healpy.npix2nside(component.amplitude.shape[-1])
    maps = resample(component.amplitude, jnp.ones(2 * own + 1), nside)
    path = folder / f"{name}_{nside}.fits"
    write_maps(path, maps, names=["Q", "U"], unit="uK_RJ", single=True, overwrite=True)
    return (
        f'[sky.{name}]\nlaw = "{name}"\nfile = "{path}"\nfields = ["Q", "U"]\n'
        f"nu_ref = {float(component.nu_ref)}\nnoise = {{ rms = 0.0 }}"
    )


def load_channels():
    """Return LiteBIRD's channels by name."""
    from jaxsky import load_instrument

    return load_instrument("litebird")


class _Steps(Progress):
    """Seconds of each step, and the peak memory [GiB] at its end."""

    def __init__(self) -> None:
        self.steps: dict[str, tuple[float, float]] = {}
        self._name, self._start = "", 0.0

    def step(self, message: str) -> None:
        """End a step and begin another."""
        unit = 1 if sys.platform == "darwin" else 1024
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
        if self._name:
            self.steps[self._name] = time.perf_counter() - self._start, peak
            print(json.dumps({self._name: self.steps[self._name]}), flush=True)
        self._name, self._start = message, time.perf_counter()

    def advance(self, done: int, total: int, *_) -> None:
        """Say how far a step is."""
        print(json.dumps({"done": [done, total, time.perf_counter() - self._start]}), flush=True)


def main() -> None:
    """Separate or fit the maps of an experiment, with few simulations."""
    parser = argparse.ArgumentParser("python -m benchmarks.large_maps")
    parser.add_argument("folder", type=Path)
    parser.add_argument("nside", type=int)
    parser.add_argument("noise", choices=("uniform", "pixel"))
    parser.add_argument("command", choices=tuple(COMMANDS))
    parser.add_argument("--prepare", action="store_true", help="write the files and stop")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.prepare:
        experiment(arguments.folder, arguments.nside, arguments.noise)
        return
    import matplotlib as mpl

    mpl.use("Agg")
    settings = load(arguments.folder / f"{arguments.noise}_{arguments.nside}.toml", [])
    few = settings.separate.model_copy(update={"nsims": NSIMS})
    settings = settings.model_copy(update={"separate": few})
    steps = _Steps()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name, scratch(Path(name)):
        steps.step("reading and preparing maps")
        COMMANDS[arguments.command](settings, Path(name), steps)
        steps.step("end")


def _separate(settings: Experiment, out: Path, steps: Progress) -> None:
    data = separation_data(settings)
    found = separate_data(settings, data, None, steps)
    steps.step("writing maps")
    separate._write_maps(out, found, settings)
    steps.step("drawing")
    separate.plot_components(out / "a.png", found, settings)
    separate.plot_residuals(out / "b.png", found, settings)
    separate._numbers(found, settings)


def _fit(settings: Experiment, out: Path, steps: Progress) -> None:
    inputs = inputs_of(settings)
    prepared = prepared_maps(settings, inputs)
    del inputs
    fit_regions(settings, prepared, region_masks(settings, settings.fit.regions), out, steps)


COMMANDS = {"separate": _separate, "fit": _fit}


def large_maps(quick: bool) -> list[Row]:
    """Time and memory at the resolution of the maps, against nside."""
    rows, nsides = [], (512,) if quick else (512, 1024, 2048)
    for noise, nside in itertools.product(("uniform", "pixel"), nsides):
        with tempfile.TemporaryDirectory() as name:
            line = [sys.executable, "-m", "benchmarks.large_maps", name, str(nside), noise]
            free = shutil.disk_usage(name).free / 1e9
            needed = 15 * 12 * nside**2 * 100 / 1e9
            if free >= needed:
                subprocess.run([*line, "fit", "--prepare"], check=True, capture_output=True)
            for which in COMMANDS:
                work = f"`jaxsky {which}`, 15 bands at nside {nside}, {noise} noise"
                if free < needed:
                    said = f"left out: {needed:.0f} GB of disk are needed, {free:.0f} GB are free"
                    rows.append(Row(work, "", remarks=said))
                    continue
                done = subprocess.run([*line, which], check=True, capture_output=True, text=True)
                steps = {}
                for said in map(json.loads, done.stdout.splitlines()):
                    steps |= {key: value for key, value in said.items() if key != "done"}
                peak = max(peak for _, peak in steps.values())
                each = [f"{key} {time_text(wall)}" for key, (wall, _) in steps.items()]
                rows.append(Row(work, f"{peak:.2f} GiB", "<= 4 GiB", peak <= 4, ", ".join(each)))
    return rows


if __name__ == "__main__":
    main()
