"""Pictures of a comparison: scatter, maps, spectra, leakage."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
#: Panels beside each other.
COLUMNS = 3


def _scatter_panel(axes: Axes, scatter: Scatter, x: np.ndarray, y: np.ndarray) -> None:
    ends = np.array([f(np.quantile(v, q) for v in (x, y)) for f, q in ((min, 0.001), (max, 0.999))])
    line = ends + 0.15 * (ends[1] - ends[0]) * np.array([-1, 1])
    axes.hexbin(x, y, gridsize=45, extent=(*line, *line), bins="log", cmap="Greys", lw=0)
    axes.plot(line, line, color="k", lw=1.0, label="one to one")
    axes.plot(line, scatter.slope * line, "--", color=COLORS[1], lw=1.4, label="slope")
    axes.set(xlim=line, ylim=line, aspect="equal")
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(4))
    axes.yaxis.set_major_locator(mpl.ticker.MaxNLocator(4))
    axes.set_title(plain(f"{scatter.band}: {scatter.stokes}"))
    axes.text(
        0.04,
        0.96,
        f"slope {with_error(scatter.slope, scatter.error)}\nr = {scatter.correlation:.3f}\n"
        f"PTE {scatter.pte_text}",
        transform=axes.transAxes,
        va="top",
        fontsize=7,
    )


def plot_scatter(
    path: Path, comparison: Comparison, region: str, bands: Sequence[str], title: str
) -> None:
    """Observed against modelled pixels of a region: a row for Q, one for U (the paper's fig. 5)."""
    blocks = [bands[i : i + COLUMNS] for i in range(0, len(bands), COLUMNS)]
    names = list(comparison.prepared.bands)
    pixels, columns = comparison.regions[region], min(len(bands), COLUMNS)
    size = 2.4 * columns, 4.7 * len(blocks) + 0.6
    with draw_panels(path, title, size, 2 * len(blocks), columns) as grid:
        for i, block in enumerate(blocks):
            for s, stokes in enumerate("QU"):
                row = grid[2 * i + s]
                for axes in row[len(block) :]:
                    axes.set_visible(False)
                for axes, band in zip(row, block, strict=False):
                    b = names.index(band)
                    x = np.asarray(comparison.model[b, s])[pixels]
                    y = np.asarray(comparison.prepared.data[b, s])[pixels]
                    _scatter_panel(axes, comparison.scatter(band, region, stokes), x, y)
                    axes.set_xlabel(f"model [{UNIT}]")
                row[0].set_ylabel(f"observed [{UNIT}]")
        legend_below(grid[0, 0], 2)


def plot_model_maps(
    path: Path, comparison: Comparison, stokes: str, bands: Sequence[str], nside: int, title: str
) -> None:
    """Observed maps beside the model, in one scale of colours (the paper's fig. 6).

    Parameters
    ----------
    path : picture to write
    comparison : the maps
    stokes : "Q", "U" or "QU", two columns for each
    bands : a row for each
    nside : of the pixels that are drawn
    title : of the figure
    """
    names, rows = list(comparison.prepared.bands), []
    region = "full" if "full" in comparison.regions else next(iter(comparison.regions))
    weights = jnp.asarray(comparison.prepared.used[None], float)
    share = np.asarray(average_pixels(weights, nside))[0]
    # Half of a pixel is used, or half as much as in the fullest where a mask is finer than that.
    used = share > share.max() / 2
    for band in bands:
        both = [
            np.where(used, average_pixels(maps[names.index(band)], nside), np.nan)
            for maps in (comparison.prepared.data, comparison.model)
        ]
        row: list[MapPanel] = []
        for kind in stokes:
            observed, model = (maps["QU".index(kind)] for maps in both)
            limit, scatter = color_limit(model), comparison.scatter(band, region, kind)
            head = (
                f"model; slope {with_error(scatter.slope, scatter.error)}, "
                f"r = {scatter.correlation:.2f} ({region})"
            )
            row += [
                MapPanel(plain(f"{band}: {kind} observed"), observed, limit, UNIT),
                MapPanel(plain(head), model, limit, UNIT),
            ]
        rows.append(row)
    plot_maps(path, rows, title)


def _spectrum_panel(axes: Axes, spectra: BandSpectra, index: int) -> None:
    name = FIELDS[index]
    ell, observed = with_powers(spectra.observed[index])
    _, error = with_powers(spectra.error[index])
    _, foregrounds = with_powers(spectra.foregrounds[index])
    low = np.maximum(observed - error, 1e-3 * observed)
    axes.fill_between(ell, low, observed + error, color=OBSERVED, alpha=0.3, lw=0)
    label = r"observed $\pm\,\Delta C_\ell$"
    axes.plot(ell, observed, color=OBSERVED, lw=2.2, alpha=0.8, label=label)
    _, complete = with_powers(spectra.complete[index])
    axes.plot(ell, complete, color=MODEL, lw=1.0, label="foregrounds + CMB + noise")
    axes.plot(ell, foregrounds, color=FOREGROUNDS, lw=1.0, ls="--", label="foregrounds")
    axes.plot(*with_powers(spectra.noise[index]), color=NOISE, lw=1.0, ls=":", label="noise")
    axes.set(xscale="log", yscale="log")
    round_numbers(axes.xaxis)
    axes.set_ylim(bottom=0.3 * min(observed.min(), foregrounds.min()))
    bins = spectra.binned.shape[-1]
    axes.set_title(
        rf"{plain(spectra.band)}: {name}, $\chi^2$ = {spectra.chi2[index]:.1f} / {bins} bins, "
        f"PTE {probability(spectra.pte[index])}"
    )


def plot_full_sky(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """EE and BB of each band, observed and of the complete model (the paper's figs. 7 and 8)."""
    size = 7.2, 2.3 * len(spectra) + 0.8
    with draw_panels(path, title, size, len(spectra), 2, sharex=True) as grid:
        for row, one in zip(grid, spectra, strict=True):
            for index, axes in enumerate(row):
                _spectrum_panel(axes, one, index)
            row[0].set_ylabel(POWER)
        for axes in grid[-1]:
            axes.set_xlabel(r"multipole $\ell$")
        legend_below(grid[0, 0])


def plot_leakage(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """BB before and after leakage was subtracted, and noise (the paper's fig. 9)."""
    with draw_panels(path, title, (3.6 * len(spectra), 3.2), 1, len(spectra)) as grid:
        for axes, one in zip(grid[0], spectra, strict=True):
            assert one.uncorrected is not None  # as chosen by the caller
            assert one.pte_uncorrected is not None
            pte = [probability(p) for p in (one.pte_uncorrected[1], one.pte[1])]
            curves: list[tuple[str, np.ndarray, dict[str, Any]]] = [
                (f"before correction, PTE {pte[0]}", one.uncorrected, {"color": COLORS[1]}),
                (f"after correction, PTE {pte[1]}", one.observed, {"color": COLORS[0]}),
                ("foregrounds", one.foregrounds, {"color": "k", "lw": 0.9, "ls": "--"}),
                ("noise", one.noise, {"color": COLORS[2], "ls": ":"}),
            ]
            for label, spectrum, style in curves:
                axes.plot(*with_powers(spectrum[1]), **{"lw": 1.2, "label": label, **style})
            axes.set(xscale="log", yscale="log", xlabel=r"multipole $\ell$")
            axes.set_title(plain(f"{one.band}: BB"))
            round_numbers(axes.xaxis)
            axes.legend(frameon=False)
        grid[0, 0].set_ylabel(POWER)


class _Series(NamedTuple):
    """Patches in a picture: those shown, and what x and y are: a fit, and EE (0) or BB (1)."""

    name: str
    color: str
    shown: np.ndarray
    x: tuple[PatchFits, int]
    y: tuple[PatchFits, int]


def _patch_panel(axes: Axes, series: Sequence[_Series], what: str) -> None:
    """A or alpha with errors, and the line of equals; the field of BICEP2 is a star."""
    drawn: list[float] = []
    for one in series:
        star = np.array([name == "BICEP2" for name in one.x[0].names])
        (x, dx), (y, dy) = (
            (getattr(fit, what)[:, index], getattr(fit, f"{what}_error")[:, index])
            for fit, index in (one.x, one.y)
        )
        for kept, marker, size in ((one.shown & ~star, "x", 4), (one.shown & star, "*", 11)):
            axes.errorbar(
                x[kept], y[kept], yerr=dy[kept], xerr=dx[kept], fmt=marker, color=one.color,
                ms=size, elinewidth=0.4, alpha=0.8, zorder=3,
            )  # fmt: skip
        label = f"{one.name}: {one.shown.sum()} of {star.size} patches"
        axes.plot([], [], "x", color=one.color, label=label)
        drawn += [*x[one.shown], *y[one.shown]]
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
    path: Path,
    series: Sequence[_Series],
    labels: Sequence[str],
    heads: Sequence[str],
    title: str,
) -> None:
    """A on the left and alpha on the right."""
    with draw_panels(path, title, (7.2, 4.0), 1, 2) as panels:
        for axes, what, symbol, head in zip(
            panels[0], ("A", "alpha"), (rf"$A$ [{UNIT}$^2$]", r"$\alpha$"), heads, strict=True
        ):
            _patch_panel(axes, series, what)
            axes.set(xlabel=f"{symbol}, {labels[0]}", ylabel=f"{symbol}, {labels[1]}")
            axes.set_title(head, fontsize=8)
        legend_below(panels[0, 0])


def plot_patches(path: Path, patches: PatchComparison, title: str) -> None:
    """A and alpha of the patches, model and observed (the paper's fig. 10)."""
    title = f"{title}\n{patches.band}: patches of 400 square degrees"
    series = [
        _Series(name, COLORS[i], patches.detected(i), (patches.model, i), (patches.observed, i))
        for i, name in enumerate(FIELDS)
    ]
    heads = [
        f"{what}: {', '.join(f'{name} {with_error(*of(i))}' for i, name in enumerate(FIELDS))}"
        for what, of in (
            ("observed / model", patches.ratio),
            ("observed - model", patches.slope_difference),
        )
    ]
    _plot_patch_pairs(path, series, ("model", "observed"), heads, title)


def plot_template_patches(path: Path, fit: PatchFits, title: str) -> None:
    """A and alpha of the patches of one map, BB against EE."""
    both = fit.detected.all(axis=1)
    EE, BB = np.median(fit.alpha[both], axis=0)
    heads = [
        f"median BB / EE: {np.median(fit.A[both, 1] / fit.A[both, 0]):.2f}",
        f"median: EE {EE:.2f}, BB {BB:.2f}",
    ]
    series = [_Series("EE and BB", COLORS[0], np.asarray(both), (fit, 0), (fit, 1))]
    _plot_patch_pairs(path, series, FIELDS, heads, f"{title}\npatches of 400 square degrees")
