"""Spectral laws, one function an equation.

Each law is the antenna temperature (Rayleigh-Jeans, K_RJ) at `nu` relative to that at `nu_ref`,
so it is exactly 1 at `nu_ref`. All arguments are floats or arrays and broadcast against each
other, all are differentiable, and none is treated specially at any value. Frequencies are in
GHz, temperatures in K. "The paper" is Hervias-Caimapo, Bonaldi & Brown (2016, MNRAS 462, 2063).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsky.checks import Numeric
from jaxsky.constants import H_OVER_K, T_CMB


def _log_planck_excess(x: Numeric) -> Numeric:
    """ln(e^x - 1) for x > 0, finite where e^x overflows."""
    return x + jnp.log(-jnp.expm1(-x))


def _log_body(nu, beta_dust, T_dust, nu_pivot):
    """ln of (nu/nu_pivot)^(beta+1) / (e^{h nu / k T} - 1)."""
    return (beta_dust + 1) * jnp.log(nu / nu_pivot) - _log_planck_excess(H_OVER_K * nu / T_dust)


@jax.jit
def power_law(nu: Numeric, beta_syn: Numeric, nu_ref: Numeric) -> Float[Array, "..."]:
    """Power law (nu/nu_ref)^-beta_syn: the paper's synchrotron law, eq. 2.

    Parameters
    ----------
    nu, nu_ref : frequency and reference frequency [GHz]
    beta_syn : spectral index, positive for a falling spectrum (PySM's is its negative)

    Examples
    --------
    >>> round(float(power_law(60.0, 3.0, 30.0)), 4)
    0.125
    """
    return jnp.exp(-beta_syn * jnp.log(nu / nu_ref))


@jax.jit
def curved_power_law(
    nu: Numeric, beta_syn: Numeric, curvature: Numeric, nu_piv: Numeric, nu_ref: Numeric
) -> Float[Array, "..."]:
    """Power law with running index, (nu/nu_ref)^(-beta_syn + C ln(nu/nu_piv)).

    The paper's section on curved synchrotron; the logarithm is the natural one.

    Parameters
    ----------
    nu, nu_ref, nu_piv : frequency, reference frequency, pivot of the curvature [GHz]
    beta_syn : spectral index at the pivot, positive for a falling spectrum
    curvature : C; positive flattens the spectrum with rising frequency

    Examples
    --------
    >>> round(float(curved_power_law(60.0, 3.0, 0.0, 23.0, 30.0)), 4)
    0.125
    """
    return jnp.exp((-beta_syn + curvature * jnp.log(nu / nu_piv)) * jnp.log(nu / nu_ref))


@jax.jit
def modified_blackbody(
    nu: Numeric, beta_dust: Numeric, T_dust: Numeric, nu_ref: Numeric
) -> Float[Array, "..."]:
    """Modified black body nu^(beta+1) / (e^{h nu / k T} - 1), the paper's eq. 1.

    Parameters
    ----------
    nu, nu_ref : frequency and reference frequency [GHz]
    beta_dust : emissivity index
    T_dust : dust temperature [K]

    Examples
    --------
    >>> float(modified_blackbody(353.0, 1.53, 21.0, 353.0))
    1.0
    """
    # The pivot cancels between the two; at nu_ref it keeps both logarithms small.
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
    """Sum of modified black bodies, normalised once, on the sum, at nu_ref.

    Sum_i E_i (nu/nu_pivot)^(beta_i+1) / (e^{h nu / k T_i} - 1), the paper's eq. 4. The pivot is
    that of Meisner & Finkbeiner (2015), whose f_i q_i the amplitudes E_i stand for.

    Parameters
    ----------
    nu, nu_ref, nu_pivot : frequency, reference frequency, pivot of the emissivities [GHz]
    beta_dust, T_dust, E_dust : tuples of one length; index, temperature [K], relative amplitude

    Examples
    --------
    Model 8 of Finkbeiner et al. (1999):

    >>> float(modified_blackbodies(353.0, (1.67, 2.70), (9.4, 16.2), (0.49, 1.0), 353.0))
    1.0
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

    Parameters
    ----------
    nu, nu_ref : frequency and reference frequency [GHz]
    m60 : minus the slope of ln S against ln nu at 60 GHz
    nu_max : frequency of the peak in flux [GHz], below 60

    Examples
    --------
    >>> float(ame_log_parabola(23.0, 4.0, 19.0, 23.0))
    1.0
    """
    curvature = m60 / (2 * jnp.log(nu_max / 60.0))
    parabola = jnp.log(nu / nu_max) ** 2 - jnp.log(nu_ref / nu_max) ** 2
    return jnp.exp(curvature * parabola - 2 * jnp.log(nu / nu_ref))


@jax.jit
def cmb_derivative(nu: Numeric, T_cmb: Numeric = T_CMB) -> Float[Array, "..."]:
    """Antenna temperature per thermodynamic temperature, x^2 e^x / (e^x - 1)^2 [K_RJ/K_CMB].

    Written as (x / (2 sinh(x/2)))^2 with e^{-x}, which neither overflows nor cancels.

    Parameters
    ----------
    nu : frequency [GHz]
    T_cmb : CMB temperature [K]

    Examples
    --------
    >>> round(float(cmb_derivative(100.0)), 4)
    0.7772
    """
    x = H_OVER_K * nu / T_cmb
    return jnp.square(x * jnp.exp(-x / 2) / -jnp.expm1(-x))
