"""What ends a command or a script: errors of libraries, Ctrl-C, the end amid a transform."""

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

import commands
from fits import app as cli
from fits.commands.run import ERROR_LOG, results_folder

JAXSKY = Path(sys.executable).with_name("jaxsky")


def run(monkeypatch, capsys, function) -> tuple[int, str]:
    """Exit code and errors of a command line that does this."""
    monkeypatch.setattr(cli, "app", function)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return stop.value.code, capsys.readouterr().err.replace("\n", " ")


def raises(error):
    def fail(out=None):
        raise error

    return fail


def in_folder(out, function):
    def command():
        with results_folder(out, resume=False, overwrite=False):
            function()

    return command


def test_sentences_of_our_own_have_no_traceback(monkeypatch, capsys):
    from jaxsky.bandpass import conversion

    code, said = run(monkeypatch, capsys, lambda: conversion("furlong", "uK_RJ", 30.0))
    assert code == 2
    assert said.startswith("jaxsky: ")
    assert "furlong" in said
    assert "Traceback" not in said
    code, said = run(monkeypatch, capsys, lambda: Path("/no/[bold]/such").read_text())
    assert code == 2
    assert said == "jaxsky: /no/[bold]/such: No such file or directory. "


@pytest.mark.parametrize(
    ("fail", "words"),
    [
        (lambda: np.linalg.inv(np.zeros((2, 2))), "LinAlgError in numpy: Singular matrix."),
        (lambda: np.zeros(3).reshape(2), "ValueError in tests: cannot reshape"),
        (lambda: {}["key"], "KeyError in "),
        (raises(MemoryError()), "There is not enough memory"),
        (raises(RecursionError("deep\nand deeper")), ": deep."),
        (raises(AssertionError()), "AssertionError in "),
        (raises(RuntimeError("[/] [bold] :smile:")), "[/] [bold] :smile:"),
    ],
)
def test_errors_of_libraries_are_sentences(monkeypatch, capsys, tmp_path, fail, words):
    out = tmp_path / "[red]out"
    code, said = run(monkeypatch, capsys, in_folder(out, fail))
    assert code == 2
    assert words in said
    assert said.rstrip().endswith(f"Traceback: {out / ERROR_LOG}")
    assert "Traceback (most recent call last)" in (out / ERROR_LOG).read_text()
    code, said = run(monkeypatch, capsys, fail)
    assert code == 2
    assert words in said
    log = Path(said.split("Traceback: ")[1].strip())
    assert "Traceback (most recent call last)" in log.read_text()
    log.unlink()


def test_a_log_is_that_of_the_last_run(monkeypatch, capsys, tmp_path):
    run(monkeypatch, capsys, in_folder(tmp_path, raises(TypeError("x"))))
    assert (tmp_path / ERROR_LOG).exists()
    with results_folder(tmp_path, resume=False, overwrite=False):
        pass
    assert not (tmp_path / ERROR_LOG).exists()


