"""What all commands have in common: keys on the command line, steps, and the page."""

import io
import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from commands import jaxsky
from fits.commands import console as terminal
from fits.commands.page import Section, Table, key_of, write_page
from fits.commands.run import DEFAULTS
from jaxsky.settings import SettingsError, load

SETTINGS = """
[common]
nside = 16
[free]
"dust.beta_dust" = { start = 1.5, uniform = [0.5, 2.5] }
[sky.dust]
law = "dust"
file = "dust.fits"
nu_ref = 353.0
[[bands]]
name = "44"
file = "44.fits"
bandpass = { center = 44.1, width = 0.0 }
noise = { rms = 1.0 }
[[bands]]
name = "70"
file = "70.fits"
bandpass = { center = 70.4, width = 0.0 }
noise = { rms = 1.0 }
"""


@pytest.fixture
def path(tmp_path):
    (tmp_path / "a.toml").write_text(SETTINGS)
    return tmp_path / "a.toml"


def test_any_key_can_be_set(path):
    given = load(
        path,
        [
            "seed=3",
            "common.nside=32",
            "fit.regions = ['full']",
            "title=two words",
            "free.'dust.beta_dust'.start=1.6",
            'free."dust.T_dust"={start = 20.0, gaussian = [20.0, 1.0]}',
            "bands.1.fwhm=13.2",
            "bands.0.noise.rms=2",
            "cmb.include=false",
        ],
    )
    assert (given.common.nside, given.seed, given.fit.regions) == (32, 3, ["full"])
    assert given.title == "two words"
    assert given.free["dust.beta_dust"].start == 1.6
    assert given.free["dust.beta_dust"].uniform == (0.5, 2.5)
    assert given.free["dust.T_dust"].gaussian == (20.0, 1.0)
    assert [band.fwhm for band in given.bands] == [None, 13.2]
    assert [band.noise.rms for band in given.bands] == [2.0, 1.0]
    assert given.cmb.include is False


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("common.nside", "--set common.nside: must be KEY=VALUE"),
        ("=3", "--set =3: must be KEY=VALUE"),
        ("common.nsides=32", "common.nsides: unknown key"),
        ("common.nside=33", "common.nside: nside must be a power of two, not 33 (given with"),
        ("common.nside=big", "common.nside: input should be a valid integer, not 'big' (given"),
        ("bands.2.fwhm=3", "--set bands.2.fwhm=3: 2: is not among the 2 entries, 0 to 1"),
        ("bands.44.fwhm=3", "44: is not among the 2 entries"),
        ("common=3", "common: input should be a valid table"),
    ],
)
def test_what_cannot_be_set_is_one_sentence(path, assignment, words):
    with pytest.raises(SettingsError, match=re.escape(words)):
        load(path, [assignment])


def steps(is_terminal: bool, monkeypatch, tmp_path) -> tuple[str, str]:
    """What is printed about steps, and what is in the file."""
    stream = io.StringIO()
    shown = Console(file=stream, force_terminal=is_terminal, width=80, **terminal.PLAIN)
    monkeypatch.setattr(terminal, "console", shown)
    clock = itertools.count(0.0, 70.0)  # moves on whenever it is looked at
    monkeypatch.setattr(terminal.time, "perf_counter", lambda: next(clock))
    with terminal.Steps() as told:
        told.step("reading [maps]")
        told.keep(tmp_path / "log.txt")
        told.step("simulations")
        told.advance(3, 10)
    monkeypatch.undo()
    return stream.getvalue(), (tmp_path / "log.txt").read_text()


def test_steps_in_a_pipe_are_lines(monkeypatch, tmp_path):
    printed, logged = steps(False, monkeypatch, tmp_path)
    lines = printed.splitlines()
    assert lines == logged.splitlines()
    assert [line.split(" s  ")[1] for line in lines] == [
        "reading [maps]",
        "simulations",
        "simulations: 3 of 10",
    ]
    assert "\x1b" not in printed


def test_steps_on_a_terminal_leave_their_times(monkeypatch, tmp_path):
    printed, logged = steps(True, monkeypatch, tmp_path)
    assert "3/10" in printed
    assert re.search(r"reading \[maps\]: \d+\.\d s", printed)
    assert len(logged.splitlines()) == 3


def test_numbers_are_whole_however_narrow_the_terminal(capsys):
    names = ("name", *(f"column{i}" for i in range(12)))
    table = Table(names, (("/a/path/to/something", *["-1234567.89012"] * 12),))
    terminal.print_tables([table], width=40)
    assert capsys.readouterr().out.count("-1234567.89012") == 12


def test_page(tmp_path):
    table = Table(("name", "value"), (("beta", "1.53"), (), ("T", "20")), title="A <table>")
    sections = [
        Section("Results: all", "What & why", table=table, note="Note: read <this>"),
        Section("picture", picture="a b.png"),
    ]
    write_page(tmp_path / "index.html", "A <sky>", ["one", "two"], sections, "Made by x,")
    text = (tmp_path / "index.html").read_text()
    for part in ("A &lt;sky&gt;", "<p>one</p>", "What &amp; why", "<b>Note:</b> read &lt;this&gt;"):
        assert part in text, part
    assert 'href="#results"' in text
    assert 'id="results"' in text
    assert '<td class="n">1.53</td>' in text
    assert 'src="a b.png"' in text
    assert key_of("Figure 1: a") == "figure-1"


def test_version(monkeypatch, capsys):
    printed = subprocess.check_output(
        [sys.executable, "-m", "jaxsky", "fit", "--version"], text=True
    )
    assert re.fullmatch(r"jaxsky \d+\.\d+\.\d+\n", printed)
    for line in (["--version"], ["data", "fetch", "--version"]):
        assert jaxsky(monkeypatch, *line) == 0
        assert capsys.readouterr().out == printed


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        pytest.param("se", ["separate"], marks=pytest.mark.slow),
        ("init pl", ["planck-44-70", "planck-separate"]),
    ],
)
def test_shells_complete_commands_and_experiments(words, completed):
    line = {"_JAXSKY_COMPLETE": "complete_bash", "COMP_WORDS": f"jaxsky {words}"}
    line["COMP_CWORD"] = str(len(words.split()))
    script = Path(sys.executable).with_name("jaxsky")
    printed = subprocess.check_output([script], env=os.environ | line, text=True)
    assert printed.split() == completed


def test_nothing_in_jaxsky_imports_fits_but_main():
    import jaxsky

    folder = Path(jaxsky.__file__).parent
    importing = [
        path.name
        for path in folder.rglob("*.py")
        if re.search(r"^\s*(from|import) fits\b", path.read_text(), re.MULTILINE)
    ]
    assert importing == ["__main__.py"]
    assert list(DEFAULTS.glob("*.toml"))
