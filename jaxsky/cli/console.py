"""What commands share: console and progress, and the example of the settings."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

__all__ = [
    "console",
    "print_tables",
    "print_written",
    "progress_bar",
    "replace_unprintable",
    "warn",
    "write_example",
]

#: Everything is printed as it is: names, titles and paths may have brackets and colons.
PLAIN: dict[str, Any] = {"markup": False, "emoji": False, "highlight": False}
console = Console(stderr=True, **PLAIN)


def replace_unprintable() -> None:
    """Have characters that a terminal's encoding does not have replaced, rather than refused."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def warn(sentence: str) -> None:
    """Print a warning."""
    console.print(Text.assemble(("(!)", "yellow"), " ", sentence))


def print_tables(*tables: RenderableType, width: int | None = None) -> None:
    """Print results, on standard output."""
    for table in tables:
        Console(width=width, **PLAIN).print(table)


def print_written(paths: Sequence[Path]) -> None:
    """Say what was written; not wrapped, so that paths can be copied."""
    console.print("Written: " + ", ".join(map(str, paths)), soft_wrap=True)


def progress_bar() -> Progress:
    """What is being done, how much of it, and how long it will take; gone when it is done."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )


def write_example(path: Path, example: Path) -> None:
    """Write an example of the settings, unless the file exists."""
    if path.exists():
        raise ValueError(f"{path}: exists already and is left as it is.")
    path.write_text(example.read_text())
    print_written([path])
