"""Keys of random numbers, one for each kind of them."""

import zlib

import jax
from jaxtyping import Array

__all__ = ["stream"]


def stream(key: Array, kind: str, name: str = "") -> Array:
    """The key of one kind of random numbers: the same whatever else is drawn, and in any order."""
    return jax.random.fold_in(key, zlib.crc32(f"{kind} {name}".encode()))
