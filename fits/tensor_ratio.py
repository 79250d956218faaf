"""The tensor-to-scalar ratio r from BB band powers on part of the sky, and their covariance.

The covariance is exact for a mask like a disc, which does not mix orders m about its centre.

Band powers of BB of a cleaned CMB map are modelled as r T + A_lens L + N: tensors, lensing, and
the noise and residual foregrounds. The estimate solves T^T C^-1 (D - r T - A_lens L - N) = 0 with C
the covariance that the model itself gives at that r. This is linear in the powers, so that r is
unbiased, where errors from measured powers would bias it low; and on the full sky it maximises the
exact likelihood.
"""

from typing import NamedTuple

import ducc0
import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float, Int

from fits.pseudo_cl import MaskedSpectra, derivative_factors, pure_factors
from jaxsky.checks import check_finite, check_shape
from jaxsky.harmonics import alm_to_healpy, analysis, lmax_of

#: Most iterations for r, and the change in standard deviations at which they end.
STEPS, CLOSE = 50, 1e-6
#: The posterior is tabulated up to this many standard deviations above max(r, 0), at this many
#: points.
WIDTHS, POINTS = 8.0, 2001
#: Fraction of a mask's power that may depend on longitude about its axis if it is symmetric.
ASYMMETRY = 1e-3
#: Fraction of a symmetric mask's largest value below which it counts as zero.
NOTHING = 1e-5
#: Products of a symmetric mask are exact up to this multipole, with what the next ones add: their
#: time grows as its cube, and the width of a mask matters less and less.
EXACT_LMAX, MARGIN = 320, 32
#: Orders m of harmonics in memory at a time.
CHUNK = 32


def covariance_terms(
    spectra: MaskedSpectra, fields: Float[np.ndarray, "field 2 ell"]
) -> Float[np.ndarray, "field field 2 bin 2 bin"]:
    """Return half the covariance of band powers of independent Gaussian fields, per pair of them.

    `fields` are their spectra EE, BB, window included, up to `spectra.lmax` at least.

    The covariance of a sum of fields with p_i times these spectra is 2 sum_ij p_i p_j terms[i, j].
    It is exact for symmetric masks (`zonal`) up to l = 320. Beyond (errors good to 5 %, and that of
    r, which is measured below, to 1e-3) and for other masks pseudo-spectra are correlated like
    modes of the squared mask, and the spectra are assumed to vary little over the width of the
    mask's own (Efstathiou 2004; Challinor & Chon 2005): good to some 10 %, except for purified B,
    whose errors in the lowest bands, at the scale of the mask, are up to 50 % larger.
    """
    given = np.asarray(fields, float)[..., : spectra.lmax + 1]
    reach = min(2 * spectra.lmax, 2 * healpy.npix2nside(spectra.mask.size))
    profile = zonal(np.asarray(analysis(jnp.asarray(spectra.mask)[None], reach)[0]))
    if profile is None:
        blocks = _narrow_products(spectra, given)
    else:
        last = min(spectra.lmax, EXACT_LMAX + MARGIN)
        mask = profile[: 2 * last + 1]  # its higher multipoles couple none up to the last
        blocks = zonal_products(mask, given[..., : last + 1], spectra.derivatives is not None)
        if last < spectra.lmax:
            low, exact = slice(EXACT_LMAX + 1), blocks
            blocks = _narrow_products(spectra, given)
            blocks[..., low, :, low] = exact[..., low, :, low]
    inverse = spectra.inverse
    return np.einsum("ibjl,xyjlkm,nckm->xyibnc", inverse, blocks, inverse, optimize=True)


def _narrow_products(
    spectra: MaskedSpectra, given: Float[np.ndarray, "field 2 ell"]
) -> Float[np.ndarray, "field field 2 ell 2 ell"]:
    """Return `zonal_products` of any mask, if spectra vary little over the width of its own."""
    # What leaks from E adds to the variance of B.
    total = spectra.mixing.sum(axis=(1, 3))
    seen = np.einsum("ijlm,xjm->xil", spectra.mixing, given) / np.where(total > 0, total, 1.0)
    root = np.sqrt(seen[:, None] * seen)
    same, cross = spectra.spread
    pairs = np.array([[same, cross], [cross, same]])
    return np.einsum("xyjl,jklm,xykm->xyjlkm", root, pairs, root)


