"""Brightness units: K_RJ, K_CMB and MJy/sr, at a frequency and over a band.

Units are named by strings such as "uK_CMB", "mK_RJ", "MJy/sr". The factors are pure functions of
arrays; the names are static. Inside the package everything is uK_RJ.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsky.checks import Numeric
from jaxsky.constants import MJYSR_PER_K_RJ_AT_1GHZ
from jaxsky.sed import cmb_derivative

_PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}
#: name -> (size in the unit of its kind, kind)
UNITS: dict[str, tuple[float, str]] = {
    f"{prefix}{kind}": (size, kind)
    for kind in ("K_RJ", "K_CMB")
    for prefix, size in _PREFIXES.items()
} | {"MJy/sr": (1.0, "MJy/sr"), "kJy/sr": (1e-3, "MJy/sr"), "Jy/sr": (1e-6, "MJy/sr")}


def parse_unit(unit: str) -> tuple[float, str]:
    """Size and kind ("K_RJ", "K_CMB" or "MJy/sr") of a unit's name."""
    try:
        return UNITS[unit]
    except KeyError:
        raise ValueError(f"Unknown unit {unit!r}; known units are {', '.join(UNITS)}.") from None


def _ratio(
    source: str, target: str, nu: Numeric, nu_ref: Numeric, mean: Callable[[Any], Any]
) -> Array:
    """Factor between units; `mean` is the one over the band of values at its frequencies."""

    def K_RJ_per(kind: str) -> Numeric:
        if kind == "K_CMB":
            return mean(cmb_derivative(nu))
        if kind == "K_RJ":
            return 1.0
        return mean((nu_ref / nu) / (MJYSR_PER_K_RJ_AT_1GHZ * nu**2))

    (source_size, source_kind), (target_size, target_kind) = parse_unit(source), parse_unit(target)
    scale = source_size / target_size
    if source_kind == target_kind:
        return jnp.asarray(scale)
    return jnp.asarray(scale * K_RJ_per(source_kind) / K_RJ_per(target_kind))


def conversion(source: str, target: str, nu: Numeric) -> Float[Array, "..."]:
    """Factor from one brightness unit to another at a frequency [GHz]."""
    nu = jnp.asarray(nu)
    return _ratio(source, target, nu, nu, lambda values: values)


@partial(jax.jit, static_argnames=("source", "target"))
def band_conversion(
    source: str,
    target: str,
    nu: Float[Array, " sample"],
    weights: Float[Array, " sample"],
    nu_ref: Numeric,
) -> Float[Array, ""]:
    """Factor from one brightness unit to another over a band.

    A band reports the weighted mean of the antenna temperature, so 1 K_CMB reads sum w g(nu)
    K_RJ, g being `cmb_derivative`. A value in MJy/sr is that at `nu_ref` [GHz] of a spectrum
    I ~ 1/nu (the IRAS convention, which Planck HFI follows: Planck 2013 results IX). The weights
    are those on antenna temperature, with sum 1 (`Bandpass.quadrature`).
    """
    return _ratio(source, target, nu, nu_ref, lambda values: jnp.sum(weights * values))
