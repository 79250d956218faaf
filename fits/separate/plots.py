"""Pictures of a separation: components, residuals, parameters, spectra, r."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from fits.plots import label
from fits.record import with_error
from fits.separate.separate import Separation
from jaxsky.plots import COLORS, STYLE, UNITS, draw_map, draw_title, plain, save

#: Width of a column of a paper [inch].
COLUMN = 3.5
#: Bands whose residuals are drawn.
SHOWN = 4
CLEANED, NOISE, RESIDUAL, LEFT, LENSING, TRUTH = (*COLORS[:4], "0.5", COLORS[3])


def _unit(found: Separation, name: str) -> str:
    """Of a component's amplitude."""
    return UNITS[found.like.sky[name].unit]


def _title(found: Separation, name: str) -> str:
    component: Any = found.like.sky[name]
    if component.unit == "uK_CMB":
        return name.upper() if name == "cmb" else name
    return f"{name}, {float(component.nu_ref):g} GHz"


def plot_components(path: Path, found: Separation, title: str) -> None:
    """Q and U of the components, a row for each."""
    with mpl.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(found.components),
            2,
            figsize=(7.2, 1.95 * len(found.components) + 0.4),
            squeeze=False,
            layout="constrained",
        )
        for row, name, maps in zip(grid, found.components, found.maps[:, -2:], strict=True):
            limit = float(np.nanquantile(np.abs(maps), 0.99))
            for axes, values, stokes in zip(row, maps, "QU", strict=True):
                draw_map(axes, values, limit, f"{stokes} [{_unit(found, name)}]")
                axes.set_title(plain(f"{_title(found, name)}: {stokes}"))
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def plot_residuals(path: Path, found: Separation, unit: str, title: str) -> None:
    """Data less components in a few bands, Q beside U."""
    names = list(found.setup.domain.bands)
    at = np.unique(np.linspace(0, len(names) - 1, min(SHOWN, len(names))).round().astype(int))
    with mpl.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(at), 2, figsize=(7.2, 1.95 * len(at) + 0.4), squeeze=False, layout="constrained"
        )
        for row, b in zip(grid, at, strict=True):
            maps = found.residuals[b, -2:]
            limit = 3 * float(np.nanstd(maps))
            for axes, values, stokes in zip(row, maps, "QU", strict=True):
                draw_map(axes, values, limit, f"{stokes} [{UNITS[unit]}]", middle=0.0)
                axes.set_title(plain(f"{names[b]}: {stokes}, data less components"))
        draw_title(figure, title, fontsize=9)
        save(figure, path)


def plot_parameters(path: Path, found: Separation, title: str) -> bool:
    """Maps of the parameters that have regions, their errors beside them.

    Returns False, without a picture, if none has.
    """
    varying = [name for name in found.fit.free if np.ndim(found.fit.best_fit[name])]
    if not varying:
        return False
    with mpl.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(varying),
            2,
            figsize=(7.2, 1.95 * len(varying) + 0.4),
            squeeze=False,
            layout="constrained",
        )
        for row, name in zip(grid, varying, strict=True):
            value, sigma = (found.of_pixel(name, x) for x in (found.fit.best_fit, found.sigma))
            middle = float(np.nanmedian(value))
            limit = float(np.nanquantile(np.abs(value - middle), 0.98)) or 1.0
            draw_map(row[0], value, limit, f"${label(name)}$", middle=float(f"{middle:.3g}"))
            half = float(f"{np.nanquantile(sigma, 0.98) / 2:.1g}")
            draw_map(row[1], sigma, half, rf"$\sigma({label(name)})$", middle=half)
            row[0].set_title(f"${label(name)}$, {len(found.fit.best_fit[name])} regions")
            row[1].set_title("its standard deviation")
        draw_title(figure, title, fontsize=9)
        save(figure, path)
    return True


def _positive(values: np.ndarray) -> np.ndarray:
    return np.where(values > 0, values, np.nan)


def plot_spectra(path: Path, found: Separation, title: str) -> None:
    """BB of the cleaned CMB, its noise and residual foregrounds, against the model."""
    ratio, spectra = found.tensors, found.spectra
    ell, edges = spectra.centers, np.array(spectra.edges)
    width = np.stack([ell - edges[:-1], edges[1:] - 1 - ell])
    signal = ratio.powers - ratio.model.additive
    error = np.sqrt(np.diagonal(ratio.covariance))
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(COLUMN, 4.2), layout="constrained")
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
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=7)
        draw_title(figure, title, fontsize=8)
        save(figure, path)


def plot_ratio(path: Path, found: Separation, title: str) -> None:
    """The posterior of the tensor-to-scalar ratio."""
    ratio = found.tensors
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(COLUMN, 3.2), layout="constrained")
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
        if (known := (found.setup.truth or {}).get("r")) is not None:
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
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=7)
        draw_title(figure, title, fontsize=8)
        save(figure, path)


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
