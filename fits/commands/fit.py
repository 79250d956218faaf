"""`jaxsky fit`, from settings to a report."""

from collections.abc import Mapping, Sequence
from typing import Any

from fits.commands.page import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.common import prepared_maps
from fits.inputs import Inputs, inputs_of
from fits.posterior_plots import plot_grids, plot_marginals, plot_posterior
from fits.regions import region_masks
from fits.spectral_index import RegionFit, all_free, fit_regions, known_truth
from fits.template_noise import unknown_noise
from fits.writing import with_errors
from jaxsky.settings import WORDS, Experiment

#: A fit with a smaller probability to exceed its chi^2 is pointed out.
UNLIKELY = 0.01
#: Pictures, each with what draws it, and the chains, from which a stopped run resumes.
PICTURES = {
    "grid.png": plot_grids,
    "marginals.png": plot_marginals,
    "posterior.png": plot_posterior,
}
CHAINS = "chain_*.npz"


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    regions = region_masks(settings, settings.fit.regions)
    inputs = inputs_of(settings)
    prepared = prepared_maps(settings, inputs)
    inputs = inputs._replace(bands={})  # their maps have served
    command.begin()
    fits = fit_regions(settings, prepared, regions, command.out, command.steps)
    truth = known_truth(inputs, fits)
    return Report(
        inputs.description,
        [_table(fits, truth)],
        fit_warnings(inputs, settings, fits),
        fit_numbers(settings, fits, truth),
        {name: (plot, fits, truth, settings.title) for name, plot in PICTURES.items()},
        sorted(command.out.glob(CHAINS)),
    )


COMMAND = Command("fit", _work, ("result.json", *PICTURES, CHAINS))


def _result(fit: RegionFit, method: str) -> dict[str, Any]:
    result = fit.results[method]
    kept = ("free", "best_fit", "interval_68", "covariance", "converged", "message")
    numbers = {key: getattr(result, key) for key in kept}
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
    for key in ("tau", "acceptance", "discard", "steps"):
        if key in result.details:
            numbers[key] = result.details[key]
    return numbers


def fit_numbers(
    settings: Experiment, fits: Sequence[RegionFit], truth: Mapping[str, float] | None
) -> dict[str, Any]:
    """All numbers: `results` by region, then Stokes parameters, then method."""
    results: dict[str, Any] = {}
    for fit in fits:
        methods = {method: _result(fit, method) for method in fit.results}
        results.setdefault(fit.region, {})[fit.stokes] = methods
    return {"likelihood": settings.fit.likelihood, "truth": truth, "results": results}


def _short_names(names: Sequence[str]) -> list[str]:
    """Names without their component where that leaves them different; those of bands are whole."""
    short = [n if n.split(".")[0] in WORDS else n.split(".", 1)[1] for n in names]
    return [s if short.count(s) == 1 else name for name, s in zip(names, short, strict=True)]


def _table(fits: Sequence[RegionFit], truth: Mapping[str, float] | None) -> ResultTable:
    """The best fits and 68 % intervals, and the truth if there is one."""
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
    header = ("region", "", "method", *_short_names(free), "chi2/dof")
    caption = "best fit and central 68 % interval; chi2 counts pixels with the noise alone"
    return ResultTable(header, rows, caption, words=3)


def fit_warnings(inputs: Inputs, settings: Experiment, fits: Sequence[RegionFit]) -> list[str]:
    """What a user should know before using the numbers, a sentence each, the gravest first."""
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
    sentences += filter(None, map(_attenuated, fits))
    for fit in fits:
        where = f"{fit.region}, {fit.stokes}"
        for method, result in fit.results.items():
            if not result.converged:
                sentences.append(f"{where}, {method}: {result.message}")
        method, result = next(iter(fit.results.items()))
        probability = fit.probability_to_exceed(method)
        if probability is not None and probability < UNLIKELY:
            sentences.append(
                f"{where}: the model does not fit the amplitudes of the templates (chi2 "
                f"{result.chi2:.1f} for {fit.dof_amplitudes} degrees of freedom, probability "
                f"{probability:.1g}); by chance, or its errors are too small."
            )
    return sentences


def _attenuated(fit: RegionFit) -> str | None:
    """What the noise of the templates does to a fit that is not corrected for it."""
    if fit.corrected or not fit.noise_shares:
        return None
    shares = ", ".join(f"{name} by {100 * share:.2g} %" for name, share in fit.noise_shares.items())
    return (
        f"{fit.region}, {fit.stokes}: the noise of the templates attenuates {shares}; the fit is "
        "not corrected for it, as there are parameters with maps of values."
    )
