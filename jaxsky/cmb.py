"""CMB power spectra from CAMB, Gaussian fields with given auto- and cross-spectra, the dipole."""

from functools import cache, partial
from importlib.metadata import version
from typing import Any, TypeAlias

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jaxsky.arrays import Alm, Scalar, StokesMaps
from jaxsky.checks import Numeric, as_number, check_choice, check_nside, is_concrete
from jaxsky.components import CMB, Component, KinematicQuadrupole
from jaxsky.harmonics import expand
from jaxsky.noise import cholesky, normal
from jaxsky.sed import T_CMB

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
#: Parameters that a cosmology may have instead of H0.
EXPANSION = {"cosmomc_theta", "thetastar"}
#: Arguments of `camb.set_params` that this module sets itself.
OWN = ("r", "lmax", "max_l_tensor", "max_eta_k_tensor", "WantScalars", "WantTensors")
#: Where the first pieces of spectra end. Each piece is a CAMB run with settings that do not depend
#: on the lmax asked for, so a multipole has one value; the next piece ends at twice that.
SCALARS_END, TENSORS_END = 1500, 3000


def camb_spectra(lmax: int, r: float = 0.0, **cosmology: float) -> Float[np.ndarray, "4 ell"]:
    """Return C_l of TT, EE, BB, TE [uK_CMB^2], l = 0 ... lmax: lensed scalars plus tensors.

    The cosmology consists of arguments of `camb.set_params` that replace or extend `PLANCK_2018`.
    The primordial spectra are power laws with pivot k = 0.05 / Mpc: scalars with its amplitude `As`
    and tilt `ns`, tensors with amplitude r `As`, r being the tensor-to-scalar ratio, and no tilt
    unless it sets `nt`. The spectra are therefore linear in r, with slope `tensor_spectra`. The
    value at a multipole does not depend on lmax.

    ValueError if lmax or r is negative, or CAMB rejects the cosmology.
    """
    if not (np.isfinite(r) and r >= 0):
        raise ValueError(f"Argument `r` must be a number from 0 on, but is {r}.")
    scalars = _joined(_scalars, SCALARS_END, lmax, cosmology)
    return scalars + r * tensor_spectra(lmax, **cosmology) if r else scalars


def tensor_spectra(lmax: int, **cosmology: float) -> Float[np.ndarray, "4 ell"]:
    """Return C_l of TT, EE, BB, TE of tensors with r = 1, not lensed; see `camb_spectra`."""
    return _joined(_tensors, TENSORS_END, lmax, cosmology)


def _joined(piece, end, lmax, cosmology):
    """Return spectra up to lmax, joined from pieces of which the first ends at `end`."""
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
    """Return lensed scalars up to l = end: BB within 0.2 % of CAMB at its highest accuracy."""
    # Lensing at l = end needs higher multipoles.
    lmax = end + 1000
    accuracy = {"lens_potential_accuracy": max(4.0, (lmax - 1500) / 500)} | cosmology
    return _spectra("get_lensed_scalar_cls", end, **accuracy, lmax=lmax)


@cache
def _tensors(end, **cosmology):
    """Return tensor spectra for r = 1 up to l = end: within 0.7 % up to l = 1000."""
    lmax = end + 500
    # With CAMB's default sampling in l, its interpolation is off by 2 % beyond l = 500.
    accuracy = {"nt": 0.0, "lSampleBoost": 2, "lAccuracyBoost": 2} | cosmology
    tensors = {"r": 1.0, "WantTensors": True, "WantScalars": False}
    ends = {"lmax": lmax, "max_l_tensor": lmax, "max_eta_k_tensor": 3 * lmax}
    return _spectra("get_tensor_cls", end, **accuracy, **tensors, **ends)


def _spectra(which: str, end: int, **arguments: Any) -> Float[np.ndarray, "4 ell"]:
    """Run CAMB up to l = end with arguments of `camb.set_params`, or take the cached result."""
    from jaxsky.io.files import kept  # jaxsky.io is slow to import, as CAMB is

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


