"""`jaxsky fit`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run
from jaxsky.settings import at_key

KIND = run.Kind(
    "fit", ("result.json", "log.json", "grid.png", "marginals.png", "posterior.png", "chain.h5")
)


def fit(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/fit"),
    maps: run.Maps = None,
    values: run.Values = None,
    resume: run.Resume = False,
    overwrite: run.Overwrite = False,
) -> None:
    """Fit spectral indices to polarization maps: on a grid, by gradient and by MCMC."""
    run.run(KIND, _work, run.Options(settings_file, out, values, resume, overwrite, maps))


def _work(settings, command: run.Run) -> run.Report:
    from fits import report, spectral_index
    from fits.inputs import inputs_of
    from fits.regions import region_masks
    from fits.resolution import prepare

    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.fit.regions)
    inputs = inputs_of(settings)
    with at_key("common"):
        prepared = prepare(inputs, settings.common.nside, settings.common.fwhm)
    inputs = inputs._replace(bands={})  # their maps have served
    command.begin()
    chains = command.out / "chain.h5"
    fits = spectral_index.run(settings, prepared, regions, chains, command.steps)
    command.steps.step("drawing")
    written = report.write_report(command.out, inputs, settings, fits, command.steps.seconds)
    return run.Report(
        inputs.description,
        [report.result_table(fits, report.known_truth(inputs, fits))],
        report.warnings(inputs, settings, fits),
        [*written, *([chains] if chains.exists() else [])],
    )
