"""The figures of the paper: all are made, their numbers are right, and the page shows them."""

import html.parser
import json
from pathlib import Path
from unittest import mock

import healpy
import jax
import numpy as np
import pytest

import commands
from fits.commands import paper
from fits.commands.forecast import forecast
from fits.commands.paper import NUMBERS, STEPS, Make, labels_of
from fits.commands.report import Section
from fits.commands.run import DEFAULTS, Run
from fits.common import common_maps
from fits.comparison import compare
from fits.inputs import inputs_of
from fits.paper import figures_model
from fits.paper.figures_model import (
    core_observation,
    figure_patch,
    forecast_settings,
    prepared_templates,
)
from fits.paper.sky import Impossible, Number, PaperFigure, PaperSky, picture_of
from fits.regions import region_masks
from fits.results import with_error
from jaxsky.checks import listed
from jaxsky.harmonics import gaussian_beam, power_spectrum
from jaxsky.io import read_maps
from jaxsky.io.files import ALL, Folder
from jaxsky.observation import Source
from jaxsky.programs import Progress
from jaxsky.settings import Experiment, load
from jaxsky.simulation import harmonic_sources
from jaxsky.small_scales import fit_power_law
from refusals import cases, raises

LABELS = [*(f"Figure {n}" for n in (1, 2, 3, 4, 13)), "Table 1", "Figure 14"]
EXAMPLE = Path(__file__).parents[1] / "examples" / "paper_real_sky.toml"


class Quiet(Progress):
    """Steps that leave no log."""

    seconds = 0.0

    def keep(self, path):
        pass


def make_figures(settings, out, only=(), *, overwrite=False, steps=STEPS) -> list[PaperFigure]:
    """As the command does in its folder."""
    out.mkdir(parents=True, exist_ok=True)
    command = Run(settings, out, True, overwrite, (), Folder(out, ALL), Quiet(), ALL, None)
    with mock.patch.object(paper, "STEPS", steps):
        return paper.make_figures(settings, command, only)


@pytest.fixture(scope="module")
def small() -> Experiment:
    """The embedded sky at the resolution of the real maps, so that programs serve both."""
    return load(DEFAULTS / "paper.toml", ["sky.embedded.nside=64", "paper.fwhm=80.0"])


@pytest.fixture(scope="module")
def made(small, tmp_path_factory) -> tuple[Path, dict[str, PaperFigure]]:
    out = tmp_path_factory.mktemp("paper") / "embedded"
    return out, {item.label: item for item in make_figures(small, out, LABELS)}


@pytest.fixture(scope="module")
def real(data_dir, tmp_path_factory) -> Experiment:
    folder = tmp_path_factory.mktemp("paper")
    nu = np.geomspace(0.4, 40, 300)
    # 2.7 below 5 GHz, 2.83 above: steeper by the paper's 0.13.
    temperature = np.where(nu < 5, (nu / 5) ** -2.7, (nu / 5) ** -2.83)
    np.savetxt(folder / "spectrum.txt", np.stack([nu, temperature], axis=1))
    # Templates of other names than their laws.
    text = EXAMPLE.read_text().replace("[sky.", "[sky.sky_")
    for key in ("angles = ", "components = ["):
        text = text.replace(f'{key}"dust"', f'{key}"sky_dust"')
    text = text.replace('"synchrotron"]', '"sky_synchrotron"]')
    (folder / "paper.toml").write_text(text)
    values = [f'data_dir = "{data_dir.resolve()}"', "free = {}", "fixed = {}", "paper.fwhm = 80.0"]
    steepening = f"paper.beta_syn.steepening = '{folder / 'spectrum.txt'}'"
    return load(folder / "paper.toml", [*values, steepening])


def numbers_of(items: dict[str, PaperFigure]) -> dict[str, Number]:
    return {number.what: number for item in items.values() for number in item.numbers}


def value(number: Number) -> float:
    return float(number.ours.split(" ")[0])


