"""One of several processes that share pixels: `python processes.py FOLDER KIND ...`."""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxsky.job import processes
from jaxsky.mesh import SUMS, distribute, over_pixels, total

KINDS = {}


def kind(function):
    KINDS[function.__name__] = function
    return function


def place(maps, fill=np.nan):
    return distribute(maps, fill=fill)


@kind
def every(folder: Path, npix: str) -> None:
    """Write all that each process finds."""
    import pixels  # which calls JAX

    np.savez(folder / f"{jax.process_index()}.npz", **pixels.every(int(npix), place))


@kind
def endless(folder: Path, failing: str = "") -> None:
    """Add up pixels until another process ends; that may be one that fails by itself."""
    maps = distribute(np.arange(48.0))
    added = jax.jit(over_pixels(SUMS)(lambda maps: total(jnp.sum(maps))))
    (folder / f"{jax.process_index()}.begun").touch()
    if failing and jax.process_index() == 1:
        raise FileNotFoundError("map.fits: no such file.")
    while True:
        added(maps).block_until_ready()
        time.sleep(0.01)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    with processes():
        KINDS[sys.argv[2]](Path(sys.argv[1]), *sys.argv[3:])
