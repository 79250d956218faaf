"""The command line from a cold start."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.table import Row, time_text
from benchmarks.timing import usage
from fits.commands.run import DEFAULTS

#: The sample sky, and next to it what makes files in the structure of Planck's.
DATA = Path(os.environ.get("JAXSKY_DATA", Path(__file__).parents[2] / "shared" / "data"))
MAKER = DATA.parent / "official" / "make_files.py"
#: Indices of the sky in these files.
TRUTH = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.1}


def fit(quick: bool) -> list[Row]:
    """`jaxsky fit` without an argument; in a trial only the command's start."""
    jaxsky = str(Path(sys.executable).with_name("jaxsky"))
    arguments = ["--version"] if quick else ["fit"]
    runs = []
    for _ in range(1 if quick else 3):
        with tempfile.TemporaryDirectory() as folder:
            out = [] if quick else ["--out", folder]
            runs.append(usage([jaxsky, *arguments, *out]))
    wall, peak = median(run.seconds for run in runs), median(run.peak for run in runs)
    times = ", ".join(time_text(run.seconds) for run in runs)
    work = f"`{' '.join(['jaxsky', *arguments])}`, cold process"
    return [
        Row(f"{work}: time", time_text(wall), "< 60 s", wall < 60, f"runs {times}"),
        Row(f"{work}: peak memory", f"{peak:.2f} GiB", "< 2 GiB", peak < 2),
    ]


def planck(quick: bool) -> list[Row]:
    """The fit that `jaxsky init planck-44-70` writes, on files in the structure of Planck's."""
    nside = 128 if quick else 1024
    work = f"`jaxsky fit examples/planck_44_70.toml`, nside {nside}, cold process"
    if not MAKER.is_file():
        return [Row(work, "", remarks=f"left out: {MAKER} is not there")]
    jaxsky = str(Path(sys.executable).with_name("jaxsky"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        line = [sys.executable, str(MAKER), name, "--nside", str(nside), "--seed", "1"]
        subprocess.run(line, check=True, capture_output=True)
        (folder / "LFI_RIMO_R3.31.fits").symlink_to(DATA / "bandpass" / "LFI_RIMO_R3.31.fits")
        settings, out = folder / "planck.toml", folder / "results"
        settings.write_text((DEFAULTS / "planck-44-70.toml").read_text())
        run = usage([jaxsky, "fit", str(settings), "--out", str(out)])
        found = json.loads((out / "result.json").read_text())["results"]
    pulls = {
        f"{region}, {parameter}": (fit["best_fit"][parameter] - truth) / error
        for region, choices in found.items()
        for fit in [choices["QU"]["gradient"]]
        for i, parameter in enumerate(fit["free"])
        for truth, error in [(TRUTH[parameter], fit["covariance"][i][i] ** 0.5)]
    }
    words = ", ".join(f"{name} {pull:+.1f}" for name, pull in pulls.items())
    remark = "two regions, Q, U and both, three methods"
    return [
        Row(f"{work}: time", time_text(run.seconds), "<= 60 s", run.seconds <= 60, remark),
        Row(f"{work}: peak memory", f"{run.peak:.2f} GiB", "<= 3 GiB", run.peak <= 3),
        Row(
            f"{work}: largest deviation from the truth, Q and U together",
            f"{max(map(abs, pulls.values())):.1f} sigma",
            "<= 3 sigma",
            max(map(abs, pulls.values())) <= 3,
            words,
        ),
    ]
