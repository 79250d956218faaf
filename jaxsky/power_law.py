"""Power laws fitted to spectra."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsky.checks import check_positive


class PowerLaw(NamedTuple):
    """C_l = exp(log_amplitude) (l / pivot)^slope, with the covariance of the two numbers."""

    log_amplitude: Float[Array, ""]
    slope: Float[Array, ""]
    covariance: Float[Array, "2 2"]
    pivot: int

    def __call__(self, lmax: int) -> Float[Array, " ell"]:
        """C_l of l = 0 ... lmax, zero below l = 2."""
        ell = jnp.arange(lmax + 1)
        log = jnp.log(jnp.maximum(ell, 1) / self.pivot)
        return jnp.where(ell < 2, 0.0, jnp.exp(self.log_amplitude + self.slope * log))


def fit_power_law(spectrum: Float[Array, " ell"], lmin: int, lmax: int) -> PowerLaw:
    """Straight line through log C_l against log l by least squares, every l counting alike.

    The paper's fit; its errors come from the scatter about the line.

    Parameters
    ----------
    spectrum : C_l, l = 0 ...
    lmin, lmax : range of the fit, both included; lmax is the pivot of the result
    """
    if not 2 <= lmin <= lmax - 3 or lmax >= len(spectrum):
        raise ValueError(
            f"A power law cannot be fitted from l = {lmin} to {lmax} to a spectrum that ends at "
            f"{len(spectrum) - 1}; it needs four multipoles from l = 2 on."
        )
    part = spectrum[lmin : lmax + 1]
    check_positive("spectrum", part)
    log = jnp.log(jnp.arange(lmin, lmax + 1) / lmax)
    (slope, log_amplitude), covariance = jnp.polyfit(log, jnp.log(part), 1, cov=True)
    return PowerLaw(log_amplitude, slope, covariance[::-1, ::-1], lmax)
