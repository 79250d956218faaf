"""The page: figures and tables in order, static, with nothing from outside its folder."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import jaxsky
from fits.paper.item import NUMBERS, Item, Table, key_of
from jaxsky.io import write_text

__all__ = ["write_page"]

PAPER = "Hervías-Caimapo, Bonaldi &amp; Brown (2016), “A new model of the microwave polarized sky"
PAPER += " for CMB experiments”"
STYLE = """
body { font: 17px/1.5 Georgia, "Times New Roman", serif; color: #222; background: #fff;
  max-width: 56rem; margin: 2rem auto 4rem; padding: 0 1rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin-bottom: .3rem; }
h2 { font-size: 1.15rem; margin: 0 0 .8rem; }
nav ol { columns: 2; padding-left: 1.2rem; list-style: none; padding: 0; }
section { border-top: 1px solid #ccc; margin-top: 2.2rem; padding-top: 1.2rem; }
figure { margin: 0 0 1rem; text-align: center; }
img { max-width: 100%; max-height: 48rem; }
.differs { background: #f4f1ea; border-left: 3px solid #e69f00; padding: .4rem .8rem; }
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


def _table(table: Table) -> str:
    """A table; cells that begin with a number do not break."""

    def cell(text: str) -> str:
        number = len(text) < 24 and text[:1] in "0123456789-" and bool(text)
        return f'<td class="n">{escape(text)}</td>' if number else f"<td>{escape(text)}</td>"

    head = "".join(f'<th scope="col">{escape(word)}</th>' for word in table.header)
    rows = "\n".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(map(cell, row[1:]))}</tr>'
        for row in table.rows
    )
    return (
        f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}\n</tbody></table></div>"
    )


def _heading(item: Item) -> str:
    return f"{item.label}: {item.title}"


def _section(item: Item) -> str:
    parts = [f'<section id="{key_of(item.label)}">', f"<h2>{escape(_heading(item))}</h2>"]
    if item.picture is not None:
        picture, words = escape(item.picture), escape(_heading(item))
        parts.append(
            f'<figure><a href="{picture}"><img src="{picture}" alt="{words}"></a></figure>'
        )
    if item.caption:
        parts.append(f"<p>{escape(item.caption)}</p>")
    if item.table is not None:
        parts.append(_table(item.table))
    if item.label == NUMBERS:
        parts.append(f'<p class="small">{escape(item.differs)}</p>')
    else:
        parts.append(
            f'<p class="differs"><b>Differs from the paper:</b> {escape(item.differs)}</p>'
        )
    return "\n".join([*parts, "</section>"])


def write_page(path: Path, title: str, description: str, items: Sequence[Item]) -> None:
    """Write the page whole.

    Parameters
    ----------
    path : of the page, in the folder of the pictures
    title : what the sky is, in a few words
    description : the same in a sentence
    items : in the order in which they are shown
    """
    links = "\n".join(
        f'<li><a href="#{key_of(item.label)}">{escape(_heading(item))}</a></li>' for item in items
    )
    body = "\n".join(map(_section, items))
    seconds = sum(item.seconds or 0 for item in items)
    write_text(
        path,
        f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>A model of the microwave polarized sky: {escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>A model of the microwave polarized sky</h1>
<p><b>{escape(title)}.</b> {escape(description)}</p>
<p>Figures and tables of {PAPER}, made again by jaxsky {jaxsky.__version__} and numbered as
there.</p>
<nav><ol>
{links}
</ol></nav>
{body}
<p class="small">Written by <code>jaxsky paper</code> in {seconds:.0f} s.</p>
</body>
</html>
""",
    )
