"""Run any command: read its settings, guard its results folder, write its report, handle errors.

A command is a function from its settings to a `Report`; all that commands share is here. An error
is printed as one sentence, with its traceback in a file, and Ctrl-C ends any command in seconds.
"""

import _thread
import atexit
import json
import os
import signal
import socket
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import jaxsky
from fits.commands.report import (
    ResultTable,
    Section,
    Steps,
    console,
    print_tables,
    print_written,
    warn,
    write_page,
)
from fits.results import FitError, write_json, write_log
from jaxsky import job
from jaxsky.arrays import STOKES
from jaxsky.io import files
from jaxsky.io.stacks import scratch
from jaxsky.settings import Experiment, SettingsError, check_log, load, of_file
from jaxsky.workers import raised_in, workers_of

#: Files in every results folder: the steps with their times, and the page of results.
LOG, PAGE = "log.txt", "index.html"
#: When, where and with what a command was run, next to its numbers.
CIRCUMSTANCES = "log.json"
#: Settings that may differ where results are resumed.
MAY_DIFFER = {"title", "data_dir", "fit.nsteps", "compare.nsims"}
MAY_DIFFER |= {f"separate.{key}" for key in ("nsims", "nsteps", "sampler")}
#: Folder of the experiments that commands run by default.
DEFAULTS = Path(__file__).parents[1] / "defaults"
#: File in the results folder for the traceback of an error.
ERROR_LOG = "error.log"
#: Messages of other libraries are cut to this many characters.
LONGEST = 500
#: Ctrl-C is repeated after this time [s], in case a callback has swallowed it; after this many
#: repetitions the process ends wherever it is.
PATIENCE, REPETITIONS = 1.0, 3
#: Time for the watching thread to notice Ctrl-C [s].
MOMENT = 0.1


class Report(NamedTuple):
    """Results of a command, printed on the terminal and shown on a page.

    Without a description there is no page, as the command has written its own. `numbers` go to the
    first of its result files, with description and warnings. `pictures` maps file names to a
    function and its arguments after the path; it returns False if there is nothing to draw, and
    then no picture is there. `written` are other files that were written.
    """

    description: str
    tables: Sequence[ResultTable] = ()
    warnings: Sequence[str] = ()
    numbers: Mapping[str, Any] | None = None
    pictures: Mapping[str, tuple[Any, ...]] = {}
    written: Sequence[Path] = ()
    remark: str = ""


class Run(NamedTuple):
    """A running command: its settings, results folder and options, and the steps it reports.

    `executor` makes realisations, None in this process.
    """

    settings: Experiment
    out: Path
    resume: bool
    overwrite: bool
    results: Sequence[str]
    folder: files.Folder
    steps: Steps
    part: range
    executor: Executor | None

    @property
    def log(self) -> Path:
        """Log of the steps and their times; one per process that makes a part of the results."""
        first = self.part.start
        return self.out / (f"log_{first:05d}.txt" if first else LOG)

    def begin(self) -> None:
        """Check or remove what is there and begin the log, once the input is known to be good."""
        job.of_first(self._begin)

    def _begin(self) -> None:
        if self.overwrite:
            self.folder.remove((*self.results, CIRCUMSTANCES))
            self.folder.narrow(self.part)  # others may make the rest
        elif self.resume and self.results and (log := self.out / CIRCUMSTANCES).exists():
            said = self.settings.model_dump(mode="json", exclude_none=True)
            check_log(log, said, "results", MAY_DIFFER)
        self.steps.keep(self.log)


def with_vectors(results: Sequence[str]) -> tuple[str, ...]:
    """Return file names of results, and for each picture those of its vector formats."""
    from fits.plots import VECTOR_FORMATS  # slow to import

    pictures = [name.removesuffix("png") for name in results if name.endswith(".png")]
    return (*results, *(stem + form for stem in pictures for form in VECTOR_FORMATS))


class Command(NamedTuple):
    """A command; its name is also that of its default experiment file.

    `work` calls `Run.begin` before it writes; `results` are patterns of all files but the logs.
    If `shared`, the processes of a job share out the work. `stokes` are the choices of
    `common.stokes` that it takes.
    """

    name: str
    work: Callable[[Experiment, Run], Report]
    results: tuple[str, ...] = ()
    shared: bool = False
    stokes: tuple[str, ...] = tuple(STOKES.values())


