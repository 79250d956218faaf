"""What a mask does to polarization spectra: coupling matrices, also of purified fields."""

import math

import numpy as np
from ducc0.misc import wigner3j_int
from ducc0.misc.experimental import coupling_matrix_rect
from jaxtyping import Float


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
