"""`jaxsky compare`, from settings to a report."""

from fits.commands.run import Command, Report, Run
from fits.common import common_maps
from fits.comparison import check_comparison, compare, compare_patches, report
from fits.inputs import inputs_of
from fits.regions import region_masks
from jaxsky.settings import Experiment, at_key


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.compare.regions)
    inputs = inputs_of(settings)
    with at_key("common"):
        prepared = common_maps(inputs, settings.common.nside, settings.common.fwhm)
    check_comparison(settings, prepared, regions)
    command.begin()
    out, steps = command.out, command.steps
    steps.step("realisations")
    found = compare(settings, prepared, regions, out / "simulations.npz", steps.advance)
    patches = None
    if settings.compare.patches is not None:
        steps.step("patches")
        patches = compare_patches(settings, inputs)
    steps.step("drawing")
    written = report.write_report(out, inputs, settings, found, steps.seconds, patches)
    return Report(
        inputs.description,
        [report.comparison_table(found)],
        report.warnings(found, settings),
        written,
    )


COMMAND = Command(
    "compare",
    _work,
    (
        "comparison.json",
        "log.json",
        "simulations.npz",
        "scatter_*.png",
        "maps_[QU].png",
        "spectra.png",
        "leakage.png",
        "patches.png",
    ),
)
