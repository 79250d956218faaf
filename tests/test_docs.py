"""The pages of docs/: their Python runs, and what they name is there."""

import re
import sys
from pathlib import Path

import pytest

import fits
import jaxsky
from jaxsky.settings import Experiment

DOCS = Path(__file__).parent.parent / "docs"
#: Pages whose Python is not run, and why.
NOT_RUN = {"cluster.md": "starts processes, and needs several devices or a scheduler"}
#: Pages that need more than a few seconds.
SLOW = {"python.md", "samplers.md", "start.md"}


def python_of(path):
    """The Python of a page, in order."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text(), re.DOTALL | re.M))


PAGES = {path.relative_to(DOCS).as_posix(): path for path in sorted(DOCS.rglob("*.md"))}
PAGES = {
    name: path
    for name, path in PAGES.items()
    if not name.startswith(("_build", "generated")) and python_of(path)
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if Path(name).name in SLOW else ())
        for name in PAGES
        if name not in NOT_RUN
    ],
)
def test_the_python_of_a_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Classes find their annotations in the module that they say they are of.
    exec(compile(python_of(PAGES[name]), name, "exec"), {"__name__": "__main__"})


def test_pages_are_found():
    assert len(PAGES) >= 8
    assert set(NOT_RUN) <= set(PAGES)


@pytest.fixture(scope="module")
def generated():
    pytest.importorskip("sphinx", reason="of requirements-docs.txt")
    sys.path.insert(0, str(DOCS / "_ext"))
    import generated

    yield generated
    sys.path.remove(str(DOCS / "_ext"))


def test_the_reference_has_all_there_is(generated):
    settings = generated.settings()
    for key in Experiment.model_fields:
        assert f"| `{key}` |" in settings
    for table in ("BandTable", "ComponentTable", "SeparateTable", "NoiseTable"):
        assert f"## {table}\n" in settings
    for package in (jaxsky, fits):
        page = generated.names(package)
        assert all(f"## {name}\n" in page for name in dir(package) if name in package.__all__)
    commands = generated.command_line()
    for command in ("init", "simulate", "fit", "compare", "separate", "forecast", "paper", "data"):
        assert f"## `jaxsky {command}`" in commands
    assert "`--set`" in commands
    assert "| 44 | 44.1 | 10.72 | 27.0 | 240.0 uK_CMB arcmin |" in generated.instruments()
    assert "wmap_band_iqumap_r9_9yr_K_v5.fits" in generated.products()
    assert "| `d1` | `dust` | `beta_dust`, `T_dust` |" in generated.presets()
