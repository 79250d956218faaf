"""Spectra on part of the sky, and the commands that are made of them.

There is no peer with wheels for these; NaMaster has to be compiled. The times stand for themselves,
with their growth.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.table import Row, time_text
from benchmarks.timing import interleave, seconds, usage
from fits.discs import paper_patches
from fits.patches import fit_patches, prepare_patches
from fits.pseudo_cl import coupling_matrices, pure_coupling_matrices
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import gaussian_beam, smooth


def coupling(quick: bool) -> list[Row]:
    """Mode coupling of spin 2, EE and BB, against the largest multipole."""
    sizes = (63, 127) if quick else (191, 383, 767)
    power = {lmax: 1 / (1 + np.arange(2 * lmax + 1.0)) ** 2 for lmax in sizes}
    calls = {lmax: lambda lmax=lmax: coupling_matrices(power[lmax], lmax) for lmax in sizes}
    times = interleave(calls, 2 if quick else 5)
    last, pure = sizes[-1], sizes[0]
    purified = seconds(lambda: pure_coupling_matrices(power[pure], pure))
    return [
        Row(
            f"MASTER coupling matrices EE-EE and EE-BB, l <= {last}",
            time_text(times[last]),
            "< 5 s",
            times[last] < 5,
            ", ".join(f"{lmax}: {time_text(times[lmax])}" for lmax in sizes)
            + f"; purified, l <= {pure}: {time_text(purified)}",
        )
    ]


def patches(quick: bool) -> list[Row]:
    """48 discs and the field of BICEP2, from maps to A and alpha."""
    nside = 64 if quick else 256
    maps = smooth(embedded_sky(nside).dust[1:], 60.0)
    window = np.asarray(gaussian_beam(60.0, 2 * nside))

    def whole():
        return fit_patches(maps, prepare_patches(paper_patches(nside), window), noise=1e-3).A

    first = seconds(whole)
    again = seconds(whole)
    prepared = prepare_patches(paper_patches(nside), window)
    fit = seconds(lambda: fit_patches(maps, prepared, noise=1e-3).A)
    return [
        Row(
            f"power laws on 49 patches, nside {nside}, from maps to A and alpha",
            time_text(first),
            "< 60 s",
            first < 60,
            f"first call; again {time_text(again)}; with masks prepared {time_text(fit)}",
        )
    ]


def commands(quick: bool) -> list[Row]:
    """The commands on the embedded sky at nside 256, cold processes."""
    jaxsky = str(Path(sys.executable).with_name("jaxsky"))
    if quick:
        run = usage([jaxsky, "paper", "--help"])
        return [Row("`jaxsky paper --help`, cold process", time_text(run.seconds))]
    rows = []
    for command, limit in (("compare", None), ("forecast", None), ("paper", 600)):
        with tempfile.TemporaryDirectory() as folder:
            run = usage([jaxsky, command, "--out", folder])
        rows.append(
            Row(
                f"`jaxsky {command}`, embedded sky, nside 256, cold process",
                f"{time_text(run.seconds)}, {run.peak:.1f} GiB",
                "" if limit is None else f"< {limit} s, 8 GiB",
                None if limit is None else run.seconds < limit and run.peak < 8,
            )
        )
    return rows
