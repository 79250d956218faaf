"""Keys of random numbers: from the seed, the number of a realisation, a kind and a name."""

import zlib
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsky.checks import check_seed


def realisation_key(seed: int, index: int = 0) -> Array:
    """The key of a sky, from nothing but the seed and its number; number 0 is what is observed."""
    check_seed("seed", seed)
    check_seed("index", index)
    return jax.random.fold_in(jax.random.key(seed), index)


def stream(key: Array, kind: str, name: str = "") -> Array:
    """The key of one kind of random numbers: the same whatever else is drawn, and in any order."""
    return jax.random.fold_in(key, zlib.crc32(f"{kind} {name}".encode()))


@partial(jax.jit, static_argnames=("shape", "dtype"))
def normal(key: Array, shape: tuple[int, ...], dtype: Any) -> Float[Array, "..."]:
    """Normal numbers, which are the same in any precision, but for rounding."""
    return jax.random.normal(key, shape, jnp.result_type(float)).astype(dtype)


@partial(jax.jit, static_argnames=("stokes", "size", "dtype"))
def stokes_noise(key: Array, stokes: int, size: int, dtype: Any) -> Float[Array, "stokes size"]:
    """White noise of I, or Q and U, or I, Q and U, of which Q and U are the same in both."""
    white = normal(key, (stokes, size), dtype)
    return jnp.roll(white, 1, axis=0) if stokes == 3 else white
