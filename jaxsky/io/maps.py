"""Read HEALPix maps and masks into the package's conventions, and write maps in these."""

import gzip
import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import ArrayLike, Bool, Float

from jaxsky.bandpass import Bandpass
from jaxsky.checks import Numeric, check_shape
from jaxsky.io.columns import column_stokes, default_fields, mark_missing, read_columns, stacked
from jaxsky.io.files import InputError, UnfitError, check_file, in_file, whole
from jaxsky.io.quantities import unit_factor, unit_name
from jaxsky.io.stacks import Stack, ranges
from jaxsky.io.tables import equals, in_ring, open_table, spelled
from jaxsky.public import takes_quantities


def _blocks(where: str, names: Sequence[str], kinds: Sequence[str | None]) -> list[list[int]]:
    """Group rows that rotate together when coordinates change: (Q, U) pairs, single scalars."""
    found: list[list[int]] = []
    row = 0
    while row < len(kinds):
        if list(kinds[row : row + 2]) == ["Q", "U"]:
            found.append([row, row + 1])
        elif kinds[row] in ("", "I"):
            found.append([row])
        else:
            turned = f"{where}: column {names[row]} cannot be turned to Galactic coordinates"
            raise InputError(f"{turned}; read Q followed by U, and no covariances.")
        row += len(found[-1])
    return found


def _turned(block: np.ndarray, rotator: healpy.Rotator) -> np.ndarray:
    """Rotate a scalar (1, pix) or Q and U (2, pix) in harmonic space."""
    nside = healpy.npix2nside(block.shape[-1])
    # Ring weights and eight iterations reach 1e-7 up to this lmax; no number does at 3 nside.
    lmax = 5 * nside // 2
    weights = nside > 1 and healpy.isnsideok(nside, nest=True)
    maps = block[0] if len(block) == 1 else [np.zeros_like(block[0]), *block]
    alm = healpy.map2alm(maps, lmax=lmax, iter=8, use_weights=weights)
    turned = healpy.alm2map(rotator.rotate_alm(alm), nside, lmax=lmax)
    return np.atleast_2d(turned)[-len(block) :]


