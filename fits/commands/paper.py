"""`jaxsky paper`: remake the figures and tables of the paper, and a page that shows them."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from fits.commands.report import ResultTable, Row, Section, write_page
from fits.commands.run import CIRCUMSTANCES, PAGE, Report, Run
from fits.paper import figures_data, figures_model
from fits.paper.sky import TEXTS, Impossible, PaperFigure, PaperSky, picture_of
from fits.results import write_log
from jaxsky.io import write_text
from jaxsky.programs import forget_programs
from jaxsky.settings import Experiment, changed_settings

#: File of the settings and the figures made with them, from which a stopped run resumes.
KEPT, FILE = "figures.json", TypeAdapter(tuple[dict[str, Any], list[PaperFigure]])
#: Label of the table of numbers from all figures.
NUMBERS = "Numbers of the text"
PAPER = (
    "Hervías-Caimapo, Bonaldi & Brown (2016), “A new model of the microwave polarized sky for CMB "
    "experiments”"
)
#: Figures of observed maps.
OBSERVED = {f"Figure {n}" for n in range(5, 12)}
#: Makes a figure from the sky that figures share and the path of its picture, an atomic write;
#: raises `Impossible` where the settings do not allow the figure.
Make = Callable[[PaperSky, Path], PaperFigure]
#: Figures and tables in the order of the paper.
STEPS: dict[str, Make] = {
    "Figure 1": figures_model.figure_templates,
    "Figure 2": figures_model.figure_spectra,
    "Figure 3": figures_model.figure_indices,
    "Figure 4": figures_model.figure_ame,
    "Figure 5": figures_data.figure_scatter,
    "Figure 6": figures_data.figure_maps,
    "Figure 7": partial(figures_data.figure_full_sky, "Planck"),
    "Figure 8": partial(figures_data.figure_full_sky, "WMAP"),
    "Figure 9": figures_data.figure_leakage,
    "Figure 10": figures_data.figure_patches,
    "Figure 11": figures_data.figure_probability,
    "Figure 12": figures_model.figure_b_modes,
    "Figure 13": figures_model.figure_patch,
    "Table 1": figures_model.table_core,
    "Figure 14": figures_model.figure_randomised,
}


def labels_of(words: Iterable[str]) -> list[str]:
    """Return labels of figures, in order, from numbers or labels; all if none are given."""
    labels, wanted = {label.lower(): label for label in STEPS}, set()
    for word in words:
        name = " ".join(word.lower().split())
        name = f"figure {name}" if name.isdigit() else name
        if name not in labels:
            raise ValueError(
                f"--only: there is no {word!r}; there are {', '.join(labels.values())}."
            )
        wanted.add(labels[name])
    return [label for label in labels.values() if not wanted or label in wanted]


def make_figures(settings: Experiment, command: Run, only: Iterable[str]) -> list[PaperFigure]:
    """Make the missing figures and tables, and `index.html`, which shows all that exist.

    `only` lists numbers or labels of figures. With --overwrite, the wanted figures are made again;
    others in the folder are kept if they were made with these settings, and otherwise removed once
    the first new figure is there. Returns all figures of the page, new and old.
    """
    out, overwrite, wanted = command.out, command.overwrite, labels_of(only)
    mark = settings.model_dump(mode="json", exclude_none=True)
    figures, other = _kept(out, mark, overwrite)
    command.steps.keep(command.log)  # not `begin`: old figures are replaced one by one
    paper = PaperSky(settings, command.executor)
    made = {
        label
        for label, (_, section, *_) in figures.items()
        if section.table or (out / (section.picture or "")).is_file()
    }
    todo = [label for label in wanted if overwrite or label not in made]
    for done, label in enumerate(todo):
        command.steps.step(label)
        command.steps.advance(done, len(todo))
        start = time.perf_counter()
        try:
            figure = STEPS[label](paper, out / picture_of(label))
        except Impossible as reason:
            figure = PaperFigure(label, Section(f"{label}: not made", note=f"Not made: {reason}"))
        for name in other - {figure.section.picture}:
            (out / name).unlink(missing_ok=True)
        other = set()
        figures[label] = figure._replace(seconds=round(time.perf_counter() - start, 1))
        write_text(out / KEPT, FILE.dump_json((mark, list(figures.values())), indent=2).decode())
        _write_page(paper, out, figures)
        if OBSERVED.isdisjoint(todo[done + 1 :]):
            paper.forget_bands()
        # Figures have no compiled programs in common, and the memory of these adds up.
        forget_programs()
    shown = _write_page(paper, out, figures)
    write_log(out / CIRCUMSTANCES, settings, command.steps.seconds)
    return shown


def _kept(
    out: Path, settings: dict[str, Any], overwrite: bool
) -> tuple[dict[str, PaperFigure], set[str]]:
    """Return the figures in a folder made with these settings, and pictures of other settings."""
    path, made_with, figures = out / KEPT, settings, list[PaperFigure]()
    try:
        if path.exists():
            made_with, figures = FILE.validate_json(path.read_bytes())
    except ValidationError:
        if not overwrite:
            raise ValueError(f"{path}: is damaged; start again with --overwrite.") from None
    if made_with == settings:
        return {figure.label: figure for figure in figures}, set()
    if not overwrite:
        changed = ", ".join(changed_settings(made_with, settings))
        raise ValueError(
            f"{out}: holds figures of other settings ({changed}); choose another --out, or start "
            "again with --overwrite."
        )
    return {}, {f.section.picture for f in figures if f.section.picture is not None}


def _write_page(
    paper: PaperSky, out: Path, figures: Mapping[str, PaperFigure]
) -> list[PaperFigure]:
    """Write the page of all figures in order and the table of their numbers; return these."""
    shown = [figures[label] for label in STEPS if label in figures]
    rows: list[Row] = [(n.what, n.paper, n.ours, n.note, f.label) for f in shown for n in f.numbers]
    if rows:
        table = ResultTable(("quantity", "paper", "here", "about it", "see"), rows)
        texts, head = TEXTS[NUMBERS], f"{NUMBERS}: {TEXTS[NUMBERS]['title']}"
        section = Section(head, texts["caption"], None, table, texts["note"])
        shown.append(PaperFigure(NUMBERS, section))
    seconds = sum(figure.seconds for figure in shown)
    write_page(
        out / PAGE,
        f"A model of the microwave polarized sky: {paper.settings.title}",
        [paper.description, f"Figures and tables of {PAPER}, made again and numbered as there."],
        [figure.section for figure in shown],
        f"Written by `jaxsky paper` in {seconds:.0f} s,",
    )
    return shown


def report_figures(settings: Experiment, command: Run, *, only: Sequence[str]) -> Report:
    """Make some figures, or all, and report what was written."""
    figures = make_figures(settings, command, only)
    sections = {figure.label: figure.section for figure in figures}
    missing = [f"{n}: {s.note}" for n, s in sections.items() if not (s.picture or s.table)]
    remark = f"{len(figures)} figures and tables ({command.steps.seconds:.1f} s)."
    return Report("", warnings=missing, written=[command.out / PAGE], remark=remark)
