"""Covariance of band powers on part of the sky, for Gaussian fields.

A disc does not mix orders m about its middle, so what it does to harmonics can be said exactly.
"""

import ducc0
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from fits.pseudo_cl import MaskedSpectra, derivative_factors, pure_factors
from jaxsky.harmonics import alm_to_healpy, analysis, lmax_of

#: Part of a mask's variance that may depend on longitude about its middle for it to be a disc.
ASYMMETRY = 1e-3
#: Part of a symmetric mask's largest value that counts as nothing.
NOTHING = 1e-5
#: Orders m of harmonics that are held at a time.
CHUNK = 32


def covariance_terms(
    spectra: MaskedSpectra, fields: Float[np.ndarray, "field 2 ell"]
) -> Float[np.ndarray, "field field 2 bin 2 bin"]:
    """Half the covariance of band powers of independent Gaussian fields, for each pair of them.

    `fields` are their spectra EE, BB, window included, up to `spectra.lmax` at least.

    The covariance of the sum of fields with p_i times the spectra is 2 sum_ij p_i p_j terms[i, j].
    Exact for symmetric masks (`zonal`). For others pseudo-spectra are correlated as modes of the
    squared mask, and the spectra taken to vary little over the width of the mask's own spectrum
    (Efstathiou 2004; Challinor & Chon 2005): good to some 10 % but for purified B, whose errors in
    the lowest bands, of the size of the mask, are up to 50 % larger.
    """
    given = np.asarray(fields, float)[..., : spectra.lmax + 1]
    reach = min(2 * spectra.lmax, 2 * healpy.npix2nside(spectra.mask.size))
    profile = zonal(np.asarray(analysis(jnp.asarray(spectra.mask)[None], reach)[0]))
    if profile is None:
        blocks = _narrow_products(spectra, given)
    else:
        factors = None if spectra.derivatives is None else pure_factors(spectra.lmax)
        blocks = zonal_products(profile * derivative_factors(len(profile)), given, factors)
    inverse = spectra.inverse
    return np.einsum("ibjl,xyjlkm,nckm->xyibnc", inverse, blocks, inverse, optimize=True)


def _narrow_products(
    spectra: MaskedSpectra, given: Float[np.ndarray, "field 2 ell"]
) -> Float[np.ndarray, "field field 2 ell 2 ell"]:
    """`zonal_products` of any mask, for spectra that vary little over the width of its own."""
    # What leaks from E adds to the variance of B.
    total = spectra.mixing.sum(axis=(1, 3))
    seen = np.einsum("ijlm,xjm->xil", spectra.mixing, given) / np.where(total > 0, total, 1.0)
    root = np.sqrt(seen[:, None] * seen)
    same, cross = spectra.spread
    pairs = np.array([[same, cross], [cross, same]])
    return np.einsum("xyjl,jklm,xykm->xyjlkm", root, pairs, root)


def zonal(alm: Float[np.ndarray, " alm"]) -> Float[np.ndarray, " ell"] | None:
    """Coefficients a_l0 of a mask about its own middle, or None if it depends on longitude, too."""
    lmax = lmax_of(alm)
    # The middle is where the dipole points to; a mask without one has none.
    x, y, z = -alm[lmax + 1], alm[lmax + 2], alm[1]
    if np.hypot(np.hypot(x, y), z) < 1e-6 * abs(alm[0]):
        x, y, z = 0.0, 0.0, 1.0
    angles = -np.arctan2(y, x), -np.arctan2(np.hypot(x, y), z), 0.0
    turned = ducc0.sht.rotate_alm(alm_to_healpy(alm, lmax), lmax, *angles, nthreads=0)
    coefs = turned[: lmax + 1].real
    whole = np.sum(alm**2)
    return coefs if whole - np.sum(coefs**2) < ASYMMETRY * whole else None


