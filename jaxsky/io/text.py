"""Tables of numbers in text files: what is a header, what is a row, and what is neither."""

import codecs
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsky.io.files import UnfitError, in_file

COMMENTS = ("#", ";", "%", "!", "\\", "|", "//", "*")
_TRAILING = re.compile(r"\s(?:[#!%\\]|//).*")
_NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[ed][+-]?\d+)?|nan|inf|infinity)", re.I | re.ASCII
)
#: What to do about decimal commas.
_WRITE = "write decimal points, or semicolons between the columns"
#: A field that begins as a number does, if not as a word.
_DAMAGED = re.compile(r"[\"'(\[+-]*\.?\d")


class Row(NamedTuple):
    """A line of a table: its number in the file, its text and its fields."""

    line: int
    text: str
    cells: list[str]


def _words(line: str) -> list[str]:
    return re.split(r"[\s,;|]+", line.strip(" ,;|"))


class TextTable(NamedTuple):
    """Lines of a text file: comments and names of columns, the bars of an IPAC header, rows."""

    path: Path
    header: list[str]
    bars: list[str]
    rows: list[Row]

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.rows[0].cells)

    def words(self) -> list[list[str]]:
        """The lines above the rows, split into words."""
        return [_words(line) for line in [*self.bars, *self.header]]

    def names(self) -> list[str]:
        """Names of the columns: those of the last line of the header with so many words."""
        lines = [re.sub(r"[(\[].*?[)\]]", "", line) for line in [*self.bars[:1], *self.header]]
        named = (words for words in map(_words, reversed(lines)) if len(words) == self.width)
        return next(named, [])

    def numbers(self, columns: Sequence[int] | None = None) -> Float[np.ndarray, "row column"]:
        """The numbers of some columns; without, of all, of which each row must have as many."""
        table = []
        for line, text, cells in self.rows:
            wanted = range(len(cells)) if columns is None else columns
            values = [_number(cells[c]) if c < len(cells) else None for c in wanted]
            with in_file(f"{self.path}, line {line}"):
                if None in values:
                    raise UnfitError(f"not a row of numbers: {text!r}.")
                if columns is None and len(values) != self.width:
                    raise UnfitError(f"{len(values)} numbers, but {self.width} in the lines above.")
            table.append(values)
        return np.array(table, np.float64)


def _number(cell: str) -> float | None:
    """The value of a field, exponents of Fortran (1.0D+01) included; None if it is no number."""
    if not _NUMBER.fullmatch(cell):
        return None
    word = cell.lower()
    return float(word if "n" in word else word.replace("d", "e"))


def _lines(path: Path) -> list[str]:
    content = path.read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        raise UnfitError("neither a FITS file nor a text table.") from None
    if "\0" in text:
        raise UnfitError("neither a FITS file nor a text table, for it has NUL bytes.")
    return text.splitlines()


def _cells(text: str) -> list[str]:
    """Fields between semicolons, commas or blanks; a comma may be decimal in the first."""
    if ";" in text:
        return [cell.strip().replace(",", ".") for cell in text.strip(" ;").split(";")]
    words = [word.strip(",") for word in text.split()]
    for word in words if len(words) > 1 else ():
        if "," in word and all(_number(part) is not None for part in word.split(",")):
            raise UnfitError(f"{word!r} is two numbers or one with a decimal comma; {_WRITE}.")
    return [cell for cell in re.split(r"[\s,]+", text) if cell]


def read_text(path: Path) -> TextTable:
    r"""The lines of a text table; UTF-8, or UTF-16 with its mark.

    Comments start with # ; % ! \ | // or *. Columns are separated by blanks, commas or semicolons.
    A line before the first row is a header if none of its fields is a number, and they do not all
    begin with a digit.
    """
    table = TextTable(path, [], [], [])
    with in_file(path):
        for line, text in enumerate(map(str.strip, _lines(path)), start=1):
            if text:
                with in_file(f"{path}, line {line}"):
                    _add_line(table, line, text)
        if not table.rows:
            raise UnfitError("no line has numbers.")
        _check_commas(table.rows)
    return table


def _add_line(table: TextTable, line: int, text: str) -> None:
    """Put a line of the file where it belongs."""
    if text.startswith("|") and table.rows:
        raise UnfitError(f"a header among the rows: {text!r}.")
    if text.startswith("|"):
        table.bars.append(text)
    elif text.startswith(COMMENTS):
        if not table.rows:
            table.header.append(text.lstrip("".join(COMMENTS)).strip())
    else:
        cells = _cells(_TRAILING.sub("", text))
        if table.rows or any(_number(cell) is not None for cell in cells):
            table.rows.append(Row(line, text, cells))
        elif all(_DAMAGED.match(cell) for cell in cells):
            raise UnfitError(f"not a row of numbers: {text!r}.")
        else:
            table.header.append(text)


def _check_commas(rows: list[Row]) -> None:
    """Refuse rows such as 30,5,2,0: two numbers with decimal commas, or four."""
    cells = [cell for row in rows for cell in row.cells]
    halves = all(len(row.cells) % 2 == 0 and len(row.cells) > 2 for row in rows)
    commas = all(len(row.text.split()) == 1 and "," in row.text for row in rows)
    if halves and commas and all(cell.lstrip("+-").isdigit() for cell in cells):
        raise UnfitError(
            f"line {rows[0].line}: {rows[0].text!r} may have decimal commas; {_WRITE}."
        )
