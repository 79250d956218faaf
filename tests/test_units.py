"""Brightness units against astropy, and over bands."""

import astropy.units as u
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy import cosmology
from jax.test_util import check_grads

from jaxsky import Bandpass
from jaxsky.bandpass import UNITS, conversion, parse_unit
from jaxsky.sed import T_CMB

NU = np.array([0.4, 30.0, 143.0, 353.0, 857.0, 3000.0])


def test_against_astropy():
    assert cosmology  # the equivalencies live in astropy.units; cosmology is not consulted
    for nu in NU[:-1]:
        rj = u.brightness_temperature(nu * u.GHz)
        cmb = u.thermodynamic_temperature(nu * u.GHz, T_CMB * u.K)
        assert float(conversion("uK_RJ", "MJy/sr", nu)) == pytest.approx(
            (1 * u.uK).to_value(u.MJy / u.sr, rj), rel=1e-12
        )
        assert float(conversion("mK_CMB", "Jy/sr", nu)) == pytest.approx(
            (1 * u.mK).to_value(u.Jy / u.sr, cmb), rel=1e-8
        )


def test_round_trips_and_chains():
    for source in UNITS:
        for target in UNITS:
            there, back = conversion(source, target, NU), conversion(target, source, NU)
            np.testing.assert_allclose(there * back, 1.0, rtol=1e-12)
            via = conversion(source, "K_RJ", NU) * conversion("K_RJ", target, NU)
            np.testing.assert_allclose(via, there, rtol=1e-12)


def test_long_wavelengths_are_thermodynamic():
    assert float(conversion("K_CMB", "K_RJ", 0.4)) == pytest.approx(1.0, abs=1e-5)


def test_single_precision_is_finite_to_terahertz():
    for source in UNITS:
        for target in UNITS:
            assert bool(jnp.isfinite(conversion(source, target, jnp.float32(3000.0))))


def test_a_narrow_band_is_its_centre():
    band = Bandpass.top_hat(143.0, 1e-4)
    for source, target in (("uK_CMB", "uK_RJ"), ("K_CMB", "MJy/sr"), ("MJy/sr", "uK_RJ")):
        assert float(band.conversion(source, target, 143.0)) == pytest.approx(
            float(conversion(source, target, 143.0)), rel=1e-9
        )


def test_band_conversion_is_the_hfi_formula():
    # Planck 2013 results IX, eq. 32: U = int tau b' dnu / int tau (nu_c/nu) dnu.
    nu = np.linspace(120.0, 170.0, 400)
    tau = np.exp(-0.5 * ((nu - 143) / 12) ** 2)
    b_prime = np.asarray(conversion("K_CMB", "MJy/sr", nu))
    expected = np.trapezoid(tau * b_prime, nu) / np.trapezoid(tau * 143.0 / nu, nu)
    band = Bandpass(nu, tau, "power")
    assert float(band.conversion("K_CMB", "MJy/sr", 143.0)) == pytest.approx(expected, rel=1e-12)


def test_gradients_against_finite_differences():
    def over_band(center, width, nu_ref):
        return Bandpass.top_hat(center, width).conversion("K_CMB", "MJy/sr", nu_ref)

    args = tuple(map(jnp.asarray, (143.0, 40.0, 143.0)))
    check_grads(over_band, args, order=1, rtol=1e-6)
    check_grads(jax.tree_util.Partial(conversion, "K_CMB", "uK_RJ"), (jnp.asarray(143.0),), order=1)


def test_unknown_unit_is_named():
    with pytest.raises(ValueError, match=r"Unknown unit 'K'; known units are .*K_CMB"):
        parse_unit("K")


def test_a_brightness_over_a_band_needs_its_frequency():
    with pytest.raises(ValueError, match=r"MJy/sr needs `nu_ref`"):
        Bandpass.top_hat(143.0, 40.0).conversion("K_CMB", "MJy/sr")
