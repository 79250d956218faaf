"""Open FITS tables with clear errors, and read HEALPix columns and header keywords."""

import gzip
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from astropy.io import fits as pyfits
from astropy.utils.exceptions import AstropyUserWarning
from jaxtyping import Bool, Float, Int

from jaxsky.io.files import InputError, UnfitError, check_file, in_file

#: Properties of maps by argument: header keywords, and spellings in upper case -> the package's.
_SAID = {
    "ordering": (("ORDERING",), {"RING": "RING", "NESTED": "NESTED", "NEST": "NESTED"}),
    "coordinates": (
        ("COORDSYS", "SKYCOORD"),
        {
            **dict.fromkeys(("G", "GAL", "GALACTIC"), "G"),
            **dict.fromkeys(("C", "Q", "CEL", "CELESTIAL", "EQUATORIAL", "ICRS", "FK5"), "C"),
            **dict.fromkeys(("E", "ECL", "ECLIPTIC"), "E"),
        },
    ),
    "polarization": (("POLCCONV",), {"COSMO": "COSMO", "IAU": "IAU"}),
}
#: Names for the column of pixel numbers in a table with explicit indexing, the usual ones first.
PIXELS = ("PIXEL", "PIX", "PIXELS", "IPIX", "PIXNUM", "PIXEL_NUMBER", "HPX_PIX", "HEALPIX_PIX")
#: Formats of columns with real numbers, and the contents of others.
NUMBERS = tuple("BIJKED")
KINDS = {
    "L": "logical values",
    "X": "bits",
    "A": "text",
    **dict.fromkeys("CM", "complex numbers"),
    **dict.fromkeys("PQ", "arrays of different lengths"),
}
LARGEST_NSIDE = 8192
#: Binary tables and ASCII tables.
TABLES = (pyfits.BinTableHDU, pyfits.TableHDU)

#: Errors raised only for truncated files and files that are not FITS.
_DAMAGE = (EOFError, zlib.error, gzip.BadGzipFile, AstropyUserWarning)
#: Errors that astropy raises for these, and for anything else it cannot interpret.
_PUZZLED = (OSError, ValueError, TypeError, LookupError, AttributeError, pyfits.VerifyError)


@contextmanager
def open_fits(path: Path) -> Iterator[pyfits.HDUList]:
    """Open a FITS file; problems found while it is open become an InputError."""
    check_file(path)
    hdus = None
    with in_file(path), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyUserWarning)
        for message in (".*truncated", ".*[Ee]rror validating header"):
            warnings.filterwarnings("error", message, AstropyUserWarning)
        try:
            with pyfits.open(path) as hdus:
                yield hdus
        except InputError:
            raise
        except (*_DAMAGE, *_PUZZLED) as error:
            damaged = hdus is None or isinstance(error, _DAMAGE) or is_cut(path, hdus)
            what = "not a FITS file, or a truncated one" if damaged else "cannot be read"
            reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
            raise InputError(f"{path}: {what} ({reason}).") from error


@contextmanager
def open_table(path: Path, hdu: int | str) -> Iterator["HealpixTable"]:
    """Open a HEALPix table in a FITS file; see `open_fits`."""
    with open_fits(path) as hdus:
        table, where = select_hdu(hdus, hdu), f"{path}, HDU {hdu!r}"
        with in_file(where):
            yield HealpixTable(where, table, hdus[0].header)


def is_cut(path: Path, hdus: pyfits.HDUList) -> bool:
    """Return whether a file ends before the data that its headers announce."""
    try:
        ends = [info["datLoc"] + info["datSpan"] for hdu in hdus if (info := hdu.fileinfo())]
        with path.open("rb") as plain:
            packed = plain.read(2) == b"\x1f\x8b"
        with gzip.open(path) if packed else path.open("rb") as stream:
            return max(ends, default=0) > stream.seek(0, 2)
    except (*_DAMAGE, *_PUZZLED):
        return True


def to_number(text: str) -> float | None:
    """Parse a number, also with a Fortran exponent (1.0D+01); None if it is not a number."""
    try:
        return float(text.lower().replace("d", "e")) if text.isascii() and "_" not in text else None
    except ValueError:
        return None


