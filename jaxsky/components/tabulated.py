"""Components whose law is a table of numbers: emissivities of dust grains from other codes."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.arrays import StokesMaps
from jaxsky.checks import Parameter, as_array, check_positive, check_shape, is_concrete
from jaxsky.components.base import Component, parameter, reference, table, template


def _check_increasing(name: str, what: str, values: Float[Array, " row"]) -> None:
    if is_concrete(values) and not np.all(np.diff(values) > 0):
        raise ValueError(f"Argument `{name}` has {what} that do not increase strictly.")


class SpinningDust(Component, law="spinning_dust"):
    """Spinning dust: an emissivity j(nu), stretched in frequency so that it peaks at nu_peak.

    T(nu)/T(nu_ref) = (nu/nu_ref)^-2 j(nu s)/j(nu_ref s) with s = nu_table/nu_peak: the law of
    PySM's models a1 and a2 (Thorne et al. 2017), whose table is SPDUST2's for a cold neutral medium
    (Ali-Haimoud et al. 2009, Silsbee et al. 2011). Between rows j is linear in nu, as in PySM, so
    derivatives have steps at rows; beyond the first and last one it is constant.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    emissivity : table (row, 2) of frequencies [GHz], strictly increasing, and j_nu in any unit of
        brightness, both positive
    nu_peak : frequency of the peak [GHz]
    nu_table : frequency of the table that comes to lie at nu_peak [GHz], 30 in PySM; by default
        that of its largest j
    nu_ref : reference frequency [GHz]

    Raises
    ------
    TypeError, ValueError
        As for any `Component`, and for a table that is not as said above.

    Examples
    --------
    >>> import numpy as np
    >>> nu = np.geomspace(1.0, 500.0, 200)
    >>> table = np.stack([nu, np.exp(-np.log(nu / 30) ** 2)], axis=1)
    >>> dust = SpinningDust(np.ones((2, 12)), table, nu_peak=30.0, nu_table=30.0)
    >>> round(float(dust.sed(40.0)), 4)
    0.3275
    """

    amplitude: StokesMaps = template()
    emissivity: Float[Array, "row 2 1"] = table("frequencies [GHz] and emissivities")
    nu_peak: Parameter = parameter(
        30.0, positive=True, symbol=r"\nu_{\rm peak}", unit="GHz", zero=False
    )
    nu_table: Parameter | None = parameter(
        None, positive=True, symbol=r"\nu_{\rm table}", unit="GHz"
    )
    nu_ref: Parameter = reference(22.8, within=(0.01, 1e3))

    def __check_init__(self) -> None:
        if self.emissivity is None:
            return  # the base class says so
        found = as_array("emissivity", self.emissivity)
        good = found.ndim == 3 and found.shape[1:] == (2, 1) and len(found) > 1
        form = "be a table (row, 2) of frequencies [GHz] and emissivities"
        check_shape("emissivity", found, good, form)
        check_positive("emissivity", found)
        _check_increasing("emissivity", "frequencies in its first column", found[:, 0, 0])

    def sed(self, nu: Any):
        frequencies, values = self.emissivity[..., 0].T
        own = frequencies[jnp.argmax(values)] if self.nu_table is None else self.nu_table
        stretch = own / self.nu_peak

        def emissivity(nu):
            return jnp.interp(nu * stretch, frequencies, values)

        return (self.nu_ref / nu) ** 2 * emissivity(nu) / emissivity(self.nu_ref)
