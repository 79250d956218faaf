"""The page that shows results: static, with nothing from outside its folder."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jaxsky
from jaxsky.io import write_text

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

    The first cell is the heading of its row, the first `words` columns hold words rather than
    numbers. Behind an empty row begins a new section; a row that is cut short is its heading.
    """

    header: Row
    rows: list[Row]
    caption: str = ""
    words: int = 1


class Section(NamedTuple):
    """A part of a page: a picture, which is a file in its folder, or a table, or both.

    The note is what is to be known about it; before its first colon, if there is one, in bold.
    """

    title: str
    caption: str = ""
    picture: str | None = None
    table: ResultTable | None = None
    note: str = ""


def key_of(title: str) -> str:
    """A title as an anchor: what is before its colon."""
    return title.partition(":")[0].lower().replace(" ", "-")


def _table(table: ResultTable) -> str:
    """A table; cells that begin with a number do not break."""

    def cell(text: str) -> str:
        number = len(text) < 24 and text[:1] in "0123456789-" and bool(text)
        return f'<td class="n">{escape(text)}</td>' if number else f"<td>{escape(text)}</td>"

    head = "".join(f'<th scope="col">{escape(word)}</th>' for word in table.header)
    rows = "\n".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(map(cell, row[1:]))}</tr>'
        for row in table.rows
        if row
    )
    return (
        f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}\n</tbody></table></div>"
    )


def _section(section: Section) -> str:
    title = escape(section.title)
    parts = [f'<section id="{escape(key_of(section.title))}">', f"<h2>{title}</h2>"]
    if section.picture is not None:
        picture = escape(section.picture)
        parts.append(
            f'<figure><a href="{picture}"><img src="{picture}" alt="{title}"></a></figure>'
        )
    if section.caption:
        parts.append(f"<p>{escape(section.caption)}</p>")
    if section.table is not None:
        parts.append(_table(section.table))
    if section.note:
        what, colon, rest = section.note.partition(": ")
        words = f"<b>{escape(what)}:</b> {escape(rest)}" if colon else escape(what)
        parts.append(f'<p class="note">{words}</p>')
    return "\n".join([*parts, "</section>"])


def write_page(
    path: Path, title: str, intro: Sequence[str], sections: Sequence[Section], end: str
) -> None:
    """Write a page of sections, whole or not at all: intro, paragraphs; end, its last line."""
    links = "\n".join(
        f'<li><a href="#{escape(key_of(s.title))}">{escape(s.title)}</a></li>' for s in sections
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
