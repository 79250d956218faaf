"""Spherical harmonics of HEALPix maps: synthesis, analysis, smoothing, resolution.

The transforms are those of ducc0 (`jaxsky.ducc`), so they can be jitted and differentiated and have
exact transposes; healpy supplies the bookkeeping (ring weights, sizes). Q and U are one spin-2
field with coefficients E and B: smoothing them as two scalars would be wrong by several percent.

Coefficients are packed as real numbers: for each m the a_lm of l = m ... lmax, and for m > 0 their
real and imaginary parts times sqrt(2), so that the sum of squares of the packed numbers is the sum
of |a_lm|^2 over all m.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import ducc0
import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky import ducc
from jaxsky.arrays import Alm, Beam, Map, StokesMaps, Window
from jaxsky.checks import check_double, check_finite, check_shape, is_concrete

#: A window below this is treated as zero: what it lets through is lost in rounding.
NEGLIGIBLE = 1e-12
#: A tabulated target may exceed a map's own window by this fraction, as measured tables do.
FINER = 0.01
#: An analysis extends to this times the largest multipole kept, as far as the map resolves it.
MARGIN = 3
#: Up to this fraction of nside, quadrature needs neither iterations nor a margin: a multipole up to
#: three times as high leaks by some 1e-6 at nside 128, and less with finer pixels. Variances, whose
#: spectra are steep, allow a larger fraction.
FINE, FINE_VARIANCE = 0.25, 0.375


# Packed coefficients.


def alm_ell(lmax: int) -> np.ndarray:
    """Return the multipole l of each packed coefficient, shape (alm,)."""
    ell, m = healpy.Alm.getlm(lmax)
    return np.concatenate([ell[m == 0], np.repeat(ell[m > 0], 2)])


def degrees(lmax: int) -> tuple[Array, Array, Array]:
    """Return l, m and part (0 real, 1 imaginary) of each packed coefficient."""
    # Computed inside the program: as constants they would be as large as the coefficients.
    i = jnp.arange((lmax + 1) ** 2)
    pair, part = jnp.divmod(jnp.maximum(i - (lmax + 1), 0), 2)
    # Counted from the end, m = lmax has one pair, m = lmax - 1 two, ...: triangular numbers.
    back = lmax * (lmax + 1) // 2 - 1 - pair
    length = jnp.floor((1 + jnp.sqrt(1.0 + 8 * back)) / 2).astype(i.dtype)
    ell = lmax - (back - length * (length - 1) // 2)
    zonal = i <= lmax
    return jnp.where(zonal, i, ell), jnp.where(zonal, 0, lmax + 1 - length), part


def lmax_of(alm: Array | np.ndarray) -> int:
    """Return the largest multipole of packed coefficients, (..., (lmax + 1)^2).

    TypeError if they are complex, ValueError if their number is no square.
    """
    if jnp.iscomplexobj(alm):
        raise TypeError(
            "Argument `alm` must be packed real coefficients, but is complex; those of healpy are "
            "converted by jaxsky.harmonics.alm_from_healpy."
        )
    root = math.isqrt(many := alm.shape[-1])
    if root**2 != many:
        raise ValueError(
            f"Argument `alm` must have (lmax + 1)^2 coefficients, a square number, not {many}."
        )
    return root - 1


@jax.jit
def expand(values: Float[Array, "... ell"]) -> Float[Array, "... alm"]:
    """Return the values of a function of l = 0 ... lmax at each packed coefficient."""
    return values[..., degrees(values.shape[-1] - 1)[0]]


@partial(jax.jit, static_argnames="lmax")
def resize(alm: Float[Array, "... alm"], lmax: int) -> Float[Array, "... alm"]:
    """Cut packed coefficients at another lmax, or pad them with zeros."""
    own = lmax_of(alm)
    ell, m, part = degrees(lmax)
    pairs = (m - 1) * (own + 1) - m * (m - 1) // 2 + ell - m
    index = jnp.where(m == 0, ell, own + 1 + 2 * pairs + part)
    return jnp.where(ell <= own, alm[..., jnp.where(ell <= own, index, 0)], 0)


@jax.jit
def power_spectrum(
    alm: Float[Array, "... alm"], other: Float[Array, "... alm"] | None = None
) -> Float[Array, "... ell"]:
    """Return C_l of packed coefficients, or the cross-spectrum with others, row by row."""
    lmax = lmax_of(alm)
    product = (alm * (alm if other is None else other)).reshape(-1, alm.shape[-1])
    ell = degrees(lmax)[0]
    sums = jax.vmap(lambda row: jnp.zeros(lmax + 1, row.dtype).at[ell].add(row))(product)
    return sums.reshape(*alm.shape[:-1], -1) / (2 * jnp.arange(lmax + 1) + 1)


def map_variance(spectrum: Float[Array | np.ndarray, " ell"]) -> float:
    """Return the variance of a pixel in maps with a given spectrum."""
    return float(np.sum((2 * np.arange(spectrum.size) + 1) * np.asarray(spectrum)) / (4 * np.pi))


def alm_from_healpy(alm: np.ndarray, lmax: int) -> Float[np.ndarray, "... alm"]:
    """Convert healpy's complex coefficients to packed real ones, along the last axis.

    TypeError if they are real, ValueError unless there are (lmax + 1) (lmax + 2) / 2 of them.
    """
    alm, many = np.asarray(alm), (lmax + 1) * (lmax + 2) // 2
    if not np.iscomplexobj(alm):
        raise TypeError(
            "Argument `alm` must be the complex coefficients of healpy, but is real: maps, or "
            "coefficients that are packed already."
        )
    check_shape("alm", alm, alm.shape[-1:] == (many,), f"have {many} coefficients at lmax = {lmax}")
    high = np.sqrt(2) * alm[..., lmax + 1 :]
    pairs = np.stack([high.real, high.imag], axis=-1).reshape(*alm.shape[:-1], -1)
    return np.concatenate([alm[..., : lmax + 1].real, pairs], axis=-1)


def alm_to_healpy(alm: ArrayLike, lmax: int) -> np.ndarray:
    """Convert packed real coefficients to healpy's complex ones, along the last axis.

    TypeError if they are complex, ValueError unless there are (lmax + 1)^2 of them.
    """
    alm = np.asarray(alm)
    form = f"have {(lmax + 1) ** 2} coefficients at lmax = {lmax}"
    check_shape("alm", alm, lmax_of(alm) == lmax, form)
    alm = alm.astype(float)
    pairs = alm[..., lmax + 1 :] / np.sqrt(2)
    return np.concatenate([alm[..., : lmax + 1], pairs[..., ::2] + 1j * pairs[..., 1::2]], axis=-1)


# Transforms.


def _by_spin(transform: Callable[..., Any], rows: Array, spin: int, **how: Any) -> Array:
    """Transform the rows I, or Q, U (or E, B), or both: the first is scalar, two have a spin."""
    check_double("A spherical harmonic transform")
    ducc.finish_at_exit()
    scalar, polarized = (slice(0, 1), 0), (slice(-2, None), spin)
    blocks = {1: [scalar], 2: [polarized], 3: [scalar, polarized]}[len(rows)]
    return jnp.concatenate([transform(rows[block], spin=s, **how)[0] for block, s in blocks])


@partial(jax.jit, static_argnames=("nside", "spin"))
def synthesis(alm: Alm, nside: int, spin: int = 2) -> StokesMaps:
    """Return maps of I, or Q, U, or I, Q, U from packed coefficients I, or E, B, or I, E, B.

    With lmax > 3 nside - 1 the maps are undersampled. `spin` is that of the last two rows.
    """
    how = {"nside": nside, "lmax": lmax_of(alm)}
    return _by_spin(ducc.synthesis, alm, spin, **how, weighted=False)


@partial(jax.jit, static_argnames="lmax")
def adjoint_synthesis(maps: StokesMaps, lmax: int) -> Alm:
    """Apply the transpose of `synthesis`: inner products of maps with the spherical harmonics."""
    how = {"nside": healpy.npix2nside(maps.shape[-1]), "lmax": lmax}
    return _by_spin(ducc.adjoint_synthesis, maps, 2, **how, weighted=False)


@partial(jax.jit, static_argnames=("lmax", "iterations", "spin"))
def analysis(maps: StokesMaps, lmax: int, iterations: int | None = None, spin: int = 2) -> Alm:
    """Return packed coefficients of maps of I, or Q, U, or I, Q, U: the inverse of `synthesis`.

    Uses ring-weighted quadrature, refined by Jacobi steps on the residual map. For a map without
    multipoles above lmax <= 2 nside the rms error is below 1e-6 of the rms coefficient, and about
    1e-7 at nside 512; for higher lmax no number of steps (`iterations`) suffices. By default there
    is one step up to lmax = 1.5 nside and two above, plus one below nside 128, where the
    quadrature is worse. Maps are in RING order, lmax at most 3 nside - 1.
    """
    nside = healpy.npix2nside(maps.shape[-1])
    if iterations is None:
        iterations = 1 + (2 * lmax > 3 * nside) + (nside < 128)
    how = {"nside": nside, "lmax": lmax}
    alm = _by_spin(ducc.adjoint_synthesis, maps, spin, **how, weighted=True)
    return _by_spin(ducc.refined, alm, spin, **how, iterations=iterations) if iterations else alm


# Beams and windows in l.


@partial(jax.jit, static_argnames="lmax")
def gaussian_beam(fwhm: ArrayLike, lmax: int, own: ArrayLike = 0.0) -> Window:
    """Return the window b_l = exp(-l (l+1) sigma^2 / 2) of a Gaussian beam of `fwhm` [arcmin].

    The same window serves temperature and polarization, as in the paper; healpy's window for
    polarization differs by exp(2 sigma^2), 1.0001 for 1 degree. With a beam `own` it is that of
    sqrt(fwhm^2 - own^2). Differentiable in the widths.
    """
    variance = (jnp.square(fwhm) - jnp.square(own)) * math.radians(1 / 60) ** 2 / (8 * math.log(2))
    ell = jnp.arange(lmax + 1)
    return jnp.exp(-ell * (ell + 1) * variance / 2)


def beam_ratio(target: ArrayLike, own: ArrayLike, lmax: int, what: str = "the map") -> Window:
    """Return the window that takes a map from its own beam to a target, differentiable in both.

    Each beam is the full width at half maximum of a Gaussian [arcmin], or a table b_l, l = 0 ...;
    for two Gaussians the window is that of sqrt(target^2 - own^2). `what` names the map in errors.
    """
    target, own = jnp.asarray(target, float), jnp.asarray(own, float)
    if not target.ndim and not own.ndim:
        if is_concrete(target) and is_concrete(own) and float(target) < float(own):
            raise ValueError(
                f"The target beam of {float(target):g} arcmin is finer than that of {what}, "
                f"{float(own):g} arcmin."
            )
        return gaussian_beam(target, lmax, own)
    over, under = _window(target, lmax, "the target"), _window(own, lmax, what)
    empty = jnp.abs(under) < NEGLIGIBLE
    ratio = jnp.where(empty, 0.0, over / jnp.where(empty, 1.0, under))
    if is_concrete(ratio) and float(jnp.abs(ratio).max()) > 1 + FINER:
        at = int(jnp.abs(ratio).argmax())
        raise ValueError(
            f"The target beam is finer than that of {what}: at l = {at} their windows are "
            f"{float(over[at]):.3g} and {float(under[at]):.3g}."
        )
    return ratio


def _window(beam: Array, lmax: int, what: str) -> Window:
    if not beam.ndim:
        return gaussian_beam(beam, lmax)
    if len(beam) <= lmax:
        raise ValueError(f"The beam table of {what} ends at l = {len(beam) - 1}, not at {lmax}.")
    return beam[: lmax + 1]


def needed_lmax(window: Float[Array | np.ndarray, " ell"]) -> int:
    """Return the last multipole at which a window is not negligible."""
    return int(np.flatnonzero(np.abs(np.asarray(window)) > NEGLIGIBLE).max(initial=0))


def shortened(window: Window) -> Window:
    """Cut a window where it becomes negligible for good, unless it is being traced."""
    # Q and U have no multipoles below 2.
    return window[: max(2, needed_lmax(window)) + 1] if is_concrete(window) else window


def pixel_window(nside: int, lmax: int) -> Float[np.ndarray, " ell"]:
    """Return the pixel window, approximated by a disc of the pixel's area, 2 J_1(x)/x."""
    # healpy has tables, but fetches them over the network.
    from scipy.special import j1  # slower to import than most windows are to compute

    ell, radius = np.arange(lmax + 1), math.sqrt(healpy.nside2pixarea(nside) / np.pi)
    x = np.sqrt(ell * (ell + 1)) * radius
    return np.where(x > 0, 2 * j1(x) / np.where(x > 0, x, 1), 1.0)


