"""Transforms against healpy, transposes and gradients; the CMB on top of them."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxsky import cmb
from jaxsky.harmonics import (
    adjoint_synthesis,
    alm_ell,
    alm_from_healpy,
    alm_to_healpy,
    analysis,
    average_pixels,
    gaussian_beam,
    resample,
    synthesis,
)

NSIDE, LMAX = 32, 64


@pytest.fixture(scope="module")
def alm():
    """healpy's coefficients (I, E, B) of a map with a falling spectrum."""
    ell = np.arange(LMAX + 1)
    spectrum = 1 / (ell + 1.0) ** 2 * (ell > 1)
    rng = np.random.default_rng(4)
    shape = (3, healpy.Alm.getsize(LMAX))
    draws = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    draws[:, : LMAX + 1].imag = 0
    return np.stack([healpy.almxfl(a, np.sqrt(spectrum)) for a in draws])


@pytest.mark.parametrize("rows", [slice(0, 1), slice(1, 3), slice(0, 3)], ids=["I", "QU", "IQU"])
def test_synthesis_and_analysis_against_healpy(alm, rows):
    maps = healpy.alm2map(alm, NSIDE, lmax=LMAX)[rows]
    packed = jnp.asarray(alm_from_healpy(alm[rows], LMAX))
    np.testing.assert_allclose(synthesis(packed, NSIDE), maps, atol=1e-10 * maps.std())
    back = np.asarray(analysis(jnp.asarray(maps), LMAX))
    # Ring weights and two Jacobi steps; band-limited to 2 nside.
    np.testing.assert_allclose(back, packed, atol=1e-4 * float(packed.std()))
    # healpy's own error with iter=3 is as large.
    reference = alm_from_healpy(healpy.map2alm(healpy.alm2map(alm, NSIDE), LMAX, iter=3), LMAX)
    assert np.abs(back - packed).max() < 2 * np.abs(reference[rows] - packed).max()


def test_packing_is_inverse_and_keeps_the_norm(alm):
    packed = alm_from_healpy(alm, LMAX)
    np.testing.assert_allclose(alm_to_healpy(packed, LMAX), alm, atol=1e-15)
    ell = alm_ell(LMAX)
    power = [np.sum(packed[0][ell == degree] ** 2) / (2 * degree + 1) for degree in range(LMAX + 1)]
    np.testing.assert_allclose(power, healpy.alm2cl(alm[0]), rtol=1e-12, atol=1e-18)


def test_transpose_of_synthesis():
    rng = np.random.default_rng(0)
    a = jnp.asarray(rng.normal(size=(2, (LMAX + 1) ** 2)))
    a = a.at[:, alm_ell(LMAX) < 2].set(0)  # spin 2 has no such modes
    m = jnp.asarray(rng.normal(size=(2, healpy.nside2npix(NSIDE))))
    left, right = jnp.vdot(synthesis(a, NSIDE), m), jnp.vdot(a, adjoint_synthesis(m, LMAX))
    assert float(left) == pytest.approx(float(right), rel=1e-11)


def test_smoothing_against_healpy(alm):
    maps = healpy.alm2map(alm, NSIDE, lmax=LMAX)
    fwhm = 300.0
    ours = resample(jnp.asarray(maps), gaussian_beam(fwhm, LMAX), NSIDE)
    theirs = healpy.smoothing(maps, fwhm=np.radians(fwhm / 60), lmax=LMAX, iter=10)
    # healpy's polarized beam is larger by exp(2 sigma^2), here 1.0027.
    ratio = np.exp(2 * (np.radians(fwhm / 60) / np.sqrt(8 * np.log(2))) ** 2)
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-4 * theirs[0].std())
    np.testing.assert_allclose(ours[1:] * ratio, theirs[1:], atol=1e-4 * theirs[1:].std())


def test_degrading_by_coefficients_keeps_what_fits(alm):
    maps = jnp.asarray(healpy.alm2map(alm, NSIDE, lmax=LMAX))
    low = resample(maps, jnp.ones(17), 8)
    kept = np.stack([healpy.resize_alm(a, LMAX, LMAX, 16, 16) for a in alm])
    # Multipoles 17 ... 64 that are cut leak in by 1e-3, the error of the quadrature.
    expected = healpy.alm2map(kept, 8, lmax=16)
    np.testing.assert_allclose(low, expected, atol=2e-3 * float(maps.std()))


def test_averaging_pixels_is_healpys(alm):
    maps = healpy.alm2map(alm, NSIDE, lmax=LMAX)
    np.testing.assert_allclose(average_pixels(maps, 8), healpy.ud_grade(maps, 8), atol=1e-12)


def test_gradient_in_the_beam():
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(2, healpy.nside2npix(8))))

    def smoothed(fwhm, m):
        return resample(m, gaussian_beam(fwhm * 100, 16), 4)

    check_grads(smoothed, (jnp.asarray(6.0), maps), order=1, rtol=1e-5)


def test_single_precision():
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(3, 768)), jnp.float32)
    assert resample(maps, gaussian_beam(jnp.float32(600.0), 16), 4).dtype == jnp.float32


def test_cmb_spectra_and_realisation():
    spectra = cmb.camb_spectra(LMAX, r=0.1)
    TT, _, BB, _ = spectra
    assert spectra.shape == (4, LMAX + 1)
    # D_l of TT at l = 10 is about 850 uK^2; r = 0.1 lifts BB over that of lensing.
    assert 700 < 110 / (2 * np.pi) * TT[10] < 1000
    assert BB[10] > 3 * cmb.camb_spectra(LMAX)[2][10]
    keys = jax.random.split(jax.random.key(0), 300)
    alms = jax.vmap(lambda k: cmb.realisation(k, jnp.asarray(spectra), "IQU"))(keys)
    ell = alm_ell(LMAX)
    for degree in (2, 30, 64):
        modes = np.asarray(alms[:, :, ell == degree]).swapaxes(0, 1).reshape(3, -1)
        measured = modes @ modes.T / modes.shape[1]
        tt, ee, bb, te = spectra[:, degree]
        expected = np.array([[tt, te, 0], [te, ee, 0], [0, 0, bb]])
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(
            measured / scale, expected / scale, atol=6 / modes.shape[1] ** 0.5
        )


def test_cmb_refuses_nonsense():
    with pytest.raises(ValueError, match="`r` must not be negative, but is -1"):
        cmb.camb_spectra(10, r=-1)
    with pytest.raises(ValueError, match="`stokes` must be 'QU' or 'IQU', not 'Q'"):
        cmb.realisation(jax.random.key(0), jnp.ones((4, 5)), "Q")
