"""How simulated maps were observed: tables of bandpass, beam, noise, leakage and truth in files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Array, Float

from jaxsky.bandpass import Bandpass
from jaxsky.experiment import SimulationInputs
from jaxsky.harmonics import beam_ratio
from jaxsky.io import InputError
from jaxsky.io.tables import open_fits
from jaxsky.noise import COVARIANCE_COLUMNS, covariance_from_columns

#: Marks the tables written by this module.
CREATOR = "jaxsky"
#: Numeric columns of each table; those of the noise depend on the Stokes parameters.
TABLES = {
    "BANDPASS": ("NU", "WEIGHT"),
    "BEAM": ("BEAM",),
    "NOISE_SPECTRUM": (),
    "NOISE": (),
    "LEAKAGE": ("Q", "U"),
    "TRUTH": ("VALUE",),
}
#: Columns of the spectrum of smoothed noise, of all Stokes parameters or of each.
SPECTRUM_COLUMNS = {1: ("N_L",), 3: ("N_L_I", "N_L_Q", "N_L_U")}


class Observed(NamedTuple):
    """How a map was observed.

    `beam` is the FWHM of a Gaussian [arcmin], or a table b_l. `noise` is a level [uK_RJ arcmin],
    or several (stokes,), or the covariance of the Stokes parameters in each pixel [uK_RJ^2]. If it
    was smoothed with the map, `noise` is None and `spectrum` is N_l [uK_RJ^2], where known, of all
    Stokes parameters or of each. `leakage` is Q and U leaked from the intensity [uK_RJ], with the
    beam of the map; `truth` has spectral parameters by dotted name.
    """

    bandpass: Bandpass
    beam: float | Float[Array, " ell"]
    noise: float | Float[Array | np.ndarray, "stokes stokes pix"] | None = None
    spectrum: Float[np.ndarray, "*stokes ell"] | None = None
    leakage: Float[np.ndarray, "2 pix"] | None = None
    truth: Mapping[str, float] = {}


def observed_band(setup: SimulationInputs, name: str) -> Observed:
    """Return how the maps of a band are observed."""
    channel = setup.observation.channels[name]
    beam = channel.map_beam
    noise, spectrum = channel.noise, None
    if noise is not None and channel.target is not None:
        if jnp.ndim(noise) < 2:
            lmax = setup.observation.lmax
            window = np.asarray(beam_ratio(beam, channel.beam, lmax, f"band {name!r}"))
            level = np.asarray(noise)[..., None] if jnp.ndim(noise) else float(noise)
            spectrum = (level * np.radians(1 / 60) * window) ** 2
            if setup.observation.stokes == "QU":
                spectrum[:2] = 0.0  # where polarization has no modes
        noise = None
    return Observed(
        channel.band,
        jnp.asarray(beam) if jnp.ndim(beam) else float(beam),
        noise if noise is None or jnp.ndim(noise) > 1 else np.asarray(noise)[()],
        spectrum,
        None if name not in setup.leakage else np.asarray(setup.leakage[name]),
        setup.truth,
    )


def observed_tables(observed: Observed) -> list[pyfits.BinTableHDU]:
    """Return the tables of a FITS file that `read_observed` reads back exactly."""
    band = observed.bandpass
    rows: dict[str, list[Any]] = {"BANDPASS": [band.nu, band.weights]}
    if np.ndim(observed.beam):
        rows["BEAM"] = [observed.beam]
    if observed.spectrum is not None:
        rows["NOISE_SPECTRUM"] = list(np.atleast_2d(observed.spectrum))
    if observed.noise is not None and np.ndim(observed.noise) > 1:
        pixels = np.asarray(observed.noise)
        rows["NOISE"] = list(pixels[np.triu_indices(len(pixels))])
    if observed.leakage is not None:
        rows["LEAKAGE"] = list(observed.leakage)
    if observed.truth:
        rows["TRUTH"] = [list(observed.truth.values())]
    tables = []
    for name, values in rows.items():
        names = TABLES[name] or COVARIANCE_COLUMNS[len(values)]
        if name == "NOISE_SPECTRUM":
            names = SPECTRUM_COLUMNS[len(values)]
        named = zip(names, map(np.asarray, values), strict=True)
        columns = [pyfits.Column(n, "D", array=array) for n, array in named]
        if name == "TRUTH":
            length = max(map(len, observed.truth))
            columns.insert(0, pyfits.Column("NAME", f"{length}A", array=list(observed.truth)))
        tables.append(pyfits.BinTableHDU.from_columns(columns, name=name))
    header = tables[0].header
    header["CREATOR"] = CREATOR
    header["CONVENT"] = (band.convention, "convention of the weights")
    if not np.ndim(observed.beam):
        header["FWHM"] = (float(observed.beam), "[arcmin] beam of the map")
    if observed.noise is not None and np.ndim(observed.noise) < 2:
        of_I, *_, last = np.ravel(observed.noise)[[0, -1]]
        header["NOISE"] = (float(last), "[uK_RJ arcmin] uniform noise")
        if of_I != last:
            header["NOISE_I"] = (float(of_I), "[uK_RJ arcmin] uniform noise of I")
    return tables


def read_observed(path: Path) -> Observed | None:
    """Read how the map in a file was observed; None if it has no `observed_tables`."""
    with open_fits(path) as hdus:
        tables = {hdu.name: hdu for hdu in hdus[1:]}
        if "BANDPASS" not in tables or tables["BANDPASS"].header.get("CREATOR") != CREATOR:
            return None
        header, npix = tables["BANDPASS"].header, hdus[1].header["NAXIS2"]
        found: dict[str, np.ndarray] = {}
        for table, names in TABLES.items():
            if table not in tables:
                continue
            data = tables[table].data
            values = found[table] = np.array([data[n] for n in names or data.names], float)
            if not np.isfinite(values).all():
                raise InputError(f"{path}: its table {table} has values that are not finite.")
            if table in ("NOISE", "LEAKAGE") and values.shape[1] != npix:
                raise InputError(
                    f"{path}: its table {table} has {values.shape[1]} pixels, its map {npix}."
                )
        stated = {key: float(header[key]) for key in ("FWHM", "NOISE", "NOISE_I") if key in header}
        for key, value in stated.items():
            if not 0 <= value < np.inf:
                raise InputError(f"{path}: {key} of its table BANDPASS is {value}.")
        if "FWHM" not in stated and "BEAM" not in found:
            raise InputError(f"{path}: the table of its beam is missing.")
        truth: dict[str, float] = {}
        if "TRUTH" in tables:
            parameters = map(str, tables["TRUTH"].data["NAME"])
            truth = dict(zip(parameters, found["TRUTH"][0].tolist(), strict=True))
        nu, weights = found["BANDPASS"]
        spectrum, noise = found.get("NOISE_SPECTRUM"), found.get("NOISE")
        level: Any = stated.get("NOISE")
        if "NOISE_I" in stated:
            level = np.array([stated["NOISE_I"], level, level])
        return Observed(
            Bandpass(nu, weights, header["CONVENT"]),
            stated["FWHM"] if "FWHM" in stated else jnp.asarray(found["BEAM"][0]),
            level if noise is None else np.asarray(covariance_from_columns(noise)),
            spectrum[0] if spectrum is not None and len(spectrum) == 1 else spectrum,
            found.get("LEAKAGE"),
            truth,
        )
