"""What all commands do: settings, folder, steps, and the report of what was found.

A command is a function from its settings to a `Report`; the rest is here, once.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from fits.commands.console import Steps, console, print_tables, print_written, warn
from fits.commands.endings import interruptible, logged
from fits.commands.page import ResultTable, Section, write_page
from jaxsky.io.folders import ALL, Folder, occupied
from jaxsky.settings import Experiment, load, of_file

#: Steps and their times, and the page that shows the results, in every folder.
LOG, PAGE = "log.txt", "index.html"
#: Steps of a process that makes a part of the results, from its first one.
PART_LOG = "log_{:05d}.txt"
#: Experiments that commands have without a file.
DEFAULTS = Path(__file__).parents[1] / "defaults"


class Options(NamedTuple):
    """What the command line says, to any command."""

    settings_file: Path | None
    out: Path
    values: Sequence[str] | None = None
    resume: bool = False
    overwrite: bool = False
    maps: Path | None = None


class Report(NamedTuple):
    """What a command has found, to be shown.

    Parameters
    ----------
    description : what was looked at, in a sentence
    tables, warnings : results, and what a user should know before using them
    written : files, but for log and page
    remark : what else is said at the end
    page : whether a page of tables and pictures is made of it
    """

    description: str
    tables: Sequence[ResultTable] = ()
    warnings: Sequence[str] = ()
    written: Sequence[Path] = ()
    remark: str = ""
    page: bool = True


class Run(NamedTuple):
    """A command at work: what it may write, and to whom it says what it does."""

    options: Options
    results: Sequence[str]
    folder: Folder
    steps: Steps
    part: range = ALL

    @property
    def out(self) -> Path:
        """Folder of the results."""
        return self.options.out

    def begin(self) -> None:
        """Nothing is wrong with the input: what is to be replaced goes, and the log begins."""
        if self.options.overwrite:
            self.folder.remove(self.results)
        self.steps.keep(self.log)

    @property
    def log(self) -> Path:
        """File of the steps."""
        whole = self.part.start == 0
        return self.out / (LOG if whole else PART_LOG.format(self.part.start))


class Command(NamedTuple):
    """What a command is.

    Parameters
    ----------
    name : of the command, and of the settings that it takes without a file
    work : from settings to what was found; calls `Run.begin` before it writes
    results : patterns of what is in the folder of the results
    resumable : whether a stopped command can be gone on with
    """

    name: str
    work: Callable[[Experiment, Run], Report]
    results: tuple[str, ...] = ()
    resumable: bool = True


def run_command(command: Command, options: Options, part: range = ALL) -> None:
    """Run a command with what the command line says.

    `part` of the results is made, see `jaxsky.io.folders.occupied`.
    """
    path, out = options.settings_file or DEFAULTS / f"{command.name}.toml", options.out
    values = list(options.values or ())
    if options.maps is not None:
        values.append(f"common.maps={json.dumps(str(options.maps.resolve()))}")
    settings = load(path, values)
    with (
        of_file(path),
        results_folder(
            out,
            command.results,
            resume=options.resume if command.resumable else None,
            overwrite=options.overwrite,
            part=part,
        ) as folder,
        Steps() as steps,
    ):
        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        running = Run(options, command.results, folder, steps, part)
        report = command.work(settings, running)
        report = report._replace(warnings=[*report.warnings, *_other_sky(settings)])
        if report.page:
            _show(out, settings.title, report, steps.seconds)
    if report.description:
        console.print(report.description)
    print_tables(report.tables)
    for sentence in report.warnings:
        warn(sentence)
    pages = [out / PAGE] if report.page else []
    print_written([*pages, *report.written, running.log])
    if report.remark:
        console.print(report.remark, soft_wrap=True)


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

    Parameters
    ----------
    out : the folder; made if it is not there, and removed again if nothing was written
    results : patterns of what the command leaves in it
    resume, overwrite : results that are there are kept or replaced, and refused if neither is
        set. `resume` is None for commands that cannot be resumed.
    part : what of the results is made, see `jaxsky.io.folders.occupied`
    """
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is not a folder; choose another --out.")
    stopped = interruptible("" if resume is None else "; resume with --resume")
    with stopped, occupied(out, part) as folder, logged(out):
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
        try:
            yield folder
        except Exception:
            if [path.name for path in out.glob("[!.]*")] == [LOG]:
                (out / LOG).unlink()  # of nothing that would be in the folder
            raise


def _other_sky(settings: Experiment) -> list[str]:
    """A warning about maps that were simulated with other settings than these."""
    if settings.common.maps is None:
        return []
    from jaxsky.montecarlo import changed_tables

    maps = Path(settings.data_dir) / str(settings.common.maps)
    if not (changed := changed_tables(maps, settings)):
        return []
    return [
        f"The maps in {settings.common.maps} were simulated with other settings in the tables "
        f"{', '.join(changed)}; bandpass, beam and noise are those of their files."
    ]


def _show(out: Path, title: str, report: Report, seconds: float) -> None:
    """Write the page of a command's tables and pictures."""
    tables = [
        Section(table.title or f"Results {i}", table.caption, table=table)
        for i, table in enumerate(report.tables, 1)
    ]
    pictures = [
        Section(path.stem.replace("_", " "), picture=path.name)
        for path in report.written
        if path.suffix == ".png"
    ]
    warnings = [f"(!) {sentence}" for sentence in report.warnings]
    command = " ".join(["jaxsky", *sys.argv[1:2]])
    end = f"Written by `{command}` in {seconds:.0f} s,"
    intro = [report.description, *warnings]
    write_page(out / PAGE, title or "jaxsky", intro, [*tables, *pictures], end)
