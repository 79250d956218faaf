"""Keys of random numbers: from the seed, the number of a realisation, a kind and a name."""

import zlib

import jax
from jaxtyping import Array

from jaxsky.checks import check_seed

__all__ = ["realisation_key", "stream"]


def realisation_key(seed: int, index: int = 0) -> Array:
    """The key of a sky, from nothing but the seed and its number; number 0 is what is observed.

    Raises
    ------
    TypeError, ValueError
        For a seed or a number that is none, or is below 0 or above 2^32 - 1.
    """
    check_seed("seed", seed)
    check_seed("index", index)
    return jax.random.fold_in(jax.random.key(seed), index)


def stream(key: Array, kind: str, name: str = "") -> Array:
    """The key of one kind of random numbers: the same whatever else is drawn, and in any order."""
    return jax.random.fold_in(key, zlib.crc32(f"{kind} {name}".encode()))
