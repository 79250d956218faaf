"""`jaxsky fit`."""

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from jaxsky.cli.console import console, print_tables, print_written, warn, write_example
from jaxsky.cli.results import results_folder
from jaxsky.settings_keys import at_key, of_file

__all__ = ["fit"]

#: What a fit leaves in its folder.
RESULTS = (
    "result.json",
    "log.json",
    "grid.png",
    "marginals.png",
    "posterior.png",
    "chain.h5",
)


def fit(
    settings_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ANALYSIS.toml]", help="Settings; without, the embedded sky is fitted."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/fit"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of simulated maps and chains.")] = None,
    region: Annotated[
        list[str] | None, typer.Option(help="strip, outside, full or a mask file; repeatable.")
    ] = None,
    stokes: Annotated[list[str] | None, typer.Option(help="Q, U or QU; repeatable.")] = None,
    nside: Annotated[int | None, typer.Option(help="Common nside of the comparison.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the chains in --out.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results that are in --out.")
    ] = False,
) -> None:
    """Fit spectral indices to polarization maps: on a grid, by gradient and by MCMC."""
    started = time.perf_counter()
    from fits import settings as fit_settings

    if init:
        write_example(settings_file or Path("analysis.toml"), fit_settings.EXAMPLE)
        return
    # Files on the command line are relative to the folder one is in, not to the settings.
    files = [str(Path(r).resolve()) if Path(r).is_file() else r for r in region or []]
    overrides = {"seed": seed, "regions": files or None, "stokes": stokes, "nside": nside}
    settings_file = settings_file or fit_settings.EMBEDDED
    settings = fit_settings.load_settings(settings_file, overrides)
    with (
        of_file(settings_file),
        results_folder(out, RESULTS, resume=resume, overwrite=overwrite) as folder,
        console.status("starting") as status,
    ):
        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        from fits import report, spectral_index
        from fits.inputs import inputs_of
        from fits.regions import region_masks
        from fits.resolution import prepare

        status.update("reading and preparing maps")
        regions = region_masks(settings)
        inputs = inputs_of(settings)
        with at_key("analysis"):
            prepared = prepare(inputs, settings.analysis.nside, settings.analysis.fwhm)
        inputs = inputs._replace(bands={})  # their maps have served
        if overwrite:
            folder.remove(RESULTS)
        chains = out / "chain.h5"

        def report_step(message: str) -> None:
            # emcee's progress bar takes the place of the status line.
            (status.stop if message.endswith("mcmc") else status.start)()
            status.update(Text(message))

        fits = spectral_index.run(settings, prepared, regions, chains, report_step, progress=True)
        status.start()
        status.update("drawing")
        seconds = time.perf_counter() - started
        written = report.write_report(out, inputs, settings, fits, seconds)
    console.print(inputs.description)
    print_tables(report.result_table(fits))
    for sentence in report.warnings(inputs, settings, fits):
        warn(sentence)
    written += [chains] if chains.exists() else []
    print_written(written)
