"""Realisations made by workers: processes of this machine, and any executor."""

import logging
import os
import sys
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from distributed import LocalCluster

from fits.commands.run import keep_traceback
from fits.kept import kept_realisations
from jaxsky import workers
from jaxsky.io import files
from jaxsky.settings import SettingsError
from jaxsky.workers import realised, workers_of
from realisations import Pair, drawn, failing, mistaken, surroundings
from refusals import cases, raises, refused


@pytest.fixture(scope="module")
def cluster():
    """The address of a Dask cluster of two processes."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
    ) as cluster:
        yield cluster.scheduler_address


def pairs(path=None, executor=None, count=9, reports=None):
    told = {} if reports is None else {"report": lambda *done: reports.append(done)}
    return kept_realisations(drawn, Pair, count, 3, path, "mark", **told, executor=executor)


def test_results_are_the_same_to_the_bit(two, tmp_path):
    expected, reports = pairs(), []
    for executor in (two, ThreadPoolExecutor(2)):
        found = pairs(tmp_path / f"{type(executor).__name__}.npz", executor, reports=reports)
        assert [array.tobytes() for array in found] == [array.tobytes() for array in expected]
        assert reports == [(done, 9) for done in range(10)]
        reports.clear()
    assert not files.writer  # threads are no workers with names of their own for files
    assert sorted(os.listdir(tmp_path)) == ["Processes.npz", "ThreadPoolExecutor.npz"]


def test_more_realisations_go_on_from_a_file(two, tmp_path):
    path, reports = tmp_path / "kept.npz", []
    pairs(path, two, 4)
    found = pairs(path, two, 9, reports)
    assert reports[0] == (4, 9)
    np.testing.assert_array_equal(found.maps, pairs().maps)


def test_workers_are_like_this_process(two, tmp_path):
    environment = dict(os.environ)
    found = list(realised(surroundings, range(600), two, tmp_path))
    pids, types, threads, blocked = zip(*found, strict=True)
    assert len(set(pids) - {os.getpid()}) == 2
    assert set(types) == {np.dtype("float64")}
    assert set(map(tuple, threads)) == {(str(max(1, workers.processors() // 2)),)}
    assert all(blocked)
    assert os.environ == environment


def test_a_dask_cluster_finds_the_same(cluster, tmp_path):
    notes = []
    with workers_of(cluster, notes.append) as executor:
        found = pairs(tmp_path / "kept.npz", executor)
        with pytest.raises(SettingsError, match=r"^separate.lmax: is wrong.$") as caught:
            list(realised(mistaken, range(3), executor, tmp_path))
        assert workers.raised_in(caught.value) == ("realisations", True)
    assert [array.tobytes() for array in found] == [array.tobytes() for array in pairs()]
    assert not notes
    assert os.listdir(tmp_path) == ["kept.npz"]


def test_a_dask_worker_of_another_version_is_refused(cluster, monkeypatch):
    monkeypatch.setattr(workers.jax, "__version__", "0.0.7")
    words = r"^The worker tcp://.* has jax \d+\..*, but 0.0.7 is needed"
    with refused(words, ValueError), workers_of(cluster):
        pass


def test_errors_of_workers_are_those_of_this_process(two, tmp_path):
    with pytest.raises(SettingsError, match=r"^separate.lmax: is wrong.$") as caught:
        list(realised(mistaken, range(3), two, tmp_path))
    assert workers.raised_in(caught.value) == ("realisations", True)
    with pytest.raises(ValueError, match="cannot reshape") as caught:
        list(realised(failing, range(3), two, tmp_path))
    keep_traceback(caught.value, tmp_path / "error.log")
    assert "in failing" in (tmp_path / "error.log").read_text()


def test_what_cannot_be_sent_is_refused(two, tmp_path):
    words = "Argument `work` cannot be sent to workers"
    raises(TypeError, words, lambda: list(realised(lambda n: n, [1], two, tmp_path)))
    assert not list(tmp_path.iterdir())


def test_workers_of_another_version_are_refused(two, tmp_path, monkeypatch):
    monkeypatch.setattr(workers.jaxsky, "__version__", "0.0.7")
    with pytest.raises(ValueError, match=r"^The worker process \d+ on .* has jaxsky .*, but 0.0.7"):
        list(realised(surroundings, [1], two, tmp_path))


def test_workers_have_to_see_the_folder(tmp_path):
    class Elsewhere(ThreadPoolExecutor):
        def submit(self, task, part):
            task.state = tmp_path / "elsewhere" / "state"
            return super().submit(task, part)

    words = f"^{tmp_path}/elsewhere: process .* does not see this folder"
    with Elsewhere(1) as executor, refused(words, FileNotFoundError):
        list(realised(surroundings, [1], executor, tmp_path))


def test_a_result_that_was_lost_on_its_way_is_not_waited_for(tmp_path, monkeypatch):
    class Losing(Executor):
        _client = SimpleNamespace(status="running", futures={})

        def submit(self, task, part):
            return Future()

    monkeypatch.setattr(workers, "PATIENCE", 0.1)
    words = r"^The connection to the scheduler of the workers was lost\..* with --resume"
    with refused(words, ConnectionError):
        list(realised(surroundings, range(3), Losing(), tmp_path))


@pytest.mark.parametrize(("text", "words"), cases("workers/mistakes"))
def test_what_workers_are_not(text, words, monkeypatch):
    monkeypatch.setattr(workers, "PATIENCE", 0.5)
    with refused(words, (ValueError, OSError)), workers_of(text):
        pass


def test_without_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = r"--workers tcp://x:1: takes Dask, .* pip install 'jaxsky\[dask\]'"
    with refused(words, ValueError), workers_of("tcp://x:1"):
        pass


def test_more_workers_than_processors_are_said(monkeypatch):
    notes = []
    monkeypatch.setattr(workers, "processors", lambda: 2)
    monkeypatch.setattr(workers, "ProcessPoolExecutor", lambda *_: ThreadPoolExecutor())
    with workers_of("3", notes.append) as three, workers_of("2", notes.append) as two:
        assert (three._threads["OMP_NUM_THREADS"], two._threads["OMP_NUM_THREADS"]) == ("1", "1")
    assert notes == ["--workers 3: more than the 2 processors there are."]
