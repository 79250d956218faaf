"""Write HEALPix maps, which may be larger than memory."""

import gzip
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Bool

from jaxsky.checks import check_shape
from jaxsky.io.files import InputError, whole
from jaxsky.io.quantities import unit_name
from jaxsky.io.stacks import Maps, Stack, ranges

#: Bytes of a block of a FITS file; an empty primary HDU has one.
BLOCK = 2880


def write_maps(
    path: str | Path,
    maps: Maps,
    *,
    names: str | Sequence[str],
    unit: str | Sequence[str],
    mask: Bool[np.ndarray, " pix"] | None = None,
    overwrite: bool = False,
    extra_header: Mapping[str, Any] | None = None,
    single: bool = False,
    tables: Sequence[pyfits.BinTableHDU] = (),
) -> None:
    """Write maps as a HEALPix table in a FITS file, with a complete header; the write is atomic.

    Parameters
    ----------
    path : FITS file
    maps : RING, Galactic, COSMO, shape (field, pix) or (pix,)
    names : names of the columns
    unit : unit of all maps or of each, in any spelling `unit_name` accepts; "" for pure numbers
    mask : True in used pixels, shape (pix,); the others are written as UNSEEN
    overwrite : replace an existing file
    extra_header : further header keywords and their values, or values and comments
    single : write single precision instead of double
    tables : further tables of the file, after the maps

    Raises
    ------
    FileExistsError
        If the file exists and `overwrite` is not set.
    """
    path, dtype = Path(path), np.dtype(np.float32 if single else np.float64)
    maps = maps if isinstance(maps, Stack) else np.atleast_2d(np.asarray(maps, dtype=dtype))
    names = [names] if isinstance(names, str) else list(names)
    units = [unit_name(x) for x in ([unit] * len(maps) if isinstance(unit, str) else unit)]
    npix = maps.shape[-1]
    good = maps.ndim == 2 and healpy.isnpixok(npix)
    check_shape("maps", maps, good, "have shape (field, pix) with 12 nside^2 pixels")
    for name, values in {"names": names, "unit": units}.items():
        if len(values) != len(maps):
            raise ValueError(f"Argument `{name}` has {len(values)} entries for {len(maps)} maps.")
    used = np.broadcast_to(True, npix) if mask is None else np.asarray(mask, dtype=bool)
    check_shape("mask", used, used.shape == (npix,), f"have shape ({npix},)")
    wrong = (~np.isfinite(np.asarray(maps[..., part], dtype)) & used[part] for part in ranges(npix))
    if bad := sum(map(np.count_nonzero, wrong)):
        raise ValueError(
            f"Argument `maps` has {bad} of {len(maps) * used.sum()} values that are not finite; "
            "leave pixels out with `mask`."
        )
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path}: file exists, and `overwrite` is not set.")
    if not path.parent.is_dir():
        raise InputError(f"{path}: folder {path.parent} does not exist.")
    # A blank TUNIT cannot be told from a missing one, so a pure number is written as "1".
    columns = [
        pyfits.Column(name=name, format="E" if single else "D", unit=text or "1")
        for name, text in zip(names, units, strict=True)
    ]
    table = pyfits.BinTableHDU.from_columns(columns, name="MAPS")
    required = {
        "PIXTYPE": ("HEALPIX", "HEALPIX pixelisation"),
        "ORDERING": ("RING", "pixel ordering"),
        "NSIDE": (healpy.npix2nside(npix), "resolution"),
        "FIRSTPIX": (0, "first pixel"),
        "LASTPIX": (npix - 1, "last pixel"),
        "INDXSCHM": ("IMPLICIT", "indexing"),
        "OBJECT": ("FULLSKY", "sky coverage"),
        "COORDSYS": ("G", "Galactic coordinates"),
        "POLCCONV": ("COSMO", "HEALPix sign of U"),
        "BAD_DATA": (healpy.UNSEEN, "value of pixels without data"),
    }
    for key, value in (extra_header or {}).items():
        if key.upper() in table.header or key.upper() in required:
            raise ValueError(f"Argument `extra_header` must not set {key}: it is written anyway.")
        table.header[key] = value
    table.header.update(required)
    table.header["NAXIS2"] = npix
    others = io.BytesIO()
    pyfits.HDUList([pyfits.PrimaryHDU(), *tables]).writeto(others)
    opened = gzip.open if path.suffix == ".gz" else open
    with whole(path) as beside, opened(beside, "wb") as file:
        file.write(others.getvalue()[:BLOCK])
        file.write(table.header.tostring().encode("ascii"))
        for part in ranges(npix):  # the whole table may be larger than memory
            rows = np.where(used[part], np.asarray(maps[..., part], dtype), healpy.UNSEEN)
            file.write(rows.T.astype(dtype.newbyteorder(">"), order="C").tobytes())
        file.write(bytes(-npix * len(maps) * dtype.itemsize % BLOCK))
        file.write(others.getvalue()[BLOCK:])
