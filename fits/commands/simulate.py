"""`jaxsky simulate`: simulate maps of the sky as an experiment observes it."""

import statistics
import time
from collections.abc import Mapping
from pathlib import Path

import healpy
import jax.numpy as jnp
import numpy as np

from fits.commands.run import Report, Run
from fits.plots import (
    UNITS,
    band_title,
    color_limit,
    draw_map,
    draw_panels,
    draw_spectra,
    spread,
)
from fits.pseudo_cl import SPECTRA
from jaxsky import experiment, montecarlo
from jaxsky.harmonics import analysis, power_spectrum
from jaxsky.io import read_maps
from jaxsky.settings import Experiment

#: Number of bands on a sheet, and the highest multipole of its spectra.
SHOWN, LMAX_SHOWN = 5, 1024
#: Spectra are shown down to this fraction of the largest.
DEPTH = 1e-7


def _restricted(settings: Experiment, only: str) -> Experiment:
    """Return settings that include only noise, signal, foregrounds or CMB."""
    included = settings.included()
    foregrounds = [name for name in settings.sky.components if name in included]
    wanted = {"signal": [*foregrounds, "cmb"], "foregrounds": foregrounds}.get(only, [only])
    include = [name for name in wanted if name in included]
    if not include:
        raise ValueError(f"--only {only}: nothing is left that simulate.include names.")
    spec = settings.simulate.model_copy(update={"include": include})
    return settings.model_copy(update={"simulate": spec})


def make_realisations(settings: Experiment, command: Run, *, only: str | None) -> Report:
    """Simulate realisations, or `only` one part of them; maps are kept or replaced one by one."""
    indices = command.part
    if only is not None:
        settings = _restricted(settings, only)
    out, steps, overwrite = command.out, command.steps, command.overwrite
    steps.step("reading templates")
    montecarlo.check_folder(out, settings, command.resume, overwrite, indices)
    setup = experiment.simulation_inputs(settings)
    names, notes = setup.observation.names, list[str]()
    seconds, count = [], len(indices) * len(names)
    steps.step("simulating")
    files = montecarlo.run(
        settings, setup, out, indices, overwrite, notes.append, command.begin, command.executor
    )
    before = time.perf_counter()
    for done, written in enumerate(files, 1):
        steps.advance(done, count)
        if written:
            now = time.perf_counter()
            seconds.append(now - before)
            before = now
    if settings.simulate.sheet:
        steps.step("drawing")
        shown = montecarlo.paths(out, names, indices.start)
        _draw_sheet(out / f"sim_{indices.start:05d}.png", shown, setup.observation.lmax, settings)
    kept = count - len(seconds)
    there = f"; {kept} maps were there already" if kept else ""
    # Files of workers are reported several at once.
    middle = statistics.median if command.executor is None else statistics.mean
    rate = f"{middle(seconds):.2g} s a band, " if seconds else ""
    took = f"{rate}{steps.seconds:.1f} s in all"
    remark = f"{len(seconds)} maps in {out / 'sim_*'}{there} ({took})."
    sheets, warnings = sorted(out.glob("sim_*.png")), list(dict.fromkeys(notes))
    return Report(setup.description, warnings=warnings, written=sheets, remark=remark)


def _draw_sheet(path: Path, files: Mapping[str, Path], lmax: int, settings: Experiment) -> None:
    """Draw maps of some bands, read from their files, and the spectra of their totals."""
    names, unit, spectra = spread(list(files), SHOWN), settings.simulate.unit, {}
    stokes = settings.simulate.stokes
    size, heights = (max(4.5, 3.6 * len(stokes)), 1.75 * len(names) + 3.2), [1.0] * len(names)
    shape, heights = (len(names) + 1, len(stokes)), [*heights, 1.6]
    with draw_panels(
        path, settings.title, size, *shape, fontsize=10, height_ratios=heights
    ) as panels:
        for row, name in zip(panels, names, strict=False):
            maps = np.asarray(read_maps(files[name], fields=list(stokes), missing=[]).maps)
            # Without refinement this is good to 1e-3, which no eye can see.
            largest = min(lmax, LMAX_SHOWN, 2 * healpy.npix2nside(maps.shape[-1]))
            spectra[name] = np.asarray(power_spectrum(analysis(jnp.asarray(maps), largest, 0)))
            for axes, values, which in zip(row, maps, stokes, strict=True):
                limit = color_limit(maps[:1] if which == "I" else maps[-2:])
                draw_map(axes, values, limit, UNITS[unit])
                axes.set_title(f"{band_title(name)}: {which}")
        for index, (axes, which) in enumerate(zip(panels[-1], SPECTRA[stokes], strict=True)):
            draw_spectra(axes, {n: s[index] for n, s in spectra.items()}, unit)
            axes.set_title(which)
            low, high = axes.get_ylim()
            axes.set_ylim(bottom=max(low, high * DEPTH))
        panels[-1, 0].legend(title="band", ncols=2, frameon=False)
