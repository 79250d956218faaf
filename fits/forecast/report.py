"""What a forecast leaves behind: tables, forecast.json, pictures and a log, each written whole."""

from pathlib import Path
from typing import Any

import jax
from rich.table import Table

from fits.forecast import plots
from fits.forecast.b_modes import PIVOT
from fits.forecast.forecast import Forecast
from fits.pseudo_cl import sky_fraction
from fits.record import write_json, write_log
from jaxsky.components import declared
from jaxsky.settings import Experiment


def forecast_json(found: Forecast, settings: Experiment) -> dict[str, Any]:
    """All numbers, D_l in uK_CMB^2 unless their key says otherwise."""
    errors, spectra, lmax = found.errors, found.spectra, settings.forecast.lmax
    results: dict[str, Any] = {
        "description": found.setup.description,
        "bands": list(found.setup.bands),
        "sky_fraction": sky_fraction(found.setup.mask),
        "bins": {"first": spectra.edges[:-1], "last": [e - 1 for e in spectra.edges[1:]]},
        "foregrounds": {
            name: {
                "EE": powers[0],
                "BB": powers[1],
                "BB_law": found.laws[name]._asdict(),
                "equal_r": found.equal_r[name],
            }
            for name, powers in found.powers.items()
        },
        "C_l_BB": {
            "tensors_r_1": found.tensors[2, : lmax + 1],
            "lensing": found.lensed[2, : lmax + 1],
        },
        "parameters": found.parameters,
        "fisher": {
            "free": errors.free,
            "sigma": {name: errors.sigma(name) for name in errors.free},
            "sigma_all_others_known": errors.known,
            "covariance": errors.covariance,
            "priors": errors.priors,
        },
    }
    if found.without_foregrounds is not None:
        results["sigma_r"] = {
            "foregrounds_free": errors.sigma("r"),
            "all_else_known": errors.known["r"],
            "no_foregrounds": found.without_foregrounds,
        }
    return results


def tables(found: Forecast) -> list[Table]:
    """The foregrounds in bands, and the errors, for the terminal."""
    bands = Table(caption=f"BB of foregrounds at l = {PIVOT}, and the r that has as much")
    bands.add_column("band")
    for column in ("D_l / uK_CMB^2", "slope of C_l", *next(iter(found.equal_r.values()))):
        heading = column if column[0] in "Ds" else f"r, {column}"
        bands.add_column(heading, justify="right")
    for name, law in found.laws.items():
        equal = [f"{r:.3g}" for r in found.equal_r[name].values()]
        bands.add_row(name, f"{law.amplitude:.3g}", f"{law.slope:.2f}", *equal)

    errors = found.errors
    numbers = Table(caption="errors of 68 %, all free parameters marginalised")
    for i, column in enumerate(("parameter", "value", "error", "others known", "prior")):
        numbers.add_column(column, justify="right" if i else "left")
    for name in errors.free:
        prior = errors.priors.get(name)
        numbers.add_row(
            name,
            f"{errors.fiducial[name]:.4g}",
            f"{errors.sigma(name):.2g}",
            f"{errors.known[name]:.2g}",
            "" if prior is None else f"{prior:.2g}",
        )
    if found.without_foregrounds is not None:
        numbers.add_section()
        numbers.add_row("r, without foregrounds", "", f"{found.without_foregrounds:.2g}")
    return [bands, numbers]


def warnings(found: Forecast) -> list[str]:
    """What a user should know before using the numbers, a sentence each."""
    sentences = []
    errors, sky = found.errors, found.setup.sky
    for name in errors.free:
        component, *field = name.split(".")
        if component not in sky or not declared(type(sky[component]), field[0])["positive"]:
            continue
        if errors.sigma(name) > errors.fiducial[name]:
            sentences.append(
                f"{name}: the error is larger than the value; the Fisher matrix, good for small "
                "errors, says only that this is not measured."
            )
    varying = [name for name in sky if any(x.ndim == 1 for x in jax.tree.leaves(sky[name]))]
    if varying:
        sentences.append(
            f"Laws of {', '.join(varying)} vary over the sky; the Fisher matrix has their mean "
            "and leaves out what the variation takes from the correlation of bands."
        )
    return sentences


def write_report(out: Path, found: Forecast, settings: Experiment, seconds: float) -> list[Path]:
    """Write forecast.json, the pictures and log.json to a folder; returns what was written."""
    written = [out / name for name in ("forecast.json", "log.json", "bb.png", "fisher.png")]
    write_json(written[0], forecast_json(found, settings))
    write_log(written[1], settings, seconds)
    plots.plot_b_modes(written[2], found, settings)
    plots.plot_errors(written[3], found)
    return written
