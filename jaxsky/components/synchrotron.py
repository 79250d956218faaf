"""Synchrotron emission."""

from jaxtyping import Array, Float

from jaxsky import sed
from jaxsky.checks import Parameter
from jaxsky.components.base import Component, parameter, reference, template


class Synchrotron(Component, law="synchrotron"):
    """Synchrotron: a power law, or one with curvature (`sed.curved_power_law`).

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    beta_syn : spectral index, T ~ nu^-beta_syn; the paper's baseline 3.10
    curvature : C of the paper, 0 for a pure power law
    nu_piv : pivot frequency of the curvature [GHz]
    nu_ref : reference frequency [GHz]
    """

    amplitude: Float[Array, "stokes pix"] = template()
    beta_syn: Parameter = parameter(
        3.10,
        within=(0.0, 10.0),
        symbol=r"\beta_{\rm syn}",
        zero=False,
        hint="T ~ nu^-beta_syn, so jaxsky.templates.from_pysm_beta makes 3.1 of an index of -3.1",
    )
    curvature: Parameter = parameter(0.0, symbol="C")
    nu_piv: Parameter = parameter(23.0, positive=True, symbol=r"\nu_{\rm piv}", unit="GHz")
    nu_ref: Parameter = reference(30.0, within=(0.01, 1e3))

    def sed(self, nu):
        return sed.curved_power_law(nu, self.beta_syn, self.curvature, self.nu_piv, self.nu_ref)
