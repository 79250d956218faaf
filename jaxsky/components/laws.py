"""The components with closed forms: dust, synchrotron, AME, free-free, the CMB, the SZ effect."""

from typing import Any, ClassVar, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxsky import sed
from jaxsky.arrays import StokesMaps
from jaxsky.bandpass import response_at
from jaxsky.checks import Numeric, Parameter, as_array, check_shape, is_concrete
from jaxsky.components.base import Component, parameter, reference, template
from jaxsky.sed import T_CMB

#: Zero of x coth(x/2) - 4, where the thermal SZ effect vanishes: 217.5 GHz.
SZ_ZERO: Final = 3.830016096


class Dust(Component, law="dust"):
    """Thermal dust: one modified black body, or a sum of them given as tuples.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    beta_dust, T_dust : index and temperature [K], or tuples of them with one entry per body;
        the paper's baseline is 1.53 and 21 K
    E_dust : tuple of relative amplitudes, only for several bodies (`sed.modified_blackbodies`)
    nu_ref : reference frequency [GHz]
    nu_pivot : pivot of the emissivities [GHz], only for several bodies; default 3000

    Raises
    ------
    TypeError, ValueError
        As for any `Component`, and for tuples of different lengths.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> maps = jnp.ones((2, 12))
    >>> two = Dust(maps, beta_dust=(1.67, 2.70), T_dust=(9.4, 16.2), E_dust=(0.49, 1.0))
    >>> round(float(two.sed(353.0)), 6)
    1.0
    """

    amplitude: StokesMaps = template()
    beta_dust: Parameter | tuple[Parameter, ...] = parameter(
        1.53, symbol=r"\beta_{\rm dust}", zero=False
    )
    T_dust: Parameter | tuple[Parameter, ...] = parameter(
        21.0, positive=True, symbol=r"T_{\rm dust}", unit="K", zero=False
    )
    E_dust: tuple[Parameter, ...] | None = parameter(None, symbol=r"E_{\rm dust}")
    nu_ref: Parameter = reference(353.0, within=(1.0, 2e4))
    nu_pivot: Parameter | None = parameter(
        None, positive=True, symbol=r"\nu_{\rm pivot}", unit="GHz"
    )

    def __post_init__(self) -> None:
        if isinstance(self.beta_dust, tuple) and self.nu_pivot is None:
            self.nu_pivot = 3000.0

    def __check_init__(self) -> None:
        if not isinstance(self.beta_dust, tuple):
            for name in ("E_dust", "nu_pivot"):
                if getattr(self, name) is not None:
                    raise ValueError(
                        f"Argument `{name}` has no effect with a single body; give `beta_dust`, "
                        "`T_dust` and `E_dust` as tuples for several."
                    )
        bodies = (self.beta_dust, self.T_dust, self.E_dust)
        lengths = [len(v) if isinstance(v, tuple) else None for v in bodies]
        if len(set(lengths)) > 1 or lengths[0] == 0:
            raise ValueError(
                "Arguments `beta_dust`, `T_dust` and `E_dust` must be tuples with one entry a "
                f"body, but have lengths {lengths}."
            )

    def sed(self, nu):
        if self.E_dust is None:
            return sed.modified_blackbody(nu, self.beta_dust, self.T_dust, self.nu_ref)
        return sed.modified_blackbodies(
            nu, self.beta_dust, self.T_dust, self.E_dust, self.nu_ref, self.nu_pivot
        )


class Synchrotron(Component, law="synchrotron"):
    """Synchrotron: a power law, or one with curvature (`sed.curved_power_law`).

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    beta_syn : spectral index, T ~ nu^-beta_syn; the paper's baseline is 3.10
    curvature : C of the paper, 0 for a pure power law
    nu_piv : pivot frequency of the curvature [GHz]
    nu_ref : reference frequency [GHz]
    """

    amplitude: StokesMaps = template()
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