def zonal(alm: Float[np.ndarray, " alm"]) -> Float[np.ndarray, " ell"] | None:
    """Return a_l0 of a mask about its own axis, or None if it is not symmetric about that."""
    lmax = lmax_of(alm)
    # The axis is that of the dipole, or of the coordinates for a mask without one.
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
    """Return harmonics over colatitude, in ducc0's signs; their sums of squares integrate to 1.

    The two maps of E = 1 are the first and i times the second, times exp(i m phi). Spin 0 has the
    first only.
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
    mask: Float[np.ndarray, " reach"], fields: Float[np.ndarray, "field 2 ell"], pure: bool
) -> Float[np.ndarray, "field field 2 ell 2 ell"]:
    """Return half the covariance of pseudo-spectra EE, BB in a symmetric mask, per pair of fields.

    Such a mask does not mix orders m. If K_m turns the E and B of the sky into those of the masked
    map, their covariance at one order is G = K C K^T, and that of pseudo-spectra is sum_m 2 G^2 /
    ((2 l + 1) (2 l' + 1)). Only power beyond the last multipole is neglected. `mask` has a_l0 of
    the mask, `fields` are the spectra EE, BB of each field, and `pure` says if B is purified.
    """
    lmax, reach = fields.shape[-1] - 1, mask.size - 1
    nodes = (2 * lmax + reach) // 2 + 1
    theta, weight = ducc0.misc.GL_thetas(nodes), ducc0.misc.GL_weights(nodes, 1)
    zero = np.zeros(1, int)
    # The mask and its derivatives, which are maps of spin 0, 1, 2.
    alms = enumerate(mask * derivative_factors(mask.size))
    rings = [row @ ring_functions(n, reach, theta, zero)[0, 0] for n, row in alms]
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
        if pure:
            _, once, twice = pure_factors(lmax)[:, :, None]
            seen[1] -= once * first * ring_functions(1, lmax, theta, orders)[::-1]
            seen[1, 1] += twice * second * ring_functions(0, lmax, theta, orders)[0]
        low = max(int(orders[0]), 2)
        sky, seen = (np.moveaxis(x[..., low:, :], 2, 0) for x in (sky, seen * weight))
        count = np.where(orders == 0, 1.0, 2.0)  # orders -m add the same
        sums[:, :, :, low:, :, low:] += _squares(sky, seen, count, fields[..., low:])
    degrees = 2 * np.arange(lmax + 1) + 1
    return sums / (degrees[:, None, None] * degrees)


@jax.jit
def _squares(sky, seen, count, fields):
    """Sum products of the harmonics' covariances over orders, for each pair of fields."""

    def add(total, of_order):
        sky, seen, count = of_order
        rings = jnp.einsum("jclr,xjl,jdls->xcrds", sky, fields, sky)
        covariance = jnp.einsum("iclr,xcrds,jdms->xiljm", seen, rings, seen)
        return total + count * covariance[:, None] * covariance, None

    n, _, ell = fields.shape
    return jax.lax.scan(add, jnp.zeros((n, n, 2, ell, 2, ell)), (sky, seen, count))[0]


class PowerModel(NamedTuple):
    """Band powers D_b of BB [uK_CMB^2] and their covariance, as functions of r.

    `tensors` are those of r = 1, `lensing` includes A_lens, `additive` is noise and residuals,
    and the covariance is sum_xy p_x p_y terms[x, y] with p = (r, 1).
    """

    tensors: Float[np.ndarray, " bin"]
    lensing: Float[np.ndarray, " bin"]
    additive: Float[np.ndarray, " bin"]
    terms: Float[np.ndarray, "2 2 bin bin"]

    def mean(self, r: float) -> Float[np.ndarray, " bin"]:
        """Return the mean band powers."""
        return r * self.tensors + self.lensing + self.additive

    def covariance(self, r: float) -> Float[np.ndarray, "bin bin"]:
        """Return the covariance of the band powers, for negative r that of r = 0."""
        p = np.array([max(r, 0.0), 1.0])
        return np.einsum("x,y,xybc->bc", p, p, self.terms)


class TensorFit(NamedTuple):
    """The tensor-to-scalar ratio; see `fit_tensors`.

    The estimate may be negative. `sigma` includes cosmic variance of tensors and lensing, noise,
    and residuals as far as the model has them. 95 % of the posterior lies below `upper_95`; it is
    given on a grid of r >= 0, with the largest value 1. `probability` is that of exceeding `chi2`.
    `powers`, which were fitted, include noise and residuals; their covariance is that at r, and
    added powers change r by weights @ powers.
    """

    r: float
    sigma: float
    upper_95: float
    grid: Float[np.ndarray, " point"]
    posterior: Float[np.ndarray, " point"]
    chi2: float
    dof: int
    probability: float
    powers: Float[np.ndarray, " bin"]
    covariance: Float[np.ndarray, "bin bin"]
    model: PowerModel
    weights: Float[np.ndarray, " bin"]

    def shift(self, powers: Float[np.ndarray, " bin"]) -> float:
        """Return the bias of r if these powers were in BB and not in the model."""
        return float(self.weights @ powers)


def power_model(
    spectra: MaskedSpectra,
    window: Float[np.ndarray, " ell"],
    lensed: Float[np.ndarray, "4 ell"],
    tensors: Float[np.ndarray, "4 ell"],
    additive: Float[np.ndarray, " bin"],
    noise: Float[np.ndarray, " ell"],
    *,
    A_lens: float = 1.0,
    simulated: Float[np.ndarray, "sim bin"] | None = None,
) -> PowerModel:
    """Return the model of the band powers of BB, their mean and covariance.

    Parameters
    ----------
    spectra : from `fits.pseudo_cl.masked_spectra`
    window : b_l of the map, the one that `spectra` was made with
    lensed, tensors : C_l of TT, EE, BB, TE: lensed scalars, and tensors of r = 1 [uK_CMB^2]; up
        to `spectra.lmax` at least
    additive : band powers that noise and residuals add on average
    noise : C_l of noise and residuals in the map, window included, for the covariance
    A_lens : fraction of the lensing B modes in the map
    simulated : band powers of simulations with r = 0. The standard deviations of the analytic
        covariance are scaled to theirs, since it is exact only for symmetric masks and for
        uniform noise
    """
    lmax, bins = spectra.lmax, len(spectra.edges) - 1
    for name, given in {"lensed": lensed, "tensors": tensors}.items():
        good = np.ndim(given) == 2 and np.shape(given)[1] > lmax
        check_shape(name, np.asarray(given), good, f"have shape (4, ell) up to l = {lmax}")
    for name, given in {"window": window, "noise": noise}.items():
        good = np.ndim(given) == 1 and np.size(given) > lmax
        check_shape(name, np.asarray(given), good, f"reach l = {lmax}")
    additive = np.asarray(additive, float)
    of_bins = f"have a value for each of {bins} bins"
    check_shape("additive", additive, additive.shape == (bins,), of_bins)
    primordial = np.asarray(tensors)[1:3, : lmax + 1]
    scalars = np.asarray(lensed)[1:3, : lmax + 1] * np.array([[1.0], [A_lens]])
    squared = np.asarray(window)[: lmax + 1] ** 2
    fields = [primordial * squared, scalars * squared + np.asarray(noise)[: lmax + 1]]
    terms = 2 * covariance_terms(spectra, np.stack(fields))[:, :, 1, :, 1]
    binned, lensing = (np.einsum("bjl,jl->b", spectra.windows[1], C) for C in (primordial, scalars))
    model = PowerModel(binned, lensing, additive, terms)
    if simulated is None:
        return model
    simulated = np.asarray(simulated)
    good = simulated.ndim == 2 and simulated.shape[1] == bins and len(simulated) > 1
    two = f"have shape (sim, {bins}) with two simulations at least"
    check_shape("simulated", simulated, good, two)
    scale = np.std(simulated, axis=0, ddof=1) / np.sqrt(np.diagonal(model.covariance(0.0)))
    return model._replace(terms=terms * scale[:, None] * scale)


def fit_tensors(model: PowerModel, powers: Float[np.ndarray, " bin"]) -> TensorFit:
    """Estimate the tensor-to-scalar ratio from band powers.

    The posterior takes each power as the mean square of nu_b Gaussian modes, -2 ln L =
    sum_b nu_b [x - ln x] with x the power over the model's (Hamimeche & Lewis 2008), and nu_b from
    the variance at r = 0. On the full sky that is exact.

    Parameters
    ----------
    model : from `power_model`
    powers : band powers D_b of BB, including noise and residuals [uK_CMB^2]
    """
    powers = np.asarray(powers, float)
    good, form = powers.shape == model.tensors.shape, f"be {model.tensors.size} finite numbers"
    check_shape("powers", powers, good, form)
    check_finite("powers", powers)
    r, before = 0.0, np.inf
    for _ in range(STEPS):
        covariance = model.covariance(r)
        solved = np.linalg.solve(covariance, model.tensors)
        sigma = 1 / np.sqrt(float(model.tensors @ solved))
        if abs(r - before) < CLOSE * sigma:
            break
        r, before = float(solved @ (powers - model.mean(0.0))) * sigma**2, r
    rest = powers - model.mean(r)
    chi2, dof = float(rest @ np.linalg.solve(covariance, rest)), powers.size - 1
    grid = np.linspace(0.0, max(r, 0.0) + WIDTHS * sigma, POINTS)
    zero = model.mean(0.0)
    ratio = powers / (zero + grid[:, None] * model.tensors)
    modes = 2 * zero**2 / np.diagonal(model.covariance(0.0))
    # Decoupling from the mask may make a power negative; its logarithm is then cut.
    log_posterior = -0.5 * np.sum(modes * (ratio - np.log(np.maximum(ratio, 1e-3))), axis=1)
    posterior = np.exp(log_posterior - log_posterior.max())
    upper = float(np.interp(0.95, np.cumsum(posterior) / posterior.sum(), grid))
    return TensorFit(
        r=r,
        sigma=sigma,
        upper_95=upper,
        grid=grid,
        posterior=posterior,
        chi2=chi2,
        dof=dof,
        probability=float(scipy.special.chdtrc(dof, chi2)) if dof else np.nan,
        powers=powers,
        covariance=covariance,
        model=model,
        weights=solved * sigma**2,
    )
