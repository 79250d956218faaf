"""Pictures of fits: the grid, the marginal distributions, the posterior of the chains."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from getdist import plots

from fits.plots import COLORS, STYLE, draw_panels, draw_title, label, legend_below, plain, save
from fits.results import FitResult
from fits.spectral_index import RegionFit, all_free

STOKES_COLORS = {"Q": COLORS[0], "U": COLORS[1], "QU": COLORS[6]}
TRUTH = {"color": COLORS[3], "linewidth": 1.6}


def _levels(log_posterior: np.ndarray) -> list[float]:
    """Heights of the contours that hold 95.45 % and 68.27 % of the probability."""
    density = np.sort(np.exp(log_posterior).ravel())[::-1]
    held = np.cumsum(density) / density.sum()
    return [float(np.log(density[np.searchsorted(held, p)])) for p in (0.9545, 0.6827)]


def _by_region(fits: Sequence[RegionFit]) -> dict[str, list[RegionFit]]:
    return {fit.region: [f for f in fits if f.region == fit.region] for fit in fits}


def plot_grids(
    path: Path, fits: Sequence[RegionFit], truth: Mapping[str, float] | None, title: str
) -> bool:
    """The probability on the grid, Q beside U, a row for each region: the paper's figure.

    Returns False, without a picture, if no fit has a grid of two parameters.
    """
    with_grid = [f for f in fits if "grid" in f.results and len(f.results["grid"].free) == 2]
    if not with_grid:
        return False
    regions = _by_region(with_grid)
    columns = max(map(len, regions.values()))
    size = 1.2 + 2.6 * columns, 0.8 + 2.4 * len(regions)
    with draw_panels(path, title, size, len(regions), columns) as panels:
        for row, members in zip(panels, regions.values(), strict=True):
            for axes in row[len(members) :]:
                axes.set_visible(False)
            for axes, fit in zip(row, members, strict=False):
                x, y = fit.results["grid"].free
                _draw_grid(axes, fit.results["grid"], truth)
                alike = [f for f in with_grid if f.stokes == fit.stokes]
                axes.set(xlim=_limits(alike, x), ylim=_limits(alike, y))
                axes.set(xlabel=f"${label(x)}$", ylabel=f"${label(y)}$")
                axes.set_title(plain(f"{fit.region}, {' + '.join(fit.stokes)}"))
        legend_below(panels[0, 0])
    return True


def _drawable(fits: Sequence[RegionFit], name: str) -> list[tuple[RegionFit, FitResult]]:
    """Fits that have a parameter, with a finite error, and the result that says most of each.

    That is the result of a grid, of a chain or of another method.
    """
    found = []
    for fit in fits:
        results = list(fit.results.values())
        known = [r for r in results if "axes" in r.details or "chain" in r.details]
        best = min(known, key=lambda r: "chain" in r.details, default=results[0])
        if name in best.free and np.isfinite(best.sigma[name]):
            found.append((fit, best))
    return found


def _limits(fits: Sequence[RegionFit], name: str) -> tuple[float, float] | None:
    """Range of a parameter that shows all fits to four standard deviations."""
    drawn = [result for _, result in _drawable(fits, name)]
    ends = [r.best_fit[name] + away * r.sigma[name] for r in drawn for away in (-4, 4)]
    return (min(ends), max(ends)) if ends else None


def _draw_grid(axes: plt.Axes, result: FitResult, truth: Mapping[str, float] | None) -> None:
    x, y = result.free
    grid = [result.details["axes"][name] for name in (x, y)]
    log_posterior = result.details["log_posterior"]
    density = np.exp(log_posterior).T
    axes.pcolormesh(*grid, density, cmap="Greys", vmin=0, vmax=1.4, rasterized=True)
    levels, color = _levels(log_posterior), COLORS[0]
    axes.contour(*grid, log_posterior.T, levels, colors=color, linestyles=["--", "-"])
    axes.plot([], [], color=color, label=r"1$\sigma$")
    axes.plot([], [], "--", color=color, label=r"2$\sigma$")
    axes.plot(result.best_fit[x], result.best_fit[y], "k+", ms=9, mew=1.5, label="best fit")
    if truth and x in truth and y in truth:
        axes.plot(truth[x], truth[y], "o", mfc="none", mec=TRUTH["color"], mew=1.6, label="truth")
    axes.spines[:].set_visible(True)


def plot_marginals(
    path: Path, fits: Sequence[RegionFit], truth: Mapping[str, float] | None, title: str
) -> None:
    """Marginal probability of each parameter, for Q, U and both, with 68 % intervals."""
    free, regions = all_free(fits), _by_region(fits)
    size = 3.4 * len(free), 0.9 + 2.2 * len(regions)
    with draw_panels(path, title, size, len(regions), len(free), sharex="col") as panels:
        for row, (region, members) in zip(panels, regions.items(), strict=True):
            for axes, name in zip(row, free, strict=True):
                for fit, result in _drawable(members, name):
                    _draw_marginal(axes, fit.stokes, result, name)
                if truth and name in truth:
                    axes.axvline(truth[name], **TRUTH, label="truth")
                axes.set(ylim=(0, 1.12), ylabel="relative probability", title=plain(region))
                axes.xaxis.set_tick_params(labelbottom=True)
        for axes, name in zip(panels[-1], free, strict=True):
            axes.set(xlabel=f"${label(name)}$", xlim=_limits(fits, name))
        legend_below(panels[0, 0])


def _draw_marginal(axes: plt.Axes, stokes: str, result: FitResult, name: str) -> None:
    """A marginal distribution from a grid, a chain, or the Gaussian of another result."""
    if "axes" in result.details:
        x, density = result.details["axes"][name], result.details["marginals"][name]
    elif "chain" in result.details:
        smooth = result.to_getdist(stokes, label).get1DDensity(name)
        x, density = smooth.x, smooth.P
    else:
        away = np.linspace(-5, 5, 201)
        x, density = result.best_fit[name] + result.sigma[name] * away, np.exp(-0.5 * away**2)
    density, color = density / density.max(), STOKES_COLORS[stokes]
    axes.plot(x, density, color=color, label=f"{' + '.join(stokes)}, 68 % shaded")
    low, high = result.interval_68[name]
    inside = (x >= low) & (x <= high)
    axes.fill_between(x[inside], density[inside], color=color, alpha=0.22, linewidth=0)


def plot_posterior(
    path: Path, fits: Sequence[RegionFit], truth: Mapping[str, float] | None, title: str
) -> bool:
    """The posterior of the chains, a colour for each region, for the most Stokes parameters.

    Returns False, without a picture, if no fit has a chain.
    """
    with_chain = [f for f in fits if "mcmc" in f.results and "chain" in f.results["mcmc"].details]
    if not with_chain:
        return False
    most = max(with_chain, key=lambda f: len(f.stokes)).stokes
    shown = [f for f in with_chain if f.stokes == most]
    results = {f"{f.region}, {' + '.join(most)}": f.results["mcmc"] for f in shown}
    plot_chains(path, results, truth, title)
    return True


def plot_chains(
    path: Path, results: Mapping[str, FitResult], truth: Mapping[str, float] | None, title: str
) -> None:
    """The posterior of chains of the same parameters by what they are of, a colour for each."""
    samples = [result.to_getdist(plain(name), label) for name, result in results.items()]
    rows = next(iter(results.values())).labels
    plotter = plots.get_subplot_plotter(width_inch=max(4.0, 1.6 * len(rows)))
    plotter.settings.axes_fontsize = 9
    plotter.settings.axes_labelsize = 11
    plotter.settings.legend_fontsize = 9
    plotter.settings.title_limit_fontsize = 9
    plotter.triangle_plot(
        samples,
        list(rows),
        filled=True,
        contour_colors=list(COLORS[: len(samples)]),
        title_limit=1 if len(samples) == 1 else 0,
        markers={n: v for n, v in (truth or {}).items() if n in rows},
        marker_args={"color": TRUTH["color"], "lw": TRUTH["linewidth"], "ls": "-"},
    )
    for i, name in enumerate(rows):
        for result, color in zip(results.values(), COLORS, strict=False):
            interval = result.of_row(result.interval_68, name)
            plotter.subplots[i, i].axvspan(*interval, color=color, alpha=0.15, linewidth=0)
    draw_title(plotter.fig, f"{title}; 68 % shaded", fontsize=8, y=1.03)
    with mpl.rc_context(STYLE | {"savefig.dpi": 200}):
        save(plotter.fig, path)
