"""The CMB: power spectra from CAMB, and realisations of them."""

from functools import cache, partial
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky import correlated

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

#: What stands for H0 in a cosmology.
EXPANSION = {"cosmomc_theta", "thetastar"}
#: What this module gives to `camb.set_params` itself.
OWN = ("r", "lmax", "max_l_tensor", "max_eta_k_tensor", "WantScalars", "WantTensors")
#: Where the first pieces of spectra end. Each piece is a run of its own with the same settings
#: whatever is asked for, so a multipole has one value; the next piece ends at twice that.
SCALARS_END, TENSORS_END = 1500, 3000


def camb_spectra(lmax: int, r: float = 0.0, **cosmology: float) -> Float[np.ndarray, "4 ell"]:
    """Spectra C_l of TT, EE, BB, TE [uK_CMB^2], l = 0 ... lmax: lensed scalars, and r tensors.

    The primordial spectra are power laws about k = 0.05 / Mpc: that of scalars with the
    amplitude `As` and the tilt `ns` of the cosmology, that of tensors with r `As` and no tilt,
    unless the cosmology has another, `nt`. So the spectra are linear in r, with `tensor_spectra`
    as the slope. A multipole has the same value whatever lmax is.

    Parameters
    ----------
    lmax : largest multipole
    r : tensor-to-scalar ratio at k = 0.05 / Mpc
    **cosmology : of `camb.set_params`, in place of those in `PLANCK_2018`

    Raises
    ------
    ValueError
        If lmax or r are negative, or CAMB does not take the cosmology.
    """
    if not (np.isfinite(r) and r >= 0):
        raise ValueError(f"Argument `r` must be a number from 0 on, but is {r}.")
    scalars = _joined(_scalars, SCALARS_END, lmax, cosmology)
    return scalars + r * tensor_spectra(lmax, **cosmology) if r else scalars


def tensor_spectra(lmax: int, **cosmology: float) -> Float[np.ndarray, "4 ell"]:
    """Spectra C_l of TT, EE, BB, TE of tensors with r = 1 [uK_CMB^2], l = 0 ... lmax.

    For another r they are these times r. They are not lensed. See `camb_spectra` for their
    primordial spectrum.

    Parameters
    ----------
    lmax : largest multipole
    **cosmology : of `camb.set_params`, in place of those in `PLANCK_2018`
    """
    return _joined(_tensors, TENSORS_END, lmax, cosmology)


def _joined(piece, end, lmax, cosmology):
    """Spectra up to lmax from pieces, the first of which ends at `end`."""
    if lmax < 0:
        raise ValueError(f"Argument `lmax` must not be negative, but is {lmax}.")
    for name, value in cosmology.items():
        if name in OWN:
            raise ValueError(f"{name!r} is no parameter of the cosmology.")
        if name in PLANCK_2018 and name != "omk" and not value >= 0:
            raise ValueError(f"Parameter {name!r} of the cosmology is {value}, which is negative.")
    known = {n: v for n, v in PLANCK_2018.items() if n != "H0" or not EXPANSION & set(cosmology)}
    pieces, begin = [], 0
    while begin <= lmax:
        pieces.append(piece(end, **(known | cosmology))[:, begin : lmax + 1])
        begin, end = end + 1, 2 * end
    return np.concatenate(pieces, axis=1)


@cache
def _scalars(end, **cosmology):
    """Lensed scalars up to l = end: BB within 0.2 % of CAMB at its highest accuracy."""
    # The lensing of l = end needs higher multipoles.
    lmax = end + 1000
    accuracy = {"lens_potential_accuracy": max(4.0, (lmax - 1500) / 500)} | cosmology
    return _spectra("get_lensed_scalar_cls", end, **accuracy, lmax=lmax)


@cache
def _tensors(end, **cosmology):
    """Tensors with r = 1 up to l = end: within 0.7 % up to l = 1000."""
    lmax = end + 500
    # Between too few multipoles, CAMB's interpolation is off by 2 % beyond l = 500.
    accuracy = {"nt": 0.0, "lSampleBoost": 2, "lAccuracyBoost": 2} | cosmology
    return _spectra(
        "get_tensor_cls",
        end,
        **accuracy,
        r=1.0,
        WantTensors=True,
        WantScalars=False,
        lmax=lmax,
        max_l_tensor=lmax,
        max_eta_k_tensor=3 * lmax,
    )


def _spectra(which: str, end: int, **arguments: Any) -> Float[np.ndarray, "4 ell"]:
    """What CAMB computes up to l = end for arguments of `camb.set_params`, once and for all."""
    from jaxsky.io.folders import kept  # the border is slow to import, as CAMB is

    def computed() -> np.ndarray:
        import camb

        try:
            results = camb.get_results(camb.set_params(**arguments))
        except (camb.CAMBError, camb.CAMBFortranError, TypeError, ValueError) as error:
            said = " ".join(str(error).split())
            raise ValueError(f"CAMB does not take the cosmology: {said}") from None
        return np.asarray(getattr(results, which)(end, CMB_unit="muK", raw_cl=True).T)

    mark = (version("camb"), which, end, sorted(arguments.items()))
    return kept("spectra", mark, (4, end + 1), computed)


def realisation(
    key: Array, spectra: Float[Array | np.ndarray, "4 ell"], stokes: str = "QU"
) -> Float[Array, "stokes alm"]:
    """Packed coefficients (E, B or I, E, B) of a Gaussian realisation of spectra.

    Parameters
    ----------
    key : of jax.random
    spectra : C_l of TT, EE, BB, TE, in any unit squared
    stokes : "QU" or "IQU"
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
