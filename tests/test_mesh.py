"""Pixels over several devices give what one device gives; `validation` has several processes."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxsky import job
from jaxsky.job import processes
from jaxsky.mesh import distribute, pixel_mesh
from jaxsky.settings import SettingsError


@pytest.mark.parametrize(
    "which",
    [
        "template_likelihoods and explicit-192-False or lie_where or refuse or is_seen",
        pytest.param("test", marks=pytest.mark.slow),
    ],
)
def test_on_eight_devices(which):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    tests = Path(__file__).with_name("forced_devices.py")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
    run = subprocess.run(
        [*command, str(tests), "-k", which],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout


def test_half_an_address_is_refused(monkeypatch):
    for known, words in (
        ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES is missing: set all of"),
        ("JAX_PROCESS_ID", "JAX_COORDINATOR_ADDRESS is missing: set all of"),
    ):
        with monkeypatch.context() as environment:
            environment.setenv(known, "1")
            with pytest.raises(ValueError, match=words), processes():
                pass


def test_errors_are_sent_to_other_processes_with_their_words():
    class Local(RuntimeError):
        pass

    found = pickle.loads(pickle.dumps(job._as_sent(Local("No maximum."))))
    assert (type(found), str(found)) == (RuntimeError, "Local: No maximum.")
    found = pickle.loads(pickle.dumps(job._as_sent(SettingsError("bands: there are none."))))
    assert (type(found), str(found)) == (SettingsError, "bands: there are none.")


def test_one_process_does_all_by_itself():
    assert list(job.by_turns(str, [1, 2])) == ["1", "2"]
    with pytest.raises(ZeroDivisionError):
        job.of_first(lambda: 1 / 0)
    maps = np.arange(10.0).reshape(2, 5)
    np.testing.assert_array_equal(job.filled((2, 5), lambda i: maps[i]), maps)
    np.testing.assert_array_equal(job.collected({"a": distribute(maps)}, 4)["a"], maps[:, :4])


def test_one_process_is_its_own_mesh():
    with processes():
        assert pixel_mesh().size == 1
    with pytest.raises(ZeroDivisionError), processes():
        raise ZeroDivisionError
