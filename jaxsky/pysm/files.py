"""Find the templates of PySM where a user has them, and read them as PySM does."""

import os
import warnings
from pathlib import Path
from typing import Any, Final

import healpy
import numpy as np
from astropy import units as u
from astropy.io import fits as pyfits
from astropy.utils.data import cache_contents

from jaxsky.io.files import InputError, MissingFileError
from jaxsky.public import takes_quantities

#: Where PySM's templates are published, and their folder at NERSC.
URL: Final = "https://portal.nersc.gov/project/cmb/pysm-data/"
NERSC: Final = Path("/global/cfs/cdirs/cmb/www/pysm-data")
VARIABLE: Final = "PYSM_LOCAL_DATA"


def find_template(name: str | Path) -> Path:
    """Return the path of a file, given as a path or by its name in PySM's data.

    It is looked for in the folder $PYSM_LOCAL_DATA, in PySM's folder at NERSC and in the cache of
    astropy, which is where PySM leaves its downloads. Nothing is downloaded.
    MissingFileError names these places and the address to fetch the file from.
    """
    local = os.environ.get(VARIABLE)
    places = [Path(name), *([Path(local) / name] if local else []), NERSC / name]
    for path in places:
        if path.is_file():
            return path
    with warnings.catch_warnings():  # where there is no cache
        warnings.simplefilter("ignore")
        cached = cache_contents().get(f"{URL}{name}")
    if cached is not None and Path(cached).is_file():
        return Path(cached)
    said = f"${VARIABLE} ({local if local else 'not set'})"
    raise MissingFileError(
        f"{name}: no such file, nor in {said}, {NERSC} or the cache of astropy; fetch {URL}{name} "
        f"to the same path under a folder that ${VARIABLE} names."
    )


def _stated_unit(path: Path, field: int) -> str:
    """Return the unit of a column, "" if there is none."""
    return str(pyfits.getheader(path, 1).get(f"TUNIT{field + 1}", ""))


def _of_nside(maps: np.ndarray, nside: int) -> np.ndarray:
    """Return maps in the resolution asked for, by means of pixels in double precision."""
    if healpy.get_nside(maps) == nside:
        return maps
    wide = maps.astype(np.float64) if nside < healpy.get_nside(maps) else maps
    return np.asarray(healpy.ud_grade(wide, nside)).astype(maps.dtype, copy=False)


def read_map(
    path: str | Path, nside: int, unit: str | None = None, field: int | list[int] = 0
) -> tuple[np.ndarray, str]:
    """Read a map, or several columns, of a file of PySM (`find_template`), with the unit.

    RING order, shape (pix,) or (field, pix), in the precision of the file; another resolution is
    changed to `nside` by averaging or repeating pixels. Without `unit` it is that of the header.
    InputError if the file is no HEALPix map with these columns.
    """
    found = find_template(path)
    try:
        maps = np.asarray(healpy.read_map(found, field, dtype=None))
        first = field if isinstance(field, int) else field[0]
        stated = _stated_unit(found, first) if unit is None else unit
        maps = maps.astype(maps.dtype.newbyteorder("="), copy=False)
        return _of_nside(maps, nside), stated
    except (OSError, ValueError, TypeError, IndexError, KeyError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{found}: no HEALPix map with columns {field} ({said}).") from error


@takes_quantities
def given_map(
    value: Any, nside: int, unit: str | None, field: int | list[int] = 0
) -> tuple[np.ndarray, str]:
    """Return a map or a number with its unit: from a file, a quantity, or bare."""
    if isinstance(value, str | Path):
        return read_map(value, nside, unit, field)
    if hasattr(value, "unit"):
        return np.asarray(value.value), str(value.unit)
    return np.asarray(value), "" if unit is None else str(unit)


@takes_quantities
def given_frequency(name: str, value: Any) -> float:
    """Return a frequency in GHz, from a quantity or text such as "408 MHz"; TypeError otherwise."""
    try:
        return float(u.Quantity(value).to_value(u.GHz))
    except (TypeError, u.UnitConversionError):
        raise TypeError(
            f"Argument `{name}` must be a frequency with a unit, such as '353 GHz', not {value!r}."
        ) from None
