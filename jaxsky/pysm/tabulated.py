"""Models of PySM whose laws are tables: spinning dust, and dust of Hensley & Draine (2017)."""

from collections.abc import Iterable
from typing import Any, ClassVar, Final

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from astropy import units as u

from jaxsky.components import Component, HensleyDraine, SpinningDust
from jaxsky.components.tabulated import SPEED_OF_LIGHT
from jaxsky.pysm.files import find_template, given_frequency, given_map, read_map
from jaxsky.pysm.models import LawModel

#: Tables of grains, and the columns of intensity and polarization at 81 strengths of the field.
GRAINS: Final = {
    "silicate": "pysm_2/sil_fe00_2.0.dat",
    "iron": "pysm_2/sil_fe05_2.0.dat",
    "carbon": "pysm_2/car_1.0.dat",
}
COLUMNS: Final = {"I": slice(3, 84), "QU": slice(84, 165)}
LOG_U: Final = np.arange(-3.0, 5.01, 0.1)
#: Commander's dust, with temperature, its error, index and its error in these columns.
COMMANDER: Final = "pysm_2/COM_CompMap_dust-commander_0256_R2.00.fits"
FIELDS: Final = [3, 5, 6, 8]


class SpDust(LawModel):
    """Spinning dust from a table of emissivities: `SpinningDust`, of I alone.

    Arguments are those of PySM: `map_I`, `unit_I`, `freq_ref_I`, `emissivity`, `freq_peak`,
    `freq_ref_peak`, of `SpDustPol` also `pol_frac`, `angle_Q`, `angle_U`.
    """

    law = "spinning_dust"
    order: ClassVar = ("map_I", "freq_ref_I", "emissivity", "freq_peak", "freq_ref_peak", "nside")

    def _components(self, arguments):
        amplitude, nu_ref, _ = self._maps(arguments | {"has_polarization": False})
        for used in ("map_I", "unit_I", "freq_ref_I"):
            arguments.pop(used, None)
        emissivity = np.loadtxt(find_template(self._taken("emissivity", arguments)))
        nu_table = given_frequency("freq_ref_peak", self._taken("freq_ref_peak", arguments))
        nu_peak = self._peak(self._taken("freq_peak", arguments), nu_table)
        amplitude = self._polarized(amplitude, arguments)
        self._no_more(arguments)
        maps, table = jnp.asarray(amplitude), jnp.asarray(emissivity)
        yield "", SpinningDust(maps, table, nu_peak, nu_table, nu_ref)

    def _peak(self, value: Any, nu_table: float) -> Any:
        """Return the frequency of the peak [GHz], a number or a map."""
        try:
            return float(u.Quantity(value).to_value(u.GHz))
        except TypeError:  # a file
            values, _ = given_map(self._named(value), self.nside, "GHz")
        # PySM divides in the precision of the file.
        return np.asarray(values / values.dtype.type(nu_table), np.float64) * nu_table

    def _polarized(self, amplitude: np.ndarray, arguments: dict[str, Any]) -> np.ndarray:
        return amplitude


class SpDustPol(SpDust):
    """Spinning dust with a constant fraction of polarization and the angles of maps of Q and U."""

    def _polarized(self, amplitude, arguments):
        fraction = self._taken("pol_frac", arguments)
        Q, U = (
            given_map(self._named(self._taken(f"angle_{row}", arguments)), self.nside, "")[0]
            for row in "QU"
        )
        angle = np.arctan2(U, Q)
        return np.concatenate([amplitude, amplitude * fraction * [np.cos(angle), np.sin(angle)]])


class HensleyDraine2017(LawModel):
    """Dust of Hensley & Draine (2017), a mixture of grains in a radiation field: `HensleyDraine`.

    Arguments are those of PySM: maps and frequencies as for `LawModel`, `f_car` and `f_fe`
    (fractions of carbonaceous grains and of silicates with iron), and `uval`, log10 of the field,
    or with `rnd_uval` a realisation of it by `seed` at `nside_uval` from Commander's temperature
    and index, the same as PySM's. PySM itself fails over bands in this model.
    """

    law = "hd17"
    order: ClassVar = ("map_I", "map_Q", "map_U", "freq_ref_I", "freq_ref_P", "nside")

    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        amplitude, nu_I, nu_P = self._maps(arguments)
        iron, carbon = (self._taken(name, arguments) for name in ("f_fe", "f_car"))
        fractions = {"silicate": 1 - iron, "iron": iron, "carbon": carbon}
        log_U = self._field(arguments)
        self._no_more(arguments)
        read = {name: np.loadtxt(find_template(file)) for name, file in GRAINS.items()}
        rows = {"I": (amplitude[:1], nu_I), "QU": (amplitude[1:], nu_P)}
        for name, (maps, nu_ref) in rows.items():
            if len(maps):
                table = sum(_intensity(read[g], COLUMNS[name]) * f for g, f in fractions.items())
                whole = _with_margins(read["silicate"][:, 0], table)
                yield name, HensleyDraine(jnp.asarray(maps), whole, log_U, nu_ref)

    def _field(self, arguments: dict[str, Any]) -> Any:
        """Return log10 of the strength of the radiation field, a number or a map."""
        drawn, given = arguments.pop("rnd_uval", True), arguments.pop("uval", 0.2)
        nside, seed = arguments.pop("nside_uval", 256), arguments.pop("seed", None)
        if not drawn:
            return given
        T, T_error, beta, beta_error = read_map(COMMANDER, nside, "", FIELDS)[0]
        random = np.random.RandomState(seed)
        T = T + random.randn(T.size) * T_error
        beta = beta + random.randn(T.size) * beta_error
        # The energy of grains in equilibrium is that absorbed: U ~ T^(4 + beta).
        log_U = np.clip((4 + beta) * np.log10(T / np.mean(T)), LOG_U[0], LOG_U[-1])
        return healpy.ud_grade(log_U, self.nside)


def _intensity(table: np.ndarray, columns: slice) -> np.ndarray:
    """Return intensities per frequency, (wavelength, field), from those times frequency."""
    return table[:, columns] * table[:, :1]


def _with_margins(wavelengths: np.ndarray, table: Any) -> jax.Array:
    """Return the table that `HensleyDraine` takes; wavelengths are in micrometres."""
    whole = np.zeros((1 + len(table), 1 + table.shape[1]))
    whole[0, 1:], whole[1:, 0] = LOG_U, SPEED_OF_LIGHT / wavelengths[::-1]
    whole[1:, 1:] = table[::-1]
    return jnp.asarray(whole)