@partial(jax.jit, static_argnames="stokes")
def realisation(key: Array, spectra: Float[Array | np.ndarray, "4 ell"], stokes: str = "QU") -> Alm:
    """Draw coefficients E, B ("QU") or I, E, B ("IQU") from C_l of TT, EE, BB, TE in any unit."""
    check_choice("stokes", stokes, ("QU", "IQU"))
    TT, EE, BB, TE = spectra
    zero = jnp.zeros_like(TT)
    fields = jnp.array([[TT, TE, zero], [TE, EE, zero], [zero, zero, BB]])
    return gaussian_fields(key, fields)[3 - len(stokes) :]


# Mutually correlated fields, after Brown & Battye (2011).

#: The auto- and cross-spectra C_l of fields.
Spectra: TypeAlias = Float[Array, "field field ell"]
#: Smallest eigenvalue of a repaired correlation matrix.
LEAST = 1e-10


@jax.custom_jvp
def _positive(matrix: Float[Array, "ell field field"]) -> tuple[Array, Float[Array, " ell"]]:
    """Raise the eigenvalues of symmetric matrices to `LEAST`; also return the smallest before."""
    values, vectors = jnp.linalg.eigh(matrix)
    kept = jnp.maximum(values, LEAST)
    return (vectors * kept[:, None]) @ vectors.mT, values[:, 0]


@_positive.defjvp
def _positive_jvp(primals, tangents):
    """Differentiate `_positive` by the formula of Daleckii & Krein."""
    # Eigenvectors have no derivative where eigenvalues coincide, as all do without correlations.
    values, vectors = jnp.linalg.eigh(primals[0])
    kept = jnp.maximum(values, LEAST)
    above = values > LEAST
    both, one = above[:, :, None] & above[:, None], above[:, :, None] != above[:, None]
    gap = jnp.where(one, values[:, :, None] - values[:, None], 1.0)
    slope = jnp.where(one, (kept[:, :, None] - kept[:, None]) / gap, both)
    turned = vectors.mT @ tangents[0] @ vectors
    return (
        ((vectors * kept[:, None]) @ vectors.mT, values[:, 0]),
        (vectors @ (slope * turned) @ vectors.mT, turned[:, 0, 0]),
    )


@jax.jit
def repair(spectra: Spectra) -> tuple[Spectra, Int[Array, ""]]:
    """Make the matrix of spectra positive semi-definite at each l; also count those that were not.

    Extrapolated cross-spectra may exceed what the auto-spectra allow. Such a matrix keeps its
    auto-spectra; the negative eigenvalues of its correlation matrix are raised to `LEAST`, and
    the diagonal is scaled back to one. No multipole is left out. Differentiable in the spectra.
    """
    n = len(spectra)
    power = jnp.diagonal(spectra).T  # (field, ell)
    scale = jnp.sqrt(jnp.where(power > 0, power, 1.0))
    there = (power[:, None] > 0) & (power[None] > 0)
    ones = jnp.eye(n, dtype=spectra.dtype)[..., None]
    matrix = jnp.where(there, spectra / (scale[:, None] * scale[None]), ones)
    mended, least = _positive(matrix.transpose(2, 0, 1))
    norm = jnp.sqrt(jnp.einsum("lii->li", mended))
    mended = (mended / (norm[:, :, None] * norm[:, None])).transpose(1, 2, 0)
    matrix = jnp.where(least < LEAST, mended, matrix)
    # A field without power has no correlations.
    matrix = jnp.where(there, matrix, 0.0)
    return matrix * scale[:, None] * scale[None], jnp.sum(least < -LEAST)


@jax.jit
def gaussian_fields(key: Array, spectra: Spectra) -> Float[Array, "field alm"]:
    """Draw coefficients of Gaussian fields of given spectra, positive semi-definite (`repair`)."""
    n, lmax = len(spectra), spectra.shape[-1] - 1
    lower = cholesky(spectra)
    white = normal(key, (n, (lmax + 1) ** 2), spectra.dtype)
    return jnp.stack([sum(expand(lower[i, j]) * white[j] for j in range(i + 1)) for i in range(n)])


