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
from jaxsky.references import template
from jaxsky.sky import emission

#: Relative error of band averages where parameters are maps.
TOLERANCE = 1e-10


class Part:
    """A component, and what is needed of it to compute its emission many times.

    `ready` has all its maps at one reference frequency, and `ends` is the law at the ends of the
    ranges of its maps, which is enough to choose how it is averaged over a band. `name` tells the
    parts of a model apart; with `cut` it is averaged without samples of no weight (`above_cut`).
    """

    def __init__(self, component: Component, name: str = "", cut: bool = False) -> None:
        self.component, self.name, self.cut = component, name, cut

    @cached_property
    def ready(self) -> Component:
        if self.component.nu_ref_I is None:
            return self.component
        amplitude = template(self.component)
        return dataclasses.replace(self.component, amplitude=amplitude, nu_ref_I=None)

    @cached_property
    def ends(self) -> Component:
        stokes, npix = self.ready.amplitude.shape

        def ends(leaf: Any) -> Any:
            return np.array([leaf.min(), leaf.max()]) if leaf.shape == (npix,) else leaf

        return eqx.tree_at(
            lambda one: one.amplitude, jax.tree.map(ends, self.ready), np.zeros((stokes, 2))
        )


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
    cut = above_cut(band) if any(part.cut for part in parts) else band
    if cut is not band and not all(part.cut for part in parts):
        own, others = (tuple(p for p in parts if p.cut == which) for which in (True, False))
        return emission_of(own, band, factor) + emission_of(others, band, factor)
    plan: Plan = tuple(choose_nodes(part.ends, (cut,), TOLERANCE) for part in parts)
    maps = _summed(tuple(part.ready for part in parts), cut, jnp.asarray(factor), plan=plan)
    # Nothing else refers to what a program returns, so users may change it in place, as PySM's.
    return np.asarray(_Writable(maps))


def above_cut(band: Bandpass, cut: float = 1e-10) -> Bandpass:
    """Return a band without samples whose weights, once it has the integral 1 [1/GHz], are below.

    As PySM converts units. The band itself is returned where there are none.
    """
    nu, response = np.asarray(band.nu), np.asarray(band.weights)
    kept = response >= cut * np.trapezoid(response, nu)
    return band if nu.size == 1 or kept.all() else Bandpass(nu[kept], response[kept], "power")
