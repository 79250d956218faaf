"""Polarization spectra on part of the sky: MASTER pseudo-C_l with the mixing of E and B.

A mask mixes multipoles, and E with B. The mean of the spectra of masked maps is a matrix times
the spectra of the sky (Hivon et al. 2002; for polarization Brown, Castro & Taylor 2005); it can be
inverted in bins that are wide compared with the width of the mask's own spectrum.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from ducc0.misc import wigner3j_int
from ducc0.misc.experimental import coupling_matrix_rect
from jaxtyping import Array, Float

from jaxsky.checks import Numeric, check_finite, check_shape, is_concrete
from jaxsky.harmonics import analysis, expand, lmax_of, power_spectrum, synthesis
from jaxsky.io.stacks import Maps, Stack, aligned, empty, is_large, loaded, ranges

#: Multipole of amplitudes: that of the recombination peak of primordial B modes.
PIVOT = 80
#: Spectra are corrected for beams down to this window.
LEAST_WINDOW = 0.05
#: Fewest modes of a field in a bin for a mean power.
LEAST_MODES = 4.0
#: Lowest multipole of polarization.
LMIN = 2
FIELDS = ("EE", "BB")
#: Names of the spectra of maps of some Stokes parameters.
SPECTRA = {"I": ("TT",), "QU": FIELDS, "IQU": ("TT", *FIELDS)}


class MaskedSpectra(NamedTuple):
    """Operators for spectra on part of the sky, up to lmax; from `masked_spectra`.

    `edges` are the first multipole of each bin, and the one after the last; `derivatives` those of
    the mask, spin 1 and 2, where B is purified. `inverse` turns pseudo-spectra EE, BB into band
    powers D_b; `windows` turns C_l of the sky into these, beam included, and `mixing` turns C_l
    into pseudo-spectra, without it. `spread` correlates pseudo-spectra within and between E and B.
    """

    mask: Float[np.ndarray, " pix"]
    edges: tuple[int, ...]
    lmax: int
    derivatives: Float[np.ndarray, "4 pix"] | Maps | None
    inverse: Float[np.ndarray, "2 bin 2 ell"]
    windows: Float[np.ndarray, "2 bin 2 ell"]
    spread: Float[np.ndarray, "2 ell ell"]
    mixing: Float[np.ndarray, "2 2 ell ell"]

    @property
    def centers(self) -> Float[np.ndarray, " bin"]:
        """Middle multipole of each bin."""
        return bin_centers(self.edges)


def bin_centers(edges: Sequence[int]) -> Float[np.ndarray, " bin"]:
    """Return the middle multipole of each bin."""
    return (np.array(edges[:-1]) + np.array(edges[1:]) - 1) / 2


def bin_edges(lmin: int, lmax: int, width: int) -> tuple[int, ...]:
    """Return edges of bins of one width from lmin to lmax inclusive; the last may be wider.

    A ValueError is raised if lmax is below lmin, or the width is not positive.
    """
    for name, value, least in (("lmax", lmax, lmin), ("width", width, 1)):
        if value < least:
            raise ValueError(f"Argument `{name}` must be at least {least}, but is {value}.")
    count = max(1, (lmax + 1 - lmin) // width)
    return (*(lmin + width * i for i in range(count)), lmax + 1)


def coupling_matrices(
    power: Float[np.ndarray, " ell"], lmax: int
) -> Float[np.ndarray, "2 ell ell"]:
    """Return the effect of a mask: pseudo-EE = M[0] EE + M[1] BB, and with E and B exchanged.

    `power` is C_l of the mask, at best up to 2 lmax, with lmax that of the spectra.
    """
    spectrum = np.zeros(2 * lmax + 1)
    kept = min(len(power), len(spectrum))
    spectrum[:kept] = power[:kept]
    matrices = np.empty((2, lmax + 1, lmax + 1))
    coupling_matrix_rect(spectrum[None], (4,), matrices, nthreads=0)
    matrices[:, :2] = matrices[:, :, :2] = 0  # a field of spin 2 has no multipoles below 2
    return matrices * (2 * np.arange(lmax + 1) + 1)


def pure_factors(lmax: int) -> Float[np.ndarray, "3 ell"]:
    """Return the factors of the three terms of a purified harmonic."""
    ell = np.maximum(np.arange(lmax + 1), 2.0)
    first, second = (ell - 1) * (ell + 2), (ell - 1) * ell * (ell + 1) * (ell + 2)
    return np.stack([np.ones_like(ell), 2 / np.sqrt(first), 1 / np.sqrt(second)])


def derivative_factors(count: int) -> Float[np.ndarray, "3 ell"]:
    """Return sqrt((l + n)! / (l - n)!), for n-th derivatives in harmonics of spin n = 0, 1, 2."""
    ell = np.arange(count, dtype=float)
    second = (ell - 1) * ell * (ell + 1) * (ell + 2)
    return np.stack([np.ones(count), np.sqrt(ell * (ell + 1)), np.sqrt(np.maximum(second, 0))])


def pure_coupling_matrices(
    power: Float[np.ndarray, " ell"], lmax: int
) -> Float[np.ndarray, "2 ell ell"]:
    """Return `coupling_matrices` of a purified field (Smith 2006).

    The mask times a harmonic of spin 2 is replaced by the second derivative of the mask times a
    scalar harmonic, three terms with a Wigner symbol each. M[1] is zero to rounding if all
    multipoles of the mask are given: that is the purpose of purifying.
    """
    count = min(len(power), 2 * lmax + 1)
    weights = power[:count] * (2 * np.arange(count) + 1) / (4 * math.pi)
    factors, rises = pure_factors(lmax), derivative_factors(count)
    matrices = np.zeros((2, lmax + 1, lmax + 1))
    degree = np.arange(count)
    for ell in range(2, lmax + 1):
        others = np.arange(max(2, ell - count + 1), min(lmax, ell + count - 1) + 1)
        symbols = np.zeros((len(others), count))
        for row, other in zip(symbols, others, strict=True):
            for n in range(3):
                first, values = wigner3j_int(int(other), ell, -2, 2 - n)
                stop = min(first + len(values), count)
                row[first:stop] += factors[n, ell] * rises[n, first:stop] * values[: stop - first]
        squares = symbols**2 * weights
        odd = (ell + others[:, None] + degree) % 2 == 1
        matrices[0, ell, others] = np.where(odd, 0, squares).sum(axis=1)
        matrices[1, ell, others] = np.where(odd, squares, 0).sum(axis=1)
    return matrices * (2 * np.arange(lmax + 1) + 1)


def masked_spectra(
    mask: Float[np.ndarray, " pix"],
    edges: Sequence[int],
    *,
    lmax: int | None = None,
    window: Float[np.ndarray, " ell"] | None = None,
    pure: bool = False,
) -> MaskedSpectra:
    """Prepare the operators that take spectra on part of the sky.

    Parameters
    ----------
    mask : weight of each pixel, 0 to 1, best falling smoothly to 0; RING
    edges : first multipole of each bin, and the one after the last
    lmax : largest multipole whose power is taken into account, by default twice that of the bins,
        at most 2 nside
    window : window b_l of the maps (beam and pixels), by default 1
    pure : purify B, so that E adds no variance to it; needs a mask with two derivatives

    Raises
    ------
    ValueError : for a mask outside 0 to 1 or with too few pixels for the bins, edges that do not
        increase or reach beyond lmax, or a window that ends before lmax
    """
    mask = np.asarray(mask, dtype=float)
    nside, edges = healpy.npix2nside(mask.size), tuple(int(edge) for edge in edges)
    lmax = min(2 * nside, 2 * edges[-1]) if lmax is None else lmax
    _check(mask, edges, lmax, window)
    window = np.ones(lmax + 1) if window is None else np.asarray(window, float)[: lmax + 1]
    reach = min(2 * lmax, 2 * nside)
    alm = analysis(jnp.asarray(mask)[None], reach)
    power = np.asarray(power_spectrum(alm)[0])
    standard = coupling_matrices(power, lmax)
    purified = pure_coupling_matrices(power, lmax) if pure else standard
    # [out, in]: pseudo-EE and pseudo-BB of the sky's EE and BB
    mixing = np.array([[standard[0], standard[1]], [purified[1], purified[0]]])
    of_sky = mixing * window**2
    # The mask also mixes in power below and above the bins, for which there are equally wide ones.
    below = np.arange(edges[0], 2, edges[0] - edges[1])
    above = np.arange(edges[-1], lmax + 1, edges[-1] - edges[-2])
    every = np.unique([2, *below, *edges[1:-1], *above, lmax + 1])
    ell = np.arange(lmax + 1)
    inside = (ell >= every[:-1, None]) & (ell < every[1:, None])
    to_D = np.maximum(ell * (ell + 1), 1) / (2 * math.pi)
    binning = inside * to_D / np.diff(every)[:, None]
    binned = np.einsum("bl,ijlm,cm->ibjc", binning, of_sky, inside / to_D, optimize=True)
    bins = len(every) - 1
    solved = np.linalg.inv(binned.reshape(2 * bins, 2 * bins)).reshape(2, bins, 2, bins)
    wanted = np.isin(every[:-1], edges[:-1])
    inverse = np.einsum("ibjc,cl->ibjl", solved[:, wanted], binning, optimize=True)
    windows = np.einsum("ibjl,jklm->ibkm", inverse, of_sky, optimize=True)
    squared = analysis(jnp.asarray(mask**2)[None], reach, 0)
    spread = coupling_matrices(np.asarray(power_spectrum(squared)[0]), lmax) / (2 * ell + 1)
    derivatives = _derivatives(alm, nside) if pure else None
    return MaskedSpectra(mask, edges, lmax, derivatives, inverse, windows, spread, mixing)


def _check(mask: np.ndarray, edges: tuple[int, ...], lmax: int, window: np.ndarray | None) -> None:
    nside = healpy.npix2nside(mask.size)
    if not np.isfinite(mask).all() or mask.min() < 0 or mask.max() > 1:
        raise ValueError(
            f"Argument `mask` must be between 0 and 1, but reaches from {mask.min():g} to "
            f"{mask.max():g}."
        )
    if len(edges) < 2 or min(np.diff(edges)) < 1 or edges[0] < 2:
        raise ValueError(
            f"Argument `edges` must increase from 2 or more and give one bin at least, not {edges}."
        )
    if not edges[-1] - 1 <= lmax <= 2 * nside:
        raise ValueError(
            f"Argument `lmax` must be between the end of the bins, {edges[-1] - 1}, and 2 nside, "
            f"{2 * nside}, but is {lmax}."
        )
    if window is not None and len(window) <= lmax:
        raise ValueError(f"Argument `window` ends at l = {len(window) - 1}, not at {lmax}.")
    fraction = sky_fraction(mask)
    for low, high in itertools.pairwise(edges):
        modes = fraction * (high**2 - low**2)
        if modes < LEAST_MODES:
            raise ValueError(
                f"The mask leaves too few pixels: {fraction:.2g} of the sky has {modes:.2g} modes "
                f"at l = {low} to {high - 1}, and {LEAST_MODES:g} are needed."
            )


def sky_fraction(mask: Float[np.ndarray, " pix"]) -> float:
    """Return the fraction of the sky that has as many modes as the mask leaves."""
    fourth = float(np.mean(mask**4))
    return float(np.mean(mask**2)) ** 2 / fourth if fourth else 0.0


def _derivatives(alm: Float[Array, "1 alm"], nside: int) -> Float[np.ndarray, "4 pix"]:
    """Return first and second derivatives of a mask, as fields of spin 1 and 2."""
    rises = derivative_factors(lmax_of(alm) + 1)
    zero = jnp.zeros_like(alm[0])
    first, second = (jnp.stack([alm[0] * expand(jnp.asarray(rise)), zero]) for rise in rises[1:])
    found = empty((4, healpy.nside2npix(nside)))
    found[:2] = np.asarray(synthesis(first, nside, spin=1))
    found[2:] = np.asarray(synthesis(second, nside))
    return found


def _product(order: int, mask: Any, derivatives: Any, maps: Any) -> Float[Array, "2 pix"]:
    """Return maps (2, pix) times the mask (order 0), or its derivative of an order.

    The latter is Q + iU times the conjugate of the derivative; its maps are minus the real and
    imaginary part, as Q and U are of E + iB.
    """
    # Unused pixels may contain anything, and a purified harmonic reaches a little beyond the mask.
    maps = jnp.where(mask > 0, maps, 0.0)
    if not order:
        return mask * maps
    (Q, U), (real, imaginary) = maps, derivatives[2 * order - 2 : 2 * order]
    return -jnp.stack([Q * real + U * imaginary, U * real - Q * imaginary])


def _field(order: int, mask: Any, derivatives: Any, maps: Any) -> Float[Array, "2 pix"]:
    """Return `_product`, made range by range if it is large."""
    if not is_large(maps.shape):
        return _product(order, mask, derivatives, maps)
    found, maps = aligned(maps.shape), maps if isinstance(maps, Stack) else np.asarray(maps)
    for part in ranges(mask.size):
        slopes = None if derivatives is None else derivatives[:, part]
        found[:, part] = _product(order, mask[part], slopes, maps[:, part])
    return loaded(found)


def _alm(mask: Any, derivatives: Any, maps: Any, lmax: int) -> Float[Array, "2 alm"]:
    """Return E and B of masked maps, with B purified if the mask's derivatives are given."""
    E, B = analysis(_field(0, mask, derivatives, maps), lmax, 0)
    if derivatives is not None:
        _, once, twice = (expand(jnp.asarray(factors)) for factors in pure_factors(lmax))
        B = B + once * analysis(_field(1, mask, derivatives, maps), lmax, 0, spin=1)[1]
        B = B - twice * analysis(_field(2, mask, derivatives, maps)[1:], lmax, 0)[0]
    return jnp.stack([E, B])


