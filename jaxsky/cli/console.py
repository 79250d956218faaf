"""What commands share: console and progress, the example of the settings, results' folder."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

__all__ = ["check_out", "claim", "console", "progress_bar", "write_example"]

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


def check_out(out: Path, results: Sequence[str], resume: bool | None, overwrite: bool) -> None:
    """Refuse a folder that has results (patterns), unless they are to be kept or replaced.

    `resume` is None for commands that have nothing to go on with.
    """
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is not a folder; choose another --out.")
    if not (resume or overwrite) and any(any(out.glob(name)) for name in results):
        go_on = "" if resume is None else "go on with --resume, "
        raise ValueError(
            f"{out}: holds results already; {go_on}replace them with --overwrite, or choose "
            "another --out."
        )


def claim(out: Path, results: Sequence[str], overwrite: bool) -> None:
    """Make the folder of the results, and with overwrite remove those that it has."""
    out.mkdir(parents=True, exist_ok=True)
    if overwrite:
        for name in results:
            for path in out.glob(name):
                path.unlink()