@jax.jit
def speed_of_dipole(amplitude: Numeric, T_cmb: Numeric = T_CMB) -> Scalar:
    """Return the observer's v/c from the largest rise of temperature.

    From `amplitude` [uK_CMB], 3366.6 in Planck's last maps (Planck intermediate results LVII), and
    T_cmb [K]. The temperature towards the velocity is T_cmb sqrt[(1 + beta)/(1 - beta)].
    """
    ratio = jnp.square(1 + 1e-6 * amplitude / T_cmb)
    return (ratio - 1) / (ratio + 1)


def dipole(
    nside: int,
    beta: ArrayLike,
    longitude: ArrayLike = 263.986,
    latitude: ArrayLike = 48.247,
    *,
    T_cmb: ArrayLike = T_CMB,
    quadrupole: bool = False,
) -> dict[str, Component]:
    """Return what a moving observer adds to the CMB, as components "dipole", "quadrupole".

    Differentiable in speed, direction and temperature. With mu the cosine of the angle to the
    velocity, the temperature is T_cmb / [gamma (1 - beta mu)]. To first order in the anisotropy
    that is one map with the law of the CMB. With `quadrupole` it is, as in PySM's model dip2, to
    second order in beta: T_cmb beta mu with that law, and T_cmb beta^2 mu^2 with that of
    `KinematicQuadrupole`.

    Parameters
    ----------
    nside : resolution of the maps, RING order, Galactic coordinates
    beta : speed v/c, between -1 and 1; see `speed_of_dipole`
    longitude, latitude : Galactic direction of the velocity [deg]; by default the Sun's by Planck
        (Planck intermediate results LVII)
    T_cmb : temperature of the monopole [K]
    quadrupole : whether to return two components

    Raises
    ------
    TypeError, ValueError
        For values that are no numbers, an nside that is no power of 2, or a speed that is not
        below that of light.

    Examples
    --------
    >>> sky = dipole(4, speed_of_dipole(3366.6))
    >>> round(float(sky["dipole"].amplitude.max() / 3366.6), 2)
    0.99
    """
    check_nside("nside", nside)
    beta, T_cmb = as_number("beta", beta), as_number("T_cmb", T_cmb, positive=True)
    if is_concrete(beta) and not abs(float(beta)) < 1:
        raise ValueError(f"Argument `beta` must be between -1 and 1, but is {float(beta):g}.")
    direction = as_number("longitude", longitude), as_number("latitude", latitude)
    pixels = np.stack(healpy.pix2vec(nside, np.arange(12 * nside**2)))
    first, exact, second = _temperatures(pixels, beta, *direction, T_cmb)
    if not quadrupole:
        return {"dipole": CMB(exact, T_cmb)}
    return {"dipole": CMB(first, T_cmb), "quadrupole": KinematicQuadrupole(second, T_cmb)}


@jax.jit
def _temperatures(
    pixels: Array, beta: Scalar, longitude: Scalar, latitude: Scalar, T_cmb: Scalar
) -> tuple[StokesMaps, StokesMaps, StokesMaps]:
    """Return the first order in the speed, all orders, and the second: I, Q, U [uK_CMB]."""
    lon, lat = jnp.deg2rad(longitude), jnp.deg2rad(latitude)
    x, y, z = pixels
    along = jnp.cos(lat) * (jnp.cos(lon) * x + jnp.sin(lon) * y) + jnp.sin(lat) * z
    motion = beta * along
    # sqrt(1 - beta^2)/(1 - beta mu) - 1 without the cancellation of a small speed.
    root = jnp.sqrt(1 - beta**2)
    all_orders = (motion - beta**2 / (1 + root)) / (1 - motion)
    rows = [1e6 * T_cmb * one for one in (motion, all_orders, motion**2)]
    first, exact, second = (jnp.stack([row, 0 * row, 0 * row]) for row in rows)
    return first, exact, second
