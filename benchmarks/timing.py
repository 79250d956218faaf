"""Measuring: turns, medians and ratios of times, and the peak memory of a command."""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

import jax

# The memory of a process that starts another counts as the other's until it runs its own
# program, so a small interpreter stands between this process and the command.
_BETWEEN = """
import json, os, subprocess, sys, time
start = time.perf_counter()
command = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
_, status, usage = os.wait4(command.pid, 0)
end = time.perf_counter()
print(json.dumps([os.waitstatus_to_exitcode(status), end - start, usage.ru_maxrss]))
"""


class Times:
    """Seconds a call of each function, one number a round."""

    def __init__(self, rounds: Mapping[Any, list[float]]) -> None:
        self.rounds = dict(rounds)

    def __getitem__(self, name: Any) -> float:
        return median(self.rounds[name])

    def ratio(self, name: Any, other: Any) -> float:
        """Median over the rounds of the time of one in units of that of the other."""
        return median(a / b for a, b in zip(self.rounds[name], self.rounds[other], strict=True))


class Usage(NamedTuple):
    """Wall time [s] and peak resident memory [GiB] of a command."""

    seconds: float
    peak: float


def seconds(function: Callable[[], Any]) -> float:
    """Seconds of one call, waiting for what JAX does in the background."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def page_faults(function: Callable[[], Any]) -> int:
    """Pages of memory that the system hands out in one call."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    jax.block_until_ready(function())
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def _turn(function: Callable[[], Any], atleast: float) -> float:
    calls = [seconds(function)]
    while sum(calls) < atleast:
        calls.append(seconds(function))
    return median(calls)


def interleave(
    functions: Mapping[Any, Callable[[], Any]], rounds: int, atleast: float = 0.1
) -> Times:
    """Times of functions that take turns.

    Parameters
    ----------
    functions : by name; each has been called before
    rounds : turns of each
    atleast : seconds a turn goes on; it counts as the median of its calls, so that what the one
        before has left (cold caches, waiting threads) does not count
    """
    times: dict[Any, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            times[name].append(_turn(function, atleast))
    return Times(times)


def usage(command: Sequence[str]) -> Usage:
    """Wall time and peak memory of a command in a process of its own.

    Raises
    ------
    RuntimeError
        If it fails; the message holds what it printed.
    """
    line = [sys.executable, "-c", _BETWEEN, *command]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    code, wall, peak = json.loads(done.stdout)
    if code:
        raise RuntimeError(f"{' '.join(command)} ended with code {code}:\n{done.stderr}")
    unit = 1 if sys.platform == "darwin" else 1024
    return Usage(wall, peak * unit / 2**30)
