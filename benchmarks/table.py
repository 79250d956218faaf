"""The table of results, on the screen and as Markdown."""

import datetime as dt
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

HEADER = ("work", "measured", "target", "", "remarks")
PACKAGES = ("jaxsky", "jax", "numpy", "pysm3", "numba", "emcee", "h5py")


class Row(NamedTuple):
    """A line of the table; `met` is None where there is no target."""

    work: str
    measured: str
    target: str = ""
    met: bool | None = None
    remarks: str = ""

    @property
    def verdict(self) -> str:
        """Pass, miss, or nothing."""
        return {None: "", True: "pass", False: "MISS"}[self.met]

    @property
    def cells(self) -> tuple[str, ...]:
        """What stands in the columns."""
        return self.work, self.measured, self.target, self.verdict, self.remarks


def time_text(seconds: float) -> str:
    """A time with a fitting unit, to three digits."""
    if seconds >= 1:
        return f"{seconds:.3g} s"
    return f"{seconds * 1e3:.3g} ms" if seconds >= 1e-3 else f"{seconds * 1e6:.3g} us"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def conditions(quick: bool) -> list[str]:
    """Date, machine and versions, a sentence each."""
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    today = dt.datetime.now(dt.UTC).date()
    cores, load = _cores(), os.getloadavg()[0]
    return [
        f"{today}, {_processor()}, {cores} cores, load {load:.1f} at the end.",
        f"Python {platform.python_version()}, {versions}; double precision.",
        *(["Small maps: a trial of the benchmarks, no measurement."] if quick else []),
    ]


def rich_table(rows: list[Row]) -> Table:
    """The table for the screen."""
    table = Table(*HEADER, show_lines=True)
    colors = {None: "", True: "green", False: "red"}
    for row in rows:
        table.add_row(*row.cells, style=colors[row.met])
    return table


def markdown(rows: list[Row], lines: list[str]) -> str:
    """The table as a Markdown file."""
    table = [HEADER, ("---",) * len(HEADER), *(row.cells for row in rows)]
    body = "\n".join("| " + " | ".join(cells) + " |" for cells in table)
    return "# Benchmarks\n\n`python -m benchmarks --write`. " + " ".join(lines) + f"\n\n{body}\n"


def renewed(before: str, rows: list[Row], lines: list[str]) -> str:
    """A Markdown file with rows in place of those of the same work, or at its end.

    Each says when it was measured, as the first line does for all others.
    """
    when, own = f"(later: {lines[0].rstrip('.')})", {}
    for row in rows:
        cells = *row.cells[:-1], f"{row.remarks} {when}".strip()
        own[row.work] = "| " + " | ".join(cells) + " |"
    kept = [own.pop(line[2:].partition(" | ")[0], line) for line in before.splitlines()]
    return "\n".join([*kept, *own.values()]) + "\n"
