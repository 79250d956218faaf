"""Read columns of HEALPix tables, and work out their Stokes parameters, units and missing pixels.

Only names on a list identify the Stokes parameter of a column. They are those of Planck, WMAP,
healpy, the HEALPix libraries, PySM and this package; the position of a column is no evidence.
"""

import numbers
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import reduce
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsky.bandpass import UNITS
from jaxsky.io.files import InputError, UnfitError
from jaxsky.io.quantities import is_ambiguous, unit_name
from jaxsky.io.tables import PIXELS, HealpixTable, equals, open_table

_LETTERS = {"I": "I", "T": "I", "Q": "Q", "U": "U"}
_RUNS = ("FULL", "HM1", "HM2", "HR1", "HR2", "YR1", "YR2", "Y1", "Y2")
_OF_ONE = (
    *("STOKES", "STOKES_INP", "POLARISATION", "POLARIZATION", "ML", "MEAN"),
    *(f"{word}_{run}" for word, run in product(("ML", "MEAN", "STOKES"), _RUNS)),
)
_SPREADS = ("RMS", "STD", "STDDEV", "SIGMA", "ERR", "ERROR", "COV", "VAR", "VARIANCE")
_OF_TWO = ("COV", "COVAR", "COVARIANCE", "VAR", "VARIANCE", "INVCOV", "WEIGHT", "WEIGHTS")
_SCALARS = (
    *("HITS", "HIT", "N_OBS", "NOBS", "N_HITS", "NHITS", "HITMAP", "MASK", "LABEL"),
    *("BETA", "BETA_D", "BETA_S", "BETA_DUST", "BETA_SYN", "BETA_ML", "BETA_MEAN"),
    *("T_D", "T_DUST", "TEMP_ML", "TEMP_MEAN", "CURVATURE", "NU_PIV"),
)


def _ordered(letters: str) -> str:
    """Return the Stokes parameters that letters stand for in the order I, Q, U; "?" for others."""
    return "".join(sorted((_LETTERS.get(c, "?") for c in letters), key="IQU?".index))


def _known() -> dict[str, str]:
    """Map certain names to one Stokes parameter, two of a covariance, or "" for neither."""
    names = dict.fromkeys(("TEMPERATURE", "INTENSITY", "I_MAP", "T_MAP"), "I")
    for letter, one in _LETTERS.items():
        names |= {letter: one, f"STOKES_{letter}": one}
        names |= {f"{letter}_{word}": one for word in _OF_ONE}
        # The spread of a Stokes parameter has no sign, so it is treated like a variance.
        names |= {f"{letter}_{word}": one * 2 for word in _SPREADS}
        names |= {f"{word}_{letter}": one * 2 for word in _SPREADS}
    for a, b in product(_LETTERS, repeat=2):
        names[a + b] = _ordered(a + b)
        for word in _OF_TWO:
            forms = (f"{a}{b}_{word}", f"{word}_{a}{b}", f"{a}{b}{word}", f"{word}{a}{b}")
            names |= dict.fromkeys((*forms, f"{word}_{a}_{b}", f"{a}_{b}_{word}"), _ordered(a + b))
    return names | dict.fromkeys((*_SCALARS, *PIXELS), "")


_KNOWN = _known()


def stokes_of(name: str) -> str | None:
    """Return the Stokes parameter that a column's name identifies; None if it is not certain.

    Two letters stand for a covariance, or an rms, which has no sign either; "" for hits and others.
    """
    return _KNOWN.get(name.strip().upper().replace("-", "_").replace(" ", "_"))


def parse_stokes(given: str | Sequence[str]) -> list[str]:
    """Parse the argument `stokes` into one entry per column.

    It has a letter per column, or words in a list or a string; "" is a column without one.

    Examples
    --------
    >>> parse_stokes("QU"), parse_stokes("QQ, UQ, UU")
    (['Q', 'U'], ['QQ', 'QU', 'UU'])
    """
    words = given.replace(",", " ").split() if isinstance(given, str) else given
    entries = list(words[0]) if isinstance(given, str) and len(words) == 1 else words
    found = [_ordered(str(entry).upper()) for entry in entries]
    if not set(found).issubset(_KNOWN.values()):
        raise InputError(
            "Argument `stokes` must name I, Q, U or pairs of them in the order of the columns, "
            f'such as "QU" or "QQ QU UU", but is {given!r}.'
        )
    return found


