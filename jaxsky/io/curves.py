"""Read text tables of numbers, power spectra and beam windows."""

import codecs
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsky.io.files import UnfitError, in_file, is_fits
from jaxsky.io.quantities import unit_factor, unit_name
from jaxsky.io.tables import TABLES, open_fits, select_hdu, to_number

COMMENTS = ("#", ";", "%", "!", "\\", "|", "//", "*")
_TRAILING = re.compile(r"\s(?:[#!%\\]|//).*")
#: Advice for decimal commas.
_WRITE = "write decimal points, or semicolons between the columns"
#: The beginning of a field that looks like a number.
_DAMAGED = re.compile(r"[\"'(\[+-]*\.?\d")


class TextRow(NamedTuple):
    """A line of a table: its number in the file, its text and its fields."""

    line: int
    text: str
    cells: list[str]


class TextTable(NamedTuple):
    """Lines of a text file: comments and column names, the IPAC header lines ("|"), and rows."""

    path: Path
    header: list[str]
    bars: list[str]
    rows: list[TextRow]

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.rows[0].cells)

    def headings(self) -> Iterator[list[str]]:
        """Yield the words of lines that may name the columns, last line first, without units."""
        for line in reversed([*self.bars[:1], *self.header]):
            yield re.split(r"[\s,;|]+", re.sub(r"[(\[].*?[)\]]", "", line).strip(" ,;|"))

    def numbers(self, columns: Sequence[int] | None = None) -> Float[np.ndarray, "row column"]:
        """Return the numbers of some columns; by default all, with equally many in each row."""
        table = []
        for line, text, cells in self.rows:
            wanted = range(len(cells)) if columns is None else columns
            values = [to_number(cells[c]) if c < len(cells) else None for c in wanted]
            with in_file(f"{self.path}, line {line}"):
                if None in values:
                    raise UnfitError(f"not a row of numbers: {text!r}.")
                if columns is None and len(values) != self.width:
                    raise UnfitError(f"{len(values)} numbers, but {self.width} in the lines above.")
            table.append(values)
        return np.array(table, np.float64)


def _cells(text: str) -> list[str]:
    """Split a line at semicolons, commas or blanks; between semicolons, commas are decimal."""
    if ";" in text:
        return [cell.strip().replace(",", ".") for cell in text.strip(" ;").split(";")]
    words = [word.strip(",") for word in text.split()]
    for word in words if len(words) > 1 else ():
        if "," in word and all(to_number(part) is not None for part in word.split(",")):
            raise UnfitError(f"{word!r} is two numbers or one with a decimal comma; {_WRITE}.")
    return [cell for cell in re.split(r"[\s,]+", text) if cell]


def read_text(path: Path) -> TextTable:
    r"""Read the lines of a text table in UTF-8, or UTF-16 with a byte order mark.

    Comments start with # ; % ! \ | // or *. Columns are separated by blanks, commas or semicolons.
    A line before the first row is a header if none of its fields is a number, and not all of them
    begin like one.
    """
    table, content = TextTable(path, [], [], []), path.read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    with in_file(path):
        try:
            decoded = content.decode("utf-16" if wide else "utf-8-sig")
        except UnicodeDecodeError:
            raise UnfitError("neither a FITS file nor a text table.") from None
        if "\0" in decoded:
            raise UnfitError("neither a FITS file nor a text table, for it has NUL bytes.")
        for line, text in enumerate(map(str.strip, decoded.splitlines()), start=1):
            if text:
                with in_file(f"{path}, line {line}"):
                    _add_line(table, line, text)
        if not table.rows:
            raise UnfitError("no line has numbers.")
        with in_file(f"{path}, line {table.rows[0].line}"):
            _check_commas(table.rows)
    return table


def _add_line(table: TextTable, line: int, text: str) -> None:
    """Add a line of the file to the header, the IPAC header lines or the rows."""
    if text.startswith("|") and table.rows:
        raise UnfitError(f"a header among the rows: {text!r}.")
    if text.startswith("|"):
        table.bars.append(text)
    elif text.startswith(COMMENTS):
        if not table.rows:
            table.header.append(text.lstrip("".join(COMMENTS)).strip())
    else:
        cells = _cells(_TRAILING.sub("", text))
        if table.rows or any(to_number(cell) is not None for cell in cells):
            table.rows.append(TextRow(line, text, cells))
        elif all(_DAMAGED.match(cell) for cell in cells):
            raise UnfitError(f"not a row of numbers: {text!r}.")
        else:
            table.header.append(text)