def equals(
    values: Float[np.ndarray, " pix"], number: float, rtol: float
) -> Bool[np.ndarray, " pix"]:
    """Return where values equal a number to a relative tolerance; zero must be exact."""
    apart = rtol * abs(number)
    return (values >= number - apart) & (values <= number + apart)


def index_of(field: int | str, names: Sequence[str]) -> int:
    """Return the number of a column given by name (in any case, if unambiguous) or number.

    All names are empty if the columns have none.
    """
    if isinstance(field, str):
        same = [i for i, name in enumerate(names) if name == field]
        same = same or [i for i, name in enumerate(names) if name.upper() == field.upper()]
        if len(same) > 1:
            raise UnfitError(f"{len(same)} columns are called {field!r}.")
        if same:
            return same[0]
    elif not isinstance(field, bool) and field in range(len(names)):
        return int(field)
    listed = ", ".join(filter(None, names)) or f"0 to {len(names) - 1}"
    raise UnfitError(f"no column {field!r}; it has {listed}.")


def select_hdu(
    hdus: pyfits.HDUList, hdu: int | str, kinds: Any = pyfits.BinTableHDU
) -> pyfits.BinTableHDU:
    """Return the table `hdu` (number or name) of an open file; a binary one by default."""
    try:
        if isinstance(hdu, bool):
            raise KeyError(hdu)  # True is not taken for 1
        found = hdus[hdu]
    except (IndexError, KeyError):
        names = ", ".join(f"{i} ({h.name})" for i, h in enumerate(hdus))
        raise UnfitError(
            f"no HDU {hdu!r}; it has {names}, and is truncated if there should be more."
        ) from None
    if not isinstance(found, kinds):
        kind = "table" if kinds is TABLES else "binary table"
        raise UnfitError(f"HDU {hdu!r} holds no {kind}.")
    return found


def _choices(argument: str) -> str:
    return ", ".join(dict.fromkeys(_SAID[argument][1].values()))


def spelled(argument: str, given: str) -> str:
    """Return the package's spelling of an argument about maps."""
    if (found := _SAID[argument][1].get(str(given).upper())) is None:
        known = _choices(argument)
        raise InputError(f"Argument `{argument}` must be one of {known}, not {given!r}.")
    return found


@lru_cache(maxsize=1)
def _nested(nside: int) -> Int[np.ndarray, " pix"]:
    """Return NESTED pixel numbers in RING order; cached, as files often share an nside."""
    return healpy.ring2nest(nside, np.arange(healpy.nside2npix(nside))).astype(np.int32)


def in_ring(values: Float[np.ndarray, " pix"], ordering: str) -> Float[np.ndarray, " pix"]:
    """Reorder values from an ordering to RING."""
    if ordering == "RING":
        return values
    return values[_nested(_nestable(healpy.npix2nside(values.size)))]


def _nestable(nside: int) -> int:
    """Return nside, if it may be that of NESTED maps."""
    if not healpy.isnsideok(nside, nest=True):
        raise UnfitError(f"ordering is NESTED, but nside is {nside}, no power of 2.")
    return nside


def _flat(column: np.ndarray) -> Any:
    """Return what takes the values of a column by their number, without a copy of the column."""
    return column if column.ndim == 1 else column.flat  # the second is slower


