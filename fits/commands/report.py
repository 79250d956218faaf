"""Show results on the terminal and on an HTML page, and the progress of a command."""

import time
from collections.abc import Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from rich.text import Text

import jaxsky
from jaxsky import programs
from jaxsky.io import write_text

#: Everything is printed literally: names, titles and paths may contain brackets and colons.
PLAIN: dict[str, Any] = {"markup": False, "emoji": False, "highlight": False}
console = Console(stderr=True, **PLAIN)
#: Duration above which a step leaves a line on a terminal, and interval of the progress of a long
#: step in a log [s].
NOTICED, OFTEN = 2.0, 60.0
STYLE = """
body { font: 17px/1.5 Georgia, "Times New Roman", serif; color: #222; background: #fff;
  max-width: 56rem; margin: 2rem auto 4rem; padding: 0 1rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin-bottom: .3rem; }
h2 { font-size: 1.15rem; margin: 0 0 .8rem; }
nav ol { columns: 2; padding-left: 1.2rem; list-style: none; padding: 0; }
section { border-top: 1px solid #ccc; margin-top: 2.2rem; padding-top: 1.2rem; }
figure { margin: 0 0 1rem; text-align: center; }
img { max-width: 100%; max-height: 48rem; }
.note { background: #f4f1ea; border-left: 3px solid #e69f00; padding: .4rem .8rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font: 13.5px/1.4 "Helvetica Neue", Arial, sans-serif; }
th, td { padding: .25rem .55rem; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; }
td.n { white-space: nowrap; font-variant-numeric: tabular-nums; }
thead th { border-bottom: 2px solid #888; }
a { color: #0072b2; }
.small { color: #666; font-size: .85rem; }
@media print { nav { display: none; } section { break-inside: avoid; } }
"""
Row: TypeAlias = tuple[str, ...]


class ResultTable(NamedTuple):
    """A table as text, for the terminal and for a page.

    The first cell of a row is its heading; the first `words` columns are text, not numbers. An
    empty row starts a new section; a row with fewer cells than the header is a heading.
    """

    header: Row
    rows: list[Row]
    caption: str = ""
    words: int = 1


class Section(NamedTuple):
    """A part of a page with a picture (a file in the page's folder), a table, or both.

    `note` is a remark about it; the part before its first colon, if there is one, is in bold.
    """

    title: str
    caption: str = ""
    picture: str | None = None
    table: ResultTable | None = None
    note: str = ""


def warn(sentence: str) -> None:
    """Print a warning."""
    console.print(Text.assemble(("(!)", "yellow"), " ", sentence))


def print_tables(tables: Sequence[ResultTable], width: int | None = None) -> None:
    """Print tables on standard output, in lines wider than the terminal where numbers need it."""
    out = Console(width=width, **PLAIN)
    for table in tables:
        caption = table.caption or None
        shown = RichTable(caption=caption, box=box.SIMPLE, pad_edge=False, collapse_padding=True)
        for i, word in enumerate(table.header):
            shown.add_column(word, justify="left" if i < table.words else "right", overflow="fold")
        for row in table.rows:
            heading = "bold" if len(row) < len(table.header) else ""
            shown.add_row(*row, style=heading) if row else shown.add_section()
        least = Measurement.get(out, out.options.update(width=10_000), shown).minimum
        Console(width=max(out.width, least), **PLAIN).print(shown)


def print_written(paths: Sequence[Path]) -> None:
    """Print the paths that were written, unwrapped so that they can be copied."""
    console.print("Written: " + ", ".join(map(str, paths)), soft_wrap=True)


class Steps(programs.Progress):
    """Show the steps of a command: a progress bar on a terminal, otherwise one line per step.

    `keep` also writes them to a file. On a terminal, a step that takes longer than two seconds
    leaves a line with its time.
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
        """Seconds since the command began."""
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
        """Write the steps so far, and all later ones, to a file."""
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
        """End a step; if it took long, print its time on a terminal."""
        taken = time.perf_counter() - self._begun
        if console.is_terminal and self._message and taken > NOTICED:
            console.print(f"{self._message}: {taken:.1f} s", soft_wrap=True)
        self._message = ""


def anchor(title: str) -> str:
    """Return the HTML anchor of a title: the part before its colon."""
    return escape(title.partition(":")[0].lower().replace(" ", "-"))


def _cell(text: str) -> str:
    """Return a table cell as HTML; a short one that begins with a number does not wrap."""
    number = 0 < len(text) < 24 and text[0] in "0123456789-"
    return f'<td class="n">{escape(text)}</td>' if number else f"<td>{escape(text)}</td>"


def _section(section: Section) -> str:
    title = escape(section.title)
    parts = [f'<section id="{anchor(section.title)}">', f"<h2>{title}</h2>"]
    if section.picture is not None:
        file = escape(section.picture)
        parts.append(f'<figure><a href="{file}"><img src="{file}" alt="{title}"></a></figure>')
    if section.caption:
        parts.append(f"<p>{escape(section.caption)}</p>")
    if section.table is not None:
        head = "".join(f'<th scope="col">{escape(word)}</th>' for word in section.table.header)
        rows = (
            f'<tr><th scope="row">{escape(first)}</th>{"".join(map(_cell, rest))}</tr>'
            for first, *rest in filter(None, section.table.rows)
        )
        parts += [
            f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>',
            *rows,
            "</tbody></table></div>",
        ]
    if section.note:
        what, colon, rest = section.note.partition(": ")
        words = f"<b>{escape(what)}:</b> {escape(rest)}" if colon else escape(what)
        parts.append(f'<p class="note">{words}</p>')
    return "\n".join([*parts, "</section>"])


def write_page(
    path: Path, title: str, intro: Sequence[str], sections: Sequence[Section], end: str
) -> None:
    """Write a static HTML page atomically: paragraphs `intro`, sections, and a last line `end`.

    It loads nothing from outside its folder.
    """
    links = "\n".join(
        f'<li><a href="#{anchor(s.title)}">{escape(s.title)}</a></li>' for s in sections
    )
    write_text(
        path,
        f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{escape(title)}</h1>
{"".join(f"<p>{escape(words)}</p>" for words in intro)}
<nav><ol>
{links}
</ol></nav>
{"".join(map(_section, sections))}
<p class="small">{escape(end)} jaxsky {jaxsky.__version__}.</p>
</body>
</html>
""",
    )