def run_command(
    command: Command,
    settings_file: Path | None,
    out: Path,
    values: Sequence[str] | None = None,
    *,
    resume: bool | None = None,
    overwrite: bool = False,
    maps: Path | None = None,
    part: range = files.ALL,
    workers: str | None = None,
) -> None:
    """Run a command with the options of the command line, see `results_folder`."""
    path, values = settings_file or DEFAULTS / f"{command.name}.toml", list(values or ())
    if maps is not None:
        values.append(f"common.maps={json.dumps(str(maps.resolve()))}")
    if (count := job.number()) > 1 and not (command.shared and workers is None):
        raise ValueError(
            f"jaxsky {command.name} was started as {count} processes of a job, which only fit and "
            "separate share out, without --workers; start one process."
        )
    console.quiet = job.index() > 0
    settings = job.of_first(lambda: load(path, values))
    with (
        of_file(path),
        ExitStack() as stack,
        scratch(out),
        Steps() as steps,
        workers_of(workers, warn) as executor,
    ):
        import matplotlib as mpl

        from jaxsky.montecarlo import other_sky

        if settings.common.stokes not in command.stokes:
            raise SettingsError(
                f"common.stokes: jaxsky {command.name} takes {' or '.join(command.stokes)}, not "
                f"{settings.common.stokes}."
            )

        mpl.use("Agg")  # pictures go to files
        results = with_vectors(command.results)
        guard = results_folder(out, results, resume=resume, overwrite=overwrite, part=part)
        folder, owner = job.of_first(lambda: (stack.enter_context(guard), os.getpid()))
        if count > 1:
            files.writer = f"{owner}-{job.index()}"
        running = Run(
            settings, out, bool(resume), overwrite, results, folder, steps, part, executor
        )
        report = command.work(settings, running)
        table = settings.simulate if command.name == "simulate" else settings.common
        said = [*settings.unpolarized(table.stokes), *other_sky(settings)]
        report = report._replace(warnings=[*report.warnings, *said])
        written = job.of_first(lambda: _write(settings, report, running))
        if_stopped("; all results are written")
    if job.index():
        return
    if report.description:
        console.print(report.description)
    print_tables(report.tables)
    for sentence in report.warnings:
        warn(sentence)
    print_written([*written, running.log])
    if report.remark:
        console.print(report.remark, soft_wrap=True)


def _write(settings: Experiment, report: Report, command: Run) -> list[Path]:
    """Write the numbers, log, pictures and page of a report; return the paths of all files."""
    out, written = command.out, list[Path]()
    if report.numbers is not None:
        command.steps.step("drawing")
        written = [out / command.results[0], out / CIRCUMSTANCES]
        said = {"description": report.description, "warnings": report.warnings}
        write_json(written[0], {**said, **report.numbers})
        for name, (draw, *drawn) in report.pictures.items():
            if draw(out / name, *drawn) is not False:
                written.append(out / name)
            else:
                (out / name).unlink(missing_ok=True)
        write_log(written[1], settings, command.steps.seconds)
    written += report.written
    if report.description:
        intro = [report.description, *(f"(!) {sentence}" for sentence in report.warnings)]
        numbered = enumerate(report.tables, 1)
        shown = [Section(f"Results {i}", table.caption, table=table) for i, table in numbered]
        drawn = [path for path in written if path.suffix == ".png"]
        shown += [Section(path.stem.replace("_", " "), picture=path.name) for path in drawn]
        called = " ".join(["jaxsky", *sys.argv[1:2]])
        end = f"Written by `{called}` in {command.steps.seconds:.0f} s,"
        write_page(out / PAGE, settings.title or "jaxsky", intro, shown, end)
        written.insert(0, out / PAGE)
    return written


@contextmanager
def results_folder(
    out: Path,
    results: Sequence[str] = (),
    *,
    resume: bool | None,
    overwrite: bool,
    part: range = files.ALL,
) -> Iterator[files.Folder]:
    """Guard the results folder, so that no other command writes the same results meanwhile.

    It is made if missing, and removed again if nothing was written. Existing files that match
    `results` are an error unless `resume` or `overwrite` is set; `resume` is None for commands that
    cannot be resumed. Only `part` of the results is made, see `jaxsky.io.files.occupied`; but
    `overwrite` replaces all of them, so no other process may be making any.
    """
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is not a folder; choose another --out.")
    if_stopped("" if resume is None else "; resume with --resume")
    with files.occupied(out, files.ALL if overwrite else part) as folder:
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
                (out / LOG).unlink()  # nothing else was written
            keep_traceback(error, out / ERROR_LOG)
            raise


