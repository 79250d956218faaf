"""Models of PySM of the CMB: maps of it, its dipole, and the Sunyaev-Zeldovich effects."""

from collections.abc import Iterable
from typing import Any, ClassVar, Final

import jax.numpy as jnp
import numpy as np

from jaxsky import sed
from jaxsky.arrays import StokesMaps
from jaxsky.checks import Parameter, check_choice
from jaxsky.cmb import dipole, speed_of_dipole
from jaxsky.components import CMB, Component, parameter, template
from jaxsky.io.quantities import unit_factor
from jaxsky.public import takes_quantities
from jaxsky.pysm.files import given_map
from jaxsky.pysm.models import LawModel
from jaxsky.pysm.units import T_CMB

#: Temperature that PySM has in the thermal effect [K], and with it its values of h and k [cgs].
T_SZ: Final = 2.725
H_SZ, K_SZ = 6.62607004e-27, 1.380622e-16


class SecondOrder(Component):
    """CMB anisotropies with the law of what is of second order: x coth(x/2) - offset, x = h nu/kT.

    Times the law of first order, `sed.cmb_derivative`. The thermal Sunyaev-Zeldovich effect has the
    offset 4 and the amplitude y T; the quadrupole of our motion 0 and T (beta cos theta)^2 / 2
    (Notari & Quartin 2015).

    Parameters
    ----------
    amplitude : maps in thermodynamic temperature [uK_CMB], shape (stokes, pix)
    offset : see above
    T_x, T_cmb : temperatures in x and in the law of first order [K], which PySM has apart
    """

    unit = "uK_CMB"

    amplitude: StokesMaps = template()
    offset: Parameter = parameter(4.0)
    T_x: Parameter = parameter(T_CMB, positive=True, symbol="T_x", unit="K")
    T_cmb: Parameter = parameter(T_CMB, positive=True, symbol=r"T_{\rm CMB}", unit="K")

    def sed(self, nu):
        x = sed.H_OVER_K * nu / self.T_x
        return (x / jnp.tanh(x / 2) - self.offset) * sed.cmb_derivative(nu, self.T_cmb)


class CMBMap(LawModel):
    """A map of the CMB in uK_CMB: `CMB`.

    Arguments: `map_IQU`, or `map_I`, for I, Q, U with `map_Q` and `map_U`.
    """

    law = "cmb"
    cut = True
    order: ClassVar = ("nside", "max_nside", "map_IQU", "map_I", "map_Q", "map_U")

    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        together = arguments.pop("map_IQU", None)
        if together is not None:
            maps = [self._thermodynamic(together, [0, 1, 2])]
        else:
            rows = "IQU" if arguments.get("map_Q") is not None else "I"
            maps = [self._thermodynamic(self._taken(f"map_{row}", arguments)) for row in rows]
        for unused in ("map_I", "map_Q", "map_U"):
            arguments.pop(unused, None)
        self._no_more(arguments)
        yield "", CMB(jnp.asarray(np.concatenate([np.atleast_2d(m) for m in maps])), T_CMB)

    def _thermodynamic(self, values: Any, field: int | list[int] = 0) -> np.ndarray:
        """Return a map in uK_CMB; files are taken to be in this unit, as in PySM."""
        maps, stated = given_map(self._named(values), self.nside, "uK_CMB", field)
        return np.asarray(maps, np.float64) * unit_factor(stated, "uK_CMB")


class WebSkyCMB(CMBMap):
    """The CMB of WebSky. Arguments: `websky_version`, `seed`, `lensed`, `include_solar_dipole`."""

    def _components(self, arguments):
        version, seed = arguments.pop("websky_version", 0.4), arguments.pop("seed", 1)
        lensed = "" if arguments.pop("lensed", True) else "un"
        dipole = "solardipole_" if arguments.pop("include_solar_dipole", False) else ""
        nside = 512 if self.nside <= 512 else 4096
        name = f"{lensed}lensed_alm_seed{seed}_{dipole}nside{nside}.fits"
        for row in "IQU":
            arguments[f"map_{row}"] = f"websky/{version}/cmb/map_{row}_{name}"
        yield from super()._components(arguments)


class SimpleSZ(LawModel):
    """A Sunyaev-Zeldovich effect, `sz_type` "kinetic" or "thermal", from the map `template_name`.

    The map is in uK_CMB, or Compton's y. In the thermal one PySM has constants of its own, which
    are taken over: `SecondOrder`.
    """

    order: ClassVar = ("nside", "template_name", "sz_type", "max_nside")

    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        kind = self._taken("sz_type", arguments)
        check_choice("sz_type", kind, ("kinetic", "thermal"))
        values, _ = given_map(self._taken("template_name", arguments), self.nside, "uK_CMB")
        self._no_more(arguments)
        maps = jnp.atleast_2d(jnp.asarray(values, float))
        if kind == "kinetic":
            yield "", CMB(maps, T_CMB)
        else:
            T_x = sed.H_OVER_K * T_SZ * K_SZ / (1e9 * H_SZ)
            yield "", SecondOrder(1e6 * T_SZ * maps, 4.0, T_x, T_CMB)


class CMBDipole(LawModel):
    """The dipole of our motion: a map of I alone, shape (pix,), as in PySM.

    A `Sky` of nothing else has this shape, too. With others it is added to I; PySM's `Sky` adds it
    to Q and U as well.

    Arguments: `amp` and `T_cmb` (temperatures, such as "3366.6 uK_CMB"), `dip_lon` and `dip_lat`
    (Galactic, such as "264 deg"), and `quadrupole_correction`: to second order in the velocity,
    with the quadrupole's law, instead of the exact temperature at all frequencies.
    """

    order: ClassVar = ("nside", "amp", "T_cmb", "dip_lon", "dip_lat")

    @takes_quantities
    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        amplitude, T = (_temperature(self._taken(name, arguments)) for name in ("amp", "T_cmb"))
        T *= 1e-6
        lon, lat = (_degrees(self._taken(name, arguments)) for name in ("dip_lon", "dip_lat"))
        quadrupole = arguments.pop("quadrupole_correction", False)
        self._no_more(arguments)
        beta = speed_of_dipole(amplitude, T)
        found = dipole(self.nside, beta, lon, lat, T_cmb=T, quadrupole=quadrupole)
        yield ("dipole" if quadrupole else ""), CMB(found["dipole"].amplitude[:1], T_CMB)
        if quadrupole:
            maps = found["quadrupole"].amplitude[:1] / 2
            yield "quadrupole", SecondOrder(maps, 0.0, T, T_CMB)

    @property
    def only_I(self) -> bool:
        return True


def _temperature(value: Any) -> float:
    """Return a temperature in uK_CMB, from a quantity or text."""
    number, unit = (value.value, value.unit) if hasattr(value, "unit") else str(value).split()
    return float(number) * unit_factor(str(unit), "uK_CMB")


def _degrees(value: Any) -> float:
    number, unit = (value.value, value.unit) if hasattr(value, "unit") else str(value).split()
    return float(number) * unit_factor(str(unit), "deg")
