"""Free-free emission of ionized gas."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsky.checks import Numeric, Parameter
from jaxsky.components.base import Component, parameter, reference, template


def _emissivity(nu: Numeric, T_e: Numeric) -> Float[Array, "..."]:
    """nu^-2 T_e^-1/2 times the Gaunt factor of Draine (2011), eq. 10.9, with nu in units of GHz."""
    falling = jnp.exp(5.960 - jnp.sqrt(3) / jnp.pi * jnp.log(nu * (T_e / 1e4) ** -1.5))
    return jnp.log(falling + jnp.e) / (jnp.sqrt(T_e) * nu**2)


@jax.jit
def amplitude_from_emission_measure(
    EM: Numeric, T_e: Numeric, nu_ref: Numeric
) -> Float[Array, "..."]:
    """Antenna temperature of optically thin free-free emission [uK_RJ] from its emission measure.

    0.05468 T_e^-3/2 nu^-2 EM g_ff is the optical depth of Draine (2011), with nu in GHz and EM in
    cm^-6 pc; times T_e it is the temperature (Planck 2015 results X, table 4, to first order in
    the depth).
    """
    return jnp.asarray(1e6 * 0.05468 * EM * _emissivity(nu_ref, T_e))


class FreeFree(Component, law="free_free"):
    """Free-free emission, optically thin, with the Gaunt factor of Draine (2011), eq. 10.9.

    (nu/nu_ref)^-2 g_ff(nu, T_e) / g_ff(nu_ref, T_e), with
    g_ff = ln{exp[5.960 - sqrt(3)/pi ln(nu/GHz (T_e/10^4 K)^-3/2)] + e}. It is not polarized.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], I, Q, U with nothing in Q and U, shape (3, pix);
        `amplitude_from_emission_measure` makes the one of I
    T_e : electron temperature [K]
    nu_ref : reference frequency [GHz]
    """

    polarized: ClassVar[bool] = False

    amplitude: Float[Array, "stokes pix"] = template()
    T_e: Parameter = parameter(7000.0, positive=True, symbol=r"T_{\rm e}", unit="K", zero=False)
    nu_ref: Parameter = reference(30.0, within=(0.01, 1e3))

    def sed(self, nu):
        return _emissivity(nu, self.T_e) / _emissivity(self.nu_ref, self.T_e)
