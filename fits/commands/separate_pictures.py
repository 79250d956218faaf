"""Pictures of a separation: components, residuals, parameters, spectra, r."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from fits.cleaning import Separation
from fits.plots import (
    COLORS,
    COLUMN,
    UNITS,
    MapPanel,
    color_limit,
    draw_panels,
    label,
    legend_below,
    plot_maps,
    spread,
    stokes_panels,
)
from fits.writing import with_error

#: Bands whose residuals are drawn.
SHOWN = 4
CLEANED, NOISE, RESIDUAL, LEFT, LENSING, TRUTH = (*COLORS[:4], "0.5", COLORS[3])


def _title(found: Separation, name: str) -> str:
    component: Any = found.like.sky[name]
    if component.unit == "uK_CMB":
        return name.upper() if name == "cmb" else name
    return f"{name}, {float(component.nu_ref):g} GHz"


def plot_components(path: Path, found: Separation, title: str) -> None:
    """Q and U of the components, a row for each."""
    rows = [
        stokes_panels(_title(found, name), maps, color_limit(maps), found.like.sky[name].unit)
        for name, maps in zip(found.components, found.maps[:, -2:], strict=True)
    ]
    plot_maps(path, rows, title)


def plot_residuals(path: Path, found: Separation, unit: str, title: str) -> None:
    """Data less components in a few bands, Q beside U."""
    names, rows = list(found.data.bands), []
    for name in spread(names, SHOWN):
        maps = found.residuals[names.index(name), -2:]
        limit = 3 * float(np.nanstd(maps))
        rows.append(stokes_panels(f"{name}, data less components", maps, limit, unit, 0.0))
    plot_maps(path, rows, title)


def plot_parameters(path: Path, found: Separation, title: str) -> bool:
    """Maps of the parameters that have regions, their errors beside them.

    Returns False, without a picture, if none has.
    """
    rows = []
    for name in found.fit.free:
        if not np.ndim(found.fit.best_fit[name]):
            continue
        value, sigma = (found.of_pixel(name, x) for x in (found.fit.best_fit, found.sigma))
        middle = float(np.nanmedian(value))
        half = float(f"{np.nanquantile(sigma, 0.98) / 2:.1g}")
        symbol, regions = label(name), len(found.fit.best_fit[name])
        head, center = f"${symbol}$, {regions} regions", float(f"{middle:.3g}")
        limit, error = color_limit(value - middle, 0.98), "its standard deviation"
        rows.append(
            [
                MapPanel(head, value, limit, f"${symbol}$", center),
                MapPanel(error, sigma, half, rf"$\sigma({symbol})$", half),
            ]
        )
    if rows:
        plot_maps(path, rows, title)
    return bool(rows)


def _positive(values: np.ndarray) -> np.ndarray:
    return np.where(values > 0, values, np.nan)


def plot_spectra(path: Path, found: Separation, title: str) -> None:
    """BB of the cleaned CMB, its noise and residual foregrounds, against the model."""
    ratio, spectra = found.tensors, found.spectra
    ell, edges = spectra.centers, np.array(spectra.edges)
    width = np.stack([ell - edges[:-1], edges[1:] - 1 - ell])
    signal = ratio.powers - ratio.model.additive
    error = np.sqrt(np.diagonal(ratio.covariance))
    with draw_panels(path, title, (COLUMN, 4.2), fontsize=8) as panels:
        axes = panels[0, 0]
        seen = signal > 0
        axes.errorbar(
            ell[seen],
            signal[seen],
            yerr=[np.minimum(error, 0.99 * np.abs(signal))[seen], error[seen]],
            xerr=width[:, seen],
            fmt="o",
            ms=3,
            lw=1.0,
            color=CLEANED,
            label="cleaned, noise subtracted",
        )
        if not seen.all():
            upper = np.maximum(signal, 0) + 2 * error
            axes.plot(
                ell[~seen], upper[~seen], "v", ms=4, color=CLEANED, label=r"below 0: $2\sigma$"
            )
        axes.plot(ell, _positive(ratio.model.lensing), color=LENSING, lw=1.4, label="lensing")
        for r, dashes in ((0.01, "--"), (0.001, ":")):
            primordial = r * ratio.model.tensors
            axes.plot(ell, primordial, color="k", ls=dashes, lw=1.1, label=f"$r = {r:g}$")
        noise = found.simulated.noise.mean(axis=0)
        axes.plot(ell, _positive(noise), color=NOISE, lw=1.4, label="noise")
        residual = found.simulated.residual.mean(axis=0)
        axes.plot(
            ell, _positive(residual), color=RESIDUAL, lw=1.4, label="residuals, from errors of laws"
        )
        if found.left is not None:
            axes.plot(
                ell,
                _positive(found.left),
                "-.",
                color=LEFT,
                lw=1.4,
                label="foregrounds left (known)",
            )
        axes.set(
            yscale="log",
            xlim=(edges[0], edges[-1] - 1),
            xlabel=r"multipole $\ell$",
            ylabel=rf"$\ell(\ell+1)C_\ell^{{BB}}/2\pi$ [{UNITS['uK_CMB']}$^2$]",
        )
        lowest = [residual] if found.left is None else [residual, found.left]
        low = min(np.nanmin(_positive(values)) for values in lowest) / 3
        axes.set_ylim(bottom=max(low, np.nanmax(ratio.model.lensing) * 1e-8))
        axes.yaxis.set_major_locator(mpl.ticker.LogLocator(numticks=20))
        legend_below(axes, 2, fontsize=7)


def plot_ratio(path: Path, found: Separation, title: str) -> None:
    """The posterior of the tensor-to-scalar ratio."""
    ratio = found.tensors
    with draw_panels(path, title, (COLUMN, 3.2), fontsize=8) as panels:
        axes = panels[0, 0]
        axes.plot(ratio.grid, ratio.posterior, color=CLEANED, label=r"posterior, $r \geq 0$")
        below = ratio.grid <= ratio.upper_95
        axes.fill_between(
            ratio.grid[below],
            ratio.posterior[below],
            color=CLEANED,
            alpha=0.2,
            lw=0,
            label=f"95 %: $r < {_two_digits(ratio.upper_95)}$",
        )
        _interval(axes, ratio.r, ratio.sigma)
        if (known := (found.data.truth or {}).get("r")) is not None:
            axes.axvline(known, color=TRUTH, lw=1.6, label="truth")
        low = min(0.0, ratio.r - 1.3 * ratio.sigma)
        shown = ratio.grid[ratio.posterior > 2e-3].max()
        axes.set(
            xlim=(low, max(shown, ratio.r + 1.5 * ratio.sigma)),
            ylim=(0, 1.25),
            xlabel="tensor-to-scalar ratio $r$",
            ylabel="relative probability",
        )
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
        legend_below(axes, 2, fontsize=7)


def _interval(axes: Axes, r: float, sigma: float) -> None:
    """The estimate with its error, above the curve."""
    axes.errorbar(
        [r],
        [1.12],
        xerr=[sigma],
        fmt="o",
        color="k",
        ms=3.5,
        lw=1.2,
        capsize=2,
        label=f"estimate {with_error(r, sigma)}",
    )


def _two_digits(value: float) -> str:
    """A number in two significant digits, without an exponent."""
    digits = max(0, 1 - int(np.floor(np.log10(value)))) if value > 0 else 1
    return f"{value:.{digits}f}"
