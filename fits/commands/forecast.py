"""`jaxsky forecast`: foreground B modes against primordial ones, and errors on r and the laws."""

from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fits import fisher, plots, pseudo_cl
from fits.commands.report import ResultTable, Row
from fits.commands.run import Command, Report, Run
from fits.common import prepare_component
from fits.mixing import Mixing, unit_sky
from fits.regions import apodize, region_mask
from fits.results import with_error
from jaxsky import Sky, observe_band
from jaxsky.checks import check_double
from jaxsky.cmb import camb_spectra, tensor_spectra
from jaxsky.components import declared
from jaxsky.experiment import map_nside, read_channel
from jaxsky.harmonics import Preparation, gaussian_beam
from jaxsky.inputs import read_sky
from jaxsky.io import degrade_mask
from jaxsky.observation import ObservedBand
from jaxsky.programs import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key

#: Number of bands whose spectra are taken if the settings name none.
SHOWN = 5
#: Line styles of primordial spectra, from the largest r down.
DASHES = ("-", "--", "-.", ":")
LENSING = "#888888"


class ForecastInputs(NamedTuple):
    """Input of a forecast: foregrounds with one beam [arcmin] and one nside, and the bands.

    Spectra are taken in the bands `shown`, with the mask, 0 to 1, as the weight of each pixel.
    """

    sky: Sky
    fwhm: float
    mask: Float[np.ndarray, " pix"]
    bands: dict[str, ObservedBand]
    shown: tuple[str, ...]
    description: str


class Forecast(NamedTuple):
    """Results of a forecast; spectra C_l and band powers D_b are in uK_CMB^2.

    Per band, `powers` are those of EE and BB, `laws` are power laws fitted to BB, and `equal_r` is
    the r whose BB equals the foregrounds, by range of multipoles. `tensors` (r = 1) and `lensed`
    are TT, EE, BB, TE; `parameters` are all those of the bands' covariance, `errors` come from the
    Fisher matrix; `without_foregrounds` is the error on r without any, None where r is not free.
    """

    inputs: ForecastInputs
    spectra: pseudo_cl.MaskedSpectra
    powers: dict[str, Float[np.ndarray, "2 bin"]]
    laws: dict[str, fisher.BandLaw]
    equal_r: dict[str, dict[str, float]]
    tensors: Float[np.ndarray, "4 ell"]
    lensed: Float[np.ndarray, "4 ell"]
    parameters: dict[str, float]
    errors: fisher.Errors
    without_foregrounds: float | None


def forecast_inputs(settings: Experiment) -> ForecastInputs:
    """Read templates, bands and mask, bring the templates to one resolution, and check them."""
    spec, observed = settings.forecast, settings.bands_of("QU")
    for wrong, sentence in (
        (not settings.cmb.include, "cmb.include: is false, but a forecast has a CMB."),
        (settings.cmb.file, "cmb.file: a forecast changes r, which takes spectra of CAMB."),
        (not settings.modelled(), "sky: has no components; a forecast takes some."),
        (not observed, "bands: there are none."),
    ):
        if wrong:
            raise SettingsError(sentence)
    templates, description = read_sky(settings, names=settings.modelled())
    pixels = map_nside(settings, templates)
    bands = {str(one.name): read_channel(settings, one, pixels) for one in observed}
    if silent := [name for name, band in bands.items() if band.noise is None]:
        raise SettingsError(f"bands.{silent[0]}.noise: is missing.")
    shown = spec.bands or plots.spread(tuple(bands), SHOWN)
    fwhm = max(template.fwhm for template in templates.values())
    nside = min(healpy.npix2nside(template.used.size) for template in templates.values())
    window = gaussian_beam(fwhm, 2 * nside - 1)
    if spec.lmax > (reach := int(np.flatnonzero(window >= pseudo_cl.LEAST_WINDOW).max())):
        raise SettingsError(
            f"forecast.lmax: {spec.lmax} is beyond what templates of nside {nside} and a beam of "
            f"{fwhm:g} arcmin resolve, {reach}."
        )
    used = region_mask(settings, spec.region, nside, coarser=True)
    components = {}
    for name, template in templates.items():
        used &= degrade_mask(template.used, nside, 1.0)
        components[name] = template.component
        own = healpy.npix2nside(template.used.size)
        if own != nside or template.fwhm != fwhm:
            operator = Preparation.smoothing(own, template.fwhm, nside, fwhm, 2 * nside)
            components[name] = prepare_component(template.component, operator, template.used)
    mask = apodize(used, spec.apodization)
    if not mask.any():
        raise SettingsError("forecast.region: leaves no pixel.")
    return ForecastInputs(Sky(components), fwhm, mask, bands, tuple(shown), description)


