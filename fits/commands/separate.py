"""`jaxsky separate`, from settings to tables, maps and pictures."""

from pathlib import Path
from typing import Any

import numpy as np

from fits.cleaning import SAMPLED, Separation, separate_data
from fits.commands import separate_pictures as pictures
from fits.commands.page import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.posterior_plots import plot_chains
from fits.results import FitError
from fits.separated_data import separation_data
from fits.writing import probability, with_error
from jaxsky.inputs import parameter_unit
from jaxsky.io import write_maps
from jaxsky.settings import Experiment

#: Probabilities below this are worth a word.
UNLIKELY = 1e-3
#: As is E in B above this fraction of a power's standard deviation.
LEAKED = 0.5
#: Name, unit and values of a column of a map's file.
Column = tuple[str, str, np.ndarray]


def _numbers(found: Separation, settings: Experiment) -> dict[str, Any]:
    """All numbers; band powers are D_l of BB in uK_CMB^2."""
    fit, ratio, spectra = found.fit, found.tensors, found.spectra
    bands, truth, simulated = list(found.data.bands), found.data.truth or {}, found.simulated
    small = None
    if found.data.by_pixel:
        values = found.found.probability[np.isfinite(found.found.probability)]
        small = {f"below_{p:g}": float(np.mean(values < p)) for p in (0.05, 0.01, 0.001)}
    results: dict[str, Any] = {
        "domain": settings.separate.domain,
        "components": found.components,
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
        **{key: getattr(fit, key) for key in ("chi2", "dof", "converged", "message")},
        "solver": {key: fit.details[key] for key in ("solver", "steps", "distance")},
        "pixels_with_small_probability": small,
        "cmb_noise_degradation": found.degradation,
        "residual_rms": dict(zip(bands, np.nanstd(found.residuals, axis=(1, 2)), strict=True)),
        "r": {
            "best_fit": ratio.r,
            "sigma": ratio.sigma,
            "upper_95": ratio.upper_95,
            "truth": truth.get("r"),
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
        "simulations": len(simulated.theta),
    }
    if (chain := found.chain) is not None:
        results["posterior"] = {
            "sampler": chain.method,
            "interval_68": {n: chain.of_row(chain.interval_68, n) for n in chain.labels},
            "converged": chain.converged,
            "message": chain.message,
        }
    return results


def _table(found: Separation) -> ResultTable:
    """Parameters and r, with the truth if it is known."""
    fit, truth, ratio = found.fit, found.data.truth or {}, found.tensors
    rows: list[Row] = []
    for name in fit.free:
        value, sigma = np.asarray(fit.best_fit[name]), np.asarray(found.sigma[name])
        shown = with_error(float(np.nanmedian(value)), float(np.nanmedian(sigma)))
        regions = f", median of {int(np.isfinite(value).sum())} regions" if value.ndim else ""
        rows.append((name + regions, shown, f"{truth[name]:g}" if name in truth else ""))
    rows += [
        (),
        ("r", with_error(ratio.r, ratio.sigma), f"{truth.get('r', 0.0):g}"),
        ("r, 95 % below", f"{ratio.upper_95:.2g}", ""),
    ]
    if found.left is not None:
        rows.append(("r, shift by foregrounds left", f"{ratio.shift(found.left):+.1e}", ""))
    degradation = f"{found.degradation:.2f}"
    rows.append(("noise of CMB, times that without foregrounds", degradation, ""))
    header, columns = ("parameter", "best fit", "truth"), 3 if truth else 2
    caption = f"standard deviations; chi2/dof {fit.chi2 / fit.dof:.4f}"
    return ResultTable(header[:columns], [row[:columns] for row in rows], caption)


def separation_warnings(found: Separation, settings: Experiment) -> list[str]:
    """What a user should know before using the numbers, a sentence each."""
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
    if ratio.probability < UNLIKELY:
        sentences.append(
            f"BB of the cleaned CMB is not that of tensors, lensing, noise and errors of laws "
            f"(probability {probability(ratio.probability)}); foregrounds may be left in it."
        )
    share = simulated.leaked.mean(axis=0) / simulated.total.std(axis=0, ddof=1)
    if (share > LEAKED).any():
        sentences.append(
            f"E that leaks into B at the edge of the mask is up to {share.max():.1f} standard "
            "deviations of BB in a bin. It is part of the model, but a larger "
            "separate.apodization makes it and the errors smaller."
        )
    if settings.separate.sampler != "none" and len(fit.labels) > SAMPLED:
        sentences.append(
            f"The posterior was not sampled: {len(fit.labels)} parameters are more than {SAMPLED}."
        )
    if found.chain is not None and not found.chain.converged:
        sentences.append(f"posterior: {found.chain.message}")
    if settings.cmb.A_lens != 1:
        A_lens = settings.cmb.A_lens
        sentences.append(f"The lensing B modes are taken as known, A_lens = {A_lens:g}.")
    return sentences


def _write_maps(out: Path, found: Separation, settings: Experiment) -> list[Path]:
    """Maps of components, residuals, and parameters that have regions."""
    mask, in_pixels = np.isfinite(found.maps).all(axis=(0, 1)), found.data.by_pixel
    components: list[Column] = []
    for name, maps in zip(found.components, found.maps, strict=True):
        unit, head = "uK_CMB" if name == "cmb" else "uK_RJ", name.upper()
        components += [(f"{head}_{s}", unit, x) for s, x in zip("QU", maps[-2:], strict=True)]
        if in_pixels:
            sigma = found.found.sigma(name)[-2:]
            components += [(f"{head}_SIGMA_{s}", unit, x) for s, x in zip("QU", sigma, strict=True)]
    if in_pixels:
        tested = {"CHI2": found.found.chi2, "PROBABILITY": found.found.probability}
        components += [(name, "", values) for name, values in tested.items()]
    residuals: list[Column] = [
        (f"{band}_{stokes}", settings.separate.unit, values)
        for band, maps in zip(found.data.bands, found.residuals[:, -2:], strict=True)
        for stokes, values in zip("QU", maps, strict=True)
    ]
    parameters: list[Column] = [
        (name.upper() + end, parameter_unit(name), found.of_pixel(name, values))
        for name in found.fit.free
        if np.ndim(found.fit.best_fit[name])
        for end, values in (("", found.fit.best_fit), ("_SIGMA", found.sigma))
    ]
    written = []
    for file, columns in zip(MAPS, (components, residuals, parameters), strict=True):
        if columns:
            names, units, values = zip(*columns, strict=True)
            beam = {"FWHM": (settings.common.fwhm, "[arcmin]")} if file == MAPS[0] else None
            written.append(out / file)
            write_maps(
                written[-1],
                np.stack([np.broadcast_to(each, mask.shape) for each in values]),
                names=names,
                unit=units,
                mask=mask,
                extra_header=beam,
                overwrite=True,
                single=True,
            )
    return written


#: Pictures, each with what draws it; maps; and what a stopped run resumes from.
PICTURES = {
    "components.png": pictures.plot_components,
    "residuals.png": pictures.plot_residuals,
    "spectra.png": pictures.plot_spectra,
    "r.png": pictures.plot_ratio,
    "parameters.png": pictures.plot_parameters,
}
POSTERIOR = "posterior.png"
MAPS = ("components.fits", "residuals.fits", "parameters.fits")
KEPT = ("simulations.npz", "chain.npz")


def _work(settings: Experiment, command: Run) -> Report:
    command.steps.step("reading and preparing maps")
    data = separation_data(settings)
    command.begin()
    try:
        found = separate_data(settings, data, command.out, command.steps)
    except FitError as error:
        raise ValueError(f"The spectral parameters were not found. {error}") from None
    drawn: dict[str, Any] = {name: (plot, found, settings) for name, plot in PICTURES.items()}
    if (chain := found.chain) is not None:
        drawn[POSTERIOR] = plot_chains, {chain.method: chain}, data.truth, settings.title
    return Report(
        data.description,
        [_table(found)],
        separation_warnings(found, settings),
        _numbers(found, settings),
        drawn,
        _write_maps(command.out, found, settings),
    )


COMMAND = Command("separate", _work, ("result.json", *MAPS, *PICTURES, POSTERIOR, *KEPT))
