"""`jaxsky compare`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run
from jaxsky.settings import at_key

KIND = run.Kind(
    "compare",
    (
        "comparison.json",
        "log.json",
        "simulations.npz",
        "scatter_*.png",
        "maps_[QU].png",
        "spectra.png",
        "leakage.png",
        "patches.png",
    ),
)


def compare(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/compare"),
    maps: run.Maps = None,
    values: run.Values = None,
    resume: run.Resume = False,
    overwrite: run.Overwrite = False,
) -> None:
    """Compare observed maps with the model of foregrounds, CMB and noise."""
    run.run(KIND, _work, run.Options(settings_file, out, values, resume, overwrite, maps))


def _work(settings, command: run.Run) -> run.Report:
    from fits.comparison import check_comparison, compare, compare_patches, report
    from fits.inputs import inputs_of
    from fits.regions import region_masks
    from fits.resolution import prepare

    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.compare.regions)
    inputs = inputs_of(settings)
    with at_key("common"):
        prepared = prepare(inputs, settings.common.nside, settings.common.fwhm)
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
