"""The terminal: what is being done, tables, warnings."""

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from rich.text import Text

from fits.commands.page import ResultTable
from jaxsky import progress

#: Everything is printed as it is: names, titles and paths may have brackets and colons.
PLAIN: dict[str, Any] = {"markup": False, "emoji": False, "highlight": False}
console = Console(stderr=True, **PLAIN)
#: A step on a terminal that took longer leaves a line [s], and a long one in a log says so often
#: how far it is.
NOTICED, OFTEN = 2.0, 60.0


def replace_unprintable() -> None:
    """Have characters that a terminal's encoding does not have replaced, rather than refused."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def warn(sentence: str) -> None:
    """Print a warning."""
    console.print(Text.assemble(("(!)", "yellow"), " ", sentence))


def print_tables(tables: Sequence[ResultTable], width: int | None = None) -> None:
    """Print results on standard output, where it is too narrow for a number in longer lines."""
    out = Console(width=width, **PLAIN)
    for table in tables:
        shown = RichTable(
            caption=table.caption or None,
            box=box.SIMPLE,
            pad_edge=False,
            collapse_padding=True,
        )
        for i, word in enumerate(table.header):
            shown.add_column(word, justify="left" if i < table.words else "right", overflow="fold")
        for row in table.rows:
            heading = "bold" if len(row) < len(table.header) else ""
            shown.add_row(*row, style=heading) if row else shown.add_section()
        least = Measurement.get(out, out.options.update(width=10_000), shown).minimum
        Console(width=max(out.width, least), **PLAIN).print(shown)


def print_written(paths: Sequence[Path]) -> None:
    """Say what was written; not wrapped, so that paths can be copied."""
    console.print("Written: " + ", ".join(map(str, paths)), soft_wrap=True)


class Steps(progress.Progress):
    """The steps of a command: a line that moves on a terminal, elsewhere a line for each.

    With `keep`, they are in a file as well. A step that takes longer than two seconds leaves its
    time on the terminal.
    """

    def __init__(self) -> None:
        self._started = self._begun = self._said = time.perf_counter()
        self._message, self._lines = "", list[str]()
        self._path: Path | None = None
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[part]}", markup=False),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=None, part="")

    @property
    def seconds(self) -> float:
        """Since the command began."""
        return time.perf_counter() - self._started

    def __enter__(self) -> "Steps":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._bar.stop()

    def step(self, message: str) -> None:
        self._end()
        self._message, self._begun, self._said = message, time.perf_counter(), time.perf_counter()
        self._bar.reset(self._task, description=message, total=None, part="")
        self._say(message)

    def advance(self, done: int, of: int) -> None:
        self._bar.update(self._task, completed=done, total=of, part=f"{done}/{of}")
        if time.perf_counter() - self._said > OFTEN:
            self._said = time.perf_counter()
            self._say(f"{self._message}: {done} of {of}")

    def keep(self, path: Path) -> None:
        """Write the steps to a file, from now on and those that were."""
        self._path = path
        path.write_text("".join(self._lines), encoding="utf-8")

    def _say(self, words: str) -> None:
        line = f"{self.seconds:7.1f} s  {words}"
        if not console.is_terminal:
            console.print(line, soft_wrap=True)
        self._lines.append(f"{line}\n")
        if self._path is not None:
            with suppress(OSError), self._path.open("a", encoding="utf-8") as file:
                file.write(self._lines[-1])

    def _end(self) -> None:
        """Leave a line on the terminal about a step that took long."""
        taken = time.perf_counter() - self._begun
        if console.is_terminal and self._message and taken > NOTICED:
            console.print(f"{self._message}: {taken:.1f} s", soft_wrap=True)
        self._message = ""
