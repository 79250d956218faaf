"""The sky as a sum of components: observe it in bands, get and set its parameters by name."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxsky.arrays import BandMaps, StokesMaps
from jaxsky.bandpass import Bandpass
from jaxsky.checks import Printed, as_array, check_names, check_type
from jaxsky.components import Component, Moment, check_parameter_of, check_value, declared
from jaxsky.interpolation import Nodes, Plan, band_sed, choose_nodes
from jaxsky.mesh import maps_of, over_pixels, typed
from jaxsky.references import kept_template

#: Bands in order: a list, or what `Instrument.bands` gives.
Bands: TypeAlias = Sequence[Bandpass] | OrderedDict[str, Bandpass]


class Sky(Printed, eqx.Module):
    """A sum of named components on the same pixels.

    `components` are a mapping from names, each the first part of the names of its parameters
    ("dust.beta_dust"), to components whose amplitudes share one shape (stokes, pix); TypeError or
    ValueError if they are not. A `Moment` is that of another component of the sky, else KeyError.

    Examples
    --------
    >>> from jaxsky import Bandpass, Dust, Synchrotron
    >>> maps = jnp.ones((2, 12))
    >>> sky = Sky({"dust": Dust(maps), "synchrotron": Synchrotron(maps)})
    >>> observe(sky, [Bandpass.delta(44.0), Bandpass.top_hat(70.0, 14.0)]).shape
    (2, 2, 12)
    """

    given: dict[str, Component]

    def __init__(self, components: Mapping[str, Component]) -> None:
        form = "a dictionary of components by name"
        check_type("Argument `components`", components, Mapping, form)
        # JAX sorts dictionaries when it flattens them; sorted here, the order is always the same.
        self.given = {name: components[name] for name in sorted(components)}
        if not self.given:
            raise ValueError("Argument `components` must have at least one component.")
        for name, component in self.given.items():
            if not isinstance(name, str) or not name or "." in name:
                raise ValueError(
                    f"A component's name is the first part of dotted names of parameters, so it "
                    f"must be text without dots, not {name!r}."
                )
            check_type(f"Component {name!r}", component, Component, "a jaxsky Component")
            if isinstance(component, Moment):
                self.given[name] = self._checked(name, component).at(None)
        shapes = {name: component.amplitude.shape for name, component in self.given.items()}
        if len(set(shapes.values())) > 1:
            raise ValueError(f"Amplitudes must share one shape (stokes, pix), but have {shapes}.")

    def _checked(self, name: str, moment: Moment) -> Moment:
        """Return a moment; KeyError unless the sky has the component and its parameters."""
        of = self.given.get(moment.of)
        if of is None or isinstance(of, Moment):
            raise KeyError(
                f"Component {name!r} is a moment of {moment.of!r}, which is no component of the "
                "sky that has a law of its own."
            )
        for parameter in moment.parameters:
            check_parameter_of(of, moment.of, parameter)
        return moment

    @property
    def components(self) -> dict[str, Component]:
        """The components by name, moments with the component that they are derivatives of."""
        own = self.given
        if not any(isinstance(one, Moment) for one in own.values()):
            return own
        return {n: c.at(own[c.of]) if isinstance(c, Moment) else c for n, c in own.items()}

    def __getitem__(self, name: str) -> Component:
        return self.components[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.given)

    def summary(self):
        rows = [(name, *row) for name, one in self.given.items() for row in one.summary()[1]]
        return f"Sky of {', '.join(self)}", rows

    @property
    def shape(self) -> tuple[int, int]:
        """(stokes, pix) of the maps."""
        stokes, npix = next(iter(self.given.values())).amplitude.shape
        return stokes, npix


def interpolation_nodes(sky: Sky, bands: Bands, tolerance: float) -> Plan:
    """Choose node counts for each component as `observe` does, for its argument `nodes`."""
    bands = _check_bands(sky, bands)
    return tuple(choose_nodes(c, bands, tolerance) for c in sky.components.values())


def _check_bands(sky: object, bands: Any) -> tuple[Bandpass, ...]:
    check_type("Argument `sky`", sky, Sky, "a Sky")
    # JAX keeps the order of this kind of dictionary; another would lose it under jit, and with it
    # the order of the result.
    if isinstance(bands, OrderedDict):
        bands = tuple(bands.values())
    if isinstance(bands, Bandpass) or not isinstance(bands, Sequence):
        raise TypeError(
            "Argument `bands` must be a list of Bandpass; for one, use observe_band, "
            "for a dictionary list(bands.values())."
        )
    for i, band in enumerate(bands):
        check_type(f"Entry {i} of `bands`", band, Bandpass, "a Bandpass")
    if not bands:
        raise ValueError("Argument `bands` must have at least one band.")
    return tuple(bands)


def emission(
    component: Component,
    bands: tuple[Bandpass, ...],
    nodes: Nodes,
    known: StokesMaps | None = None,
) -> list[StokesMaps]:
    """Return the emission of a component in each band; `known` is its template if computed."""
    rows = component.template if known is None else known
    laws = (band_sed(component, band, nodes) for band in bands)
    # Costly laws are evaluated once for all Stokes parameters, ...
    if nodes and len(nodes.counts) > 1:
        return [rows * law for law in laws]
    # ... cheap ones once per row: XLA fuses each row into one pass over memory.
    return [jnp.stack([row * law for row in rows]) for law in laws]


@partial(jax.jit, static_argnames=("plan", "apart"))
@over_pixels(maps_of(3))
def _observe(sky, bands, kept, *, plan, apart):
    """Return the maps of all components together, or of each separately."""
    emissions = {
        name: emission(component, bands, nodes, kept[name])
        for (name, component), nodes in zip(sky.components.items(), plan, strict=True)
    }
    if apart:
        return {name: jnp.stack(maps) for name, maps in emissions.items()}
    return jnp.stack([sum(maps) for maps in zip(*emissions.values(), strict=True)])


def _kept(sky: Sky) -> dict[str, StokesMaps | None]:
    """Return the templates that need not be computed in each call, by component."""
    return {name: kept_template(component) for name, component in sky.given.items()}


def observe(
    sky: Sky, bands: Bands, *, tolerance: float = 1e-10, nodes: Plan | None = None
) -> BandMaps:
    """Observe the sky through a list of bands, the paper's eq. 8: (band, stokes, pix) [uK_RJ].

    Parameters
    ----------
    sky, bands : the sky, and a list of bands, or those of an instrument, `instrument.bands()`
    tolerance : relative error of the band-averaged laws where parameters are maps; 0 sums
        directly over the bands in every pixel. Inside jit, where the range of the maps is not
        known beforehand, a fixed number of nodes is used; if they do not reach the tolerance as
        the program runs, the direct sum is.
    nodes : from `interpolation_nodes`, instead of a tolerance; not checked again

    Raises
    ------
    TypeError, ValueError
        If `sky` is no Sky, or `bands` is not at least one Bandpass in order.
    """
    sky, bands = typed(sky), _check_bands(sky, bands)
    plan = nodes or interpolation_nodes(sky, bands, tolerance)
    return _observe(sky, bands, _kept(sky), plan=plan, apart=False)


def observe_band(sky: Sky, band: Bandpass, *, tolerance: float = 1e-10) -> StokesMaps:
    """Observe the sky through one band [uK_RJ]; see `observe`."""
    return observe(sky, [band], tolerance=tolerance)[0]


def observe_components(
    sky: Sky, bands: Bands, *, tolerance: float = 1e-10, nodes: Plan | None = None
) -> dict[str, BandMaps]:
    """Observe each component separately [uK_RJ]; see `observe`."""
    sky, bands = typed(sky), _check_bands(sky, bands)
    plan = nodes or interpolation_nodes(sky, bands, tolerance)
    return _observe(sky, bands, _kept(sky), plan=plan, apart=True)


# Parameters by name. A sky is a tree of arrays, and names follow from the tree: the component,
# the field and, for fields that are tuples, the position ("dust.T_dust.1"). A name that ends in
# ".offset" stands for a value added to that parameter, for example to shift a whole map.

OFFSET = ".offset"


def _flatten(sky: Sky) -> tuple[dict[str, Array], "jax.tree_util.PyTreeDef"]:
    paths, structure = jax.tree_util.tree_flatten_with_path(sky)
    name = partial(jax.tree_util.keystr, simple=True, separator=".")
    return {name(path[1:]): leaf for path, leaf in paths}, structure


def parameter_names(sky: Sky) -> tuple[str, ...]:
    """Return the names of all parameters of a sky, including amplitudes."""
    return tuple(_flatten(sky)[0])


def unknown_parameter(name: str, known: Iterable[str]) -> KeyError:
    """Return the error for an unknown parameter name."""
    return KeyError(f"Unknown parameter {name!r}; known parameters are {', '.join(known)}.")


def get_parameters(sky: Sky, names: Iterable[str]) -> dict[str, Array]:
    """Return parameter values by name; KeyError lists the known names if one is unknown."""
    check_names("names", names)
    leaves, _ = _flatten(sky)
    try:
        return {name: leaves[name] for name in names}
    except KeyError as error:
        raise unknown_parameter(error.args[0], leaves) from None


def check_parameter(sky: Sky, target: str, name: str, value: Array) -> None:
    """Raise ValueError if a concrete value, called `name`, is not allowed for a parameter."""
    component, field = target.split(".")[:2]
    check_value(name, value, declared(type(sky[component]), field))


def set_parameters(sky: Sky, params: Mapping[str, ArrayLike]) -> Sky:
    """Return a sky with some parameters replaced, or shifted for names that end in ".offset".

    Values are numbers, or maps with the sky's pixels; for amplitudes maps of the sky's shape, and
    for tables of numbers those of the same shape, (row, column, 1).
    KeyError lists the known names if one is unknown; ValueError refuses values of another shape,
    that are not finite, or outside the range of the parameter.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from jaxsky import Dust
    >>> sky = Sky({"dust": Dust(jnp.ones((2, 12)), beta_dust=1.5)})
    >>> moved = set_parameters(sky, {"dust.beta_dust.offset": 0.25})
    >>> float(moved["dust"].beta_dust)
    1.75
    """
    leaves, structure = _flatten(sky)
    # Values first, then shifts, whatever the order of the dictionary.
    for name, value in sorted(params.items(), key=lambda item: item[0].endswith(OFFSET)):
        target = name.removesuffix(OFFSET)
        if target not in leaves:
            raise unknown_parameter(name, leaves)
        value = as_array(name, value)
        own = leaves[target].shape
        whole = len(own) > 1  # an amplitude or a table
        if value.shape not in ((own,) if whole else ((), sky.shape[1:])):
            wanted = f"shape {own}" if whole else f"a number or of shape {sky.shape[1:]}"
            raise ValueError(f"Parameter {name!r} must be {wanted}, but has shape {value.shape}.")
        leaves[target] = leaves[target] + value if name.endswith(OFFSET) else value
        check_parameter(sky, target, name, leaves[target])
    return jax.tree.unflatten(structure, list(leaves.values()))
