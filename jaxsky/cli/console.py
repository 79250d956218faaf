"""What commands share: console and progress, and the example of the settings."""

from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

__all__ = ["console", "progress_bar", "write_example"]

console = Console(stderr=True)


def progress_bar() -> Progress:
    """What is being done, how much of it, and how long it will take; gone when it is done."""
    return Progress(
        TextColumn("{task.description}"),
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
    console.print(f"Written: {path}")
