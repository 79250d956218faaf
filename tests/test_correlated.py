"""Correlated Gaussian fields: recovered spectra, repaired ones, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky.cmb import gaussian_fields, repair
from jaxsky.harmonics import alm_ell

LMAX = 40
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def spectra():
    """Spectra of dust E, B and AME E, B like those of the sky, zero below l = 2."""
    correlations = np.array(
        [[1, -0.1, 0.7, 0], [-0.1, 1, 0.05, 0.5], [0.7, 0.05, 1, -0.15], [0, 0.5, -0.15, 1]]
    )
    ell = np.arange(LMAX + 1)
    slopes = np.array([-2.4, -2.2, -2.8, -2.0])[:, None]
    root = np.sqrt([[4.0], [2.0], [0.1], [0.05]]) * np.maximum(ell, 1) ** (slopes / 2) * (ell > 1)
    return jnp.asarray(correlations[..., None] * root[:, None] * root)


def mixed(level, coefficient):
    """Three fields: none, no power in one, uncorrelated, valid, impossible, twice impossible."""
    ones, zero = jnp.ones(()), jnp.zeros(())
    c = coefficient

    def matrix(a, b, d):
        return jnp.array([[1, a, b], [a, 1, d], [b, d, 1]])

    blocks = [
        matrix(zero, zero, zero) * 0,
        matrix(c, zero, zero).at[2].set(0),
        matrix(zero, zero, zero),
        matrix(0.5 * c, 0.2 * ones, -0.3 * c),
        matrix(c, c, -0.8 * ones),
        matrix(-1.5 * c, -1.6 * c, -1.7 * ones),
    ]
    scale = jnp.array([1.0, 3.0, 1e-4]) * level
    return jnp.stack(blocks, axis=-1) * scale[:, None, None] * scale[:, None]


def test_a_single_field_is_white_noise_times_the_root_of_its_spectrum():
    spectrum = jnp.arange(5.0)
    white = jax.random.normal(KEY, (1, 25))
    expected = white * np.sqrt(spectrum)[alm_ell(4)]
    np.testing.assert_allclose(gaussian_fields(KEY, spectrum[None, None]), expected, rtol=1e-14)


def test_what_is_fine_is_left_as_it_is(spectra):
    mended, count = repair(spectra)
    assert int(count) == 0
    np.testing.assert_allclose(mended, spectra, rtol=1e-14)


def test_two_fields_that_are_too_correlated_become_proportional():
    # The closest coefficient to 1.3 is 1; the auto-spectra 4 and 9 stay, so the cross is 6.
    bad = jnp.array([[4.0, -7.8], [-7.8, 9.0]])[..., None]
    mended, count = repair(bad)
    assert int(count) == 1
    # Eigenvalues are kept above 1e-10, so the coefficient is 1 within that.
    np.testing.assert_allclose(mended[..., 0], [[4, -6], [-6, 9]], rtol=1e-9)
    E, B = gaussian_fields(KEY, mended)
    np.testing.assert_allclose(B, -1.5 * E, atol=1e-4 * float(jnp.abs(E).max()))


def test_impossible_correlations_are_counted_and_mended():
    given = mixed(1.0, 0.9)
    mended, count = repair(given)
    assert int(count) == 2
    np.testing.assert_allclose(mended[..., :4], given[..., :4], rtol=1e-14, atol=0)
    power = np.einsum("iil->li", mended)
    np.testing.assert_allclose(power, np.einsum("iil->li", given), rtol=1e-13)
    for ell in (4, 5):
        scale = np.sqrt(power[ell])
        correlations = np.asarray(mended[..., ell]) / np.outer(scale, scale)
        least = np.linalg.eigvalsh(correlations)[0]
        assert 0 < least < 1e-9
        assert abs(correlations).max() < 1 + 1e-9
        # Clipping the eigenvalues and scaling the diagonal back, written out.
        original = np.asarray(given[..., ell]) / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(original)
        assert values[0] < -0.1
        clipped = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        norm = np.sqrt(np.diag(clipped))
        np.testing.assert_allclose(correlations, clipped / np.outer(norm, norm), atol=1e-9)


def test_without_power_there_are_no_correlations():
    given = mixed(1.0, 0.9).at[0, 2, 1].set(5.0).at[2, 0, 1].set(5.0)
    mended, count = repair(given)
    assert int(count) == 2  # those of before; nothing had to be mended here
    assert np.all(mended[..., 0] == 0)
    assert np.all(mended[2, :, 1] == 0)
    fields = gaussian_fields(KEY, mended)
    assert bool(jnp.isfinite(fields).all())
    assert np.all(fields[:, alm_ell(5) == 0] == 0)
    assert np.all(fields[2, alm_ell(5) == 1] == 0)


@pytest.mark.parametrize("argument", [0, 1], ids=["level", "coefficient"])
def test_derivatives(argument):
    # Through multipoles without power, without correlations and with repaired ones.
    at = [jnp.asarray(1.3), jnp.asarray(0.9)]

    @jax.jit
    def fields(value):
        values = [*at[:argument], value, *at[argument + 1 :]]
        return gaussian_fields(KEY, repair(mixed(*values))[0])

    tangent = jax.jvp(fields, (at[argument],), (jnp.ones(()),))[1]
    h = 1e-4
    difference = (fields(at[argument] + h) - fields(at[argument] - h)) / (2 * h)
    # Of repaired fields the roots of eigenvalues 1e-10 carry rounding of 1e-11 / h.
    scale = np.abs(fields(at[argument])).max(axis=1, keepdims=True)
    np.testing.assert_allclose(tangent / scale, difference / scale, atol=1e-6)
    assert float(np.abs(tangent[2] / scale[2]).max()) > 0.1
    weights = jax.random.normal(jax.random.key(3), tangent.shape)
    pulled = jax.grad(lambda value: jnp.vdot(weights, fields(value)))(at[argument])
    assert float(pulled) == pytest.approx(float(jnp.vdot(weights, tangent)), rel=1e-9)


def test_derivatives_in_every_spectrum_are_finite():
    given = mixed(1.0, 0.9)
    slopes = jax.grad(lambda s: jnp.sum(gaussian_fields(KEY, repair(s)[0]) ** 2))(given)
    assert bool(jnp.isfinite(slopes).all())
    assert np.all(slopes[..., 0] == 0)
    assert float(slopes[0, 0, 2]) > 0
