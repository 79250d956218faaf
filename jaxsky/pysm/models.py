"""Models of PySM as components of jaxsky: what PySM calls arguments, and its templates.

Each class takes the arguments of the class of PySM with its name and makes one `Component`, or
several, of them. `MODELS` has all of them by name.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy import units as u

from jaxsky.bandpass import Bandpass
from jaxsky.checks import check_double
from jaxsky.components import Component, component_class, declared
from jaxsky.io.quantities import unit_factor
from jaxsky.public import takes_quantities
from jaxsky.pysm.emission import Part, emission_of
from jaxsky.pysm.files import given_frequency, given_map, read_map
from jaxsky.pysm.units import T_CMB, bandpass, unit_of

#: Classes by the names that PySM has for them.
MODELS: dict[str, type["Model"]] = {}


class Model:
    """Base class of models, with PySM's interface; for models of your own define `get_emission`.

    Parameters
    ----------
    nside : resolution of the maps
    max_nside : highest resolution of the templates; for information
    available_nside : resolutions of templates with "{nside}" in their names; the nearest is read
    map_dist : must be None; jaxsky distributes pixels over devices by itself
    """

    name = ""

    @takes_quantities
    def __init__(
        self,
        nside: int,
        max_nside: int | None = None,
        available_nside: list[int] | None = None,
        map_dist: None = None,
    ) -> None:
        if map_dist is not None:
            raise ValueError("Argument `map_dist` is not supported: maps are not shared by MPI.")
        check_double("jaxsky.pysm")
        self.nside = int(nside)
        self.max_nside = 512 if max_nside is None else max_nside
        self.available_nside = available_nside
        nearest = partial(min, key=lambda n: abs(n - self.nside))
        self.templates_nside = nearest(available_nside) if available_nside else None

    @property
    def parts(self) -> tuple[Part, ...]:
        """The components of jaxsky that this is made of; none for models of users."""
        return ()

    def parts_in(self, band: Bandpass) -> tuple[Part, ...]:
        """Return those of `parts` that a band may see."""
        return self.parts

    @property
    def is_component(self) -> bool:
        """Whether this is made of components of jaxsky."""
        return False

    @property
    def same_parts(self) -> bool:
        """Whether this is made of components of jaxsky, the same in all bands."""
        return self.is_component

    @property
    def only_I(self) -> bool:
        """Whether maps are of I alone, (pix,), as those of the dipole in PySM."""
        return False

    @takes_quantities
    def get_emission(self, freqs: u.Quantity, weights: np.ndarray | None = None) -> u.Quantity:
        """Return I, Q, U [uK_RJ] at a frequency, or over a band with weights in power units."""
        band = bandpass(freqs, weights)
        maps = emission_of(self.parts_in(band), band, 1.0) << unit_of("uK_RJ")
        return maps[0] if self.only_I else maps

    def read_map(
        self,
        path: str,
        unit: str | None = None,
        field: int | list[int] = 0,
        nside: int | None = None,
    ) -> u.Quantity:
        """Read a map in the resolution of the model, or in another; see `files.read_map`."""
        maps, stated = read_map(self._named(path), nside or self.nside, unit, field)
        try:
            return maps << u.Unit(stated)
        except ValueError:
            return maps << unit_of(stated)

    def _named(self, value: Any) -> Any:
        """Return a value; in names of files with the resolution of the templates."""
        if isinstance(value, str | Path) and "{nside}" in str(value):
            return str(value).format(nside=self.templates_nside)
        return value


class LawModel(Model):
    """A model that is a component of jaxsky, made from PySM's arguments.

    Arguments are those of PySM, by name: `map_I`, `map_Q`, `map_U` (or `map_I` with all three),
    names of files (`files.find_template`) or quantities, their units `unit_I`, ..., the frequencies
    `freq_ref_I` and `freq_ref_P`, `has_polarization`, those of `Model`, and the parameters of the
    law in `words`, which may be numbers, names of files, arrays or quantities.

    Raises
    ------
    TypeError, ValueError
        For arguments that are unknown or missing, and as for the `Component`.
    InputError
        For files that are missing or no such maps.
    """

    #: Law of the component, and its parameters by PySM's names.
    law: ClassVar[str] = ""
    words: ClassVar[Mapping[str, str]] = {}
    #: Arguments that may be given by their place, in PySM's order.
    order: ClassVar[tuple[str, ...]] = ("nside",)
    #: Whether another reference frequency only scales the law, and does not change its shape.
    scales: ClassVar[bool] = True
    #: Whether samples of no weight are left out, see `Part`.
    cut: ClassVar[bool] = False

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        MODELS[cls.__name__] = cls

    @takes_quantities
    def __init__(self, *values: Any, **arguments: Any) -> None:
        if len(values) > len(self.order):
            raise TypeError(f"{type(self).__name__} takes {', '.join(self.order)}, others by name.")
        arguments |= dict(zip(self.order, values, strict=False))
        words = ("max_nside", "available_nside", "map_dist")
        nside = self._taken("nside", arguments)
        super().__init__(nside, **{word: arguments.pop(word, None) for word in words})
        self._parts = tuple(Part(one, name, self.cut) for name, one in self._components(arguments))

    @property
    def parts(self) -> tuple[Part, ...]:
        return self._parts

    @property
    def is_component(self) -> bool:
        return True

    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        """Yield the components by name, "" for a single one; all arguments have to be used."""
        amplitude, nu_I, nu_P = self._maps(arguments)
        law = self._law(arguments)
        if nu_I == nu_P:
            yield "", law(amplitude, nu_ref=nu_P)
        elif self.scales:
            yield "", law(amplitude, nu_ref=nu_P, nu_ref_I=nu_I)
        else:
            yield "I", law(amplitude[:1], nu_ref=nu_I)
            yield "QU", law(amplitude[1:], nu_ref=nu_P)

    def _maps(self, arguments: dict[str, Any]) -> tuple[np.ndarray, float, float]:
        """Take I, or I, Q, U [uK_RJ] out of the arguments, with their frequencies [GHz]."""
        polarized = arguments.pop("has_polarization", True)
        nu_I = given_frequency("freq_ref_I", arguments.pop("freq_ref_I", None))
        stated = arguments.pop("freq_ref_P", None)
        nu_P = given_frequency("freq_ref_P", stated) if polarized else nu_I
        together = polarized and arguments.get("map_Q") is None
        maps = []
        for row in "IQU" if polarized and not together else "I":
            unit, values = arguments.pop(f"unit_{row}", None), self._taken(f"map_{row}", arguments)
            nu = nu_I if row == "I" else nu_P
            maps.append(self._amplitude(values, unit, nu, [0, 1, 2] if together else 0))
        for row in "QU":
            arguments.pop(f"map_{row}", None), arguments.pop(f"unit_{row}", None)
        amplitude = np.concatenate([np.atleast_2d(np.asarray(m, np.float64)) for m in maps])
        return amplitude, nu_I, nu_P

    def _amplitude(
        self,
        values: Any,
        unit: str | None,
        nu: float,
        field: int | list[int],
        dtype: type | None = None,
    ) -> np.ndarray:
        """Return maps in uK_RJ at a frequency [GHz], converted in their precision as in PySM."""
        maps, stated = given_map(self._named(values), self.nside, unit, field)
        maps = maps if dtype is None else maps.astype(dtype)
        factor = unit_factor(stated, "uK_RJ", nu, T_cmb=T_CMB)
        return maps if factor == 1 else maps * maps.dtype.type(factor)

    def _law(self, arguments: dict[str, Any]) -> Callable[..., Component]:
        """Return the component as a function of its amplitude, from all arguments that are left."""
        given = {ours: self._parameter(theirs, arguments) for theirs, ours in self.words.items()}
        self._no_more(arguments)
        return partial(component_class(self.law), **self._signed(given))

    def _taken(self, name: str, arguments: dict[str, Any]) -> Any:
        """Take a required argument out of all."""
        if arguments.get(name) is None:
            raise TypeError(f"{type(self).__name__} needs the argument `{name}`.")
        return arguments.pop(name)

    def _no_more(self, arguments: dict[str, Any]) -> None:
        """Raise TypeError if there are arguments that nothing has taken."""
        if arguments:
            unknown = ", ".join(map(repr, arguments))
            raise TypeError(f"{type(self).__name__} has no argument {unknown}.")

    def _signed(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return parameters with the signs of jaxsky in place of PySM's."""
        return given

    def _parameter(self, theirs: str, arguments: dict[str, Any]) -> Any:
        """Take a parameter of the law out of the arguments, in jaxsky's unit."""
        value = self._taken(theirs, arguments)
        unit = declared(component_class(self.law), self.words[theirs])["unit"]
        if unit == "GHz":
            return given_frequency(theirs, value)
        own = arguments.pop(theirs.replace("map_", "unit_"), None)
        values, stated = given_map(self._named(value), self.nside, own if unit else "")
        if unit and stated not in ("", unit):
            values = values * unit_factor(stated, unit)
        return np.asarray(values, np.float64)


