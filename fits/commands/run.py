"""What all commands do: settings, folder, steps, and the report of what was found.

A command is a function from its settings to a `Report`; the rest is here, once.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from fits.commands.console import Steps, console, print_tables, print_written, warn
from fits.commands.endings import ERROR_LOG, interruptible, keep_traceback
from fits.commands.page import ResultTable, Section, write_page
from fits.writing import write_json, write_log
from jaxsky.io.folders import ALL, Folder, occupied
from jaxsky.settings import Experiment, load, of_file

#: Steps and their times, and the page that shows the results, in every folder.
LOG, PAGE = "log.txt", "index.html"
#: When, where and with what a command was run, next to its numbers.
CIRCUMSTANCES = "log.json"
#: Experiments that commands have without a file.
DEFAULTS = Path(__file__).parents[1] / "defaults"


class Report(NamedTuple):
    """What a command has found: said on the terminal, and shown on a page unless `page` is False.

    `numbers` go to the first file of the command's results, with description and warnings.
    `pictures` are names of files, each with a function and what it takes after the path; it returns
    False if there is nothing to draw. `written` are other files.
    """

    description: str
    tables: Sequence[ResultTable] = ()
    warnings: Sequence[str] = ()
    numbers: Mapping[str, Any] | None = None
    pictures: Mapping[str, tuple[Any, ...]] = {}
    written: Sequence[Path] = ()
    remark: str = ""
    page: bool = True


class Run(NamedTuple):
    """A command at work: what it may write, and to whom it says what it does."""

    out: Path
    resume: bool
    overwrite: bool
    results: Sequence[str]
    folder: Folder
    steps: Steps
    part: range

    @property
    def log(self) -> Path:
        """File of the steps and their times; one for each process that makes a part of results."""
        first = self.part.start
        return self.out / (f"log_{first:05d}.txt" if first else LOG)

    def begin(self) -> None:
        """Nothing is wrong with the input: what is to be replaced goes, and the log begins."""
        if self.overwrite:
            self.folder.remove((*self.results, CIRCUMSTANCES))
            self.folder.narrow(self.part)  # others may make the rest
        self.steps.keep(self.log)


class Command(NamedTuple):
    """What a command is; its name is also that of the settings that it takes without a file.

    `work` calls `Run.begin` before it writes; `results` are patterns of all files but the logs.
    """

    name: str
    work: Callable[[Experiment, Run], Report]
    results: tuple[str, ...] = ()
    resumable: bool = True


def run_command(
    command: Command,
    settings_file: Path | None,
    out: Path,
    values: Sequence[str] | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    maps: Path | None = None,
    part: range = ALL,
) -> None:
    """Run a command with what the command line says.

    `part` of the results is made, see `jaxsky.io.folders.occupied`. All of them are replaced, so
    nobody else may be making any then.
    """
    path, values = settings_file or DEFAULTS / f"{command.name}.toml", list(values or ())
    if maps is not None:
        values.append(f"common.maps={json.dumps(str(maps.resolve()))}")
    settings = load(path, values)
    with (
        of_file(path),
        results_folder(
            out,
            command.results,
            resume=resume if command.resumable else None,
            overwrite=overwrite,
            part=ALL if overwrite else part,
        ) as folder,
        Steps() as steps,
    ):
        import matplotlib as mpl

        from jaxsky.montecarlo import other_sky

        mpl.use("Agg")  # pictures go to files
        running = Run(out, resume, overwrite, command.results, folder, steps, part)
        report = command.work(settings, running)
        report = report._replace(warnings=[*report.warnings, *other_sky(settings)])
        written = [*_write(settings, report, running), *report.written]
        if report.page:
            written.insert(0, _show(out, settings.title, report, written, steps.seconds))
    if report.description:
        console.print(report.description)
    print_tables(report.tables)
    for sentence in report.warnings:
        warn(sentence)
    print_written([*written, running.log])
    if report.remark:
        console.print(report.remark, soft_wrap=True)


def _write(settings: Experiment, report: Report, command: Run) -> list[Path]:
    """Write the numbers, a log and the pictures of a report."""
    if report.numbers is None:
        return []
    command.steps.step("drawing")
    written = [command.out / command.results[0], command.out / CIRCUMSTANCES]
    said = {"description": report.description, "warnings": report.warnings}
    write_json(written[0], {**said, **report.numbers})
    for name, (draw, *drawn) in report.pictures.items():
        if draw(command.out / name, *drawn) is not False:
            written.append(command.out / name)
    write_log(written[1], settings, command.steps.seconds)
    return written


@contextmanager
def results_folder(
    out: Path,
    results: Sequence[str] = (),
    *,
    resume: bool | None,
    overwrite: bool,
    part: range = ALL,
) -> Iterator[Folder]:
    """The folder of the results, in which no other command writes the same meanwhile.

    It is made if it is not there, and removed again if nothing was written. What `results` says is
    kept, replaced, or refused if it is to be neither; `resume` is None for commands that cannot be
    resumed. `part` of the results is made, see `jaxsky.io.folders.occupied`.
    """
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is not a folder; choose another --out.")
    stopped = interruptible("" if resume is None else "; resume with --resume")
    with stopped, occupied(out, part) as folder:
        if not folder.locked:
            warn(
                f"{out}: this file system has no locks, so see to it that no other command writes "
                "there meanwhile."
            )
        if not (resume or overwrite) and any(any(out.glob(name)) for name in results):
            go_on = "" if resume is None else "go on with --resume, "
            raise ValueError(
                f"{out}: holds results already; {go_on}replace them with --overwrite, or choose "
                "another --out."
            )
        folder.clean()
        (out / ERROR_LOG).unlink(missing_ok=True)
        try:
            yield folder
        except Exception as error:
            if [path.name for path in out.glob("[!.]*")] == [LOG]:
                (out / LOG).unlink()  # of nothing that would be in the folder
            keep_traceback(error, out / ERROR_LOG)
            raise


def _show(out: Path, title: str, report: Report, written: Sequence[Path], seconds: float) -> Path:
    """Write the page of a command's tables and pictures."""
    tables = [Section(f"Results {i}", t.caption, table=t) for i, t in enumerate(report.tables, 1)]
    drawn = [path for path in written if path.suffix == ".png"]
    pictures = [Section(path.stem.replace("_", " "), picture=path.name) for path in drawn]
    intro = [report.description, *(f"(!) {sentence}" for sentence in report.warnings)]
    end = f"Written by `{' '.join(['jaxsky', *sys.argv[1:2]])}` in {seconds:.0f} s,"
    write_page(out / PAGE, title or "jaxsky", intro, [*tables, *pictures], end)
    return out / PAGE
