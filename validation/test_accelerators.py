"""Whole commands with transforms called as on a GPU give the same files, threads and all."""

import subprocess
import sys
from pathlib import Path

import pytest

from refusals import cases

COMMAND = """
import sys
if sys.argv.pop(1) == "callback":
    from jax.interpreters import mlir
    from jaxbind import jaxbind
    from jaxsky.ducc import _lower_callback
    mlir.register_lowering(jaxbind._prim, _lower_callback, platform="cpu")
from fits.app import main
main()
"""


def results(command: str, transforms: str, folder: Path) -> dict[str, bytes]:
    """The results and maps of a small run."""
    keys = [word for key, value in cases("programs/small") for word in ("--set", f"{key}={value}")]
    text = (Path(__file__).parents[1] / f"fits/defaults/{command}.toml").read_text()
    text = text.replace('patches = "353"', "").replace("leakage = 0.02\n", "")
    folder.mkdir()
    (folder / "x.toml").write_text(text)
    line = [sys.executable, "-c", COMMAND, transforms, command, "x.toml", "--out", "out", *keys]
    subprocess.run(line, cwd=folder, check=True, capture_output=True)
    found = (*folder.rglob("*.json"), *folder.rglob("*.fits"))
    return {
        path.name: path.read_bytes()
        for path in found
        if path.name not in ("log.json", "simulation.json")  # times
    }


@pytest.mark.parametrize("command", ["simulate", "fit", "compare", "separate", "forecast"])
def test_commands_give_the_same_through_a_callback(command, tmp_path):
    direct, found = (results(command, how, tmp_path / how) for how in ("direct", "callback"))
    assert direct
    assert found == direct
