"""Anomalous microwave emission."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxsky import sed
from jaxsky.checks import Parameter, as_array, check_shape, is_concrete
from jaxsky.components.base import Component, parameter, reference, template


class AME(Component, law="ame"):
    """Anomalous microwave emission with the log-parabola law (`sed.ame_log_parabola`).

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix), its Q and U for a polarization
        fraction of 1; `from_dust_angles` makes one
    polarization_fraction : what Q and U are multiplied by; 1 for maps that are measured Q and U
    m60, nu_max : slope at 60 GHz and peak frequency in flux [GHz] (below 60)
    nu_ref : reference frequency [GHz]
    """

    amplitude: Float[Array, "stokes pix"] = template()
    polarization_fraction: Parameter = parameter(1.0, symbol=r"f_{\rm p}")
    m60: Parameter = parameter(4.0, symbol="m_{60}")
    nu_max: Parameter = parameter(19.0, positive=True, symbol=r"\nu_{\rm max}", unit="GHz")
    nu_ref: Parameter = reference(23.0, within=(0.01, 1e3))

    def __check_init__(self) -> None:
        nu_max = as_array("nu_max", self.nu_max)
        if is_concrete(nu_max) and not bool(jnp.all(nu_max < 60)):
            raise ValueError(f"Argument `nu_max` must be below 60 GHz, but is {nu_max.max():g}.")

    @classmethod
    def from_dust_angles(
        cls,
        intensity: ArrayLike,
        dust: ArrayLike,
        polarization_fraction: Parameter = 0.01,
        **parameters: Any,
    ) -> "AME":
        """AME that is polarized along the dust: Q, U = f T (cos, sin)(2 chi), the paper's eq. 5.

        Parameters
        ----------
        intensity : AME intensity [uK_RJ], shape (pix,)
        dust : dust polarization Q, U or I, Q, U in any unit, shape (stokes, pix); the result
            has the same Stokes parameters. Where the dust is not polarized, nor is the AME.
        polarization_fraction : f, the paper's 1 %
        **parameters : further parameters of `AME`
        """
        intensity, dust = as_array("intensity", intensity), as_array("dust", dust)
        form = f"have shape {dust.shape[1:]} like a map of `dust`"
        check_shape("intensity", intensity, intensity.shape == dust.shape[1:], form)
        Q, U = dust[-2:]
        P = jnp.hypot(Q, U)
        polarized = intensity * dust[-2:] / jnp.where(P > 0, P, 1.0)
        amplitude = polarized if len(dust) == 2 else jnp.concatenate([intensity[None], polarized])
        return cls(amplitude, polarization_fraction, **parameters)

    @property
    def template(self):
        polarized = self.amplitude[-2:] * self.polarization_fraction
        return jnp.concatenate([self.amplitude[:-2], polarized])

    def sed(self, nu):
        return sed.ame_log_parabola(nu, self.m60, self.nu_max, self.nu_ref)
