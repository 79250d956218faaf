"""The tensor-to-scalar ratio from band powers: closed forms, and skies of known r."""

import functools

import healpy
import numpy as np
import pytest

from fits import tensor_ratio
from fits.pseudo_cl import bin_edges, masked_spectra
from fits.regions import apodize
from fits.tensor_ratio import PowerModel, covariance_terms, fit_tensors, power_model
from jaxsky.cmb import camb_spectra, tensor_spectra
from jaxsky.harmonics import gaussian_beam
from refusals import cases, raises

NSIDE, LMAX = 16, 32
ELL = np.arange(LMAX + 1)
#: A bin for each multipole, and a last one that holds the rest.
EDGES = (*range(2, 20), 26)
WINDOW = np.asarray(gaussian_beam(300.0, LMAX))
NOISE = np.where(ELL > 1, np.deg2rad(5.0 / 60) ** 2, 0.0)


@functools.cache
def spectra():
    return masked_spectra(np.ones(12 * NSIDE**2), EDGES, window=WINDOW)


def model(**changes):
    noise = np.array([NOISE / np.maximum(WINDOW, 1e-9) ** 2] * 2)
    arguments = {
        "spectra": spectra(),
        "window": WINDOW,
        "lensed": camb_spectra(LMAX),
        "tensors": tensor_spectra(LMAX),
        "additive": np.einsum("bjl,jl->b", spectra().windows[1], noise),
        "noise": NOISE,
    }
    return power_model(**(arguments | changes))


def to_D(ell):
    return ell * (ell + 1) / (2 * np.pi)


def test_the_model_is_that_of_the_full_sky():
    """Powers of single multipoles with their cosmic variance, 2 C^2 / (2l + 1)."""
    ell = np.arange(2, 19)
    C = camb_spectra(LMAX, 0.0)[2] * 0.7
    found = model(A_lens=0.7)
    rows = slice(0, len(ell))
    np.testing.assert_allclose(found.lensing[rows], to_D(ell) * C[ell], rtol=1e-4)
    T = tensor_spectra(LMAX)[2]
    np.testing.assert_allclose(found.tensors[rows], to_D(ell) * T[ell], rtol=1e-4)
    for r in (0.0, 0.03):
        total = C + r * T + NOISE / WINDOW**2
        expected = np.sqrt(2 / (2 * ell + 1)) * to_D(ell) * total[ell]
        sigma = np.sqrt(np.diagonal(found.covariance(r)))[rows]
        np.testing.assert_allclose(sigma, expected, rtol=2e-3)
        np.testing.assert_allclose(found.mean(r)[rows], to_D(ell) * total[ell], rtol=1e-4)
    np.testing.assert_array_equal(found.covariance(-1.0), found.covariance(0.0))


def test_the_estimate_is_the_maximum_of_the_likelihood():
    """For uncorrelated powers of nu modes each, whatever their values."""
    tensors, rest, modes = np.array([3.0, 1.0]), np.array([2.0, 1.5]), np.array([9.0, 30.0])
    p = np.stack([tensors, rest])
    terms = np.einsum("xb,yb,bc->xybc", p, p, np.diag(2 / modes))
    one = PowerModel(tensors, rest, np.zeros(2), terms)
    for powers in (np.array([4.0, 2.0]), np.array([3.0, 1.9])):
        fit = fit_tensors(one, powers)

        def log_likelihood(r, powers=powers):
            total = rest + r * tensors
            return -0.5 * np.sum(modes * (powers / total + np.log(total)))

        step = 1e-5
        assert log_likelihood(fit.r + step) - log_likelihood(fit.r - step) == pytest.approx(
            0, abs=1e-8
        )
        # The posterior is that of modes at r = 0, the estimate its maximum.
        assert fit.grid[np.argmax(fit.posterior)] == pytest.approx(fit.r, abs=2e-3 * fit.sigma * 8)
        curve = np.array([log_likelihood(r) for r in fit.grid])
        np.testing.assert_allclose(fit.posterior, np.exp(curve - curve.max()), atol=1e-9)
        held = np.cumsum(np.exp(curve)) / np.exp(curve).sum()
        assert fit.upper_95 == pytest.approx(np.interp(0.95, held, fit.grid), rel=1e-9)


def test_powers_of_the_model_give_its_r_and_others_shift_it():
    one = model()
    fit = fit_tensors(one, one.mean(0.02))
    assert fit.r == pytest.approx(0.02, rel=1e-6)
    assert fit.chi2 < 1e-9
    assert fit.probability == pytest.approx(1)
    assert fit.dof == len(EDGES) - 2
    assert fit.shift(0.003 * one.tensors) == pytest.approx(0.003, rel=1e-9)
    left = np.abs(np.random.default_rng(0).normal(size=one.tensors.size)) * 1e-6
    moved = fit_tensors(one, one.mean(0.02) + left)
    # Linear, but for the change of the weights.
    assert moved.r - fit.r == pytest.approx(fit.shift(left), rel=0.02)
    negative = fit_tensors(one, one.mean(-0.001))
    assert negative.r == pytest.approx(-0.001, rel=1e-6)
    assert 0 < negative.upper_95 < fit_tensors(one, one.mean(0.001)).upper_95


def test_products_beyond_the_exact_ones_hardly_count(monkeypatch):
    """Outside a purified strip: errors to 1 % below the last exact multipole, that of r to 2 %."""
    nside = 32
    latitude = healpy.pix2ang(nside, np.arange(12 * nside**2), lonlat=True)[1]
    mask = apodize(np.abs(latitude) > 20, 20.0)
    outside = masked_spectra(mask, bin_edges(2, 58, 8), pure=True)
    fields = np.stack([of(2 * nside)[1:3] for of in (tensor_spectra, camb_spectra)])
    mean = outside.windows[1, :, 1] @ fields[0, 1]
    errors, informations = [], []
    for exact in (99, 24):
        monkeypatch.setattr(tensor_ratio, "EXACT_LMAX", exact)
        terms = covariance_terms(outside, fields)[1, 1, 1, :, 1]
        errors.append(np.sqrt(np.diagonal(terms)))
        informations.append(mean @ np.linalg.solve(terms, mean))
    np.testing.assert_allclose(errors[0][:2], errors[1][:2], rtol=0.01)
    np.testing.assert_allclose(errors[0], errors[1], rtol=0.05)
    assert not np.array_equal(*errors)
    assert informations[0] == pytest.approx(informations[1], rel=0.04)


def test_simulations_set_the_errors():
    rng = np.random.default_rng(1)
    one = model()
    std = np.sqrt(np.diagonal(one.covariance(0.0)))
    draws = rng.normal(size=(50, std.size)) * std * np.linspace(0.5, 2, std.size)
    scaled = model(simulated=draws)
    found = np.sqrt(np.diagonal(scaled.covariance(0.0)))
    np.testing.assert_allclose(found, draws.std(axis=0, ddof=1), rtol=1e-12)


@pytest.mark.parametrize(("changes", "words"), cases("tensor_ratio/bad_input"))
def test_bad_input_is_refused(changes, words):
    raises(ValueError, words, model, **changes)


def test_powers_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"`powers` must be 18 finite numbers, .* shape \(2,\)"):
        fit_tensors(model(), np.ones(2))
    raises(
        ValueError, "18 of 18 values that are not finite", fit_tensors, model(), np.full(18, np.nan)
    )
