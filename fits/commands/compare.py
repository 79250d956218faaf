"""`jaxsky compare`: observed maps against the model, from settings to a report."""

from pathlib import Path
from typing import Any

from fits.commands import compare_pictures as pictures
from fits.commands.page import ResultTable
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
from fits.writing import leaks, probability, with_error, write_json, write_log
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
    out, steps = command.out, command.steps
    steps.step("realisations")
    found = compare(settings, prepared, regions, out / "simulations.npz", steps.advance)
    patches = None
    if settings.compare.patches is not None:
        steps.step("patches")
        patches = compare_patches(settings, inputs)
    steps.step("drawing")
    warnings = comparison_warnings(found, settings)
    results = {"description": inputs.description, **_numbers(found, patches)}
    write_json(out / "comparison.json", results | {"warnings": warnings})
    drawn = _draw(out, found, settings, patches)
    write_log(out / "log.json", settings, steps.seconds)
    written = [out / "comparison.json", out / "log.json", *drawn]
    return Report(inputs.description, [_table(found)], warnings, written)


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


def _numbers(comparison: Comparison, patches: PatchComparison | None) -> dict[str, Any]:
    """All numbers: `pixels` by band, region and Stokes parameter, `spectra` by band, `patches`."""
    pixels: dict[str, Any] = {}
    for s in comparison.scatters:
        numbers = s._asdict() | {"slope_pte": s.slope_pte}
        here = pixels.setdefault(s.band, {}).setdefault(s.region, {})
        here[s.stokes] = {k: v for k, v in numbers.items() if k not in ("band", "region", "stokes")}
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
    rows: list[tuple[str, ...]] = []
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
    return ResultTable(header, tuple(rows), caption=caption, words=3)


def comparison_warnings(comparison: Comparison, settings: Experiment) -> list[str]:
    """What a user should know before using the numbers, a sentence each."""
    sentences = leaks(settings)
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


def _draw(
    out: Path, comparison: Comparison, settings: Experiment, patches: PatchComparison | None
) -> list[Path]:
    """Draw what there is into a folder; returns the pictures."""
    bands, title = list(comparison.prepared.bands), settings.title
    written = []
    for region in comparison.regions:
        written.append(out / f"scatter_{region}.png")
        pictures.plot_scatter(written[-1], comparison, region, bands, f"{title}\n{region}")
    nside = min(settings.compare.panel_nside, settings.common.nside)
    for stokes in "QU":
        written.append(out / f"maps_{stokes}.png")
        pictures.plot_model_maps(written[-1], comparison, stokes, bands, nside, title)
    if comparison.spectra:
        written.append(out / "spectra.png")
        pictures.plot_full_sky(written[-1], comparison.spectra, title)
    if leaky := [s for s in comparison.spectra if s.uncorrected is not None]:
        written.append(out / "leakage.png")
        pictures.plot_leakage(written[-1], leaky, title)
    if patches is not None:
        written.append(out / "patches.png")
        pictures.plot_patches(written[-1], patches, title)
    return written
