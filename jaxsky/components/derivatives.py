"""Moments: derivatives of a law in its spectral parameters, as components of their own.

Where parameters vary along the line of sight, in the beam or from pixel to pixel, emission is
A sed(nu, p + delta) = A sed + sum_i (A delta_i) d sed / d p_i + ... (Chluba, Hill & Abitbol 2017,
MNRAS 472, 1195; Vacher et al. 2022, A&A 660, A111). Each derivative is a law of its own, whose
amplitude is a map of A delta_i: linear in the data, however the parameters vary.
"""

import copy
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations_with_replacement
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsky.arrays import StokesMaps
from jaxsky.checks import check_names, check_type
from jaxsky.components.base import Component, declared, template


def _value(law: Component, name: str) -> Any:
    """Return a parameter of a law by name, "T_dust", or "T_dust.1" of a tuple."""
    field, _, place = name.partition(".")
    value = getattr(law, field)
    return value[int(place)] if place else value


def check_parameter_of(law: Component, name: str, parameter: str) -> None:
    """Raise KeyError unless a law, of the component `name`, has a parameter that is an array."""
    leaves = jax.tree_util.tree_flatten_with_path(law)[0]
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    fields = {path: path.split(".")[0] for path in paths}
    known = [
        path
        for path, field in fields.items()
        if field != "amplitude" and "table" not in declared(type(law), field)
    ]
    if parameter not in known:
        raise KeyError(
            f"Component {name!r} has no parameter {parameter!r}; it has {', '.join(known)}."
        )


def _name(kind: type = str) -> Any:
    """Declare a field that is part of the structure, and no parameter."""
    return eqx.field(static=True, converter=kind)


class Moment(Component):
    """A derivative of the law of another component of the same sky; see `moments`.

    The law is d^k sed / d p_1 ... d p_k at the parameters of that component: they are not copied,
    so whatever changes them, such as `set_parameters` or a fit, moves the derivative as well.

    Parameters
    ----------
    amplitude : maps A delta_1 ... delta_k / k!, shape (stokes, pix), with A the amplitude of the
        component and delta the deviations of its parameters; the factor is 1 over the product of
        the factorials of the powers in mixed derivatives, delta_1 delta_2 without any
    of : name of the component
    parameters : names of its parameters, one for each derivative; the same one twice for the second

    Raises
    ------
    TypeError, ValueError : as for any `Component`, and without a parameter
    """

    amplitude: StokesMaps = template()
    of: str = _name()
    parameters: tuple[str, ...] = _name(tuple)
    #: the component, inserted by the sky; nothing else has its parameters
    component: Component | None = eqx.field(default=None, init=False)

    def __check_init__(self) -> None:
        check_names("parameters", self.parameters)
        if not self.parameters:
            raise ValueError("Argument `parameters` must name at least one parameter.")

    def summary(self):
        heading, rows = super().summary()
        slopes = "".join(f" / d {name}" for name in self.parameters)
        return heading, [*rows, ("law", f"{self.of}{slopes}")]

    def at(self, component: Component | None) -> "Moment":
        """Return it with the component whose law is differentiated, or without any."""
        moment = copy.copy(self)  # checked already, and perhaps being traced
        object.__setattr__(moment, "component", component)
        return moment

    def sed(self, nu):
        component = self.component
        if component is None:
            raise ValueError(
                f"A moment of {self.of!r} has no law of its own; make a Sky of both, and take it "
                "from there."
            )

        def law(*shifts: Array) -> Array:
            moved = component
            for name, shift in zip(self.parameters, shifts, strict=True):
                where = partial(_value, name=name)
                moved = eqx.tree_at(where, moved, where(moved) + shift)
            return moved.sed(nu)

        zeros = [jnp.zeros((), _value(component, name).dtype) for name in self.parameters]
        function = law
        for i in range(len(zeros)):
            function = partial(_slope, function, i)
        return function(*zeros)


def _slope(function, i, *values):
    """Return the derivative of a function of several numbers in one of them."""

    def along(value):
        return function(*values[:i], value, *values[i + 1 :])

    return jax.jvp(along, (values[i],), (jnp.ones_like(values[i]),))[1]


def moments(
    components: Mapping[str, Component],
    name: str,
    parameters: Sequence[str],
    order: int = 1,
) -> dict[str, Moment]:
    """Return all derivatives of a component's law up to an order, as further components by name.

    They are called by the component and the parameters ("dust_beta_dust",
    "dust_beta_dust_T_dust"), and have no emission until they are given amplitudes, as by a
    separation, for which only laws count.

    Parameters
    ----------
    components : components by name, or a Sky
    name : that of the component
    parameters : names of its parameters, such as ["beta_dust", "T_dust"]
    order : largest number of derivatives, 1 or more

    Raises
    ------
    KeyError : for unknown components and parameters; tables of numbers are no parameters
    TypeError, ValueError : for a string in place of a list, orders below 1, and components that
        are averaged over bands by themselves

    Examples
    --------
    >>> from jaxsky import Bandpass, Dust, Sky, observe_components, set_parameters
    >>> laws = {"dust": Dust(jnp.ones((2, 12)), 1.5, 20.0)}
    >>> sky = Sky(laws | moments(laws, "dust", ["beta_dust"]))
    >>> sky = set_parameters(sky, {"dust_beta_dust.amplitude": jnp.full((2, 12), 0.01)})
    >>> band = [Bandpass.delta(100.0)]
    >>> emission = observe_components(sky, band)
    >>> bool(jnp.allclose(emission["dust_beta_dust"],
    ...                   0.01 * jnp.log(100 / 353) * emission["dust"]))
    True
    """
    check_names("parameters", parameters)
    check_type("Argument `order`", order, int, "an int")
    if order < 1:
        raise ValueError(f"Argument `order` must be at least 1, but is {order}.")
    if name not in (known := list(components)):
        raise KeyError(f"There is no component {name!r}; components are {', '.join(known)}.")
    component = components[name]
    if type(component).band_average is not Component.band_average:
        raise ValueError(f"Component {name!r} has no law at one frequency, and so no moments.")
    for parameter in parameters:
        check_parameter_of(component, name, parameter)
    nothing = jnp.zeros_like(component.amplitude)
    found = {}
    for count in range(1, order + 1):
        for chosen in combinations_with_replacement(parameters, count):
            label = "_".join((name, *chosen)).replace(".", "_")
            found[label] = Moment(nothing, of=name, parameters=chosen)
    return found
