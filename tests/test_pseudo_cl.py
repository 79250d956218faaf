"""Spectra on part of the sky: coupling, means and errors over simulations, purified B."""

import functools
import itertools
import re

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ducc0.misc import wigner3j_int

from fits.discs import disc_mask
from fits.pseudo_cl import (
    band_powers,
    bin_edges,
    coupling_matrices,
    masked_spectra,
    pure_coupling_matrices,
)
from fits.tensor_ratio import covariance_terms
from jaxsky.cmb import gaussian_fields
from jaxsky.harmonics import expand, gaussian_beam, power_spectrum, synthesis
from refusals import cases

NSIDE, LMAX = 64, 128
EDGES = bin_edges(20, 79, 20)
ELL = np.arange(LMAX + 1)
#: C_l of D_l ~ l^-0.4, with more E than B, as dust has.
DUST = np.where(ELL > 1, np.array([[2.0], [1.0]]) * np.maximum(ELL, 2.0) ** -2.4, 0.0)
BEAM = np.asarray(gaussian_beam(120.0, LMAX))


def covariance_of(spectra, field):
    """Covariance of the band powers of one Gaussian field with spectra EE, BB."""
    return 2 * covariance_terms(spectra, field[None])[0, 0]


@functools.cache
def disc():
    return disc_mask(NSIDE, 40.0, 60.0, radius=25.0, fwhm=8.0)


@functools.partial(jax.jit, static_argnames="nside")
def sky(key, EE, BB, nside=NSIDE):
    """Maps Q, U of a Gaussian sky."""
    zero = jnp.zeros_like(EE)
    spectra = jnp.stack([jnp.stack([EE, zero]), jnp.stack([zero, BB])])
    return synthesis(gaussian_fields(key, spectra), nside)


