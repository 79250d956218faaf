"""What a fit leaves behind: a table, result.json, pictures and a log, each written whole."""

import json
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.table import Table

from fits import plots
from fits.inputs import Inputs
from fits.settings import Settings
from fits.spectral_index import Fit

__all__ = ["result_table", "write_report"]

PACKAGES = ("jaxsky", "jax", "numpy", "healpy", "optimistix", "emcee", "getdist", "camb", "ducc0")


def write_text(path: Path, text: str) -> None:
    """Write a file beside its place and move it there, so that it is never half written."""
    partial = path.with_name(f".{path.name}")
    partial.write_text(text)
    partial.replace(path)


def _result(fit: Fit, method: str) -> dict[str, Any]:
    result = fit.results[method]
    numbers = {
        "free": list(result.free),
        "best_fit": result.best_fit,
        "interval_68": {name: list(pair) for name, pair in result.interval_68.items()},
        "covariance": result.covariance.tolist(),
        "chi2": fit.chi2[method],
        "dof": fit.dof,
        "converged": result.converged,
        "message": result.message,
    }
    if fit.dof_amplitudes is not None:
        numbers |= {"chi2_amplitudes": result.chi2, "dof_amplitudes": fit.dof_amplitudes}
    for key in ("tau", "acceptance", "discard", "steps"):
        if key in result.details:
            numbers[key] = result.details[key]
    return numbers


def result_json(inputs: Inputs, settings: Settings, fits: Sequence[Fit]) -> dict[str, Any]:
    """All numbers: `results` by region, then Stokes parameters, then method."""
    results: dict[str, Any] = {}
    for fit in fits:
        methods = {method: _result(fit, method) for method in fit.results}
        results.setdefault(fit.region, {})[fit.stokes] = methods
    return {
        "description": inputs.description,
        "likelihood": settings.analysis.likelihood,
        "truth": inputs.truth,
        "results": results,
    }


def result_table(fits: Sequence[Fit]) -> Table:
    """The best fits and 68 % intervals for the terminal."""
    free = next(iter(fits[0].results.values())).free
    table = Table(caption="best fit and central 68 % interval; chi2 is the sum over pixels")
    for column in ("region", "Stokes", "method", *free, "chi2 / dof"):
        table.add_column(column, justify="left" if column == "region" else "right")
    for fit in fits:
        for method, result in fit.results.items():
            cells = []
            for name in free:
                low, high = result.interval_68[name]
                best = result.best_fit[name]
                cells.append(f"{best:.4g} [{low:.4g}, {high:.4g}]")
            mark = "" if result.converged else " (!)"
            chi2 = f"{fit.chi2[method]:.0f} / {fit.dof}"
            table.add_row(fit.region, fit.stokes, method + mark, *cells, chi2)
        table.add_section()
    return table


def write_report(
    out: Path, inputs: Inputs, settings: Settings, fits: Sequence[Fit], seconds: float
) -> list[Path]:
    """Write result.json, the pictures and log.json to a folder; returns what was written.

    Pictures that the fits do not allow (a grid of more than two parameters) are left out.
    """
    written = [out / "result.json", out / "log.json"]
    write_text(written[0], json.dumps(result_json(inputs, settings, fits), indent=2) + "\n")
    for name, plot in {
        "grid.png": plots.plot_grids,
        "marginals.png": plots.plot_marginals,
        "posterior.png": plots.plot_posterior,
    }.items():
        if plot(out / name, fits, inputs.truth, inputs.description):
            written.append(out / name)
    log = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "seconds": round(seconds, 2),
        "python": platform.python_version(),
        "machine": platform.platform(),
        "versions": {name: version(name) for name in PACKAGES},
        "settings": settings.model_dump(mode="json", exclude_none=True),
    }
    write_text(written[1], json.dumps(log, indent=2) + "\n")
    return written