def _check_commas(rows: list[TextRow]) -> None:
    """Refuse rows such as 30,5,2,0, which may be four numbers or two with decimal commas."""
    cells = [cell for row in rows for cell in row.cells]
    halves = all(len(row.cells) % 2 == 0 and len(row.cells) > 2 for row in rows)
    commas = all(len(row.text.split()) == 1 and "," in row.text for row in rows)
    if halves and commas and all(cell.lstrip("+-").isdigit() for cell in cells):
        raise UnfitError(f"{rows[0].text!r} may have decimal commas; {_WRITE}.")


SPECTRA = ("TT", "EE", "BB", "TE")
#: First columns of the files that CAMB calls so.
_CAMB_NAMES = ["L", *SPECTRA]
#: Column names in upper case -> the package's: HEALPix (IDL, Fortran, healpy), HEALPix C++.
_NAMES = {
    **dict.fromkeys(("ELL", "INDEX", "MULTIPOLE"), "L"),
    **dict.fromkeys(("TEMPERATURE", "TEMPERATURE C_L"), "TT"),
    **dict.fromkeys(("GRADIENT", "E-MODE C_L"), "EE"),
    **dict.fromkeys(("CURL", "B-MODE C_L"), "BB"),
    **dict.fromkeys(("G-T", "T-E CROSS C_L"), "TE"),
}
_CAMB = "..._lensedCls.dat and ..._totCls.dat"
_D_ELL = re.compile(r"(?<![a-z0-9])D_?(L|ELL)(?![a-z])|\bL\s*\*?\s*\(L\s*\+\s*1\)", re.I)
#: |TE| may exceed sqrt(TT EE) by this factor, from rounding in text with six digits.
_ROUNDING = 1 + 1e-5


def _up_to(
    ell: Float[np.ndarray, " row"], values: np.ndarray, lmax: int, start: int
) -> Float[np.ndarray, "... ell"]:
    """Return the values at l = 0 ... lmax; 0 below the first row, which is at most l = `start`."""
    if lmax < 0:
        raise ValueError(f"Argument `lmax` must not be negative, but is {lmax}.")
    if odd := int(np.sum(~(ell == np.round(ell)) | (ell < 0))):
        raise UnfitError(f"{odd} of {ell.size} rows do not begin with a multipole.")
    if ell[0] > start:
        raise UnfitError(f"begins at l = {ell[0]:.0f}, but l = {start} is needed.")
    if np.any(jumps := np.diff(ell) != 1):
        at = int(np.argmax(jumps))
        raise UnfitError(f"l = {ell[at]:.0f} is followed by l = {ell[at + 1]:.0f}.")
    if ell[-1] < lmax:
        raise UnfitError(f"ends at l = {ell[-1]:.0f}, but lmax is {lmax}.")
    below = np.zeros((*values.shape[:-1], int(ell[0])))
    return np.concatenate([below, values], axis=-1)[..., : lmax + 1]


def _known(names: Sequence[object]) -> list[str]:
    """Return the package's names for columns."""
    words = [str(name).upper() for name in names]
    return [_NAMES.get(word, word) for word in words]


