"""The emission of components over a band, computed many times: I, Q, U as arrays of numpy."""

import dataclasses
from collections.abc import Iterable
from functools import cached_property, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxsky.bandpass import Bandpass
from jaxsky.components import Component
from jaxsky.interpolation import Plan, choose_nodes
from jaxsky.sky import emission

#: Relative error of band averages where parameters are maps.
TOLERANCE = 1e-10


class Part:
    """A component, and what is needed of it to compute its emission many times.

    `ready` has all its maps at one reference frequency, and `ends` is the law at the ends of the
    ranges of its maps, which is enough to choose how it is averaged over a band. `name` tells the
    parts of a model apart.
    """

    def __init__(self, component: Component, name: str = "") -> None:
        self.component, self.name = component, name

    @cached_property
    def ready(self) -> Component:
        if self.component.nu_ref_I is None:
            return self.component
        amplitude = _at_one_frequency(self.component)
        return dataclasses.replace(self.component, amplitude=amplitude, nu_ref_I=None)

    @cached_property
    def ends(self) -> Component:
        stokes, npix = self.ready.amplitude.shape

        def ends(leaf: Any) -> Any:
            return np.array([leaf.min(), leaf.max()]) if leaf.shape == (npix,) else leaf

        return eqx.tree_at(
            lambda one: one.amplitude, jax.tree.map(ends, self.ready), np.zeros((stokes, 2))
        )


@jax.jit
def _at_one_frequency(component):
    """Return the amplitude with I brought to the reference frequency of the law."""
    return component.template


@partial(jax.jit, static_argnames="plan")
def _summed(components, band, factor, *, plan):
    """Return I, Q, U of all components together, times a factor, shape (3, pix)."""
    total = 0.0
    for component, nodes in zip(components, plan, strict=True):
        (maps,) = emission(component, (band,), nodes)
        total = total + iqu(maps)
    return factor * total


def iqu(maps: Any) -> Any:
    """Return maps of I, or Q, U, or I, Q, U as I, Q, U, with zeros where there are none."""
    missing = {1: (0, 2), 2: (1, 0), 3: (0, 0)}[len(maps)]
    return jnp.pad(maps, (missing, (0, 0)))


class _Writable:
    """The result of a program as memory that numpy may write to, without a copy."""

    def __init__(self, maps: jax.Array) -> None:
        values = np.asarray(maps)
        self.kept = maps, values
        address, _ = values.__array_interface__["data"]
        self.__array_interface__ = values.__array_interface__ | {"data": (address, False)}


def emission_of(parts: Iterable[Part], band: Bandpass, factor: float) -> np.ndarray:
    """Return the sum of the emission of parts in a band [uK_RJ], times a factor, shape (3, pix)."""
    parts = tuple(parts)
    plan: Plan = tuple(choose_nodes(part.ends, (band,), TOLERANCE) for part in parts)
    maps = _summed(tuple(part.ready for part in parts), band, jnp.asarray(factor), plan=plan)
    # Nothing else refers to what a program returns, so users may change it in place, as PySM's.
    return np.asarray(_Writable(maps))
