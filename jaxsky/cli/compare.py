"""`jaxsky compare`."""

import time
from pathlib import Path
from typing import Annotated

import typer

from jaxsky.cli.console import (
    console,
    print_tables,
    print_written,
    progress_bar,
    warn,
    write_example,
)
from jaxsky.cli.results import results_folder
from jaxsky.settings_keys import at_key, of_file

__all__ = ["compare"]

#: What a comparison leaves in its folder.
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
    settings_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ANALYSIS.toml]",
            help="Settings, as of `jaxsky fit`; without, the embedded sky is compared.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/compare"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
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
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the realisations in --out.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results in --out.")
    ] = False,
) -> None:
    """Compare observed maps with the model of foregrounds, CMB and noise."""
    from fits import settings as fit_settings

    if init:
        write_example(settings_file or Path("analysis.toml"), fit_settings.EXAMPLE)
        return
    started = time.perf_counter()
    # Files on the command line are relative to the folder one is in, not to the settings.
    files = [str(Path(r).resolve()) if Path(r).is_file() else r for r in region or []]
    settings_file = settings_file or fit_settings.EMBEDDED_COMPARISON
    settings = fit_settings.load_settings(
        settings_file,
        {"seed": seed, "regions": files or None, "nside": nside},
        {"nsims": nsims},
    )
    with (
        of_file(settings_file),
        results_folder(out, RESULTS, resume=resume, overwrite=overwrite) as folder,
        progress_bar() as progress,
    ):
        task = progress.add_task("reading and preparing maps", total=None)

        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        from fits.comparison import check_comparison, compare, compare_patches, report
        from fits.inputs import inputs_of
        from fits.regions import region_masks
        from fits.resolution import prepare

        def show(done: int, of: int) -> None:
            progress.update(task, description="realisations", completed=done, total=of)

        regions = region_masks(settings)
        inputs = inputs_of(settings)
        with at_key("analysis"):
            prepared = prepare(inputs, settings.analysis.nside, settings.analysis.fwhm)
        check_comparison(settings, prepared, regions)
        if overwrite:
            folder.remove(RESULTS)
        found = compare(settings, prepared, regions, out / "simulations.npz", show)
        patches = None
        if settings.compare.patches is not None:
            progress.update(task, description="patches")
            patches = compare_patches(settings, inputs)
        progress.update(task, description="drawing")
        seconds = time.perf_counter() - started
        written = report.write_report(out, inputs, settings, found, seconds, patches)
    console.print(inputs.description)
    print_tables(report.comparison_table(found))
    for sentence in report.warnings(found, settings):
        warn(sentence)
    print_written(written)
