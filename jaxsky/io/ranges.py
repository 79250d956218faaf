"""Read ranges of pixels of HEALPix maps, for processes or passes that take no more."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxsky.bandpass import Bandpass
from jaxsky.checks import Numeric
from jaxsky.io.columns import column_stokes, mark_missing, read_columns, stacked
from jaxsky.io.files import InputError
from jaxsky.io.quantities import unit_factor, unit_name


def read_pixels(
    path: str | Path | Sequence[str | Path],
    pixels: slice,
    *,
    unit: str | None = None,
    to: str | None = None,
    at: Numeric | Bandpass | None = None,
    fields: int | str | Sequence[int | str] | None = None,
    hdu: int | str | Sequence[int | str] = 1,
    ordering: str | None = None,
    coordinates: str | None = None,
    polarization: str | None = None,
    stokes: str | Sequence[str] | None = None,
    missing: float | Iterable[float] | None = None,
    zeros_are_data: bool = False,
) -> Float[np.ndarray, "field pixels"]:
    """Read a range of pixels of HEALPix maps, as `read_maps` does the whole sky.

    The file is mapped into memory, and of RING maps only this part is read; of NESTED ones only
    the pixels, which lie apart. Numbers that seem to mark missing pixels are looked for in the
    range only. Compressed files are unpacked whole.

    Parameters
    ----------
    path : FITS file, or several whose columns belong together
    pixels : range of RING pixels
    unit : unit of the columns, if the header does not say it
    to, at : unit to convert to, and the frequency [GHz] or band at which; see `Maps.to`
    fields, hdu, ordering, coordinates, polarization : as in `read_maps`
    stokes, missing, zeros_are_data : as in `read_maps`

    Returns
    -------
    Galactic, COSMO maps in RING order; NaN where one of them has no value.

    Raises
    ------
    InputError
        For what `read_maps` refuses, pixels that the maps do not have, and maps that are not in
        Galactic coordinates: to rotate them takes the whole sky.
    """
    stated = {"ordering": ordering, "coordinates": coordinates, "polarization": polarization}
    given = None if unit is None else unit_name(unit)
    columns = read_columns(path, hdu, fields, given, stated, pixels)
    first = columns[0]
    if first.coordinates != "G":
        raise InputError(
            f"{first.where}: the maps are in coordinates {first.coordinates}, and a range of "
            "pixels cannot be rotated; write them in Galactic coordinates first."
        )
    kinds = column_stokes(columns, stokes)
    mark_missing(columns, missing, zeros_are_data)
    maps, mask = stacked(columns, kinds)
    maps[:, ~mask] = np.nan
    return maps if to is None else maps * float(unit_factor(first.unit, to, at))
