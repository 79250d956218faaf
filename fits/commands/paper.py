"""`jaxsky paper`."""

from pathlib import Path
from typing import Annotated

import typer

from fits.commands import run
from jaxsky.settings import Experiment


def paper(
    settings_file: run.SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/paper"),
    only: Annotated[
        list[str] | None,
        typer.Option(help="A figure by its number, or 'table 1'; repeatable. Default all."),
    ] = None,
    values: run.Values = None,
    resume: run.Resume = False,
    overwrite: run.Overwrite = False,
) -> None:
    """Make the figures and tables of the paper again, and a page that shows them."""

    def work(settings: Experiment, command: run.Run) -> run.Report:
        from fits.paper.run import run as make

        options = command.options
        items = make(
            settings,
            command.out,
            only or (),
            resume=options.resume,
            overwrite=options.overwrite,
            begin=command.begin,
            progress=command.steps,
        )
        missing = [f"{i.label}: {i.differs}" for i in items if not (i.picture or i.table)]
        count = f"{len(items)} figures and tables ({command.steps.seconds:.1f} s)"
        page = command.out / run.PAGE
        return run.Report("", (), missing, [page], f"{count}.", page=False)

    # What is kept and what is replaced is seen to figure by figure.
    run.run(run.Kind("paper", ()), work, run.Options(settings_file, out, values, resume, overwrite))
