"""`jaxsky compare`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run
from fits.commands.fit import region_files
from jaxsky.settings_keys import at_key

__all__ = ["compare"]

RESULTS = (
    "comparison.json",
    "log.json",
    "simulations.npz",
    "scatter_*.png",
    "maps_[QU].png",
    "spectra.png",
    "leakage.png",
    "patches.png",
)


def compare(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/compare"),
    init: run.Init = False,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of realisations, and of the maps of the embedded sky."),
    ] = None,
    region: Annotated[
        list[str] | None, typer.Option(help="strip, outside, full or a mask file; repeatable.")
    ] = None,
    nside: Annotated[int | None, typer.Option(help="Common nside of the comparison.")] = None,
    nsims: Annotated[
        int | None, typer.Option(min=30, help="Number of realisations of CMB and noise.")
    ] = None,
    values: run.Values = None,
    resume: run.Resume = False,
    overwrite: run.Overwrite = False,
) -> None:
    """Compare observed maps with the model of foregrounds, CMB and noise."""
    from fits.settings import EMBEDDED_COMPARISON, EXAMPLE, Settings

    kind = run.Kind(Settings, EMBEDDED_COMPARISON, EXAMPLE, "analysis.toml", RESULTS)
    analysis = {"seed": seed, "regions": region_files(region), "nside": nside}
    options = run.Options(settings_file, out, init, values, resume, overwrite)
    run.run(kind, _work, options, {"analysis": analysis, "compare": {"nsims": nsims}})


def _work(settings, command: run.Run) -> run.Report:
    from fits.comparison import check_comparison, compare, compare_patches, report
    from fits.inputs import inputs_of
    from fits.regions import region_masks
    from fits.resolution import prepare

    command.steps.step("reading and preparing maps")
    regions = region_masks(settings)
    inputs = inputs_of(settings)
    with at_key("analysis"):
        prepared = prepare(inputs, settings.analysis.nside, settings.analysis.fwhm)
    check_comparison(settings, prepared, regions)
    command.begin()
    out, steps = command.out, command.steps
    steps.step("realisations")
    found = compare(settings, prepared, regions, out / "simulations.npz", steps.advance)
    patches = None
    if settings.compare.patches is not None:
        steps.step("patches")
        patches = compare_patches(settings, inputs)
    steps.step("drawing")
    written = report.write_report(out, inputs, settings, found, steps.seconds, patches)
    return run.Report(
        inputs.description,
        [report.comparison_table(found)],
        report.warnings(found, settings),
        written,
    )
