"""FITS tables with their errors, and the HEALPix facts in their headers."""

import re
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits as pyfits
from astropy.utils.exceptions import AstropyUserWarning
from jaxtyping import Float

__all__ = [
    "COORDINATES",
    "ORDERINGS",
    "HealpixTable",
    "InputError",
    "open_fits",
    "select_hdu",
    "stokes",
]

#: Spellings in headers and arguments, upper case -> the package's.
ORDERINGS = {"RING": "RING", "NESTED": "NESTED", "NEST": "NESTED"}
COORDINATES = {
    **dict.fromkeys(("G", "GAL", "GALACTIC"), "G"),
    **dict.fromkeys(("C", "Q", "CEL", "CELESTIAL", "EQUATORIAL", "ICRS", "FK5"), "C"),
    **dict.fromkeys(("E", "ECL", "ECLIPTIC"), "E"),
}


#: What astropy raises at files that are cut short or no FITS files at all.
_DAMAGE = (OSError, EOFError, ValueError, TypeError, IndexError, zlib.error, AstropyUserWarning)


class InputError(ValueError):
    """A file that cannot be used, as it is or as it was asked for; one sentence with the names."""


@contextmanager
def open_fits(path: Path) -> Iterator[pyfits.HDUList]:
    """An open FITS file; what astropy finds wrong with it while it is open is an InputError."""
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyUserWarning)
        for message in (".*truncated", ".*[Ee]rror validating header"):
            warnings.filterwarnings("error", message, AstropyUserWarning)
        try:
            with pyfits.open(path) as hdus:
                yield hdus
        except InputError:
            raise
        except _DAMAGE as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: not a FITS file, or a truncated one ({reason}).") from error


def select_hdu(path: Path, hdus: pyfits.HDUList, hdu: int | str) -> pyfits.BinTableHDU:
    """The table `hdu` (number or name) of an open file."""
    try:
        found = hdus[hdu]
    except (IndexError, KeyError):
        names = ", ".join(f"{i} ({h.name})" for i, h in enumerate(hdus))
        raise InputError(
            f"{path}: no HDU {hdu!r}; it has {names}, and is truncated if there should be more."
        ) from None
    if not isinstance(found, pyfits.BinTableHDU):
        raise InputError(
            f"{path}: HDU {hdu!r} holds no binary table; HEALPix maps are columns of one."
        )
    return found


