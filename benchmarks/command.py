"""The command line from a cold start."""

import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.table import Row, time_text
from benchmarks.timing import usage

__all__ = ["fit"]


def fit(quick: bool) -> list[Row]:
    """`jaxsky fit` without an argument; in a trial only the command's start."""
    jaxsky = str(Path(sys.executable).with_name("jaxsky"))
    arguments = ["--version"] if quick else ["fit"]
    runs = []
    for _ in range(1 if quick else 3):
        with tempfile.TemporaryDirectory() as folder:
            out = [] if quick else ["--out", folder]
            runs.append(usage([jaxsky, *arguments, *out]))
    wall, peak = median(run.seconds for run in runs), median(run.peak for run in runs)
    times = ", ".join(time_text(run.seconds) for run in runs)
    work = f"`{' '.join(['jaxsky', *arguments])}`, cold process"
    return [
        Row(f"{work}: time", time_text(wall), "< 60 s", wall < 60, f"runs {times}"),
        Row(f"{work}: peak memory", f"{peak:.2f} GiB", "< 2 GiB", peak < 2),
    ]
