"""`jaxsky separate`: separate components and measure r; numbers, maps, warnings, pictures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fits import plots
from fits.cleaning import SAMPLED, Separation, SimulatedNoise, separate_data
from fits.commands.report import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.results import FitError, probability, two_digits, with_error
from fits.separated_data import separation_data
from fits.tensor_ratio import TensorFit
from jaxsky.components import parameter_declaration
from jaxsky.io import write_maps
from jaxsky.io.stacks import Maps, Stack, computed, ranges
from jaxsky.job import of_first
from jaxsky.settings import Experiment

#: Probabilities below this get a warning.
UNLIKELY = 1e-3
#: E in B above this fraction of a band power's standard deviation gets a warning.
LEAKED = 0.5
#: Number of bands whose residuals are drawn.
SHOWN = 4
CLEANED, NOISE, RESIDUAL, LEFT, LENSING = (*plots.COLORS[:4], "0.5")


def _numbers(found: Separation, settings: Experiment) -> dict[str, Any]:
    """Return all numbers; band powers are D_l of BB in uK_CMB^2."""
    fit, bands, truth = found.fit, list(found.data.bands), found.data.truth or {}
    small = None
    if settings.separate.domain == "pixel":
        values = np.asarray(found.found.probability)
        values = values[np.isfinite(values)]
        small = {f"below_{p:g}": float(np.mean(values < p)) for p in (0.05, 0.01, 0.001)}
    results: dict[str, Any] = {
        "domain": settings.separate.domain,
        "components": found.found.components,
        "bands": bands,
        "parameters": {
            name: {
                "best_fit": fit.best_fit[name],
                "sigma": found.sigma[name],
                "sigma_of_likelihood": fit.sigma[name],
                "truth": truth.get(name),
            }
            for name in fit.free
        },
        "labels": fit.labels,
        "covariance": found.covariance,
        **{key: fit.to_dict()[key] for key in ("chi2", "dof", "converged", "message")},
        "solver": {key: fit.details[key] for key in ("solver", "steps", "distance")},
        "pixels_with_small_probability": small,
        "cmb_noise_degradation": found.found.mean_degradation("cmb"),
        "residual_rms": dict(zip(bands, _rms(found.residuals), strict=True)),
        **_of_BB(found),
        "simulations": len(found.simulated.theta),
    }
    if (chain := found.chain) is not None:
        results["posterior"] = {
            "sampler": chain.method,
            "interval_68": {n: chain.of_row(chain.interval_68, n) for n in chain.labels},
            "converged": bool(chain.converged),
            "message": chain.message,
        }
    return results


def _of_BB(found: Separation) -> dict[str, Any]:
    """Return the numbers of the spectrum BB and of r; none without polarization."""
    ratio, spectra, simulated = found.tensors, found.spectra, found.simulated
    if ratio is None or spectra is None:
        return {}
    return {
        "r": {
            "best_fit": ratio.r,
            "sigma": ratio.sigma,
            "upper_95": ratio.upper_95,
            "truth": (found.data.truth or {}).get("r"),
            "shift_by_foregrounds_left": None if found.left is None else ratio.shift(found.left),
            "shift_by_errors_of_laws": ratio.shift(simulated.residual.mean(axis=0)),
            "chi2": ratio.chi2,
            "dof": ratio.dof,
            "pte": ratio.probability,
        },
        "BB": {
            "first": spectra.edges[:-1],
            "last": [edge - 1 for edge in spectra.edges[1:]],
            "cleaned": ratio.powers,
            "covariance": ratio.covariance,
            "noise": simulated.noise.mean(axis=0),
            "residual_from_errors_of_laws": simulated.residual.mean(axis=0),
            "foregrounds_left": found.left,
            "lensing": ratio.model.lensing,
            "tensors_r_1": ratio.model.tensors,
        },
    }


def _rms(maps: Maps) -> np.ndarray:
    """Return the standard deviation of each band's maps, without masked pixels."""
    if not isinstance(maps, Stack):
        return np.nanstd(maps, axis=(1, 2))
    sums = np.zeros((3, len(maps)))
    for part in ranges(maps.shape[-1]):
        values = maps[..., part]
        powers = np.isfinite(values).astype(float), values, values**2
        sums += [np.nansum(each, axis=(1, 2)) for each in powers]
    number, first, second = sums
    return np.sqrt(second / number - (first / number) ** 2)


