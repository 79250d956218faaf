"""Maps of spectral indices: read, taken from templates, or drawn."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.harmonics import expand, gaussian_beam, synthesis
from jaxsky.inputs import parameter_map, read
from jaxsky.io import InputError
from jaxsky.presets import from_pysm_beta
from jaxsky.settings import IndexFile, SettingsError, find_file
from jaxsky.templates import dust_index, steepening

#: Resolution of the paper's maps [arcmin], and by how much its synchrotron is made steeper.
FWHM = {"beta_dust": 180.0, "beta_syn": 600.0}
STEEPENING = 0.13
#: Names as they are shown.
SYMBOLS = {"beta_dust": "β_dust", "beta_syn": "β_syn"}
#: What a map has that is drawn: the paper's mean; its scatter, of which the paper gives that of
#: the synchrotron only; and the exponent of its spectrum.
MEAN = {"beta_dust": 1.53, "beta_syn": 2.9}
SCATTER = {"beta_dust": 0.04, "beta_syn": 0.1}
SLOPE = -2.0


class Index(NamedTuple):
    """A map of a spectral index.

    Parameters
    ----------
    values : the index, T ~ nu^-beta_syn for the synchrotron
    fwhm : resolution [arcmin]
    steepening : by how much it was made steeper; None if it is what was drawn
    origin : where it is from, to be part of a sentence
    """

    values: Float[Array, " pix"]
    fwhm: float
    steepening: float | None
    origin: str


def drawn_index(key: Array, name: str, nside: int) -> Index:
    """A Gaussian field with the mean and the scatter of the paper's map."""
    lmax, fwhm = 2 * nside, FWHM[name]
    ell = jnp.arange(lmax + 1)
    root = jnp.where(ell < 1, 0.0, jnp.maximum(ell, 1) ** (SLOPE / 2))
    white = jax.random.normal(key, (1, (lmax + 1) ** 2))
    field = synthesis(white * expand(root * gaussian_beam(fwhm, lmax)), nside)[0]
    values = MEAN[name] + SCATTER[name] * (field - field.mean()) / field.std()
    origin = (
        f"{SYMBOLS[name]} is a Gaussian field of mean {MEAN[name]:g} and scatter {SCATTER[name]:g}"
    )
    return Index(values, fwhm, None, origin)


def held_index(name: str, values: Float[Array, " pix"]) -> Index:
    """The index that a template has in each pixel."""
    nside = healpy.npix2nside(values.size)
    smooth = dust_index(values, 0.0, FWHM[name], nside)
    return Index(smooth, FWHM[name], 0.0, f"{SYMBOLS[name]} is that of the template")


def read_index(folder: Path, name: str, spec: IndexFile) -> Index:
    """The index of a file, smoothed; that of the synchrotron made steeper, if so wished."""
    pure = spec if spec.unit is not None else spec.model_copy(update={"unit": ""})
    where, found = f"paper.{name}", read(folder, pure, stokes="", zeros_are_data=True)
    origin, fwhm, by = f"{SYMBOLS[name]} is that of {spec.label}", max(FWHM[name], spec.fwhm), 0.0
    if name == "beta_syn" and bool(np.all(found.maps[:, found.mask] < 0)):
        found = dataclasses.replace(found, maps=np.asarray(from_pysm_beta(found.maps)))
        origin = f"{origin} with the other sign"
    stated = spec.missing is not None
    values, used = parameter_map(found, name, found.nside, where, stated=stated)
    smooth = dust_index(values, spec.fwhm, fwhm, found.nside, None if used.all() else used)
    if name == "beta_syn":
        given = spec.steepening
        by = _of_spectrum(folder, given) if isinstance(given, str) else given
        origin += f", made steeper by {by:.2f}" if by else ", not made steeper"
    return Index(smooth + by, fwhm, by, origin)


def _of_spectrum(folder: Path, file: str) -> float:
    """By how much a spectrum in a file steepens."""
    try:
        path = find_file(folder, file)
        nu, temperature = np.loadtxt(path, unpack=True, usecols=(0, 1))
        return float(steepening(nu, temperature))
    except InputError as error:
        raise SettingsError(f"paper.beta_syn.steepening: {error}") from None
    except (OSError, ValueError) as error:
        raise SettingsError(f"paper.beta_syn.steepening: {path}: {error}") from None
