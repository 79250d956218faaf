"""`jaxsky fit`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run
from jaxsky.settings_keys import at_key

__all__ = ["fit"]

RESULTS = ("result.json", "log.json", "grid.png", "marginals.png", "posterior.png", "chain.h5")


def fit(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/fit"),
    init: run.Init = False,
    seed: Annotated[int | None, typer.Option(help="Seed of simulated maps and chains.")] = None,
    region: Annotated[
        list[str] | None, typer.Option(help="strip, outside, full or a mask file; repeatable.")
    ] = None,
    stokes: Annotated[list[str] | None, typer.Option(help="Q, U or QU; repeatable.")] = None,
    nside: Annotated[int | None, typer.Option(help="Common nside of the comparison.")] = None,
    values: run.Values = None,
    resume: run.Resume = False,
    overwrite: run.Overwrite = False,
) -> None:
    """Fit spectral indices to polarization maps: on a grid, by gradient and by MCMC."""
    from fits.settings import EMBEDDED, EXAMPLE, Settings

    kind = run.Kind(Settings, EMBEDDED, EXAMPLE, "analysis.toml", RESULTS)
    overrides = {"seed": seed, "regions": region_files(region), "stokes": stokes, "nside": nside}
    options = run.Options(settings_file, out, init, values, resume, overwrite)
    run.run(kind, _work, options, {"analysis": overrides})


def region_files(regions: list[str] | None) -> list[str] | None:
    """Regions of the command line: files are relative to the folder one is in."""
    return [str(Path(r).resolve()) if Path(r).is_file() else r for r in regions or []] or None


def _work(settings, command: run.Run) -> run.Report:
    from fits import report, spectral_index
    from fits.inputs import inputs_of
    from fits.regions import region_masks
    from fits.resolution import prepare

    command.steps.step("reading and preparing maps")
    regions = region_masks(settings)
    inputs = inputs_of(settings)
    with at_key("analysis"):
        prepared = prepare(inputs, settings.analysis.nside, settings.analysis.fwhm)
    inputs = inputs._replace(bands={})  # their maps have served
    command.begin()
    chains = command.out / "chain.h5"
    fits = spectral_index.run(settings, prepared, regions, chains, command.steps)
    command.steps.step("drawing")
    written = report.write_report(command.out, inputs, settings, fits, command.steps.seconds)
    return run.Report(
        inputs.description,
        [report.result_table(fits, inputs.truth)],
        report.warnings(inputs, settings, fits),
        [*written, *([chains] if chains.exists() else [])],
    )
