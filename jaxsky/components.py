"""Components of the sky: template maps times a spectral law.

A component is its parameters. Each spectral parameter is a number or a map of shape (pix,); the
law is written once, for a frequency, in `sed`, and everything else (band averages, gradients,
parameter names) follows from the fields.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxsky import sed
from jaxsky.checks import as_array, check_finite, check_positive
from jaxsky.constants import T_CMB
from jaxsky.types import Parameter

__all__ = ["AME", "CMB", "Component", "Dust", "Synchrotron"]


class Component(eqx.Module):
    """Base class: `amplitude` (stokes, pix) times `sed(nu)`.

    Stokes parameters are I, Q, U (3 rows) or Q, U (2 rows), in uK_RJ at the component's
    reference frequency, HEALPix RING order, Galactic coordinates, COSMO sign of U.

    A subclass adds its spectral parameters as fields, converts them with `self._parameter` and
    writes `sed`.
    """

    amplitude: eqx.AbstractVar[Float[Array, "stokes pix"]]

    def sed(self, nu: ArrayLike) -> Float[Array, ""] | Float[Array, " pix"]:
        """The spectral law at one frequency [GHz]; a map if any parameter is one."""
        raise TypeError(f"{type(self).__name__} must define `sed`.")

    @property
    def template(self) -> Float[Array, "stokes pix"]:
        """What the law multiplies; the amplitude, unless parameters other than spectral act."""
        return self.amplitude

    @staticmethod
    def _amplitude(value: ArrayLike) -> Array:
        array = as_array("amplitude", value)
        if array.ndim != 2 or array.shape[0] not in (2, 3):
            raise ValueError(
                "Argument `amplitude` must have shape (stokes, pix) with Stokes Q, U or I, Q, U, "
                f"but has shape {array.shape}."
            )
        check_finite("amplitude", array)
        return array

    def _parameter(self, name: str, value: ArrayLike, positive: bool = False) -> Array:
        array = as_array(name, value)
        npix = self.amplitude.shape[-1]
        if array.shape not in ((), (npix,)):
            raise ValueError(
                f"Argument `{name}` must be a number or a map of shape ({npix},), "
                f"but has shape {array.shape}."
            )
        (check_positive if positive else check_finite)(name, array)
        return array


class Synchrotron(Component):
    """Synchrotron: a power law, or one with curvature (`sed.curved_power_law`).

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    beta_syn : spectral index, T ~ nu^-beta_syn; the paper's baseline 3.10
    curvature : C of the paper, 0 for a pure power law
    nu_piv : pivot frequency of the curvature [GHz]
    nu_ref : reference frequency [GHz]

    Raises
    ------
    TypeError, ValueError
        For units, wrong shapes, values that are not finite, or frequencies that are not positive.
    """

    amplitude: Float[Array, "stokes pix"]
    beta_syn: Parameter
    curvature: Parameter
    nu_piv: Parameter
    nu_ref: Parameter

    def __init__(self, amplitude, beta_syn=3.10, curvature=0.0, nu_piv=23.0, nu_ref=30.0) -> None:
        self.amplitude = self._amplitude(amplitude)
        self.beta_syn = self._parameter("beta_syn", beta_syn)
        self.curvature = self._parameter("curvature", curvature)
        self.nu_piv = self._parameter("nu_piv", nu_piv, positive=True)
        self.nu_ref = self._parameter("nu_ref", nu_ref, positive=True)

    def sed(self, nu):
        return sed.curved_power_law(nu, self.beta_syn, self.curvature, self.nu_piv, self.nu_ref)


class Dust(Component):
    """Thermal dust: one modified black body, or a sum of them given as tuples.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    beta_dust, T_dust : index and temperature [K], or a tuple of them with one entry a body;
        the paper's baseline 1.53 and 21 K
    E_dust : tuple of relative amplitudes, only for several bodies (`sed.modified_blackbodies`)
    nu_ref : reference frequency [GHz]
    nu_pivot : pivot of the emissivities [GHz], only for several bodies; default 3000

    Raises
    ------
    TypeError, ValueError
        For units, wrong shapes, values that are not finite, temperatures or frequencies that
        are not positive, tuples of different lengths, E_dust or nu_pivot with a single body.

    Examples
    --------
    >>> maps = jnp.ones((2, 12))
    >>> Dust(maps, beta_dust=(1.67, 2.70), T_dust=(9.4, 16.2), E_dust=(0.49, 1.0)).bodies
    2
    """

    amplitude: Float[Array, "stokes pix"]
    beta_dust: Parameter | tuple[Parameter, ...]
    T_dust: Parameter | tuple[Parameter, ...]
    E_dust: tuple[Parameter, ...] | None
    nu_ref: Parameter
    nu_pivot: Parameter | None

    def __init__(
        self, amplitude, beta_dust=1.53, T_dust=21.0, E_dust=None, nu_ref=353.0, nu_pivot=None
    ) -> None:
        self.amplitude = self._amplitude(amplitude)
        self.nu_ref = self._parameter("nu_ref", nu_ref, positive=True)
        if not isinstance(beta_dust, tuple):
            for name, value in {"E_dust": E_dust, "nu_pivot": nu_pivot}.items():
                if value is not None:
                    raise ValueError(
                        f"Argument `{name}` has no effect with a single body; give `beta_dust`, "
                        "`T_dust` and `E_dust` as tuples for several."
                    )
            self.beta_dust = self._parameter("beta_dust", beta_dust)
            self.T_dust = self._parameter("T_dust", T_dust, positive=True)
            self.E_dust = self.nu_pivot = None
            return
        lengths = [len(v) if isinstance(v, tuple) else None for v in (beta_dust, T_dust, E_dust)]
        if len(set(lengths)) > 1 or not lengths[0]:
            raise ValueError(
                "Arguments `beta_dust`, `T_dust` and `E_dust` must be tuples with one entry a "
                f"body, but have lengths {lengths}."
            )
        self.beta_dust = tuple(self._parameter("beta_dust", b) for b in beta_dust)
        self.T_dust = tuple(self._parameter("T_dust", T, positive=True) for T in T_dust)
        self.E_dust = tuple(self._parameter("E_dust", E) for E in E_dust)
        pivot = 3000.0 if nu_pivot is None else nu_pivot
        self.nu_pivot = self._parameter("nu_pivot", pivot, positive=True)

    @property
    def bodies(self) -> int:
        """Number of modified black bodies."""
        return len(self.E_dust) if self.E_dust is not None else 1

    def sed(self, nu):
        if self.E_dust is None:
            return sed.modified_blackbody(nu, self.beta_dust, self.T_dust, self.nu_ref)
        return sed.modified_blackbodies(
            nu, self.beta_dust, self.T_dust, self.E_dust, self.nu_ref, self.nu_pivot
        )


class AME(Component):
    """Anomalous microwave emission with the log-parabola law (`sed.ame_log_parabola`).

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix), its Q and U for a polarization
        fraction of 1; `from_dust_angles` makes one
    polarization_fraction : what Q and U are multiplied by; 1 for maps that are measured Q and U
    m60, nu_max : slope at 60 GHz and peak frequency in flux [GHz] (below 60)
    nu_ref : reference frequency [GHz]

    Raises
    ------
    TypeError, ValueError
        For units, wrong shapes, values that are not finite, frequencies that are not positive.
    """

    amplitude: Float[Array, "stokes pix"]
    polarization_fraction: Parameter
    m60: Parameter
    nu_max: Parameter
    nu_ref: Parameter

    def __init__(
        self, amplitude, polarization_fraction=1.0, m60=4.0, nu_max=19.0, nu_ref=23.0
    ) -> None:
        self.amplitude = self._amplitude(amplitude)
        self.polarization_fraction = self._parameter("polarization_fraction", polarization_fraction)
        self.m60 = self._parameter("m60", m60)
        self.nu_max = self._parameter("nu_max", nu_max, positive=True)
        self.nu_ref = self._parameter("nu_ref", nu_ref, positive=True)

    @classmethod
    def from_dust_angles(
        cls,
        intensity: ArrayLike,
        dust: ArrayLike,
        polarization_fraction: ArrayLike = 0.01,
        **parameters: ArrayLike,
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
        intensity, dust = as_array("intensity", intensity), cls._amplitude(dust)
        if intensity.shape != dust.shape[1:]:
            raise ValueError(
                f"Argument `intensity` must have shape {dust.shape[1:]} like a map of `dust`, "
                f"but has shape {intensity.shape}."
            )
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


class CMB(Component):
    """The CMB anisotropies: the derivative of a black body (`sed.cmb_derivative`).

    Parameters
    ----------
    amplitude : map in thermodynamic temperature [uK_CMB], shape (stokes, pix)
    T_cmb : temperature of the monopole [K]

    Raises
    ------
    TypeError, ValueError
        For units, wrong shapes, values that are not finite, a temperature that is not positive.
    """

    amplitude: Float[Array, "stokes pix"]
    T_cmb: Parameter

    def __init__(self, amplitude, T_cmb=T_CMB) -> None:
        self.amplitude = self._amplitude(amplitude)
        self.T_cmb = self._parameter("T_cmb", T_cmb, positive=True)

    def sed(self, nu):
        return sed.cmb_derivative(nu, self.T_cmb)
