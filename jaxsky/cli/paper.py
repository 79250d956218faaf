"""`jaxsky paper`."""

import time
from pathlib import Path
from typing import Annotated

import typer

from jaxsky.cli.console import console, progress_bar, warn, write_example
from jaxsky.cli.results import results_folder
from jaxsky.settings_keys import of_file

__all__ = ["paper"]


def paper(
    settings_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[PAPER.toml]", help="Settings; without, the embedded sky is shown."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/paper"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(help="A figure by its number, or 'table 1'; repeatable. Default all."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep what is in --out and make what is missing.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is in --out.")
    ] = False,
) -> None:
    """Make the figures and tables of the paper again, and a page that shows them."""
    started = time.perf_counter()
    from fits.paper import settings as paper_settings

    if init:
        write_example(settings_file or Path("paper.toml"), paper_settings.EXAMPLE)
        return
    settings_file = settings_file or paper_settings.EMBEDDED
    settings = paper_settings.load_paper(settings_file)
    with (
        of_file(settings_file),
        results_folder(out, resume=resume, overwrite=overwrite),
        progress_bar() as progress,
    ):
        task = progress.add_task("starting", total=None)
        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        from fits.paper.run import run

        def report(label: str, done: int, of: int) -> None:
            progress.update(task, description=label, completed=done, total=of)

        items = run(settings, out, only or (), resume=resume, overwrite=overwrite, report=report)
    for item in items:
        if item.picture is None and item.table is None:
            warn(f"{item.label}: {item.differs}")
    console.print(
        f"Written: {out / 'index.html'}, {len(items)} figures and tables "
        f"({time.perf_counter() - started:.1f} s).",
        soft_wrap=True,
    )
