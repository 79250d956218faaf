"""Pixels without a value, as arguments mark them or as their values give them away."""

import numbers
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsky.io.tables import InputError

#: Numbers that are written in place of a value that is missing, of either sign.
USUAL = (999.0, 9999.0, 99999.0, 999999.0, 32767.0, 32768.0, 2147483647.0, 2147483648.0)
#: Beyond any value of a sky map in any unit, unless its others are as large.
HUGE = 1e15
#: A sentinel is repeated so often, and so much more often than its neighbour among the values.
REPEATED, MORE_OFTEN = 4, 3
#: A map that is exactly 0 in more of its pixels than this fraction is taken to have a footprint.
ZEROS = 0.3


def parse_missing(given: Any) -> list[float]:
    """The numbers that an argument says to mark missing pixels."""
    several: list = [given] if isinstance(given, numbers.Real | str) else list(given)
    if any(isinstance(x, bool) or not isinstance(x, numbers.Real) for x in several):
        raise InputError(f"Argument `missing` must be a number or a list of them, not {given!r}.")
    return [float(x) for x in several]


def sentinels(
    values: Float[np.ndarray, " pix"], lowest: float | None = None, *, zero: bool = False
) -> list[tuple[float, int]]:
    """Values that look like marks of missing pixels, with the number of their pixels.

    A mark is an extreme far from the rest, further out than the rest is from its median, and
    repeated, or huge; the usual numbers (-999, -32768, ...) count also where they are nearer.

    Parameters
    ----------
    values : of a column, NaN where they are known to be missing
    lowest : what the lowest stored integer of the column stands for; None for other types
    zero : zero is a usual number, too, rather than none
    """
    known = np.isfinite(values)
    rest = values if known.all() else values[known]
    usual = {sign * number for number in USUAL for sign in (1.0, -1.0)} | {lowest}
    usual |= {0.0} if zero else set()
    found: list[tuple[float, int]] = []
    while rest.size:
        for extreme in (float(rest.min()), float(rest.max())):
            count = int(np.count_nonzero(rest == extreme))
            others = _marks(rest, extreme, count, extreme in usual) if zero or extreme else None
            if others is not None:
                found.append((extreme, count))
                rest = others
                break
        else:
            break
    return found


def _marks(rest: np.ndarray, extreme: float, count: int, usual: bool) -> np.ndarray | None:
    """The other values if an extreme marks missing pixels, else None."""
    if count < 2 and not usual and abs(extreme) < HUGE:
        return None
    others = rest[rest != extreme]
    if not others.size:
        return None
    near = others.min() if extreme < others.min() else others.max()
    far = abs(near - extreme) > abs(np.median(others) - near)
    often = max(REPEATED, 1 + MORE_OFTEN * int(np.count_nonzero(others == near)))
    is_mark = far and (usual or abs(extreme) >= HUGE or (count >= often and _is_continuous(others)))
    if usual and count > 1 and not is_mark:
        is_mark = not np.array_equal(others, np.round(others))
    return others if is_mark else None


def _is_continuous(values: np.ndarray) -> bool:
    """True if most values are there once, unlike labels, steps and rings."""
    some = values[:: max(1, values.size // 1000)]
    return np.unique(some).size > some.size / 2


def zeros(columns: Sequence[Float[np.ndarray, " pix"]]) -> float:
    """Fraction of the pixels with values in which all columns are exactly 0."""
    known = np.isfinite(columns[0])
    empty = columns[0] == 0
    for _, values in pairwise(columns):
        known &= np.isfinite(values)
        empty &= values == 0
    return float(np.count_nonzero(empty & known)) / max(float(np.count_nonzero(known)), 1.0)
