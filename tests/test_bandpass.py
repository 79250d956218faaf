"""Bandpasses and units: conventions, averages, shifts, conversions against astropy."""

import itertools

import astropy.units as u
import jax
import jax.numpy as jnp
import numpy as np
import pysm3
import pytest
from jax.test_util import check_grads

from jaxsky import Bandpass, sed
from jaxsky.bandpass import CONVENTIONS, UNITS, average, conversion, parse_unit, stack_bands
from jaxsky.io import unit_factor
from jaxsky.sed import T_CMB
from refusals import cases, raises

NU = np.linspace(60.0, 80.0, 81)


def power_law(nu):
    return sed.power_law(nu, 3.0, 30.0)


def test_average_of_a_power_is_its_integral():
    # int nu^3 / int 1 over 60 ... 80; the trapezoid rule on 2001 samples is good to 1e-8.
    band = Bandpass.top_hat(70.0, 20.0, samples=2001)
    expected = (80.0**4 - 60.0**4) / 4 / 20.0
    assert float(average(lambda nu: nu**3, band)) == pytest.approx(expected, rel=1e-7)


def test_conventions_describe_one_detector():
    """The same response tabulated in three conventions observes the same sky."""
    rj = np.exp(-0.5 * ((NU - 70) / 5) ** 2)
    tables = {
        "RJ": rj,
        "power": rj / NU**2,
        "CMB": rj * np.asarray(conversion("K_CMB", "K_RJ", NU)),
    }
    assert set(tables) == set(CONVENTIONS)
    seen = [float(average(power_law, Bandpass(NU, w, c))) for c, w in tables.items()]
    np.testing.assert_allclose(seen, seen[0], rtol=1e-13)


def test_power_convention_is_pysms_formula():
    weights = np.linspace(1.0, 2.0, NU.size)
    S = np.asarray(power_law(NU))
    expected = np.trapezoid(weights * NU**2 * S, NU) / np.trapezoid(weights * NU**2, NU)
    assert float(average(power_law, Bandpass(NU, weights, "power"))) == pytest.approx(
        expected, rel=1e-13
    )


def test_uneven_samples_and_normalisation():
    nu = np.array([60.0, 61.0, 65.0, 72.0, 80.0])
    weights = np.array([1.0, 3.0, 2.0, 5.0, 1.0])
    S = np.asarray(power_law(nu))
    expected = np.trapezoid(weights * S, nu) / np.trapezoid(weights, nu)
    for factor in (1.0, 1e-20, 1e20):
        band = Bandpass(nu, factor * weights)
        assert float(average(power_law, band)) == pytest.approx(expected, rel=1e-13)
        assert float(band.quadrature.sum()) == pytest.approx(1.0)


def test_delta():
    assert float(average(power_law, Bandpass.delta(70.0))) == float(power_law(70.0))


def test_maps_are_summed_like_numbers():
    beta = jnp.linspace(2.5, 3.5, 7)
    band = Bandpass(NU, np.hanning(NU.size), "power")
    maps = average(lambda nu: sed.power_law(nu, beta, 30.0), band)
    numbers = [average(lambda nu, b=b: sed.power_law(nu, b, 30.0), band) for b in beta]
    np.testing.assert_allclose(maps, jnp.stack(numbers), rtol=1e-13)


def test_shift_and_stretch_move_the_band_and_keep_it_normalised():
    band = Bandpass(NU, np.hanning(NU.size), "power")
    shifted, stretched = band.shifted(1.5), band.stretched(1.2)
    np.testing.assert_allclose(shifted.nu, NU + 1.5)
    rj = Bandpass(NU, np.hanning(NU.size))
    assert float(rj.stretched(1.2).center) == pytest.approx(float(rj.center), rel=1e-13)
    assert float(np.ptp(stretched.nu)) == pytest.approx(1.2 * np.ptp(NU))
    for moved in (shifted, stretched):
        assert float(moved.quadrature.sum()) == pytest.approx(1.0)
        assert float(average(power_law, moved)) != pytest.approx(float(average(power_law, band)))
    # A moved table in the power convention is renormalised with nu^2 at its new frequencies.
    expected = Bandpass(NU + 1.5, np.hanning(NU.size), "power")
    assert float(average(power_law, shifted)) == float(average(power_law, expected))


