"""The dipole and the kinematic quadrupole: closed forms, and PySM's code."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pysm3
import pytest
from jax.test_util import check_grads
from pysm3.models.dipole import CMBDipole

from jaxsky import Bandpass, Sky, observe, observe_band
from jaxsky.cmb import dipole, speed_of_dipole
from jaxsky.components import CMB, KinematicQuadrupole
from jaxsky.sed import H_OVER_K, T_CMB
from refusals import raises

NSIDE = 4
NPIX = 12 * NSIDE**2
NU = np.linspace(200.0, 240.0, 21)
WEIGHTS = 0.1 + np.hanning(NU.size)


@pytest.mark.parametrize("quadrupole", [False, True])
def test_the_dipole_is_pysms(quadrupole):
    # PySM converts K_CMB at astropy's 2.7255 K, whatever its T_cmb.
    T_cmb, direction = 2.7255, {"dip_lon": "263.986 deg", "dip_lat": "48.247 deg"}
    temperatures = {"amp": "3366.6 uK_CMB", "T_cmb": f"{T_cmb} K_CMB"}
    model = CMBDipole(NSIDE, **temperatures, **direction, quadrupole_correction=quadrupole)
    beta = speed_of_dipole(3366.6, T_cmb)
    sky = Sky(dipole(NSIDE, beta, T_cmb=T_cmb, quadrupole=quadrupole))
    assert list(sky) == ["dipole", "quadrupole"][: 1 + quadrupole]
    for nu, weights in ((np.array([30.0]), None), (np.array([545.0]), None), (NU, WEIGHTS)):
        expected = model.get_emission(nu * pysm3.units.GHz, weights).value
        band = Bandpass(nu, np.ones(len(nu)) if weights is None else weights, "power")
        found = observe_band(sky, band)
        np.testing.assert_allclose(found[0], expected, rtol=1e-9, atol=1e-7)
        assert float(jnp.abs(found[1:]).max()) == 0


def test_the_temperature_is_that_of_a_moving_observer():
    """To all orders, along the velocity, against it, and across it; at a high speed."""
    beta = 0.6
    lon, lat = healpy.pix2ang(NSIDE, 70, lonlat=True)
    (component,) = dipole(NSIDE, beta, lon, lat).values()
    assert type(component) is CMB
    assert float(component.amplitude[0, 70]) == pytest.approx(1e6 * T_CMB, rel=1e-12)  # 2 T
    back = healpy.vec2pix(NSIDE, *-np.array(healpy.pix2vec(NSIDE, 70)))
    assert float(component.amplitude[0, back]) == pytest.approx(-0.5e6 * T_CMB, rel=1e-12)
    assert float(speed_of_dipole(1e6 * T_CMB)) == pytest.approx(beta, rel=1e-13)


def test_second_orders_agree_at_long_wavelengths_but_for_the_monopole():
    """(x/2) coth(x/2) is 1, and the temperature T [1 + beta mu + beta^2 (mu^2 - 1/2)]."""
    beta, band = 1e-3, [Bandpass.delta(1e-2)]
    whole, parts = (
        observe(Sky(dipole(NSIDE, beta, quadrupole=q)), band)[0, 0] for q in (False, True)
    )
    np.testing.assert_allclose(parts - whole, 1e6 * T_CMB * beta**2 / 2, rtol=5e-3)


def test_the_law_of_the_quadrupole_is_the_second_derivative_of_plancks():
    """With the temperature along a direction to second order, T (1 + e), e = beta mu."""

    def antenna(e, nu):
        return T_CMB * H_OVER_K * nu / T_CMB / jnp.expm1(H_OVER_K * nu / (T_CMB * (1 + e)))

    law = KinematicQuadrupole(jnp.zeros((3, 12)))
    for nu in (30.0, 143.0, 353.0):
        # e + e^2 in the temperature itself is the first law, half of its square the second one.
        first, second = jax.grad(antenna)(0.0, nu), jax.grad(jax.grad(antenna))(0.0, nu)
        expected = (first + second / 2) / T_CMB
        assert float(law.sed(nu)) == pytest.approx(float(expected), rel=1e-10)


@pytest.mark.parametrize("quadrupole", [False, True])
def test_derivatives_against_finite_differences(quadrupole):
    @jax.jit
    def seen(x):
        speed, direction = 1.2e-3 * x[0], (264 * x[1], 48 * x[2])
        made = dipole(1, speed, *direction, T_cmb=T_CMB * x[3], quadrupole=quadrupole)
        return observe(Sky(made), [Bandpass(NU, WEIGHTS)])

    check_grads(seen, (jnp.ones(4),), order=1, modes=["fwd", "rev"], rtol=1e-6, atol=1e-5)


def test_bad_arguments_are_refused():
    raises(ValueError, "`nside` must be a power of 2, but is 3", dipole, 3, 0.001)
    raises(ValueError, "`beta` must be between -1 and 1, but is 370", dipole, 4, 370.0)
    raises(ValueError, "`longitude` must be a number", dipole, 4, 0.001, [1.0, 2.0])
    raises(ValueError, "`T_cmb` must be positive", dipole, 4, 0.001, T_cmb=-2.7)
