"""Thermal dust."""

from jaxtyping import Array, Float

from jaxsky import sed
from jaxsky.checks import Parameter
from jaxsky.components.base import Component, parameter, reference, template


class Dust(Component, law="dust"):
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
    >>> import jax.numpy as jnp
    >>> maps = jnp.ones((2, 12))
    >>> Dust(maps, beta_dust=(1.67, 2.70), T_dust=(9.4, 16.2), E_dust=(0.49, 1.0)).bodies
    2
    """

    amplitude: Float[Array, "stokes pix"] = template()
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
