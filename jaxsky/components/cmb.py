"""The cosmic microwave background."""

from typing import ClassVar

from jaxtyping import Array, Float

from jaxsky import sed
from jaxsky.checks import Parameter
from jaxsky.components.base import Component, parameter, template
from jaxsky.constants import T_CMB


class CMB(Component, law="cmb"):
    """The CMB anisotropies: the derivative of a black body (`sed.cmb_derivative`).

    Parameters
    ----------
    amplitude : map in thermodynamic temperature [uK_CMB], shape (stokes, pix)
    T_cmb : temperature of the monopole [K]
    """

    unit: ClassVar[str] = "uK_CMB"

    amplitude: Float[Array, "stokes pix"] = template()
    T_cmb: Parameter = parameter(T_CMB, positive=True, symbol=r"T_{\rm CMB}", unit="K", zero=False)

    def sed(self, nu):
        return sed.cmb_derivative(nu, self.T_cmb)
