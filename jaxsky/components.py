"""Components of the sky: template maps times a spectral law.

A component is its parameters. Each spectral parameter is a number or a map of shape (pix,); the
law is written once, for a frequency, in `sed`, and everything else (band averages, gradients,
parameter names) follows from the fields.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky import sed
from jaxsky.checks import as_array, check_finite, check_positive, is_concrete
from jaxsky.constants import T_CMB
from jaxsky.types import Parameter

__all__ = ["AME", "CMB", "Component", "Dust", "Synchrotron", "parameter", "template"]


def template() -> Any:
    """Field of a component for its amplitude, (stokes, pix)."""
    return eqx.field(converter=_converted)


def parameter(
    default: Any = dataclasses.MISSING,
    *,
    positive: bool = False,
    within: tuple[float, float] | None = None,
    hint: str = "",
) -> Any:
    """Field of a component for a spectral parameter: a number, or a map of shape (pix,).

    Parameters
    ----------
    default : value if none is given; without, the parameter is required
    positive : refuse values that are not positive
    within : refuse a number, or a map by its median, outside of this range
    hint : what to do about that
    """
    metadata = {"positive": positive, "within": within, "hint": hint}
    if default is dataclasses.MISSING:
        return eqx.field(converter=_converted, metadata=metadata)
    return eqx.field(converter=_converted, metadata=metadata, default=default)


def _converted(value: Any) -> Any:
    """An array, or several in a tuple; what cannot be one is left for the check by name."""
    if value is None or isinstance(value, tuple):
        return value and tuple(map(_converted, value))
    try:
        return as_array("value", value)
    except TypeError:
        return value


class Component(eqx.Module):
    """Base class: `amplitude` (stokes, pix) times `sed(nu)`.

    Stokes parameters are I, Q, U (3 rows) or Q, U (2 rows), in uK_RJ at the component's
    reference frequency, HEALPix RING order, Galactic coordinates, COSMO sign of U.

    A subclass declares its fields with `template` and `parameter`, and writes `sed`.

    Raises
    ------
    TypeError, ValueError
        On construction, for units, wrong shapes, values that are not finite, or not positive
        where they have to be; for a beta_syn with the other sign, and a nu_ref that is not in GHz.

    Examples
    --------
    >>> class FreeFree(Component):
    ...     amplitude: Array = template()
    ...     beta_ff: Array = parameter(2.13)
    ...     nu_ref: Array = parameter(30.0, positive=True)
    ...
    ...     def sed(self, nu):
    ...         return sed.power_law(nu, self.beta_ff, self.nu_ref)
    >>> round(float(FreeFree(jnp.ones((2, 12))).sed(60.0)), 4)
    0.2285
    """

    amplitude: eqx.AbstractVar[Float[Array, "stokes pix"]]

    def sed(self, nu: ArrayLike) -> Float[Array, ""] | Float[Array, " pix"]:
        """The spectral law at one frequency [GHz]; a map if any parameter is one."""
        raise TypeError(f"{type(self).__name__} must define `sed`.")

    @property
    def template(self) -> Float[Array, "stokes pix"]:
        """What the law multiplies; the amplitude, unless parameters other than spectral act."""
        return self.amplitude

    def __check_init__(self) -> None:
        amplitude = as_array("amplitude", self.amplitude)
        if amplitude.ndim != 2 or amplitude.shape[0] not in (2, 3):
            raise ValueError(
                "Argument `amplitude` must have shape (stokes, pix) with Stokes Q, U or I, Q, U, "
                f"but has shape {amplitude.shape}."
            )
        check_finite("amplitude", amplitude)
        for field in dataclasses.fields(self):
            if field.name == "amplitude" or field.metadata.get("static"):
                continue
            value = getattr(self, field.name)
            for entry in value if isinstance(value, tuple) else (value,):
                if entry is not None:
                    _check(field.name, entry, amplitude.shape[-1], field.metadata)


def _check(name: str, value: object, npix: int, metadata: Any) -> None:
    array = as_array(name, value)
    if array.shape not in ((), (npix,)):
        raise ValueError(
            f"Argument `{name}` must be a number or a map of shape ({npix},), "
            f"but has shape {array.shape}."
        )
    if "positive" not in metadata:
        raise TypeError(f"Field `{name}` must be declared with jaxsky.components.parameter.")
    _check_value(name, array, metadata)


def _check_value(name: str, value: Array, metadata: Any) -> None:
    (check_positive if metadata.get("positive") else check_finite)(name, value)
    within = metadata.get("within")
    if within is None or not is_concrete(value):
        return
    (low, high), middle = within, float(np.median(value))
    if not low <= middle <= high:
        what = "is" if value.ndim == 0 else "its median is"
        raise ValueError(
            f"Argument `{name}` must be from {low:g} to {high:g}, but {what} {middle:g}; "
            f"{metadata['hint']}."
        )


def is_positive(component: type[Component], field: str) -> bool:
    """True if a field of a component is declared to be positive."""
    declared = {f.name: f.metadata for f in dataclasses.fields(component)}
    return bool(declared[field].get("positive"))


def check_value(component: type[Component], field: str, name: str, value: Array) -> None:
    """Raise ValueError if a concrete value, called `name`, is none that a field may have."""
    declared = {f.name: f.metadata for f in dataclasses.fields(component)}
    _check_value(name, value, declared[field])


#: Where the reference frequency of a law may lie [GHz].
REFERENCES = {"dust": (1.0, 2e4), "synchrotron": (0.01, 1e3), "ame": (0.01, 1e3)}


def _reference(default: float, law: str) -> Any:
    """Field for the reference frequency of a law [GHz]."""
    return parameter(default, positive=True, within=REFERENCES[law], hint="it has to be in GHz")


class Synchrotron(Component):
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
        hint="T ~ nu^-beta_syn, so jaxsky.presets.from_pysm_beta makes 3.1 of an index of -3.1",
    )
    curvature: Parameter = parameter(0.0)
    nu_piv: Parameter = parameter(23.0, positive=True)
    nu_ref: Parameter = _reference(30.0, "synchrotron")

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
    ValueError
        For tuples of different lengths, E_dust or nu_pivot with a single body, and what
        `Component` refuses.

    Examples
    --------
    >>> maps = jnp.ones((2, 12))
    >>> Dust(maps, beta_dust=(1.67, 2.70), T_dust=(9.4, 16.2), E_dust=(0.49, 1.0)).bodies
    2
    """

    amplitude: Float[Array, "stokes pix"] = template()
    beta_dust: Parameter | tuple[Parameter, ...] = parameter(1.53)
    T_dust: Parameter | tuple[Parameter, ...] = parameter(21.0, positive=True)
    E_dust: tuple[Parameter, ...] | None = parameter(None)
    nu_ref: Parameter = _reference(353.0, "dust")
    nu_pivot: Parameter | None = parameter(None, positive=True)

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
    """

    amplitude: Float[Array, "stokes pix"] = template()
    polarization_fraction: Parameter = parameter(1.0)
    m60: Parameter = parameter(4.0)
    nu_max: Parameter = parameter(19.0, positive=True)
    nu_ref: Parameter = _reference(23.0, "ame")

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
    """

    amplitude: Float[Array, "stokes pix"] = template()
    T_cmb: Parameter = parameter(T_CMB, positive=True)

    def sed(self, nu):
        return sed.cmb_derivative(nu, self.T_cmb)
