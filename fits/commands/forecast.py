"""`jaxsky forecast`, from settings to a report."""

from fits.commands.run import Command, Report, Run
from fits.forecast import report
from fits.forecast.forecast import forecast
from jaxsky.settings import Experiment


def _work(settings: Experiment, command: Run) -> Report:
    found = forecast(settings, command.steps)
    command.steps.step("drawing")
    command.begin()
    written = report.write_report(command.out, found, settings, command.steps.seconds)
    return Report(
        found.setup.description,
        report.tables(found),
        [*report.warnings(found), *settings.left_out("forecast")],
        written,
    )


COMMAND = Command(
    "forecast", _work, ("forecast.json", "log.json", "bb.png", "fisher.png"), resumable=False
)
