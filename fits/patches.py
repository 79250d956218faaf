"""Fit power laws D_l = A (l/80)^(alpha + 2) to EE and BB on small patches of the sky.

On a patch of 400 square degrees a band has the power of ten modes or fewer. Its error grows with
the power itself, and errors from the measured power would favour low values, so the variance here
follows the law. The equations that A and alpha solve are linear in the powers: their mean is zero
at the true values, whatever the distribution of the powers (Wedderburn 1974). For one band without
noise that is the likelihood of a chi^2-distributed power. Neighbouring bands of a small patch are
correlated by -0.4, and are replaced by uncorrelated combinations.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.stats
from jaxtyping import Array, ArrayLike, Bool, Float

from fits.pseudo_cl import PIVOT, MaskedSpectra, band_powers, masked_spectra, mean_spectrum
from fits.tensor_ratio import covariance_terms
from jaxsky.checks import check_shape

#: The paper's multipoles, 40 to 100, in four bins.
EDGES = (40, 55, 70, 85, 101)
#: Coupling matrices that agree to this belong to the same mask at another place.
SAME = 2e-3
#: Least width in the variance of a power (`BandCombinations`), relative to the expected power:
#: otherwise a band in which the law predicts nothing would decide alone.
FLOOR = 0.3
#: Mean and standard deviation of the Gaussian prior of alpha. Dust has -2.4 (Planck intermediate
#: results 30, 2016).
SLOPE = (-2.4, 3.0)
#: Fewest standard deviations of an amplitude that counts as detected.
DETECTION = 2.0
#: Least amplitude for errors, as a fraction of the rms of the bands.
LEAST = 0.1


class PreparedPatches(NamedTuple):
    """Patches with everything that does not depend on the maps; from `prepare_patches`.

    `shapes` is the index of the first patch of the same shape, and `window` is b_l of the maps.
    """

    names: tuple[str, ...]
    spectra: tuple[MaskedSpectra, ...]
    shapes: tuple[int, ...]
    window: Float[np.ndarray, " ell"]


def prepare_patches(
    patches: Mapping[str, Float[np.ndarray, " pix"]],
    window: Float[np.ndarray, " ell"],
    *,
    edges: Sequence[int] = EDGES,
) -> PreparedPatches:
    """Prepare patches for the spectra of any number of maps.

    Parameters
    ----------
    patches : weight of each pixel by the name of the patch, for example `paper_patches(nside)`
    window : window b_l of the maps (beam and pixels)
    edges : first multipole of each bin, and the one after the last; three bins at least
    """
    if len(edges) < 4:
        raise ValueError(
            f"Argument `edges` must give three bins at least, for two parameters, not {edges}."
        )
    spectra: list[MaskedSpectra] = []
    shapes: list[int] = []
    if not patches:
        raise ValueError("Argument `patches` has no patch in it.")
    for i, (name, mask) in enumerate(patches.items()):
        try:
            one = masked_spectra(mask, edges, window=window)
        except ValueError as error:
            raise ValueError(f"Patch {name}: {error}") from error
        close = SAME * np.abs(one.mixing).max()
        same = (j for j in set(shapes) if np.allclose(spectra[j].mixing, one.mixing, 0, close))
        shapes.append(next(same, i))
        spectra.append(one)
    window = np.asarray(window, float)[: spectra[0].lmax + 1]
    return PreparedPatches(tuple(patches), tuple(spectra), tuple(shapes), window)


class PatchFits(NamedTuple):
    """A and alpha of each patch, for EE and BB (in this order); from `fit_patches`.

    The amplitude A = D_80, in the square of the maps' unit, may be negative where noise dominates;
    alpha is the slope of C_l. Their `covariance`, and the `errors` of the noise-subtracted band
    powers, are those of the law with the prior's slope and its best amplitude. `detected` means
    that A is more than twice its error; otherwise alpha says little.
    `pte` is the probability to exceed chi2 of the powers about the fit.
    """

    names: tuple[str, ...]
    A: Float[np.ndarray, "patch 2"]
    alpha: Float[np.ndarray, "patch 2"]
    covariance: Float[np.ndarray, "patch 2 2 2"]
    chi2: Float[np.ndarray, "patch 2"]
    pte: Float[np.ndarray, "patch 2"]
    detected: Bool[np.ndarray, "patch 2"]
    converged: Bool[np.ndarray, "patch 2"]
    powers: Float[np.ndarray, "patch 2 bin"]
    errors: Float[np.ndarray, "patch 2 bin"]
    centers: Float[np.ndarray, " bin"]


def fit_patches(
    maps: Float[Array, "2 pix"],
    patches: PreparedPatches,
    *,
    noise: float | Float[np.ndarray, "..."] | None = None,
    other: Float[Array, "2 pix"] | None = None,
    slope: tuple[float, float] = SLOPE,
) -> PatchFits:
    """Fit D_l = A (l/80)^(alpha + 2) to EE and BB of each patch.

    On simulated discs the mean A is 0.985 times the true one, alpha 0.1 of its standard deviation
    above, and both scatter by 0.9 to 1.1 of their errors, without noise and with as much noise as
    signal; alpha by less where its prior matters. Large-scale power leaks into the bands, and
    errors count it as for the mean slope: if spectra continue to the largest scales as C_l ~
    l^-2.8, errors are 20 % too small, with l^-3.2 by half and more, unless `slope` says so.

    Parameters
    ----------
    maps : Q and U, RING
    patches : from `prepare_patches`
    noise : noise of the maps, whose mean power is subtracted: a level [u arcmin], u being the unit
        of the maps, of white noise in their pixels; or its spectrum N_l in the maps, with the
        beam that they are smoothed with, of shape (ell,), (2, ell) for EE and BB, or
        (patch, 2, ell). By default none, or with `other` that of the difference of the two
    other : Q and U of another map with independent noise of the same level, for cross-spectra
    slope : mean and standard deviation of the Gaussian prior of alpha. It is wide, and
        bounds alpha where noise hides the signal; it moves alpha by 0.1 where the truth is 1 from
        its mean and the error is 1
    """
    maps = jnp.asarray(maps, float)
    other = None if other is None else jnp.asarray(other, float)
    if not slope[1] > 0 or not np.isfinite(slope).all():
        raise ValueError(f"Argument `slope` must be a mean and a positive width, not {slope}.")
    powers = np.zeros((len(patches.names), 2, len(patches.spectra[0].edges) - 1))
    for i, (patch, one) in enumerate(zip(patches.names, patches.spectra, strict=True)):
        try:
            powers[i] = band_powers(one, maps, other)
        except ValueError as error:
            raise ValueError(f"Patch {patch}: {error}") from None
    noises = _noise_spectra(noise, maps, other, patches)
    if other is None:
        bias = [
            np.einsum("ibjl,jklm,km->ib", one.inverse, one.mixing, row, optimize=True)
            for one, row in zip(patches.spectra, noises, strict=True)
        ]
        powers = powers - np.stack(bias)
    return _fit_powers(powers, noises, patches, other is not None, slope)


def _noise_spectra(
    noise: float | np.ndarray | None, maps: Array, other: Array | None, patches: PreparedPatches
) -> Float[np.ndarray, "patch 2 ell"]:
    """Return spectra of the noise in the maps on each patch."""
    lmax = patches.spectra[0].lmax
    shape = (len(patches.names), 2, lmax + 1)
    if noise is None:
        if other is None:
            return np.zeros(shape)
        half = (maps - other) / math.sqrt(2)
        rows = np.array([mean_spectrum(one.mask, half, lmax) for one in patches.spectra])
        return np.broadcast_to(rows[:, None], shape)
    values = np.asarray(noise, float)
    if not np.isfinite(values).all() or values.min() < 0:
        raise ValueError("Argument `noise` has values that are negative or not finite.")
    if not values.ndim:
        return np.full(shape, (values * math.radians(1 / 60)) ** 2)
    good = values.shape[-1] > lmax and values.shape[:-1] in ((), (2,), shape[:2])
    known = f"(ell,), (2, ell) or ({shape[0]}, 2, ell) and reach l = {lmax}"
    check_shape("noise", values, good, f"be a level or have shape {known}")
    return np.broadcast_to(values[..., : lmax + 1], shape)


def _fit_powers(powers, noises, patches, cross, slope):
    """Fit band powers (patch, 2, bin) from which the noise is subtracted.

    Noise has one spectrum for all patches in the covariance of EE and BB, with a level per patch.
    """
    first, (mean, spread) = patches.spectra[0], slope
    ell, ends = np.arange(first.lmax + 1), (first.edges[0], first.edges[-1] - 1)
    law = np.asarray(_law(ell, ends, mean, mean))
    to_C = np.where(ell > 1, 2 * math.pi / np.maximum(ell * (ell + 1), 1), 0.0)
    level = noises[..., ends[0] : ends[1] + 1].mean(axis=(1, 2))
    noise = (noises / np.where(level > 0, level, 1.0)[:, None, None]).mean(axis=0)
    form = _covariance_terms(patches, to_C * law * patches.window**2, noise, cross)

    def covariance(A):
        amplitudes = np.concatenate([np.maximum(A, least), level[:, None]], axis=1)
        return np.einsum("pixybc,px,py->pibc", form, amplitudes, amplitudes), amplitudes

    windows = np.stack([one.windows for one in patches.spectra]) * to_C
    means = windows @ law  # (p, i, b, of j)
    own = np.einsum("pibi->pib", means)
    # A first amplitude, for the mean slope, with errors of the signal without noise.
    signal = np.stack([form[:, i, i, i] for i in (0, 1)], axis=1)
    weights = np.linalg.solve(signal, own[..., None])[..., 0]
    A = np.sum(weights * powers, axis=-1) / np.sum(weights * own, axis=-1)
    least = LEAST * np.sqrt(np.mean((powers / own) ** 2, axis=-1))
    errors, amplitudes = covariance(A)
    A = amplitudes[:, :2]
    for name, one in zip(patches.names, errors, strict=True):
        if not one.any(axis=-1).all():
            raise ValueError(f"The patch {name} has neither signal nor noise.")
    turn = decorrelate(errors, own)
    seen = np.einsum("pibc,pic->pib", turn, own)
    leaked = np.einsum("pibj,pj->pib", means, A) - own * A[..., None]
    forms = np.einsum("pibc,pixycd,pibd->pibxy", turn, form, turn)
    parts = [
        _variances(forms[:, i][..., order, :][..., order], amplitudes[:, order], seen[:, i])
        for i, order in enumerate(([0, 1, 2], [1, 0, 2]))
    ]
    nu, offset, width = np.stack(parts, axis=2)
    data = np.einsum("pibc,pic->pib", turn, powers - leaked)
    laws = np.einsum("pibc,picl->pibl", turn, np.einsum("pibil->pibl", windows))
    scale = np.mean(offset + seen * A[..., None], axis=-1, keepdims=True)
    bands = BandCombinations(data / scale, nu, offset / scale, width / scale, laws)
    flat = jax.tree.map(lambda x: jnp.asarray(x.reshape(-1, *x.shape[2:])), bands)
    found = minimise(flat, jnp.asarray(slope), ends)
    A, alpha, straight, model, slopes, converged = (
        np.asarray(x).reshape(*A.shape, *x.shape[1:]) for x in found
    )
    A, straight, model = A * scale[..., 0], straight * scale[..., 0], model * scale
    # Errors are those of the mean slope, with its best amplitude.
    errors, amplitudes = covariance(straight)
    d, slopes = seen * amplitudes[:, :2, None], slopes * amplitudes[:, :2, None]
    spreads = turn @ errors @ np.swapaxes(turn, -1, -2)
    derivatives, variance = np.stack([seen, slopes], -1), 2 / nu * ((offset + d) ** 2 + width**2)
    parameters = _sandwich(derivatives, variance, spreads, spread)
    rest = data - model
    chi2 = np.sum(rest * np.linalg.solve(spreads, rest[..., None])[..., 0], axis=-1)
    return PatchFits(
        names=patches.names,
        A=A,
        alpha=alpha,
        covariance=parameters,
        chi2=chi2,
        pte=scipy.stats.chi2.sf(chi2, len(first.edges) - 3),
        detected=DETECTION * np.sqrt(parameters[..., 0, 0]) < A,
        converged=converged,
        powers=powers,
        errors=np.sqrt(np.einsum("pibb->pib", errors)),
        centers=first.centers,
    )


def _covariance_terms(
    patches: PreparedPatches, power: np.ndarray, noise: np.ndarray, cross: bool
) -> Float[np.ndarray, "patch 2 3 3 bin bin"]:
    """Return the covariance of EE and BB as a quadratic form of amplitudes of EE, BB and noise.

    `power` is C_l of a signal of amplitude 1, and `noise` are those of noise, (2, ell), as seen.
    """
    fields = np.array([[power, 0 * power], [0 * power, power], noise])
    of_shape = {i: covariance_terms(patches.spectra[i], fields) for i in set(patches.shapes)}
    terms = 2 * np.stack([np.einsum("xyibic->ixybc", of_shape[i]) for i in patches.shapes])
    if cross:  # Signal times noise counts once instead of twice, and noises differ.
        terms[:, :, 2] /= 2
        terms[:, :, :2, 2] /= 2
    return terms


def _law(ell: ArrayLike, ends: tuple[int, int], mean: ArrayLike, alpha: ArrayLike) -> Array:
    """Return D_l for A = 1; beyond the bins, where nothing is measured, it has the mean slope."""
    inside = jnp.clip(ell, *ends)
    return (inside / PIVOT) ** (alpha + 2) * (jnp.maximum(ell, 2) / inside) ** (mean + 2)


def decorrelate(
    covariance: Float[np.ndarray, "... bin bin"], expected: Float[np.ndarray, "... bin"]
) -> Float[np.ndarray, "... bin bin"]:
    """Return symmetric, uncorrelated combinations of bands that keep the expected powers.

    The inverse root of the covariance, after Hamilton & Tegmark (2000). Bands are left unchanged
    where it would have to be multiplied by negative numbers.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors / np.sqrt(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    sums = np.einsum("...bc,...c->...b", root, expected)
    good = (sums / expected > 0).all(axis=-1)[..., None, None]
    with np.errstate(divide="ignore"):
        return np.where(good, root * (expected / sums)[..., None], np.eye(root.shape[-1]))


class BandCombinations(NamedTuple):
    """Combinations d of bands with variance (2 / nu) ((d + offset)^2 + width^2)."""

    data: Float[Array, "... bin"]
    nu: Float[Array, "... bin"]
    offset: Float[Array, "... bin"]
    width: Float[Array, "... bin"]
    laws: Float[Array, "... bin ell"]  # d of D_l


def _variances(form, amplitudes, seen):
    """Return nu, offset and width (`BandCombinations`) of one field, given other amplitudes.

    `form` has the variances of d as a quadratic form of the amplitudes, those of the field first,
    (patch, bin, x, x); d is `seen` (patch, bin) for an amplitude of 1.
    """
    rest = amplitudes[:, 1:]
    square = form[..., 0, 0]
    offset = np.einsum("pbx,px->pb", form[..., 0, 1:], rest) / square * seen
    constant = np.einsum("pbxy,px,py->pb", form[..., 1:, 1:], rest, rest) / square * seen**2
    least = FLOOR * (offset + amplitudes[:, :1] * seen)
    return 2 * seen**2 / square, offset, np.sqrt(np.maximum(constant - offset**2, least**2))


def _sandwich(derivatives, variance, covariance, spread):
    """Return the covariance of solutions of G^T V^-1 (data - model) = 0, with a prior on alpha.

    G are derivatives of the model by the two parameters, (..., bin, 2), V the variance in the
    weights, whatever the covariance of the data; `spread` is the width of the prior.
    """
    prior = np.diag([0, spread**-2])
    weights = np.swapaxes(derivatives / variance[..., None], -1, -2)
    inverse = np.linalg.inv(weights @ derivatives + prior)
    return inverse @ (weights @ covariance @ np.swapaxes(weights, -1, -2) + prior) @ inverse


def _model(theta, bands, slope, ends):
    """Return d for A, and for alpha in standard deviations of its prior."""
    ell = jnp.arange(bands.laws.shape[-1])
    return theta[0] * (bands.laws @ _law(ell, ends, slope[0], slope[0] + slope[1] * theta[1]))


@partial(jax.jit, static_argnames="ends")
def minimise(bands: BandCombinations, slope: Array, ends: tuple[int, int]) -> tuple[Array, ...]:
    """Fit each row of bands, with powers of order one and the prior of alpha.

    Return A and alpha, the best A for the mean slope, d, its derivative by alpha for A = 1 and the
    mean slope, and whether a minimum was found.
    """
    solver: optx.AbstractMinimiser = optx.BFGS(1e-8, 1e-8)

    def deviance(theta, row):
        """Return -2 ln of quasi-likelihood, 2 int (d - data) / variance dd, and prior."""
        power = _model(theta, row, slope, ends) + row.offset
        terms = jnp.log(power**2 + row.width**2) / 2
        terms = terms - (row.data + row.offset) / row.width * jnp.arctan(power / row.width)
        return jnp.sum(row.nu * terms) + theta[1] ** 2

    def minimum(function, start, row):
        found: optx.Solution = optx.minimise(
            function, solver, start, args=row, max_steps=500, throw=False
        )
        good = jnp.isfinite(function(found.value, row))
        return jnp.where(good, found.value, start), good & (found.result == optx.RESULTS.successful)

    def fit(row):
        flat, zero = jnp.mean(row.data), jnp.zeros(())
        level, _ = minimum(lambda A, row: deviance(jnp.stack([A, zero]), row), flat, row)
        theta, good = minimum(deviance, jnp.stack([level, zero]), row)
        slopes = jax.jacfwd(_model)(jnp.array([1.0, 0.0]), row, slope, ends)[:, 1] / slope[1]
        alpha = slope[0] + slope[1] * theta[1]
        return theta[0], alpha, level, _model(theta, row, slope, ends), slopes, good

    return jax.vmap(fit)(bands)
