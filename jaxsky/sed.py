"""Spectral laws, one function per equation.

Each law but `cmb_derivative` and `thermal_sz` is the antenna temperature (Rayleigh-Jeans, K_RJ) at
`nu` relative to that at `nu_ref`, so exactly 1 there. Arguments are floats or arrays, broadcast
against each other and can be differentiated; no value is treated as a special case. Frequencies are
in GHz, temperatures in K. "The paper" is Hervias-Caimapo, Bonaldi & Brown (2016, MNRAS 462, 2063).
"""

from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsky.checks import Numeric

#: h/k [K/GHz], CODATA 2018 (both exact in the SI).
H_OVER_K: Final = 6.62607015e-34 / 1.380649e-23 * 1e9

#: CMB temperature [K], Fixsen (2009), as in the paper; astropy has 2.7255.
T_CMB: Final = 2.72548


def _log_body(nu, beta_dust, T_dust, nu_pivot):
    """Return ln of (nu/nu_pivot)^(beta+1) / (e^x - 1), x = h nu / k T; safe where e^x overflows."""
    x = H_OVER_K * nu / T_dust
    return (beta_dust + 1) * jnp.log(nu / nu_pivot) - (x + jnp.log(-jnp.expm1(-x)))


@jax.jit
def power_law(nu: Numeric, beta_syn: Numeric, nu_ref: Numeric) -> Float[Array, "..."]:
    """Power law (nu/nu_ref)^-beta_syn: the paper's synchrotron law, eq. 2.

    beta_syn is positive for a falling spectrum; PySM's is its negative.
    """
    return jnp.exp(-beta_syn * jnp.log(nu / nu_ref))


@jax.jit
def curved_power_law(
    nu: Numeric, beta_syn: Numeric, curvature: Numeric, nu_piv: Numeric, nu_ref: Numeric
) -> Float[Array, "..."]:
    """Power law with a running index, (nu/nu_ref)^(-beta_syn + C ln(nu/nu_piv)).

    From the paper's section on curved synchrotron; ln is the natural logarithm. A positive C
    flattens the spectrum with rising frequency. At nu_piv the exponent is -beta_syn.
    """
    return jnp.exp((-beta_syn + curvature * jnp.log(nu / nu_piv)) * jnp.log(nu / nu_ref))


@jax.jit
def modified_blackbody(
    nu: Numeric, beta_dust: Numeric, T_dust: Numeric, nu_ref: Numeric
) -> Float[Array, "..."]:
    """Modified black body nu^(beta+1) / (e^{h nu / k T} - 1), the paper's eq. 1."""
    # The pivot cancels; setting it to nu_ref keeps both logarithms small.
    return jnp.exp(
        _log_body(nu, beta_dust, T_dust, nu_ref) - _log_body(nu_ref, beta_dust, T_dust, nu_ref)
    )


@jax.jit
def modified_blackbodies(
    nu: Numeric,
    beta_dust: tuple[Numeric, ...],
    T_dust: tuple[Numeric, ...],
    E_dust: tuple[Numeric, ...],
    nu_ref: Numeric,
    nu_pivot: Numeric = 3000.0,
) -> Float[Array, "..."]:
    """Sum of modified black bodies; the sum is normalised at nu_ref, not its terms.

    Sum_i E_i (nu/nu_pivot)^(beta_i+1) / (e^{h nu / k T_i} - 1), the paper's eq. 4. The pivot is
    that of Meisner & Finkbeiner (2015); the relative amplitudes E_i are their f_i q_i. Model 8 of
    Finkbeiner et al. (1999) has beta 1.67 and 2.70, T 9.4 and 16.2 K, E 0.49 and 1.
    """
    top: Numeric = 0.0
    bottom: Numeric = 0.0
    for beta, T, E in zip(beta_dust, T_dust, E_dust, strict=True):
        top = top + E * jnp.exp(_log_body(nu, beta, T, nu_pivot))
        bottom = bottom + E * jnp.exp(_log_body(nu_ref, beta, T, nu_pivot))
    return jnp.asarray(top / bottom)


@jax.jit
def ame_log_parabola(
    nu: Numeric, m60: Numeric, nu_max: Numeric, nu_ref: Numeric
) -> Float[Array, "..."]:
    """Anomalous microwave emission: a parabola in log flux against log frequency.

    Bonaldi et al. (2007) and the paper's eq. 6, written relative to nu_ref:
    (nu/nu_ref)^-2 exp{m60 / (2 ln(nu_max/60)) [ln^2(nu/nu_max) - ln^2(nu_ref/nu_max)]}.
    m60 is minus the slope of ln S against ln nu at 60 GHz, nu_max < 60 GHz the peak in flux.
    """
    curvature = m60 / (2 * jnp.log(nu_max / 60.0))
    parabola = jnp.log(nu / nu_max) ** 2 - jnp.log(nu_ref / nu_max) ** 2
    return jnp.exp(curvature * parabola - 2 * jnp.log(nu / nu_ref))


@jax.jit
def cmb_derivative(nu: Numeric, T_cmb: Numeric = T_CMB) -> Float[Array, "..."]:
    """Antenna temperature per thermodynamic temperature, x^2 e^x / (e^x - 1)^2 [K_RJ/K_CMB].

    Written as (x / (2 sinh(x/2)))^2 in terms of e^{-x}, to avoid overflow and cancellation.
    """
    x = H_OVER_K * nu / T_cmb
    return jnp.square(x * jnp.exp(-x / 2) / -jnp.expm1(-x))


@jax.jit
def thermal_sz(nu: Numeric, T_cmb: Numeric = T_CMB) -> Float[Array, "..."]:
    """Antenna temperature of the thermal SZ effect per Compton y [K_RJ].

    T_cmb (x coth(x/2) - 4) x^2 e^x / (e^x - 1)^2 with x = h nu / k T_cmb (Sunyaev & Zeldovich 1972;
    Carlstrom et al. 2002, without relativistic corrections): negative below 217 GHz, -2 T_cmb at
    long wavelengths.
    """
    x = H_OVER_K * nu / T_cmb
    return T_cmb * (x / jnp.tanh(x / 2) - 4) * cmb_derivative(nu, T_cmb)
