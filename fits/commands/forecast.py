"""`jaxsky forecast`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run

KIND = run.Kind("forecast", ("forecast.json", "log.json", "bb.png", "fisher.png"), resumable=False)


def forecast(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/forecast"),
    values: run.Values = None,
    overwrite: run.Overwrite = False,
) -> None:
    """Forecast B modes: foregrounds against primordial ones, and errors on r and the laws."""
    run.run(KIND, _work, run.Options(settings_file, out, values, overwrite=overwrite))


def _work(settings, command: run.Run) -> run.Report:
    from fits.forecast import report
    from fits.forecast.forecast import forecast as forecast_errors

    found = forecast_errors(settings, command.steps)
    command.steps.step("drawing")
    command.begin()
    written = report.write_report(command.out, found, settings, command.steps.seconds)
    return run.Report(
        found.setup.description,
        report.tables(found),
        [*report.warnings(found), *settings.left_out("forecast")],
        written,
    )
