"""Realisations by two workers against one, in cold commands: processes start and compile."""

import os
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.table import Row, time_text
from benchmarks.timing import usage
from fits.commands.run import DEFAULTS

#: Fits that take longer than the realisations.
LEFT_OUT = 'patches = "353"', ""
#: Kinds of a run: processors it may use, and its options; workers share the processors' threads.
KINDS = {
    "2 workers, 1 thread each": (2, ["--workers", "2"]),
    "1 worker, 2 threads": (2, ["--workers", "1"]),
    "1 worker, 1 thread": (1, ["--workers", "1"]),
    "no workers, 2 threads": (2, []),
}


def _step(options: list[str], processors: set[int]) -> float:
    """Seconds that `jaxsky compare` takes for its realisations, on some processors."""
    jaxsky, mine = str(Path(sys.executable).with_name("jaxsky")), os.sched_getaffinity(0)
    os.sched_setaffinity(0, processors)  # which a process inherits
    try:
        with tempfile.TemporaryDirectory() as folder:
            file, out = Path(folder) / "experiment.toml", Path(folder) / "results"
            file.write_text((DEFAULTS / "compare.toml").read_text().replace(*LEFT_OUT))
            usage([jaxsky, "compare", str(file), "--out", str(out), *options])
            lines = (out / "log.txt").read_text().splitlines()
    finally:
        os.sched_setaffinity(0, mine)
    begun = {step: float(time) for time, step in (line.split(" s  ") for line in lines)}
    return begun["drawing"] - begun["realisations"]


def workers(quick: bool) -> list[Row]:
    """200 realisations of two bands at nside 64."""
    count, nside = (40, 16) if quick else (200, 64)
    two = sorted(os.sched_getaffinity(0))[:2]
    if len(two) < 2:
        return [Row("realisations by two workers", "", remarks="left out: there is one processor")]
    keys = [f"compare.nsims={count}", f"common.nside={nside}", f"compare.lmax={2 * nside - 1}"]
    keys.append('bands=[{instrument="planck", channels=["44", "70"]}]')
    given = [word for key in keys for word in ("--set", key)]
    rounds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for _ in range(1 if quick else 3):
        for kind, (processors, options) in KINDS.items():
            rounds[kind].append(_step([*given, *options], set(two[:processors])))
    times = {kind: median(each) for kind, each in rounds.items()}
    both, one, *_ = times.values()
    return [
        Row(
            f"`jaxsky compare`, two bands, {count} realisations at nside {nside}, with the start "
            "of workers: 1 worker / 2 workers, 2 processors",
            f"{one / both:.2f}x",
            remarks=", ".join(f"{kind} {time_text(seconds)}" for kind, seconds in times.items()),
        )
    ]
