"""What the page of the paper is made of: figures and tables, with the words of `paper.toml`."""

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fits.commands.page import ResultTable, Section

#: Titles, captions, what differs from the paper, and numbers of its text, by label.
TEXTS: dict[str, Any] = tomllib.loads(
    Path(__file__).with_name("paper.toml").read_text(encoding="utf-8")
)


class Impossible(ValueError):
    """A figure that the settings do not allow, and why in one sentence: the others go on."""


class Number(NamedTuple):
    """A number of the paper's text next to ours, and what is to be known about it."""

    what: str
    ours: str
    note: str = ""
    paper: str = ""


class PaperFigure(NamedTuple):
    """A figure or a table, by the paper's number ("Figure 1"), and the seconds that it took.

    The note of its section is on what differs from the paper, whose text gives the numbers.
    """

    label: str
    section: Section
    numbers: tuple[Number, ...] = ()
    seconds: float = 0.0


def filled(text: str, **words: Any) -> str:
    """A text of `paper.toml` on one line, its words in braces filled in."""
    return " ".join(text.format_map(words).split())


def picture_of(label: str) -> str:
    """Name of the picture of a figure."""
    return re.sub(r"\d+", lambda n: f"{int(n[0]):02d}", label.lower().replace(" ", "_")) + ".png"


def described(
    label: str,
    numbers: Sequence[Number] = (),
    *,
    table: ResultTable | None = None,
    texts: str | None = None,
    **words: Any,
) -> PaperFigure:
    """A figure with the texts of its label, filled in, and what the paper says of its numbers.

    Other `texts` than those of the label are named by their heading in `paper.toml`.
    """
    own = TEXTS[texts or label]
    published, otherwise = own.get("published", {}), own.get("otherwise", "not given")
    title, caption, differs = (filled(own[key], **words) for key in ("title", "caption", "differs"))
    section = Section(
        f"{label}: {title}",
        caption,
        picture_of(label) if table is None else None,
        table,
        f"Differs from the paper: {differs}",
    )
    said = [one._replace(paper=published.get(one.what, otherwise)) for one in numbers]
    return PaperFigure(label, section, tuple(said))
