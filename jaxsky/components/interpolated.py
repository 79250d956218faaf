"""A component as maps at several frequencies, linear in frequency between them."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxsky.arrays import StokesMaps
from jaxsky.checks import Parameter, as_array, check_shape, is_concrete
from jaxsky.components.base import Component, parameter, reference, template


class InterpolatedMap(Component, law="interpolated"):
    """One of several maps of an emission: 1 at its own frequency, 0 at those of its neighbours.

    Linear in between, and zero beyond, so that the sum of all (`interpolated_maps`) interpolates
    linearly in antenna temperature, as PySM does between maps of extragalactic sources.

    Parameters
    ----------
    amplitude : map at nu_ref [uK_RJ], shape (stokes, pix)
    nu_below, nu_above : frequencies of the neighbours [GHz], None where there is none: the law is
        then zero on that side
    nu_ref : frequency of the map [GHz]

    Raises
    ------
    TypeError, ValueError
        As for any `Component`, and unless nu_below < nu_ref < nu_above.

    Examples
    --------
    >>> one = InterpolatedMap(jnp.ones((2, 12)), nu_below=100.0, nu_above=200.0, nu_ref=150.0)
    >>> [float(one.sed(nu)) for nu in (90.0, 125.0, 150.0, 160.0)]
    [0.0, 0.5, 1.0, 0.8]
    """

    smooth: ClassVar[bool] = False

    amplitude: StokesMaps = template()
    nu_below: Parameter | None = parameter(
        None, positive=True, symbol=r"\nu_{\rm below}", unit="GHz"
    )
    nu_above: Parameter | None = parameter(
        None, positive=True, symbol=r"\nu_{\rm above}", unit="GHz"
    )
    nu_ref: Parameter = reference(100.0, within=(1e-3, 1e5))

    def __check_init__(self) -> None:
        given = [x for x in (self.nu_below, self.nu_ref, self.nu_above) if x is not None]
        arrays = [as_array("nu_ref", x) for x in given]
        numbers = [float(x) for x in arrays if is_concrete(x) and not x.ndim]
        if len(numbers) == len(arrays) and not np.all(np.diff(numbers) > 0):
            words = ", ".join(f"{number:g}" for number in numbers)
            raise ValueError(
                f"Arguments `nu_below`, `nu_ref`, `nu_above` must increase, but are {words} GHz."
            )

    def sed(self, nu: Any):
        rising = jnp.where(nu < self.nu_ref, 0.0, 1.0)
        falling = jnp.where(nu > self.nu_ref, 0.0, 1.0)
        if self.nu_below is not None:
            rising = (nu - self.nu_below) / (self.nu_ref - self.nu_below)
        if self.nu_above is not None:
            falling = (self.nu_above - nu) / (self.nu_above - self.nu_ref)
        return jnp.maximum(jnp.minimum(rising, falling), 0)


def interpolated_maps(name: str, maps: ArrayLike, nu: ArrayLike) -> dict[str, InterpolatedMap]:
    """Return components that interpolate linearly between maps, to be part of a `Sky`.

    All of them are summed in every band, so give only maps at frequencies that the bands need.

    Parameters
    ----------
    name : beginning of the components' names, which end in their number: "cib0", "cib1", ...
    maps : maps [uK_RJ], shape (frequency, stokes, pix)
    nu : their frequencies [GHz], strictly increasing, shape (frequency,); the emission is zero
        below the first and above the last one

    Raises
    ------
    TypeError, ValueError
        For other shapes, and values that `InterpolatedMap` refuses.

    Examples
    --------
    >>> from jaxsky import Bandpass, Sky, observe_band
    >>> maps = jnp.ones((3, 2, 12)) * jnp.arange(1.0, 4.0)[:, None, None]
    >>> sky = Sky(interpolated_maps("cib", maps, [100.0, 143.0, 217.0]))
    >>> float(observe_band(sky, Bandpass.delta(180.0))[0, 0])
    2.5
    """
    maps, nu = as_array("maps", maps), as_array("nu", nu)
    check_shape("maps", maps, maps.ndim == 3, "have shape (frequency, stokes, pix)")
    check_shape("nu", nu, nu.shape == maps.shape[:1], f"have shape {maps.shape[:1]} as `maps`")
    places: list[Array | None] = [None, *nu, None]
    return {
        f"{name}{i}": InterpolatedMap(one, places[i], places[i + 2], own)
        for i, (one, own) in enumerate(zip(maps, nu, strict=True))
    }
