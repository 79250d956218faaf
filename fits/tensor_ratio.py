"""The tensor-to-scalar ratio r from the B modes of a cleaned CMB map, and that foregrounds equal.

Band powers of BB are modelled as r T + A_lens L + N: tensors, lensing, and what noise and residual
foregrounds add. The estimate solves T^T C^-1 (D - r T - A_lens L - N) = 0 with C the covariance of
the powers in the model itself, at that r. It is linear in the powers, so it is unbiased where
errors from measured powers would pull it down, and at full sky it is the maximum of the exact
likelihood.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import healpy
import numpy as np
import scipy.special
from jaxtyping import Float

from fits.full_sky import FIELDS
from fits.power_covariance import covariance_terms
from fits.pseudo_cl import PIVOT, MaskedSpectra, band_powers
from jaxsky import Bandpass, Sky, observe_band
from jaxsky.checks import check_shape
from jaxsky.harmonics import beam_ratio
from jaxsky.observation import ObservedBand

#: Bins whose middle is up to this multipole are taken for the bump of reionisation.
REIONISATION = 10
#: Steps of the search, and the change in standard deviations at which it ends.
STEPS, CLOSE = 50, 1e-6
#: The posterior is tabulated up to so many standard deviations above the larger of r and 0.
WIDTHS, POINTS = 8.0, 2001


class PowerModel(NamedTuple):
    """Band powers D_b of BB [uK_CMB^2] and their covariance, as functions of r.

    `tensors` are those of r = 1, `lensing` has A_lens in it, `additive` are noise and residuals,
    and the covariance is sum_xy p_x p_y terms[x, y] with p = (r, 1).
    """

    tensors: Float[np.ndarray, " bin"]
    lensing: Float[np.ndarray, " bin"]
    additive: Float[np.ndarray, " bin"]
    terms: Float[np.ndarray, "2 2 bin bin"]

    def mean(self, r: float) -> Float[np.ndarray, " bin"]:
        """Band powers."""
        return r * self.tensors + self.lensing + self.additive

    def covariance(self, r: float) -> Float[np.ndarray, "bin bin"]:
        """Their covariance; that of r = 0 for a negative one."""
        p = np.array([max(r, 0.0), 1.0])
        return np.einsum("x,y,xybc->bc", p, p, self.terms)


class TensorFit(NamedTuple):
    """The tensor-to-scalar ratio; see `fit_tensors`.

    The estimate may be negative. Its standard deviation has cosmic variance of tensors and lensing,
    noise, and residuals as far as the model has them. Below `upper_95` lie 95 % of the posterior,
    which is given on a grid of r >= 0 with the largest value 1. The probability is that to exceed
    chi2 of the powers, which were fitted with noise and residuals in them; their covariance is that
    at r, and r changes by weights @ powers.
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
        """By how much r would be off if these powers were in BB and not in the model."""
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
    """The mean and covariance of the band powers of BB.

    Parameters
    ----------
    spectra : from `fits.pseudo_cl.masked_spectra`
    window : b_l of the map, the one that `spectra` was made with
    lensed, tensors : C_l of TT, EE, BB, TE: lensed scalars, and tensors of r = 1 [uK_CMB^2]; up
        to `spectra.lmax` at least
    additive : band powers that noise and residuals add on average
    noise : their C_l in the map, window included, for the covariance
    A_lens : fraction of the lensing B modes in the map
    simulated : band powers of simulations with r = 0. The standard deviations of the analytic
        covariance are scaled to theirs: it is exact for masks that do not depend on longitude
        and for uniform noise only
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
    """The tensor-to-scalar ratio of band powers.

    The posterior takes each power as the mean of nu squares of Gaussian modes, -2 ln L =
    sum_b nu_b [x - ln x] with x the power over the model's (Hamimeche & Lewis 2008), and nu_b from
    the variance at r = 0. At full sky that is exact.

    Parameters
    ----------
    model : from `power_model`
    powers : band powers D_b of BB, noise and residuals in them [uK_CMB^2]
    """
    powers = np.asarray(powers, float)
    if powers.shape != model.tensors.shape or not np.isfinite(powers).all():
        raise ValueError(
            f"Argument `powers` must be {model.tensors.size} finite numbers, but has shape "
            f"{powers.shape} and {int(np.sum(~np.isfinite(powers)))} that are not finite."
        )
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
    grid, posterior = _posterior(model, powers, max(r, 0.0) + WIDTHS * sigma)
    held = np.cumsum(posterior) / posterior.sum()
    return TensorFit(
        r,
        sigma,
        float(np.interp(0.95, held, grid)),
        grid,
        posterior,
        chi2,
        dof,
        float(scipy.special.chdtrc(dof, chi2)) if dof else np.nan,
        powers,
        covariance,
        model,
        solved * sigma**2,
    )


def _posterior(model: PowerModel, powers: np.ndarray, upper: float) -> tuple[np.ndarray, ...]:
    """Values of r from 0 on, and the posterior with a flat prior, largest value 1."""
    grid = np.linspace(0.0, upper, POINTS)
    mean = model.mean(0.0) + grid[:, None] * model.tensors
    modes = 2 * model.mean(0.0) ** 2 / np.diagonal(model.covariance(0.0))
    ratio = powers / mean
    # A power may be negative where noise was subtracted with the mask; then the mean decides.
    log = np.log(np.maximum(ratio, 1e-3))
    log_posterior = -0.5 * np.sum(modes * (ratio - log), axis=1)
    return grid, np.exp(log_posterior - log_posterior.max())


class BandLaw(NamedTuple):
    """A power law of band powers: D_l = amplitude (l / 80)^(slope + 2), and C_l ~ l^slope."""

    amplitude: float
    slope: float


def foreground_powers(
    sky: Sky, bands: Mapping[str, Bandpass], spectra: MaskedSpectra
) -> dict[str, Float[np.ndarray, "2 bin"]]:
    """Band powers D_b of EE and BB of a sky as each band sees it [uK_CMB^2].

    All foregrounds have the beam that is in the window of `spectra`.
    """
    return {
        name: band_powers(spectra, observe_band(sky, band) * band.conversion("uK_RJ", "uK_CMB"))
        for name, band in bands.items()
    }


def noise_weights(band: ObservedBand, lmax: int) -> Float[np.ndarray, " ell"]:
    """Beam over noise of Q and U of a band, b_l / sqrt(N_l) [1 / uK_CMB].

    Its inverse square is the noise; where that varies, pixels count by their weights.
    """
    noise = np.asarray(band.noise)
    level = noise * np.radians(1 / 60)
    if noise.ndim:
        pixel = healpy.nside2resol(healpy.npix2nside(noise.shape[-1]))
        level = pixel / np.sqrt(np.mean([1 / noise[-2, -2], 1 / noise[-1, -1]]))
    level = level * float(band.band.conversion("uK_RJ", "uK_CMB"))
    return np.asarray(beam_ratio(band.beam, 0.0, lmax)) / level


def _modes(spectra: MaskedSpectra) -> Float[np.ndarray, " bin"]:
    """Number of multipoles in each bin, each counted 2 l + 1 times."""
    return np.diff(np.square(spectra.edges)).astype(float)


def _inside(spectra: MaskedSpectra, fit: tuple[int, int], what: str) -> np.ndarray:
    """True for the bins that are within the multipoles of a fit."""
    edges = np.array(spectra.edges)
    inside = (edges[:-1] >= fit[0]) & (edges[1:] - 1 <= fit[1])
    if inside.sum() < 3:
        raise ValueError(
            f"The law of {what} takes three bins, but {inside.sum()} of those from l = {edges[0]} "
            f"to {edges[-1] - 1} are within the `fit` from {fit[0]} to {fit[1]}."
        )
    return inside


def fit_law(
    spectra: MaskedSpectra, powers: Float[np.ndarray, " bin"], fit: tuple[int, int], what: str
) -> BandLaw:
    """A straight line through log D_b against log l, bins counted as they have modes.

    `fit` has the first and last multipole of the bins that are fitted; messages name `what` it is.
    """
    inside = _inside(spectra, fit, what)
    D, ell = powers[inside], spectra.centers[inside]
    if D.min() <= 0:
        raise ValueError(
            f"The law of {what} takes positive band powers, but at l = {ell[D.argmin()]:g} that is "
            f"{D.min():.3g}; give another range or wider bins."
        )
    weights = np.sqrt(_modes(spectra)[inside])
    slope, logarithm = np.polyfit(np.log(ell / PIVOT), np.log(D), 1, w=weights)
    return BandLaw(float(np.exp(logarithm)), float(slope) - 2)


def band_correlation(
    spectra: MaskedSpectra,
    cross: Float[np.ndarray, " bin"],
    first: Float[np.ndarray, " bin"],
    second: Float[np.ndarray, " bin"],
    fit: tuple[int, int],
) -> float:
    """Mean correlation coefficient of two fields: that of the bins, counted as they have modes."""
    inside = _inside(spectra, fit, "correlated components")
    coefficients = cross[inside] / np.sqrt(first[inside] * second[inside])
    return float(np.average(coefficients, weights=_modes(spectra)[inside]))


def foreground_laws(
    sky: Sky, spectra: MaskedSpectra, fields: Sequence[str], fit: tuple[int, int]
) -> dict[str, float]:
    """Power laws of the components' spectra and the correlation of each pair, by their names.

    Those are the names of `fits.fisher.fiducial`.
    """
    maps = {name: sky[name].amplitude for name in sky}
    auto = {name: band_powers(spectra, values) for name, values in maps.items()}
    pairs = itertools.combinations(maps, 2)
    cross = {(a, b): band_powers(spectra, maps[a], maps[b]) for a, b in pairs}
    found: dict[str, float] = {}
    for field in fields:
        row = FIELDS.index(field)
        for name, D in auto.items():
            law = fit_law(spectra, D[row], fit, f"{field} of {name!r}")
            found |= {f"{field}.{name}.{kind}": value for kind, value in law._asdict().items()}
        for (a, b), D in cross.items():
            found[f"{field}.{a}.{b}.correlation"] = band_correlation(
                spectra, D[row], auto[a][row], auto[b][row], fit
            )
    return found


def equal_r(
    spectra: MaskedSpectra,
    powers: Float[np.ndarray, "2 bin"],
    law: BandLaw,
    tensors: Float[np.ndarray, "4 ell"],
) -> dict[str, float]:
    """The r whose primordial BB equals a band's foregrounds, at l = 80 and at reionisation.

    At l = 80 the foregrounds are those of the power law; at reionisation the band powers of the
    lowest bins against those that tensors have in them. `tensors` are C_l of TT, EE, BB, TE for
    r = 1 [uK_CMB^2], up to `spectra.lmax` and 80; `law` was fitted to BB.
    """
    primordial = PIVOT * (PIVOT + 1) / (2 * np.pi) * tensors[2, PIVOT]
    found = {f"l = {PIVOT}": float(law.amplitude / primordial)}
    low = spectra.centers <= REIONISATION
    if low.any():
        binned = np.einsum("bjl,jl->b", spectra.windows[1], tensors[1:3, : spectra.lmax + 1])
        weights = _modes(spectra)[low]
        found["reionisation"] = float(weights @ powers[1, low] / (weights @ binned[low]))
    return found
