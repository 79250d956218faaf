"""Pictures of a forecast: B modes of foregrounds and primordial ones; errors."""

from pathlib import Path
from typing import Any

import numpy as np

from fits.commands.forecast import Forecast
from fits.fisher import Errors
from fits.plots import (
    COLORS,
    COLUMN,
    draw_panels,
    label,
    label_b_modes,
    plain,
    round_numbers,
    with_powers,
)
from fits.tensor_ratio import noise_weights
from fits.writing import with_error
from jaxsky.settings import Experiment

#: Primordial spectra, from the largest r on.
DASHES = ("-", "--", "-.", ":")
LENSING = "#888888"


def plot_b_modes(path: Path, found: Forecast, settings: Experiment) -> None:
    """BB of the foregrounds in some bands and their noise, against primordial BB."""
    lmax = settings.forecast.lmax
    with draw_panels(path, "", (COLUMN, 3.9)) as panels:
        axes = panels[0, 0]
        for (name, powers), color in zip(found.powers.items(), COLORS, strict=False):
            BB = np.where(powers[1] > 0, powers[1], np.nan)
            axes.loglog(found.spectra.centers, BB, color=color, lw=1.8, label=plain(_band(name)))
            noise = noise_weights(found.inputs.bands[name], lmax) ** -2
            axes.loglog(*with_powers(noise), color=color, lw=0.7)
        axes.loglog(*with_powers(found.lensed[2, : lmax + 1]), color=LENSING, lw=1.2)
        bottom = 1.0
        for r, dashes in zip(sorted(settings.forecast.show_r, reverse=True), DASHES, strict=False):
            ell, primordial = with_powers(r * found.tensors[2, : lmax + 1])
            axes.loglog(ell, primordial, color="k", ls=dashes, lw=1.1, label=f"$r = {r:g}$")
            bottom = min(bottom, primordial[: min(100, len(ell))].min())
        axes.plot([], [], color=LENSING, lw=1.2, label="lensing")
        axes.plot([], [], color="k", lw=0.7, label="noise (thin)")
        label_b_modes(axes, 2, lmax, 3)
        axes.set_ylim(bottom=bottom / 2)
        round_numbers(axes.xaxis)


def _band(name: str) -> str:
    """A band's name, with a unit if it is a number."""
    return f"{name} GHz" if name.isdigit() else name


def plot_errors(path: Path, found: Forecast) -> None:
    """Values with errors, and how the errors are correlated, without foregrounds' spectra in l."""
    errors = found.errors
    beside = [n for n in errors.free if not n.startswith(("EE.", "BB."))]
    names = beside or list(errors.free)
    count = len(names)
    matrix = np.array([[errors.correlation(a, b) for b in names] for a in names])
    matrix[np.triu_indices(count)] = np.nan
    height = 0.75 + (COLUMN - 1.9) / max(count, 3) * count
    with draw_panels(path, "", (COLUMN, height)) as panels:
        axes = panels[0, 0]
        axes.imshow(matrix, cmap="RdBu_r", vmin=-1.3, vmax=1.3, aspect="auto")
        for (row, column), value in np.ndenumerate(matrix):
            if row > column:
                text = f"{value:+.2f}".replace("0.", ".").replace("-", "\u2212")
                text = "0" if abs(value) < 0.005 else text
                color = "w" if abs(value) > 0.6 else "k"
                axes.text(column, row, text, ha="center", va="center", fontsize=7, color=color)
        symbols = [f"${_symbol(name)[0]}$" for name in names]
        turned: Any = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
        axes.set_xticks(range(count), symbols, fontsize=8, **turned)
        axes.set_yticks(range(count), [_value(errors, name) for name in names], fontsize=8)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_title("errors of 68 % and their correlation", fontsize=8, loc="right")


def _symbol(name: str) -> tuple[str, str]:
    """TeX for a parameter, and its unit."""
    symbol = {"r": "r", "A_lens": r"A_{\rm lens}"}.get(name) or label(name)
    symbol, _, unit = symbol.partition(r"\ [")
    return symbol, rf"\ {unit.rstrip(']')}" if unit else ""


def _value(errors: Errors, name: str) -> str:
    """A parameter with its value and two digits of its error."""
    value, sigma = errors.fiducial[name], errors.sigma(name)
    symbol, unit = _symbol(name)
    if not value and sigma < 0.01:
        power = int(np.floor(np.log10(sigma)))
        return rf"${symbol} = 0 \pm {sigma / 10.0**power:.1f} \times 10^{{{power}}}{unit}$"
    shown = with_error(value, sigma).replace("\u00b1", r"\pm")
    return rf"${symbol} = {shown}{unit}$"
