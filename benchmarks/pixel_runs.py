"""LiteBIRD's 15 bands in files, and their separation by processes that share the pixels.

`python -m benchmarks.pixel_runs FOLDER NSIDE NAME` is one of these processes: `files` writes the
maps, and the others write times and peak memory as JSON.
"""

import argparse
import json
import resource
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.timing import seconds
from jaxsky.job import processes
from jaxsky.mesh import distribute, pixel_mesh

NAMES = ("files", "empty", "uniform", "pixels")


def _peak() -> float:
    """Peak memory of this process [GiB]."""
    status = Path("/proc/self/status")
    if status.exists():  # where what the system reports begins with that of the parent
        (line,) = (x for x in status.read_text().splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def _files(folder: Path, nside: int) -> None:
    from benchmarks.separation_runs import UNIT, litebird, maps_in_memory
    from jaxsky import write_maps

    names = litebird(nside).bands
    for name, maps in zip(names, maps_in_memory(nside), strict=True):
        write_maps(folder / f"{name}.fits", maps, names=["Q", "U"], unit=UNIT, single=True)


def _separated(folder: Path, nside: int, name: str) -> dict[str, Any]:
    """Fit three numbers to maps, with noise in each pixel or not, and separate the components."""
    from benchmarks.separation_runs import START, UNIT, litebird, white_sky
    from fits.optimize import best_fit
    from fits.posterior import value_and_gradient
    from fits.profile_likelihood import spectral_likelihood
    from fits.separated_maps import component_maps
    from jaxsky import read_maps

    bands, sigma = litebird(nside)
    shape = (len(bands), 2, 12 * nside**2)
    paths = [folder / f"{band}.fits" for band in bands]

    def read(part: slice) -> np.ndarray:
        return np.stack([read_maps(path, pixels=part, missing=[]).filled() for path in paths])

    times: dict[str, float] = {}
    found: dict[str, Any] = {}

    def timed(step: str, function: Any) -> None:
        times[step] = seconds(lambda: found.setdefault(step, function()))

    timed("read", lambda: distribute(read, shape=shape))
    data, noise = found["read"], sigma
    if name == "pixels":

        def levels(part: slice) -> np.ndarray:
            factor = 1 + 0.1 * np.sin(np.arange(part.start, part.stop))
            return np.broadcast_to(sigma[:, None, None] * factor, (*shape[:2], factor.size))

        noise = distribute(levels, shape=shape, fill=np.inf)
    laws = white_sky(1, np.random.default_rng(0))
    timed("likelihood", lambda: spectral_likelihood(laws, bands, data, noise, START, unit=UNIT))
    like = found["likelihood"]
    timed("fit", lambda: best_fit(like))
    theta = like.flat({})
    jax.block_until_ready(value_and_gradient(like, theta))
    timed("gradient", lambda: value_and_gradient(like, theta))
    timed("maps", lambda: component_maps(like, found["fit"].best_fit, data, noise))
    return {"times": times, "best_fit": found["fit"].best_fit, "sigma": found["fit"].sigma}


def main() -> None:
    parser = argparse.ArgumentParser("python -m benchmarks.pixel_runs", description="A process.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("nside", type=int)
    parser.add_argument("name", choices=NAMES)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.name == "files":
        _files(arguments.folder, arguments.nside)
        return
    with processes():
        mesh = pixel_mesh()
        result: dict[str, Any] = {}
        if arguments.name == "empty":
            distribute(np.ones(mesh.size))
        else:
            result = _separated(arguments.folder, arguments.nside, arguments.name)
        result |= {"peak": _peak()}
        out = arguments.folder / f"{arguments.name}-{mesh.size}-{jax.process_index()}.json"
        out.write_text(json.dumps(result))


if __name__ == "__main__":
    main()