def ring_functions(
    spin: int, lmax: int, theta: Float[np.ndarray, " ring"], orders: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "2 m ell ring"]:
    """How harmonics depend on colatitude, in ducc0's signs; sums of squares integrate to 1.

    The maps of E = 1 are the first times exp(i m phi), and i times the second. Those of spin 0
    have the first only.
    """
    values = np.zeros((2, orders.size, lmax + 1, theta.size))
    starts = np.arange(orders.size) * (lmax + 1)
    m, mstart = orders.astype(np.uintp), starts.astype(np.uintp)
    for ell in range(max(spin, int(orders.min())), lmax + 1):
        alm = np.zeros((1 + (spin > 0), orders.size * (lmax + 1)), complex)
        alm[0, (starts + ell)[orders <= ell]] = 1
        leg = ducc0.sht.alm2leg(
            alm=alm, lmax=lmax, spin=spin, theta=theta, mval=m, mstart=mstart, nthreads=0
        )
        values[0, :, ell] = leg[0].real.T
        if spin:
            values[1, :, ell] = leg[1].imag.T
    return values


def zonal_products(
    mask: Float[np.ndarray, "3 reach"],
    fields: Float[np.ndarray, "field 2 ell"],
    factors: Float[np.ndarray, "3 ell"] | None = None,
) -> Float[np.ndarray, "field field 2 ell 2 ell"]:
    """Half the covariance of pseudo-spectra EE, BB with a symmetric mask, for pairs of fields.

    Such a mask does not mix orders m. With K_m from the E and B of the sky to those of the masked
    map, G = K C K^T is their covariance at one order, and that of pseudo-spectra sum_m 2 G^2 /
    ((2 l + 1) (2 l' + 1)). Nothing is neglected but power beyond the last multipole. `mask` has
    a_l0 of the mask and of its derivatives, as maps of spin 0, 1, 2, `fields` the spectra EE, BB of
    each, and `factors` those of the three terms of purified B, None to leave it as it is.
    """
    lmax, reach = fields.shape[-1] - 1, mask.shape[1] - 1
    nodes = (2 * lmax + reach) // 2 + 1
    theta, weight = ducc0.misc.GL_thetas(nodes), ducc0.misc.GL_weights(nodes, 1)
    zero = np.zeros(1, int)
    rings = [row @ ring_functions(n, reach, theta, zero)[0, 0] for n, row in enumerate(mask)]
    size = sum(np.abs(row) / float(lmax) ** n for n, row in enumerate(rings))
    kept = size > NOTHING * size.max()
    theta, weight = theta[kept], weight[kept]
    value, first, second = (row[kept] for row in rings)
    sums = np.zeros((len(fields), len(fields), 2, lmax + 1, 2, lmax + 1))
    for orders in np.array_split(np.arange(lmax + 1), lmax // CHUNK + 1):
        # Q and -i U of E = 1 and of B = 1, up to a phase; (field, component, m, ell, ring).
        spin2 = ring_functions(2, lmax, theta, orders)
        sky = np.stack([spin2, spin2[::-1]])
        seen = sky * value
        if factors is not None:
            _, once, twice = factors[:, :, None]
            seen[1] -= once * first * ring_functions(1, lmax, theta, orders)[::-1]
            seen[1, 1] += twice * second * ring_functions(0, lmax, theta, orders)[0]
        low = max(int(orders[0]), 2)
        sky, seen = (np.moveaxis(x[..., low:, :], 2, 0) for x in (sky, seen * weight))
        count = np.where(orders == 0, 1.0, 2.0)  # those of -m are alike
        sums[:, :, :, low:, :, low:] += _squares(sky, seen, count, fields[..., low:])
    degrees = 2 * np.arange(lmax + 1) + 1
    return sums / (degrees[:, None, None] * degrees)


@jax.jit
def _squares(sky, seen, count, fields):
    """Products of the covariances of harmonics, summed over orders, for each pair of fields."""

    def add(total, of_order):
        sky, seen, count = of_order
        rings = jnp.einsum("jclr,xjl,jdls->xcrds", sky, fields, sky)
        covariance = jnp.einsum("iclr,xcrds,jdms->xiljm", seen, rings, seen)
        return total + count * covariance[:, None] * covariance, None

    n, _, ell = fields.shape
    return jax.lax.scan(add, jnp.zeros((n, n, 2, ell, 2, ell)), (sky, seen, count))[0]