def tangents(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return unit vectors towards south and east, shape (2, 3, pix)."""
    south = [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)]
    return np.array([south, [-np.sin(phi), np.cos(phi), np.zeros_like(phi)]])


def _interpolated(block: np.ndarray, rotator: healpy.Rotator) -> np.ndarray:
    """Rotate a scalar (1, pix) or Q and U (2, pix) by interpolation between pixels.

    Q and U vary fast near the poles, so the Cartesian components of the tensor
    Q (ss - ee) + U (se + es) are interpolated instead, s and e pointing south and east.
    """
    directions = healpy.pix2ang(healpy.npix2nside(block.shape[-1]), np.arange(block.shape[-1]))
    source = rotator.I(*directions)
    if len(block) == 1:
        return healpy.get_interp_val(block[0], *source)[None]
    s, e = tangents(*directions)
    tensor = block[0] * (s[:, None] * s - e[:, None] * e) + block[1] * (
        s[:, None] * e + e[:, None] * s
    )
    tensor = healpy.get_interp_val(tensor.reshape(9, -1), *source).reshape(3, 3, -1)
    s, e = np.einsum("ji,kjp->kip", rotator.mat, tangents(*directions))
    project = "ip,ijp,jp->p"
    ss, ee = np.einsum(project, s, tensor, s), np.einsum(project, e, tensor, e)
    return np.array([(ss - ee) / 2, np.einsum(project, s, tensor, e)])


@dataclass(frozen=True, eq=False)
class Maps:
    """Maps in the package's conventions: RING, Galactic, COSMO sign of U, float64.

    All maps are 0 where `mask` is False, even if only one lacks a value there. `unit` is in the
    spelling of `unit_name`. `stokes` of each column is as given, or as its name implies for sure:
    one letter, two for a covariance, "" for no Stokes parameter, None if unknown.
    """

    maps: Float[np.ndarray, "field pix"]
    mask: Bool[np.ndarray, " pix"]
    unit: str
    names: tuple[str, ...]
    stokes: tuple[str | None, ...]
    nside: int

    def filled(self, value: float = np.nan) -> Float[np.ndarray, "field pix"]:
        """Return the maps with a value in place of 0 where `mask` is False."""
        return np.where(self.mask, self.maps, value)

    @takes_quantities
    def to(
        self, unit: str, at: Numeric | Bandpass | None = None, nu_ref: float | None = None
    ) -> "Maps":
        """Return the maps in another unit; `at` and `nu_ref` as in `unit_factor`."""
        factor = unit_factor(self.unit, unit, at, nu_ref)
        return replace(self, maps=self.maps * factor, unit=unit_name(unit))


def read_maps(
    path: str | Path | Sequence[str | Path],
    *,
    fields: int | str | Sequence[int | str] | None = None,
    hdu: int | str | Sequence[int | str] = 1,
    unit: str | None = None,
    nside: int | None = None,
    ordering: str | None = None,
    coordinates: str | None = None,
    polarization: str | None = None,
    stokes: str | Sequence[str] | None = None,
    missing: float | Iterable[float] | None = None,
    zeros_are_data: bool = False,
    pixels: slice | None = None,
) -> Maps:
    """Read HEALPix maps from FITS files in RING order, Galactic coordinates, COSMO sign of U.

    Unit, ordering, coordinates and polarization convention are read from the header. An argument
    supplies what the header does not state, and must agree with what it does. NESTED maps are
    reordered, U (and its covariances IU, QU) of an IAU file changes sign, and maps in Celestial
    or Ecliptic coordinates are rotated, Q and U together as a spin-2 field (covariances cannot
    be rotated). Partial maps with explicit pixel numbers can be read as well.

    The Stokes parameter of a column follows from its name if that is one used by Planck, WMAP,
    healpy and the like (`jaxsky.io.columns`). For other names it must be given as `stokes` if the
    file has the IAU sign or is not in Galactic coordinates.

    Pixels have no value if they are not listed, UNSEEN, NaN, infinite, equal to the header's
    BAD_DATA, or to TNULL in columns of integers. Files in which other numbers seem to mark them
    (an extreme such as -999 that is repeated and far from the rest; exact zeros in all columns of
    a brightness in more than 30 % of the pixels) are refused until `missing` says what they are.

    A range of `pixels` is read by itself: the file is mapped into memory, and of RING maps only
    this part is read, of NESTED ones only the pixels, which lie apart. Numbers that seem to mark
    missing pixels are then looked for in the range only. Compressed files are unpacked whole.

    Parameters
    ----------
    path : FITS file, or several whose columns belong together, such as Q and U in separate files
    fields : columns by name or number; by default the first columns named as I, Q and U (I_STOKES,
        TEMPERATURE, Q_POLARISATION, U_ML, ...), or the only column. For several files or HDUs one
        that all have, or one for each.
    hdu : number or name of the table; or a list of them, one per file, or all in one file
    unit : unit of the columns, for example "mK_CMB"; must be given if the header has a bare "K" or
        "mK", which may mean any temperature ("K" for a map of dust temperatures; "": pure number)
    nside : expected resolution
    ordering : "RING" or "NESTED"
    coordinates : "G", "C" or "E" (Galactic, Celestial, Ecliptic)
    polarization : "COSMO" or "IAU"; COSMO, the HEALPix convention, if nothing states it
    stokes : Stokes parameters of the columns in order, "QU", "IQU", "I", or for covariances
        "QQ QU UU"; "I" also for hits and the like, "" if no column has one
    missing : number or numbers that mark missing pixels, possibly zero; [] if all values are data
    zeros_are_data : accept exact zeros, as of a correction where there is nothing to correct
    pixels : range of RING pixels to read, of maps in Galactic coordinates; default all

    Raises
    ------
    InputError
        If a file is not such a map or lacks some of the pixels, or if a property is stated neither
        by header nor argument, or differently by both or by several files.
    """
    stated = {"ordering": ordering, "coordinates": coordinates, "polarization": polarization}
    given = None if unit is None else unit_name(unit)
    columns = read_columns(path, hdu, fields, given, stated, pixels)
    first, where, names = columns[0], columns[0].where, tuple(column.name for column in columns)
    if nside not in (None, first.nside):
        raise InputError(f"{where}: nside is {first.nside}, but {nside} is expected.")
    if pixels is not None and first.coordinates != "G":
        raise InputError(
            f"{where}: the maps are in coordinates {first.coordinates}, and a range of pixels "
            "cannot be rotated; write them in Galactic coordinates first."
        )
    kinds = column_stokes(columns, stokes)
    blocks = None if first.coordinates == "G" else _blocks(where, names, kinds)
    mark_missing(columns, missing, zeros_are_data)
    maps, mask = stacked(columns, kinds)
    if pixels is None and not mask.any():
        raise InputError(f"{where}: no pixel has values in {', '.join(names)}.")
    if blocks is not None:
        # Complete maps are rotated in harmonic space, which is exact for a sky without structure
        # above l = 2.5 nside and cuts what is above. Incomplete maps are interpolated between the
        # four nearest pixels, and pixels next to missing ones are lost.
        rotator = healpy.Rotator(coord=[first.coordinates, "G"])
        turn = _turned if mask.all() else _interpolated
        maps = np.concatenate([turn(maps[rows], rotator) for rows in blocks])
        if not mask.all():
            mask = _interpolated(mask[None].astype(float), rotator)[0] > 1 - 1e-9
            maps[:, ~mask] = 0
    return Maps(maps, mask, first.unit, names, kinds, first.nside)


def _read_npz(path: Path, field: str | int | None, ordering: str | None) -> np.ndarray:
    """Read the values of a mask from an .npz archive, in RING order."""
    order = spelled("ordering", ordering or "RING")
    check_file(path)
    try:
        with np.load(path) as archive:
            known = list(archive)
            name = known[0] if field is None and len(known) == 1 else field
            if name not in known:
                what = "give `field`, of several" if field is None else f"no mask {field!r}"
                raise UnfitError(f"{what}; it has {', '.join(known)}.")
            found = np.squeeze(archive[name])
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UnfitError(f"not a readable .npz archive ({error}).") from error
    if found.dtype.kind not in "biuf" or found.ndim != 1:
        raise UnfitError(f"{name} is no mask, but has type {found.dtype} and shape {found.shape}.")
    if not healpy.isnpixok(found.size):
        raise UnfitError(f"not a HEALPix mask, {found.size} is not 12 nside^2 pixels.")
    values = found.astype(np.float64)
    values[~np.isfinite(values) | equals(values, healpy.UNSEEN, 1e-5)] = np.nan
    return in_ring(values, order)


def read_mask(
    path: str | Path,
    *,
    field: str | int | None = None,
    hdu: int | str = 1,
    nside: int | None = None,
    ordering: str | None = None,
) -> Bool[np.ndarray, " pix"]:
    """Read a mask from a FITS file or an .npz archive: True in used pixels; RING, Galactic, (pix,).

    Pixels without a value (`read_maps`) are not used. Other values than 0 and 1, as of an apodized
    mask, are an InputError, and so is a mask without any used pixel.

    Parameters
    ----------
    path : FITS file or .npz archive
    field : column of the table or array of the archive, for example "GAL040"; may be omitted
        if there is only one, or an I column (the WMAP masks)
    hdu : number or name of the FITS table
    nside : expected resolution
    ordering : "RING" or "NESTED" if the header does not say; archives are RING by default. A
        FITS mask without coordinates is taken to be Galactic.
    """
    path = Path(path)
    frame, others = "G", []
    with in_file(path):
        if path.suffix == ".npz":
            values = _read_npz(path, field, ordering)
        else:
            with open_table(path, hdu) as table:
                column = default_fields(table, "field")[0] if field is None else table.index(field)
                order = table.state("ordering", ordering)
                frame = table.state("coordinates", None, "G")
                values = table.values(column, order, logical=True)
                others = [name for name in table.names if name != table.names[column]]
        found = healpy.npix2nside(values.size)
        if nside not in (None, found):
            raise UnfitError(f"nside is {found}, but {nside} is expected.")
        odd = values[np.isfinite(values) & (values != 0) & (values != 1)]
        if odd.size:
            listed = ", ".join(f"{value:.6g}" for value in np.unique(odd)[:3])
            raise UnfitError(
                f"a mask has values 0 and 1, but {odd.size} of {values.size} pixels have others, "
                f"such as {listed}."
            )
        mask = values == 1
        if not mask.any():
            hint = f"; give `field` out of {', '.join(others)}" if field is None and others else ""
            raise UnfitError(f"the mask leaves no pixel{hint}.")
    if frame == "G":
        return mask
    # Look the mask up at the pixel centers of the Galactic frame.
    directions = healpy.pix2ang(found, np.arange(mask.size))
    return mask[healpy.ang2pix(found, *healpy.Rotator(coord=["G", frame])(*directions))]


def degrade_mask(
    mask: Bool[np.ndarray, " pix"], nside: int, threshold: float = 0.5
) -> Bool[np.ndarray, " pix"]:
    """Degrade a mask in RING order: keep pixels of which at least a fraction is used."""
    found = healpy.npix2nside(np.size(mask))
    if not healpy.isnsideok(found, nest=True):
        raise ValueError(f"Argument `mask` must have nside 1, 2, 4, ..., but has nside {found}.")
    if not healpy.isnsideok(nside, nest=True) or nside > found:
        raise ValueError(
            f"Argument `nside` must be a power of 2 up to that of the mask, {found}, not {nside}."
        )
    if not 0 < threshold <= 1:
        raise ValueError(f"Argument `threshold` must be within (0, 1], but is {threshold}.")
    # The means of 0 and 1 over powers of 4 are exact, so a threshold of 1 keeps full pixels.
    return healpy.ud_grade(np.asarray(mask, dtype=float), nside) >= threshold


#: Bytes of a block of a FITS file; an empty primary HDU has one.
BLOCK = 2880


def write_maps(
    path: str | Path,
    maps: ArrayLike | Stack,
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
