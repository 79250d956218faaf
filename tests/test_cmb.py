"""The CMB: spectra from CAMB and Gaussian realisations of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky import cmb
from jaxsky.harmonics import alm_ell

LMAX = 64


def test_spectra_and_realisation():
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


def test_polarization_alone_is_that_of_a_realisation_with_intensity():
    spectra = jnp.asarray(cmb.camb_spectra(LMAX))
    key = jax.random.key(1)
    both = cmb.realisation(key, spectra, "IQU")
    np.testing.assert_array_equal(cmb.realisation(key, spectra), both[1:])


def test_tensors_are_what_r_adds():
    tensors = cmb.tensor_spectra(LMAX)
    assert tensors.shape == (4, LMAX + 1)
    # CAMB tilts them by -r/8, which is little for a small r.
    added = (cmb.camb_spectra(LMAX, r=1e-3) - cmb.camb_spectra(LMAX)) / 1e-3
    np.testing.assert_allclose(tensors[1:3, 2:], added[1:3, 2:], rtol=3e-3)
    assert not tensors[:, :2].any()


def test_refuses_nonsense():
    with pytest.raises(ValueError, match="`r` must not be negative, but is -1"):
        cmb.camb_spectra(10, r=-1)
    with pytest.raises(ValueError, match="`stokes` must be 'QU' or 'IQU', not 'Q'"):
        cmb.realisation(jax.random.key(0), jnp.ones((4, 5)), "Q")