def _located(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Return the numbers of the columns wanted."""
    known = _known(names)
    if missing := [name for name in wanted if name not in known]:
        hint = f"; CAMB writes it to {_CAMB}" if missing == ["BB"] else ""
        raise UnfitError(f"no column {', '.join(missing)}; it has {', '.join(names)}{hint}.")
    return [known.index(name) for name in wanted]


def _text_order(text: TextTable, fields: list[str] | None) -> list[str]:
    """Return the column names of a text file, from its header, `fields` or the file name."""
    file, width = text.path.name, text.width
    if names := next((known for known in map(_known, text.headings()) if "TT" in known), None):
        listed = " ".join(names)
        if len(names) != width:
            said = f"the header names {len(names)} columns ({listed})"
            raise UnfitError(f"{said}, but there are {width}.")
        if fields is not None and names[: len(fields)] != fields:
            raise UnfitError(f"`fields` are {' '.join(fields)}, the columns {listed}.")
        return names
    if file.endswith("scalCls.dat"):
        raise UnfitError(f"CAMB's scalar spectra have no BB; read {_CAMB}.")
    if fields is None and file.endswith(("lensedCls.dat", "totCls.dat")):
        fields = _CAMB_NAMES
    if fields is None:
        example = ", ".join(f'"{name}"' for name in _CAMB_NAMES)
        raise UnfitError(f"no header names the columns; give their names, `fields` = [{example}].")
    if width < len(fields):
        raise UnfitError(f"there are {width} columns, but the names {' '.join(fields)}.")
    return fields


def _fits_factor(name: str, found: str | None, given: str | None) -> float:
    """Return the factor to uK_CMB^2 from the unit of a column, or from the argument `unit`."""
    stated = None if (found or "").lower() in ("", "unknown") else found
    if (units := [unit for unit in (given, stated) if unit is not None]) == []:
        raise UnfitError(f'column {name} has no unit; give `unit`, such as "uK_CMB^2".')
    factors = []
    for unit in units:
        try:
            # Bare kelvins in a CMB spectrum mean thermodynamic temperature.
            definite = re.sub(r"K\^2$", "K_CMB^2", unit_name(unit))
            factors.append(unit_factor(definite, "uK_CMB^2"))
        except ValueError:
            raise UnfitError(
                f"column {name} has the unit {unit!r}, which is no square of K_CMB."
            ) from None
    if factors[0] != factors[-1]:
        raise UnfitError(f"argument `unit` is {given}, but column {name} is in {stated}.")
    return factors[0]


def _spectra_of_fits(
    path: Path, unit: str | None
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, "4 row"]]:
    """Read the multipoles of a FITS table, and C_l of TT, EE, BB, TE [uK_CMB^2]."""
    with open_fits(path) as hdus:
        table = select_hdu(hdus, 1, TABLES)
        if stated := _D_ELL.search(repr(table.header)):
            raise UnfitError(f"the header says {stated[0]!r}; spectra in FITS files must be C_l.")
        names = table.columns.names
        columns, known = _located(names, SPECTRA), _known(names)
        factors = [_fits_factor(names[c], table.header.get(f"TUNIT{c + 1}"), unit) for c in columns]
        values = np.array([np.ravel(table.data.field(c)) for c in columns], np.float64)
        ell = table.data.field(known.index("L")) if "L" in known else np.arange(values.shape[1])
        return np.array(ell, float).ravel(), values * np.array(factors)[:, None]


def _first(bad: np.ndarray) -> str:
    return f"{bad.sum()} multipoles, the first l = {np.argmax(bad)}"


def read_spectra(
    path: str | Path,
    lmax: int,
    *,
    fields: Sequence[str | int] | None = None,
    unit: str | None = None,
) -> Float[np.ndarray, "4 ell"]:
    """Read power spectra C_l of TT, EE, BB, TE from a file [uK_CMB^2], l = 0 ... lmax.

    * Text with l and D_l = l (l+1) C_l / 2 pi [uK^2], as of the Planck Legacy Archive and CAMB. The
      header names the columns; without one, they are L TT EE BB TE if the file's name ends in
      totCls.dat or lensedCls.dat (CAMB), and must else be given as `fields`.
    * FITS tables with C_l as written by HEALPix and healpy, from l = 0 unless there is a column
      of multipoles. Units are read from the header; a bare K^2 means K_CMB^2.

    Multipoles 0 and 1 are zero where the file does not have them.

    Parameters
    ----------
    path : text or FITS file
    lmax : largest multipole
    fields : names of the first columns of a text file without a header, in order, for example
        ["L", "TT", "TE", "EE", "BB"]
    unit : unit of a FITS table that states none (`healpy.write_cl`), for example "uK_CMB^2"

    Raises
    ------
    InputError
        If the file lacks a spectrum or multipoles, if neither file nor arguments state columns
        and units, or if values are negative or not finite, or |TE| exceeds sqrt(TT EE).
    """
    path = Path(path)
    with in_file(path):
        named = None if fields is None else _known(fields)
        if named is not None and len(set(named)) < len(named):
            raise UnfitError(f"`fields` must differ, but are {', '.join(named)}.")
        if is_fits(path):
            if named is not None:
                raise UnfitError("`fields` is for text files, columns of FITS files have names.")
            ell, values = _spectra_of_fits(path, unit)
        else:
            if unit is not None:
                raise UnfitError("argument `unit` is for FITS files, text is in uK^2.")
            text = read_text(path)
            table = text.numbers()
            at, *columns = _located(_text_order(text, named), ("L", *SPECTRA))
            ell = table[:, at]
            factor = np.where(ell > 0, 2 * np.pi / np.maximum(ell * (ell + 1), 1), 0)
            values = table[:, columns].T * factor
        spectra = _up_to(ell, values, lmax, 2)
        for name, row in zip(SPECTRA, spectra, strict=True):
            bad = ~np.isfinite(row) | ((row < 0) & (name != "TE"))
            if bad.any():
                kind = "finite" if name == "TE" else "finite and not negative"
                raise UnfitError(f"{name} must be {kind}, but is not at {_first(bad)}.")
        TT, EE, _, TE = spectra
        if np.any(bad := np.abs(TE) > np.sqrt(TT * EE) * _ROUNDING):
            raise UnfitError(f"|TE| exceeds sqrt(TT EE) at {_first(bad)}.")
    return spectra


#: Columns with b_l: HEALPix, Planck's T E B windows, instrument models of HFI and LFI.
_WINDOWS = ("TEMPERATURE", "INTENSITY", "T", "NOMINAL", "BL")


def _window_of_fits(path: Path, hdu: int | str) -> Float[np.ndarray, " row"]:
    def windows(table: object) -> list[str]:
        names = table.columns.names if isinstance(table, TABLES) else []
        return [name for name in names if name.upper() in _WINDOWS]

    with open_fits(path) as hdus:
        table = select_hdu(hdus, hdu, TABLES)
        if not (names := windows(table)):
            others = ", ".join(h.name for h in hdus if windows(h))
            raise UnfitError(
                f"HDU {hdu!r}: no column is named {', '.join(_WINDOWS)}; it has "
                f"{', '.join(table.columns.names)}{others and f'; give `hdu`, one of {others}'}."
            )
        return np.array(table.data.field(names[0]), np.float64).ravel()


def read_beam(path: str | Path, lmax: int, *, hdu: int | str = 1) -> Float[np.ndarray, " ell"]:
    """Read the window b_l of a beam from a file, l = 0 ... lmax, normalised to 1 at l = 0.

    The table must contain b_l, the factor on a_lm, not its square.

    * Text with columns l and b_l (`read_text`), including IPAC tables such as those of WMAP;
      further columns are ignored.
    * FITS tables from l = 0, of HEALPix or Planck: the first column named TEMPERATURE, INTENSITY,
      T, NOMINAL or BL, which is the temperature window if there are several.

    The normalisation removes the power that a main beam misses in its far sidelobes (1 % at 30 GHz
    in LFI_RIMO_R3.31).

    Parameters
    ----------
    path : text or FITS file
    lmax : largest multipole; a table that does not reach it is an InputError
    hdu : number or name of the FITS table, for example "BEAMWF_030X030" of an instrument model
    """
    path = Path(path)
    with in_file(path):
        if is_fits(path):
            window = _window_of_fits(path, hdu)
            ell = np.arange(window.size, dtype=float)
        elif (text := read_text(path)).width < 2:
            raise UnfitError("one column, but l and b_l are needed.")
        else:
            ell, window = text.numbers().T[:2]
        window = _up_to(ell, window, lmax, 0)
        if bad := int(np.sum(~np.isfinite(window))):
            raise UnfitError(f"{bad} of {window.size} values of the window are not finite.")
        if not window[0] > 0:
            raise UnfitError(f"the window must be positive at l = 0, but is {window[0]:g}.")
    return window / window[0]
