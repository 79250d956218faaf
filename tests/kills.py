"""Commands that are killed, resumed and killed again, and compared with an undisturbed run."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from refusals import cases
from settings_fuzz import written
from systems import small_experiment

COMMANDS = ("fit", "simulate", "compare", "separate", "paper")
#: Small settings of each command, on the embedded sky: most of a run is to start and compile. They
#: name a folder, as results say which it is.
SETTINGS = {
    name: small_experiment(**given, data_dir=str(Path(__file__).parent))
    for name, given in cases("kills/settings").items()
}
OPTIONS = {"simulate": ("--nsims", "4"), "paper": ("--only", "1", "--only", "table 1")}
#: What says when and how long a run was, and how it was called.
CIRCUMSTANCES = {"date", "seconds", "command"}
#: A command that is interrupted has to stop within this many seconds on a busy machine.
PATIENCE = 30.0


def start(name: str, out: Path, *options: str) -> subprocess.Popen:
    """The command in a process of its own, its words in a file beside the folder."""
    settings = written(out.with_name(f"{name}.toml"), SETTINGS[name])
    code = "from fits.app import main; main()"
    arguments = [name, str(settings), "--out", str(out), *OPTIONS.get(name, ()), *options]
    with said_by(out).open("w") as said:
        return subprocess.Popen(
            [sys.executable, "-c", code, *arguments], stdout=said, stderr=subprocess.STDOUT
        )


def said_by(out: Path) -> Path:
    """What the last command with this folder printed."""
    return out.with_name(f"{out.name}.txt")


def listing(out: Path) -> frozenset:
    """Names and states of all files of a folder, those that are being written among them."""
    found = []
    for folder, _, names in os.walk(out):
        for name in names:
            try:
                state = os.stat(os.path.join(folder, name))
            except FileNotFoundError:
                continue
            found.append((folder, name, state.st_ino, state.st_size))
    return frozenset(found)


def watch(process: subprocess.Popen, out: Path, changes: int, seconds: float) -> int:
    """Wait for changes in a folder, some seconds, or the end; the number of changes seen."""
    seen, before, until = 0, listing(out), time.monotonic() + seconds
    while seen < changes and time.monotonic() < until and process.poll() is None:
        time.sleep(0.001)
        now = listing(out)
        seen, before = seen + (now != before), now
    return seen


def plain(value):
    """JSON without what differs between runs that do the same."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if k not in CIRCUMSTANCES}
    return [plain(entry) for entry in value] if isinstance(value, list) else value


def content(out: Path) -> dict:
    """All that a folder holds, to the bit, but for times."""
    found: dict = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        name = str(path.relative_to(out))
        if path.suffix == ".json":
            found[name] = plain(json.loads(path.read_text()))
            if name == "figures.json":  # label, section, numbers, seconds
                settings, figures = found[name]
                found[name] = settings, [figure[:3] for figure in figures]
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                found[name] = {key: arrays[key].tobytes() for key in arrays}
        elif name == "log.txt":
            continue  # times of steps
        elif path.suffix == ".html":
            found[name] = re.sub(r"in \d+ s", "", path.read_text())
        else:
            found[name] = path.read_bytes()
    return found


class Killing:
    """Kills of a command, chained, against an undisturbed run in an empty folder."""

    def __init__(self, name: str, folder: Path, seed: int = 0, options: tuple = ()) -> None:
        self.name, self.out, self.rng = name, folder / "out", np.random.default_rng(seed)
        self.finished, self.options = 0, options
        began, whole = time.monotonic(), folder / "whole"
        process = start(name, whole)
        self.changes = watch(process, whole, 10**9, 600)
        self.seconds = time.monotonic() - began
        self.check_end(process, whole)
        self.expected = content(whole)

    def check_end(self, process: subprocess.Popen, out: Path) -> None:
        """The command came to its end, and left nothing but results."""
        code, said = process.wait(600), said_by(out).read_text()
        assert code == 0, said
        assert "Traceback" not in said
        hidden = [path for path in out.rglob("*") if path.name.startswith(".")]
        assert not hidden, hidden

    def check_whole(self, process: subprocess.Popen) -> None:
        """The command came to its end with the results of the undisturbed one."""
        self.check_end(process, self.out)
        found = content(self.out)
        assert found.keys() == self.expected.keys()
        differing = [name for name in found if found[name] != self.expected[name]]
        assert not differing, differing
        self.finished += 1

    def stop(self, how: int, changes: int, seconds: float) -> bool:
        """Begin or resume, and stop at a moment; False if the end came before."""
        began, fresh = time.monotonic(), not self.out.exists()
        process = start(self.name, self.out, *self.options, *([] if fresh else ["--resume"]))
        if how == signal.SIGINT:  # when Python is there to hear it
            watch(process, self.out, 1, 600)
        watch(process, self.out, changes, seconds)
        ended = process.poll() is not None
        process.send_signal(how)
        try:
            code = process.wait(PATIENCE)
        finally:
            process.kill()
        if ended or code == 0:
            self.check_whole(process)
            if fresh:  # the machine was busier before
                self.seconds = min(self.seconds, time.monotonic() - began)
            for path in sorted(self.out.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
            self.out.rmdir()
            return False
        said = said_by(self.out).read_text()
        if how == signal.SIGINT:
            assert code == 130, said
            if "Stopped; all results are written" in said:
                found = content(self.out)
                assert {name: found.get(name) for name in self.expected} == self.expected
            else:
                assert "Stopped; resume with --resume" in said
        else:
            assert code == -signal.SIGKILL, said
        return True

    def run(self, kills: int, interrupts: int = 0) -> None:
        """Stop it so many times, half at moments of the clock and half when files change."""
        done = dict.fromkeys((signal.SIGINT, signal.SIGKILL), 0)
        wanted = {signal.SIGINT: interrupts, signal.SIGKILL: kills}
        # One for each part of a run, in any order; later ones where the end came before.
        parts = self.rng.permutation(kills + interrupts)
        for attempt in range(10 * (kills + interrupts)):
            left = [how for how in done for _ in range(wanted[how] - done[how])]
            if not left:
                break
            at = (parts[attempt % len(parts)] + self.rng.random()) / len(parts)
            changes, seconds = 10**9, at * self.seconds
            if attempt % 2:
                changes, seconds = 1 + int(at * self.changes), 600
            how = left[self.rng.integers(len(left))]
            done[how] += self.stop(how, changes, seconds)
        assert done == wanted
        self.check_whole(start(self.name, self.out, "--resume"))
