"""Units of PySM: antenna and thermodynamic temperature as units of astropy, and conversions.

`units.uK_RJ`, `units.K_CMB` and the like, and all names of `astropy.units`. Nothing is registered
in astropy: where PySM was imported its own units are used, so that both agree.
"""

from typing import Any, Final

import numpy as np
from astropy import units as u

from jaxsky.bandpass import UNITS, Bandpass
from jaxsky.checks import as_array
from jaxsky.io.quantities import from_quantity, unit_factor, unit_name
from jaxsky.public import takes_quantities
from jaxsky.pysm.emission import above_cut

#: CMB temperature of astropy and PySM [K].
T_CMB: Final = 2.7255
_OWN: dict[str, Any] = {}
for _kind in ("K_CMB", "K_RJ"):
    u.def_unit(_kind, namespace=_OWN, prefixes=True)


def unit_of(unit: str | u.UnitBase) -> u.UnitBase:
    """Return a unit of brightness, of antenna or of thermodynamic temperature, given its name.

    Any spelling of `jaxsky.io.unit_name` is accepted; ValueError if it is no unit of brightness.
    """
    name = unit_name(str(unit))
    if name not in UNITS:
        raise ValueError(f"Unit {str(unit)!r} is no brightness; known are {', '.join(UNITS)}.")
    if isinstance(unit, u.UnitBase):
        return unit
    if name in _OWN:  # astropy takes milliseconds to find out that it has no such unit
        return u.get_current_unit_registry().registry.get(name, _OWN[name])
    return u.Unit(name)


def __getattr__(name: str) -> Any:
    return unit_of(name) if name in _OWN and name in UNITS else getattr(u, name)


@takes_quantities
def frequencies(freqs: u.Quantity) -> np.ndarray:
    """Return frequencies in GHz, shape (sample,); TypeError if they have no unit of frequency."""
    if not hasattr(freqs, "unit"):
        raise TypeError(f"Frequencies must carry a unit, such as 100 * u.GHz, but are {freqs!r}.")
    try:
        nu = u.Quantity(freqs).to_value(u.GHz)
    except u.UnitConversionError:
        raise TypeError(
            f"Frequencies must be in GHz or a unit like it, but are in {freqs.unit}."
        ) from None
    return np.atleast_1d(np.asarray(nu, np.float64))


@takes_quantities
def bandpass(freqs: u.Quantity, weights: np.ndarray | None = None) -> Bandpass:
    """Return a band with weights in power units (Jy/sr), by default a top-hat.

    As in PySM, the weights of a single frequency have no effect.
    """
    nu = frequencies(freqs)
    if weights is None or nu.size == 1:
        weights = np.ones(nu.size)
    return Bandpass(nu, as_array("weights", weights).astype(float), "power")


@takes_quantities
def bandpass_unit_conversion(
    freqs: u.Quantity,
    weights: np.ndarray | None = None,
    output_unit: str | u.UnitBase | None = None,
    input_unit: str | u.UnitBase = "uK_RJ",
    cut: float = 1e-10,
) -> u.Quantity:
    """Return the factor between two units of brightness over a band, as PySM's function.

    Its conventions: weights are in power units, MJy/sr is that of a spectrum of constant
    intensity, integrals are by the trapezoid rule and the CMB has 2.7255 K.

    Parameters
    ----------
    freqs : frequency, or frequencies of a band
    weights : response to unit power at each, shape (sample,); by default a top-hat
    output_unit, input_unit : units of brightness, or their names
    cut : samples with smaller weights, once the band has the integral 1 [1/GHz], are left out

    Raises
    ------
    TypeError, ValueError
        If the unit of the output is missing, or a unit is no brightness, or as for `Bandpass`.

    Examples
    --------
    >>> float(bandpass_unit_conversion(100 * u.GHz, output_unit="mK_RJ").value)
    0.001
    """
    if output_unit is None:
        raise TypeError("Argument `output_unit` is missing.")
    output_unit, input_unit = unit_of(output_unit), unit_of(input_unit)
    band = above_cut(bandpass(freqs, weights), cut)
    at: Any = band if band.nu.size > 1 else float(band.nu[0])
    factor = unit_factor(str(input_unit), str(output_unit), at, T_cmb=T_CMB, flat=True)
    return factor * (output_unit / input_unit)


@takes_quantities
def cmb_equivalencies(spec: u.Quantity) -> list[tuple]:
    """Return equivalencies of astropy between K_RJ, K_CMB and Jy/sr at a frequency, or at each."""
    nu = from_quantity(u.Quantity(spec).to(u.GHz, equivalencies=u.spectral()), "GHz")
    rows = []
    for source, target in (("K_RJ", "K_CMB"), ("Jy/sr", "K_RJ"), ("Jy/sr", "K_CMB")):
        factor = np.reshape(
            [unit_factor(source, target, float(x), T_cmb=T_CMB) for x in nu.ravel()], nu.shape
        )
        rows.append(
            (unit_of(source), unit_of(target), lambda x, f=factor: x * f, lambda x, f=factor: x / f)
        )
    return rows
