"""Beam windows in files: WMAP tables, plain text, HEALPix and Planck FITS tables."""

from pathlib import Path

import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Float

from jaxsky.io.spectra import fits_table, is_fits, multipole_range
from jaxsky.io.tables import InputError, open_fits
from jaxsky.io.text import text_table

#: Columns that hold b_l: HEALPix, Planck's T E B windows, HFI's and LFI's instrument models.
_COLUMNS = ("TEMPERATURE", "INTENSITY", "T", "NOMINAL", "BL")


def _windows(hdu: object) -> list[str]:
    """Names of a table's columns that hold windows; none for other HDUs."""
    names = hdu.columns.names if isinstance(hdu, pyfits.BinTableHDU | pyfits.TableHDU) else []
    return [name for name in names if name.upper() in _COLUMNS]


def _read_fits(path: Path, hdu: int | str) -> tuple[np.ndarray, np.ndarray]:
    with open_fits(path) as hdus:
        table = fits_table(path, hdus, hdu)
        names = _windows(table)
        if not names:
            others = [h.name for h in hdus if _windows(h)]
            hint = f"; give `hdu`, one of {', '.join(others)}" if others else ""
            raise InputError(
                f"{path}, HDU {hdu!r}: no column is named {', '.join(_COLUMNS)}; "
                f"it has {', '.join(table.columns.names)}{hint}."
            )
        window = np.array(table.data.field(names[0]), np.float64).ravel()
    return np.arange(window.size, dtype=float), window


def _read_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    _, table = text_table(path)
    if table.shape[1] < 2:
        raise InputError(f"{path}: one column, but l and b_l are needed.")
    return table[:, 0], table[:, 1]


def read_beam(path: str | Path, lmax: int, *, hdu: int | str = 1) -> Float[np.ndarray, " ell"]:
    """Window b_l of a beam from a file, l = 0 ... lmax, normalised to 1 at l = 0.

    The table must hold b_l, by which a_lm are multiplied, not its square.

    * Text with columns l and b_l (`jaxsky.io.text.read_text`), IPAC tables as of WMAP among it;
      further columns are ignored.
    * FITS tables from l = 0 on, of HEALPix or Planck: the first column named TEMPERATURE,
      INTENSITY, T, NOMINAL or BL, so of a file with several that of the temperature.

    The normalisation takes out what a main beam misses in its far sidelobes (1 % at 30 GHz in
    LFI_RIMO_R3.31).

    Parameters
    ----------
    path : text or FITS file
    lmax : largest multipole; tables are not extrapolated
    hdu : number or name of the FITS table, for example "BEAMWF_030X030" of an instrument model

    Raises
    ------
    InputError
        If the file is missing or damaged; has no such column or table; has gaps in l, does not
        begin at l = 0 or ends below lmax; or has values that are not finite, or is not positive
        at l = 0.
    ValueError
        If lmax is negative.
    """
    path = Path(path)
    ell, window = _read_fits(path, hdu) if is_fits(path) else _read_text(path)
    _, rows = multipole_range(path, ell, lmax, 0)
    window = window[:rows]
    if bad := int(np.sum(~np.isfinite(window))):
        raise InputError(f"{path}: {bad} of {rows} values of the window are not finite.")
    if not window[0] > 0:
        raise InputError(f"{path}: the window must be positive at l = 0, but is {window[0]:g}.")
    return window / window[0]