def _table(found: Separation) -> ResultTable:
    """Return the table of parameters and r, with the truth if it is known."""
    fit, truth, ratio = found.fit, found.data.truth or {}, found.tensors
    rows: list[Row] = []
    for name in fit.free:
        value, sigma = np.asarray(fit.best_fit[name]), np.asarray(found.sigma[name])
        shown = with_error(float(np.nanmedian(value)), float(np.nanmedian(sigma)))
        regions = f", median of {int(np.isfinite(value).sum())} regions" if value.ndim else ""
        rows.append((name + regions, shown, f"{truth[name]:g}" if name in truth else ""))
    rows.append(())
    if ratio is not None:
        rows.append(("r", with_error(ratio.r, ratio.sigma), f"{truth.get('r', 0.0):g}"))
        rows.append(("r, 95 % below", f"{ratio.upper_95:.2g}", ""))
    if ratio is not None and found.left is not None:
        rows.append(("r, shift by foregrounds left", f"{ratio.shift(found.left):+.1e}", ""))
    degradation = found.found.mean_degradation("cmb")
    rows.append(("noise of CMB, times that without foregrounds", f"{degradation:.2f}", ""))
    header, columns = ("parameter", "best fit", "truth"), 3 if truth else 2
    caption = f"standard deviations; chi2/dof {fit.chi2 / fit.dof:.4f}"
    return ResultTable(header[:columns], [row[:columns] for row in rows], caption)


def _warnings_of_BB(ratio: TensorFit, simulated: SimulatedNoise) -> list[str]:
    """Return warnings to users of the spectrum BB and of r."""
    sentences = list[str]()
    if ratio.probability < UNLIKELY:
        sentences.append(
            f"BB of the cleaned CMB is not that of tensors, lensing, noise and errors of laws "
            f"(probability {probability(ratio.probability)}); foregrounds may be left in it."
        )
    if ratio.probability > 1 - UNLIKELY:
        sentences.append("BB of the cleaned CMB scatters less than its noise; is that too large?")
    share = simulated.leaked.mean(axis=0) / simulated.total.std(axis=0, ddof=1)
    if (share > LEAKED).any():
        sentences.append(
            f"E that leaks into B at the edge of the mask is up to {share.max():.1f} standard "
            "deviations of BB in a bin. It is part of the model, but a larger "
            "separate.apodization makes it and the errors smaller."
        )
    return sentences


def separation_warnings(found: Separation, settings: Experiment) -> list[str]:
    """Return warnings to users of the numbers, one sentence each."""
    sentences = [*settings.leaks(), *settings.left_out("separate")]
    fit, ratio, simulated = found.fit, found.tensors, found.simulated
    sentences += [
        f"Band {band} carries no weight: its noise is too large. It is not counted in degrees of "
        "freedom."
        for band in found.like.weightless
    ]
    if not fit.converged:
        sentences.append(fit.message)
    elif fit.dof > 0 and abs(fit.chi2 / fit.dof - 1) > 0.1:
        sentences.append(
            f"chi2 / dof is {fit.chi2 / fit.dof:.3g}: the laws do not describe the maps, or the "
            "noise is not what it is said to be."
        )
    if ratio is not None:
        sentences += _warnings_of_BB(ratio, simulated)
    if settings.separate.sampler != "none" and found.chain is None:
        reason = (
            f"{len(fit.labels)} parameters are more than {SAMPLED}."
            if len(fit.labels) > SAMPLED
            else "the maps are too large for memory, and their noise differs from pixel to pixel "
            "and from band to band."
        )
        sentences.append(f"The posterior was not sampled: {reason}")
    elif found.chain is not None and not found.chain.converged:
        sentences.append(f"posterior: {found.chain.message}")
    if (A_lens := settings.cmb.A_lens) != 1:
        sentences.append(f"The lensing B modes are taken as known, A_lens = {A_lens:g}.")
    return sentences


def _of_components(found: Separation, by_pixel: bool) -> tuple[list[tuple[str, str]], Callable]:
    """Return names and units of the columns of components, and their values in some pixels."""
    columns = [
        (f"{name.upper()}{end}_{s}", "uK_CMB" if name == "cmb" else "uK_RJ")
        for name in found.found.components
        for end in (("", "_SIGMA") if by_pixel else ("",))
        for s in found.like.stokes
    ]
    if not by_pixel:
        return columns, lambda part: np.concatenate(found.maps[..., part])

    def values(part: slice) -> list[np.ndarray]:
        both = zip(found.maps[..., part], found.found.sigmas(part), strict=True)
        rows = [row for maps, errors in both for row in (*maps, *errors)]
        return [*rows, found.found.chi2[part], found.found.probability[part]]

    return [*columns, ("CHI2", ""), ("PROBABILITY", "")], values


