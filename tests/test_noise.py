"""Noise: the covariance of draws, what it is made from, and estimates from maps."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxsky import noise
from jaxsky.harmonics import alm_ell, analysis, synthesis
from refusals import cases, raises

KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def covariance():
    """A different correlated covariance of I, Q, U in each of 40 pixels."""
    root = np.random.default_rng(0).normal(size=(3, 3, 40))
    return jnp.einsum("stp,utp->sup", root, root) + 0.1 * jnp.eye(3)[..., None]


def sample_covariance(draws):
    """Mean over draws of the products of Stokes parameters in each pixel."""
    return np.einsum("dsp,dtp->stp", draws, draws) / len(draws)


def errors(covariance, count):
    """Sampling error of `sample_covariance` for Gaussian draws."""
    variance = np.einsum("ssp->sp", covariance)
    return np.sqrt((variance[:, None] * variance + covariance**2) / count)


def test_cholesky_factor(covariance):
    expected = np.linalg.cholesky(np.moveaxis(covariance, -1, 0))
    np.testing.assert_allclose(np.moveaxis(noise.cholesky(covariance), -1, 0), expected, rtol=1e-9)


def test_draws_have_the_covariance_of_each_pixel(covariance):
    draws = jax.vmap(noise.draw, (0, None))(jax.random.split(KEY, 4000), covariance)
    deviation = (sample_covariance(draws) - covariance) / errors(covariance, 4000)
    # 240 different elements: none beyond 5 standard deviations, and their scatter is 1.
    assert np.abs(deviation).max() < 5
    assert 0.85 < deviation.std() < 1.15
    # The mean has the error sqrt(C / 4000).
    mean = draws.mean(axis=0) / jnp.sqrt(jnp.einsum("ssp->sp", covariance) / 4000)
    assert np.abs(mean).max() < 5


def test_pixels_are_independent():
    root = np.array([[2.0, 0, 0], [0.7, 1.5, 0], [-0.4, 0.9, 1.1]])
    everywhere = jnp.asarray(root @ root.T)[..., None] * jnp.ones(200_000)
    draws = np.asarray(noise.draw(KEY, everywhere))
    # Sampling errors of a covariance over 2e5 pixels are below 1 % of these variances.
    np.testing.assert_allclose(np.cov(draws), root @ root.T, atol=0.06)
    neighbours = np.mean(draws[:, 1:] * draws[:, :-1], axis=1)
    np.testing.assert_allclose(neighbours, 0, atol=5 * 4 / 200_000**0.5)


def test_keys_give_independent_noise(covariance):
    uniform = noise.uniform_covariance(60.0, 64, stokes=3)
    keys = [
        jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(KEY, band), component), draw)
        for band in range(2)
        for component in range(2)
        for draw in range(2)
    ]
    draws = np.stack([noise.draw(key, uniform).ravel() for key in keys])
    # 8 maps of 147,456 values each: correlations within 5 standard deviations of 0.
    correlation = np.corrcoef(draws)
    np.testing.assert_allclose(correlation, np.eye(8), atol=5 / draws.shape[1] ** 0.5)
    np.testing.assert_array_equal(noise.draw(KEY, covariance), noise.draw(KEY, covariance))


def test_diagonal_of_the_factor_as_in_the_paper(covariance):
    keys = jax.random.split(KEY, 4000)
    draws = jax.vmap(lambda k: noise.draw(k, covariance, diagonal=True))(keys)
    inverse = np.moveaxis(np.linalg.inv(np.moveaxis(covariance, -1, 0)), 0, -1)
    variance = np.einsum("ssp->sp", covariance)
    # I keeps its variance; that of U is what I and Q leave open, 1 / (C^-1)_UU; Q is given I.
    expected = np.zeros((3, 3, 40))
    expected[0, 0], expected[2, 2] = variance[0], 1 / inverse[2, 2]
    expected[1, 1] = variance[1] - np.asarray(covariance[0, 1]) ** 2 / variance[0]
    deviation = (sample_covariance(draws) - expected) / errors(expected, 4000)
    assert np.abs(deviation).max() < 5
    assert np.all(expected[2, 2] < variance[2])
    # Without correlations both ways are one.
    uniform = noise.uniform_covariance(60.0, 4, stokes=3)
    np.testing.assert_array_equal(noise.draw(KEY, uniform, diagonal=True), noise.draw(KEY, uniform))


@pytest.mark.parametrize("diagonal", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_gradient_in_the_covariance(covariance, diagonal):
    drawn = jax.jit(lambda c: noise.draw(KEY, c, diagonal=diagonal))
    check_grads(drawn, (covariance,), order=1, rtol=1e-5, eps=1e-6)
    eager = noise.draw(KEY, covariance, diagonal=diagonal)
    np.testing.assert_allclose(drawn(covariance), eager, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_gradient_in_the_noise_level():
    hits = jnp.asarray(np.random.default_rng(0).uniform(5, 50, 12))
    rms = jnp.asarray(np.random.default_rng(1).uniform(1, 2, (2, 12)))
    for function, arguments in [
        (lambda n: noise.draw(KEY, noise.uniform_covariance(n, 1)), (50.0,)),
        (lambda n: noise.uniform_alm(KEY, n, 4), (50.0,)),
        (lambda s, h: noise.draw(KEY, noise.hits_covariance(s, h)), (1.5, hits)),
        (lambda r: noise.draw(KEY, noise.rms_covariance(r)), (rms,)),
    ]:
        check_grads(jax.jit(function), arguments, order=1, rtol=1e-5)


def test_single_precision(covariance):
    single = covariance.astype(jnp.float32)
    keys = jax.random.split(KEY, 4000)
    for diagonal in (False, True):
        draws = jax.vmap(lambda k, d=diagonal: noise.draw(k, single, diagonal=d))(keys)
        assert draws.dtype == jnp.float32
    draws = jax.vmap(noise.draw, (0, None))(keys, single)
    deviation = (sample_covariance(draws) - covariance) / errors(covariance, 4000)
    assert np.abs(deviation).max() < 5
    noise.check_covariance("covariance", single)
    assert noise.rms_covariance(jnp.abs(single[0])).dtype == jnp.float32
    assert noise.hits_covariance(jnp.float32(2), single[0, 0]).dtype == jnp.float32
    assert noise.covariance_from_columns(single[0]).dtype == jnp.float32
    assert noise.uniform_alm(KEY, jnp.float32(60), 8).dtype == jnp.float32


def test_uniform_noise_does_not_depend_on_nside():
    for nside in (16, 32):
        covariance = noise.uniform_covariance(60.0, nside)
        density = covariance[0, 0, 0] * healpy.nside2pixarea(nside, degrees=True) * 3600
        assert float(density) == pytest.approx(60.0**2)


@pytest.mark.parametrize("stokes", [1, 2, 3])
def test_uniform_noise_has_one_spectrum(stokes):
    nside, lmax = 64, 96
    level = np.radians(60.0 / 60) ** 2
    degree = alm_ell(lmax)
    alm = noise.uniform_alm(KEY, 60.0, lmax, stokes)
    assert alm.shape == (stokes, (lmax + 1) ** 2)
    from_pixels = analysis(noise.draw(KEY, noise.uniform_covariance(60.0, nside, stokes)), lmax)
    from_alm = analysis(synthesis(alm, nside), lmax)
    high = degree >= 2
    for coefficients in (alm, from_alm, from_pixels):
        # Of 9,405 coefficients a row: variances with an error of 1.5 %. Pixels that alias add
        # less than 1 % at l up to 1.5 nside.
        power = np.mean(np.asarray(coefficients)[:, high] ** 2, axis=1) / level
        np.testing.assert_allclose(power, 1, atol=0.07)
        # White: no trend over l, by the correlation of l and |a|^2.
        trend = np.corrcoef(degree[high], np.asarray(coefficients)[0, high] ** 2)[0, 1]
        assert abs(trend) < 5 / high.sum() ** 0.5
        # Rows are independent, and E and B have no monopole and dipole.
        correlation = np.corrcoef(np.asarray(coefficients)[:, high])
        np.testing.assert_allclose(correlation, np.eye(stokes), atol=5 / high.sum() ** 0.5)
        if stokes > 1:
            assert not np.asarray(coefficients)[-2:, ~high].any()
    assert stokes == 2 or np.all(alm[0, ~high] != 0)


def test_rms_and_hits():
    rng = np.random.default_rng(0)
    rms = rng.uniform(1, 3, (3, 20))
    expected = np.zeros((3, 3, 20))
    expected[[0, 1, 2], [0, 1, 2]] = rms**2
    np.testing.assert_allclose(noise.rms_covariance(rms), expected, rtol=1e-14)
    hits = rng.integers(1, 500, 20)
    np.testing.assert_allclose(
        noise.hits_covariance(1.4, hits), np.eye(2)[..., None] * 1.4**2 / hits, rtol=1e-14
    )
    sigma0 = np.array([1.43, 1.44, 1.45])
    expected[[0, 1, 2], [0, 1, 2]] = sigma0[:, None] ** 2 / hits
    np.testing.assert_allclose(noise.hits_covariance(sigma0, hits, 3), expected, rtol=1e-14)


def test_columns(covariance):
    I, Q, U = covariance  # noqa: E741
    planck = jnp.stack([I[0], I[1], I[2], Q[1], Q[2], U[2]])
    np.testing.assert_array_equal(noise.covariance_from_columns(planck), covariance)
    np.testing.assert_array_equal(noise.covariance_from_columns(planck[3:]), covariance[1:, 1:])


def test_covariances_that_cannot_be(covariance):
    noise.check_covariance("covariance", covariance)
    # More correlated than possible; of no variance; not a number.
    bad = covariance.at[2, 1, 3].set(2 * jnp.sqrt(covariance[1, 1, 3] * covariance[2, 2, 3]))
    bad = bad.at[:, :, 7].set(0).at[0, 0, 9].set(jnp.nan).at[0, 0, 11].multiply(-1)
    with pytest.raises(ValueError, match="`noise` is not positive definite in 4 of 40 pixels"):
        noise.check_covariance("noise", bad)
    with pytest.raises(ValueError, match=r"`noise` must have shape \(stokes, stokes, pix\), but"):
        noise.check_covariance("noise", covariance[:2])
    # Being traced, it has no values to look at.
    jax.jit(lambda c: noise.check_covariance("noise", c))(bad)


def test_bad_arguments():
    for function, arguments, words in cases("noise/bad_arguments"):
        raises(ValueError, words, getattr(noise, function), *arguments)
    raises(ValueError, "`stokes` must be 1, 2 or 3, not 4", noise.uniform_alm, KEY, 1.0, 4, 4)


def test_noise_is_estimated_from_a_smooth_sky():
    nside = 32
    sky = 10 * healpy.pix2vec(nside, np.arange(healpy.nside2npix(nside)))[0]
    maps = sky + noise.draw(jax.random.key(3), noise.uniform_covariance(300.0, nside))
    variance = noise.estimate_variance(maps, np.ones(sky.size, bool))
    expected = noise.uniform_covariance(300.0, nside)[0, 0, 0]
    # 9,216 degrees of freedom (sampling error 1.5 %) and a little of the dipole's gradient.
    np.testing.assert_allclose(variance, expected, rtol=0.06)
    with pytest.raises(ValueError, match="groups of four pixels"):
        noise.estimate_variance(maps, np.zeros(sky.size, bool))
