"""Realisations of whole commands on workers that are killed, and on clusters that are lost."""

import re
import signal
import subprocess
import sys
import time
from functools import cache

import psutil
import pytest

from jaxsky.workers import Processes, realised
from kills import COMMANDS, content, said_by, start
from realisations import Dying

#: Commands with realisations, how many of them, and the file or folders they are in.
OPTIONS = {
    "simulate": ("--nsims", "200"),
    "compare": ("--set", "compare.nsims=200"),
    "separate": ("--set", "separate.nsims=60", "--set", "separate.sampler=none"),
    "paper": ("--only", "5", "--set", "compare.lmax=24", "--set", "compare.width=6"),
}
assert set(OPTIONS) == set(COMMANDS) - {"fit"}
KILLED = ("simulate", "compare")
#: A busy machine has to end a command in this time [s].
PATIENCE = 60.0


class Cluster:
    """A scheduler of Dask and two workers, each in a process of its own that starts it anew."""

    def __init__(self, folder):
        self.log = (folder / "cluster.txt").open("w")
        port = folder / "scheduler.json"
        place = ["--scheduler-file", str(port), "--no-dashboard"]
        self.scheduler = self.run("dask_scheduler", "--host", "127.0.0.1", "--port", "0", *place)
        each = ["--nthreads", "1", "--nworkers", "2", *place]
        self.nannies = self.run("dask_worker", *each)
        until = time.monotonic() + PATIENCE
        while len(self.workers()) < 2 or not port.exists():
            assert time.monotonic() < until
            time.sleep(0.1)
        self.address = re.search(r"tcp://[\d.:]+", port.read_text())[0]

    def run(self, module, *options):
        line = [sys.executable, "-m", f"distributed.cli.{module}", *options]
        return subprocess.Popen(line, stdout=self.log, stderr=subprocess.STDOUT)

    def workers(self):
        return spawned(self.nannies.pid)

    def end(self):
        for process in (self.nannies, self.scheduler):
            process.terminate()
            process.wait(PATIENCE)
        self.log.close()


@pytest.fixture
def cluster(tmp_path):
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.end()


def spawned(pid):
    """Processes that make realisations for another."""
    children = psutil.Process(pid).children(recursive=True)
    return [one for one in children if "spawn_main" in " ".join(one.cmdline())]


def results(name, out, *options):
    """What a command leaves when it comes to its end."""
    process = start(name, out, *OPTIONS[name], *options)
    assert process.wait(600) == 0, said_by(out).read_text()
    return left(out)


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """What a command leaves that is not disturbed and has no workers, as a function of its name."""
    return cache(lambda name: results(name, tmp_path_factory.mktemp("own") / "out"))


def left(out):
    found = content(out)
    assert not [path for path in found if "/." in f"/{path}"]
    return found


def begun(name, process, out):
    """Wait until some realisations are there, in files or in the log."""
    until = time.monotonic() + PATIENCE
    while len(list(out.glob("sim_*/*"))) < 20 if name == "simulate" else not working(process, out):
        assert process.poll() is None, said_by(out).read_text()
        assert time.monotonic() < until
        time.sleep(0.02)


def working(process, out):
    """Whether realisations of a command without files of its own for them have begun."""
    states = list(out.glob(".partial-*"))
    if states:
        time.sleep(2.0)
    return bool(states)


@pytest.mark.parametrize("name", OPTIONS)
def test_commands_find_the_same_with_any_workers(name, cluster, own, tmp_path):
    expected = own(name)
    for workers in ("1", "2", cluster.address):
        out = tmp_path / re.sub(r"\W", "", workers)
        found = results(name, out, "--workers", workers)
        assert found.keys() == expected.keys()
        assert [path for path in found if found[path] != expected[path]] == []


@pytest.mark.parametrize("name", KILLED)
def test_realisations_of_a_dask_worker_that_dies_are_made_again(name, cluster, own, tmp_path):
    expected = own(name)
    process = start(name, tmp_path / "out", *OPTIONS[name], "--workers", cluster.address)
    begun(name, process, tmp_path / "out")
    for _ in range(2):
        cluster.workers()[0].kill()
        time.sleep(1.0)
    assert process.wait(600) == 0, said_by(tmp_path / "out").read_text()
    assert left(tmp_path / "out") == expected


@pytest.mark.parametrize("name", KILLED)
def test_a_lost_scheduler_is_said_and_the_rest_is_made_later(name, cluster, own, tmp_path):
    out = tmp_path / "out"
    process = start(name, out, *OPTIONS[name], "--workers", cluster.address)
    begun(name, process, out)
    cluster.scheduler.kill()
    assert process.wait(PATIENCE) == 2
    words = "jaxsky: The connection to the scheduler of the workers was lost. What was complete is"
    said = said_by(out).read_text()
    assert said.splitlines()[-1].startswith(words), said
    assert "Traceback" not in said
    assert results(name, out, "--resume") == own(name)


@pytest.mark.parametrize("kills", [1, 2])
def test_a_local_worker_that_dies_is_replaced_once(kills, tmp_path):
    for i in range(kills):
        (tmp_path / f"kill{i}").touch()
    done = []
    with Processes(1) as processes:
        making = realised(Dying(tmp_path, 3), range(8), processes, tmp_path)
        if kills == 1:
            done.extend(making)
            assert done == list(range(8))
        else:
            with pytest.raises(ChildProcessError, match=r"died more than once.* with --resume"):
                done.extend(making)
            assert done == [0, 1, 2]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", KILLED)
def test_local_workers_that_die_again_are_said(name, own, tmp_path):
    out = tmp_path / "out"
    process = start(name, out, *OPTIONS[name], "--workers", "2")
    begun(name, process, out)
    for _ in range(2):
        first = spawned(process.pid)
        first[0].kill()
        psutil.wait_procs(first, PATIENCE)
        while process.poll() is None and len(spawned(process.pid)) < 2:
            time.sleep(0.05)
    assert process.wait(PATIENCE) == 2
    said = said_by(out).read_text()
    assert said.splitlines()[-1].startswith("jaxsky: Workers died more than once"), said
    assert "Traceback" not in said
    assert results(name, out, "--resume", "--workers", "2") == own(name)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("name", KILLED)
def test_no_worker_outlives_its_command(name, how, own, tmp_path):
    out = tmp_path / "out"
    process = start(name, out, *OPTIONS[name], "--workers", "2")
    begun(name, process, out)
    every = psutil.Process(process.pid).children(recursive=True)
    workers = spawned(process.pid)
    assert len(workers) == 2
    for one in workers if how == signal.SIGINT else ():  # as from a terminal
        one.send_signal(how)
    process.send_signal(how)
    process.wait(PATIENCE)
    _, alive = psutil.wait_procs(every, 10.0)
    assert not alive
    if how == signal.SIGINT:
        assert "Stopped; resume with --resume" in said_by(out).read_text()
        assert not [path for path in out.rglob("*") if path.name.startswith(".partial")]
    assert results(name, out, "--resume") == own(name)