_compiled_alm = jax.jit(_alm, static_argnames="lmax")


def _masked_alm(mask: Any, derivatives: Any, maps: Any, lmax: int) -> Float[Array, "2 alm"]:
    """Return what `_alm` does, field by field if the maps are large."""
    return (_alm if is_large(maps.shape) else _compiled_alm)(mask, derivatives, maps, lmax=lmax)


def band_powers(
    spectra: MaskedSpectra,
    maps: Float[Array, "2 pix"] | Maps,
    other: Float[Array, "2 pix"] | Maps | None = None,
) -> Float[np.ndarray, "2 bin"]:
    """Return band powers D_b = l (l + 1) C_l / 2 pi of EE and BB, including noise.

    Parameters
    ----------
    spectra : from `masked_spectra`
    maps : Q and U, RING, values outside the mask do not matter
    other : Q and U of another map, for cross-spectra, which independent noise does not bias

    Raises
    ------
    ValueError : for maps of another shape, and values inside the mask not finite or UNSEEN
    """
    mask = np.asarray(spectra.mask)
    given = {"maps": maps} if other is None else {"maps": maps, "other": other}
    for name, values in given.items():
        good, form = values.shape == (2, mask.size), f"have shape (2, {mask.size})"
        check_shape(name, values, good, form)
        for part in ranges(mask.size) if is_concrete(values) else ():
            check_finite(name, np.where(mask[part] > 0, np.asarray(values[..., part]), 0))
    alms = [_masked_alm(mask, spectra.derivatives, one, spectra.lmax) for one in given.values()]
    return np.einsum("ibjl,jl->ib", spectra.inverse, power_spectrum(alms[0], alms[-1]))


