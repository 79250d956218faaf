"""Processes that end while transforms run: with their exit code, and nothing on stderr."""

import subprocess
import sys
import textwrap

import pytest

# Cases are forked from one process that has imported everything and started nothing; each then
# ends as any script does. At nside 32 transforms would be done in time.
SCRIPT = """
import os, sys, threading, time
from concurrent.futures import ThreadPoolExecutor
import jax, numpy as np
from jaxsky.harmonics import analysis, rotate, smooth, synthesis

NSIDE, LMAX = 256, 400
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", None)
maps = np.random.default_rng(0).normal(size=(2, 12 * NSIDE**2))
alm = np.random.default_rng(0).normal(size=(2, (LMAX + 1) ** 2))
transforms = {{
    "synthesis": (lambda a: synthesis(a, NSIDE), alm),
    "analysis": (lambda m: analysis(m, LMAX), maps),
    "smooth": (lambda m: smooth(m, 60.0), maps),
    "rotate": (lambda a: rotate(a, "G", "C"), alm),
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
    lines = [SCRIPT.format(number=len(cases))]
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
        ("smooth rotate", True),
        ("synthesis analysis", True),
        ("synthesis analysis smooth rotate", False),
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
        "with ThreadPoolExecutor(2) as pool: pool.map(call, ['smooth', 'rotate'])": 0,
        "threading.Thread(target=time.sleep, args=(600,), daemon=True).start(); call('smooth')": 0,
        "threading.Thread(target=forever, args=('smooth',), daemon=True).start(); time.sleep(2)": 0,
    }
    assert ends(*cases) == list(cases.values())
