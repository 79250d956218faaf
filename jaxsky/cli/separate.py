"""`jaxsky separate`."""

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
from jaxsky.settings_keys import of_file

__all__ = ["separate"]

#: What a separation leaves in its folder.
RESULTS = (
    "result.json",
    "log.json",
    "components.fits",
    "residuals.fits",
    "parameters.fits",
    "components.png",
    "residuals.png",
    "parameters.png",
    "spectra.png",
    "r.png",
    "posterior.png",
    "simulations.npz",
    "chain.h5",
)


def separate(
    settings_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[SEPARATION.toml]",
            help="Settings; without, the embedded sky as LiteBIRD sees it.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/separate"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of simulations, chains, and maps of the embedded sky."),
    ] = None,
    nside: Annotated[int | None, typer.Option(help="Common nside of the maps.")] = None,
    domain: Annotated[
        str | None, typer.Option(help="pixel, or harmonic with a beam for each band.")
    ] = None,
    nsims: Annotated[
        int | None, typer.Option(min=20, help="Number of simulations of the noise.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the simulations in --out.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results in --out.")
    ] = False,
) -> None:
    """Separate CMB and foregrounds by their laws, and measure r from the cleaned B modes."""
    started = time.perf_counter()
    from fits.separate import settings as separate_settings

    if init:
        write_example(settings_file or Path("separation.toml"), separate_settings.EXAMPLE)
        return
    overrides = {"seed": seed, "nside": nside, "domain": domain, "nsims": nsims}
    settings_file = settings_file or separate_settings.EMBEDDED
    settings = separate_settings.load_separate(settings_file, {"separation": overrides})
    with (
        of_file(settings_file),
        results_folder(out, RESULTS, resume=resume, overwrite=overwrite) as folder,
        progress_bar() as progress,
    ):
        task = progress.add_task("reading and preparing maps", total=None)

        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        from fits.results import FitError
        from fits.separate import report
        from fits.separate.separate import separate as run
        from fits.separate.setup import build

        def say(message: str) -> None:
            progress.update(task, description=message, completed=0, total=None)

        def show(done: int) -> None:
            total = settings.separation.nsims
            progress.update(task, description="simulations", completed=done, total=total)

        setup = build(settings)
        if overwrite:
            folder.remove(RESULTS)
        try:
            found = run(settings, setup, out, say, show)
        except FitError as error:
            raise ValueError(f"The spectral parameters were not found. {error}") from None
        say("drawing")
        written = report.write_report(out, found, settings, time.perf_counter() - started)
    console.print(setup.description)
    print_tables(*report.tables(found))
    for sentence in report.warnings(found, settings):
        warn(sentence)
    print_written(written)
