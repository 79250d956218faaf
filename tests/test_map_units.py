"""Maps of components in units of their own: Compton y, lines in K km/s, emission measures."""

import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits as pyfits
from pysm3.models.websky import y2uK_CMB

from jaxsky import Bandpass, FreeFree, Sky, observe, sed
from jaxsky.components.laws import (
    amplitude_from_compton,
    amplitude_from_emission_measure,
    amplitude_from_line_intensity,
)
from jaxsky.inputs import read_sky
from jaxsky.io import unit_name, write_maps
from jaxsky.settings import SettingsError, load
from settings_fuzz import written

NPIX = 192
MAP = np.random.default_rng(2).uniform(0.5, 2.0, NPIX)
T_E = np.linspace(5000.0, 9000.0, NPIX)


def component(folder, law, header, scale=1.0, stokes="I", nu_ref=100.0, **keys):
    """The component of a map, one number times `MAP`, that a file has in a unit."""
    write_maps(folder / "map.fits", scale * MAP[None], names=["I"], unit="", overwrite=True)
    with pyfits.open(folder / "map.fits", mode="update") as hdus:
        hdus[1].header["TUNIT1"] = header
    write_maps(folder / "T_e.fits", T_E[None], names=["TE"], unit="K", overwrite=True)
    sky = {"x": {"law": law, "file": "map.fits", "nu_ref": nu_ref, "stokes": "I"} | keys}
    settings = {"sky": sky, "data_dir": str(folder), "common": {"stokes": stokes}}
    found, _ = read_sky(load(written(folder / "x.toml", settings)), stokes)
    return found["x"].component


@pytest.mark.parametrize("stokes", ["I", "IQU"])
def test_compton_y(stokes, tmp_path):
    """Against the closed form in antenna temperature, and PySM's in thermodynamic."""
    found = component(tmp_path, "sz", "1", 1e-5, stokes, unit="1")
    assert len(found.amplitude) == len(stokes)
    np.testing.assert_allclose(found.amplitude[0], amplitude_from_compton(1e-5 * MAP, 100.0), 1e-12)
    np.testing.assert_array_equal(found.amplitude[1:], 0.0)
    for nu in (30.0, 143.0, 353.0):
        band = Bandpass.delta(nu)
        seen = observe(Sky({"x": found}), [band])[0, 0]
        np.testing.assert_allclose(seen, 10 * MAP * float(sed.thermal_sz(nu)), rtol=1e-10)
        thermodynamic = seen * float(band.conversion("uK_RJ", "uK_CMB"))
        np.testing.assert_allclose(thermodynamic, 1e-5 * MAP * y2uK_CMB(nu), rtol=2e-3)


def test_the_temperature_of_the_cmb_counts(tmp_path):
    found = component(tmp_path, "sz", "1", unit="1", parameters={"T_cmb": 2.6})
    np.testing.assert_allclose(found.amplitude[0], amplitude_from_compton(MAP, 100.0, 2.6), 1e-12)


@pytest.mark.parametrize("unit", ["K km/s", "K_RJ km/s", "K_RJ km s^-1", "K km s-1"])
def test_lines(unit, tmp_path):
    """A band of 1 GHz about the line sees int T dv nu / c."""
    assert unit_name(unit) == "K km / s"
    found = component(tmp_path, "line", unit, nu_ref=115.271)
    np.testing.assert_allclose(
        found.amplitude[0], amplitude_from_line_intensity(MAP, 115.271), 1e-12
    )
    band = Bandpass.top_hat(115.271, 1.0, samples=101)
    seen = observe(Sky({"x": found}), [band])[0, 0]
    np.testing.assert_allclose(seen, 1e6 * MAP * 115.271 / 299792.458, rtol=1e-9)
    millikelvin = component(tmp_path, "line", "mK km/s", 1e3, nu_ref=115.271)
    np.testing.assert_allclose(millikelvin.amplitude, found.amplitude, rtol=1e-12)


def test_emission_measures(tmp_path):
    """With one electron temperature, and a map of them."""
    found = component(tmp_path, "free_free", "cm^-6 pc", nu_ref=30.0, parameters={"T_e": 8000.0})
    expected = amplitude_from_emission_measure(MAP, 8000.0, 30.0)
    np.testing.assert_allclose(found.amplitude[0], expected, rtol=1e-12)
    default = component(tmp_path, "free_free", "pc cm^-6", nu_ref=30.0)
    expected = amplitude_from_emission_measure(MAP, 7000.0, 30.0)
    np.testing.assert_allclose(default.amplitude[0], expected, rtol=1e-12)
    of_map = {"T_e": {"file": "T_e.fits", "fields": ["TE"], "unit": "K"}}
    varying = component(tmp_path, "free_free", "pc cm^-6", nu_ref=30.0, parameters=of_map)
    expected = amplitude_from_emission_measure(MAP, T_E, 30.0)
    np.testing.assert_allclose(varying.amplitude[0], expected, rtol=1e-6)
    same = FreeFree(jnp.asarray(expected)[None], jnp.asarray(T_E), nu_ref=30.0)
    np.testing.assert_allclose(varying.sed(44.0), same.sed(44.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("law", "unit", "words"),
    [
        ("dust", "K km/s", r"sky.x.unit: Unit 'K km / s' does not convert to 'uK_RJ'"),
        ("dust", "1", "sky.x.unit: Unit '' does not convert to 'uK_RJ'"),
        ("sz", "K km/s", r"sky.x.unit: Unit 'K km / s' does not convert to 'uK_RJ'"),
        ("line", "1", "sky.x.unit: Unit '' does not convert to 'uK_RJ'"),
        ("line", "K_CMB km/s", "K_CMB km"),
    ],
)
def test_units_of_other_laws_are_refused(law, unit, words, tmp_path):
    with pytest.raises((SettingsError, ValueError), match=words):
        component(tmp_path, law, unit, unit=unit)