def forecast(settings: Experiment, progress: Progress = QUIET) -> Forecast:
    """Compare foreground B modes with primordial ones, and find errors by the Fisher matrix.

    `progress` is told each step of the work.

    Raises
    ------
    RuntimeError
        Without double precision.
    jaxsky.io.InputError, KeyError, ValueError
        For settings and files that cannot be used; see `forecast_inputs` and
        `fits.fisher.fisher_errors`.
    """
    check_double("A forecast")
    progress.step("reading templates and mask")
    inputs, spec = forecast_inputs(settings), settings.forecast
    progress.step("spectra outside the mask")
    edges = pseudo_cl.bin_edges(spec.lmin, spec.lmax, spec.width)
    window = np.asarray(gaussian_beam(inputs.fwhm, 2 * edges[-1]))
    spectra = pseudo_cl.masked_spectra(inputs.mask, edges, window=window)
    highest = max(spectra.lmax, spec.fisher_lmax, pseudo_cl.PIVOT)
    with at_key("cmb.cosmology"):
        tensors = tensor_spectra(highest, **settings.cmb.cosmology)
        lensed = camb_spectra(highest, **settings.cmb.cosmology)
    bandpasses = {name: band.band for name, band in inputs.bands.items()}
    powers, laws, equal = {}, {}, {}
    for name in inputs.shown:
        band = bandpasses[name]
        emission = observe_band(inputs.sky, band) * band.conversion("uK_RJ", "uK_CMB")
        powers[name] = pseudo_cl.band_powers(spectra, emission)
        with at_key("forecast.fit"):
            laws[name] = fisher.fit_law(spectra, powers[name][1], spec.fit, f"BB in band {name!r}")
        equal[name] = fisher.equal_r(spectra, powers[name], laws[name], tensors)
    progress.step("Fisher matrix")
    fields = tuple(field for field in pseudo_cl.FIELDS if field in spec.spectra)
    ell = np.arange(spec.lmin, spec.fisher_lmax + 1)
    rows = [1 + pseudo_cl.FIELDS.index(field) for field in fields]
    weights = [fisher.noise_weights(b, spec.fisher_lmax)[ell] for b in inputs.bands.values()]
    model = fisher.ForecastModel(
        Mixing.of(unit_sky(inputs.sky, mask=inputs.mask), bandpasses, "uK_CMB"),
        jnp.asarray(np.stack(weights, axis=1)),
        jnp.asarray(tensors[rows][:, ell]),
        jnp.asarray(lensed[rows][:, ell]),
        jnp.asarray(ell, float),
        jnp.asarray(pseudo_cl.sky_fraction(inputs.mask)),
        fields,
    )
    foregrounds = fisher.foreground_laws(inputs.sky, spectra, fields, spec.fit)
    parameters = fisher.fiducial(model.sky, foregrounds, settings.cmb.r, settings.cmb.A_lens)
    errors, without = _errors(settings, model, parameters)
    return Forecast(
        inputs, spectra, powers, laws, equal, tensors, lensed, parameters, errors, without
    )