class ModifiedBlackBody(LawModel):
    """Thermal dust, one modified black body: `Dust`."""

    law = "dust"
    words: ClassVar = {"map_mbb_index": "beta_dust", "map_mbb_temperature": "T_dust"}
    order: ClassVar = ("map_I", "freq_ref_I", "freq_ref_P", *words, "nside")


class ModifiedBlackBodyLayers(ModifiedBlackBody):
    """A sum of modified black bodies, each with its maps: a `Dust` for each layer.

    Arguments are those of PySM: `map_layers`, `map_mbb_index` and `map_mbb_temperature` are names
    of files with "{layer}", which is 1, 2, ..., or arrays with a layer in each row; `num_layers`,
    `freq_ref`, `color_correction` (a factor on all maps), `unit_layers`.
    """

    order: ClassVar = ("map_layers", "freq_ref", *ModifiedBlackBody.words, "nside")

    def _components(self, arguments):
        nu = given_frequency("freq_ref", arguments.pop("freq_ref", None))
        factor = arguments.pop("color_correction", 1)
        unit = arguments.pop("unit_layers", None)
        layers = self._taken("map_layers", arguments)
        for layer in range(arguments.pop("num_layers", 1)):
            own = {k: _layer(v, layer) for k, v in arguments.items()}
            maps = self._amplitude(_layer(layers, layer), unit, nu, [0, 1, 2], np.float64)
            yield f"{layer + 1}", self._law(own)(maps * factor, nu_ref=nu)


def _layer(value: Any, layer: int) -> Any:
    """Return what belongs to a layer, counted from 0: its file, or a row of an array."""
    if isinstance(value, str | Path):
        return str(value).replace("{layer}", str(layer + 1))
    return value[layer] if np.ndim(value) else value


class PowerLaw(LawModel):
    """A power law, T ~ nu^index: `Synchrotron`, whose index has the other sign."""

    law = "synchrotron"
    words: ClassVar = {"map_pl_index": "beta_syn"}
    order: ClassVar[tuple[str, ...]] = ("map_I", "freq_ref_I", "map_pl_index", "nside")

    def _signed(self, given):
        return given | {"beta_syn": -given["beta_syn"]}


class CurvedPowerLaw(PowerLaw):
    """A power law with curvature, (nu/nu_ref)^(index + curvature ln(nu/nu_curve)): `Synchrotron`.

    The reference frequency is part of its shape: where I has another, it is a component of its own.
    """

    scales = False
    words: ClassVar = PowerLaw.words | {"spectral_curvature": "curvature", "freq_curve": "nu_piv"}
    order: ClassVar = (*PowerLaw.order, "spectral_curvature", "freq_curve")