def _sentence(error: BaseException) -> tuple[str, bool]:
    """Return an error on one line, and True if it names the file, key or argument at fault."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}.", True
    package, raised = raised_in(error)
    kinds = (ValueError, KeyError, OSError, FitError)
    if raised and package in ("jaxsky", "fits") and isinstance(error, kinds):
        # The KeyError of a dictionary has the key alone.
        words = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
        if " " in words or not isinstance(error, KeyError):
            return words, True
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first = lines[0][:LONGEST].rstrip(".") if lines else ""
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in first:
        return f"There is not enough memory ({first or 'MemoryError'}).", False
    kind = f"{type(error).__name__} in {package}"
    return (f"{kind}: {first}." if first else f"{kind}."), False


def keep_traceback(error: Exception, path: Path) -> None:
    """Write the traceback of an error to a file, unless its message says enough."""
    if not _sentence(error)[1]:
        text = f"jaxsky {jaxsky.__version__}\n{''.join(traceback.format_exception(error))}"
        with suppress(OSError):
            path.write_text(text, encoding="utf-8", errors="replace")
            error.add_note(str(path))


def print_error(error: Exception) -> None:
    """Print an error as one sentence, with the path of its traceback where that may help."""
    message, enough = _sentence(error)
    if not enough:
        notes = getattr(error, "__notes__", [])
        log = next((note for note in notes if note.endswith(ERROR_LOG)), None)
        if log is None:
            log = tempfile.mkstemp(f"-{ERROR_LOG}", "jaxsky-")[1]
            keep_traceback(error, Path(log))
        message = f"{message} Traceback: {log}"
    console.print("jaxsky: ", style="red", end="")
    console.print(message, soft_wrap=True)


#: What Ctrl-C prints.
_words = ""


def if_stopped(words: str) -> None:
    """Set the words that Ctrl-C prints after "Stopped" from now on."""
    global _words
    _words = f"Stopped{words}."


def _unraisable(error: "sys.UnraisableHookArgs") -> None:
    """Print no traceback of a Ctrl-C that came where no exception can be raised."""
    if error.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(error)


@contextmanager
def interruptible() -> Iterator[None]:
    """End the process with exit code 130 within seconds of Ctrl-C.

    An interrupt becomes an exception only when the main thread runs Python code, not while it waits
    for a computation or compiles; and in a callback (of the garbage collector, of JAX) exceptions
    are printed or turned into others. So a second thread also watches for the signal.
    Files on disk are complete at any moment, so that a run stopped in this way can be resumed.
    """
    if_stopped("")
    pressed, said = threading.Event(), threading.Event()
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def say() -> None:
        if not said.is_set():
            said.set()
            console.print(_words)

    def watch() -> None:
        """Wait for Ctrl-C, then make sure that the process ends."""
        while signal.SIGINT not in (received := reader.recv(64)):
            if not received:  # the command has ended
                return
        pressed.set()
        for _ in range(REPETITIONS):
            if not said.wait(PATIENCE):
                _thread.interrupt_main()
        threading.Event().wait(PATIENCE)  # time for the interpreter to exit
        say()
        console.show_cursor()
        os._exit(130)

    before, sys.unraisablehook = sys.unraisablehook, _unraisable
    descriptor = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    except BaseException as error:
        if isinstance(error, Exception):  # a library made it of Ctrl-C, if one comes by now
            stopped = pressed.wait(MOMENT)
        else:  # typer makes an exit of it
            stopped = isinstance(error, KeyboardInterrupt) or getattr(error, "code", 0) == 130
        if not stopped:
            raise
        say()
        sys.exit(130)
    finally:
        # While the interpreter exits, nothing is left to stop and nobody catches an exception.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        if not pressed.is_set():
            signal.set_wakeup_fd(descriptor)
            sys.unraisablehook = before
            writer.close()
