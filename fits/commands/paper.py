"""`jaxsky paper`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands.run import (
    Init,
    Kind,
    Options,
    Overwrite,
    Report,
    Resume,
    Run,
    SettingsPath,
    Values,
    run,
)

__all__ = ["paper"]


def paper(
    settings_file: SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/paper"),
    init: Init = False,
    only: Annotated[
        list[str] | None,
        typer.Option(help="A figure by its number, or 'table 1'; repeatable. Default all."),
    ] = None,
    values: Values = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
) -> None:
    """Make the figures and tables of the paper again, and a page that shows them."""
    from fits.paper.settings import EMBEDDED, EXAMPLE, PaperSettings

    def work(settings: PaperSettings, command: Run) -> Report:
        from fits.paper.run import run as make

        options = command.options
        items = make(
            settings,
            command.out,
            only or (),
            resume=options.resume,
            overwrite=options.overwrite,
            progress=command.steps,
        )
        missing = [f"{i.label}: {i.differs}" for i in items if not (i.picture or i.table)]
        count = f"{len(items)} figures and tables ({command.steps.seconds:.1f} s)"
        return Report("", (), missing, (), f"Written: {command.out / 'index.html'}, {count}.")

    # What is kept and what is replaced is seen to figure by figure.
    kind = Kind(PaperSettings, EMBEDDED, EXAMPLE, "paper.toml", ())
    run(kind, work, Options(settings_file, out, init, values, resume, overwrite))
