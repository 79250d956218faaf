"""What a page of the paper is made of: figures and tables, each with how it differs."""

import re
from typing import NamedTuple

from fits.commands.page import Table

#: Label of the table that is collected from all items.
NUMBERS = "Numbers of the text"


class Impossible(ValueError):
    """A figure that the settings do not allow, and why in one sentence: the others go on."""


class Number(NamedTuple):
    """A number of the paper's text beside ours, and what is to be known about it."""

    what: str
    paper: str
    ours: str
    note: str = ""


class Item(NamedTuple):
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
    table: Table | None = None
    numbers: tuple[Number, ...] = ()
    seconds: float | None = None


def picture_of(label: str) -> str:
    """Name of the picture of a figure.

    Examples
    --------
    >>> picture_of("Figure 1")
    'figure_01.png'
    """
    return re.sub(r"\d+", lambda n: f"{int(n[0]):02d}", label.lower().replace(" ", "_")) + ".png"
