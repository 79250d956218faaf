"""HEALPix maps in FITS files: read into the package's conventions, written in full."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from astropy.io import fits as pyfits
from jaxtyping import Bool, Float

from jaxsky.bandpass import Bandpass
from jaxsky.io.files import whole
from jaxsky.io.quantities import is_ambiguous, unit_factor, unit_name
from jaxsky.io.tables import COORDINATES, ORDERINGS, HealpixTable, InputError, open_fits, stokes
from jaxsky.types import Numeric

__all__ = ["Maps", "read_maps", "write_maps"]

POLARIZATIONS = {"COSMO": "COSMO", "IAU": "IAU"}


@dataclass(frozen=True, eq=False)
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


def default_fields(table: HealpixTable, argument: str = "fields") -> list[int]:
    """The first I, Q and U columns that are there, by their names; else a column that is alone."""
    kinds = [stokes(name) for name in table.names]
    found = [kinds.index(kind) for kind in "IQU" if kind in kinds]
    if found:
        return found
    columns = [i for i, name in enumerate(table.names) if name.upper() != "PIXEL"]
    if len(columns) == 1:
        return columns
    raise InputError(
        f"{table.where}: no column is named as I, Q or U; give `{argument}` out of "
        f"{', '.join(table.names)}."
    )


def _agree(given: str, found: str) -> bool:
    """True if a unit from an argument is the header's, or makes its bare kelvins definite."""
    return given == found or (is_ambiguous(found) and re.sub("_(CMB|RJ)", "", given) == found)


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
        if given is not None and found is not None and not _agree(given, found):
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


def _blocks(table: HealpixTable, names: Sequence[str]) -> list[list[int]]:
    """Rows that turn together when the coordinates change: (Q, U) pairs, and single scalars."""
    kinds = [stokes(name) for name in names]
    blocks: list[list[int]] = []
    row = 0
    while row < len(kinds):
        if kinds[row : row + 2] == ["Q", "U"]:
            blocks.append([row, row + 1])
        elif kinds[row] in ("", "I"):
            blocks.append([row])
        else:
            raise InputError(
                f"{table.where}: column {names[row]} cannot be turned to Galactic coordinates; "
                "read Q followed by U, and no covariances."
            )
        row += len(blocks[-1])
    return blocks


def _turned(block: np.ndarray, rotator: healpy.Rotator) -> np.ndarray:
    """A scalar (1, pix) or Q and U (2, pix), turned in harmonic space."""
    nside = healpy.npix2nside(block.shape[-1])
    # Ring weights and eight iterations reach 1e-7 up to here; nothing does at 3 nside.
    lmax = 5 * nside // 2
    weights = nside > 1 and healpy.isnsideok(nside, nest=True)
    maps = block[0] if len(block) == 1 else [np.zeros_like(block[0]), *block]
    alm = healpy.map2alm(maps, lmax=lmax, iter=8, use_weights=weights)
    turned = healpy.alm2map(rotator.rotate_alm(alm), nside, lmax=lmax)
    return np.atleast_2d(turned)[-len(block) :]


def _tangents(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Unit vectors to the south and the east, shape (2, 3, pix)."""
    south = [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)]
    return np.array([south, [-np.sin(phi), np.cos(phi), np.zeros_like(phi)]])


def _interpolated(block: np.ndarray, rotator: healpy.Rotator) -> np.ndarray:
    """A scalar (1, pix) or Q and U (2, pix), turned by interpolation between pixels.

    Q and U turn fast about the poles, so it is the tensor Q (ss - ee) + U (se + es) of the
    directions south and east that is interpolated, by its Cartesian components.
    """
    directions = healpy.pix2ang(healpy.npix2nside(block.shape[-1]), np.arange(block.shape[-1]))
    source = rotator.I(*directions)
    if len(block) == 1:
        return healpy.get_interp_val(block[0], *source)[None]
    s, e = _tangents(*directions)
    tensor = block[0] * (s[:, None] * s - e[:, None] * e) + block[1] * (
        s[:, None] * e + e[:, None] * s
    )
    tensor = healpy.get_interp_val(tensor.reshape(9, -1), *source).reshape(3, 3, -1)
    s, e = np.einsum("ji,kjp->kip", rotator.mat, _tangents(*directions))
    project = "ip,ijp,jp->p"
    ss, ee = np.einsum(project, s, tensor, s), np.einsum(project, e, tensor, e)
    return np.array([(ss - ee) / 2, np.einsum(project, s, tensor, e)])


def _to_galactic(
    maps: np.ndarray, mask: np.ndarray, blocks: list[list[int]], coordinates: str
) -> tuple[np.ndarray, np.ndarray]:
    """Maps turned to Galactic coordinates, Q and U as the spin-2 field they are.

    Complete maps are turned in harmonic space, which is exact for a sky without structure above
    l = 2.5 nside and cuts what is above. A map with pixels missing has no spherical harmonics:
    it is interpolated between the four nearest pixels, and pixels next to missing ones are lost.
    """
    rotator = healpy.Rotator(coord=[coordinates, "G"])
    turn = _turned if mask.all() else _interpolated
    turned = np.zeros_like(maps)
    for rows in blocks:
        turned[rows] = turn(maps[rows], rotator)
    if not mask.all():
        mask = _interpolated(mask[None].astype(float), rotator)[0] > 1 - 1e-9
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
        if not columns:
            raise InputError(f"{table.where}: argument `fields` is empty.")
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
    used = maps if mask is None else maps[:, mask]
    if bad := int(np.sum(~np.isfinite(used))):
        raise ValueError(
            f"Argument `maps` has {bad} of {used.size} values that are not finite; "
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
    extra_header: Mapping[str, Any] | None = None,
    single: bool = False,
) -> None:
    """Maps as a HEALPix table in a FITS file, with a header that leaves nothing open.

    The file is written beside its place and moved there when it is complete.

    Parameters
    ----------
    path : FITS file
    maps : RING, Galactic, COSMO, shape (field, pix) or (pix,)
    names : names of the columns
    unit : unit of all maps or of each, as `unit_name` takes them; "" for pure numbers
    mask : True in used pixels, shape (pix,); the others are written as UNSEEN
    overwrite : replace a file that is there
    extra_header : further header keywords and their values, or values and comments
    single : write single precision instead of double

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
    maps = np.atleast_2d(np.asarray(maps, dtype=np.float32 if single else np.float64))
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
        pyfits.Column(name=name, format="E" if single else "D", array=values, unit=text or "1")
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
    with whole(path) as beside:
        pyfits.HDUList([pyfits.PrimaryHDU(), table]).writeto(beside, overwrite=True)