class HealpixTable:
    """The columns and the header of a HEALPix table in an open FITS file."""

    def __init__(self, where: str, table: pyfits.BinTableHDU, primary: pyfits.Header) -> None:
        self.where, self._table, self._primary = where, table, primary
        # Before the data are read: otherwise astropy copies all columns when the file is closed.
        names = self._table.columns.names
        #: The letter of each column's format.
        self._kinds = [f.lstrip("0123456789")[:1] for f in map(str, self._table.columns.formats)]
        if None in names:
            number = names.index(None) + 1
            raise UnfitError(f"column {number} has no name, TTYPE{number}.")
        self.names: tuple[str, ...] = tuple(names)
        #: Numbers of the columns without pixel numbers.
        self.fields = [i for i, name in enumerate(names) if name.upper() not in PIXELS]
        if (pixtype := self.keyword("PIXTYPE")) not in (None, "HEALPIX"):
            raise UnfitError(f"not a HEALPix map, PIXTYPE is {pixtype}.")
        listed = self._listed()
        self.nside = self._nside(explicit=listed is not None)
        self._pixels = None if listed is None else self._check_pixels(listed)

    def keyword(self, *names: str) -> str | None:
        """Return the first of these header keywords that is set, in upper case, or None."""
        for name in names:
            for header in (self._table.header, self._primary):
                if text := str(header.get(name, "")).strip("'\" "):
                    return text.upper()
        return None

    def _listed(self) -> int | None:
        """Return the column of pixel numbers; None if the rows are in pixel order."""
        named = [self.names.index(n) for p in PIXELS for n in self.names if n.upper() == p]
        scheme = self.keyword("INDXSCHM")
        if scheme == "EXPLICIT" or (named and scheme != "IMPLICIT"):
            if self.keyword("NSIDE") is None:
                raise UnfitError("explicit indexing without NSIDE in the header.")
            if not named:
                listed = ", ".join(self.names)
                raise UnfitError(f"explicit indexing, but no column 'PIXEL'; it has {listed}.")
            return named[0]
        if named:
            numbers, order = self._field(named[0]).ravel(), np.arange(len(self._table.data))
            if not np.array_equal(numbers, order) and np.array_equal(np.sort(numbers), order):
                name = self.names[named[0]]
                raise UnfitError(f"INDXSCHM is IMPLICIT, but column {name} has another order.")
        return None

    def _nside(self, explicit: bool) -> int:
        text = self.keyword("NSIDE")
        stated = to_number(text or "")
        if text and not (stated and 1 <= stated <= LARGEST_NSIDE and stated.is_integer()):
            raise UnfitError(f"NSIDE is {text}, but must be a whole number, 1 to {LARGEST_NSIDE}.")
        if explicit and stated is not None:
            return int(stated)
        first = next((i for i, kind in enumerate(self._kinds) if kind in NUMBERS), 0)
        npix = 0 if not self.names else self._table.data.field(first).size
        if not npix or not healpy.isnpixok(npix):
            raise UnfitError(f"its columns have {npix} values, which is not 12 nside^2.")
        nside = healpy.npix2nside(npix)
        if stated is not None and stated != nside:
            raise UnfitError(f"NSIDE is {text}, but its columns have {npix} pixels.")
        return nside

    def _check_pixels(self, column: int) -> Int[np.ndarray, " row"]:
        """Return the pixel numbers, after checking that they are valid and unique."""
        stored, npix = self._field(column).ravel(), healpy.nside2npix(self.nside)
        where = f"column {self.names[column]}"
        with np.errstate(invalid="ignore"):
            pixels = stored.astype(np.int64)
        if bad := np.flatnonzero(~((pixels == stored) & (pixels >= 0) & (pixels < npix))).tolist():
            odd = f"{len(bad)} of {pixels.size} values that are no pixels, 0 to {npix - 1}"
            raise UnfitError(f"{where} has {odd}, such as {stored[bad[0]]:g}.")
        if self._kinds[column] == "E" and npix > 2**24:
            raise UnfitError(f"{where} is in single precision, which cannot hold all pixels.")
        if twice := pixels.size - np.unique(pixels).size:
            raise UnfitError(f"{where} has {twice} pixels more than once.")
        return pixels

    def index(self, field: int | str) -> int:
        """Return the number of a column; see `index_of`."""
        return index_of(field, self.names)

    def unit(self, index: int) -> str | None:
        """Return TUNIT of a column; None if it is missing or blank."""
        return str(self._table.header.get(f"TUNIT{index + 1}", "")).strip() or None

    def _field(self, index: int, logical: bool = False) -> np.ndarray:
        """Return a column of real numbers, or if `logical` of truths, (row,) or (row, width)."""
        kind, name = self._kinds[index], self.names[index]
        if kind not in NUMBERS and not (logical and kind == "L"):
            raise UnfitError(f"column {name} holds {KINDS.get(kind, kind)}, not real numbers.")
        found = self._table.data.field(index)
        if found.ndim > 2:
            shape = " x ".join(map(str, found.shape[1:]))
            raise UnfitError(f"column {name} has a table of {shape} in each row.")
        return found

    def _places(self, pixels: slice, ordering: str) -> Int[np.ndarray, " pix"]:
        """Return the places of RING pixels in the columns; -1 where they are not listed."""
        npix = healpy.nside2npix(self.nside)
        if not 0 <= pixels.start < pixels.stop <= npix or pixels.step not in (None, 1):
            raise UnfitError(f"argument `pixels` must be a range from 0 to {npix}, not {pixels}.")
        own = np.arange(pixels.start, pixels.stop)
        if ordering == "NESTED":
            own = healpy.ring2nest(_nestable(self.nside), own)
        if self._pixels is None:
            return own
        order = np.argsort(self._pixels)
        found = np.append(order, -1)[np.searchsorted(self._pixels, own, sorter=order)]
        return np.where(np.append(self._pixels, -1)[found] == own, found, -1)

    def lowest(self, index: int) -> float | None:
        """Return the value of the lowest integer a column can store; None for other types."""
        if self._kinds[index] not in "IJK":
            return None
        raw = self._table.data.view(np.ndarray)
        least = float(np.iinfo(raw.dtype[index].base).min)
        header, number = self._table.header, index + 1
        return least * header.get(f"TSCAL{number}", 1.0) + header.get(f"TZERO{number}", 0.0)

    def values(
        self, index: int, ordering: str, *, logical: bool = False, own: slice | None = None
    ) -> Float[np.ndarray, " pix"]:
        """Return a column over the full sky in RING order, float64; `ordering` is the file's.

        It is NaN where there is no value, see `read_maps`. If `logical`, true and false become 1
        and 0. Of `own` RING pixels only, these are read of the mapped file, and returned.
        """
        npix, pixels = healpy.nside2npix(self.nside), self._pixels
        field, expected = self._field(index, logical), npix if pixels is None else pixels.size
        if field.size != expected:
            name = self.names[index]
            raise UnfitError(f"column {name} has {field.size} values for {expected} pixels.")
        places = None if own is None else self._places(own, ordering)
        column = np.array(field if places is None else _flat(field)[places], np.float64).ravel()
        column[self._missing(index, column, places)] = np.nan
        if places is not None:
            return np.where(places < 0, np.nan, column)
        if pixels is not None:
            listed, column = column, np.full(npix, np.nan)
            column[pixels] = listed
        return in_ring(column, ordering)

    def _missing(
        self, index: int, column: Float[np.ndarray, " row"], places: np.ndarray | None
    ) -> Bool[np.ndarray, " row"]:
        """Return where a column, or what some places of it hold, has no value."""
        bad = ~np.isfinite(column) | equals(column, healpy.UNSEEN, 1e-5)
        text = self.keyword("BAD_DATA") or "UNSEEN"
        if text not in ("UNSEEN", "NAN"):
            if (stated := to_number(text)) is None:
                raise UnfitError(f"BAD_DATA is {text}, which is not a number.")
            bad |= equals(column, stated, 1e-5)
        key = f"TNULL{index + 1}"
        if text := str(self._table.header.get(key, "")).strip("'\" "):
            # TNULL is a stored integer, before scaling. By the standard only integer columns have
            # one, but in others its meaning is clear.
            if (null := to_number(text)) is None or not null.is_integer():
                raise UnfitError(f"{key} is {text}, which is not a whole number.")
            raw = self._table.data.view(np.ndarray)
            stored = raw[raw.dtype.names[index]]
            stored = stored.ravel() if places is None else _flat(stored)[places]
            exact = stored.dtype.kind in "iu"
            bad |= stored == int(null) if exact else equals(column, null, 1e-5)
        return bad

    def state(self, argument: str, given: str | None, default: str | None = None) -> str:
        """Return a property from the header or the argument, which must agree, or the default."""
        keywords, spellings = _SAID[argument]
        keyword, choices = keywords[0], _choices(argument)
        given = None if given is None else spelled(argument, given)
        text = self.keyword(*keywords)
        found = spellings.get(text or "")
        if text and not found and not given:
            raise UnfitError(f"{keyword} is {text}, which is none of {choices}; give `{argument}`.")
        if given and found and given != found:
            raise UnfitError(f"argument `{argument}` is {given}, but the header says {found}.")
        if stated := given or found or default:
            return stated
        raise UnfitError(f"the header has no {keyword}; give `{argument}`, one of {choices}.")