def mean_spectrum(
    mask: Float[np.ndarray, " pix"], maps: Float[Array, "2 pix"] | Maps, lmax: int
) -> Float[np.ndarray, " ell"]:
    """Return C_l of a masked map, the mean of EE and BB, over the mean square of the mask."""
    power = np.asarray(power_spectrum(_masked_alm(mask, None, maps, lmax)))
    return power.mean(axis=0) / np.mean(np.square(mask))


def polarization_alms(
    maps: Float[Array, "band stokes pix"], lmax: int
) -> Float[Array, "band stokes alm"]:
    """Return I, E and B of each band, as far as seen; to l = 1.5 nside C_l are good to 1e-3."""
    return jnp.stack([analysis(band, lmax) for band in maps])


def cosmic_error(power: Float[Array, "... ell"], signal: Numeric = 0.0) -> Float[Array, "... ell"]:
    """Return the standard deviation of the full-sky spectrum of a random field, the paper's eq. 9.

    It is sqrt(2 / (2l+1)) C_l; if the field is added to a fixed signal of spectrum F_l, their
    chance correlation, which the paper leaves out, makes it sqrt(2 / (2l+1) C_l (C_l + 2 F_l)).
    """
    ell = jnp.arange(power.shape[-1])
    return jnp.sqrt(2 / (2 * ell + 1) * power * (power + 2 * signal))


def hotelling(
    observed: Float[np.ndarray, " bin"], simulated: Float[np.ndarray, "sim bin"]
) -> tuple[float, float]:
    """Return chi^2 of a measurement against simulations, and the probability to exceed it.

    Mean and covariance come from the simulations, and so are uncertain; Hotelling's T^2, with its F
    distribution, is exact for any number of Gaussian simulations.
    """
    n, p = simulated.shape
    if n <= p:
        raise ValueError(f"{p} bins need more than {p} simulations, but there are {n}.")
    difference = observed - simulated.mean(axis=0)
    covariance = np.atleast_2d(np.cov(simulated, rowvar=False))
    chi2 = float(difference @ np.linalg.solve(covariance, difference))
    ratio = n / (n + 1) * (n - p) / (p * (n - 1)) * chi2
    return chi2, float(scipy.stats.f.sf(ratio, p, n - p))