@pytest.mark.parametrize(
    "convention", ["power", *(pytest.param(c, marks=pytest.mark.slow) for c in ("RJ", "CMB"))]
)
def test_gradients_against_finite_differences(convention):
    weights = jnp.asarray(np.hanning(NU.size) + 0.1)

    @jax.jit
    def seen(delta, factor, w):
        band = Bandpass(jnp.asarray(NU), w, convention)
        return 100 * average(power_law, band.shifted(delta).stretched(factor))

    @jax.jit
    def top_hat(center, width):
        return 100 * average(power_law, Bandpass.top_hat(center, width, convention))

    check_grads(seen, (jnp.asarray(0.3), jnp.asarray(1.1), weights), order=1, rtol=1e-6)
    check_grads(top_hat, (jnp.asarray(70.0), jnp.asarray(14.0)), order=1, rtol=1e-6)


def test_construction_inside_jit():
    @jax.jit
    def center(c, w):
        return Bandpass.top_hat(c, w).center

    assert float(center(70.0, 14.0)) == pytest.approx(70.0)


@pytest.mark.parametrize(("nu", "weights", "convention", "words"), cases("bandpass/bad_tables"))
def test_bad_tables_are_refused(nu, weights, convention, words):
    raises(ValueError, words, Bandpass, nu, weights, convention)


def test_top_hats_that_are_none_are_refused():
    raises(ValueError, "`width`", Bandpass.top_hat, 44.0, 0.0)
    raises(ValueError, "`samples`", Bandpass.top_hat, 44.0, 8.0, samples=1)


def test_stacked_bands_have_the_same_averages():
    bands = [Bandpass.top_hat(70.0, 20.0, samples=7), Bandpass.delta(44.0), Bandpass(NU, NU, "CMB")]
    stacked = stack_bands(bands)
    assert stacked.nu.shape == stacked.quadrature.shape == (3, NU.size)
    np.testing.assert_allclose(stacked.quadrature.sum(axis=1), 1)
    seen = jax.vmap(lambda band: average(power_law, band))(stacked)
    np.testing.assert_allclose(seen, [average(power_law, band) for band in bands], rtol=1e-14)


AT = np.array([0.4, 30.0, 143.0, 353.0, 857.0, 3000.0])


def test_against_astropy():
    for nu in AT[:-1]:
        rj = u.brightness_temperature(nu * u.GHz)
        cmb = u.thermodynamic_temperature(nu * u.GHz, T_CMB * u.K)
        assert float(conversion("uK_RJ", "MJy/sr", nu)) == pytest.approx(
            (1 * u.uK).to_value(u.MJy / u.sr, rj), rel=1e-12
        )
        assert float(conversion("mK_CMB", "Jy/sr", nu)) == pytest.approx(
            (1 * u.mK).to_value(u.Jy / u.sr, cmb), rel=1e-8
        )


#: A unit of each kind; others of a kind differ by a factor.
KINDS = {"K_RJ": "uK_RJ", "K_CMB": "mK_CMB", "MJy/sr": "Jy/sr"}


def test_round_trips_and_chains():
    for source, target in itertools.product(KINDS.values(), repeat=2):
        there, back = conversion(source, target, AT), conversion(target, source, AT)
        np.testing.assert_allclose(there * back, 1.0, rtol=1e-12)
        via = conversion(source, "K_RJ", AT) * conversion("K_RJ", target, AT)
        np.testing.assert_allclose(via, there, rtol=1e-12)
    for unit, (size, kind) in UNITS.items():
        assert conversion(unit, KINDS[kind], 30.0) == size / UNITS[KINDS[kind]][0]


