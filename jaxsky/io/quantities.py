"""Recognise units as files and astropy spell them, and convert between them."""

import re
from typing import Any

import numpy as np
from astropy import units as u

from jaxsky.bandpass import UNITS, Bandpass, conversion
from jaxsky.checks import Numeric
from jaxsky.public import takes_quantities

_DIMENSIONLESS = {"", "1", "none", "n/a", "na", "unitless", "dimensionless", "index", "ratio"}
_DIMENSIONLESS |= {"count", "counts", "ct", "hit", "hits", "n_obs", "samples", "number"}
_SQUARE = r"(?P<square>(?:\^|\*\*)?2)?"
_KELVIN = re.compile(r"(?P<prefix>mu|micro|[mun\u00b5\u03bc])?K(?P<kind>[a-zA-Z]*)" + _SQUARE)
_KINDS = {
    "": "",
    **dict.fromkeys(("cmb", "thermodynamic", "thermo"), "_CMB"),
    **dict.fromkeys(("rj", "antenna", "a"), "_RJ"),
}
_JANSKY = re.compile(
    r"(?P<prefix>[kM]?)[Jj]y(?P<inner>2)?(?:/sr2?|[.*]?sr(?:\^|\*\*)?-[12])" + _SQUARE
)


#: Antenna temperature times velocity, for which astropy has a plain kelvin.
_OF_A_LINE = re.compile(r"(?<=K)_?RJ(?=[\s.*]*km)")


def unit_name(text: str) -> str:
    """Return the package's name for a unit spelt as in FITS headers, e.g. "mK,thermodynamic".

    This is a name in `jaxsky.bandpass.UNITS`, with "^2" for a square; "" for a pure number; "K",
    "mK", "uK" or "nK" if the text does not say whether the temperature is antenna or thermodynamic;
    otherwise astropy's name, "K km / s" for that of lines, whose temperature is antenna.
    """
    if text.strip().lower() in _DIMENSIONLESS:
        return ""
    squeezed = re.sub(r"[\s_,(){}]", "", text)
    if (match := _JANSKY.fullmatch(squeezed)) is not None:
        square = "^2" if match["square"] or match["inner"] else ""
        return f"{match['prefix']}Jy/sr{square}"
    match = _KELVIN.fullmatch(squeezed)
    if match is not None and match["kind"].lower() in _KINDS:
        prefix = {"m": "m", "n": "n", None: ""}.get(match["prefix"], "u")
        square = "^2" if match["square"] else ""
        return f"{prefix}K{_KINDS[match['kind'].lower()]}{square}"
    try:
        return u.Unit(_OF_A_LINE.sub("", text)).to_string()
    except ValueError:
        raise ValueError(f"Unknown unit {text!r}; known units are {', '.join(UNITS)}.") from None


def is_ambiguous(name: str) -> bool:
    """Return whether a unit is in kelvins that may be antenna or thermodynamic temperature."""
    return name.removesuffix("^2") in ("K", "mK", "uK", "nK")


@takes_quantities
def unit_factor(
    source: str,
    target: str,
    at: Numeric | Bandpass | u.Quantity | None = None,
    nu_ref: float | None = None,
    *,
    T_cmb: float | None = None,
    flat: bool = False,
) -> float:
    """Return the factor that converts values from one unit to another.

    Parameters
    ----------
    source, target : names of units, in any spelling that `unit_name` accepts; squares ("K_CMB^2",
        for covariances) convert with the square of the factor
    at : frequency [GHz] or band, needed between K_RJ, K_CMB and MJy/sr; for a band the factor is
        `Bandpass.conversion`
    nu_ref : frequency at which a band's MJy/sr is quoted [GHz], needed for that unit unless `flat`
    T_cmb : temperature of the CMB in K_CMB [K], by default `jaxsky.sed.T_CMB`; astropy and
        PySM have 2.7255
    flat : whether a band's MJy/sr is that of a spectrum of constant intensity, as in PySM, instead
        of one that falls as 1/nu, as for IRAS and Planck HFI

    Examples
    --------
    >>> round(unit_factor("K_CMB^2", "uK_RJ^2", at=100.0) / 1e12, 4)
    0.6041
    """
    names = unit_name(source), unit_name(target)
    first, second = (name.removesuffix("^2") for name in names)
    power, other = (1 + name.endswith("^2") for name in names)
    hint = "; say K_CMB or K_RJ" if is_ambiguous(first) and second in UNITS else ""
    refusal = ValueError(f"Unit {source!r} does not convert to {target!r}{hint}.")
    if power != other or (first in UNITS) != (second in UNITS):
        raise refusal
    if first not in UNITS:
        try:
            return u.Unit(first).to(u.Unit(second)) ** power
        except u.UnitConversionError:
            raise refusal from None
    (size, kind), (target_size, target_kind) = UNITS[first], UNITS[second]
    if kind == target_kind:
        return (size / target_size) ** power
    if at is None:
        raise ValueError(
            f"The factor from {source!r} to {target!r} depends on frequency; "
            "give `at`, a frequency [GHz] or a Bandpass."
        )
    if isinstance(at, Bandpass):
        factor = at.conversion(first, second, nu_ref, T_cmb=T_cmb, flat=flat)
        return float(factor) ** power
    nu = at.to_value(u.GHz) if isinstance(at, u.Quantity) else at
    return float(conversion(first, second, nu, T_cmb)) ** power


@takes_quantities
def from_quantity(
    quantity: Any,
    unit: str,
    *,
    at: Numeric | Bandpass | u.Quantity | None = None,
    nu_ref: float | None = None,
) -> np.ndarray:
    """Convert an astropy Quantity to a bare array in a given unit, in double precision.

    `unit` is "uK_RJ", "K_CMB", "MJy/sr", "GHz", "arcmin", "K", ...; for `at` and `nu_ref` see
    `unit_factor`. Units are recognised by name, so those of `pysm3.units` (uK_RJ, K_CMB) work as
    well as astropy's.

    Examples
    --------
    >>> float(from_quantity(0.5 * u.deg, "arcmin"))
    30.0
    """
    if not hasattr(quantity, "unit"):
        raise TypeError(f"Argument `quantity` must carry a unit, but is {type(quantity).__name__}.")
    factor = unit_factor(str(quantity.unit), unit, at, nu_ref)
    return np.asarray(quantity.value, dtype=np.float64) * factor
