"""`jaxsky compare`: observed maps against the model, from settings to a report."""

from typing import Any

from fits.commands import compare_pictures as pictures
from fits.commands.page import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.common import prepared_maps
from fits.comparison import (
    Comparison,
    PatchComparison,
    check_comparison,
    compare,
    compare_patches,
)
from fits.full_sky import FIELDS
from fits.inputs import inputs_of
from fits.regions import region_masks
from fits.writing import probability, with_error
from jaxsky.settings import Experiment

#: A comparison with a smaller probability is pointed out.
UNLIKELY = 0.01


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.compare.regions)
    inputs = inputs_of(settings)
    prepared = prepared_maps(settings, inputs)
    check_comparison(settings, prepared, regions)
    command.begin()
    command.steps.step("realisations")
    simulations, report = command.out / "simulations.npz", command.steps.advance
    found = compare(settings, prepared, regions, simulations, report)
    patches = None
    if settings.compare.patches is not None:
        command.steps.step("patches")
        patches = compare_patches(settings, inputs)
    return Report(
        inputs.description,
        [_table(found)],
        comparison_warnings(found, settings),
        _numbers(found, patches),
        _pictures(found, settings, patches),
    )


PICTURES = ("scatter_*.png", "maps_[QU].png", "spectra.png", "leakage.png", "patches.png")
COMMAND = Command("compare", _work, ("comparison.json", "simulations.npz", *PICTURES))


def _numbers(comparison: Comparison, patches: PatchComparison | None) -> dict[str, Any]:
    """All numbers: `pixels` by band, region and Stokes parameter, `spectra` by band, `patches`."""
    pixels: dict[str, Any] = {}
    for s in comparison.scatters:
        numbers = s._asdict() | {"slope_pte": s.slope_pte}
        band, region, stokes = (numbers.pop(key) for key in ("band", "region", "stokes"))
        pixels.setdefault(band, {}).setdefault(region, {})[stokes] = numbers
    spectra = {
        s.band: s._asdict()
        | {"centers": s.centers, "chi2_bins": s.chi2_bins, "largest_error": s.largest_error}
        for s in comparison.spectra
    }
    found: dict[str, Any] = {"pixels": pixels, "spectra": spectra}
    if patches is not None:
        found["patches"] = {
            "band": patches.band,
            "observed": patches.observed._asdict(),
            "model": patches.model._asdict(),
        } | {
            name: {
                "ratio": patches.ratio(i),
                "slope_difference": patches.slope_difference(i),
                "correlation": patches.correlation(i),
            }
            for i, name in enumerate(FIELDS)
        }
    return found


def _table(comparison: Comparison) -> ResultTable:
    """Slopes, correlations and probabilities."""
    header = ("band", "region", "", "slope", "r", "rms", "exp.", "PTE", "EE", "BB")
    spectra = {s.band: s for s in comparison.spectra}
    rows: list[Row] = []
    for band in comparison.prepared.bands:
        powers = [probability(p) for p in spectra[band].pte] if band in spectra else ["", ""]
        for i, s in enumerate(s for s in comparison.scatters if s.band == band):
            slope = with_error(s.slope, s.error).replace(" ", "")
            numbers = (f"{s.correlation:.2f}", f"{s.rms:.2f}", f"{s.expected:.2f}", s.pte_text)
            first, last = (band, powers) if i == 0 else ("", ["", ""])
            rows.append((first, s.region, s.stokes, slope, *numbers, *last))
        rows.append(())
    caption = (
        "Slope of observed on model with the error of noise and CMB; rms of their difference, and "
        "that expected of noise and CMB, in uK_RJ; PTE: probability that noise and CMB alone give "
        "a larger chi2, in pixels, EE and BB."
    )
    return ResultTable(header, rows, caption, words=3)


def comparison_warnings(comparison: Comparison, settings: Experiment) -> list[str]:
    """What a user should know before using the numbers, a sentence each."""
    sentences = settings.leaks()
    if not comparison.spectra:
        missing = int((~comparison.prepared.used).sum())
        sentences.append(
            f"Spectra were left out: they are those of the full sky, and {missing} of "
            f"{comparison.prepared.used.size} pixels have no value."
        )
    for s in comparison.scatters:
        if s.stokes == "QU" and s.slope_pte < UNLIKELY:
            sentences.append(
                f"{s.band}, {s.region}: the slope is {with_error(s.slope, s.error)}, further from "
                f"1 than noise and CMB explain (PTE {probability(s.slope_pte)})."
            )
        if s.stokes == "QU" and s.pte <= s.floor:
            sentences.append(
                f"{s.band}, {s.region}: the maps differ from the model by {s.rms:.3g} uK_RJ, more "
                f"than in any of {round(1 / s.floor) - 1} realisations of noise and CMB."
            )
    for one in comparison.spectra:
        unlikely = [n for n, p in zip(FIELDS, one.pte, strict=True) if p < UNLIKELY]
        if unlikely:
            sentences.append(
                f"{one.band}: {' and '.join(unlikely)} differ from the model by more than noise "
                f"and CMB do (PTE below {UNLIKELY:g})."
            )
    return sentences


def _pictures(
    found: Comparison, settings: Experiment, patches: PatchComparison | None
) -> dict[str, tuple[Any, ...]]:
    """Pictures of what there is; see `fits.commands.run.Report`."""
    bands, title = list(found.prepared.bands), settings.title
    nside = min(settings.compare.panel_nside, settings.common.nside)
    drawn: dict[str, tuple[Any, ...]] = {
        f"scatter_{region}.png": (pictures.plot_scatter, found, region, bands, f"{title}\n{region}")
        for region in found.regions
    }
    for stokes in "QU":
        drawn[f"maps_{stokes}.png"] = pictures.plot_model_maps, found, stokes, bands, nside, title
    if found.spectra:
        drawn["spectra.png"] = pictures.plot_full_sky, found.spectra, title
    if leaky := [s for s in found.spectra if s.uncorrected is not None]:
        drawn["leakage.png"] = pictures.plot_leakage, leaky, title
    if patches is not None:
        drawn["patches.png"] = pictures.plot_patches, patches, title
    return drawn
