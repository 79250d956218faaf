"""`jaxsky forecast`."""

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from jaxsky.cli.console import (
    console,
    print_tables,
    print_written,
    warn,
    write_example,
)
from jaxsky.cli.results import results_folder
from jaxsky.settings_keys import of_file

__all__ = ["forecast"]

#: What a forecast leaves in its folder.
RESULTS = ("forecast.json", "log.json", "bb.png", "fisher.png")


def forecast(
    settings_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FORECAST.toml]", help="Settings; without, COrE and the embedded sky."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/forecast"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results that are in --out.")
    ] = False,
) -> None:
    """Forecast B modes: foregrounds against primordial ones, and errors on r and the laws."""
    started = time.perf_counter()
    from fits.forecast import settings as forecast_settings

    if init:
        write_example(settings_file or Path("forecast.toml"), forecast_settings.EXAMPLE)
        return
    settings_file = settings_file or forecast_settings.DEFAULT
    settings = forecast_settings.load_forecast(settings_file)
    with (
        of_file(settings_file),
        results_folder(out, RESULTS, resume=None, overwrite=overwrite) as folder,
        console.status("starting") as status,
    ):
        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        from fits.forecast import report
        from fits.forecast.forecast import forecast as run

        found = run(settings, lambda message: status.update(Text(message)))
        status.update("drawing")
        if overwrite:
            folder.remove(RESULTS)
        written = report.write_report(out, found, settings, time.perf_counter() - started)
    console.print(found.setup.description)
    print_tables(*report.tables(found))
    for sentence in report.warnings(found):
        warn(sentence)
    print_written(written)
