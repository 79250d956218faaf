"""The thermal Sunyaev-Zeldovich effect: closed forms, its zero, and PySM's code."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from pysm3.models.websky import y2uK_CMB

from jaxsky import Bandpass, Sky, observe, sed, set_parameters
from jaxsky.components import ThermalSZ, amplitude_from_compton
from jaxsky.sed import H_OVER_K, T_CMB
from refusals import raises

NPIX = 12
Y = jnp.asarray(1e-5 * np.random.default_rng(5).uniform(0.1, 2, NPIX))
NU = np.linspace(200.0, 240.0, 41)


def component(nu_ref=100.0, T_cmb=T_CMB):
    maps = jnp.zeros((3, NPIX)).at[0].set(amplitude_from_compton(Y, nu_ref, T_cmb))
    return ThermalSZ(maps, T_cmb, nu_ref)


def closed_form(nu, T_cmb=T_CMB):
    """Antenna temperature per y [K_RJ]."""
    x = H_OVER_K * nu / T_cmb
    to_antenna = x**2 * math.exp(x) / math.expm1(x) ** 2
    return T_cmb * (x * (math.exp(x) + 1) / math.expm1(x) - 4) * to_antenna


@pytest.mark.parametrize("T_cmb", [T_CMB, 2.7255])
@pytest.mark.parametrize("nu_ref", [30.0, 143.0, 353.0])
def test_maps_of_compton_y_are_observed(nu_ref, T_cmb):
    """Whatever the reference, on both sides of the zero and over a band across it."""
    sky = Sky({"sz": component(nu_ref, T_cmb)})
    bands = [*map(Bandpass.delta, (0.4, 100.0, 217.0, 857.0)), Bandpass(NU, np.hanning(41) + 0.1)]
    seen = observe(sky, bands)
    assert float(jnp.abs(seen[:, 1:]).max()) == 0
    for nu, found in zip((0.4, 100.0, 217.0, 857.0), seen, strict=False):
        np.testing.assert_allclose(found[0], 1e6 * Y * closed_form(nu, T_cmb), rtol=1e-10)
    over = np.dot(bands[-1].quadrature, [closed_form(nu, T_cmb) for nu in NU])
    np.testing.assert_allclose(seen[-1, 0], 1e6 * Y * over, rtol=1e-10)


def test_the_law_is_zero_at_217_GHz():
    low, high = (float(sed.thermal_sz(nu)) for nu in (217.505, 217.507))
    assert low < 0 < high
    # Its slope stays finite there, and at long wavelengths the decrement is 2 T_cmb.
    slope = jax.grad(lambda nu: component().sed(nu))(217.5058)
    assert abs(float(slope)) > 1e-3
    assert float(sed.thermal_sz(0.1)) == pytest.approx(-2 * T_CMB, rel=1e-5)


def test_against_pysm():
    """Its h, k and T are others, so the functions of x are compared."""
    for nu in (30.0, 143.0, 217.0, 353.0, 857.0):
        T = H_OVER_K * 2.725 / (6.62607004e-27 * 1e9 / 1.380622e-16)
        found = sed.thermal_sz(nu, T) / (T * sed.cmb_derivative(nu, T))
        assert 2.725e6 * float(found) == pytest.approx(y2uK_CMB(nu), rel=1e-9)


def test_derivatives_against_finite_differences():
    bands = [Bandpass.delta(217.5), Bandpass(NU, np.hanning(41) + 0.1)]

    def seen(x):
        given = {"sz.T_cmb": T_CMB * x[0], "sz.nu_ref": 100 * x[1]}
        return observe(set_parameters(Sky({"sz": component()}), given), bands)

    def from_y(x):
        return amplitude_from_compton(Y * x[0], 100 * x[1], T_CMB * x[2])

    check_grads(seen, (jnp.ones(2),), order=1, modes=["fwd", "rev"], rtol=1e-6)
    check_grads(from_y, (jnp.ones(3),), order=1, modes=["fwd", "rev"], rtol=1e-6)


def test_a_reference_at_the_zero_is_refused():
    words = r"`nu_ref` must be at least 2 GHz from 217.5 GHz, where the law is zero, but is 217\."
    raises(ValueError, words, ThermalSZ, jnp.zeros((3, NPIX)), nu_ref=217.0)
    raises(ValueError, "not polarized", ThermalSZ, jnp.ones((2, NPIX)))
