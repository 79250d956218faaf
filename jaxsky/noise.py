"""Keys of random numbers, and white noise of maps: draw it, estimate it, build its covariance.

A key follows from the seed, the number of a realisation, a kind and a name. Noise keeps the form in
which it was given until pixels are needed: a uniform level [u arcmin], where u is the unit of the
maps, or the covariance of the Stokes parameters in each pixel [u^2].
"""

import math
import zlib
from functools import partial, reduce
from typing import Any

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxsky.arrays import Alm, Covariance, Map, Spectrum, StokesMaps
from jaxsky.checks import Numeric, as_array, check_finite, check_seed, check_shape, is_concrete
from jaxsky.harmonics import analysis, children, expand, power_spectrum
from jaxsky.io.stacks import ranges

#: Pixels checked at once.
PIECE = 1 << 20
#: Columns of a covariance by their number, in the order of Planck's maps.
COVARIANCE_COLUMNS: dict[int, tuple[str, ...]] = {
    1: ("II",),
    3: ("QQ", "QU", "UU"),
    6: ("II", "IQ", "IU", "QQ", "QU", "UU"),
}


def realisation_key(seed: int, index: int = 0) -> Array:
    """Return the key of a realisation, from the seed and its number; 0 is the observed sky."""
    check_seed("seed", seed)
    check_seed("index", index)
    return jax.random.fold_in(jax.random.key(seed), index)


def stream(key: Array, kind: str, name: str = "") -> Array:
    """Return the key of one kind of random numbers, independent of what else is drawn and when."""
    return jax.random.fold_in(key, zlib.crc32(f"{kind} {name}".encode()))


@partial(jax.jit, static_argnames=("shape", "dtype"))
def normal(key: Array, shape: tuple[int, ...], dtype: Any) -> Float[Array, "..."]:
    """Draw normal numbers that are the same in any precision, except for rounding."""
    return jax.random.normal(key, shape, jnp.result_type(float)).astype(dtype)


@partial(jax.jit, static_argnames=("stokes", "size", "dtype"))
def stokes_noise(key: Array, stokes: int, size: int, dtype: Any) -> Float[Array, "stokes size"]:
    """Draw white noise of I, or Q, U, or I, Q, U; each is the same with and without the others."""
    if stokes == 2:
        return normal(key, (2, size), dtype)
    return jnp.roll(normal(key, (3, size), dtype), 1, axis=0)[:stokes]


@partial(jax.jit, static_argnames=("nside", "stokes", "pixels"))
def uniform_covariance(
    noise: Numeric, nside: int, stokes: int = 2, pixels: int | None = None
) -> Covariance:
    """Return the covariance of all (or so many) pixels for a level, alike for Stokes parameters."""
    npix, pixel = pixels or healpy.nside2npix(nside), healpy.nside2resol(nside, arcmin=True)
    variance = jnp.broadcast_to((noise / pixel) ** 2, (stokes,))
    return jnp.broadcast_to(jnp.diag(variance)[..., None], (stokes, stokes, npix))


def pixel_covariance(noise: Any, nside: int, stokes: int = 2) -> Any:
    """Return the covariance of Stokes parameters in each pixel; that of a level takes no memory."""
    if np.ndim(noise) > 1:
        return noise
    one = np.asarray(uniform_covariance(noise, nside, stokes, pixels=1))
    return np.broadcast_to(one, (stokes, stokes, healpy.nside2npix(nside)))


def uniform_map(key: Array, noise: ArrayLike, nside: int, stokes: int = 2) -> StokesMaps:
    """Draw white noise of a level, as from `uniform_covariance` but without that in memory.

    Levels may differ between Stokes parameters, here and in what follows: shape (stokes,).
    """
    sigma = as_array("noise", noise) / float(healpy.nside2resol(nside, arcmin=True))
    sigma = sigma[:, None] if sigma.ndim else sigma
    return sigma * stokes_noise(key, stokes, healpy.nside2npix(nside), sigma.dtype)


@partial(jax.jit, static_argnames=("lmax", "stokes"))
def uniform_alm(key: Array, noise: ArrayLike, lmax: int, stokes: int = 2) -> Alm:
    """Draw packed coefficients of white noise, N_l = noise^2 (in (u rad)^2) at all multipoles.

    Rows are I (1), E, B (2) or I, E, B (3); E and B have no modes at l < 2.
    """
    if stokes not in (1, 2, 3):
        raise ValueError(f"Argument `stokes` must be 1, 2 or 3, not {stokes!r}.")
    noise = as_array("noise", noise)
    spins = jnp.array({1: [0], 2: [2, 2], 3: [0, 2, 2]}[stokes])
    there = jnp.arange(lmax + 1) >= spins[:, None]
    noise = noise[:, None] if noise.ndim else noise
    levels = jnp.where(there, noise * (math.pi / 180 / 60), 0)
    return stokes_noise(key, stokes, (lmax + 1) ** 2, noise.dtype) * expand(levels)


