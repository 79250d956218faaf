"""HEALPix maps in FITS files: read into the package's conventions, written in full."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Bool, Float

from jaxsky.bandpass import Bandpass
from jaxsky.io.quantities import is_ambiguous, unit_factor, unit_name
from jaxsky.io.tables import COORDINATES, ORDERINGS, HealpixTable, InputError, open_fits, stokes
from jaxsky.types import Numeric

__all__ = ["Maps", "read_maps", "write_maps"]

POLARIZATIONS = {"COSMO": "COSMO", "IAU": "IAU"}


@dataclass(frozen=True)
class Maps:
    """Maps in the package's conventions: RING, Galactic, COSMO sign of U, float64.

    Parameters
    ----------
    maps : values, 0 in pixels that are not used, shape (field, pix)
    mask : True in pixels where every field has a value, shape (pix,)
    unit : unit of all fields, a name of `jaxsky.units`, its square ("K_CMB^2"), "" or "K"
    names : names of the columns
    """

    maps: Float[np.ndarray, "field pix"]
    mask: Bool[np.ndarray, " pix"]
    unit: str
    names: tuple[str, ...]

    @property
    def nside(self) -> int:
        """Resolution of the maps."""
        return healpy.npix2nside(self.maps.shape[-1])

    def to(
        self, unit: str, at: Numeric | Bandpass | None = None, nu_ref: float | None = None
    ) -> "Maps":
        """The maps in another unit; `at` and `nu_ref` as in `unit_factor`."""
        factor = unit_factor(self.unit, unit, at, nu_ref)
        return replace(self, maps=self.maps * factor, unit=unit_name(unit))


def default_fields(table: HealpixTable) -> list[int]:
    """The first I, Q and U columns that are there, by their names; else a column that is alone."""
    kinds = [stokes(name) for name in table.names]
    found = [kinds.index(kind) for kind in "IQU" if kind in kinds]
    if found:
        return found
    columns = [i for i, name in enumerate(table.names) if name.upper() != "PIXEL"]
    if len(columns) == 1:
        return columns
    raise InputError(
        f"{table.where}: no column is named as I, Q or U; give `fields` out of "
        f"{', '.join(table.names)}."
    )


def _unit(table: HealpixTable, columns: list[int], given: str | None) -> str:
    """The one unit of some columns, from the header and the argument."""
    units = []
    for column in columns:
        text, name = table.unit(column), table.names[column]
        try:
            found = None if text is None else unit_name(text)
        except ValueError:
            found = None
        if given is None and (found is None or is_ambiguous(found)):
            says = (
                f"has the unit {text!r}, which leaves open what is meant" if text else "has no unit"
            )
            raise InputError(
                f'{table.where}: column {name} {says}; give `unit`, such as "uK_CMB", "K_RJ", '
                '"MJy/sr", "K" for a temperature of matter or "" for a pure number.'
            )
        bare = None if given is None else given.replace("_CMB", "").replace("_RJ", "")
        if given and found is not None and found not in (given, bare if is_ambiguous(found) else 0):
            raise InputError(
                f"{table.where}: argument `unit` is {given}, but column {name} is in {found}."
            )
        units.append(found if given is None else given)
    if len(set(units)) > 1:
        listed = ", ".join(f"{table.names[c]} [{v}]" for c, v in zip(columns, units, strict=True))
        raise InputError(
            f"{table.where}: columns have different units, read each by itself: {listed}."
        )
    return str(units[0])


def _blocks(table: HealpixTable, names: Sequence[str]) -> list[tuple[int, ...]]:
    """Rows that turn together when the coordinates change: (Q, U) pairs, and single scalars."""
    kinds = [stokes(name) for name in names]
    blocks: list[tuple[int, ...]] = []
    row = 0
    while row < len(kinds):
        if kinds[row : row + 2] == ["Q", "U"]:
            blocks.append((row, row + 1))
        elif kinds[row] in ("", "I"):
            blocks.append((row,))
        else:
            raise InputError(
                f"{table.where}: column {names[row]} cannot be turned to Galactic coordinates; "
                "read Q followed by U, and no covariances."
            )
        row += len(blocks[-1])
    return blocks


def _to_galactic(
    maps: np.ndarray, mask: np.ndarray, blocks: list[tuple[int, ...]], coordinates: str
) -> tuple[np.ndarray, np.ndarray]:
    """Maps turned to Galactic coordinates, Q and U as the spin-2 field they are.

    Complete maps are turned in harmonic space up to l = 3 nside - 1, which is exact for a
    band-limited sky. A map with pixels missing has no spherical harmonics: it is interpolated
    between the four nearest pixels, and pixels next to missing ones are lost.
    """
    rotator = healpy.Rotator(coord=[coordinates, "G"])
    complete = bool(mask.all())
    turned = np.zeros_like(maps)
    for rows in blocks:
        block = maps[list(rows)]
        if not complete:
            turned[list(rows)] = rotator.rotate_map_pixel(block if len(rows) > 1 else block[0])
        elif len(rows) > 1:
            polarized = rotator.rotate_map_alms([0 * block[0], *block], use_pixel_weights=False)
            turned[list(rows)] = polarized[1:]
        else:
            turned[rows[0]] = rotator.rotate_map_alms(block[0], use_pixel_weights=False)
    if not complete:
        mask = rotator.rotate_map_pixel(mask.astype(float)) > 1 - 1e-9
        turned[:, ~mask] = 0
    return turned, mask


def read_maps(
    path: str | Path,
    *,
    fields: int | str | Sequence[int | str] | None = None,
    hdu: int | str = 1,
    unit: str | None = None,
    nside: int | None = None,
    ordering: str | None = None,
    coordinates: str | None = None,
    polarization: str | None = None,
) -> Maps:
    """HEALPix maps of a FITS file, in RING order, Galactic coordinates, COSMO sign of U.

    Unit, ordering, coordinates and polarization convention are read from the header; an argument
    stands in where the header is silent, and must agree with it where it is not. NESTED maps are
    reordered, U (and its covariances IU, QU) of an IAU file changes sign, and maps in Celestial
    or Ecliptic coordinates are turned, Q and U together as a spin-2 field (covariances cannot
    be). Partial maps with explicit pixel numbers are read as well.

    Parameters
    ----------
    path : FITS file
    fields : columns by name or number; default the first columns named as I, Q and U (I_STOKES,
        TEMPERATURE, Q_POLARISATION, U_ML, ...), or the only column
    hdu : number or name of the table
    unit : unit of the columns, for example "mK_CMB"; the bare "K" and "mK" of some headers do
        not say which temperature is meant, so there it must be given ("K" for a map of dust
        temperatures, "" for a pure number)
    nside : resolution that is expected
    ordering : "RING" or "NESTED"
    coordinates : "G", "C" or "E" (Galactic, Celestial, Ecliptic)
    polarization : "COSMO" or "IAU"; COSMO, HEALPix's own, where nothing is said

    Raises
    ------
    InputError
        If the file is missing, truncated or not HEALPix; a column or HDU is missing; something
        the maps cannot be used without is said neither by header nor argument, or differently by
        both; the nside is not that expected; no pixel has values.
    ValueError
        If `unit` is unknown.
    """
    path = Path(path)
    unit = None if unit is None else unit_name(unit)
    with open_fits(path) as hdus:
        table = HealpixTable(path, hdus, hdu)
        if nside is not None and nside != table.nside:
            raise InputError(f"{table.where}: nside is {table.nside}, but {nside} is expected.")
        if fields is None:
            columns = default_fields(table)
        else:
            wanted = [fields] if isinstance(fields, int | str) else list(fields)
            columns = [table.index(field) for field in wanted]
        names = tuple(table.names[i] for i in columns)
        unit = _unit(table, columns, unit)
        ordering = table.state("ordering", ordering, ("ORDERING",), ORDERINGS)
        frame = table.state("coordinates", coordinates, ("COORDSYS", "SKYCOORD"), COORDINATES)
        convention = table.state(
            "polarization", polarization, ("POLCCONV",), POLARIZATIONS, default="COSMO"
        )
        maps = np.stack([table.values(i) for i in columns])
        bad = np.any([table.bad(values) for values in maps], axis=0)
    if bad.all():
        raise InputError(f"{table.where}: no pixel has values in {', '.join(names)}.")
    maps[:, bad] = 0
    mask = ~bad
    if ordering == "NESTED":
        ring = healpy.ring2nest(table.nside, np.arange(mask.size))
        maps, mask = maps[:, ring], mask[ring]
    if convention == "IAU":
        maps *= np.array([[(-1.0) ** stokes(name).count("U")] for name in names])
    if frame != "G":
        maps, mask = _to_galactic(maps, mask, _blocks(table, names), frame)
    return Maps(maps, mask, unit, names)


def _check_written(
    maps: np.ndarray, names: Sequence[str], units: Sequence[str], mask: np.ndarray | None
) -> None:
    if maps.ndim != 2 or not healpy.isnpixok(maps.shape[-1]):
        raise ValueError(
            "Argument `maps` must have shape (field, pix) with 12 nside^2 pixels, "
            f"but has shape {maps.shape}."
        )
    for name, values in {"names": names, "unit": units}.items():
        if len(values) != len(maps):
            raise ValueError(f"Argument `{name}` has {len(values)} entries for {len(maps)} maps.")
    if mask is not None and mask.shape != maps.shape[-1:]:
        raise ValueError(
            f"Argument `mask` must have shape {maps.shape[-1:]}, but has shape {mask.shape}."
        )
    if bad := int(np.sum(~np.isfinite(maps))):
        raise ValueError(
            f"Argument `maps` has {bad} of {maps.size} values that are not finite; "
            "leave pixels out with `mask`."
        )


def write_maps(
    path: str | Path,
    maps: Float[np.ndarray, "field pix"],
    *,
    names: str | Sequence[str],
    unit: str | Sequence[str],
    mask: Bool[np.ndarray, " pix"] | None = None,
    overwrite: bool = False,
    extra_header: Mapping[str, str | float] | None = None,
) -> None:
    """Maps as a HEALPix table in a FITS file, float64, with a header that leaves nothing open.

    The file is written beside its place and moved there when it is complete.

    Parameters
    ----------
    path : FITS file
    maps : RING, Galactic, COSMO, shape (field, pix) or (pix,)
    names : names of the columns
    unit : unit of all maps or of each, as `unit_name` takes them; "" for pure numbers
    mask : True in used pixels, shape (pix,); the others are written as UNSEEN
    overwrite : replace a file that is there
    extra_header : further header keywords and their values

    Raises
    ------
    FileExistsError
        If the file exists and `overwrite` is not set.
    InputError
        If its folder does not exist.
    ValueError
        For wrong shapes, an unknown unit, values that are not finite, or an `extra_header` that
        contradicts what is written here.
    """
    path = Path(path)
    maps = np.atleast_2d(np.asarray(maps, dtype=np.float64))
    names = [names] if isinstance(names, str) else list(names)
    units = [unit_name(x) for x in ([unit] * len(maps) if isinstance(unit, str) else unit)]
    mask = None if mask is None else np.asarray(mask, dtype=bool)
    _check_written(maps, names, units, mask)
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path}: file exists, and `overwrite` is not set.")
    if not path.parent.is_dir():
        raise InputError(f"{path}: folder {path.parent} does not exist.")
    if mask is not None:
        maps = np.where(mask, maps, healpy.UNSEEN)
    # A blank TUNIT cannot be told from a missing one, so a pure number is written as "1".
    columns = [
        pyfits.Column(name=name, format="D", array=values, unit=text or "1")
        for name, values, text in zip(names, maps, units, strict=True)
    ]
    table = pyfits.BinTableHDU.from_columns(columns, name="MAPS")
    required = {
        "PIXTYPE": ("HEALPIX", "HEALPIX pixelisation"),
        "ORDERING": ("RING", "pixel ordering"),
        "NSIDE": (healpy.npix2nside(maps.shape[-1]), "resolution"),
        "FIRSTPIX": (0, "first pixel"),
        "LASTPIX": (maps.shape[-1] - 1, "last pixel"),
        "INDXSCHM": ("IMPLICIT", "indexing"),
        "OBJECT": ("FULLSKY", "sky coverage"),
        "COORDSYS": ("G", "Galactic coordinates"),
        "POLCCONV": ("COSMO", "HEALPix sign of U"),
        "BAD_DATA": (healpy.UNSEEN, "value of pixels without data"),
    }
    for key, value in (extra_header or {}).items():
        if key.upper() in table.header or key.upper() in required:
            raise ValueError(
                f"Argument `extra_header` must not set {key}, which is written anyway."
            )
        table.header[key] = value
    table.header.update(required)
    beside = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        pyfits.HDUList([pyfits.PrimaryHDU(), table]).writeto(beside, overwrite=True)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
