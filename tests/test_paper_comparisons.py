"""The paper's figures of model against maps: made, and their numbers those of the commands."""

from pathlib import Path

import pytest

from fits.commands.forecast import forecast
from fits.commands.paper import STEPS, make_figures
from fits.commands.run import DEFAULTS
from fits.common import common_maps
from fits.comparison import compare
from fits.inputs import inputs_of
from fits.paper.figures_model import forecast_settings
from fits.paper.sky import PaperSky
from fits.regions import region_masks
from fits.results import with_error
from jaxsky.settings import Experiment, load

LABELS = [f"Figure {n}" for n in range(5, 13)]
EXAMPLE = Path(__file__).parents[1] / "examples" / "paper_real_sky.toml"


@pytest.fixture(scope="module")
def small() -> Experiment:
    values = [
        "sky.embedded.nside=64",
        'bands.0.channels=["44", "70", "353"]',
        'bands.1.channels=["K"]',
        "common={ nside = 32, fwhm = 120.0 }",
        "compare={ nsims = 30, lmax = 60, patches_nside = 64 }",
    ]
    return load(DEFAULTS / "paper.toml", values)


@pytest.fixture(scope="module")
def made(small, tmp_path_factory):
    out = tmp_path_factory.mktemp("paper") / "out"
    return out, {item.label: item for item in make_figures(small, out, LABELS)}


def numbers(items):
    return {number.what: number for item in items.values() for number in item.numbers}


@pytest.mark.slow
def test_figures(made):
    out, items = made
    assert set(LABELS) <= set(items)
    for label in LABELS:
        item = items[label]
        assert item.section.caption
        assert item.section.note
        assert (out / item.section.picture).read_bytes().startswith(b"\x89PNG")
    page = (out / "index.html").read_text()
    assert all(items[label].section.picture in page for label in LABELS)


@pytest.mark.slow
def test_numbers_are_those_of_the_comparison(small, made):
    found = compare(
        small,
        common_maps(inputs_of(small), small.common.nside, small.common.fwhm),
        region_masks(small, small.compare.regions),
    )
    shown = numbers(made[1])
    for band in ("44", "70", "353", "K"):
        scatter = found.scatters[band, "strip", "QU"]
        assert shown[f"slope, {band}, Q and U"].ours == with_error(scatter.slope, scatter.error)
    leaky = next(s for s in found.spectra if s.band == "70")
    assert f"after {leaky.pte[1]:.2f}" in shown["PTE of BB, 70"].ours


@pytest.mark.slow
def test_indices_agree_with_the_truth(made):
    shown = numbers(made[1])
    for name, truth in (("dust.beta_dust", 1.53), ("synchrotron.beta_syn", 3.1)):
        number = shown[f"{name}, full, Q and U"]
        best, low, high = map(float, number.ours.split())
        assert number.note == f"truth {truth:g}"
        assert abs(best - truth) < 2 * (high - low)


@pytest.mark.slow
def test_b_modes_are_those_of_the_forecast(small, made):
    found = forecast(forecast_settings(PaperSky(small)))
    shown = numbers(made[1])
    for band, equal in found.equal_r.items():
        assert shown[f"r with as much BB at l = 80, {band} GHz"].ours == f"{equal['l = 80']:.3g}"


@pytest.mark.slow
def test_without_bands_of_the_paper(data_dir, monkeypatch, tmp_path):
    """The real maps are WMAP's: no Planck spectra, no leakage, and patches of the template."""
    monkeypatch.setenv("JAXSKY_DATA", str(data_dir))
    settings = load(EXAMPLE)
    how = settings.compare.model_copy(update={"nsims": 30})
    settings = settings.model_copy(update={"compare": how})
    figures = make_figures(settings, tmp_path / "out", [str(n) for n in range(5, 13)])
    items = {item.label: item for item in figures}
    assert items["Figure 7"].section.note.startswith("Not made: None of the bands 30, 44, 70, 353")
    assert items["Figure 9"].section.note.startswith("Not made: No band has a map of leakage")
    shown = numbers(items)
    assert {"slope, V, Q and U", "slope, W, Q and U"} <= set(shown)
    # Planck finds half as much power in B as in E (intermediate results 30).
    assert 0.4 < float(shown["median A of BB / EE"].ours) < 0.65


def test_all_figures_have_a_step():
    figures = [label for label in STEPS if label.startswith("Figure")]
    assert figures == [f"Figure {n}" for n in range(1, 15)]
    assert list(STEPS).index("Table 1") == 13
