"""Folders of results: locks, what killed processes leave, full disks, folders that vanish."""

import errno
import os
import resource
import shutil
import subprocess
import sys
import threading
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial

import emcee
import filelock
import numpy as np
import pytest

from commands import jaxsky, said
from fits.kept import KeptChain, fingerprint, kept_realisations
from jaxsky.io import InputError, whole, write_maps, write_text
from jaxsky.io.files import ALL, Owner, alone, occupied
from refusals import raises

COMMANDS = ("fit", "compare", "separate", "simulate", "forecast", "paper")


def sentence(capsys):
    printed = said(capsys)
    assert "Traceback" not in printed
    return printed


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@contextmanager
def limited(size):
    """No file may grow beyond a size, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# One command for a folder.


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_command_is_refused(name, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    with occupied(out) as folder:
        for options in ([], ["--overwrite"]):
            assert jaxsky(monkeypatch, name, "--out", out, *options) == 2
            said = sentence(capsys)
            assert f"{out}: is being written to by another command (process {os.getpid()}" in said
            assert f"started {str(folder._owner).split('started ')[1]}" in said
        assert len(names(out)) == 2
    assert not out.exists()


def test_a_lock_ends_with_its_process(tmp_path):
    """Also if it is killed; what it left is removed, and nothing of a living one."""
    out = tmp_path / "deep" / "out"
    code = (
        "import sys, time; from pathlib import Path; from jaxsky.io.files import occupied\n"
        "with occupied(Path(sys.argv[1])): print(flush=True); time.sleep(100)"
    )
    holding = [sys.executable, "-c", code, str(out)]
    with subprocess.Popen(holding, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(ValueError, match=f"process {process.pid}, started 2"), occupied(out):
            pass
        process.kill()
    (out / "sim_00000").mkdir()
    for place in (out, out / "sim_00000"):
        (place / f".partial-{process.pid}-x").touch()
        (place / f".partial-{os.getpid()}-x").touch()  # its number may be ours now
    (out / "kept").touch()
    with occupied(out, range(3)) as folder:
        assert len(names(out)) == 6
        folder.clean()
        assert len(names(out)) == 4
        assert not names(out / "sim_00000")
        with whole(out / "mine"), occupied(out, range(3, 5)) as other:
            (out / f".partial-{os.getpid()}-mine").touch()
            other.clean()
    assert names(out) == ["kept", "mine", "sim_00000"]


def test_parts_share_a_folder(tmp_path):
    with occupied(tmp_path, range(10)), occupied(tmp_path, range(10, 11)) as folder:
        for part in (range(9, 12), range(3, 4), range(10, 11), ALL):
            with pytest.raises(ValueError, match="by another command"), occupied(tmp_path, part):
                pass
        folder.narrow(range(10, 10))
        with occupied(tmp_path, range(10, 11)):
            pass
    assert not names(tmp_path)


def test_one_of_many_gets_a_folder(tmp_path):
    """Started at the same moment, and the lock's own file is removed each time."""
    barrier, got = threading.Barrier(8), []

    def work(_):
        for _ in range(20):
            barrier.wait()
            try:
                with occupied(tmp_path / "out"):
                    got.append(1)
                    barrier.wait()
            except ValueError:
                barrier.wait()
            except FileNotFoundError:  # removed by another at this moment
                barrier.wait()

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(work, range(8)))
    assert 0 < len(got) <= 20
    assert not list(tmp_path.glob("out/*"))


def test_file_systems_without_locks_are_said(tmp_path, monkeypatch, capsys):
    def acquire(self, *arguments, **options):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(filelock.FileLock, "acquire", acquire)
    out = tmp_path / "out"
    with occupied(out) as folder, alone(out):
        folder.clean()
        assert not folder.locked
    assert not out.exists()
    assert jaxsky(monkeypatch, "simulate", tmp_path / "no.toml", "--out", out) == 2
    assert "no.toml: cannot be read" in sentence(capsys)
    assert jaxsky(monkeypatch, "paper", "--out", out, "--only", "99") == 2
    said = sentence(capsys)
    assert f"{out}: this file system has no locks, so see to it" in said
    assert "--only: there is no '99'" in said


def test_names_of_owners_are_read_back():
    owner = Owner(12, 1764344049 * 10**9, 0, 50, "a-node.of.a-cluster")
    assert Owner.named(owner.name) == owner
    assert str(owner).startswith("process 12 on a-node.of.a-cluster, started 2025-11-2")


# Folders that vanish, and disks that are full.


def test_a_removed_folder_is_not_made_again(tmp_path):
    out = tmp_path / "out"
    removed = partial(pytest.raises, FileNotFoundError, match="out: was removed while the command")
    with removed(), occupied(out):
        write_text(out / "a", "a")
        shutil.rmtree(out)
        with removed():
            write_text(out / "a", "a")
        out.mkdir()
        with occupied(out), removed():
            write_text(out / "a", "a")
        # Other errors are those of the folder, too.
        np.savetxt(out / "a" / "b", [1])
    assert not out.exists()
    # Afterwards the process writes again.
    write_text(tmp_path / "a", "a")