def _write_maps(out: Path, found: Separation, settings: Experiment) -> list[Path]:
    """Write maps of components, residuals, and parameters with regions; return the paths."""
    parameters = [
        (name.upper() + end, parameter_declaration(name).get("unit", ""), name, values)
        for name in found.fit.free
        if np.ndim(found.fit.best_fit[name])
        for end, values in (("", found.fit.best_fit), ("_SIGMA", found.sigma))
    ]
    unit, npix, written = settings.separate.unit, found.maps.shape[-1], list[Path]()
    files: tuple[tuple[list[tuple[str, str]], Callable], ...] = (
        _of_components(found, settings.separate.domain == "pixel"),
        (
            [(f"{band}_{s}", unit) for band in found.data.bands for s in found.like.stokes],
            lambda part: np.concatenate(found.residuals[..., part]),
        ),
        (
            [(name, unit) for name, unit, *_ in parameters],
            lambda part: [found.of_pixel(n, values, part) for *_, n, values in parameters],
        ),
    )
    beam = {"FWHM": (settings.common.fwhm, "[arcmin]")}
    mask = np.empty(npix, bool)
    for part in ranges(npix):
        mask[part] = np.isfinite(found.maps[..., part]).all(axis=(0, 1))
    for file, (columns, values) in zip(MAPS, files, strict=True):
        if columns:

            def read(part, values=values):
                return np.stack([np.broadcast_to(row, mask[part].shape) for row in values(part)])

            names, units = map(list, zip(*columns, strict=True))
            written.append(out / file)
            write_maps(
                written[-1],
                computed((len(names), npix), read),
                names=names,
                unit=units,
                mask=mask,
                extra_header=beam if file == MAPS[0] else None,
                overwrite=True,
                single=True,
            )
    return written


def plot_components(path: Path, found: Separation, settings: Experiment) -> None:
    """Draw the Stokes parameters of the components, one row per component."""
    names, rows = found.found.components, []
    for name, maps in zip(names, plots.thinned(found.maps, range(len(names))), strict=True):
        component = found.like.mixing.sky[name]
        nu_ref = getattr(component, "nu_ref", None)
        title = "CMB" if name == "cmb" else plots.plain(name)
        title += "" if nu_ref is None else f", {float(nu_ref):g} GHz"
        rows.append(plots.stokes_panels(title, maps, plots.color_limit(maps), component.unit))
    plots.plot_maps(path, rows, settings.title)


def plot_residuals(path: Path, found: Separation, settings: Experiment) -> None:
    """Draw data minus components in a few bands, Stokes parameters next to each other."""
    names, rows, unit = list(found.data.bands), [], settings.separate.unit
    shown = plots.spread(names, SHOWN)
    drawn = plots.thinned(found.residuals, [names.index(name) for name in shown])
    for name, maps in zip(shown, drawn, strict=True):
        limit, band = 3 * float(np.nanstd(maps)), plots.band_title(name)
        rows.append(plots.stokes_panels(f"{band}, data less components", maps, limit, unit, 0.0))
    some = f"\n{len(shown)} of {len(names)} bands" if len(shown) < len(names) else ""
    plots.plot_maps(path, rows, settings.title + some)


def plot_parameters(path: Path, found: Separation, settings: Experiment) -> bool:
    """Draw maps of the parameters that have regions, if any, with their errors next to them."""
    rows = []
    for name in found.fit.free:
        if not np.ndim(found.fit.best_fit[name]):
            continue
        value, sigma = (found.of_pixel(name, x) for x in (found.fit.best_fit, found.sigma))
        middle, symbol = float(np.nanmedian(value)), plots.label(name)
        half = float(f"{np.nanquantile(sigma, 0.98) / 2:.1g}")
        head = f"${symbol}$, {len(found.fit.best_fit[name])} regions"
        limit, center = plots.color_limit(value - middle, 0.98), float(f"{middle:.3g}")
        error = plots.MapPanel("its standard deviation", sigma, rf"$\sigma({symbol})$", half, half)
        rows.append([plots.MapPanel(head, value, f"${symbol}$", center, limit), error])
    if rows:
        plots.plot_maps(path, rows, settings.title)
    return bool(rows)


