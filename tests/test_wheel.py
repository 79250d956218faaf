"""The wheel holds both packages and their data, and works where nothing else of the project is."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

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
        "load_instrument('litebird')"
    )
    subprocess.run(
        [environment / "bin" / "python", "-c", code],
        check=True,
        cwd=tmp_path,
        env={"PYTHONPATH": paths, "PATH": os.environ["PATH"], "HOME": str(tmp_path)},
    )