class HealpixTable:
    """The columns and the header of a HEALPix table in an open FITS file.

    Parameters
    ----------
    path : the file, for the messages
    hdus : the open file
    hdu : number or name of the table
    """

    def __init__(self, path: Path, hdus: pyfits.HDUList, hdu: int | str) -> None:
        self.path = path
        self.where = f"{path}, HDU {hdu!r}"
        self._table = select_hdu(path, hdus, hdu)
        self._primary = hdus[0].header
        self.names: tuple[str, ...] = tuple(self._table.columns.names)
        if (pixtype := self.keyword("PIXTYPE")) not in (None, "HEALPIX"):
            raise InputError(f"{self.where}: not a HEALPix map, PIXTYPE is {pixtype}.")
        self.nside = self._nside()

    def keyword(self, *names: str) -> str | None:
        """The first of these header keywords that is there, in upper case; None if none is."""
        for name in names:
            for header in (self._table.header, self._primary):
                if text := str(header.get(name, "")).strip():
                    return text.upper()
        return None

    @property
    def _explicit(self) -> bool:
        return self.keyword("INDXSCHM") == "EXPLICIT"

    def _nside(self) -> int:
        stated = self.keyword("NSIDE")
        if self._explicit:
            if stated is None:
                raise InputError(f"{self.where}: explicit indexing without NSIDE in the header.")
            return int(stated)
        npix = 0 if not self.names else self._table.data.field(0).size
        if not npix or not healpy.isnpixok(npix):
            raise InputError(
                f"{self.where}: not a HEALPix map, its columns have {npix} values, "
                "which is not 12 nside^2."
            )
        nside = healpy.npix2nside(npix)
        if stated is not None and int(stated) != nside:
            raise InputError(
                f"{self.where}: NSIDE is {stated}, but its columns have {npix} pixels "
                f"(nside {nside})."
            )
        return nside

    def index(self, field: int | str) -> int:
        """Number of a column given by name (in any case) or number."""
        if isinstance(field, str):
            upper = [name.upper() for name in self.names]
            if field.upper() in upper:
                return upper.index(field.upper())
        elif 0 <= field < len(self.names):
            return int(field)
        raise InputError(f"{self.where}: no column {field!r}; it has {', '.join(self.names)}.")

    def unit(self, index: int) -> str | None:
        """TUNIT of a column; None if it is missing or blank."""
        return str(self._table.header.get(f"TUNIT{index + 1}", "")).strip() or None

    def values(self, index: int) -> Float[np.ndarray, " pix"]:
        """A column over the full sky in float64 and native byte order; UNSEEN where not given."""
        column = np.array(self._table.data.field(index), dtype=np.float64).ravel()
        if not self._explicit:
            return column
        pixels = np.asarray(self._table.data.field(self.index("PIXEL"))).ravel()
        full = np.full(healpy.nside2npix(self.nside), healpy.UNSEEN)
        full[pixels] = column
        return full

    def bad(self, values: Float[np.ndarray, " pix"]) -> np.ndarray:
        """Where a column is UNSEEN, the header's BAD_DATA, NaN or infinite; shape (pix,)."""
        bad = ~np.isfinite(values) | np.isclose(values, healpy.UNSEEN, rtol=1e-5, atol=0)
        if (stated := self.keyword("BAD_DATA")) is not None:
            bad |= np.isclose(values, float(stated), rtol=1e-5, atol=0)
        return bad

    def state(
        self,
        argument: str,
        given: str | None,
        keywords: Sequence[str],
        spellings: dict[str, str],
        default: str | None = None,
    ) -> str:
        """What a header says, or the argument that stands in for it.

        Parameters
        ----------
        argument, given : name and value of the argument
        keywords : header keywords that say the same
        spellings : upper-case spelling -> the package's
        default : value if neither says anything; None to make that an error

        Raises
        ------
        InputError
            If nothing is said, one of the two is no known value, or they contradict.
        """
        choices = ", ".join(dict.fromkeys(spellings.values()))
        if given is not None:
            if str(given).upper() not in spellings:
                raise InputError(f"Argument `{argument}` must be one of {choices}, not {given!r}.")
            given = spellings[str(given).upper()]
        text = self.keyword(*keywords)
        found = None if text is None else spellings.get(text)
        if text is not None and found is None and given is None:
            raise InputError(
                f"{self.where}: {keywords[0]} is {text}, which is none of {choices}; "
                f"give `{argument}`."
            )
        if given is not None and found is not None and given != found:
            raise InputError(
                f"{self.where}: argument `{argument}` is {given}, but the header says {found}."
            )
        stated = given or found or default
        if stated is None:
            raise InputError(
                f"{self.where}: the header has no {keywords[0]}; give `{argument}`, "
                f"one of {choices}."
            )
        return stated


_STOKES = re.compile(r"(TEMPERATURE|INTENSITY|[IQU]|[TI][TIQU]|QQ|QU|UU)(?![A-Z0-9])")


def stokes(name: str) -> str:
    """Stokes parameter of a column by its name (a pair for a covariance), "" if it has none.

    Examples
    --------
    >>> [stokes(name) for name in ("Q_POLARISATION", "TEMPERATURE", "IU_COV", "U_ML", "T_D")]
    ['Q', 'I', 'IU', 'U', '']
    """
    if name.upper() == "T":
        return "I"
    match = _STOKES.match(name.upper())
    if match is None:
        return ""
    found = {"TEMPERATURE": "I", "INTENSITY": "I"}.get(match[1], match[1])
    return found.replace("T", "I")
