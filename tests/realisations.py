"""Realisations for tests of workers, which import this module; some of them go wrong."""

import os
import signal
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxsky.harmonics import synthesis
from jaxsky.settings import SettingsError
from jaxsky.workers import THREADS


class Pair(NamedTuple):
    maps: np.ndarray
    number: np.ndarray


def drawn(key):
    """Maps of random coefficients, and their sum."""
    maps = synthesis(jax.random.normal(key, (2, 81)), 8)
    return maps, maps.sum()


def surroundings(number):
    """What a worker is like."""
    blocked = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    threads = {os.environ.get(name) for name in THREADS}
    return os.getpid(), jax.numpy.zeros(1).dtype, threads, blocked


class Dying(NamedTuple):
    """Kills its process at one number, so often as there are files to remove."""

    folder: Path
    at: int

    def __call__(self, number):
        for left in self.folder.glob("kill*") if number == self.at else ():
            left.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return number


def mistaken(number):
    raise SettingsError("separate.lmax: is wrong.")


def failing(number):
    return np.ones(3).reshape(2, 2)
