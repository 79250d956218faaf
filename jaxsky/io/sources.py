"""Columns of one or several HEALPix tables, with what their headers and arguments say of them."""

import numbers
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsky.io.columns import choose
from jaxsky.io.quantities import is_ambiguous, unit_name
from jaxsky.io.tables import (
    COORDINATES,
    ORDERINGS,
    PIXELS,
    HealpixTable,
    InputError,
    open_fits,
)

POLARIZATIONS = {"COSMO": "COSMO", "IAU": "IAU"}


class Source(NamedTuple):
    """A table, and the columns that are read of it; None for those that their names tell."""

    path: Path
    hdu: int | str
    fields: list[int | str] | None


@dataclass(frozen=True)
class Columns:
    """Columns of one table: values in RING order, NaN where missing, and what is said of them."""

    where: str
    names: list[str]
    values: list[Float[np.ndarray, " pix"]]
    lowest: list[float | None]
    alone: bool
    nside: int
    unit: str
    coordinates: str
    polarization: str


def default_fields(table: HealpixTable, argument: str = "fields") -> list[int]:
    """The first I, Q and U columns that are there, by their names; else a column that is alone."""
    if found := choose(table.names):
        return found
    columns = [i for i, name in enumerate(table.names) if name.upper() not in PIXELS]
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
                f"{table.where}: argument `unit` is {given or 'that of a pure number'}, but column "
                f"{name} is {f'in {found}' if found else 'a pure number'}."
            )
        units.append(found if given is None else given)
    if len(set(units)) > 1:
        listed = ", ".join(f"{table.names[c]} [{v}]" for c, v in zip(columns, units, strict=True))
        raise InputError(
            f"{table.where}: columns have different units, read each by itself: {listed}."
        )
    return str(units[0])


def _several(value: Any, scalar: type | tuple[type, ...]) -> list[Any]:
    return [value] if isinstance(value, scalar) else list(value)


def sources(path: Any, hdu: Any, fields: Any) -> list[Source]:
    """File, HDU and columns of each table, from arguments that may be lists."""
    paths, hdus = _several(path, (str, Path)), _several(hdu, (str, numbers.Integral))
    number = max(len(paths), len(hdus))
    for name, given in {"path": paths, "hdu": hdus}.items():
        if len(given) not in (1, number) or not given:
            raise InputError(
                f"Argument `{name}` must be one, or as many as the other names, {number}, "
                f"but is {len(given)}."
            )
    wanted = None if fields is None else _several(fields, (str, numbers.Integral))
    if wanted is not None and not wanted:
        raise InputError(f"{paths[0]}: argument `fields` is empty.")
    if number == 1:
        return [Source(Path(paths[0]), hdus[0], wanted)]
    if wanted is not None and len(wanted) not in (1, number):
        raise InputError(
            f"Argument `fields` must name one column of all {number} tables, or one of each, "
            f"not {len(wanted)}."
        )
    columns = [None] * number if wanted is None else wanted * (number // len(wanted))
    return [
        Source(Path(p), h, None if c is None else [c])
        for p, h, c in zip(
            paths * (number // len(paths)), hdus * (number // len(hdus)), columns, strict=True
        )
    ]


def read_columns(
    source: Source,
    unit: str | None,
    ordering: str | None,
    coordinates: str | None,
    polarization: str | None,
) -> Columns:
    """The columns of one table; arguments as those of `read_maps`."""
    with open_fits(source.path) as hdus:
        table = HealpixTable(source.path, hdus, source.hdu)
        if source.fields is None:
            wanted = default_fields(table)
        else:
            wanted = [table.index(field) for field in source.fields]
            if len(set(wanted)) < len(wanted):
                raise InputError(f"{table.where}: `fields` names a column twice: {source.fields}.")
        unit = _unit(table, wanted, unit)
        order = table.state("ordering", ordering, ("ORDERING",), ORDERINGS)
        return Columns(
            where=table.where,
            names=[table.names[i] for i in wanted],
            values=[table.values(i, order) for i in wanted],
            lowest=[table.lowest(i) for i in wanted],
            alone=sum(name.upper() not in PIXELS for name in table.names) == 1,
            nside=table.nside,
            unit=unit,
            coordinates=table.state(
                "coordinates", coordinates, ("COORDSYS", "SKYCOORD"), COORDINATES
            ),
            polarization=table.state(
                "polarization", polarization, ("POLCCONV",), POLARIZATIONS, default="COSMO"
            ),
        )


def check_alike(tables: Sequence[Columns]) -> None:
    """Refuse tables that differ in what one field has in common."""
    hints = {
        "nside": "one field has one nside",
        "unit": "read each by itself",
        "coordinates": "one field has one system of coordinates",
        "polarization": "give `polarization` if one of them does not say it",
    }
    first = tables[0]
    for name, hint in hints.items():
        for other in tables[1:]:
            one, two = getattr(first, name), getattr(other, name)
            if one != two:
                raise InputError(
                    f"{other.where}: {name} is {two}, but that of {first.where} is {one}; {hint}."
                )
