"""`jaxsky fit`: fit spectral parameters to maps; numbers, a table, warnings, pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from fits.commands.report import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.common import prepared_maps
from fits.inputs import Inputs, inputs_of, unknown_noise
from fits.plots import COLORS, TRUTH, draw_panels, label, legend_below, plain, plot_chains
from fits.regions import region_masks, region_title
from fits.results import FitResult, with_errors
from fits.spectral_index import RegionFit, all_free, fit_regions, known_truth
from jaxsky.settings import WORDS, Experiment

#: Fits with a smaller probability to exceed their chi^2 get a warning.
UNLIKELY = 0.01
#: Files of the chains, from which a stopped run resumes.
CHAINS = "chain_*.npz"
STOKES_COLORS = {
    "Q": COLORS[0],
    "U": COLORS[1],
    "QU": COLORS[6],
    "I": COLORS[2],
    "IQU": COLORS[5],
}


def _result(fit: RegionFit, method: str) -> dict[str, Any]:
    result = fit.results[method]
    kept = ("free", "best_fit", "interval_68", "covariance", "converged", "message")
    numbers = {key: value for key, value in result.to_dict().items() if key in kept}
    numbers |= {"chi2": fit.chi2[method], "dof": fit.dof}
    if fit.dof_amplitudes is not None:
        numbers |= {
            "chi2_amplitudes": result.chi2,
            "dof_amplitudes": fit.dof_amplitudes,
            "pte_amplitudes": fit.probability_to_exceed(method),
        }
    if fit.weightless:
        numbers["bands_without_weight"] = list(fit.weightless)
    if fit.noise_shares:
        numbers["template_noise"] = {"shares": fit.noise_shares, "corrected": fit.corrected}
    details = ("tau", "acceptance", "discard", "steps")
    return numbers | {key: result.details[key] for key in details if key in result.details}


def fit_numbers(
    settings: Experiment, fits: Sequence[RegionFit], truth: Mapping[str, float] | None
) -> dict[str, Any]:
    """Return all numbers: `results` by region, then Stokes parameters, then method."""
    results: dict[str, Any] = {}
    for fit in fits:
        methods = {method: _result(fit, method) for method in fit.results}
        results.setdefault(fit.region, {})[fit.stokes] = methods
    return {"likelihood": settings.fit.likelihood, "truth": truth, "results": results}


def _table(fits: Sequence[RegionFit], truth: Mapping[str, float] | None) -> ResultTable:
    """Return the table of best fits and 68 % intervals, with the truth if it is known."""
    free = all_free(fits)
    rows: list[Row] = []
    for fit in fits:
        for method, result in fit.results.items():
            values = [
                with_errors(result.best_fit[n], *result.interval_68[n]) if n in result.free else ""
                for n in free
            ]
            mark = "" if result.converged else " (!)"
            chi2 = f"{fit.chi2[method] / fit.dof:.3f}"
            rows.append((fit.region, fit.stokes, method + mark, *values, chi2))
        rows.append(())
    if truth is not None:
        known = [f"{truth[name]:g}" if name in truth else "" for name in free]
        rows.append(("truth", "", "", *known, ""))
    # Omit the component where names stay unique without it; parameters of bands keep theirs.
    short = [n if n.split(".")[0] in WORDS else n.split(".", 1)[1] for n in free]
    heads = [s if short.count(s) == 1 else name for name, s in zip(free, short, strict=True)]
    header = ("region", "", "method", *heads, "chi2/dof")
    caption = "best fit and central 68 % interval; chi2 counts pixels with the noise alone"
    return ResultTable(header, rows, caption, words=3)


def fit_warnings(inputs: Inputs, settings: Experiment, fits: Sequence[RegionFit]) -> list[str]:
    """Return warnings to users of the numbers, one sentence each."""
    sentences = [*settings.leaks(), *settings.left_out("fit")]
    if unknown := [name for name in inputs.templates if name not in inputs.template_noise]:
        sentences.append(unknown_noise(unknown))
    for band in dict.fromkeys(name for fit in fits for name in fit.weightless):
        where = ", ".join(f"{f.region} {f.stokes}" for f in fits if band in f.weightless)
        sentences.append(
            f"Band {band} carries no weight ({where}): its noise is too large, so the fit is one "
            "of the other bands alone. It is not counted in degrees of freedom."
        )
    if "grid" in settings.fit.methods and not any("grid" in fit.results for fit in fits):
        sentences.append(
            "The grid was left out: it takes one or two free parameters with uniform priors."
        )
    for fit in (fit for fit in fits if fit.noise_shares and not fit.corrected):
        shares = ", ".join(f"{name} by {100 * s:.2g} %" for name, s in fit.noise_shares.items())
        sentences.append(
            f"{fit.region}, {fit.stokes}: the noise of the templates attenuates {shares}; the fit "
            "is not corrected for it, as there are parameters with maps of values."
        )
    for fit in fits:
        where = f"{fit.region}, {fit.stokes}"
        for method, result in fit.results.items():
            if not result.converged:
                sentences.append(f"{where}, {method}: {result.message}")
        # The first method that converged, if any did.
        method, result = min(fit.results.items(), key=lambda pair: not pair[1].converged)
        probability = fit.probability_to_exceed(method)
        if probability is None or UNLIKELY <= probability <= 1 - UNLIKELY:
            continue
        small = probability < UNLIKELY
        how, what = ("badly", "small") if small else ("too well", "large")
        sentences.append(
            f"{where}: the model fits the amplitudes of the templates {how} (chi2 "
            f"{result.chi2:.1f} for {fit.dof_amplitudes} degrees of freedom, probability "
            f"{probability:.{1 if small else 3}g}); by chance, or its errors are too {what}."
        )
    return sentences


def _by_region(fits: Sequence[RegionFit]) -> dict[str, list[RegionFit]]:
    return {fit.region: [f for f in fits if f.region == fit.region] for fit in fits}


def plot_grids(
    path: Path, fits: Sequence[RegionFit], truth: Mapping[str, float] | None, title: str
) -> bool:
    """Draw two-parameter grids, if any, Q next to U, a row per region (the paper's fig. 11)."""
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
                axes.locator_params(axis="x", nbins=3)  # small errors have long numbers
                axes.set(xlabel=f"${label(x)}$", ylabel=f"${label(y)}$")
                axes.set_title(plain(f"{fit.region}, {' + '.join(fit.stokes)}"))
        legend_below(panels[0, 0])
    return True


def _drawable(fits: Sequence[RegionFit], name: str) -> list[tuple[RegionFit, FitResult]]:
    """Return the fits with a finite error on a parameter, each with its most detailed result."""
    found, details = [], ("axes", "chain")
    for fit in fits:
        # That of a grid, else of a chain, else of the first method.
        best = min(fit.results.values(), key=lambda r: [key not in r.details for key in details])
        if name in best.free and np.isfinite(best.sigma[name]):
            found.append((fit, best))
    return found


def _limits(fits: Sequence[RegionFit], name: str) -> tuple[float, float] | None:
    """Return the range of a parameter that shows all fits to four standard deviations."""
    drawn = [result for _, result in _drawable(fits, name)]
    ends = [r.best_fit[name] + away * r.sigma[name] for r in drawn for away in (-4, 4)]
    return (min(ends), max(ends)) if ends else None


def _draw_grid(axes: Axes, result: FitResult, truth: Mapping[str, float] | None) -> None:
    x, y = result.free
    grid = [result.details["axes"][name] for name in (x, y)]
    log_posterior = result.details["log_posterior"]
    axes.pcolormesh(*grid, np.exp(log_posterior).T, cmap="Greys", vmin=0, vmax=1.4, rasterized=True)
    heights, color = np.sort(log_posterior.ravel())[::-1], COLORS[0]
    held = np.cumsum(np.exp(heights)) / np.exp(heights).sum()
    levels = [heights[np.searchsorted(held, share)] for share in (0.9545, 0.6827)]
    axes.contour(*grid, log_posterior.T, levels, colors=color, linestyles=["--", "-"])
    axes.plot([], [], color=color, label="68 %")
    axes.plot([], [], "--", color=color, label="95 %")
    axes.plot(result.best_fit[x], result.best_fit[y], "k+", ms=9, mew=1.5, label="best fit")
    if truth and x in truth and y in truth:
        axes.plot(truth[x], truth[y], "o", mfc="none", mec=TRUTH["color"], mew=1.6, label="truth")
    axes.spines[:].set_visible(True)


def plot_marginals(
    path: Path, fits: Sequence[RegionFit], truth: Mapping[str, float] | None, title: str
) -> None:
    """Draw the marginal probability of each parameter, for Q, U and both, with 68 % intervals."""
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
            axes.locator_params(axis="x", nbins=4)
        legend_below(panels[0, 0])


def _draw_marginal(axes: Axes, stokes: str, result: FitResult, name: str) -> None:
    """Draw a marginal distribution from a grid or a chain, else a Gaussian with its error."""
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
    """Draw the chains, if any, with the most Stokes parameters, one colour per region."""
    with_chain = [f for f in fits if "mcmc" in f.results and "chain" in f.results["mcmc"].details]
    most = max((f.stokes for f in with_chain), key=len, default="")
    said = " + ".join(most)
    results = {f"{f.region}, {said}": f.results["mcmc"] for f in with_chain if f.stokes == most}
    if results:
        plot_chains(path, results, truth, title)
    return bool(results)


#: Pictures and the functions that draw them.
PICTURES = {
    "grid.png": plot_grids,
    "marginals.png": plot_marginals,
    "posterior.png": plot_posterior,
}


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.fit.regions)
    inputs = inputs_of(settings)
    prepared = prepared_maps(settings, inputs)
    inputs = inputs._replace(bands={})  # frees their maps
    command.begin()
    fits = fit_regions(settings, prepared, regions, command.out, command.steps)
    truth = known_truth(inputs, fits)
    title = f"{settings.title}\n{', '.join(region_title(settings, r) for r in regions)}"
    return Report(
        inputs.description,
        [_table(fits, truth)],
        fit_warnings(inputs, settings, fits),
        fit_numbers(settings, fits, truth),
        {name: (plot, fits, truth, title) for name, plot in PICTURES.items()},
        sorted(command.out.glob(CHAINS)),
    )


COMMAND = Command("fit", _work, ("result.json", *PICTURES, CHAINS), shared=True)