def test_what_cannot_be_written_is_one_sentence(tmp_path):
    write_text(tmp_path / "a", "before")
    maps = np.zeros((2, 12 * 16**2))
    written = {
        "a": lambda path: write_text(path, "a" * 5000),
        "b": lambda path: write_maps(path, maps, names=["Q", "U"], unit="uK_RJ"),
    }
    with limited(4096):
        for name, write in written.items():
            with pytest.raises(OSError, match=rf"{name}: cannot be written \(.*\); what was comp"):
                write(tmp_path / name)
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "before"
    for name, write in written.items():
        write(tmp_path / name)
    assert names(tmp_path) == ["a", "b"]
    raises(OSError, r"x: cannot be written \(No such file", write_text, tmp_path / "none" / "x", "")
    with pytest.raises(ZeroDivisionError), whole(tmp_path / "c") as beside:
        beside.write_text(str(1 / 0))
    assert names(tmp_path) == ["a", "b"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_in_place_of_a_folder_is_left_alone(name, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    assert jaxsky(monkeypatch, name, "--out", tmp_path / "file") == 2
    assert "file: is not a folder" in sentence(capsys)
    assert jaxsky(monkeypatch, name, "--out", tmp_path / "file" / "x") == 2
    assert "x: cannot be made (Not a directory); choose another --out" in sentence(capsys)
    assert (tmp_path / "file").read_text() == "mine"


# Chains and realisations.


def ensemble(backend, nsteps):
    """A chain of emcee on a Gaussian, gone on with up to a number of steps."""
    sampler = emcee.EnsembleSampler(
        8, 2, lambda x: -np.sum(x**2, axis=1), vectorize=True, backend=backend
    )
    state = None
    if not sampler.iteration:
        initial = np.random.default_rng(1).normal(size=(8, 2))
        state = emcee.State(initial, random_state=np.random.RandomState(1).get_state())
    sampler.run_mcmc(state, nsteps - sampler.iteration)
    if isinstance(backend, KeptChain):
        backend.flush()
    return sampler.get_chain()


def test_a_chain_goes_on_after_a_full_disk(tmp_path):
    expected = ensemble(None, 400)
    path = tmp_path / "chain.npz"
    backend = KeptChain(path, "mark")
    ensemble(backend, 20)
    backend.every, backend._due = 0, 0
    with limited(30_000), pytest.raises(OSError, match=r"chain.npz: cannot be written \("):
        ensemble(backend, 400)
    assert names(tmp_path) == ["chain.npz"]
    resumed = KeptChain(path, "mark")
    assert 20 <= resumed.iteration < 400
    np.testing.assert_array_equal(ensemble(resumed, 400), expected)
    with np.load(path) as held:
        np.testing.assert_array_equal(held["chain"], expected)
        np.testing.assert_array_equal(held["accepted"], resumed.accepted)


def test_a_step_counts_when_it_is_complete(tmp_path, monkeypatch):
    """A run that is interrupted within a step is resumed from before it."""
    path = tmp_path / "chain.npz"
    backend, keep = KeptChain(path), emcee.backends.Backend.save_step

    def interrupted(self, state, accepted):
        keep(self, state, accepted)
        if self.iteration == 30:
            raise KeyboardInterrupt

    monkeypatch.setattr(emcee.backends.Backend, "save_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ensemble(backend, 40)
    backend.flush()
    monkeypatch.setattr(emcee.backends.Backend, "save_step", keep)
    resumed = KeptChain(path)
    assert resumed.iteration == 29
    np.testing.assert_array_equal(ensemble(resumed, 60), ensemble(None, 60))


def test_damaged_chains_are_refused(tmp_path):
    path = tmp_path / "chain.npz"
    ensemble(KeptChain(path, "mark"), 50)
    content = path.read_bytes()

    def refused():
        held = path.read_bytes()
        with pytest.raises(
            InputError, match=r"npz: is damaged \(.*\); start again with --overwrite"
        ):
            KeptChain(path, "mark")
        assert path.read_bytes() == held

    for size in (0, 1, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        refused()
    middle = len(content) // 2
    path.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    refused()
    with path.open("wb") as file:
        np.savez(file, mark="mark", chain=np.zeros((3, 8, 2)))
    refused()
    path.write_bytes(content)
    raises(InputError, "a chain of other data or settings", KeptChain, path, "another mark")
    assert KeptChain(path, "mark").iteration == 50


def test_realisations_go_on_after_a_full_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("fits.kept.SAVED_EVERY", -1.0)
    path = tmp_path / "simulations.npz"

    def make(key):
        import jax

        return [jax.random.normal(key, (100,)), jax.random.normal(key, ())]

    Pair = namedtuple("Pair", "a b")

    def run(count=12):
        return kept_realisations(make, Pair, count, 3, path, "mark")

    with limited(5000), pytest.raises(OSError, match=r"simulations.npz: cannot be written \("):
        run()
    assert names(tmp_path) == ["simulations.npz"]
    with np.load(path) as held:
        assert 0 < len(held["a"]) < 12
    resumed = run()
    path.unlink()
    for one, other in zip(resumed, run(), strict=True):
        np.testing.assert_array_equal(one, other)
    content = path.read_bytes()
    for size in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        raises(InputError, "npz: is damaged", run)
    with path.open("wb") as file:
        np.savez(file, mark="mark", a=np.zeros((3, 100)), b=np.zeros(2))
    raises(InputError, "npz: is damaged", run)


def test_marks_are_the_same_in_all_processes():
    """What results depend on are arrays; where objects are in memory does not count."""
    arrays = {"a": np.arange(3.0), "b": [True, 1]}
    marks = {fingerprint((arrays, function)) for function in (len, max, fingerprint)}
    assert marks == {fingerprint(arrays)}
    assert fingerprint({"a": np.arange(4.0), "b": [True, 1]}) not in marks
    raises(TypeError, "is neither an array nor a function", fingerprint, [object()])
