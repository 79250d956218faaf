"""Spectral laws: closed forms, range, precision and gradients."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxsky import sed
from jaxsky.sed import H_OVER_K, T_CMB

LAWS = {
    "power_law": (sed.power_law, {"beta_syn": 3.1, "nu_ref": 30.0}),
    "curved_power_law": (
        sed.curved_power_law,
        {"beta_syn": 3.0, "curvature": -0.3, "nu_piv": 23.0, "nu_ref": 30.0},
    ),
    "modified_blackbody": (
        sed.modified_blackbody,
        {"beta_dust": 1.53, "T_dust": 21.0, "nu_ref": 353.0},
    ),
    "modified_blackbodies": (
        sed.modified_blackbodies,
        {
            "beta_dust": (1.67, 2.70),
            "T_dust": (9.4, 16.2),
            "E_dust": (0.49, 1.0),
            "nu_ref": 353.0,
            "nu_pivot": 3000.0,
        },
    ),
    "ame_log_parabola": (sed.ame_log_parabola, {"m60": 4.0, "nu_max": 19.0, "nu_ref": 23.0}),
    "cmb_derivative": (sed.cmb_derivative, {"T_cmb": T_CMB}),
    "thermal_sz": (sed.thermal_sz, {"T_cmb": T_CMB}),
}
NU = np.array([0.4, 1.0, 23.0, 30.0, 44.1, 70.4, 353.0, 857.0, 3000.0])


@pytest.fixture(params=LAWS, ids=str)
def law(request):
    return LAWS[request.param]


def test_every_public_law_is_swept():
    own = {
        name for name, law in vars(sed).items() if getattr(law, "__module__", "") == "jaxsky.sed"
    }
    assert {name for name in own if name[0] != "_"} == set(LAWS)


def test_modified_blackbody_is_the_textbook_formula():
    def planck(nu, T):
        return nu**3 / math.expm1(H_OVER_K * nu / T)

    for nu in NU:
        emissivity_times_planck = (nu / 353.0) ** 1.53 * planck(nu, 21.0) / planck(353.0, 21.0)
        expected = emissivity_times_planck / (nu / 353.0) ** 2  # brightness -> antenna temperature
        # The laws work with logarithms, whose rounding is that of ln S, up to ~60 here.
        assert float(sed.modified_blackbody(nu, 1.53, 21.0, 353.0)) == pytest.approx(
            expected, rel=1e-13
        )


def test_sum_of_bodies_is_the_papers_formula():
    def body(nu, beta, T):
        return (nu / 3000.0) ** (beta + 1) / math.expm1(H_OVER_K * nu / T)

    def total(nu):
        return 0.49 * body(nu, 1.67, 9.4) + body(nu, 2.70, 16.2)

    law, params = LAWS["modified_blackbodies"]
    for nu in NU:
        assert float(law(nu, **params)) == pytest.approx(total(nu) / total(353.0), rel=1e-13)


def test_one_body_in_a_sum_is_that_body_whatever_pivot_and_amplitude():
    one = sed.modified_blackbody(NU, 1.6, 19.0, 353.0)
    summed = sed.modified_blackbodies(NU, (1.6,), (19.0,), (0.3,), 353.0, 1000.0)
    np.testing.assert_allclose(summed, one, rtol=1e-13)


def test_curved_power_law_is_the_papers_formula():
    for nu in NU:
        expected = (nu / 30.0) ** (-3.0 + 0.3 * math.log(nu / 23.0))
        assert float(sed.curved_power_law(nu, 3.0, 0.3, 23.0, 30.0)) == pytest.approx(
            expected, rel=1e-13
        )


def test_ame_equals_the_papers_form_with_its_constant():
    def log_T(nu, m60=4.0, nu_max=19.0):
        L = math.log(nu_max / 60)
        return -(m60 * math.log(nu_max) / L + 2) * math.log(nu) + m60 / (2 * L) * math.log(nu) ** 2

    for nu in NU[1:-1]:
        assert float(sed.ame_log_parabola(nu, 4.0, 19.0, 23.0)) == pytest.approx(
            math.exp(log_T(nu) - log_T(23.0)), rel=1e-12
        )


def test_ame_parameters_mean_what_they_say():
    def log_flux(log_nu):
        nu = jnp.exp(log_nu)
        return jnp.log(nu**2 * sed.ame_log_parabola(nu, 4.0, 19.0, 23.0))

    slope = jax.grad(log_flux)
    assert float(slope(jnp.log(60.0))) == pytest.approx(-4.0, rel=1e-12)
    assert float(slope(jnp.log(19.0))) == pytest.approx(0.0, abs=1e-12)


def test_cmb_derivative_is_the_derivative_of_the_planck_law():
    def antenna(T, nu):
        x = H_OVER_K * nu / T
        return H_OVER_K * nu / jnp.expm1(x)

    nu = jnp.asarray(NU[:-1])  # e^x overflows the textbook form at none of these
    expected = jax.vmap(jax.grad(antenna), (None, 0))(T_CMB, nu)
    np.testing.assert_allclose(sed.cmb_derivative(nu), expected, rtol=1e-12)


def test_laws_are_one_at_the_reference(law):
    function, params = law
    if "nu_ref" in params:
        assert float(function(params["nu_ref"], **params)) == 1.0


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_finite_with_finite_gradients_from_radio_to_terahertz(law, dtype):
    function, params = law
    params = jax.tree.map(lambda v: jnp.asarray(v, dtype), params)
    slope = jax.value_and_grad(lambda nu, p: function(nu, **p), argnums=(0, 1))
    nu = jnp.asarray([0.4, 23.0, 353.0, 3000.0], dtype)
    value, gradient = jax.jit(jax.vmap(slope, (0, None)))(nu, params)
    assert value.dtype == dtype
    assert bool(jnp.isfinite(value).all())
    assert bool((value > 0).all()) or function is sed.thermal_sz
    assert all(bool(jnp.isfinite(g).all()) for g in jax.tree.leaves(gradient))


def test_cold_dust_at_terahertz_does_not_overflow_single_precision():
    # h nu / k T = 48 at 3 K and 3 THz: e^x is finite only through the logarithm below 1.6 K.
    nu, cold = jnp.float32(3000.0), jnp.float32(1.2)
    gradient = jax.grad(lambda T: sed.modified_blackbody(nu, 1.5, T, 353.0))(cold)
    assert bool(jnp.isfinite(gradient))


def test_single_precision_agrees_with_double(law):
    function, params = law
    single = jax.tree.map(jnp.float32, params)
    # ln S reaches 30; float32 keeps 1e-7 of it, so the law is good to a few 1e-6.
    np.testing.assert_allclose(
        function(NU[2:].astype(np.float32), **single), function(NU[2:], **params), rtol=2e-5
    )


def test_gradients_against_finite_differences(law):
    function, params = law

    def log_sed(log_nu, p):
        return jnp.log(jnp.abs(function(jnp.exp(log_nu), **p)))

    params, log_nu = jax.tree.map(jnp.asarray, params), jnp.log(jnp.array([0.4, 44.1, 353, 3000]))
    check_grads(log_sed, (log_nu, params), order=1, modes=["fwd", "rev"], rtol=1e-5, atol=1e-6)


def test_arguments_broadcast(law):
    function, params = law
    names = [n for n in inspect.signature(function).parameters if n != "nu"]
    assert function(NU[:, None], **params).shape == (NU.size, 1)
    first = names[0]
    maps = jax.tree.map(lambda v: jnp.full(5, v), params[first])
    assert function(NU[:, None], **{**params, first: maps}).shape == (NU.size, 5)
