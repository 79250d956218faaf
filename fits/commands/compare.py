"""`jaxsky compare`: compare observed maps with the model; numbers, a table, warnings, pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import healpy
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from fits import plots
from fits.commands.report import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.common import prepared_maps
from fits.comparison import BandSpectra, Comparison, Scatter, check_comparison, compare
from fits.discs import PatchComparison, compare_patches
from fits.inputs import inputs_of
from fits.patches import PatchFits
from fits.pseudo_cl import FIELDS, SPECTRA
from fits.regions import region_masks, region_title
from fits.results import probability, with_error
from jaxsky.arrays import STOKES
from jaxsky.checks import listed
from jaxsky.harmonics import average_pixels
from jaxsky.settings import Experiment

#: Comparisons with a smaller probability get a warning.
UNLIKELY = 0.01
OBSERVED, MODEL, FOREGROUNDS, NOISE = plots.COLORS[1], plots.COLORS[2], plots.COLORS[0], "0.55"
UNIT = plots.UNITS["uK_RJ"]
POWER = rf"$D_\ell$ [{UNIT}$^2$]"
MULTIPOLE = r"multipole $\ell$"
#: Largest nside of the maps that are drawn.
NSIDE = 32
#: Panels per row, and bands in one picture.
COLUMNS, MOST_BANDS = 3, 6
#: Label, C_l of all spectra, and style.
Curve = tuple[str, np.ndarray, dict[str, Any]]
#: Patches in a picture: name, which are shown, and x and y, each a fit and EE (0) or BB (1).
Series = tuple[str, np.ndarray, tuple[PatchFits, int], tuple[PatchFits, int]]


def _numbers(comparison: Comparison) -> dict[str, Any]:
    """Return `pixels` by band, region and Stokes parameter, and `spectra` by band."""
    pixels: dict[str, Any] = {}
    for (band, region, stokes), s in comparison.scatters.items():
        numbers = s._asdict() | {"slope_pte": s.slope_pte}
        pixels.setdefault(band, {}).setdefault(region, {})[stokes] = numbers
    derived = ("centers", "chi2_bins", "largest_error")
    spectra = {
        s.band: s._asdict() | {key: getattr(s, key) for key in derived} for s in comparison.spectra
    }
    return {"pixels": pixels, "spectra": spectra}


def _patch_numbers(patches: PatchComparison) -> dict[str, Any]:
    """Return the fits to map and model, and for EE and BB how they compare."""
    fits = {"observed": patches.observed._asdict(), "model": patches.model._asdict()}
    means = ("ratio", "slope_difference", "correlation")
    compared = {
        name: {key: getattr(patches, key)(i) for key in means} for i, name in enumerate(FIELDS)
    }
    return {"band": patches.band, **fits, **compared}


def _table(comparison: Comparison) -> ResultTable:
    """Return the table of slopes, correlations and probabilities."""
    names = SPECTRA[comparison.stokes]
    header = ("band", "region", "", "slope", "r", "rms", "exp.", "PTE", *names)
    spectra, nothing = {s.band: s for s in comparison.spectra}, [""] * len(names)
    rows: list[Row] = []
    for band in comparison.prepared.bands:
        powers = [probability(p) for p in spectra[band].pte] if band in spectra else nothing
        first, last = band, powers  # in the first row of a band only
        for (name, region, stokes), s in comparison.scatters.items():
            if name == band:
                slope = with_error(s.slope, s.error).replace(" ", "")
                numbers = (f"{s.correlation:.2f}", f"{s.rms:.2f}", f"{s.expected:.2f}", s.pte_text)
                rows.append((first, region, stokes, slope, *numbers, *last))
                first, last = "", nothing
        rows.append(())
    caption = (
        "Slope of observed on model with the error of noise and CMB; rms of their difference, and "
        "that expected of noise and CMB, in uK_RJ; PTE: probability that noise and CMB alone give "
        f"a larger chi2, in pixels, {listed(names)}."
    )
    return ResultTable(header, rows, caption, words=3)


def comparison_warnings(comparison: Comparison, settings: Experiment) -> list[str]:
    """Return warnings to users of the numbers, one sentence each."""
    sentences = settings.leaks()
    if not comparison.spectra:
        missing = int((~comparison.prepared.used).sum())
        sentences.append(
            f"Spectra were left out: they are those of the full sky, and {missing} of "
            f"{comparison.prepared.used.size} pixels have no value."
        )
    for (band, region, stokes), s in comparison.scatters.items():
        if stokes in ("I", "QU") and s.slope_pte < UNLIKELY:
            sentences.append(
                f"{band}, {region}: the slope is {with_error(s.slope, s.error)}, further from "
                f"1 than noise and CMB explain (PTE {probability(s.slope_pte)})."
            )
        if stokes in ("I", "QU") and s.pte <= s.floor:
            sentences.append(
                f"{band}, {region}: the maps differ from the model by {s.rms:.3g} uK_RJ, more "
                f"than in any of {round(1 / s.floor) - 1} realisations of noise and CMB."
            )
        if stokes in ("I", "QU") and s.pte + s.floor / 2 > 1:
            sentences.append(
                f"{band}, {region}: the maps differ from the model by less than in any of "
                f"{round(1 / s.floor) - 1} realisations of noise and CMB; is the noise too large?"
            )
    for one in comparison.spectra:
        if unlikely := [
            n for n, p in zip(SPECTRA[comparison.stokes], one.pte, strict=True) if p < UNLIKELY
        ]:
            sentences.append(
                f"{one.band}: {' and '.join(unlikely)} differ from the model by more than noise "
                f"and CMB do (PTE below {UNLIKELY:g})."
            )
        if near := [
            n for n, p in zip(SPECTRA[comparison.stokes], one.pte, strict=True) if p > 1 - UNLIKELY
        ]:
            sentences.append(
                f"{one.band}: {' and '.join(near)} agree with the model better than noise and CMB "
                f"allow (PTE above {1 - UNLIKELY:g}); is the noise too large?"
            )
    return sentences


def plot_scatter(
    path: Path, comparison: Comparison, region: str, bands: Sequence[str], title: str
) -> None:
    """Draw observed against modelled pixels of a region, Q above U (the paper's fig. 5)."""
    names, pixels = list(comparison.prepared.bands), comparison.regions[region]
    many = len(comparison.stokes)
    rows, columns = many * -(-len(bands) // COLUMNS), min(len(bands), COLUMNS)
    size = 2.4 * columns, 2.35 * rows + 0.6
    with plots.draw_panels(path, title, size, rows, columns) as grid:
        for i, band in enumerate(bands):
            for s, stokes in enumerate(comparison.stokes):
                axes = grid[many * (i // COLUMNS) + s, i % COLUMNS]
                both = (comparison.model, comparison.prepared.data)
                x, y = (np.asarray(maps[names.index(band), s])[pixels] for maps in both)
                axes.set_title(f"{plots.band_title(band)}: {stokes}")
                _draw_scatter(axes, comparison.scatters[band, region, stokes], x, y)
        for axes in grid[-many:, (len(bands) - 1) % COLUMNS + 1 :].flat:
            axes.set_visible(False)
        for axes in grid[:, 0]:
            axes.set_ylabel(f"observed [{UNIT}]")
        plots.legend_below(grid[0, 0], 2)


def _draw_scatter(axes: Axes, scatter: Scatter, x: np.ndarray, y: np.ndarray) -> None:
    ends = np.array([f(np.quantile(v, q) for v in (x, y)) for f, q in ((min, 0.001), (max, 0.999))])
    line = ends + 0.05 * (ends[1] - ends[0]) * np.array([-1, 1])
    axes.hexbin(x, y, gridsize=45, extent=(*line, *line), bins="log", cmap="Greys", lw=0)
    axes.plot(line, line, color="k", lw=1.0, label="one to one")
    axes.plot(line, scatter.slope * line, "--", color=plots.COLORS[1], lw=1.4, label="slope")
    axes.set(xlim=line, ylim=line, aspect="equal", xlabel=f"model [{UNIT}]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(4))
    slope = f"slope {with_error(scatter.slope, scatter.error)}"
    words = f"{slope}\nr = {scatter.correlation:.3f}\nPTE {scatter.pte_text}"
    axes.text(0.04, 0.96, words, transform=axes.transAxes, va="top", fontsize=7)


def plot_model_maps(
    path: Path, comparison: Comparison, stokes: str, bands: Sequence[str], title: str
) -> None:
    """Draw observed maps, the model on the same colour scale, and their difference (fig. 6).

    One row per band, three columns per letter of `stokes`, such as "QU"; in pixels of nside 32.
    Colours of the difference are linear to three times its standard deviation.
    """
    nside = min(NSIDE, healpy.npix2nside(comparison.prepared.used.size))
    names, rows = list(comparison.prepared.bands), []
    region = "full" if "full" in comparison.regions else next(iter(comparison.regions))
    weights = jnp.asarray(comparison.prepared.used[None], float)
    share = np.asarray(average_pixels(weights, nside))[0]
    # Shown if used more than half as much as the fullest pixel: a mask may have finer gaps.
    used = share > share.max() / 2
    for band in bands:
        observed, model = (
            np.where(used, average_pixels(maps[names.index(band)], nside), np.nan)
            for maps in (comparison.prepared.data, comparison.model)
        )
        row: list[plots.MapPanel] = []
        for kind in stokes:
            s, scatter = comparison.stokes.index(kind), comparison.scatters[band, region, kind]
            limit, slope = plots.color_limit(model[s]), with_error(scatter.slope, scatter.error)
            head = f"model; slope {slope}, r = {scatter.correlation:.2f} ({region})"
            row += [
                plots.MapPanel(words, values[s], UNIT, limit=limit)
                for words, values in (
                    (f"{plots.band_title(band)}: {kind} observed", observed),
                    (plots.plain(head), model),
                )
            ]
            left = observed[s] - model[s]
            spread = 3 * float(np.nanstd(left)) or None
            row.append(plots.MapPanel("observed - model", left, UNIT, 0.0, spread))
        rows.append(row)
    plots.plot_maps(path, rows, title)


def _draw_curves(axes: Axes, curves: Sequence[Curve], field: int, width: float) -> None:
    """Draw one of the spectra, BB being the last, as D_l, on logarithmic axes."""
    for name, spectra, style in curves:
        axes.plot(*plots.with_powers(spectra[field]), label=name, **{"lw": width, **style})
    axes.set(xscale="log", yscale="log")
    plots.round_numbers(axes.xaxis)


def plot_full_sky(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """Draw spectra per band, observed and of the complete model (the paper's figs. 7 and 8)."""
    columns = len(spectra[0].pte)
    size = (max(4.0, 3.6 * columns), 2.3 * len(spectra) + 0.8)
    with plots.draw_panels(path, title, size, len(spectra), columns, sharex=True) as grid:
        for row, one in zip(grid, spectra, strict=True):
            for index, axes in enumerate(row):
                _draw_spectrum(axes, one, index)
            row[0].set_ylabel(POWER)
        for axes in grid[-1]:
            axes.set_xlabel(MULTIPOLE)
        plots.legend_below(grid[0, 0])


def _draw_spectrum(axes: Axes, spectra: BandSpectra, index: int) -> None:
    ell, observed = plots.with_powers(spectra.observed[index])
    _, error = plots.with_powers(spectra.error[index])
    low = np.maximum(observed - error, 1e-3 * observed)
    axes.fill_between(ell, low, observed + error, color=OBSERVED, alpha=0.3, lw=0)
    name = r"observed $\pm\,\Delta C_\ell$"
    curves: list[Curve] = [
        (name, spectra.observed, {"color": OBSERVED, "lw": 2.2, "alpha": 0.8}),
        ("foregrounds + CMB + noise", spectra.complete, {"color": MODEL}),
        ("foregrounds", spectra.foregrounds, {"color": FOREGROUNDS, "ls": "--"}),
        ("noise", spectra.noise, {"color": NOISE, "ls": ":"}),
    ]
    _draw_curves(axes, curves, index, 1.0)
    _, foregrounds = plots.with_powers(spectra.foregrounds[index])
    axes.set_ylim(bottom=0.3 * min(observed.min(), foregrounds.min()))
    chi2, pte = f"{spectra.chi2[index]:.1f}", probability(spectra.pte[index])
    tested = rf"$\chi^2$ = {chi2} / {spectra.binned.shape[-1]} bins, PTE {pte}"
    name = SPECTRA[STOKES[len(spectra.pte)]][index]
    axes.set_title(f"{plots.band_title(spectra.band)}: {name}, {tested}")


def plot_leakage(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """Draw BB before and after leakage is subtracted, and noise (the paper's fig. 9)."""
    with plots.draw_panels(path, title, (3.6 * len(spectra), 3.9), 1, len(spectra)) as grid:
        for axes, one in zip(grid[0], spectra, strict=True):
            assert one.uncorrected is not None  # as chosen by the caller
            assert one.pte_uncorrected is not None
            before, after = (probability(p[-1]) for p in (one.pte_uncorrected, one.pte))
            curves: list[Curve] = [
                (f"before correction, PTE {before}", one.uncorrected, {"color": plots.COLORS[1]}),
                (f"after correction, PTE {after}", one.observed, {"color": plots.COLORS[0]}),
                ("foregrounds", one.foregrounds, {"color": "k", "lw": 0.9, "ls": "--"}),
                ("noise", one.noise, {"color": plots.COLORS[2], "ls": ":"}),
            ]
            _draw_curves(axes, curves, -1, 1.2)
            axes.set(xlabel=MULTIPOLE, title=f"{plots.band_title(one.band)}: BB")
            handles = axes.get_legend_handles_labels()
            axes.legend(*handles, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.2))
        grid[0, 0].set_ylabel(POWER)


def _draw_patches(axes: Axes, series: Sequence[Series], what: str) -> None:
    """Draw A or alpha with errors and the line of equality; the BICEP2 field is a star."""
    drawn, at = list[float](), ("A", "alpha").index(what)
    for (name, shown, *pair), color in zip(series, plots.COLORS, strict=False):
        star = np.array([patch == "BICEP2" for patch in pair[0][0].names])
        x, y = (getattr(fit, what)[:, index] for fit, index in pair)
        dx, dy = (np.sqrt(fit.covariance[:, index, at, at]) for fit, index in pair)
        style: Any = {"color": color, "elinewidth": 0.4, "alpha": 0.8, "zorder": 3}
        for kept, marker, size in ((shown & ~star, "x", 4), (shown & star, "*", 11)):
            axes.errorbar(x[kept], y[kept], dy[kept], dx[kept], fmt=marker, ms=size, **style)
        axes.plot([], [], "x", color=color, label=f"{name}: {shown.sum()} of {star.size} patches")
        drawn += [*x[shown], *y[shown]]
    line = [*axes.get_xlim(), *axes.get_ylim()]
    if what == "A":
        axes.set(xscale="log", yscale="log")
        plots.round_numbers(axes.xaxis)
        plots.round_numbers(axes.yaxis)
        line = [min(drawn) / 1.5, max(drawn) * 1.5] if drawn else line
    ends = min(line), max(line)
    axes.plot(ends, ends, color="k", lw=1)
    axes.set(xlim=ends, ylim=ends, aspect="equal")
    axes.plot([], [], "k*", ms=9, label="BICEP2")


def _plot_patch_pairs(
    path: Path, series: Sequence[Series], x: str, y: str, heads: Sequence[str], title: str
) -> None:
    """Draw A on the left and alpha on the right."""
    symbols = {"A": rf"$A$ [{UNIT}$^2$]", "alpha": r"$\alpha$"}
    with plots.draw_panels(path, title, (7.2, 4.0), 1, 2) as panels:
        for axes, (what, symbol), head in zip(panels[0], symbols.items(), heads, strict=True):
            _draw_patches(axes, series, what)
            axes.set(xlabel=f"{symbol}, {x}", ylabel=f"{symbol}, {y}")
            axes.set_title(head, fontsize=8)
        plots.legend_below(panels[0, 0])


def plot_patches(path: Path, patches: PatchComparison, title: str) -> bool:
    """Draw A and alpha of detected patches, if any, map against model (the paper's fig. 10)."""
    if not patches.detected.any():
        return False
    title = f"{title}\n{patches.band}: patches of 400 square degrees"
    model, observed = patches.model, patches.observed
    shown = patches.detected.T
    series = [(n, shown[i], (model, i), (observed, i)) for i, n in enumerate(FIELDS)]
    found = {"observed / model": patches.ratio, "observed - model": patches.slope_difference}
    several = [i for i in range(len(FIELDS)) if shown[i].sum() > 1]
    heads = [
        f"{what}: {', '.join(f'{FIELDS[i]} {with_error(*of(i))}' for i in several) or 'too few'}"
        for what, of in found.items()
    ]
    _plot_patch_pairs(path, series, "model", "observed", heads, title)
    return True


def plot_template_patches(path: Path, fit: PatchFits, heads: Sequence[str], title: str) -> None:
    """Draw A and alpha of the patches of one map, BB against EE; `heads` are titles of panels."""
    series = [("EE and BB", np.all(fit.detected, axis=1), (fit, 0), (fit, 1))]
    _plot_patch_pairs(path, series, *FIELDS, heads, f"{title}\npatches of 400 square degrees")


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.compare.regions)
    inputs = inputs_of(settings)
    prepared = prepared_maps(settings, inputs)
    check_comparison(settings, prepared, regions)
    command.begin()
    command.steps.step("realisations")
    simulations, report = command.out / "simulations.npz", command.steps.advance
    found = compare(settings, prepared, regions, simulations, report, command.executor)
    numbers, warnings = _numbers(found), comparison_warnings(found, settings)
    bands, title = list(prepared.bands), settings.title
    pictures: dict[str, tuple[Any, ...]] = {}
    for region in regions:
        head = f"{title}\n{region_title(settings, region)}"
        for name, some in plots.pages(f"scatter_{region}", bands, MOST_BANDS).items():
            pictures[name] = plot_scatter, found, region, some, head
    for s in found.stokes:
        for name, some in plots.pages(f"maps_{s}", bands, MOST_BANDS).items():
            pictures[name] = plot_model_maps, found, s, some, title
    for name, shown in plots.pages("spectra", found.spectra, MOST_BANDS).items():
        pictures[name] = plot_full_sky, shown, title
    leaky = [s for s in found.spectra if s.uncorrected is not None]
    for name, shown in plots.pages("leakage", leaky, COLUMNS).items():
        pictures[name] = plot_leakage, shown, title
    if settings.compare.patches is not None:
        command.steps.step("patches")
        patches = compare_patches(settings, inputs)
        numbers["patches"] = _patch_numbers(patches)
        pictures["patches.png"] = plot_patches, patches, title
        if not patches.detected.any():
            warnings.append(f"{patches.band}: neither EE nor BB is detected in any patch.")
    return Report(inputs.description, [_table(found)], warnings, numbers, pictures)


PICTURES = ("scatter_*.png", "maps_[IQU]*.png", "spectra*.png", "leakage*.png", "patches.png")
COMMAND = Command("compare", _work, ("comparison.json", "simulations.npz", *PICTURES))