@pytest.mark.slow
def test_terminals_without_unicode(tmp_path):
    """Tables, and names that an encoding lacks."""
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    run = subprocess.run(
        [JAXSKY, "data", "list", "--dir", tmp_path / "µ☃"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "Kept in" in run.stdout
    assert "Traceback" not in run.stderr


@pytest.mark.slow
def test_a_reader_that_leaves():
    run = subprocess.run(
        f"{JAXSKY} data list | head -n 1", shell=True, capture_output=True, text=True, check=True
    )
    assert run.stderr == ""


STOPPED = """
import gc, os, signal, sys, threading, time
from pathlib import Path
import jax, numpy as np
from fits import app as cli
from fits.commands.run import results_folder

def swallowed():  # by a callback of the garbage collector, as those of JAX
    def callback(phase, info):
        if not threading.main_thread().ident == threading.get_ident() or done:
            return
        done.append(1)
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.01)
    done = []
    gc.callbacks.append(callback)
    gc.collect()
    while True:
        time.sleep(0.01)

def other_error():  # a library makes another error of it
    try:
        signal.raise_signal(signal.SIGINT)
        time.sleep(1)
    except KeyboardInterrupt:
        raise RuntimeError("INTERNAL: KeyboardInterrupt") from None

def caught():  # again and again
    signal.raise_signal(signal.SIGINT)
    while True:
        try:
            time.sleep(0.01)
        except BaseException:
            pass

def computing():  # the main thread waits without a look at signals
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    long = jax.jit(lambda x: jax.lax.fori_loop(0, 10**9, lambda i, x: jax.numpy.sin(x), x))
    long(np.ones(1000)).block_until_ready()

def app():
    with results_folder(Path(sys.argv[2]), resume=False, overwrite=False):
        globals()[sys.argv[1]]()

cli.app = app
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", ["computing", "swallowed", "other_error", "caught"])
def test_ctrl_c_ends_a_command(tmp_path, how):
    began = time.monotonic()
    run = subprocess.run(
        [sys.executable, "-c", STOPPED, how, tmp_path],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert run.returncode == 130
    assert run.stderr == "Stopped; resume with --resume.\n"
    assert time.monotonic() - began < 50


@pytest.mark.parametrize("late", ["write_page", "print_tables", "print_written"])
def test_ctrl_c_says_whether_all_is_written(monkeypatch, capsys, tmp_path, late):
    """Wherever the end of the command is, and although typer makes an exit of it."""

    def interrupted(*_):
        raise KeyboardInterrupt

    place, rest = "run", "all results are written"
    if late == "write_page":
        place, rest = "paper", "resume with --resume"
    options = ("--out", tmp_path, "--only", "table 1")
    with monkeypatch.context() as patched:
        patched.setattr(f"fits.commands.{place}.{late}", interrupted)
        assert commands.jaxsky(patched, "paper", *options) == 130
    said = capsys.readouterr().err
    assert said.endswith(f"\nStopped; {rest}.\n")
    assert "Traceback" not in said
    assert commands.jaxsky(monkeypatch, "paper", *options, "--resume") == 0


def test_ctrl_c_before_there_is_a_folder(monkeypatch, capsys):
    assert run(monkeypatch, capsys, raises(KeyboardInterrupt())) == (130, "Stopped. ")


@pytest.mark.slow
def test_ctrl_c_at_the_end_of_the_interpreter_says_nothing():
    code = (
        "import atexit, signal, sys; atexit.register(signal.raise_signal, signal.SIGINT)\n"
        "from fits import app as cli; sys.argv = ['jaxsky', 'data', 'list', 'wmap9']; cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert "wmap_band" in done.stdout


# Cases are forked from one process that has imported everything and started nothing; each then
# ends as any script does. At nside 32 transforms would be done in time.
ENDING = """
import os, sys, threading, time
from concurrent.futures import ThreadPoolExecutor
import jax, numpy as np
from jaxsky.harmonics import adjoint_synthesis, analysis, smooth, synthesis

NSIDE, LMAX = 256, 400
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", None)
maps = np.random.default_rng(0).normal(size=(2, 12 * NSIDE**2))
alm = np.random.default_rng(0).normal(size=(2, (LMAX + 1) ** 2))
transforms = {{
    "synthesis": (lambda a: synthesis(a, NSIDE), alm),
    "analysis": (lambda m: analysis(m, LMAX), maps),
    "smooth": (lambda m: smooth(m, 60.0), maps),
    "adjoint": (lambda m: adjoint_synthesis(m, LMAX), maps),
}}

def call(name, gradient=False):
    function, x = transforms[name]
    if gradient:
        return jax.grad(lambda x: (function(x) ** 2).sum())(x)
    return function(x)

def forever(name):
    while True:
        call(name)

for number in range({number}):
    if not os.fork():
        break
    _, status = os.wait()
    print(number, os.waitstatus_to_exitcode(status), flush=True)
else:
    sys.exit()
"""


def ends(*cases: str) -> list[int]:
    """Exit codes of scripts that end with these lines."""
    lines = [ENDING.format(number=len(cases))]
    for number, case in enumerate(cases):
        lines += [f"if number == {number}:", textwrap.indent(case, "    ")]
    run = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        capture_output=True,
        text=True,
        timeout=400,
        check=True,
    )
    assert "terminate" not in run.stderr
    return [int(line.split()[1]) for line in run.stdout.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "gradient"),
    [
        ("smooth adjoint", True),
        ("synthesis analysis", True),
        ("synthesis analysis smooth adjoint", False),
    ],
)
def test_a_script_may_end_in_any_transform(names, gradient):
    cases = [f"call({name!r}, {gradient})" for name in names.split()]
    assert ends(*cases) == [0] * len(cases)


@pytest.mark.slow
def test_a_script_may_end_in_any_way():
    cases = {
        "jax.block_until_ready(call('smooth'))": 0,
        "kept = call('smooth')": 0,
        "call('smooth'); sys.exit(3)": 3,
        "call('smooth'); raise ValueError": 1,
        "jax.jit(lambda m: smooth(smooth(m, 60.0), 90.0))(maps)": 0,
        "threading.Thread(target=call, args=('smooth',)).start()": 0,
        "with ThreadPoolExecutor(2) as pool: pool.map(call, ['smooth', 'adjoint'])": 0,
        "threading.Thread(target=time.sleep, args=(600,), daemon=True).start(); call('smooth')": 0,
        "threading.Thread(target=forever, args=('smooth',), daemon=True).start(); time.sleep(2)": 0,
    }
    assert ends(*cases) == list(cases.values())
