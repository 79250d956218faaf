"""Pixels over devices and processes of this machine: bytes, times and memory."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.launched import ended, launch
from benchmarks.table import Row, time_text


def exchanged(quick: bool) -> list[Row]:
    """Bytes that each pass moves, on eight devices that XLA makes of this machine's cores."""
    few, many = (8, 16) if quick else (64, 512)
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    command = [sys.executable, "-m", "benchmarks.pixel_programs", str(few), str(many)]
    environment = os.environ | {"XLA_FLAGS": flags}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found = json.loads(run.stdout.splitlines()[-1])
    remarks = "5 bands, Q and U, 3 regions; results of the sums on one device"
    return [
        Row(
            f"bytes moved in a pass over 8 devices, nside {few} and {many}: {name}",
            f"{small} and {large}",
            "the same",
            small == large,
            remarks,
        )
        for name, (small, large) in found.items()
    ]


def _runs(folder: Path, nside: int, name: str, number: int) -> list[dict[str, Any]]:
    """What each process wrote."""
    arguments = ["-m", "benchmarks.pixel_runs", str(folder), str(nside), name]
    if any(ended(launch(number, folder, arguments), 1800.0)):
        raise RuntimeError((folder / "0.log").read_text())
    paths = [folder / f"{name}-{number}-{index}.json" for index in range(number)]
    return [json.loads(path.read_text()) for path in paths]


def _files(folder: Path, nside: int) -> None:
    arguments = ["-m", "benchmarks.pixel_runs", str(folder), str(nside), "files"]
    subprocess.run([sys.executable, *arguments], check=True)


def times(quick: bool) -> list[Row]:
    """Times with 1, 2 and 4 processes; more of them than cores gain nothing."""
    nside = 16 if quick else 256
    with tempfile.TemporaryDirectory() as folder:
        _files(Path(folder), nside)
        rows = []
        for number in (1, 2, 4):
            found = _runs(Path(folder), nside, "pixels", number)
            slowest = {step: max(one["times"][step] for one in found) for step in found[0]["times"]}
            steps = ", ".join(f"{step} {time_text(slowest[step])}" for step in slowest)
            remarks = f"compilation included, but in the gradient; {os.cpu_count()} cores in all"
            work = f"15 bands in files, noise in each pixel, nside {nside}, shared by {number}"
            rows.append(Row(work, steps, remarks=remarks))
    return rows


def memory(quick: bool) -> list[Row]:
    """Peak memory with two processes in units of that with one, above an empty process."""
    rows = []
    for nside, name, noise in (
        (1024, "uniform", "uniform noise"),
        (512, "pixels", "per-pixel noise"),
    ):
        nside = 16 if quick else nside
        with tempfile.TemporaryDirectory() as folder:
            _files(Path(folder), nside)
            above = {}
            for number in (1, 2):
                empty = max(one["peak"] for one in _runs(Path(folder), nside, "empty", number))
                peak = max(one["peak"] for one in _runs(Path(folder), nside, name, number))
                above[number] = peak - empty
        ratio = above[2] / above[1]
        noise = "uniform noise" if name == "uniform" else "noise in each pixel"
        work = f"15 bands separated, {noise}, nside {nside}: peak memory of each of two processes"
        measured = f"{ratio:.0%} of that of one, {above[2]:.2f} of {above[1]:.2f} GiB"
        rows.append(Row(work, measured, "<= 60 %", ratio <= 0.6, "above an empty process"))
    return rows
