"""`jaxsky separate`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run

KIND = run.Kind(
    "separate",
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


def separate(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/separate"),
    maps: run.Maps = None,
    values: run.Values = None,
    resume: run.Resume = False,
    overwrite: run.Overwrite = False,
) -> None:
    """Separate CMB and foregrounds by their laws, and measure r from the cleaned B modes."""
    run.run(KIND, _work, run.Options(settings_file, out, values, resume, overwrite, maps))


def _work(settings, command: run.Run) -> run.Report:
    from fits.results import FitError
    from fits.separate import report
    from fits.separate.separate import separate as separate_maps
    from fits.separate.setup import build

    command.steps.step("reading and preparing maps")
    setup = build(settings)
    command.begin()
    try:
        found = separate_maps(settings, setup, command.out, command.steps)
    except FitError as error:
        raise ValueError(f"The spectral parameters were not found. {error}") from None
    command.steps.step("drawing")
    written = report.write_report(command.out, found, settings, command.steps.seconds)
    return run.Report(
        setup.description, report.tables(found), report.warnings(found, settings), written
    )
