"""What the page of the paper is made of: figures and tables, with the words of `paper.toml`."""

import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fits.commands.page import ResultTable

#: Titles, captions, what differs from the paper, and numbers of its text, by label.
TEXTS: dict[str, Any] = tomllib.loads(
    Path(__file__).with_name("paper.toml").read_text(encoding="utf-8")
)


class Impossible(ValueError):
    """A figure that the settings do not allow, and why in one sentence: the others go on."""


@dataclass(frozen=True)
class Number:
    """A number of the paper's text next to ours, and what is to be known about it."""

    what: str
    ours: str
    note: str = ""
    paper: str = ""


@dataclass(frozen=True)
class Item:
    """A figure or a table.

    Parameters
    ----------
    label : as the paper numbers it, "Figure 1"
    title : a few words
    caption : what is shown
    differs : one line on what differs from the paper, and why
    picture : file in the folder of the page
    table : what is shown instead of a picture, or below it
    numbers : that the paper's text gives about it
    seconds : that it took
    """

    label: str
    title: str
    caption: str
    differs: str
    picture: str | None = None
    table: ResultTable | None = None
    numbers: tuple[Number, ...] = ()
    seconds: float | None = None


def filled(text: str, **words: Any) -> str:
    """A text of `paper.toml` on one line, its words in braces filled in."""
    return " ".join(text.format_map(words).split())


def described(
    label: str,
    picture: Path | None,
    numbers: Sequence[Number] = (),
    *,
    table: ResultTable | None = None,
    texts: str | None = None,
    **words: Any,
) -> Item:
    """An item with the words of `paper.toml`, and what the paper says of its numbers.

    Parameters
    ----------
    label : of the item
    picture : its file
    numbers, table : of the item
    texts : their heading in `paper.toml`, by default the label
    words : what is filled in
    """
    own = TEXTS[texts or label]
    published, otherwise = own.get("published", {}), own.get("otherwise", "not given")
    title, caption, differs = (filled(own[key], **words) for key in ("title", "caption", "differs"))
    file = None if picture is None else picture.name
    said = [replace(one, paper=published.get(one.what, otherwise)) for one in numbers]
    return Item(label, title, caption, differs, file, table, tuple(said))


def picture_of(label: str) -> str:
    """Name of the picture of a figure.

    Examples
    --------
    >>> picture_of("Figure 1")
    'figure_01.png'
    """
    return re.sub(r"\d+", lambda n: f"{int(n[0]):02d}", label.lower().replace(" ", "_")) + ".png"


def listed(words: Iterable[str]) -> str:
    """Words as a list in a sentence.

    Examples
    --------
    >>> listed(["a", "b", "c"])
    'a, b and c'
    """
    first = list(words)
    return " and ".join(filter(None, (", ".join(first[:-1]), *first[-1:])))
