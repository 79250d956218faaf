"""Objects that print as a heading and a few rows of values with units, in notebooks as a table."""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxsky.checks import is_concrete

#: A heading, and rows of equally many cells.
Summary = tuple[str, Sequence[Sequence[str]]]


class Printed:
    """Base class of what has a `summary`."""

    def summary(self) -> Summary:
        """The heading, and rows of cells."""
        raise TypeError(f"{type(self).__name__} must define `summary`.")

    def __str__(self) -> str:
        return as_text(self.summary())

    def _repr_html_(self) -> str:
        return as_html(self.summary())


def as_text(summary: Summary) -> str:
    """Lines of a terminal."""
    heading, rows = summary
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join([heading, *(f"  {line}" for line in lines)])


def as_html(summary: Summary) -> str:
    """A table of a notebook."""
    heading, rows = summary
    cells = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    return f"<b>{html.escape(heading)}</b><table>{body}</table>"


def shown(value: Any, unit: str = "") -> str:
    """A number, the range of a map or several numbers, with their unit."""
    if isinstance(value, tuple):
        return ", ".join(shown(one, unit) for one in value)
    if not is_concrete(value):
        return f"unknown while JAX traces, shape {np.shape(value)}"
    if np.ndim(value):
        low, middle, high = np.percentile(value, [0, 50, 100])
        return f"map from {shown(low)} to {shown(high, unit)}, median {middle:.5g}"
    return f"{float(value):.5g} {unit}".rstrip()


def shown_maps(maps: Any, unit: str) -> str:
    """Stokes parameters, number of pixels and rms of maps (stokes, pix)."""
    named = "I, Q, U" if len(maps) == 3 else "Q, U"
    parts = [f"{named} in {maps.shape[-1]} pixels"]
    if is_concrete(maps):
        parts.append(f"rms {np.sqrt(np.mean(np.square(maps[-2:]))):.4g} {unit}")
    return ", ".join(parts)
