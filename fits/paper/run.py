"""All figures and tables of the paper in order, and the page that shows them."""

import gc
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax

from fits.commands.page import Section, Table, write_page
from fits.paper import (
    comparisons,
    experiment,
    forecasts,
    small_scales,
    spectral_index,
    templates,
)
from fits.paper.item import NUMBERS, Impossible, Item
from fits.paper.sources import Sources
from fits.paper.store import Store
from fits.record import write_log
from jaxsky.progress import QUIET, Progress
from jaxsky.settings import Experiment

LOG = "log.json"
PAPER = (
    "Hervías-Caimapo, Bonaldi & Brown (2016), “A new model of the microwave polarized sky for CMB "
    "experiments”"
)


class Step(NamedTuple):
    """How one item is made.

    Parameters
    ----------
    label : of the item, as the paper numbers it
    make : function of the settings, what is shared between figures (`Sources.once`), and the
        folder, to which it writes its picture whole; raises `Impossible` where the settings do
        not allow the figure
    """

    label: str
    make: Callable[[Experiment, Sources, Path], Item]


#: In the order of the paper.
STEPS: list[Step] = [
    Step("Figure 1", templates.figure_templates),
    Step("Figure 2", small_scales.figure_spectra),
    Step("Figure 3", templates.figure_indices),
    Step("Figure 4", templates.figure_ame),
    Step("Figure 5", comparisons.figure_scatter),
    Step("Figure 6", comparisons.figure_maps),
    Step("Figure 7", comparisons.figure_planck),
    Step("Figure 8", comparisons.figure_wmap),
    Step("Figure 9", comparisons.figure_leakage),
    Step("Figure 10", comparisons.figure_patches),
    Step("Figure 11", spectral_index.figure_probability),
    Step("Figure 12", forecasts.figure_b_modes),
    Step("Figure 13", experiment.figure_patch),
    Step("Table 1", experiment.table_core),
    Step("Figure 14", small_scales.figure_randomised),
]


def labels_of(words: Iterable[str], steps: Iterable[Step] = STEPS) -> list[str]:
    """Labels of items by number or label; all without any.

    Examples
    --------
    >>> labels_of(["2", "table 1"])
    ['Figure 2', 'Table 1']
    """
    known = {step.label.lower(): step.label for step in steps}
    wanted = set()
    for word in words:
        name = " ".join(word.lower().split())
        name = f"figure {name}" if name.isdigit() else name
        if name not in known:
            raise ValueError(
                f"--only: there is no {word!r}; there are {', '.join(known.values())}."
            )
        wanted.add(known[name])
    return [label for label in known.values() if not wanted or label in wanted]


def _numbers(items: Iterable[Item]) -> Item | None:
    """All numbers of the paper's text as one table; None if there are none."""
    header = ("quantity", "paper", "here", "about it", "see")
    rows = tuple(
        (number.what, number.paper, number.ours, number.note, item.label)
        for item in items
        for number in item.numbers
    )
    if not rows:
        return None
    return Item(
        NUMBERS,
        "paper and here",
        "Numbers that the text of the paper gives about what its figures show.",
        "Only numbers of figures that are on this page.",
        table=Table(header, rows),
    )


def run(
    settings: Experiment,
    out: Path,
    only: Iterable[str] = (),
    *,
    resume: bool = False,
    overwrite: bool = False,
    begin: Callable[[], None] = lambda: None,
    progress: Progress = QUIET,
    steps: Iterable[Step] | None = None,
) -> list[Item]:
    """Make figures and tables, and `index.html`, which shows all that are in the folder.

    Parameters
    ----------
    settings : of the sky
    out : folder of the results
    only : numbers of figures or labels (`labels_of`); by default all
    resume : keep what is in the folder and make what is missing
    overwrite : make again what is wanted; what else is in the folder is kept if it is of these
        settings
    begin : called when nothing is wrong with what is wanted, before anything is written
    progress : told of each item
    steps : instead of `STEPS`

    Returns
    -------
    The items of the page, those that were there already among them.
    """
    started = time.perf_counter()
    steps = list(STEPS if steps is None else steps)
    order, wanted = [step.label for step in steps], labels_of(only, steps)
    store, sources = Store(out, settings, resume, overwrite), Sources(settings)
    begin()
    todo = [s for s in steps if s.label in wanted and (overwrite or not store.has(s.label))]
    for done, step in enumerate(todo):
        progress.step(step.label)
        progress.advance(done, len(todo))
        start = time.perf_counter()
        try:
            item = step.make(settings, sources, out)
        except Impossible as reason:
            item = Item(step.label, "not made", "", f"Not made: {reason}")
        store.add(item._replace(seconds=round(time.perf_counter() - start, 1)))
        _show(settings, sources, store, order)
        # No two figures have programs in common, and what these hold adds up.
        jax.clear_caches()
        gc.collect()
    items = _show(settings, sources, store, order)
    write_log(out / LOG, settings, time.perf_counter() - started)
    return items


def _show(settings: Experiment, sources: Sources, store: Store, order: list[str]) -> list[Item]:
    """Write the page."""
    items = store.ordered(order)
    numbers = _numbers(items)
    items = [*items, numbers] if numbers else items
    seconds = sum(item.seconds or 0 for item in items)
    write_page(
        store.out / "index.html",
        f"A model of the microwave polarized sky: {settings.title}",
        [sources.description, f"Figures and tables of {PAPER}, made again and numbered as there."],
        [_section(item) for item in items],
        f"Written by `jaxsky paper` in {seconds:.0f} s,",
    )
    return items


def _section(item: Item) -> Section:
    note = item.differs if item.label == NUMBERS else f"Differs from the paper: {item.differs}"
    title = f"{item.label}: {item.title}"
    return Section(title, item.caption, item.picture, item.table, note)