def test_long_wavelengths_are_thermodynamic():
    assert float(conversion("K_CMB", "K_RJ", 0.4)) == pytest.approx(1.0, abs=1e-5)


def test_single_precision_is_finite_to_terahertz():
    for source, target in itertools.product(KINDS.values(), repeat=2):
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


def test_gradients_of_conversions():
    def over_band(center, width, nu_ref):
        return Bandpass.top_hat(center, width).conversion("K_CMB", "MJy/sr", nu_ref)

    args = tuple(map(jnp.asarray, (143.0, 40.0, 143.0)))
    check_grads(over_band, args, order=1, rtol=1e-6)
    check_grads(jax.tree_util.Partial(conversion, "K_CMB", "uK_RJ"), (jnp.asarray(143.0),), order=1)


#: PySM's names of units.
PYSM_UNITS = {"uK_RJ": pysm3.units.uK_RJ, "mK_CMB": pysm3.units.mK_CMB}
PYSM_UNITS["MJy/sr"] = pysm3.units.MJy / pysm3.units.sr


@pytest.mark.parametrize("pair", list(itertools.permutations(PYSM_UNITS, 2)), ids="-".join)
def test_pysms_conventions_are_arguments(pair):
    """Flat spectra in MJy/sr, and 2.7255 K, at a frequency and over a band."""
    source, target = pair
    nu = np.linspace(200.0, 320.0, 61)
    weights = 1e-3 + np.exp(-0.5 * ((nu - 250) / 30) ** 2)
    units = {"input_unit": PYSM_UNITS[source], "output_unit": PYSM_UNITS[target]}
    expected = pysm3.bandpass_unit_conversion(nu * u.GHz, weights, **units).value
    band = Bandpass(nu, weights, "power")
    for nu_ref in (None, 100.0):
        found = band.conversion(source, target, nu_ref, T_cmb=2.7255, flat=True)
        assert float(found) == pytest.approx(expected, rel=1e-9)
    again = unit_factor(source, target, band, T_cmb=2.7255, flat=True)
    assert again == pytest.approx(expected, rel=1e-9)
    expected = pysm3.bandpass_unit_conversion(217 * u.GHz, **units).value
    assert float(conversion(source, target, 217.0, 2.7255)) == pytest.approx(expected, rel=1e-8)
    assert unit_factor(source, target, 217.0, T_cmb=2.7255) == pytest.approx(expected, rel=1e-8)


def test_the_two_conventions_of_brightness():
    """nu I_nu or I_nu is constant: int W nu_c/nu over int W, closed for a top-hat in power."""
    band = Bandpass.top_hat(143.0, 40.0, "power", samples=2001)
    falling, flat = (band.conversion("K_CMB", "MJy/sr", 143.0, flat=flat) for flat in (False, True))
    assert float(flat / falling) == pytest.approx(143 / 40 * np.log(163 / 123), rel=1e-6)
    # At one frequency they are the same.
    delta = Bandpass.delta(143.0)
    assert float(delta.conversion("K_CMB", "MJy/sr", flat=True)) == pytest.approx(
        float(delta.conversion("K_CMB", "MJy/sr", 143.0)), rel=1e-13
    )


def test_gradient_of_a_conversion_in_the_temperature():
    def over_band(T_cmb):
        return Bandpass.top_hat(143.0, 40.0).conversion("K_CMB", "MJy/sr", T_cmb=T_cmb, flat=True)

    check_grads(over_band, (jnp.asarray(2.7255),), order=1, rtol=1e-6)


def test_unknown_unit_is_named():
    with pytest.raises(ValueError, match=r"Unknown unit 'K'; known units are .*K_CMB"):
        parse_unit("K")


def test_a_brightness_over_a_band_needs_its_frequency():
    with pytest.raises(ValueError, match=r"MJy/sr needs `nu_ref`"):
        Bandpass.top_hat(143.0, 40.0).conversion("K_CMB", "MJy/sr")