#: Numbers commonly written in place of missing values, with either sign.
USUAL = (999.0, 9999.0, 99999.0, 999999.0, 32767.0, 32768.0, 2147483647.0, 2147483648.0)
#: Larger than any value of a sky map in any unit, unless the other values are as large.
HUGE = 1e15
#: A sentinel occurs at least this often, and more than this many times as often as the next value.
REPEATED, MORE_OFTEN = 4, 3
#: A map that is exactly 0 in more than this fraction of its pixels is taken to have a footprint.
ZEROS = 0.3


def sentinels(
    values: Float[np.ndarray, " pix"], lowest: float | None = None, *, zero: bool = False
) -> list[tuple[float, int]]:
    """Find values that look like marks of missing pixels, and count their pixels.

    A mark is an extreme value that is repeated, huge or usual (-999, -32768, ...; `lowest`; zero
    on request), and farther from the next value than that is from the median of the others. Usual
    numbers that occur more than once also count where they are nearer, unless all other values are
    whole numbers. `values` are NaN where they are known to be missing.
    """
    known = np.isfinite(values)
    rest = values if known.all() else values[known]
    usual = {sign * number for number in USUAL for sign in (1.0, -1.0)} | {lowest}
    usual |= {0.0} if zero else set()
    found: list[tuple[float, int]] = []
    while rest.size:
        extremes = float(rest.min()), float(rest.max())
        marks = [x for x in extremes if (zero or x) and _is_mark(rest, x, x in usual)]
        if not marks:
            break
        found.append((marks[0], int(np.count_nonzero(rest == marks[0]))))
        rest = rest[rest != marks[0]]
    return found


