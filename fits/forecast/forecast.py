"""A forecast, from its settings to numbers."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fits.forecast import b_modes
from fits.forecast.b_modes import BandLaw
from fits.forecast.fisher import Errors, Model, fiducial, fisher_errors, foreground_names, unit_sky
from fits.forecast.setup import Setup, build
from fits.pseudo_cl import (
    MaskedSpectra,
    band_powers,
    bin_edges,
    masked_spectra,
    sky_fraction,
)
from jaxsky.checks import check_double
from jaxsky.cmb import camb_spectra, tensor_spectra
from jaxsky.harmonics import beam_ratio, gaussian_beam
from jaxsky.progress import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key
from jaxsky.sky import unknown_parameter

FIELDS = ("EE", "BB")


class Forecast(NamedTuple):
    """What a forecast finds.

    Parameters
    ----------
    setup : what was forecast
    spectra : how band powers were taken
    powers : band powers D_b of EE and BB by band [uK_CMB^2]
    laws : power laws fitted to BB, by band
    equal_r : r whose BB equals the foregrounds, by band and range of multipoles
    tensors : C_l of TT, EE, BB, TE for r = 1 [uK_CMB^2]
    lensed : those of lensed scalars
    parameters : all parameters of the bands' covariance, with their values
    errors : from the Fisher matrix
    without_foregrounds : error of r without any, None where r is not free
    """

    setup: Setup
    spectra: MaskedSpectra
    powers: dict[str, Float[np.ndarray, "2 bin"]]
    laws: dict[str, BandLaw]
    equal_r: dict[str, dict[str, float]]
    tensors: Float[np.ndarray, "4 ell"]
    lensed: Float[np.ndarray, "4 ell"]
    parameters: dict[str, float]
    errors: Errors
    without_foregrounds: float | None


def forecast(settings: Experiment, progress: Progress = QUIET) -> Forecast:
    """Foreground B modes against primordial ones, and errors from the Fisher matrix.

    Parameters
    ----------
    settings : what is forecast
    progress : told of each step of the work

    Raises
    ------
    RuntimeError
        Without double precision.
    jaxsky.io.InputError, KeyError, ValueError
        For settings and files that cannot work; see `fits.forecast.setup.build` and
        `fits.forecast.fisher.fisher_errors`.
    """
    check_double("A forecast")
    progress.step("reading templates and mask")
    setup, spec = build(settings), settings.forecast
    progress.step("spectra outside the mask")
    edges = bin_edges(spec.lmin, spec.lmax, spec.width)
    window = np.asarray(gaussian_beam(setup.fwhm, 2 * edges[-1]))
    spectra = masked_spectra(setup.mask, edges, window=window)
    bands = {name: setup.bands[name].band for name in setup.shown}
    powers = b_modes.foreground_powers(setup.sky, bands, spectra)
    with at_key("forecast.fit"):
        laws = {
            name: b_modes.fit_law(spectra, D[1], spec.fit, f"BB in band {name!r}")
            for name, D in powers.items()
        }
    highest = max(spectra.lmax, spec.fisher_lmax, b_modes.PIVOT)
    with at_key("cmb.cosmology"):
        tensors = tensor_spectra(highest, **settings.cmb.cosmology)
        lensed = camb_spectra(highest, **settings.cmb.cosmology)
    equal = {
        name: b_modes.equal_r(spectra, powers[name], law, tensors) for name, law in laws.items()
    }
    progress.step("Fisher matrix")
    model, parameters = _model(settings, setup, spectra, tensors, lensed)
    errors, without = _errors(settings, model, parameters)
    return Forecast(
        setup, spectra, powers, laws, equal, tensors, lensed, parameters, errors, without
    )


def _model(
    settings: Experiment,
    setup: Setup,
    spectra: MaskedSpectra,
    tensors: np.ndarray,
    lensed: np.ndarray,
) -> tuple[Model, dict[str, float]]:
    """The covariance of all bands, with the foregrounds' spectra measured outside the mask."""
    spec = settings.forecast
    sky, fields = setup.sky, tuple(f for f in FIELDS if f in spec.spectra)
    rows = [FIELDS.index(field) for field in fields]
    maps = {name: sky[name].amplitude for name in sky}
    auto = {name: band_powers(spectra, values) for name, values in maps.items()}
    laws: dict[tuple[str, str], BandLaw] = {}
    correlations: dict[tuple[str, str, str], float] = {}
    for field, row in zip(fields, rows, strict=True):
        for name, D in auto.items():
            laws[field, name] = b_modes.fit_law(spectra, D[row], spec.fit, f"{field} of {name!r}")
    for first, second in itertools.combinations(maps, 2):
        cross = band_powers(spectra, maps[first], maps[second])
        for field, row in zip(fields, rows, strict=True):
            correlations[field, first, second] = b_modes.correlation(
                spectra, cross[row], auto[first][row], auto[second][row], spec.fit
            )
    ell = np.arange(spec.lmin, spec.fisher_lmax + 1)
    weights = [
        np.asarray(beam_ratio(band.beam, 0.0, spec.fisher_lmax))[ell] / b_modes.noise_level(band)
        for band in setup.bands.values()
    ]
    cmb_rows = np.array(rows) + 1
    model = Model.of(
        unit_sky(sky, setup.mask),
        [band.band for band in setup.bands.values()],
        jnp.asarray(np.stack(weights, axis=1)),
        jnp.asarray(tensors[cmb_rows[:, None], ell]),
        jnp.asarray(lensed[cmb_rows[:, None], ell]),
        jnp.asarray(ell, float),
        jnp.asarray(sky_fraction(setup.mask)),
        fields,
    )
    return model, fiducial(model.sky, laws, correlations, settings.cmb.r, settings.cmb.A_lens)


def _errors(
    settings: Experiment, model: Model, parameters: dict[str, float]
) -> tuple[Errors, float | None]:
    spec = settings.forecast
    nuisance = foreground_names(model.sky, model.fields, spec.foregrounds)
    spectral = settings.free_in("forecast")
    widths = {n: one.gaussian[1] for n, one in spectral.items() if one.gaussian is not None}
    for name in spec.priors:
        if name in widths:
            raise SettingsError(f"forecast.priors: the prior of {name!r} is in the table free.")
    with at_key("free"):
        for name in spectral:
            if name not in parameters:
                raise unknown_parameter(name, parameters)
    with at_key("forecast"):
        free = list(dict.fromkeys((*spec.free, *spectral, *nuisance)))
        errors = fisher_errors(model, parameters, free, widths | spec.priors)
    if "r" not in spec.free:
        return errors, None
    none = {n: 0.0 if n.endswith(".amplitude") else v for n, v in parameters.items()}
    return errors, fisher_errors(model, none, ["r"]).sigma("r")