class AME(Component, law="ame"):
    """Anomalous microwave emission with the log-parabola law (`sed.ame_log_parabola`).

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix), with Q and U for a polarization
        fraction of 1; see `from_dust_angles`
    polarization_fraction : factor on Q and U; 1 for measured maps of Q and U
    m60, nu_max : minus the slope of ln S at 60 GHz, and the peak frequency of S [GHz] (below 60)
    nu_ref : reference frequency [GHz]
    """

    amplitude: StokesMaps = template()
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
        """Return AME polarized along the dust: Q, U = f T (cos, sin)(2 chi), the paper's eq. 5.

        From its intensity T [uK_RJ], shape (pix,), maps of dust, Q, U or I, Q, U in any unit, shape
        (stokes, pix), and f, 1 % in the paper. The Stokes parameters are those of the dust; where
        that is unpolarized, so is the AME. Further parameters are those of the class.
        """
        intensity, dust = as_array("intensity", intensity), as_array("dust", dust)
        good = dust.ndim == 2 and len(dust) in (2, 3)
        check_shape("dust", dust, good, "have shape (stokes, pix) with Stokes Q, U or I, Q, U")
        form = f"have shape {dust.shape[1:]} like a map of `dust`"
        check_shape("intensity", intensity, intensity.shape == dust.shape[1:], form)
        Q, U = dust[-2:]
        P = jnp.hypot(Q, U)
        polarized = intensity * dust[-2:] / jnp.where(P > 0, P, 1.0)
        amplitude = polarized if len(dust) == 2 else jnp.concatenate([intensity[None], polarized])
        return cls(amplitude, polarization_fraction, **parameters)

    @property
    def template(self):
        maps = super().template
        if len(maps) == 1:
            return maps
        return jnp.concatenate([maps[:-2], maps[-2:] * self.polarization_fraction])

    def sed(self, nu):
        return sed.ame_log_parabola(nu, self.m60, self.nu_max, self.nu_ref)


def _emissivity(nu: Numeric, T_e: Numeric) -> Float[Array, "..."]:
    """Return nu^-2 T_e^-1/2 times the Gaunt factor of Draine (2011), eq. 10.9, with nu in GHz."""
    falling = jnp.exp(5.960 - jnp.sqrt(3) / jnp.pi * jnp.log(nu * (T_e / 1e4) ** -1.5))
    return jnp.log(falling + jnp.e) / (jnp.sqrt(T_e) * nu**2)


@jax.jit
def amplitude_from_emission_measure(EM: Numeric, T_e: Numeric, nu_ref: Numeric) -> Array:
    """Return the antenna temperature of optically thin free-free emission [uK_RJ].

    The optical depth of Draine (2011) is 0.05468 T_e^-3/2 nu^-2 EM g_ff, with T_e in K, nu in GHz
    and the emission measure EM in cm^-6 pc. Multiplied by T_e it is the temperature (Planck 2015
    results X, table 4, to first order in the depth).
    """
    return jnp.asarray(1e6 * 0.05468 * EM * _emissivity(nu_ref, T_e))


class FreeFree(Component, law="free_free"):
    """Free-free emission, optically thin, with the Gaunt factor of Draine (2011), eq. 10.9.

    (nu/nu_ref)^-2 g_ff(nu, T_e) / g_ff(nu_ref, T_e), with
    g_ff = ln{exp[5.960 - sqrt(3)/pi ln(nu/GHz (T_e/10^4 K)^-3/2)] + e}. It is not polarized.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], I, shape (1, pix), or I, Q, U with zeros in Q and U;
        `amplitude_from_emission_measure` gives the map of I
    T_e : electron temperature [K]
    nu_ref : reference frequency [GHz]
    """

    polarized: ClassVar[bool] = False
    amplitude_from: ClassVar = {"pc / cm6": amplitude_from_emission_measure}

    amplitude: StokesMaps = template()
    T_e: Parameter = parameter(7000.0, positive=True, symbol=r"T_{\rm e}", unit="K", zero=False)
    nu_ref: Parameter = reference(30.0, within=(0.01, 1e3))

    def sed(self, nu):
        return _emissivity(nu, self.T_e) / _emissivity(self.nu_ref, self.T_e)


class CMB(Component, law="cmb"):
    """CMB anisotropies, with the derivative of a black body as law (`sed.cmb_derivative`).

    Parameters
    ----------
    amplitude : maps in thermodynamic temperature [uK_CMB], shape (stokes, pix)
    T_cmb : temperature of the monopole [K]
    """

    unit: ClassVar[str] = "uK_CMB"

    amplitude: StokesMaps = template()
    T_cmb: Parameter = parameter(T_CMB, positive=True, symbol=r"T_{\rm CMB}", unit="K", zero=False)

    def sed(self, nu):
        return sed.cmb_derivative(nu, self.T_cmb)


@jax.jit
def amplitude_from_compton(y: Numeric, nu_ref: Numeric, T_cmb: Numeric = T_CMB) -> Array:
    """Return the antenna temperature of the thermal SZ effect [uK_RJ] at nu_ref [GHz].

    From Compton y, a number or an array; T_cmb in K. See `sed.thermal_sz`.
    """
    return jnp.asarray(1e6 * y * sed.thermal_sz(nu_ref, T_cmb))


