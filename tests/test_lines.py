"""Emission lines: closed forms, and PySM's code for CO."""

import jax
import jax.numpy as jnp
import numpy as np
import pysm3
import pytest
from jax.test_util import check_grads
from pysm3.models.co_lines import COLines

from jaxsky import Bandpass, Sky, observe, observe_band, set_parameters
from jaxsky.bandpass import conversion, response_at, stack_bands
from jaxsky.components import LineEmission, amplitude_from_line_intensity
from refusals import raises

NSIDE = 2
RNG = np.random.default_rng(2)
CO = {"10": 115.271, "21": 230.538, "32": 345.796}
MAPS = {line: 1e-4 * RNG.uniform(0, 1, (3, 12 * NSIDE**2)) for line in CO}
#: Across the first line, the second, and both.
BANDS = [np.linspace(90, 130, 41), np.geomspace(200, 260, 32), np.linspace(100, 240, 30)]


def component(line):
    """A line whose maps are in K_CMB at its frequency, as PySM converts them."""
    factor = conversion("K_CMB", "uK_RJ", CO[line], 2.7255)
    return LineEmission(factor * MAPS[line], CO[line])


def test_lines_are_pysms():
    model = object.__new__(COLines)
    model.nside, model.lines, model.has_polarization = NSIDE, list(CO), False
    model.line_frequency = {line: nu * pysm3.units.GHz for line, nu in CO.items()}
    model.planck_templatemap = {line: MAPS[line][0] * pysm3.units.K_CMB for line in CO}
    model.include_high_galactic_latitude_clouds = False
    sky = Sky({f"co{line}": component(line) for line in CO})
    for nu in BANDS:
        weights = 0.1 + np.hanning(nu.size)
        expected = model.get_emission(nu * pysm3.units.GHz, weights).value
        found = observe_band(sky, Bandpass(nu, weights, "power"))
        np.testing.assert_allclose(found[0], expected[0], rtol=1e-9)
        assert float(jnp.abs(found[0]).min()) > 0


def test_a_top_hat_dilutes_a_line_by_its_width():
    """A line of W = 2 K km/s, int T dnu = W nu / c, in 8 GHz; outside of the band nothing."""
    one = LineEmission(amplitude_from_line_intensity(2.0, 115.271) * jnp.ones((2, 12)))
    inside, outside = Bandpass.top_hat(115.0, 8.0), Bandpass.top_hat(130.0, 8.0)
    expected = 1e6 * 2.0 * 115.271 / 299792.458 / 8.0
    np.testing.assert_allclose(observe_band(Sky({"co": one}), inside), expected, rtol=1e-13)
    assert float(jnp.abs(observe_band(Sky({"co": one}), outside)).max()) == 0
    raises(ValueError, "A line has no law at one frequency", one.sed, 115.0)


@pytest.mark.parametrize("convention", ["RJ", "power", "CMB"])
def test_a_narrow_source_tends_to_a_line(convention):
    """The band average of a Gaussian in frequency, over many samples."""
    nu = np.linspace(100.0, 130.0, 3001)
    band = Bandpass(nu, 1 + 0.5 * np.sin(nu / 5), convention)
    narrow = np.exp(-0.5 * ((nu - 115.271) / 0.05) ** 2) / (0.05 * np.sqrt(2 * np.pi))
    average = np.dot(band.quadrature, narrow)
    assert float(response_at(115.271, band)) == pytest.approx(average, rel=1e-4)


def test_stacked_bands_have_the_same_response():
    bands = [Bandpass.top_hat(115.0, 20.0, samples=7), Bandpass.delta(115.0)]
    bands += [Bandpass(nu, 0.1 + np.hanning(nu.size)) for nu in BANDS]
    for nu in (115.271, 125.0, 130.0):
        alone = [float(response_at(nu, band)) for band in bands]
        np.testing.assert_allclose(response_at(nu, stack_bands(bands)), alone, rtol=1e-13)
        assert alone[1] == 0 < alone[2]


def test_derivatives_against_finite_differences():
    sky, bands = Sky({"co": component("10")}), [Bandpass(BANDS[0], 0.1 + np.hanning(41), "power")]

    @jax.jit
    def seen(nu, shift):
        return observe(set_parameters(sky, {"co.nu_ref": nu}), [bands[0].shifted(shift)])

    given = jnp.asarray(115.4), jnp.asarray(0.2)
    check_grads(seen, given, order=1, modes=["fwd", "rev"], rtol=1e-6)
