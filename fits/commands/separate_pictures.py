"""Pictures of a separation: components, residuals, parameters, spectra, r."""

from pathlib import Path
from typing import Any

import numpy as np

from fits.cleaning import Separation
from fits.plots import (
    COLORS,
    COLUMN,
    MapPanel,
    color_limit,
    draw_panels,
    label,
    label_b_modes,
    legend_below,
    plot_maps,
    spread,
    stokes_panels,
)
from fits.writing import two_digits, with_error
from jaxsky.settings import Experiment

#: Bands whose residuals are drawn.
SHOWN = 4
CLEANED, NOISE, RESIDUAL, LEFT, LENSING, TRUTH = (*COLORS[:4], "0.5", COLORS[3])


def _title(found: Separation, name: str) -> str:
    if name == "cmb":
        return "CMB"
    nu_ref = getattr(found.like.mixing.sky[name], "nu_ref", None)
    return name if nu_ref is None else f"{name}, {float(nu_ref):g} GHz"


def plot_components(path: Path, found: Separation, settings: Experiment) -> None:
    """Q and U of the components, a row for each."""
    sky = found.like.mixing.sky
    rows = [
        stokes_panels(_title(found, name), maps, color_limit(maps), sky[name].unit)
        for name, maps in zip(found.components, found.maps[:, -2:], strict=True)
    ]
    plot_maps(path, rows, settings.title)


def plot_residuals(path: Path, found: Separation, settings: Experiment) -> None:
    """Data less components in a few bands, Q beside U."""
    names, rows, unit = list(found.data.bands), [], settings.separate.unit
    for name in spread(names, SHOWN):
        maps = found.residuals[names.index(name), -2:]
        limit = 3 * float(np.nanstd(maps))
        rows.append(stokes_panels(f"{name}, data less components", maps, limit, unit, 0.0))
    plot_maps(path, rows, settings.title)


def plot_parameters(path: Path, found: Separation, settings: Experiment) -> bool:
    """Maps of the parameters that have regions, their errors beside them.

    Returns False, without a picture, if none has.
    """
    rows = []
    for name in found.fit.free:
        if not np.ndim(found.fit.best_fit[name]):
            continue
        value, sigma = (found.of_pixel(name, x) for x in (found.fit.best_fit, found.sigma))
        middle, symbol = float(np.nanmedian(value)), label(name)
        half = float(f"{np.nanquantile(sigma, 0.98) / 2:.1g}")
        head = f"${symbol}$, {len(found.fit.best_fit[name])} regions"
        limit, center = color_limit(value - middle, 0.98), float(f"{middle:.3g}")
        error = MapPanel("its standard deviation", sigma, half, rf"$\sigma({symbol})$", half)
        rows.append([MapPanel(head, value, limit, f"${symbol}$", center), error])
    if rows:
        plot_maps(path, rows, settings.title)
    return bool(rows)


def plot_spectra(path: Path, found: Separation, settings: Experiment) -> None:
    """BB of the cleaned CMB, its noise and residual foregrounds, against the model."""
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
    with draw_panels(path, settings.title, (COLUMN, 4.2), fontsize=8) as panels:
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
        label_b_modes(axes, edges[0], edges[-1] - 1, 2)
        lowest = min(x[x > 0].min(initial=np.inf) for x in (residual, found.left) if x is not None)
        axes.set_ylim(bottom=max(lowest / 3, np.nanmax(model.lensing) * 1e-8))


def plot_ratio(path: Path, found: Separation, settings: Experiment) -> None:
    """The posterior of the tensor-to-scalar ratio, and above it the estimate with its error."""
    ratio = found.tensors
    r, sigma, grid, posterior = ratio.r, ratio.sigma, ratio.grid, ratio.posterior
    with draw_panels(path, settings.title, (COLUMN, 3.2), fontsize=8) as panels:
        axes, below = panels[0, 0], grid <= ratio.upper_95
        axes.plot(grid, posterior, color=CLEANED, label=r"posterior, $r \geq 0$")
        limit = f"95 %: $r < {two_digits(ratio.upper_95)}$"
        axes.fill_between(
            grid[below], posterior[below], color=CLEANED, alpha=0.2, lw=0, label=limit
        )
        marker: Any = {"fmt": "o", "color": "k", "ms": 3.5, "lw": 1.2, "capsize": 2}
        axes.errorbar(r, 1.12, xerr=sigma, label=f"estimate {with_error(r, sigma)}", **marker)
        if (known := (found.data.truth or {}).get("r")) is not None:
            axes.axvline(known, color=TRUTH, lw=1.6, label="truth")
        shown = grid[posterior > 2e-3].max()
        axes.set(
            xlim=(min(0.0, r - 1.3 * sigma), max(shown, r + 1.5 * sigma)),
            ylim=(0, 1.25),
            xlabel="tensor-to-scalar ratio $r$",
            ylabel="relative probability",
        )
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
        legend_below(axes, 2, fontsize=7)
