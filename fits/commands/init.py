"""`jaxsky init`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands.console import print_written
from fits.commands.run import DEFAULTS

#: All that an experiment file can say, with comments.
TEMPLATE = "experiment"


def _names(incomplete: str = "") -> list[str]:
    """The experiments that begin so."""
    return sorted(p.stem for p in DEFAULTS.glob("*.toml") if p.stem.startswith(incomplete))


def init(
    name: Annotated[
        str,
        typer.Argument(
            help=f"{TEMPLATE}: all keys, commented; planck-44-70, planck-separate: Planck's maps "
            "of 2018; or a command, for what it does without a file.",
            autocompletion=_names,
        ),
    ] = TEMPLATE,
    out: Annotated[
        Path | None, typer.Option(help="File to write.", show_default="NAME.toml")
    ] = None,
) -> None:
    """Write an experiment file to start from."""
    if name not in _names():
        raise ValueError(f"There is no experiment {name!r}; there are {', '.join(_names())}.")
    path = out or Path(f"{name}.toml")
    if path.exists():
        raise ValueError(f"{path}: exists already and is left as it is.")
    path.write_text((DEFAULTS / f"{name}.toml").read_text())
    print_written([path])
