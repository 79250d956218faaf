"""How many programs JAX compiles for each command: compilation is most of a first run."""

import subprocess
import sys
from pathlib import Path

import pytest

from refusals import cases

#: At most; a change may make them fewer.
PROGRAMS = {"fit": 138, "compare": 149, "separate": 135, "simulate": 48, "forecast": 54}
COUNTED = """
import sys
import jax
programs = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: programs.append(event) if event.endswith("to_mlir_module_duration")
    else None
)
from fits.app import main
try:
    main()
finally:
    print("programs:", len(programs))
"""


@pytest.mark.parametrize("command", PROGRAMS)
def test_programs_do_not_become_more(command, tmp_path):
    keys = [word for key, value in cases("programs/small") for word in ("--set", f"{key}={value}")]
    file = Path(__file__).parents[1] / f"fits/defaults/{command}.toml"
    text = file.read_text().replace('patches = "353"', "").replace("leakage = 0.02\n", "")
    (tmp_path / "x.toml").write_text(text)
    arguments = [command, tmp_path / "x.toml", "--out", tmp_path / "out", *keys]
    done = subprocess.run(
        [sys.executable, "-c", COUNTED, *map(str, arguments)], capture_output=True, text=True
    )
    assert "programs:" in done.stdout, done.stderr
    number = int(done.stdout.rsplit("programs:", 1)[1])
    assert 0 < number <= PROGRAMS[command]
