"""Processes on this machine that share pixels, over the loopback address."""

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def launch(
    number: int, folder: Path, arguments: Sequence[str], flags: str = ""
) -> list[subprocess.Popen]:
    """Start Python with arguments as so many processes; what they say is in files of the folder."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    started = []
    for index in range(number):
        own = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(number)}
        own |= {"JAX_PROCESS_ID": str(index), "XLA_FLAGS": flags}
        with (folder / f"{index}.log").open("w") as log:
            command = [sys.executable, *arguments]
            one = subprocess.Popen(command, env=os.environ | own, stdout=log, stderr=log)
        started.append(one)
    return started


def ended(started: list[subprocess.Popen], timeout: float = 300.0) -> list[int]:
    """Wait for the end of processes; their exit codes."""
    try:
        return [process.wait(timeout) for process in started]
    finally:
        for process in started:
            process.kill()
