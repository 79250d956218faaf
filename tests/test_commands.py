"""What all commands have in common: steps, the page, versions, completion, and the wheel."""

import io
import itertools
import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from rich.console import Console

from commands import jaxsky
from fits.commands import report as terminal
from fits.commands.report import ResultTable, Section, anchor, write_page
from fits.commands.run import DEFAULTS


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
    table = ResultTable(names, (("/a/path/to/something", *["-1234567.89012"] * 12),))
    terminal.print_tables([table], width=40)
    assert capsys.readouterr().out.count("-1234567.89012") == 12


def test_headings_of_sections_are_bold(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    table = ResultTable(("name", "value"), (("section",), ("beta", "1.53")))
    terminal.print_tables([table], width=40)
    printed = capsys.readouterr().out
    assert "\x1b[1msection" in printed
    assert "\x1b[1mbeta" not in printed


def test_page(tmp_path):
    table = ResultTable(("name", "value"), (("beta", "1.53"), (), ("T", "20")), "A <table>")
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
    assert anchor("Figure 1: a") == "figure-1"


def test_version(monkeypatch, capsys):
    for line in (["--version"], ["fit", "--version"], ["data", "fetch", "--version"]):
        assert jaxsky(monkeypatch, *line) == 0
        assert re.fullmatch(r"jaxsky \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("se", ["separate"]),
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


ROOT = Path(__file__).parents[1]


def test_wheel_imports_from_an_empty_environment(tmp_path):
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    subprocess.run([*build, str(ROOT)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("jaxsky-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    tracked = subprocess.run(
        ["git", "ls-files", "jaxsky", "fits"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in tracked.stdout.split():
        assert (site / name).is_file(), f"{name} is not in the wheel"

    # A new environment without the project's editable install; third-party packages by path.
    environment = tmp_path / "venv"
    venv = [sys.executable, "-m", "venv", "--without-pip", str(environment)]
    subprocess.run(venv, check=True)
    paths = os.pathsep.join([str(site), sysconfig.get_paths()["purelib"]])
    code = (
        "import jaxsky, fits; from fits.commands.run import DEFAULTS;"
        "from jaxsky.observation import load_instrument; from jaxsky.settings import load;"
        f"assert all(p.__file__.startswith({str(site)!r}) for p in (jaxsky, fits));"
        "assert 'fit' in [load(path) and path.stem for path in DEFAULTS.glob('*.toml')];"
        "load_instrument('litebird');"
        "import runpy, sys; sys.argv = ['jaxsky', 'fit', '--version'];"
        "runpy.run_module('jaxsky', run_name='__main__')"
    )
    printed = subprocess.check_output(
        [environment / "bin" / "python", "-c", code],
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": paths, "PATH": os.environ["PATH"], "HOME": str(tmp_path)},
    )
    assert re.fullmatch(r"jaxsky \d+\.\d+\.\d+\n", printed)
