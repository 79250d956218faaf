"""The CMB: power spectra from CAMB, and realisations of them."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky import correlated

__all__ = ["PLANCK_2018", "camb_spectra", "realisation", "tensor_spectra"]

#: Planck 2018 results VI, TT,TE,EE+lowE+lensing; arguments of `camb.set_params`.
PLANCK_2018 = {
    "H0": 67.36,
    "ombh2": 0.02237,
    "omch2": 0.1200,
    "mnu": 0.06,
    "omk": 0.0,
    "tau": 0.0544,
    "As": 2.1e-9,
    "ns": 0.9649,
}


@cache
def camb_spectra(lmax: int, r: float = 0.0, **cosmology: float) -> Float[np.ndarray, "4 ell"]:
    """Lensed spectra C_l of TT, EE, BB, TE with tensors [uK_CMB^2], l = 0 ... lmax.

    Parameters
    ----------
    lmax : largest multipole
    r : tensor-to-scalar ratio
    **cosmology : of `camb.set_params`, instead of `PLANCK_2018`

    Raises
    ------
    ValueError
        If r is negative.
    """
    if r < 0:
        raise ValueError(f"Argument `r` must not be negative, but is {r}.")
    import camb  # takes as long to import as a small simulation takes

    # The lensing of l = lmax needs higher multipoles, and CAMB some for its interpolation.
    params = camb.set_params(
        **(cosmology or PLANCK_2018), r=r, WantTensors=r > 0, lmax=max(lmax + 500, 1000)
    )
    results = camb.get_results(params)
    return np.asarray(results.get_total_cls(lmax, CMB_unit="muK", raw_cl=True)).T


@cache
def tensor_spectra(lmax: int, **cosmology: float) -> Float[np.ndarray, "4 ell"]:
    """Spectra C_l of TT, EE, BB, TE of tensors with r = 1 [uK_CMB^2], l = 0 ... lmax.

    Their primordial spectrum has no tilt, so for another r they are these times r. They are not
    lensed.

    Parameters
    ----------
    lmax : largest multipole
    **cosmology : of `camb.set_params`, instead of `PLANCK_2018`
    """
    import camb

    lowest = max(lmax, 600)  # CAMB's own
    params = camb.set_params(
        **(cosmology or PLANCK_2018),
        r=1.0,
        nt=0.0,
        WantTensors=True,
        WantScalars=False,
        lmax=lowest,
        max_l_tensor=lowest,
        max_eta_k_tensor=2.5 * lowest,
    )
    results = camb.get_results(params)
    return np.asarray(results.get_tensor_cls(lmax, CMB_unit="muK", raw_cl=True)).T


def realisation(
    key: Array, spectra: Float[Array | np.ndarray, "4 ell"], stokes: str = "QU"
) -> Float[Array, "stokes alm"]:
    """Packed coefficients (E, B or I, E, B) of a Gaussian realisation of spectra.

    Parameters
    ----------
    key : of jax.random
    spectra : C_l of TT, EE, BB, TE, in any unit squared
    stokes : "QU" or "IQU"

    Raises
    ------
    ValueError
        If `stokes` is neither.
    """
    if stokes not in ("QU", "IQU"):
        raise ValueError(f"Argument `stokes` must be 'QU' or 'IQU', not {stokes!r}.")
    return _realisation(key, spectra, stokes)


@partial(jax.jit, static_argnames="stokes")
def _realisation(key, spectra, stokes):
    TT, EE, BB, TE = spectra
    zero = jnp.zeros_like(TT)
    rows = [TT, TE, zero], [TE, EE, zero], [zero, zero, BB]
    fields = jnp.stack([jnp.stack(row) for row in rows])
    return correlated.realisation(key, fields)[3 - len(stokes) :]