def _is_mark(rest: np.ndarray, extreme: float, usual: bool) -> bool:
    """Return whether an extreme value of an array marks missing pixels."""
    count = int(np.count_nonzero(rest == extreme))
    if count < 2 and not usual and abs(extreme) < HUGE:
        return False
    others = rest[rest != extreme]
    if not others.size:
        return False
    near = others.min() if extreme < others.min() else others.max()
    far = abs(near - extreme) > abs(np.median(others) - near)
    often = max(REPEATED, 1 + MORE_OFTEN * int(np.count_nonzero(others == near)))
    # Most values of a map occur once, unlike those of labels, steps and rings.
    some = others[:: max(1, others.size // 1000)]
    repeated = count >= often and np.unique(some).size > some.size / 2
    is_mark = far and (usual or abs(extreme) >= HUGE or repeated)
    if usual and count > 1 and not is_mark:
        is_mark = not np.array_equal(others, np.round(others))
    return bool(is_mark)


class Column(NamedTuple):
    """A column of a HEALPix table: values in RING order, NaN where missing, and its metadata.

    `alone` is True if its table has no other column; `lowest` is the value of the lowest integer
    that the column can store, None for other types.
    """

    where: str
    nside: int
    coordinates: str
    polarization: str
    alone: bool
    name: str
    unit: str
    values: Float[np.ndarray, " pix"]
    lowest: float | None


#: Attributes that all columns read together must share, and the advice if they do not.
_COMMON = {
    "nside": "one field has one nside",
    "unit": "read columns of different units each by itself",
    "coordinates": "one field has one system of coordinates",
    "polarization": "give `polarization` if one of them does not say it",
}


def default_fields(table: HealpixTable, argument: str = "fields") -> list[int]:
    """Choose the first columns named as I, Q and U, whichever exist; else the only column.

    Anything after "_" or "-" is ignored: good enough to choose a column by, but not evidence.
    """
    beginnings = [re.match("([IQU])[_-]", name.upper()) for name in table.names]
    kinds = [stokes_of(n) or (b and b[1]) for n, b in zip(table.names, beginnings, strict=True)]
    if found := [kinds.index(letter) for letter in "IQU" if letter in kinds]:
        return found
    if len(table.fields) == 1:
        return table.fields
    raise UnfitError(
        f"no column is named as I, Q or U; give `{argument}` out of {', '.join(table.names)}."
    )


def _unit(table: HealpixTable, column: int, given: str | None) -> str:
    """Return the unit of a column, from the header or the argument `unit`."""
    text, name, found = table.unit(column), table.names[column], None
    with suppress(ValueError):
        found = unit_name(text) if text else None
    if given is None and (found is None or is_ambiguous(found)):
        says = f"has the unit {text!r}, which leaves open what is meant" if text else "has no unit"
        units = (
            '"uK_CMB", "K_RJ", "MJy/sr", "K" for a temperature of matter or "" for a pure number'
        )
        raise UnfitError(f"column {name} {says}; give `unit`, such as {units}.")
    # The argument may specify which kelvins the header means.
    if given is not None and found not in (None, given, re.sub("_(CMB|RJ)", "", given)):
        is_in = f"in {found}" if found else "a pure number"
        raise UnfitError(f"argument `unit` is {given or 'no unit'}, but column {name} is {is_in}.")
    return str(found if given is None else given)


def _several(value: Any) -> list[Any]:
    return [value] if isinstance(value, str | Path | numbers.Real) else list(value)


def _split(path: Any, hdu: Any, fields: Any) -> list[tuple[Path, Any, list[Any] | None]]:
    """Return file, HDU and columns of each table, from arguments that may be lists."""
    paths, hdus = _several(path), _several(hdu)
    number, wanted = max(len(paths), len(hdus)), None if fields is None else _several(fields)
    columns = [wanted] if number == 1 or wanted is None else [[one] for one in wanted]
    given = {"path": paths, "hdu": hdus, "fields": columns}
    for name, entries in given.items():
        if len(entries) not in (1, number):
            said = f"must be one, or as many as the other names, {number}, but is {len(entries)}"
            raise InputError(f"Argument `{name}` {said}.")
    if wanted == []:
        raise InputError(f"{paths[0]}: argument `fields` is empty.")
    each = (entries * (number // len(entries)) for entries in given.values())
    return [(Path(p), h, c) for p, h, c in zip(*each, strict=True)]


def read_columns(
    path: Any,
    hdu: Any,
    fields: Any,
    unit: str | None,
    stated: Mapping[str, str | None],
    own: slice | None = None,
) -> list[Column]:
    """Read the columns of one or several tables; arguments as in `read_maps`.

    `stated` contains ordering, coordinates and polarization; `own` is a range of pixels, or all.
    """
    columns: list[Column] = []
    for file, number, chosen in _split(path, hdu, fields):
        with open_table(file, number) as table:
            wanted = default_fields(table) if chosen is None else [table.index(f) for f in chosen]
            if len(set(wanted)) < len(wanted):
                raise UnfitError(f"`fields` names a column twice: {chosen}.")
            units = {i: _unit(table, i, unit) for i in wanted}
            order = table.state("ordering", stated["ordering"])
            frame = table.state("coordinates", stated["coordinates"])
            sign = table.state("polarization", stated["polarization"], "COSMO")
            shared = (table.where, table.nside, frame, sign, len(table.fields) == 1)
            for i, text in units.items():
                values = table.values(i, order, own=own)
                columns.append(Column(*shared, table.names[i], text, values, table.lowest(i)))
    first, *others = columns
    for (name, hint), other in product(_COMMON.items(), others):
        one, two = getattr(first, name), getattr(other, name)
        if one != two:
            raise InputError(
                f"{other.where}: {name} of column {other.name} is {two}, but that of "
                f"{first.name} in {first.where} is {one}; {hint}."
            )
    return columns


def column_stokes(
    columns: Sequence[Column], given: str | Sequence[str] | None
) -> tuple[str | None, ...]:
    """Return the Stokes parameter of each column; None where it is unknown and not needed."""
    first, names = columns[0], [column.name for column in columns]
    # healpy names any map that is alone in its file T or TEMPERATURE.
    doubtful = ("T", "TEMPERATURE") if len(names) > 1 or given is not None else ()
    certain = [None if c.alone and c.name in doubtful else stokes_of(c.name) for c in columns]
    if given is None:
        if None in certain and (first.coordinates != "G" or first.polarization == "IAU"):
            galactic = first.coordinates == "G"
            why = "has the IAU sign of U" if galactic else "is not in Galactic coordinates"
            raise InputError(
                f"{first.where}: the file {why}, and the name of column "
                f"{names[certain.index(None)]} does not say which Stokes parameter it holds; give "
                f'`stokes`, such as "QU" or "I", one letter for each of {", ".join(names)}.'
            )
        return tuple(certain)
    stated = [""] * len(names) if given == "" else parse_stokes(given)
    if len(stated) != len(names):
        raise InputError(
            f"{first.where}: argument `stokes` names {len(stated)} columns, but {len(names)} "
            f"are read, {', '.join(names)}."
        )
    for column, one, found in zip(columns, stated, certain, strict=True):
        if not one or found is None:
            continue
        # Whatever its name, a column may be a spread, or have no Stokes parameter.
        if not (found in ("I", "") if one == "I" else one in (found, found * 2)):
            raise InputError(
                f"{column.where}: argument `stokes` says {one} of column {column.name}, whose "
                f"name says {found or 'that it has no Stokes parameter'}."
            )
    return tuple(stated)


def mark_missing(columns: Sequence[Column], missing: Any, zeros_are_data: bool) -> None:
    """Set values listed in `missing` to NaN, in place.

    If there are none, refuse columns with suspected sentinels, unless `missing` is an empty list.
    """
    marks = None if missing is None else _several(missing)
    if any(isinstance(x, bool) or not isinstance(x, numbers.Real) for x in marks or ()):
        raise InputError(f"Argument `missing` must be a number or a list of them, not {missing!r}.")
    found = marks == []
    for column, mark in product(columns, marks or ()):
        marked = equals(column.values, float(mark), 1e-6)
        found |= bool(marked.any())
        column.values[marked] = np.nan
    if found:
        return
    suspects = [
        f"column {c.name} is {number:.9g} in {count} of {c.values.size} pixels, far from its other "
        "values"
        for c in columns
        for number, count in sentinels(c.values, c.lowest)
    ]
    # One after the other: an array of all columns may be large.
    known = reduce(np.logical_and, (np.isfinite(c.values) for c in columns))
    empty = reduce(np.logical_and, (c.values == 0 for c in columns))
    share = np.count_nonzero(empty & known) / max(1, int(np.count_nonzero(known)))
    if columns[0].unit in UNITS and not zeros_are_data and share > ZEROS:
        names = ", ".join(c.name for c in columns)
        suspects.append(f"{names}: exactly 0 in {share:.0%} of the pixels")
    if suspects:
        raise InputError(
            f"{columns[0].where}: {'; '.join(suspects)}; give `missing`, the numbers that mark "
            "pixels without a value, or `missing = []` if all are data."
        )


def stacked(
    columns: list[Column], kinds: Sequence[str | None]
) -> tuple[Float[np.ndarray, "field pix"], Bool[np.ndarray, " pix"]]:
    """Return maps with the COSMO sign of U, and where all have values; elsewhere they are 0.

    The list is emptied to free memory. `kinds` are the Stokes parameters.
    """
    sign = -1.0 if columns[0].polarization == "IAU" else 1.0
    maps = np.empty((len(columns), columns[0].values.size))
    for row in maps:
        row[:] = columns.pop(0).values
    mask = np.asarray(np.isfinite(maps).all(axis=0))
    maps[:, ~mask] = 0
    if sign < 0:
        maps *= np.array([[sign ** (kind or "").count("U")] for kind in kinds])
    return maps, mask
