"""White noise of maps: draws from the covariance of each pixel, and estimates from the maps."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxsky.harmonics import alm_ell, analysis, children
from jaxsky.types import Numeric

__all__ = [
    "cholesky",
    "draw",
    "estimate_variance",
    "fit_knee",
    "knee_spectrum",
    "uniform_covariance",
]


def uniform_covariance(
    noise: Numeric, nside: int, stokes: int = 2
) -> Float[Array, "stokes stokes pix"]:
    """Covariance of each pixel for a uniform noise level.

    Parameters
    ----------
    noise : noise [u arcmin], u being the unit of the maps
    nside : resolution
    stokes : number of Stokes parameters, all with this noise
    """
    sigma = noise / (healpy.nside2resol(nside, arcmin=True))
    return jnp.eye(stokes)[..., None] * jnp.full(healpy.nside2npix(nside), sigma**2)


def cholesky(covariance: Float[Array, "stokes stokes pix"]) -> Float[Array, "stokes stokes pix"]:
    """Lower Cholesky factor of the covariance of each pixel, written out element by element."""
    n = len(covariance)
    lower = [[jnp.zeros_like(covariance[0, 0])] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = covariance[i, j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            if i == j:
                # At zero, where the derivative of the root is not finite, it is not taken.
                lower[i][j] = jnp.where(rest == 0, 0.0, jnp.sqrt(jnp.where(rest == 0, 1.0, rest)))
            else:
                lower[i][j] = rest / jnp.where(lower[j][j] > 0, lower[j][j], 1.0)
    return jnp.stack([jnp.stack(row) for row in lower])


@jax.jit
def draw(key: Array, covariance: Float[Array, "stokes stokes pix"]) -> Float[Array, "stokes pix"]:
    """A realisation L n of noise with a covariance in each pixel, independent between pixels.

    Parameters
    ----------
    key : of jax.random
    covariance : of the Stokes parameters in each pixel, positive semi-definite
    """
    white = jax.random.normal(key, covariance.shape[1:], covariance.dtype)
    return jnp.einsum("stp,tp->sp", cholesky(covariance), white)


def estimate_variance(
    maps: Float[Array, "stokes pix"], used: Bool[Array, " pix"]
) -> Float[Array, " stokes"]:
    """Noise variance per pixel from the scatter inside groups of four neighbouring pixels.

    What varies little over such a group cancels, which leaves the noise where the sky is smooth.

    Parameters
    ----------
    maps : maps with white noise, RING
    used : pixels to use; groups of which all four are used count

    Raises
    ------
    ValueError
        If no complete group is left.
    """
    nside = healpy.npix2nside(maps.shape[-1])
    whole = children(used, nside // 2).all(axis=-1)
    if not bool(whole.any()):
        raise ValueError("Estimating the noise needs groups of four pixels that are all used.")
    scatter = jnp.var(children(maps, nside // 2), axis=-1, ddof=1)
    return jnp.sum(scatter * whole, axis=-1) / jnp.sum(whole)


def knee_spectrum(
    white: Numeric, ell_knee: Numeric, slope: Numeric, lmax: int
) -> Float[Array, " ell"]:
    """Noise with a white level and excess at large scales, N_l = white [1 + (l/l_knee)^-slope].

    Zero at l < 2, where polarization has no modes.
    """
    ell = jnp.arange(2, lmax + 1)
    return jnp.concatenate([jnp.zeros(2), white * (1 + (ell / ell_knee) ** -slope)])


def _deviance(theta, args):
    """-2 ln L of white level, knee and slope (logarithms) for a measured spectrum from l = 2."""
    measured, modes = args
    white, knee, slope = jnp.exp(theta)
    spectrum = knee_spectrum(white, knee, slope, measured.size + 1)[2:]
    return jnp.sum(modes * (jnp.log(spectrum) + measured / spectrum))


def fit_knee(
    maps: Float[Array, "stokes pix"], used: Bool[Array, " pix"], lmax: int
) -> tuple[float, float, float]:
    """White level, knee and slope (`knee_spectrum`) of the noise of Q, U maps.

    The most probable values given the spectrum (EE + BB)/2 of the masked maps divided by the
    fraction of the sky, whose values are taken as independent between multipoles. Whatever the
    sky itself shows in these pixels counts as noise.

    Parameters
    ----------
    maps : Q and U, RING
    used : pixels to use; the fewer, the coarser the estimate
    lmax : largest multipole to use

    Raises
    ------
    ValueError
        If no pixel is left, or the fit does not converge.
    """
    fraction = float(np.mean(used))
    if not fraction:
        raise ValueError("Estimating the noise needs pixels, but none is left.")
    alm = np.asarray(analysis(jnp.where(used, maps, 0.0), lmax))
    degree = alm_ell(lmax)
    power = np.bincount(degree, (alm**2).sum(axis=0)) / (2 * (2 * np.arange(lmax + 1) + 1))
    measured = jnp.asarray(power[2:] / fraction)
    modes = 2 * (2 * jnp.arange(2, lmax + 1) + 1) * fraction
    level = jnp.median(measured[-lmax // 4 :])

    start = jnp.log(jnp.array([1.0, 10.0, 1.5]))
    solver: optx.AbstractMinimiser = optx.BFGS(1e-6, 1e-6)
    args = (measured / level, modes)
    solution: optx.Solution = optx.minimise(
        _deviance, solver, start, args=args, max_steps=500, throw=False
    )
    if solution.result != optx.RESULTS.successful:
        raise ValueError("The spectrum of the noise could not be fitted.")
    white, knee, slope = np.exp(np.asarray(solution.value))
    return float(level * white), float(knee), float(slope)
