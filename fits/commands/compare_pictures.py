"""Pictures of a comparison: scatter, maps, spectra, leakage."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from fits.comparison import Comparison, PatchComparison, Scatter
from fits.full_sky import FIELDS, BandSpectra
from fits.patches import PatchFits
from fits.plots import (
    COLORS,
    UNITS,
    MapPanel,
    color_limit,
    draw_panels,
    legend_below,
    plain,
    plot_maps,
    round_numbers,
    with_powers,
)
from fits.writing import probability, with_error
from jaxsky.harmonics import average_pixels

OBSERVED, MODEL, FOREGROUNDS, NOISE = COLORS[1], COLORS[2], COLORS[0], "0.55"
UNIT = UNITS["uK_RJ"]
POWER = rf"$D_\ell$ [{UNIT}$^2$]"
MULTIPOLE = r"multipole $\ell$"
#: Panels beside each other.
COLUMNS = 3


def plot_scatter(
    path: Path, comparison: Comparison, region: str, bands: Sequence[str], title: str
) -> None:
    """Observed against modelled pixels of a region: a row for Q, one for U (the paper's fig. 5)."""
    names, pixels = list(comparison.prepared.bands), comparison.regions[region]
    rows, columns = 2 * -(-len(bands) // COLUMNS), min(len(bands), COLUMNS)
    size = 2.4 * columns, 2.35 * rows + 0.6
    with draw_panels(path, title, size, rows, columns) as grid:
        for i, band in enumerate(bands):
            for s, stokes in enumerate("QU"):
                axes = grid[2 * (i // COLUMNS) + s, i % COLUMNS]
                both = (comparison.model, comparison.prepared.data)
                x, y = (np.asarray(maps[names.index(band), s])[pixels] for maps in both)
                _draw_scatter(axes, comparison.scatter(band, region, stokes), x, y)
        for axes in grid[-2:, (len(bands) - 1) % COLUMNS + 1 :].flat:
            axes.set_visible(False)
        for axes in grid[:, 0]:
            axes.set_ylabel(f"observed [{UNIT}]")
        legend_below(grid[0, 0], 2)


def _draw_scatter(axes: Axes, scatter: Scatter, x: np.ndarray, y: np.ndarray) -> None:
    ends = np.array([f(np.quantile(v, q) for v in (x, y)) for f, q in ((min, 0.001), (max, 0.999))])
    line = ends + 0.15 * (ends[1] - ends[0]) * np.array([-1, 1])
    axes.hexbin(x, y, gridsize=45, extent=(*line, *line), bins="log", cmap="Greys", lw=0)
    axes.plot(line, line, color="k", lw=1.0, label="one to one")
    axes.plot(line, scatter.slope * line, "--", color=COLORS[1], lw=1.4, label="slope")
    axes.set(xlim=line, ylim=line, aspect="equal", xlabel=f"model [{UNIT}]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(4))
    axes.set_title(plain(f"{scatter.band}: {scatter.stokes}"))
    slope = f"slope {with_error(scatter.slope, scatter.error)}"
    words = f"{slope}\nr = {scatter.correlation:.3f}\nPTE {scatter.pte_text}"
    axes.text(0.04, 0.96, words, transform=axes.transAxes, va="top", fontsize=7)


def plot_model_maps(
    path: Path, comparison: Comparison, stokes: str, bands: Sequence[str], nside: int, title: str
) -> None:
    """Observed maps beside the model, in one scale of colours (the paper's fig. 6).

    A row for each band, two columns for each of `stokes`, "Q", "U" or "QU"; in pixels of `nside`.
    """
    names, rows = list(comparison.prepared.bands), []
    region = "full" if "full" in comparison.regions else next(iter(comparison.regions))
    weights = jnp.asarray(comparison.prepared.used[None], float)
    share = np.asarray(average_pixels(weights, nside))[0]
    # Half of a pixel is used, or half as much as in the fullest where a mask is finer than that.
    used = share > share.max() / 2
    for band in bands:
        observed, model = (
            np.where(used, average_pixels(maps[names.index(band)], nside), np.nan)
            for maps in (comparison.prepared.data, comparison.model)
        )
        row: list[MapPanel] = []
        for kind in stokes:
            s, scatter = "QU".index(kind), comparison.scatter(band, region, kind)
            limit, slope = color_limit(model[s]), with_error(scatter.slope, scatter.error)
            head = f"model; slope {slope}, r = {scatter.correlation:.2f} ({region})"
            row += [
                MapPanel(plain(f"{band}: {kind} observed"), observed[s], limit, UNIT),
                MapPanel(plain(head), model[s], limit, UNIT),
            ]
        rows.append(row)
    plot_maps(path, rows, title)


def _draw_curves(
    axes: Axes, curves: Sequence[tuple[str, np.ndarray, dict[str, Any]]], field: int, width: float
) -> None:
    """Spectra as D_l, both axes logarithmic: label, C_l of EE (0) and BB (1), style of each."""
    for name, spectra, style in curves:
        axes.plot(*with_powers(spectra[field]), label=name, **{"lw": width} | style)
    axes.set(xscale="log", yscale="log")
    round_numbers(axes.xaxis)


def plot_full_sky(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """EE and BB of each band, observed and of the complete model (the paper's figs. 7 and 8)."""
    size = 7.2, 2.3 * len(spectra) + 0.8
    with draw_panels(path, title, size, len(spectra), 2, sharex=True) as grid:
        for row, one in zip(grid, spectra, strict=True):
            for index, axes in enumerate(row):
                _draw_spectrum(axes, one, index)
            row[0].set_ylabel(POWER)
        for axes in grid[-1]:
            axes.set_xlabel(MULTIPOLE)
        legend_below(grid[0, 0])


def _draw_spectrum(axes: Axes, spectra: BandSpectra, index: int) -> None:
    ell, observed = with_powers(spectra.observed[index])
    _, error = with_powers(spectra.error[index])
    low = np.maximum(observed - error, 1e-3 * observed)
    axes.fill_between(ell, low, observed + error, color=OBSERVED, alpha=0.3, lw=0)
    name = r"observed $\pm\,\Delta C_\ell$"
    curves: list[tuple[str, np.ndarray, dict[str, Any]]] = [
        (name, spectra.observed, {"color": OBSERVED, "lw": 2.2, "alpha": 0.8}),
        ("foregrounds + CMB + noise", spectra.complete, {"color": MODEL}),
        ("foregrounds", spectra.foregrounds, {"color": FOREGROUNDS, "ls": "--"}),
        ("noise", spectra.noise, {"color": NOISE, "ls": ":"}),
    ]
    _draw_curves(axes, curves, index, 1.0)
    _, foregrounds = with_powers(spectra.foregrounds[index])
    axes.set_ylim(bottom=0.3 * min(observed.min(), foregrounds.min()))
    chi2, pte = f"{spectra.chi2[index]:.1f}", probability(spectra.pte[index])
    tested = rf"$\chi^2$ = {chi2} / {spectra.binned.shape[-1]} bins, PTE {pte}"
    axes.set_title(f"{plain(spectra.band)}: {FIELDS[index]}, {tested}")


def plot_leakage(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """BB before and after leakage was subtracted, and noise (the paper's fig. 9)."""
    with draw_panels(path, title, (3.6 * len(spectra), 3.2), 1, len(spectra)) as grid:
        for axes, one in zip(grid[0], spectra, strict=True):
            assert one.uncorrected is not None  # as chosen by the caller
            assert one.pte_uncorrected is not None
            before, after = (probability(p[1]) for p in (one.pte_uncorrected, one.pte))
            curves: list[tuple[str, np.ndarray, dict[str, Any]]] = [
                (f"before correction, PTE {before}", one.uncorrected, {"color": COLORS[1]}),
                (f"after correction, PTE {after}", one.observed, {"color": COLORS[0]}),
                ("foregrounds", one.foregrounds, {"color": "k", "lw": 0.9, "ls": "--"}),
                ("noise", one.noise, {"color": COLORS[2], "ls": ":"}),
            ]
            _draw_curves(axes, curves, 1, 1.2)
            axes.set(xlabel=MULTIPOLE, title=plain(f"{one.band}: BB"))
            axes.legend(frameon=False)
        grid[0, 0].set_ylabel(POWER)


#: Patches in a picture: name, those shown, and what x and y are: a fit, and EE (0) or BB (1).
Series = tuple[str, np.ndarray, tuple[PatchFits, int], tuple[PatchFits, int]]


def _draw_patches(axes: Axes, series: Sequence[Series], what: str) -> None:
    """A or alpha with errors, and the line of equals; the field of BICEP2 is a star."""
    drawn: list[float] = []
    for (name, shown, *pair), color in zip(series, COLORS, strict=False):
        star = np.array([patch == "BICEP2" for patch in pair[0][0].names])
        x, y = (getattr(fit, what)[:, index] for fit, index in pair)
        dx, dy = (getattr(fit, f"{what}_error")[:, index] for fit, index in pair)
        style: Any = {"color": color, "elinewidth": 0.4, "alpha": 0.8, "zorder": 3}
        for kept, marker, size in ((shown & ~star, "x", 4), (shown & star, "*", 11)):
            axes.errorbar(x[kept], y[kept], dy[kept], dx[kept], fmt=marker, ms=size, **style)
        axes.plot([], [], "x", color=color, label=f"{name}: {shown.sum()} of {star.size} patches")
        drawn += [*x[shown], *y[shown]]
    line = [*axes.get_xlim(), *axes.get_ylim()]
    if what == "A":
        axes.set(xscale="log", yscale="log")
        round_numbers(axes.xaxis)
        round_numbers(axes.yaxis)
        line = [min(drawn) / 1.5, max(drawn) * 1.5] if drawn else line
    ends = min(line), max(line)
    axes.plot(ends, ends, color="k", lw=1)
    axes.set(xlim=ends, ylim=ends, aspect="equal")
    axes.plot([], [], "k*", ms=9, label="BICEP2")


def _plot_patch_pairs(
    path: Path, series: Sequence[Series], x: str, y: str, heads: Sequence[str], title: str
) -> None:
    """A on the left and alpha on the right."""
    symbols = {"A": rf"$A$ [{UNIT}$^2$]", "alpha": r"$\alpha$"}
    with draw_panels(path, title, (7.2, 4.0), 1, 2) as panels:
        for axes, (what, symbol), head in zip(panels[0], symbols.items(), heads, strict=True):
            _draw_patches(axes, series, what)
            axes.set(xlabel=f"{symbol}, {x}", ylabel=f"{symbol}, {y}")
            axes.set_title(head, fontsize=8)
        legend_below(panels[0, 0])


def plot_patches(path: Path, patches: PatchComparison, title: str) -> None:
    """A and alpha of the patches, model and observed (the paper's fig. 10)."""
    title = f"{title}\n{patches.band}: patches of 400 square degrees"
    series: list[Series] = [
        (name, patches.detected(i), (patches.model, i), (patches.observed, i))
        for i, name in enumerate(FIELDS)
    ]
    found = {"observed / model": patches.ratio, "observed - model": patches.slope_difference}
    heads = [
        f"{what}: {', '.join(f'{name} {with_error(*of(i))}' for i, name in enumerate(FIELDS))}"
        for what, of in found.items()
    ]
    _plot_patch_pairs(path, series, "model", "observed", heads, title)


def plot_template_patches(path: Path, fit: PatchFits, heads: Sequence[str], title: str) -> None:
    """A and alpha of the patches of one map, BB against EE, each with its head."""
    series = [("EE and BB", np.all(fit.detected, axis=1), (fit, 0), (fit, 1))]
    _plot_patch_pairs(path, series, *FIELDS, heads, f"{title}\npatches of 400 square degrees")