def plot_spectra(path: Path, found: Separation, settings: Experiment) -> bool:
    """Draw BB of the cleaned CMB, its noise and residual foregrounds, against the model."""
    if found.tensors is None or found.spectra is None:
        return False
    model, edges, ell = found.tensors.model, np.array(found.spectra.edges), found.spectra.centers
    signal = found.tensors.powers - model.additive
    error = np.sqrt(np.diagonal(found.tensors.covariance))
    noise, residual = found.simulated.noise.mean(axis=0), found.simulated.residual.mean(axis=0)
    curves = [
        ("lensing", model.lensing, LENSING, "-", 1.4),
        ("$r = 0.01$", 0.01 * model.tensors, "k", "--", 1.1),
        ("$r = 0.001$", 0.001 * model.tensors, "k", ":", 1.1),
        ("noise", noise, NOISE, "-", 1.4),
        ("residuals, from errors of laws", residual, RESIDUAL, "-", 1.4),
    ]
    if found.left is not None:
        curves.append(("foregrounds left (known)", found.left, LEFT, "-.", 1.4))
    with plots.draw_panels(path, settings.title, (plots.COLUMN, 4.2), fontsize=8) as panels:
        axes, seen = panels[0, 0], signal > 0
        yerr = np.stack([np.minimum(error, 0.99 * np.abs(signal)), error])[:, seen]
        xerr = np.stack([ell - edges[:-1], edges[1:] - 1 - ell])[:, seen]
        points: Any = {"fmt": "o", "ms": 3, "lw": 1.0, "label": "cleaned, noise subtracted"}
        axes.errorbar(ell[seen], signal[seen], yerr, xerr, color=CLEANED, **points)
        if not seen.all():
            upper, below = (np.maximum(signal, 0) + 2 * error)[~seen], r"below 0: $2\sigma$"
            axes.plot(ell[~seen], upper, "v", ms=4, color=CLEANED, label=below)
        for name, powers, color, dashes, width in curves:
            positive = np.where(powers > 0, powers, np.nan)
            axes.plot(ell, positive, dashes, color=color, lw=width, label=name)
        plots.label_b_modes(axes, edges[0], edges[-1] - 1, 2)
        lowest = min(x[x > 0].min(initial=np.inf) for x in (residual, found.left) if x is not None)
        axes.set_ylim(bottom=max(lowest / 3, np.nanmax(model.lensing) * 1e-8))
    return True


def plot_ratio(path: Path, found: Separation, settings: Experiment) -> bool:
    """Draw the posterior of the tensor-to-scalar ratio, the estimate with its error above it."""
    if (ratio := found.tensors) is None:
        return False
    r, sigma, grid, posterior = ratio.r, ratio.sigma, ratio.grid, ratio.posterior
    with plots.draw_panels(path, settings.title, (plots.COLUMN, 3.2), fontsize=8) as panels:
        axes, below = panels[0, 0], grid <= ratio.upper_95
        axes.plot(grid, posterior, color=CLEANED, label=r"posterior, $r \geq 0$")
        limit = f"95 %: $r < {two_digits(ratio.upper_95)}$"
        axes.fill_between(
            grid[below], posterior[below], color=CLEANED, alpha=0.2, lw=0, label=limit
        )
        marker: Any = {"fmt": "o", "color": "k", "ms": 3.5, "lw": 1.2, "capsize": 2}
        axes.errorbar(r, 1.12, xerr=sigma, label=f"estimate {with_error(r, sigma)}", **marker)
        if (known := (found.data.truth or {}).get("r")) is not None:
            axes.axvline(known, **plots.TRUTH, label="truth")
        shown = grid[posterior > 2e-3].max()
        axes.set(
            xlim=(min(0.0, r - 1.3 * sigma), max(shown, r + 1.5 * sigma)),
            ylim=(0, 1.25),
            xlabel="tensor-to-scalar ratio $r$",
            ylabel="relative probability",
        )
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
        plots.legend_below(axes, 2, fontsize=7)
    return True


def plot_posterior(path: Path, found: Separation, settings: Experiment) -> bool:
    """Draw the posterior of the chain, if there is one."""
    if found.chain is not None:
        chains = {found.chain.method: found.chain}
        plots.plot_chains(path, chains, found.data.truth, settings.title)
    return found.chain is not None


#: Pictures and the functions that draw them; maps; files from which a stopped run resumes.
PICTURES = {
    "components.png": plot_components,
    "residuals.png": plot_residuals,
    "spectra.png": plot_spectra,
    "r.png": plot_ratio,
    "parameters.png": plot_parameters,
    "posterior.png": plot_posterior,
}
MAPS = ("components.fits", "residuals.fits", "parameters.fits")
KEPT = ("simulations.npz", "chain.npz")


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    data = separation_data(settings)
    command.begin()
    try:
        found = separate_data(settings, data, command.out, command.steps, command.executor)
    except FitError as error:
        raise ValueError(f"The spectral parameters were not found. {error}") from None
    return Report(
        data.description,
        [_table(found)],
        separation_warnings(found, settings),
        _numbers(found, settings),
        {name: (plot, found, settings) for name, plot in PICTURES.items()},
        of_first(lambda: _write_maps(command.out, found, settings)),
    )


COMMAND = Command("separate", _work, ("result.json", *MAPS, *PICTURES, *KEPT), shared=True)
