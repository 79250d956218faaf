"""Templates whose I has a reference frequency of its own, brought to that of Q and U once.

Where parameters are maps, the law at the reference frequency of I costs as much as the law in a
band, so it is kept for the same arrays and not computed in each call.
"""

import weakref
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsky.arrays import StokesMaps
from jaxsky.components import Component
from jaxsky.mesh import spread


class _Kept(NamedTuple):
    """A map of I, and the arrays that it was computed from."""

    structure: Any
    leaves: tuple[weakref.ref, ...]
    intensity: Array

    def fits(self, structure: Any, leaves: list[Array]) -> bool:
        """Return whether this was computed from the same arrays."""
        return self.structure == structure and all(
            known() is leaf for known, leaf in zip(self.leaves, leaves, strict=True)
        )


#: Maps of I by the address of the amplitude, for as long as this lives.
_KEPT: dict[int, _Kept] = {}


@jax.jit
def _intensity(component: Component) -> StokesMaps:
    return component.template[:1]


# A program of its own: within another one, rows put together are not read in one pass.
@jax.jit
def _joined(intensity: StokesMaps, amplitude: StokesMaps) -> StokesMaps:
    return jnp.concatenate([intensity, amplitude[1:]])


def template(component: Component) -> StokesMaps:
    """Return `Component.template`, (stokes, pix), of a component with `nu_ref_I`, anew."""
    return _joined(_intensity(component), component.amplitude)


def kept_template(component: Component) -> StokesMaps | None:
    """Return `Component.template` of a component with the I that is kept for the same arrays.

    None where it costs nothing, without `nu_ref_I` or maps of parameters, and where it belongs
    into the program: while JAX is tracing, and for distributed maps.
    """
    if component.nu_ref_I is None:
        return None
    leaves, structure = jax.tree.flatten(component)
    plain = all(isinstance(x, jax.Array) and not isinstance(x, jax.core.Tracer) for x in leaves)
    if not plain or not any(x.ndim == 1 for x in leaves) or spread(component.amplitude):
        return None
    key = id(component.amplitude)
    kept = _KEPT.get(key)
    if kept is None:
        weakref.finalize(component.amplitude, _KEPT.pop, key, None)
    with jax.ensure_compile_time_eval():  # also where something else is traced
        if kept is None or not kept.fits(structure, leaves):
            found = _intensity(component)
            kept = _KEPT[key] = _Kept(structure, tuple(map(weakref.ref, leaves)), found)
        return _joined(kept.intensity, component.amplitude)