def check_items(out: Path, items: dict[str, PaperFigure]) -> None:
    assert list(items) == [*LABELS, NUMBERS]
    for item in items.values():
        assert item.section.caption
        assert item.section.note
        picture = item.section.picture
        assert item.section.table or (out / picture).read_bytes().startswith(b"\x89PNG")
    rows = items[NUMBERS].section.table.rows
    assert [row[0] for row in rows] == [n.what for i in items.values() for n in i.numbers]
    assert len(items["Table 1"].section.table.header) == 16
    assert items["Table 1"].section.table.rows[0][1:4] == ("23.3", "14.0", "10.0")


def check_slopes(settings: Experiment, items: dict[str, PaperFigure]) -> None:
    """Against healpy's transform of the templates."""
    sources, numbers = PaperSky(settings), numbers_of(items)
    for name in ("dust", "synchrotron"):
        layer = sources.template(name)
        lmax = 2 * layer.nside
        full = [np.zeros(layer.maps.shape[-1]), *np.asarray(layer.maps)]
        alms = healpy.map2alm(full, lmax=lmax, iter=10, use_weights=True)[1:]
        for kind, alm in zip(("EE", "BB"), alms, strict=True):
            spectrum = healpy.alm2cl(alm) / np.asarray(gaussian_beam(layer.fwhm, lmax)) ** 2
            law = fit_power_law(jax.numpy.asarray(spectrum), *getattr(layer.small_scales, kind))
            shown = value(numbers[f"slope of {name} {kind}"])
            assert shown == pytest.approx(float(law.slope), abs=0.01)


def check_correlations(settings: Experiment, items: dict[str, PaperFigure]) -> None:
    (ame, dust, *_), numbers = PaperSky(settings).ame(), numbers_of(items)
    for i, stokes in enumerate("QU"):
        r = np.corrcoef(np.asarray(ame[i]), np.asarray(dust[i]))[0, 1]
        shown = numbers[f"correlation of dust and AME, {stokes}"]
        assert value(shown) == pytest.approx(r, abs=6e-4)


def test_embedded_sky(small, made):
    out, items = made
    check_items(out, items)
    check_slopes(small, items)
    check_correlations(small, items)
    for label in LABELS:
        known = label in ("Figure 3", "Table 1")  # these show nothing of the model
        assert ("embedded model" in items[label].section.note) != known
    numbers = numbers_of(items)
    assert value(numbers["mean of β_dust"]) == pytest.approx(1.53, abs=1e-3)
    assert value(numbers["mean of β_syn"]) == pytest.approx(2.9, abs=1e-3)
    assert value(numbers["scatter of β_syn"]) == pytest.approx(0.1, abs=1e-3)
    assert numbers["mean of β_syn"].note == "by construction"


@pytest.mark.slow
def test_real_sky(real, data_dir, tmp_path):
    items = {item.label: item for item in make_figures(real, tmp_path, LABELS)}
    check_items(tmp_path, items)
    check_slopes(real, items)
    check_correlations(real, items)
    numbers = numbers_of(items)
    files = {
        "dust": ("pysm2_d1_QU353GHz_betad_Td_n64.fits", "BETA_D", 1, 0.0, 180.0),
        "syn": ("pysm2_s1_QU23GHz_betas_n64.fits", "BETA_S", -1, 0.13, 600.0),
    }
    for name, (file, column, sign, steeper, fwhm) in files.items():
        raw = read_maps(data_dir / "templates" / file, fields=[column], unit="").maps[0]
        beta = healpy.smoothing(sign * np.asarray(raw, float), np.radians(fwhm / 60)) + steeper
        assert value(numbers[f"mean of β_{name}"]) == pytest.approx(beta.mean(), abs=1e-3)
        assert value(numbers[f"scatter of β_{name}"]) == pytest.approx(beta.std(), abs=1e-3)
    assert numbers["steepening of β_syn from 0.49 ... 2.12 to 20 ... 30 GHz"].ours == "0.13"
    assert "with the other sign, made steeper by 0.13" in items["Figure 3"].section.note
    assert "embedded" not in items["Figure 4"].section.note