class ThermalSZ(Component, law="sz"):
    """Thermal Sunyaev-Zeldovich effect, without relativistic corrections (`sed.thermal_sz`).

    As for other laws the amplitude is in uK_RJ at nu_ref, and the law relative to that, so it is
    negative on the other side of 217 GHz, and any frequency may be observed, 217 GHz included. A
    map of Compton y becomes an amplitude by `amplitude_from_compton`. It is not polarized.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], I, Q, U with zeros in Q and U, shape (3, pix); negative
        where y is positive if nu_ref is below 217 GHz
    T_cmb : temperature of the monopole [K]
    nu_ref : reference frequency [GHz]; ValueError within 2 GHz of the zero of the law
    """

    polarized: ClassVar[bool] = False
    amplitude_from: ClassVar = {"": amplitude_from_compton}

    amplitude: StokesMaps = template()
    T_cmb: Parameter = parameter(T_CMB, positive=True, symbol=r"T_{\rm CMB}", unit="K", zero=False)
    nu_ref: Parameter = reference(100.0, within=(0.01, 2e3))

    def __check_init__(self) -> None:
        nu_ref, T_cmb = as_array("nu_ref", self.nu_ref), as_array("T_cmb", self.T_cmb)
        if not (is_concrete(nu_ref) and is_concrete(T_cmb)):
            return
        zero = float(SZ_ZERO * T_cmb.mean() / sed.H_OVER_K)
        if bool(jnp.any(jnp.abs(nu_ref - zero) < 2)):
            raise ValueError(
                f"Argument `nu_ref` must be at least 2 GHz from {zero:.4g} GHz, where the law is "
                f"zero, but is {float(nu_ref.mean()):g}."
            )

    def sed(self, nu):
        return sed.thermal_sz(nu, self.T_cmb) / sed.thermal_sz(self.nu_ref, self.T_cmb)


class KinematicQuadrupole(Component, law="kinematic_quadrupole"):
    """Second order in the observer's velocity, with its own law (Kamionkowski & Knox 2003).

    The law is (x/2) coth(x/2) times that of CMB anisotropies, x = h nu / k T_cmb: 1 K_RJ/K_CMB at
    long wavelengths. It is not polarized.

    Parameters
    ----------
    amplitude : T_cmb beta^2 mu^2 [uK_CMB], I, Q, U with zeros in Q and U, shape (3, pix); mu is the
        cosine of the angle to the velocity (`dipole`)
    T_cmb : temperature of the monopole [K]
    """

    polarized: ClassVar[bool] = False
    unit: ClassVar[str] = "uK_CMB"

    amplitude: StokesMaps = template()
    T_cmb: Parameter = parameter(T_CMB, positive=True, symbol=r"T_{\rm CMB}", unit="K", zero=False)

    def sed(self, nu):
        x = sed.H_OVER_K * nu / self.T_cmb
        return x / 2 / jnp.tanh(x / 2) * sed.cmb_derivative(nu, self.T_cmb)


@jax.jit
def amplitude_from_line_intensity(W: Numeric, nu_ref: Numeric) -> Array:
    """Return the amplitude of `LineEmission` [uK_RJ] from the integral of a line over velocity.

    W is in K_RJ km/s, nu_ref in GHz: int T dnu = nu_ref / c int T dv, divided by 1 GHz.
    """
    return jnp.asarray(1e6 * W * nu_ref / 299792.458)


class LineEmission(Component, law="line"):
    """An emission line that is narrow compared with bands, such as those of CO.

    A band sees the response at the line, relative to the integral of the response: W(nu_ref) /
    int W dnu (`jaxsky.bandpass.response_at`), so it has to have a width; one of a single frequency
    sees nothing. Rotational lines of CO lie at 115.271, 230.538 and 345.796 GHz.

    Parameters
    ----------
    amplitude : antenna temperature in a top-hat of 1 GHz that holds the line [uK_RJ], shape
        (stokes, pix); see `amplitude_from_line_intensity`. PySM's maps of CO, in K_CMB, are that,
        converted at the frequency of the line.
    nu_ref : frequency of the line [GHz]
    """

    smooth: ClassVar[bool] = False
    amplitude_from: ClassVar = {"K km / s": amplitude_from_line_intensity}

    amplitude: StokesMaps = template()
    nu_ref: Parameter = reference(115.271, within=(0.01, 2e4))

    def sed(self, nu):
        raise ValueError("A line has no law at one frequency; average it over a band with a width.")

    def band_average(self, band):
        return response_at(self.nu_ref, band)