def low_multipoles(maps: StokesMaps, lmax: int, iterations: int | None = None) -> Alm:
    """Return coefficients up to lmax of maps that have higher multipoles; zero above 2 nside."""
    # Multipoles beyond those analysed leak into the result, so more are analysed than are kept.
    resolved = 2 * healpy.npix2nside(maps.shape[-1])
    return resize(analysis(maps, min(resolved, MARGIN * lmax), iterations), lmax)


@partial(jax.jit, static_argnames=("nside", "iterations", "fine"))
def resample(
    maps: StokesMaps, window: Window, nside: int, iterations: int | None = None, fine: float = 0.0
) -> StokesMaps:
    """Multiply maps by a window in l and change their nside: smooth and degrade in one step.

    Linear in the maps, with an exact transpose. Multipoles above those of the window are cut,
    so a degraded map is band-limited rather than averaged over pixels; nothing is left above
    2 nside of the input. If the window ends below the fraction `fine` of the maps' nside, only its
    own multipoles are analysed, without Jacobi steps (`iterations`).
    """
    lmax = len(window) - 1
    if lmax <= fine * healpy.npix2nside(maps.shape[-1]):
        alm = analysis(maps, lmax, 0)
    else:
        alm = low_multipoles(maps, lmax, iterations)
    return synthesis(alm * expand(window), nside)


