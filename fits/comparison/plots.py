"""Pictures of a comparison: scatter, maps, spectra, leakage."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from fits.comparison.compare import Comparison
from fits.comparison.patches import PatchComparison
from fits.comparison.pixels import Scatter
from fits.comparison.spectra import LMIN, BandSpectra
from fits.patches import PatchFits
from fits.record import probability, with_error
from jaxsky.harmonics import average_pixels
from jaxsky.plots import COLORS, STYLE, UNITS, draw_map, draw_title, plain, save

OBSERVED, MODEL, FOREGROUNDS, NOISE = COLORS[1], COLORS[2], COLORS[0], "0.55"
UNIT = UNITS["uK_RJ"]
POWER = rf"$D_\ell$ [{UNIT}$^2$]"
FIELDS = ("EE", "BB")
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
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            2 * len(blocks),
            COLUMNS if len(bands) > COLUMNS else len(bands),
            figsize=(2.4 * min(len(bands), COLUMNS), 4.7 * len(blocks) + 0.6),
            squeeze=False,
            layout="constrained",
        )
        pixels = comparison.regions[region]
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
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def plot_maps(
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
    names = list(comparison.prepared.bands)
    region = "full" if "full" in comparison.regions else next(iter(comparison.regions))
    weights = jnp.asarray(comparison.prepared.used[None], float)
    used = np.asarray(average_pixels(weights, nside))[0] > 0.5
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(bands),
            2 * len(stokes),
            figsize=(7.0 * len(stokes), 1.85 * len(bands) + 0.4),
            squeeze=False,
            layout="constrained",
        )
        for row, band in zip(grid, bands, strict=True):
            b = names.index(band)
            both = [
                np.asarray(average_pixels(m[b], nside))
                for m in (comparison.prepared.data, comparison.model)
            ]
            for s, kind in enumerate(stokes):
                maps = [m["QU".index(kind)] for m in both]
                limit = float(np.quantile(np.abs(maps[1]), 0.99)) or 1.0
                scatter = comparison.scatter(band, region, kind)
                heads = (
                    f"{band}: {kind} observed",
                    f"model; slope {with_error(scatter.slope, scatter.error)}, "
                    f"r = {scatter.correlation:.2f} ({region})",
                )
                for axes, values, head in zip(row[2 * s :], maps, heads, strict=False):
                    draw_map(axes, np.where(used, values, np.nan), limit, UNIT)
                    axes.set_title(plain(head))
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def _dl(spectrum: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ell = np.arange(LMIN, len(spectrum))
    return ell, ell * (ell + 1) / (2 * np.pi) * spectrum[LMIN:]


def _log_axes(axes: Axes) -> None:
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_locator(mpl.ticker.FixedLocator([2, 5, 10, 20, 50, 100, 200, 500, 1000]))
    axes.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(mpl.ticker.NullLocator())


def _spectrum_panel(axes: Axes, spectra: BandSpectra, index: int) -> None:
    name = FIELDS[index]
    ell, observed = _dl(spectra.observed[index])
    _, error = _dl(spectra.error[index])
    axes.fill_between(
        ell, np.maximum(observed - error, 1e-3 * observed), observed + error, color=OBSERVED,
        alpha=0.3, lw=0,
    )  # fmt: skip
    axes.plot(
        ell, observed, color=OBSERVED, lw=2.2, alpha=0.8, label=r"observed $\pm\,\Delta C_\ell$"
    )
    axes.plot(*_dl(spectra.complete[index]), color=MODEL, lw=1.0, label="foregrounds + CMB + noise")
    axes.plot(*_dl(spectra.foregrounds[index]), color=FOREGROUNDS, lw=1.0, ls="--",
              label="foregrounds")  # fmt: skip
    axes.plot(*_dl(spectra.noise[index]), color=NOISE, lw=1.0, ls=":", label="noise")
    _log_axes(axes)
    axes.set_ylim(bottom=0.3 * min(observed.min(), _dl(spectra.foregrounds[index])[1].min()))
    bins = spectra.binned.shape[-1]
    axes.set_title(
        rf"{plain(spectra.band)}: {name}, $\chi^2$ = {spectra.chi2[index]:.1f} / {bins} bins, "
        f"PTE {probability(spectra.pte[index])}"
    )


def plot_spectra(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """EE and BB of each band, observed and of the complete model (the paper's figs. 7 and 8)."""
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(spectra), 2, figsize=(7.2, 2.3 * len(spectra) + 0.8), squeeze=False,
            layout="constrained", sharex=True,
        )  # fmt: skip
        for row, one in zip(grid, spectra, strict=True):
            for index, axes in enumerate(row):
                _spectrum_panel(axes, one, index)
            row[0].set_ylabel(POWER)
        for axes in grid[-1]:
            axes.set_xlabel(r"multipole $\ell$")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def plot_leakage(path: Path, spectra: Sequence[BandSpectra], title: str) -> None:
    """BB before and after leakage was subtracted, and noise (the paper's fig. 9)."""
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            1, len(spectra), figsize=(3.6 * len(spectra), 3.2), squeeze=False, layout="constrained"
        )
        for axes, one in zip(grid[0], spectra, strict=True):
            assert one.uncorrected is not None  # as chosen by the caller
            assert one.pte_uncorrected is not None
            pte = [probability(p) for p in (one.pte_uncorrected[1], one.pte[1])]
            axes.plot(*_dl(one.uncorrected[1]), color=COLORS[1], lw=1.2,
                      label=f"before correction, PTE {pte[0]}")  # fmt: skip
            axes.plot(*_dl(one.observed[1]), color=COLORS[0], lw=1.2,
                      label=f"after correction, PTE {pte[1]}")  # fmt: skip
            axes.plot(*_dl(one.foregrounds[1]), color="k", lw=0.9, ls="--", label="foregrounds")
            axes.plot(*_dl(one.noise[1]), color=COLORS[2], lw=1.2, ls=":", label="noise")
            _log_axes(axes)
            axes.set(xlabel=r"multipole $\ell$", title=plain(f"{one.band}: BB"))
            axes.legend(frameon=False)
        grid[0, 0].set_ylabel(POWER)
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def _round_numbers(axes: Axes) -> None:
    """Logarithmic axes with a few round numbers."""
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(mpl.ticker.NullFormatter())


