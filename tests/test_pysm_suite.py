"""PySM's own tests with the drop-in in its place, where $PYSM_SOURCE names a checkout of PySM."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

#: Tests that need neither official data nor parts of PySM that the drop-in lacks.
FILES = ["test_inmemory_maps.py", "test_smoothing.py", "test_dipole.py"]
#: What fails, and why.
DIFFERENT = {
    "test_car_nosmoothing": "maps are HEALPix maps",
}


@pytest.mark.skipif("PYSM_SOURCE" not in os.environ, reason="$PYSM_SOURCE names no checkout")
def test_pysms_own_tests(tmp_path):
    source = Path(os.environ["PYSM_SOURCE"]) / "tests"
    for file in FILES:  # away from the checkout, whose package would be imported
        shutil.copy(source / file, tmp_path)
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent)])
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "pysm_drop_in", *FILES],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    passed, failed = (
        set(re.findall(rf"^{word} \S+::(\w+)", done.stdout, re.MULTILINE))
        for word in ("PASSED", "FAILED")
    )
    assert failed == set(DIFFERENT), done.stdout
    assert len(passed) >= 11
