"""What all commands share: the console, and the example of the settings."""

from pathlib import Path

from rich.console import Console

__all__ = ["console", "write_example"]

console = Console(stderr=True)


def write_example(path: Path, example: Path) -> None:
    """Write an example of the settings, unless the file exists."""
    if path.exists():
        raise ValueError(f"{path}: exists already and is left as it is.")
    path.write_text(example.read_text())
    console.print(f"Written: {path}")
