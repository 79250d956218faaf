"""Titles and names are drawn as they are, whatever they look like to TeX."""

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt

from fits.plots import draw_title, in_formula, label, plain, save
from fits.posterior_plots import plot_chains
from fits.results import FitResult

NAMES = [
    "$x_$",
    "a $ b",
    r"\frac{",
    "100 %",
    "_",
    "x^",
    "{",
    "[bold]",
    "[/]",
    "",
    "µ ☃ 🙂",
    90 * "n ",
]


@pytest.mark.parametrize("name", NAMES)
def test_any_name_is_drawn(tmp_path, name):
    figure, axes = plt.subplots(layout="constrained")
    draw_title(figure, f"{name}\n{name}")
    axes.set_title(plain(f"{name}: Q") + r", $\chi^2$")
    axes.set_xlabel(f"${in_formula(name)}$")
    axes.set_ylabel(f"${label(f'calibration.{name}')}$, ${label(f'{name}.beta_dust')}$")
    axes.plot([0, 1], label=plain(name))
    axes.legend(handles=axes.lines)
    save(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_titles_keep_their_characters():
    figure = plt.figure()
    draw_title(figure, r"$x_$ and \$ 100 %")
    assert figure._suptitle.get_text().replace(r"\$", "$") == r"$x_$ and \$ 100 %"
    plt.close(figure)


def test_chains_of_any_name_are_drawn(tmp_path):
    free = ("dust.$x_$", "calibration.44_%")
    chain = np.random.default_rng(0).normal(size=(200, 8, 2))
    result = FitResult(
        "mcmc",
        dict.fromkeys(free, 0.0),
        dict.fromkeys(free, 1.0),
        dict.fromkeys(free, (-1.0, 1.0)),
        free,
        np.eye(2),
        1.0,
        10,
        True,
        "",
        {"chain": chain, "discard": 0, "thin": 1},
    )
    plot_chains(tmp_path / "chains.png", {"$x_$ [/]": result, "b": result}, None, "$x_$")
    assert (tmp_path / "chains.png").exists()