def test_patch_shows_the_small_scales_of_the_spectra(small):
    """Those that are there already are the ones that `harmonic_sources` makes."""
    sources = PaperSky(small)
    observation = core_observation(sources)
    given = {name: Source(*sources.template(name)) for name in ("dust", "synchrotron")}
    expected = harmonic_sources(sources.key, given, observation)
    found = prepared_templates(sources, observation)
    for name, one in expected.items():
        np.testing.assert_allclose(found[name].alms[0], one.alms[0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found[name].weights, one.weights)
        assert found[name].fwhm == one.fwhm == 0
        assert power_spectrum(one.alms[0])[:, 40:].min() > 0


class Page(html.parser.HTMLParser):
    """What is in a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags, self.links, self.ids, self.headings = set(), [], [], []
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.tags.add(tag)
        self.links += [given[key] for key in ("href", "src") if key in given]
        self.ids += [given["id"]] if "id" in given else []

    def handle_data(self, data):
        if self.lasttag == "h2" and data.strip():
            self.headings.append(data.strip())


def test_page(made):
    out, items = made
    page = Page(out / "index.html")
    assert page.headings[: len(items)] == [item.section.title for item in items.values()]
    assert not page.tags & {"script", "link", "iframe", "object"}
    for link in page.links:
        assert link[1:] in page.ids if link[0] == "#" else (out / link).is_file()
    pictures = [item for item in items.values() if item.section.picture is not None]
    assert len(page.links) == len(items) + 2 * len(pictures)
    assert "not data" in (out / "index.html").read_text()


def drawn(
    made: list[str], stop: type[BaseException] | None = None, stopped: str = "Figure 2"
) -> dict[str, Make]:
    """Two figures that are quickly drawn, one of which may stop."""

    def step(label: str) -> Make:
        def make(sources, picture):
            made.append(label)
            if stop is not None and label == stopped:
                raise stop("it takes a <map>.")
            picture.write_bytes(b"picture")
            section = Section(f"{label}: a & b", "c", picture.name, note="d")
            return PaperFigure(label, section, (Number("x", "1", "2"),))

        return make

    return {label: step(label) for label in ("Figure 1", "Figure 2")}


def test_a_stopped_run_goes_on(small, tmp_path):
    made = []
    with pytest.raises(KeyboardInterrupt):
        make_figures(small, tmp_path, steps=drawn(made, KeyboardInterrupt))
    assert Page(tmp_path / "index.html").headings[0] == "Figure 1: a & b"
    two = drawn(made)
    items = make_figures(small, tmp_path, steps=two)
    assert made == ["Figure 1", "Figure 2", "Figure 2"]
    assert [item.label for item in items] == ["Figure 1", "Figure 2", NUMBERS]
    (tmp_path / picture_of("Figure 1")).unlink()
    make_figures(small, tmp_path, steps=two)
    assert made[3:] == ["Figure 1"]
    make_figures(small, tmp_path, ["2"], overwrite=True, steps=two)
    assert made[4:] == ["Figure 2"]
    kept = json.loads((tmp_path / "figures.json").read_text())
    assert [figure[2][0][0] for figure in kept[1]] == ["x", "x"]


def test_real_figures_are_not_made_again(small, made):
    out, items = made
    before = {path: path.stat().st_mtime_ns for path in out.glob("*.png")}
    assert make_figures(small, out, LABELS) == list(items.values())
    assert {path: path.stat().st_mtime_ns for path in out.glob("*.png")} == before


def test_a_figure_that_cannot_be_made_is_said_and_left_out(small, tmp_path):
    made = []
    steps = drawn(made, Impossible, "Figure 1")
    items = make_figures(small, tmp_path, steps=steps)
    assert items[0].section.note == "Not made: it takes a <map>."
    assert "it takes a &lt;map&gt;." in (tmp_path / "index.html").read_text()
    assert items[1].section.picture == "figure_02.png"
    make_figures(small, tmp_path, steps=steps)
    assert made == ["Figure 1", "Figure 2", "Figure 1"]


def test_figures_of_maps_are_left_out_without_bands(small, tmp_path):
    bare = small.model_copy(update={"bands": []})
    figures = make_figures(bare, tmp_path, ["5", "6", "7", "8", "9", "11", "Table 1"])
    *maps, table = figures
    assert {f.section.note for f in maps} == {
        "Not made: It takes observed maps, but there are no bands."
    }
    assert table.section.table


def test_other_settings_are_refused_or_replaced(small, tmp_path):
    steps = drawn([])
    make_figures(small, tmp_path, steps=steps)
    other = small.model_copy(update={"title": "another sky"})
    with pytest.raises(ValueError, match=r"holds figures of other settings \(title\)"):
        make_figures(other, tmp_path, steps=steps)
    items = make_figures(other, tmp_path, ["1"], overwrite=True, steps=steps)
    assert [item.label for item in items] == ["Figure 1", NUMBERS]
    assert [path.name for path in tmp_path.glob("*.png")] == ["figure_01.png"]
    for damaged in ("{", "{}", '[{}, [{"label": "Figure 1"}]]'):
        (tmp_path / "figures.json").write_text(damaged)
        raises(ValueError, "is damaged", make_figures, other, tmp_path, steps=steps)
    make_figures(other, tmp_path, overwrite=True, steps=steps)


def test_what_fails_removes_nothing(small, tmp_path):
    """Of other settings, figures go when the first new one is there, and not before."""
    out, both = tmp_path / "out", ["figure_01.png", "figure_02.png"]
    make_figures(small, out, steps=drawn([]))
    held = (out / "figures.json").read_text()
    other = small.model_copy(update={"title": "another"})
    fails = drawn([], OSError, "Figure 1")
    raises(OSError, "it takes a <map>", make_figures, other, out, steps=fails, overwrite=True)
    assert (out / "figures.json").read_text() == held
    assert sorted(path.name for path in out.glob("*.png")) == both
    items = make_figures(other, out, ["2"], steps=fails, overwrite=True)
    assert [item.label for item in items] == ["Figure 2", NUMBERS]
    assert [path.name for path in out.glob("*.png")] == both[1:]
    # A first run that fails leaves nothing that has to be overwritten.
    raises(OSError, "it takes a <map>", make_figures, small, tmp_path / "new", steps=fails)
    assert not list((tmp_path / "new").iterdir())


def test_labels():
    assert [listed("abc"[:n]) for n in (0, 1, 3)] == ["", "a", "a, b and c"]
    assert labels_of([]) == list(STEPS)
    assert labels_of(["14", "Table  1", "figure 2"]) == ["Figure 2", "Table 1", "Figure 14"]
    assert [label for label in STEPS if label in LABELS] == LABELS


def jaxsky(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    return commands.jaxsky(monkeypatch, "paper", *arguments), capsys.readouterr().err


def test_command_line(monkeypatch, capsys, tmp_path):
    code, said = jaxsky(monkeypatch, capsys, "--out", tmp_path / "out", "--only", "table 1")
    assert code == 0
    assert "index.html" in said
    page = Page(tmp_path / "out" / "index.html")
    assert page.headings[0] == "Table 1: COrE"
    for arguments, sentence in cases("paper/command_line"):
        code, said = jaxsky(monkeypatch, capsys, *arguments, "--out", tmp_path / "out")
        assert code == 2
        assert sentence in said.replace("\n", " ")
        assert "Traceback" not in said
    code, said = jaxsky(monkeypatch, capsys, "--out", __file__)
    assert code == 2
    assert "is not a folder" in said


def test_ame_without_a_map_is_that_of_the_dust(small):
    plain = PaperSky(small).ame()[0]
    raw = small.model_dump(exclude_unset=True)
    raw["sky"]["ame"] = {"law": "ame"}
    raw["common"]["components"] = ["dust", "synchrotron"]
    np.testing.assert_array_equal(PaperSky(Experiment.model_validate(raw)).ame()[0], plain)


def test_settings_that_cannot_work(real):
    raw = real.model_dump()
    raw["sky"]["sky_ame"] |= {"fields": ["I_STOKES", "Q_STOKES"]}
    with pytest.raises(
        ValueError, match=r"sky.sky_ame: fields must name I, not I_STOKES, Q_STOKES"
    ):
        PaperSky(Experiment.model_validate(raw)).ame()
    raw["paper"]["beta_syn"] |= {"steepening": "absent.txt"}
    raises(ValueError, r"absent.txt", PaperSky(Experiment.model_validate(raw)).index, "beta_syn")
    del raw["sky"]["sky_synchrotron"], raw["common"]["components"]
    with pytest.raises(Impossible, match="one template of the law 'synchrotron', but there are 0"):
        PaperSky(Experiment.model_validate(raw)).template("synchrotron")


def test_the_cmb_of_figure_13_is_that_of_the_settings(real, monkeypatch, tmp_path):
    spectra = figures_model.cmb_spectra(real, 100)
    asked = []
    monkeypatch.setattr(figures_model, "prepared_templates", lambda *a: {})
    monkeypatch.setattr(
        figures_model, "cmb_spectra", lambda s, lmax: asked.append(s) or spectra[:, :10]
    )
    raises(ValueError, r"spectra of the CMB end at l = 9", figure_patch, PaperSky(real), tmp_path)
    assert asked == [real]


COMPARED = [f"Figure {n}" for n in range(5, 13)]


@pytest.fixture(scope="module")
def small_maps() -> Experiment:
    values = [
        "sky.embedded.nside=64",
        'bands.0.channels=["44"]',
        'bands.3.channels=["K"]',
        "common={ nside = 32, fwhm = 120.0 }",
        "compare={ nsims = 30, lmax = 60 }",
    ]
    return load(DEFAULTS / "paper.toml", values)


@pytest.fixture(scope="module")
def compared(small_maps, tmp_path_factory):
    out = tmp_path_factory.mktemp("paper") / "out"
    return out, {item.label: item for item in make_figures(small_maps, out, COMPARED)}


@pytest.mark.slow
def test_figures_of_maps(compared):
    out, items = compared
    assert set(COMPARED) <= set(items)
    for label in COMPARED:
        item = items[label]
        assert item.section.caption
        assert item.section.note
        assert (out / item.section.picture).read_bytes().startswith(b"\x89PNG")
    page = (out / "index.html").read_text()
    assert all(items[label].section.picture in page for label in COMPARED)


@pytest.mark.slow
def test_numbers_are_those_of_the_comparison(small_maps, compared):
    found = compare(
        small_maps,
        common_maps(inputs_of(small_maps), small_maps.common.nside, small_maps.common.fwhm),
        region_masks(small_maps, small_maps.compare.regions),
    )
    shown = numbers_of(compared[1])
    for band in ("44", "70", "353", "K"):
        scatter = found.scatters[band, "strip", "QU"]
        assert shown[f"slope, {band}, Q and U"].ours == with_error(scatter.slope, scatter.error)
    leaky = next(s for s in found.spectra if s.band == "70")
    assert f"after {leaky.pte[1]:.2f}" in shown["PTE of BB, 70"].ours


@pytest.mark.slow
def test_indices_agree_with_the_truth(compared):
    shown = numbers_of(compared[1])
    for name, truth in (("dust.beta_dust", 1.53), ("synchrotron.beta_syn", 3.1)):
        number = shown[f"{name}, full, Q and U"]
        best, low, high = map(float, number.ours.split())
        assert number.note == f"truth {truth:g}"
        assert abs(best - truth) < 2 * (high - low)


@pytest.mark.slow
def test_b_modes_are_those_of_the_forecast(small_maps, compared):
    found = forecast(forecast_settings(PaperSky(small_maps)))
    shown = numbers_of(compared[1])
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
    shown = numbers_of(items)
    assert {"slope, V, Q and U", "slope, W, Q and U"} <= set(shown)
    # Planck finds half as much power in B as in E (intermediate results 30).
    assert 0.4 < float(shown["median A of BB / EE"].ours) < 0.65


def test_all_figures_have_a_step():
    figures = [label for label in STEPS if label.startswith("Figure")]
    assert figures == [f"Figure {n}" for n in range(1, 15)]
    assert list(STEPS).index("Table 1") == 13
