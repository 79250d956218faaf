"""`jaxsky separate`, from settings to a report."""

from fits.commands.run import Command, Report, Run
from fits.results import FitError
from fits.separate import report
from fits.separate.separate import separate
from fits.separate.setup import build
from jaxsky.settings import Experiment


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    setup = build(settings)
    command.begin()
    try:
        found = separate(settings, setup, command.out, command.steps)
    except FitError as error:
        raise ValueError(f"The spectral parameters were not found. {error}") from None
    command.steps.step("drawing")
    written = report.write_report(command.out, found, settings, command.steps.seconds)
    return Report(
        setup.description, report.tables(found), report.warnings(found, settings), written
    )


COMMAND = Command(
    "separate",
    _work,
    (
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
    ),
)