def smooth(
    maps: StokesMaps, fwhm: ArrayLike, own: ArrayLike = 0.0, lmax: int | None = None
) -> StokesMaps:
    """Smooth maps from their own beam to another; differentiable in maps and widths.

    The maps are I, or Q, U, or I, Q, U, shape (stokes, pix), RING; for the beams see `beam_ratio`.
    Multipoles are kept up to lmax, by default 2 nside, or less where the beam leaves nothing.

    Raises
    ------
    ValueError
        For a wrong shape, a target finer than the maps' own beam, or values that are not finite.
    """
    good = maps.ndim == 2 and healpy.isnpixok(maps.shape[-1])
    check_shape("maps", maps, good, "have shape (stokes, pix) with 12 nside^2 pixels")
    check_finite("maps", maps)
    nside = healpy.npix2nside(maps.shape[-1])
    window = beam_ratio(fwhm, own, 2 * nside if lmax is None else lmax)
    return resample(maps, shortened(window) if lmax is None else window, nside)


@cache
def _children(nside_in: int, nside_out: int) -> np.ndarray:
    """Return RING indices at nside_in of the pixels inside each at nside_out, (pix_out, child)."""
    parents = healpy.ring2nest(nside_out, np.arange(healpy.nside2npix(nside_out)))
    ratio = (nside_in // nside_out) ** 2
    return healpy.nest2ring(nside_in, parents[:, None] * ratio + np.arange(ratio))


def children(maps: Float[Array, "... pix"], nside: int) -> Float[Array, "... parent child"]:
    """Group the pixels of maps by the pixel of a lower resolution that contains them (RING)."""
    nside_in = healpy.npix2nside(maps.shape[-1])
    return maps[..., _children(nside_in, nside)]


def average_pixels(maps: Float[Array, "... pix"], nside: int) -> Float[Array, "... pix"]:
    """Degrade maps by averaging over pixels, like healpy's ud_grade (RING)."""
    return children(maps, nside).mean(axis=-1)


class Preparation(eqx.Module):
    """Operator that takes maps to a common beam and nside, or averages over pixels only."""

    window: Window | None  # None averages pixels and leaves the beam unchanged
    nside_in: int = eqx.field(static=True)
    nside: int = eqx.field(static=True)

    @classmethod
    def smoothing(
        cls, nside_in: int, own: Beam, nside: int, fwhm: float | None, lmax: int, what: str = "map"
    ) -> "Preparation":
        """Smooth from the maps' own beam to a Gaussian up to lmax or less (see `beam_ratio`).

        With None for `fwhm`, pixels are averaged instead.
        """
        if nside > nside_in:
            raise ValueError(f"The common nside {nside} is larger than that of {what}, {nside_in}.")
        window = None if fwhm is None else shortened(beam_ratio(fwhm, own, lmax, what))
        return cls(window, nside_in, nside)

    def __call__(self, maps: StokesMaps) -> StokesMaps:
        """Return the maps at the common resolution."""
        if self.window is None:
            return average_pixels(maps, self.nside)
        return resample(maps, self.window, self.nside, fine=FINE)

    @eqx.filter_jit
    def transpose(self, maps: StokesMaps) -> StokesMaps:
        """Apply the transposed operator, from the common resolution to that of the maps."""
        shape = (len(maps), healpy.nside2npix(self.nside_in))
        return jax.linear_transpose(self, jax.ShapeDtypeStruct(shape, maps.dtype))(maps)[0]

    def variance(self, variance: Sequence[Map]) -> StokesMaps:
        """Return the variance of prepared white noise, given the variance of each input pixel."""
        if self.window is None:
            mean = average_pixels(jnp.asarray(variance, float), self.nside)
            return mean * (self.nside / self.nside_in) ** 2
        # That of a smoothed map is the map of variances smoothed by the square of the kernel.
        squared = jnp.asarray(_squared_window(np.asarray(self.window), 2 * self.nside_in))
        area = healpy.nside2pixarea(self.nside_in)
        rows = []
        for row in variance:  # one by one: a row may be as large as everything else
            values = jnp.asarray(row[None], float)
            smoothed = resample(values, squared, self.nside, fine=FINE_VARIANCE)
            rows.append((area * smoothed[0]).block_until_ready())
        return jnp.stack(rows)

    def uniform_variance(self, level: float) -> float:
        """Return the variance of prepared white noise of a level [u arcmin]."""
        if self.window is None:
            return (level / healpy.nside2resol(self.nside, arcmin=True)) ** 2
        return map_variance((level * np.radians(1 / 60) * np.asarray(self.window)) ** 2)


def _squared_window(window: np.ndarray, highest: int) -> np.ndarray:
    """Return the window of the squared kernel, exact on Gauss-Legendre nodes, given its window."""
    lmax = min(2 * (len(window) - 1), highest)
    order = 2 * len(window) + lmax
    x = np.cos(ducc0.misc.GL_thetas(order))
    weights = ducc0.misc.GL_weights(order, 1) / (2 * np.pi)
    ell = np.arange(len(window))
    kernel = np.polynomial.legendre.legval(x, (2 * ell + 1) / (4 * np.pi) * window)
    return 2 * np.pi * (weights * kernel**2) @ np.polynomial.legendre.legvander(x, lmax)