def _patch_panel(
    axes: Axes,
    points: Sequence[tuple[str, str, np.ndarray, np.ndarray]],
    star: np.ndarray,
    logarithmic: bool,
) -> None:
    """Values with errors against each other, and the line of equals; a star where it is true.

    Parameters
    ----------
    axes : to draw on
    points : of each series, name, colour, and for x and y values and errors, (2, 2, patch)
    star : patches to mark, and the patches of each series that are shown in its third entry
    logarithmic : both axes
    """
    every = []
    for name, color, shown, values in points:
        (x, dx), (y, dy) = values
        for chosen, marker, size in ((shown & ~star, "x", 4), (shown & star, "*", 11)):
            axes.errorbar(
                x[chosen], y[chosen], yerr=dy[chosen], xerr=dx[chosen], fmt=marker, color=color,
                ms=size, elinewidth=0.4, alpha=0.8, zorder=3,
            )  # fmt: skip
        axes.plot([], [], "x", color=color, label=f"{name}: {shown.sum()} of {shown.size} patches")
        every += [x[shown], y[shown]]
    line = np.array([axes.get_xlim(), axes.get_ylim()])
    if logarithmic:
        _round_numbers(axes)
        if (found := np.concatenate(every)).size:
            line = np.array([found.min() / 1.5, found.max() * 1.5])
    ends = line.min(), line.max()
    axes.plot(ends, ends, color="k", lw=1)
    axes.set(xlim=ends, ylim=ends, aspect="equal")
    axes.plot([], [], "k*", ms=9, label="BICEP2")


def _plot_patch_pairs(path, points, star, labels, heads, title):
    """A on the left and alpha on the right."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(7.2, 4.0), layout="constrained")
        for axes, what, symbol, head in zip(
            panels, ("A", "alpha"), (rf"$A$ [{UNIT}$^2$]", r"$\alpha$"), heads, strict=True
        ):
            _patch_panel(axes, points(what), star, what == "A")
            axes.set(xlabel=f"{symbol}, {labels[0]}", ylabel=f"{symbol}, {labels[1]}")
            axes.set_title(head, fontsize=8)
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def _with_errors(fit: PatchFits, what: str, index: int) -> np.ndarray:
    return np.array([getattr(fit, what)[:, index], getattr(fit, f"{what}_error")[:, index]])


def plot_patches(path: Path, patches: PatchComparison, title: str) -> None:
    """A and alpha of the patches, model and observed (the paper's fig. 10)."""

    def points(what):
        return [
            (
                name,
                COLORS[i],
                patches.detected(i),
                np.array([_with_errors(f, what, i) for f in (patches.model, patches.observed)]),
            )
            for i, name in enumerate(FIELDS)
        ]

    def head(what, numbers):
        found = [f"{name} {with_error(*numbers(i))}" for i, name in enumerate(FIELDS)]
        return f"{what}: {', '.join(found)}"

    _plot_patch_pairs(
        path,
        points,
        np.array([name == "BICEP2" for name in patches.model.names]),
        ("model", "observed"),
        (
            head("observed / model", patches.ratio),
            head("observed - model", patches.slope_difference),
        ),
        f"{title}\n{patches.band}: patches of 400 square degrees",
    )


def plot_template_patches(path: Path, fit: PatchFits, title: str) -> None:
    """A and alpha of the patches of one map, BB against EE."""
    both = fit.detected.all(axis=1)

    def points(what):
        values = np.array([_with_errors(fit, what, i) for i in (0, 1)])
        return [("EE and BB", COLORS[0], both, values)]

    medians = [np.median(getattr(fit, what)[both], axis=0) for what in ("A", "alpha")]
    _plot_patch_pairs(
        path,
        points,
        np.array([name == "BICEP2" for name in fit.names]),
        FIELDS,
        (
            f"median BB / EE: {np.median(fit.A[both, 1] / fit.A[both, 0]):.2f}",
            f"median: EE {medians[1][0]:.2f}, BB {medians[1][1]:.2f}",
        ),
        f"{title}\npatches of 400 square degrees",
    )