def white_alm(key: Array, noise: Any, lmax: int, stokes: int = 2) -> Alm:
    """Draw coefficients of noise given as a level or as a covariance of each pixel."""
    if not jnp.ndim(noise):
        return uniform_alm(key, noise, lmax, stokes)
    # Without iterations or multipoles beyond lmax, ten times faster than usual, the mean spectrum
    # is right to 1e-4.
    in_memory = isinstance(noise, jax.Array)
    pixels = draw(key, noise.astype(float)) if in_memory else draw_in_pieces(key, noise)
    return analysis(pixels, lmax, 0)


def positive_root(values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root of positive values, else 0 (with derivative 0)."""
    return jnp.where(values > 0, jnp.sqrt(jnp.where(values > 0, values, 1.0)), 0.0)


@jax.jit
def cholesky(covariance: Covariance) -> Covariance:
    """Return the lower Cholesky factor of each pixel's covariance, unrolled over its elements."""
    n = len(covariance)
    lower = [[jnp.zeros_like(covariance[0, 0])] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = covariance[i, j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            if i == j:
                lower[i][j] = positive_root(rest)  # rounding may make a zero negative
            else:
                lower[i][j] = rest / jnp.where(lower[j][j] > 0, lower[j][j], 1.0)
    return jnp.array(lower)


@partial(jax.jit, static_argnames="diagonal")
def _correlated(covariance, white, diagonal):
    """Multiply white noise by the Cholesky factor of each pixel, or by its diagonal."""
    lower = cholesky(covariance)
    terms = [[i] if diagonal else range(i + 1) for i in range(len(white))]
    return jnp.stack([sum(lower[i, j] * white[j] for j in js) for i, js in enumerate(terms)])


def draw(key: Array, covariance: Covariance, *, diagonal: bool = False) -> StokesMaps:
    """Draw noise L n with a given covariance in each pixel, independent between pixels.

    L is the lower Cholesky factor, n white noise. The paper (Hervias-Caimapo, Bonaldi & Brown 2016)
    uses only the diagonal of L, as standard deviations; `diagonal` does the same. The draws then
    have no correlations, and where the covariance has some, the variance of U is too small by the
    factor 1 - R^2, R being its multiple correlation with I and Q; likewise for Q with I.
    """
    # A program of its own: together with the products, XLA would redo the normals for each row.
    _, stokes, npix = covariance.shape
    white = stokes_noise(key, stokes, npix, covariance.dtype)
    return _correlated(covariance, white, diagonal)


def draw_in_pieces(key: Array, covariance: Any) -> StokesMaps:
    """Return the same as `draw` in double precision; a covariance on disk stays there."""
    _, stokes, npix = covariance.shape
    white = stokes_noise(key, stokes, npix, float)
    found = np.empty(white.shape)
    for part in ranges(npix, PIECE):
        piece = jnp.asarray(covariance[..., part], float)
        found[:, part] = _correlated(piece, white[:, part], False)
    return jnp.asarray(found)


def estimate_variance(maps: StokesMaps, used: Bool[Array, " pix"]) -> Float[Array, " stokes"]:
    """Estimate the noise variance per pixel from the scatter in groups of four pixels, all used."""
    # A signal that is smooth over such a group cancels.
    nside = healpy.npix2nside(maps.shape[-1])
    whole = children(used, nside // 2).all(axis=-1)
    if not bool(whole.any()):
        raise ValueError("Estimating the noise needs groups of four pixels that are all used.")
    groups = children(maps, nside // 2)
    check_finite("maps", groups[:, whole])
    scatter = jnp.var(groups, axis=-1, ddof=1)
    return jnp.sum(scatter * whole, axis=-1) / jnp.sum(whole)


def knee_spectrum(white: Numeric, ell_knee: Numeric, slope: Numeric, lmax: int) -> Spectrum:
    """Return the spectrum of noise with excess at large scales, white [1 + (l/l_knee)^-slope]."""
    # Zero at l < 2, where polarization has no modes.
    ell = jnp.arange(2, lmax + 1)
    return jnp.concatenate([jnp.zeros(2), white * (1 + (ell / ell_knee) ** -slope)])


def _deviance(theta, args):
    """Return -2 ln L of the logarithms of white level, knee and slope, given C_l from l = 2."""
    measured, modes = args
    white, knee, slope = jnp.exp(theta)
    spectrum = knee_spectrum(white, knee, slope, measured.size + 1)[2:]
    return jnp.sum(modes * (jnp.log(spectrum) + measured / spectrum))


def fit_knee(maps: StokesMaps, used: Bool[Array, " pix"], lmax: int) -> tuple[float, float, float]:
    """Fit white level, knee and slope (`knee_spectrum`) of the noise of Q, U maps, up to lmax.

    These have the highest likelihood for the spectrum (EE + BB)/2 of the masked maps, divided by
    the sky fraction and independent between multipoles. Sky signal in these pixels counts as noise.
    """
    fraction = float(np.mean(used))
    if not fraction:
        raise ValueError("Estimating the noise needs pixels, but none is left.")
    spectra = power_spectrum(analysis(jnp.where(used, maps, 0.0), lmax))
    import optimistix as optx  # slower to import than many simulations are to run

    measured = spectra.mean(axis=0)[2:] / fraction
    modes = 2 * (2 * jnp.arange(2, lmax + 1) + 1) * fraction
    level = jnp.median(measured[-lmax // 4 :])
    start = jnp.log(jnp.array([1.0, 10.0, 1.5]))
    solver: optx.AbstractMinimiser = optx.BFGS(1e-6, 1e-6)
    given = measured / level, modes
    found: optx.Solution = optx.minimise(
        _deviance, solver, start, given, max_steps=500, throw=False
    )
    if found.result != optx.RESULTS.successful:
        raise ValueError("The spectrum of the noise could not be fitted.")
    white, knee, slope = np.exp(np.asarray(found.value))
    return float(level * white), float(knee), float(slope)


def rms_covariance(rms: StokesMaps) -> Covariance:
    """Return the covariance of each pixel from maps of the rms, without correlations."""
    rms = as_array("rms", rms)
    check_shape("rms", rms, rms.ndim == 2, "have shape (stokes, pix)")
    check_finite("rms", rms)
    if is_concrete(rms) and (bad := int(jnp.sum(rms < 0))):
        raise ValueError(f"Argument `rms` has {bad} of {rms.size} values that are negative.")
    return _diagonal(rms**2)


def hits_covariance(sigma0: ArrayLike, hits: Map, stokes: int = 2) -> Covariance:
    """Return the covariance of each pixel, sigma_0^2 / hits, from the numbers of observations.

    The noise of one observation, sigma_0, is one number or, as for WMAP, one per Stokes parameter.
    """
    sigma0, hits = _each(sigma0, stokes), as_array("hits", hits)
    check_shape("hits", hits, hits.ndim == 1, "have shape (pix,)")
    check_finite("hits", hits)
    if is_concrete(hits) and (bad := int(jnp.sum(hits <= 0))):
        raise ValueError(f"Argument `hits` is not positive in {bad} of {hits.size} pixels.")
    return _diagonal(sigma0[:, None] ** 2 / hits)


def weights_covariance(
    sigma0: ArrayLike, weights: Float[Array, "3 pix"]
) -> Float[Array, "2 2 pix"]:
    """Return the covariance of Q, U per pixel: sigma_0^2 times the inverse of weights QQ, QU, UU.

    WMAP's maps have such weights, which like hit counts grow with observing time (Jarosik et al.
    2011). A pixel whose weights have no inverse gets a covariance that is not finite.
    """
    sigma0, weights = _each(sigma0, 2), as_array("weights", weights)
    check_shape("weights", weights, weights.shape[:-1] == (3,), "have shape (3, pix)")
    QQ, QU, UU = weights
    inverse = jnp.array([[UU, -QU], [-QU, QQ]]) / (QQ * UU - QU**2)
    return jnp.outer(sigma0, sigma0)[..., None] * inverse


def _each(sigma0: ArrayLike, stokes: int) -> Float[Array, " stokes"]:
    """Return the noise of one observation in each Stokes parameter."""
    sigma0 = as_array("sigma0", sigma0)
    good = sigma0.shape in ((), (stokes,))
    check_shape("sigma0", sigma0, good, f"be a number or have shape ({stokes},)")
    check_finite("sigma0", sigma0)
    return jnp.broadcast_to(sigma0, (stokes,))


def _diagonal(variance: StokesMaps) -> Covariance:
    return jnp.eye(len(variance), dtype=variance.dtype)[..., None] * variance


def covariance_from_columns(columns: Float[Array | np.ndarray, "column pix"]) -> Covariance:
    """Return the covariance of each pixel from its elements, in order of `COVARIANCE_COLUMNS`."""
    columns = as_array("columns", columns)
    good = columns.ndim == 2 and len(columns) in COVARIANCE_COLUMNS
    check_shape("columns", columns, good, "have shape (1, pix), (3, pix) or (6, pix)")
    rows = dict(zip(COVARIANCE_COLUMNS[len(columns)], columns, strict=True))
    stokes = {1: "I", 3: "QU", 6: "IQU"}[len(columns)]
    return jnp.array([[rows[min(a + b, b + a)] for b in stokes] for a in stokes])


@jax.jit
def _number_indefinite(covariance: Covariance) -> Int[Array, ""]:
    """Count the pixels whose covariance is not positive definite."""
    # A root of a negative number is NaN, and NaN is not positive; each pixel is read once.
    pivots = [row[s] for s, row in enumerate(cholesky(covariance.astype(float)))]
    return jnp.sum(~reduce(jnp.logical_and, [(p > 0) & jnp.isfinite(p) for p in pivots]))


def check_covariance(name: str, covariance: Covariance) -> None:
    """Raise ValueError if covariances of pixels are not positive definite by the lower triangle."""
    good = covariance.ndim == 3 and covariance.shape[0] == covariance.shape[1]
    check_shape(name, covariance, good, "have shape (stokes, stokes, pix)")
    if not is_concrete(covariance):
        return
    npix = covariance.shape[-1]
    pieces = (covariance[..., part] for part in ranges(npix, PIECE))
    if bad := sum(int(_number_indefinite(piece)) for piece in pieces):
        raise ValueError(f"Argument `{name}` is not positive definite in {bad} of {npix} pixels.")
