"""Pixels over several devices and processes give what one device gives."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pixels
from benchmarks.launched import ended, launch
from jaxsky.mesh import processes
from refusals import raises

SCRIPT = Path(__file__).with_name("processes.py")


def test_on_eight_devices():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    tests = Path(__file__).with_name("forced_devices.py")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
    run = subprocess.run(
        [*command, str(tests)],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout


def test_two_processes_find_what_one_does(tmp_path):
    run = launch(2, tmp_path, [str(SCRIPT), str(tmp_path), "templates", "50"])
    expected = pixels.of_templates(50, lambda maps, fill=None: maps, False)
    assert ended(run) == [0, 0]
    for index in range(2):
        pixels.same(dict(np.load(tmp_path / f"{index}.npz")), expected)


def test_half_an_address_is_refused(monkeypatch):
    def begin(*arguments):
        with processes(*arguments):
            pass

    raises(ValueError, "Argument `number` is missing", begin, "127.0.0.1:1")
    monkeypatch.setenv("JAX_PROCESS_ID", "1")
    raises(ValueError, "Argument `address` is missing", begin)


def test_one_process_is_its_own_mesh():
    with processes() as mesh:
        assert mesh.size == 1
    with pytest.raises(ZeroDivisionError), processes():
        raise ZeroDivisionError
