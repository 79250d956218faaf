"""What a comparison leaves behind: a table, comparison.json, pictures and a log."""

from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from fits.comparison import plots
from fits.comparison.compare import Comparison
from fits.comparison.patches import PatchComparison
from fits.inputs import Inputs
from fits.record import leaks, probability, with_error, write_json, write_log
from jaxsky.settings import Experiment

#: A comparison with a smaller probability is pointed out.
UNLIKELY = 0.01


def comparison_json(
    comparison: Comparison, inputs: Inputs, patches: PatchComparison | None = None
) -> dict[str, Any]:
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
    found = {"description": inputs.description, "pixels": pixels, "spectra": spectra}
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
            for i, name in enumerate(("EE", "BB"))
        }
    return found


def comparison_table(comparison: Comparison) -> Table:
    """Slopes, correlations and probabilities for the terminal."""
    table = Table(
        box=box.SIMPLE,
        pad_edge=False,
        caption="Slope of observed on model with the error of noise and CMB; rms of their "
        "difference, and that expected of noise and CMB, in uK_RJ; PTE: probability that noise and "
        "CMB alone give a larger chi2, in pixels, EE and BB.",
    )
    for column in ("band", "region", ""):
        table.add_column(column, no_wrap=True)
    for column in ("slope", "r", "rms", "exp.", "PTE", "EE", "BB"):
        table.add_column(column, justify="right", no_wrap=True)
    spectra = {s.band: s for s in comparison.spectra}
    for band in comparison.prepared.bands:
        for i, s in enumerate(s for s in comparison.scatters if s.band == band):
            power = ["", ""]
            if i == 0 and band in spectra:
                power = [probability(p) for p in spectra[band].pte]
            table.add_row(
                band if i == 0 else "",
                s.region,
                s.stokes,
                with_error(s.slope, s.error).replace(" ", ""),
                f"{s.correlation:.2f}",
                f"{s.rms:.2f}",
                f"{s.expected:.2f}",
                s.pte_text,
                *power,
            )
        table.add_section()
    return table


def warnings(comparison: Comparison, settings: Experiment) -> list[str]:
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
        unlikely = [n for n, p in zip(("EE", "BB"), one.pte, strict=True) if p < UNLIKELY]
        if unlikely:
            sentences.append(
                f"{one.band}: {' and '.join(unlikely)} differ from the model by more than noise "
                f"and CMB do (PTE below {UNLIKELY:g})."
            )
    return sentences


def write_report(
    out: Path,
    inputs: Inputs,
    settings: Experiment,
    comparison: Comparison,
    seconds: float,
    patches: PatchComparison | None = None,
) -> list[Path]:
    """Write comparison.json, pictures and log.json to a folder; returns what was written."""
    written = [out / "comparison.json", out / "log.json"]
    numbers = {"warnings": warnings(comparison, settings)}
    write_json(written[0], comparison_json(comparison, inputs, patches) | numbers)
    bands, title = list(comparison.prepared.bands), settings.title
    for region in comparison.regions:
        written.append(out / f"scatter_{region}.png")
        plots.plot_scatter(written[-1], comparison, region, bands, f"{title}\n{region}")
    nside = min(settings.compare.panel_nside, settings.common.nside)
    for stokes in "QU":
        written.append(out / f"maps_{stokes}.png")
        plots.plot_model_maps(written[-1], comparison, stokes, bands, nside, title)
    if comparison.spectra:
        written.append(out / "spectra.png")
        plots.plot_spectra(written[-1], comparison.spectra, title)
    if leaky := [s for s in comparison.spectra if s.uncorrected is not None]:
        written.append(out / "leakage.png")
        plots.plot_leakage(written[-1], leaky, title)
    if patches is not None:
        written.append(out / "patches.png")
        plots.plot_patches(written[-1], patches, title)
    write_log(written[1], settings, seconds)
    return written
