"""Processes that share pixels find what one does, and end when one of them dies."""

import time
from pathlib import Path

import numpy as np
import pytest

import pixels
from benchmarks.launched import ended, launch

SCRIPT = str(Path(pixels.__file__).with_name("processes.py"))


# 3069 pixels are padded for 2 processes.
@pytest.mark.parametrize(("number", "npix"), [(2, 3069), (4, 3072)])
def test_processes_find_what_one_does(number, npix, tmp_path):
    run = launch(number, tmp_path, [SCRIPT, str(tmp_path), "every", str(npix)])
    codes = ended(run, 600.0)
    assert codes == [0] * number, (tmp_path / "0.log").read_text()
    expected = pixels.every(npix, lambda maps, fill=None: maps)
    for index in range(number):
        pixels.same(dict(np.load(tmp_path / f"{index}.npz")), expected)


def begun(folder: Path, number: int) -> None:
    """Wait until all processes exchange sums."""
    last = time.monotonic() + 120
    while len(list(folder.glob("*.begun"))) < number:
        assert time.monotonic() < last
        time.sleep(0.1)
    time.sleep(1)


@pytest.mark.parametrize("lost", [0, 1])
def test_one_that_dies_ends_the_others(lost, tmp_path):
    run = launch(3, tmp_path, [SCRIPT, str(tmp_path), "endless"])
    begun(tmp_path, 3)
    run[lost].kill()
    killed = time.monotonic()
    assert all(ended(run, 30.0))
    assert time.monotonic() - killed < 30
    said = [(tmp_path / f"{index}.log").read_text() for index in range(3) if index != lost]
    assert any("Another of the 3 processes has ended, and number" in text for text in said)


def test_one_that_fails_ends_the_others(tmp_path):
    run = launch(2, tmp_path, [SCRIPT, str(tmp_path), "endless", "failing"])
    begun(tmp_path, 2)
    assert all(ended(run, 30.0))
    assert "FileNotFoundError: map.fits: no such file." in (tmp_path / "1.log").read_text()