def test_coupling_matrices_are_sums_of_wigner_symbols():
    lmax = 9
    power = np.random.default_rng(0).random(2 * lmax + 1)
    expected = np.zeros((2, lmax + 1, lmax + 1))
    for ell in range(2, lmax + 1):
        for other in range(2, lmax + 1):
            first, symbols = wigner3j_int(ell, other, 2, -2)
            third = first + np.arange(symbols.size)
            terms = (2 * third + 1) * power[third] * symbols**2 * (2 * other + 1) / (4 * np.pi)
            odd = (ell + other + third) % 2
            expected[0, ell, other] = terms[odd == 0].sum()
            expected[1, ell, other] = terms[odd == 1].sum()
    np.testing.assert_allclose(coupling_matrices(power, lmax), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("matrices", [coupling_matrices, pure_coupling_matrices])
def test_the_full_sky_does_not_couple(matrices):
    power = np.zeros(41)
    power[0] = 4 * np.pi  # of a map of ones
    same, mixed = matrices(power, 20)
    np.testing.assert_allclose(same[2:, 2:], np.eye(19), atol=1e-12)
    np.testing.assert_allclose(mixed, 0, atol=1e-12)


def test_purified_multipoles_do_not_mix():
    power = np.exp(-np.arange(61) / 4.0)
    same, mixed = pure_coupling_matrices(power, 30)
    assert np.abs(mixed).max() < 1e-12 * np.abs(same).max()
    standard = coupling_matrices(power, 30)
    assert np.abs(standard[1]).max() > 1e-2 * np.abs(standard[0]).max()


def test_the_full_sky_has_its_own_spectra():
    alm = gaussian_fields(jax.random.key(1), jnp.asarray(np.eye(2)[..., None] * DUST[0]))
    whole = np.ones(12 * NSIDE**2)
    spectra = masked_spectra(whole, EDGES, lmax=LMAX)
    D = ELL * (ELL + 1) / (2 * np.pi) * np.asarray(power_spectrum(alm))
    expected = [[row[a:b].mean() for a, b in itertools.pairwise(EDGES)] for row in D]
    # The quadrature without Jacobi steps.
    np.testing.assert_allclose(band_powers(spectra, synthesis(alm, NSIDE)), expected, rtol=1e-3)
    # A beam weights the multipoles of a bin, and the windows say how.
    spectra = masked_spectra(whole, EDGES, lmax=LMAX, window=BEAM)
    seen = band_powers(spectra, synthesis(alm * expand(jnp.asarray(BEAM)), NSIDE))
    expected = np.einsum("ibjl,jl->ib", spectra.windows, power_spectrum(alm))
    np.testing.assert_allclose(seen, expected, rtol=1e-3)


@functools.cache
def simulated(pure, count=300):
    """Band powers of simulated skies with the mask, and how they were taken."""
    spectra = masked_spectra(disc(), EDGES, lmax=LMAX, window=BEAM, pure=pure)
    seen = [jnp.asarray(row * BEAM**2) for row in DUST]
    keys = jax.random.split(jax.random.key(3), count)
    return spectra, np.stack([band_powers(spectra, sky(key, *seen)) for key in keys])


@pytest.mark.slow
@pytest.mark.parametrize("pure", [False, True])
def test_band_powers_are_those_of_the_sky_with_the_right_errors(pure):
    spectra, powers = simulated(pure)
    expected = np.einsum("ibjl,jl->ib", spectra.windows, DUST)
    # D_l at the middle of a bin is near; the first one is wide, and next to a wider one.
    middle = spectra.centers
    D = middle * (middle + 1) / (2 * np.pi) * np.array([[2.0], [1.0]]) * middle**-2.4
    np.testing.assert_allclose(expected, D, rtol=0.1)
    mean, error = powers.mean(axis=0), powers.std(axis=0, ddof=1)
    assert np.abs((mean - expected) / error).max() < 4 / np.sqrt(len(powers))
    covariance = covariance_of(spectra, DUST * BEAM**2)
    predicted = np.sqrt(np.einsum("ibib->ib", covariance))
    # Of a disc they are exact, and 300 skies measure a standard deviation to 4 %.
    np.testing.assert_allclose(predicted / error, 1, atol=0.1)
    # Not only the errors: all together, whatever the correlations.
    delta = (powers - expected).reshape(len(powers), -1)
    n = delta.shape[1]
    chi2 = np.einsum("si,ij,sj->s", delta, np.linalg.inv(covariance.reshape(n, n)), delta)
    assert chi2.mean() == pytest.approx(n, rel=0.1)


@functools.cache
def oblong(pure, count=200):
    """The same with a mask of two discs, that is not symmetric."""
    pair = [disc_mask(NSIDE, lon, 60.0, radius=12.0, fwhm=5.0) for lon in (20.0, 50.0)]
    spectra = masked_spectra(1 - (1 - pair[0]) * (1 - pair[1]), EDGES, lmax=LMAX, pure=pure)
    keys = jax.random.split(jax.random.key(10), count)
    rows = list(map(jnp.asarray, DUST))
    return spectra, np.std([band_powers(spectra, sky(key, *rows)) for key in keys], 0, ddof=1)


@pytest.mark.slow
def test_errors_with_a_mask_that_is_not_a_disc():
    spectra, error = oblong(False)
    predicted = np.sqrt(np.einsum("ibib->ib", covariance_of(spectra, DUST)))
    # 200 skies measure a standard deviation to 5 %.
    np.testing.assert_allclose(predicted / error, 1, atol=0.2)


@pytest.mark.slow
def test_errors_of_purified_B_are_too_small():
    spectra, error = oblong(True)
    alone = covariance_of(spectra, DUST)
    assert np.sqrt(alone[1, 0, 1, 0]) < 0.8 * error[1, 0]


@pytest.mark.slow
def test_terms_add_up_to_the_covariance_of_the_sum():
    spectra, _ = simulated(True)
    noise = np.full((2, LMAX + 1), 1e-4)
    terms = covariance_terms(spectra, np.stack([DUST, noise]))
    parts = 3.0**2 * terms[0, 0] + 3 * (terms[0, 1] + terms[1, 0]) + terms[1, 1]
    np.testing.assert_allclose(2 * parts, covariance_of(spectra, 3 * DUST + noise), rtol=1e-8)


def test_the_full_sky_has_the_variance_of_its_modes():
    spectra = masked_spectra(np.ones(12 * NSIDE**2), EDGES, lmax=LMAX)
    errors = np.sqrt(np.einsum("ibib->ib", covariance_of(spectra, DUST)))
    D = ELL * (ELL + 1) / (2 * np.pi) * DUST
    of_bins = [
        [np.sqrt(np.sum(2 * row[a:b] ** 2 / (2 * ELL[a:b] + 1))) / (b - a) for row in D]
        for a, b in itertools.pairwise(EDGES)
    ]
    np.testing.assert_allclose(errors, np.transpose(of_bins), rtol=1e-3)


def test_purified_B_does_not_see_E():
    EE = jnp.asarray(DUST[0])
    maps = sky(jax.random.key(4), EE, 0 * EE)
    levels = []
    for pure in (False, True):
        spectra = masked_spectra(disc(), EDGES, lmax=LMAX, pure=pure)
        EE_found, BB_found = band_powers(spectra, maps)
        levels.append(np.abs(BB_found).max() / EE_found.max())
        np.testing.assert_allclose(EE_found[0], DUST[0][20:40].mean() * 29.5**2 / 6.28, rtol=1)
    assert levels[1] < 1e-3
    assert levels[1] < levels[0] / 20


def test_cross_spectra_have_no_noise_in_the_mean():
    spectra = masked_spectra(disc(), EDGES, lmax=LMAX)
    signal = sky(jax.random.key(5), *map(jnp.asarray, DUST))
    noise = [1e-3 * jax.random.normal(jax.random.key(i), signal.shape) for i in (6, 7)]
    auto = band_powers(spectra, signal + noise[0])
    cross = band_powers(spectra, signal + noise[0], signal + noise[1])
    alone = band_powers(spectra, signal)
    np.testing.assert_allclose(band_powers(spectra, signal, signal), alone, rtol=1e-12)
    assert np.all(np.abs(cross - alone) < 0.5 * np.abs(auto - alone).max())


@pytest.mark.parametrize("pure", [False, True])
def test_pixels_that_are_not_used_may_hold_anything(pure):
    spectra = masked_spectra(disc(), EDGES, lmax=LMAX, pure=pure)
    maps = np.asarray(sky(jax.random.key(8), *map(jnp.asarray, DUST)))
    for unused in (healpy.UNSEEN, np.nan):
        others = np.where(disc() > 0, maps, unused)
        np.testing.assert_array_equal(band_powers(spectra, others), band_powers(spectra, maps))


def test_refusals():
    for mask, edges, options, words in cases("pseudo_cl/refusals"):
        with pytest.raises(ValueError, match=re.escape(words)):
            masked_spectra(mask, edges, **options)
    few = np.where(np.arange(12 * 8**2) < 3, 1.0, 0.0)
    with pytest.raises(
        ValueError, match=r"leaves too few pixels: 0.0039 of the sky has 0.082 modes"
    ):
        masked_spectra(few, (2, 5))