def _errors(
    settings: Experiment, model: fisher.ForecastModel, parameters: dict[str, float]
) -> tuple[fisher.Errors, float | None]:
    """Return errors on the free parameters, and the error on r without foregrounds or None."""
    spec = settings.forecast
    nuisance = [
        name
        for field in model.fields
        for kind in spec.free
        for name in parameters
        if name.startswith(f"{field}.") and name.endswith(f".{kind}")
    ]
    spectral = settings.free_in("forecast")
    widths = {n: one.gaussian[1] for n, one in spectral.items() if one.gaussian is not None}
    own = [name for name in spec.free if name in parameters]
    free = list(dict.fromkeys((*own, *spectral, *nuisance)))
    with at_key("free"):
        errors = fisher.fisher_errors(model, parameters, free, widths)
    if "r" not in free:
        return errors, None
    none = {n: 0.0 if n.endswith(".amplitude") else v for n, v in parameters.items()}
    return errors, fisher.fisher_errors(model, none, ["r"]).sigma["r"]


def _numbers(found: Forecast, settings: Experiment) -> dict[str, Any]:
    """Return all numbers, D_l in uK_CMB^2 unless their key says otherwise."""
    errors, spectra, lmax = found.errors, found.spectra, settings.forecast.lmax
    results: dict[str, Any] = {
        "bands": list(found.inputs.bands),
        "sky_fraction": pseudo_cl.sky_fraction(found.inputs.mask),
        "bins": {"first": spectra.edges[:-1], "last": [e - 1 for e in spectra.edges[1:]]},
        "foregrounds": {
            name: {
                **dict(zip(pseudo_cl.FIELDS, powers, strict=True)),
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
            "sigma": errors.sigma,
            "sigma_all_others_known": errors.known,
            "covariance": errors.covariance,
            "priors": errors.priors,
        },
    }
    if found.without_foregrounds is not None:
        results["sigma_r"] = {
            "foregrounds_free": errors.sigma["r"],
            "all_else_known": errors.known["r"],
            "no_foregrounds": found.without_foregrounds,
        }
    return results


def _tables(found: Forecast) -> list[ResultTable]:
    """Return the tables of foregrounds per band and of errors."""
    bands, numbers, errors = list[Row](), list[Row](), found.errors
    for name, law in found.laws.items():
        equal = [f"{r:.3g}" for r in found.equal_r[name].values()]
        bands.append((name, f"{law.amplitude:.3g}", f"{law.slope:.2f}", *equal))
    for name in errors.free:
        widths = errors.sigma[name], errors.known[name], errors.priors.get(name)
        shown = ("" if width is None else f"{width:.2g}" for width in widths)
        numbers.append((name, f"{errors.fiducial[name]:.4g}", *shown))
    if found.without_foregrounds is not None:
        numbers += [(), ("r, without foregrounds", "", f"{found.without_foregrounds:.2g}", "", "")]
    ranges = [f"r, {where}" for where in next(iter(found.equal_r.values()))]
    header = ("band", "D_l / uK_CMB^2", "slope of C_l", *ranges)
    caption = f"BB of foregrounds at l = {pseudo_cl.PIVOT}, and the r that has as much"
    other = ("parameter", "value", "error", "others known", "prior")
    marginal = "errors of 68 %, all free parameters marginalised"
    return [ResultTable(header, bands, caption), ResultTable(other, numbers, marginal)]


def forecast_warnings(found: Forecast) -> list[str]:
    """Return warnings to users of the numbers, one sentence each."""
    sentences, errors, sky = list[str](), found.errors, found.inputs.sky
    for name in errors.free:
        component, *field = name.split(".")
        positive = component in sky and declared(type(sky[component]), field[0])["positive"]
        if positive and errors.sigma[name] > errors.fiducial[name]:
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


def plot_b_modes(path: Path, found: Forecast, settings: Experiment) -> None:
    """Draw BB of foregrounds and noise in some bands, against primordial BB."""
    lmax = settings.forecast.lmax
    shown, known = len(found.powers), len(found.inputs.bands)
    title = f"{settings.title}\nB modes" + (f", {shown} of {known} bands" if shown < known else "")
    with plots.draw_panels(path, title.strip(), (plots.COLUMN, 4.3), fontsize=8) as panels:
        axes = panels[0, 0]
        for (name, powers), color in zip(found.powers.items(), plots.COLORS, strict=False):
            BB = np.where(powers[1] > 0, powers[1], np.nan)
            title = plots.band_title(name)
            axes.loglog(found.spectra.centers, BB, color=color, lw=1.8, label=title)
            noise = fisher.noise_weights(found.inputs.bands[name], lmax) ** -2
            axes.loglog(*plots.with_powers(noise), color=color, lw=0.8)
        lensing = {"color": LENSING, "lw": 3.0, "alpha": 0.5, "zorder": 1}  # noise may lie on it
        axes.loglog(*plots.with_powers(found.lensed[2, : lmax + 1]), **lensing)
        bottom = 1.0
        for r, dashes in zip(sorted(settings.forecast.show_r, reverse=True), DASHES, strict=False):
            ell, primordial = plots.with_powers(r * found.tensors[2, : lmax + 1])
            axes.loglog(ell, primordial, color="k", ls=dashes, lw=1.1, label=f"$r = {r:g}$")
            bottom = min(bottom, primordial[: min(100, len(ell))].min())
        axes.plot([], [], **lensing, label="lensing")
        axes.plot([], [], color="k", lw=0.8, label="noise (thin)")
        plots.label_b_modes(axes, 2, lmax, 3)
        axes.set_ylim(bottom=bottom / 2)
        plots.round_numbers(axes.xaxis)


def plot_errors(path: Path, found: Forecast, settings: Experiment) -> None:
    """Draw values with errors and their correlations, without those of foreground spectra in l."""
    errors = found.errors
    names = [n for n in errors.free if not n.startswith(("EE.", "BB."))] or errors.free
    count = len(names)
    matrix = np.array([[errors.correlation(a, b) for b in names] for a in names])
    matrix[np.triu_indices(count)] = np.nan
    height = 1.1 + (plots.COLUMN - 1.9) / max(count, 3) * count
    with plots.draw_panels(path, settings.title, (plots.COLUMN, height), fontsize=8) as panels:
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
    """Return TeX for a parameter, and for its unit."""
    symbol = {"r": "r", "A_lens": r"A_{\rm lens}"}.get(name) or plots.label(name)
    symbol, _, unit = symbol.partition(r"\ [")
    return symbol, rf"\ {unit.rstrip(']')}" if unit else ""


def _value(errors: fisher.Errors, name: str) -> str:
    """Return TeX for a parameter, its value, and two digits of its error."""
    value, sigma = errors.fiducial[name], errors.sigma[name]
    symbol, unit = _symbol(name)
    if not value and sigma < 0.01:
        power = int(np.floor(np.log10(sigma)))
        return rf"${symbol} = 0 \pm {sigma / 10.0**power:.1f} \times 10^{{{power}}}{unit}$"
    shown = with_error(value, sigma).replace("\u00b1", r"\pm")
    return rf"${symbol} = {shown}{unit}$"


def _work(settings: Experiment, command: Run) -> Report:
    found = forecast(settings, command.steps)
    command.begin()
    return Report(
        found.inputs.description,
        _tables(found),
        [*forecast_warnings(found), *settings.left_out("forecast")],
        _numbers(found, settings),
        {"bb.png": (plot_b_modes, found, settings), "fisher.png": (plot_errors, found, settings)},
    )


RESULTS = ("forecast.json", "bb.png", "fisher.png")
COMMAND = Command("forecast", _work, RESULTS, stokes=("QU", "IQU"))
