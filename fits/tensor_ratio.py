"""The tensor-to-scalar ratio r from the B modes of a cleaned CMB map.

Band powers of BB are modelled as r T + A_lens L + N: tensors, lensing, and what noise and residual
foregrounds add. The estimate solves T^T C^-1 (D - r T - A_lens L - N) = 0 with C the covariance of
the powers in the model itself, at that r. It is linear in the powers, so it is unbiased where
errors from measured powers would pull it down, and at full sky it is the maximum of the exact
likelihood.
"""

from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from fits.power_covariance import covariance_terms
from fits.pseudo_cl import MaskedSpectra
from jaxsky.checks import check_shape

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
    given = {"lensed": lensed, "tensors": tensors, "window": window, "noise": noise}
    rows = {name: np.asarray(values) for name, values in given.items()}
    for name in ("lensed", "tensors"):
        good = rows[name].ndim == 2 and rows[name].shape[1] > lmax
        check_shape(name, rows[name], good, f"have shape (4, ell) up to l = {lmax}")
    for name in ("window", "noise"):
        good = rows[name].ndim == 1 and rows[name].size > lmax
        check_shape(name, rows[name], good, f"reach l = {lmax}")
    additive = np.asarray(additive, float)
    of_bins = f"have a value for each of {bins} bins"
    check_shape("additive", additive, additive.shape == (bins,), of_bins)
    scalars = rows["lensed"][1:3, : lmax + 1] * np.array([[1.0], [A_lens]])
    primordial = rows["tensors"][1:3, : lmax + 1]
    squared = rows["window"][: lmax + 1] ** 2
    fields = np.stack([primordial * squared, scalars * squared + rows["noise"][: lmax + 1]])
    terms = 2 * covariance_terms(spectra, fields)[:, :, 1, :, 1]
    windows = spectra.windows[1]
    model = PowerModel(
        np.einsum("bjl,jl->b", windows, primordial),
        np.einsum("bjl,jl->b", windows, scalars),
        additive,
        terms,
    )
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
    r = 0.0
    for _ in range(STEPS):
        solved = np.linalg.solve(model.covariance(r), model.tensors)
        information = float(model.tensors @ solved)
        weights, before = solved / information, r
        r = float(weights @ (powers - model.mean(0.0)))
        if abs(r - before) < CLOSE / np.sqrt(information):
            break
    covariance = model.covariance(r)
    solved = np.linalg.solve(covariance, model.tensors)
    sigma = 1 / np.sqrt(float(model.tensors @ solved))
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
