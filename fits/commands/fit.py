"""`jaxsky fit`, from settings to a report."""

from fits import report, spectral_index
from fits.commands.run import Command, Report, Run
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.regions import region_masks
from jaxsky.settings import Experiment, at_key


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.fit.regions)
    inputs = inputs_of(settings)
    with at_key("common"):
        prepared = common_maps(inputs, settings.common.nside, settings.common.fwhm)
    inputs = inputs._replace(bands={})  # their maps have served
    command.begin()
    chains = command.out / "chain.h5"
    fits = spectral_index.run(settings, prepared, regions, chains, command.steps)
    command.steps.step("drawing")
    written = report.write_report(command.out, inputs, settings, fits, command.steps.seconds)
    return Report(
        inputs.description,
        [report.result_table(fits, report.known_truth(inputs, fits))],
        report.warnings(inputs, settings, fits),
        [*written, *([chains] if chains.exists() else [])],
    )


COMMAND = Command(
    "fit",
    _work,
    ("result.json", "log.json", "grid.png", "marginals.png", "posterior.png", "chain.h5"),
)
