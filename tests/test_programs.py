"""Compiled programs that are kept from one process to the next."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jaxsky import programs

#: A process that keeps its programs: transforms with gradients, in one of two orders, and others.
SCRIPT = """
import sys
from pathlib import Path
order, folder, transforms = sys.argv[1:]
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
if order == "other":
    kept = [object() for _ in range(5000)]
    from jaxsky import templates
from jaxsky.harmonics import adjoint_synthesis, analysis, synthesis
from jaxsky.programs import keep_programs
if transforms == "callback":
    from jax.interpreters import mlir
    from jaxbind import jaxbind
    from jaxsky.ducc import _lower_callback
    mlir.register_lowering(jaxbind._prim, _lower_callback, platform="cpu")
keep_programs(Path(folder))
alm = jnp.asarray(np.random.default_rng(1).normal(size=(2, 81)))
def chi2(x):
    return jnp.sum(synthesis(x, 8) ** 2) + jnp.sum(adjoint_synthesis(synthesis(x, 4), 4) ** 3)
def steps():
    yield lambda: jax.grad(chi2)(alm)
    yield lambda: analysis(synthesis(alm, 8), 8)
    yield lambda: jax.jit(lambda x: jnp.linalg.inv(x[:, :2]))(alm)
done = [step() for step in (list(steps()) if order == "one" else list(steps())[::-1])]
for found in done if order == "one" else done[::-1]:
    print(np.asarray(found).tobytes().hex())
"""


def process(folder, order="one", fixed=False, transforms="direct", **environment):
    """What such a process prints, and its warnings."""
    line = [sys.executable, "-W", "always", "-c", SCRIPT, order, str(folder), transforms]
    clean = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    run = subprocess.run(
        ["setarch", "-R", *line] if fixed else line,
        env=clean | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout, run.stderr


def kept(folder):
    return {path.name for path in programs.program_folder(folder).iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("transforms", ["direct", "callback"])
def test_a_second_process_adds_nothing_and_transforms_are_not_kept(tmp_path, transforms):
    """Also where transforms are called as on a GPU."""
    first, _ = process(tmp_path, transforms=transforms)
    names = kept(tmp_path)
    assert any(name.startswith("jit__lambda") for name in names)
    assert not [n for n in names if any(w in n for w in ("synthesis", "analysis"))]
    second, said = process(tmp_path, transforms=transforms)
    assert kept(tmp_path) == names
    assert second == first
    assert "cache" not in said


@pytest.mark.slow
def test_processes_that_import_in_another_order_agree(tmp_path):
    """With the same addresses in both, where a program that holds one would find another object."""
    if shutil.which("setarch") is None or subprocess.run(["setarch", "-R", "true"]).returncode:
        pytest.skip("the randomisation of addresses cannot be turned off here")
    direct, _ = process(tmp_path / "none", JAX_ENABLE_COMPILATION_CACHE="0")
    for order in ("one", "other", "one"):
        found, _ = process(tmp_path / "kept", order, fixed=True)
        assert found == direct, order


@pytest.mark.slow
def test_it_can_be_turned_off_and_put_elsewhere(tmp_path):
    process(tmp_path / "a", JAX_ENABLE_COMPILATION_CACHE="0")
    assert not (tmp_path / "a").exists()
    process(tmp_path / "a", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "b"))
    assert not (tmp_path / "a").exists()
    assert any((tmp_path / "b").iterdir())


@pytest.mark.slow
def test_a_damaged_program_is_made_again(tmp_path):
    first, _ = process(tmp_path)
    for path in programs.program_folder(tmp_path).iterdir():
        path.write_bytes(path.read_bytes()[:20])
    second, _ = process(tmp_path)
    assert second == first


@pytest.mark.slow
def test_a_folder_that_cannot_be_made_is_done_without(tmp_path):
    (tmp_path / "file").write_text("")
    process(tmp_path / "file" / "programs")


def test_entries_appear_whole(tmp_path, monkeypatch):
    cache = programs._Cache(str(tmp_path), max_size=-1)
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        cache.put("x", b"1234")
    assert cache.get("x") is None
    (part,) = tmp_path.iterdir()
    part.unlink()
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    cache.put("x", b"1234")
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    cache.put("x", b"1234")
    assert cache.get("x") == b"1234"


def test_the_oldest_go(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "LARGEST", 250)
    for i in range(6):
        kind = tmp_path / f"kind{i}"
        kind.mkdir()
        (kind / "program").write_bytes(bytes(100))
        for path in (kind / "program", kind):
            os.utime(path, (1000 + i, 1000 + i))
    programs._prune(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kind2", "kind3", "kind4", "kind5"]
    assert [p.parent.name for p in sorted(tmp_path.rglob("program"))] == ["kind4", "kind5"]
