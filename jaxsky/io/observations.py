"""How a simulated map was observed, kept in its file: bandpass, beam, noise, leakage, truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Array, Float

from jaxsky.bandpass import Bandpass
from jaxsky.io.files import InputError
from jaxsky.io.tables import open_fits

#: Whose maps have these tables.
CREATOR = "jaxsky"
NOISE = ("QQ", "QU", "UU")


class Observed(NamedTuple):
    """How a map was observed; maps and noise in uK_RJ.

    Parameters
    ----------
    bandpass : of the band
    beam : FWHM of a Gaussian [arcmin], or a table b_l
    level : of uniform noise [uK_RJ arcmin], None where it is not
    spectrum : N_l of noise that was smoothed with the map [uK_RJ^2], None where it was not
    covariance : of Q and U in each pixel [uK_RJ^2], None where noise is uniform
    leakage : Q and U that leaked from the intensity [uK_RJ], with the beam of the map
    truth : spectral parameters of the sky, by dotted name
    """

    bandpass: Bandpass
    beam: float | Float[Array, " ell"]
    level: float | None = None
    spectrum: Float[np.ndarray, " ell"] | None = None
    covariance: Float[np.ndarray, "2 2 pix"] | None = None
    leakage: Float[np.ndarray, "2 pix"] | None = None
    truth: Mapping[str, float] = {}


def observed_tables(observed: Observed) -> list[pyfits.BinTableHDU]:
    """Tables of a FITS file that `read_observed` reads back, exactly."""
    band = observed.bandpass
    columns: dict[str, dict[str, np.ndarray]] = {
        "BANDPASS": {"NU": np.asarray(band.nu), "WEIGHT": np.asarray(band.weights)}
    }
    if np.ndim(observed.beam):
        columns["BEAM"] = {"BEAM": np.asarray(observed.beam)}
    if observed.spectrum is not None:
        columns["NOISE_SPECTRUM"] = {"N_L": np.asarray(observed.spectrum)}
    if observed.covariance is not None:
        matrix = np.asarray(observed.covariance)[-2:, -2:]
        parts = matrix[0, 0], matrix[0, 1], matrix[1, 1]
        columns["NOISE"] = dict(zip(NOISE, parts, strict=True))
    if observed.leakage is not None:
        columns["LEAKAGE"] = dict(zip("QU", np.asarray(observed.leakage), strict=True))
    if observed.truth:
        names = np.array(list(observed.truth))
        columns["TRUTH"] = {"NAME": names, "VALUE": np.array(list(observed.truth.values()))}
    tables = []
    for name, rows in columns.items():
        made = [
            pyfits.Column(n, f"{v.dtype.itemsize // 4}A" if v.dtype.kind == "U" else "D", array=v)
            for n, v in rows.items()
        ]
        tables.append(pyfits.BinTableHDU.from_columns(made, name=name))
    header = tables[0].header
    header["CREATOR"] = CREATOR
    header["CONVENT"] = (band.convention, "convention of the weights")
    if not np.ndim(observed.beam):
        header["FWHM"] = (float(observed.beam), "[arcmin] beam of the map")
    if observed.level is not None:
        header["NOISE"] = (observed.level, "[uK_RJ arcmin] uniform noise")
    return tables


def read_observed(path: Path) -> Observed | None:
    """How the map in a file was observed; None if `observed_tables` did not write it."""
    with open_fits(path) as hdus:
        tables = {hdu.name: hdu for hdu in hdus[1:]}
        if "BANDPASS" not in tables or tables["BANDPASS"].header.get("CREATOR") != CREATOR:
            return None
        header = tables["BANDPASS"].header

        def column(table: str, name: str) -> np.ndarray:
            values = np.array(tables[table].data[name], float)
            if not np.isfinite(values).all():
                raise InputError(f"{path}: the column {name} of its table {table} is not finite.")
            return values

        def number(key: str) -> float | None:
            if (value := header.get(key)) is not None and not 0 <= float(value) < np.inf:
                raise InputError(f"{path}: {key} of its table BANDPASS is {value}.")
            return None if value is None else float(value)

        def maps(table: str, names: Sequence[str]) -> list[np.ndarray] | None:
            if table not in tables:
                return None
            found, npix = [column(table, name) for name in names], hdus[1].header["NAXIS2"]
            if found[0].size != npix:
                raise InputError(
                    f"{path}: its table {table} has {found[0].size} pixels, its map {npix}."
                )
            return found

        beam: float | Array | None = number("FWHM")
        if beam is None and "BEAM" in tables:
            beam = jnp.asarray(column("BEAM", "BEAM"))
        if beam is None:
            raise InputError(f"{path}: the table of its beam is missing.")
        spectral = "NOISE_SPECTRUM" in tables
        noise, leakage = maps("NOISE", NOISE), maps("LEAKAGE", "QU")
        truth: dict[str, float] = {}
        if "TRUTH" in tables:
            names = [str(name) for name in tables["TRUTH"].data["NAME"]]
            truth = dict(zip(names, column("TRUTH", "VALUE").tolist(), strict=True))
        return Observed(
            Bandpass(column("BANDPASS", "NU"), column("BANDPASS", "WEIGHT"), header["CONVENT"]),
            beam,
            number("NOISE"),
            column("NOISE_SPECTRUM", "N_L") if spectral else None,
            np.array([noise[:2], noise[1:]]) if noise else None,
            np.array(leakage) if leakage else None,
            truth,
        )
