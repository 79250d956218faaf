"""Presets against PySM 3, whose own functions are run on the same arrays; instruments as data."""

import builtins
import tomllib
from importlib.resources import files

import numpy as np
import pytest
from pysm3 import utils
from pysm3.models import dust, power_law

from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe_band
from jaxsky.io import read_maps
from jaxsky.observation import band_tables, load_instrument
from jaxsky.templates import from_pysm_beta, preset
from refusals import cases, raises

NPIX = 48
RNG = np.random.default_rng(0)
MAPS = RNG.normal(size=(3, NPIX))
BETA_D, T_D = RNG.normal(1.55, 0.1, NPIX), RNG.uniform(15, 25, NPIX)
BETA_S = RNG.normal(-3.0, 0.1, NPIX)

#: Monochromatic, and with weights in power units (Jy/sr), as PySM takes them.
BANDS = {
    "23 GHz": ([23.0], [1.0]),
    "100 GHz": ([100.0], [1.0]),
    "857 GHz": ([857.0], [1.0]),
    "30 GHz band": (np.linspace(24.0, 36.0, 13), 1 + RNG.random(13)),
    "353 GHz band": ([290.0, 300.0, 340.0, 355.0, 420.0], [0.1, 1.0, 2.0, 1.0, 0.3]),
}


def pysm(name, band, maps, *parameters):
    """PySM's emission, by its functions as they are before compilation.

    All templates refer to PySM's frequency for Q and U.
    """
    nu = np.asarray(band[0])
    weights = utils.normalize_weights(nu, np.asarray(band[1]))
    if name.startswith("d"):
        return dust.get_emission_numba.py_func(nu, weights, *maps, 353.0, 353.0, *parameters)
    arguments = (nu, weights, *maps, 23.0, 23.0, *parameters)
    if name == "s3":
        return power_law.get_emission_numba_IQU_curved.py_func(*arguments, 23.0, -0.052)
    return power_law.get_emission_numba_IQU.py_func(*arguments)


def seen(component, band):
    sky = Sky({"component": component})
    return observe_band(sky, Bandpass(*band, "power"), tolerance=1e-13)


@pytest.mark.parametrize(
    "band", [b if b[:2] in ("10", "35") else pytest.param(b, marks=pytest.mark.slow) for b in BANDS]
)
@pytest.mark.parametrize("name", ["d0", "d1", "s0", "s1", "s3"])
def test_presets_agree_with_pysm(name, band):
    parameters, arguments = {
        "d0": ((1.54, 20.0), {}),
        "d1": ((BETA_D, T_D), {"beta_dust": BETA_D, "T_dust": T_D}),
        "s0": ((-3.0,), {}),
        "s1": ((BETA_S,), {"beta_syn": from_pysm_beta(BETA_S)}),
        "s3": ((BETA_S,), {"beta_syn": from_pysm_beta(BETA_S)}),
    }[name]
    expected = pysm(name, BANDS[band], MAPS, *parameters)
    mine = seen(preset(name, MAPS, **arguments), BANDS[band])
    np.testing.assert_allclose(mine, expected, rtol=1e-12)


@pytest.mark.parametrize("band", ["100 GHz", "30 GHz band", "353 GHz band"])
def test_real_templates_agree_with_pysm(data_dir, band):
    folder = data_dir / "templates"
    path = folder / "pysm2_d1_QU353GHz_betad_Td_n64.fits"
    Q, U = read_maps(path).maps
    beta = read_maps(path, fields="BETA_D", unit="").maps[0]
    T = read_maps(path, fields="T_D", unit="K").maps[0]
    expected = pysm("d1", BANDS[band], (Q, Q, U), beta, T)[1:]
    component = preset("d1", np.array([Q, U]), beta_dust=beta, T_dust=T)
    np.testing.assert_allclose(seen(component, BANDS[band]), expected, rtol=1e-12)

    path = folder / "pysm2_s1_QU23GHz_betas_n64.fits"
    Q, U = read_maps(path).maps
    beta = read_maps(path, fields="BETA_S", unit="").maps[0]
    for name in ("s1", "s3"):
        expected = pysm(name, BANDS[band], (Q, Q, U), beta)[1:]
        component = preset(name, np.array([Q, U]), beta_syn=from_pysm_beta(beta))
        np.testing.assert_allclose(seen(component, BANDS[band]), expected, rtol=1e-12)


def test_constants_are_those_of_pysm():
    theirs = tomllib.loads((files("pysm3") / "data" / "presets.cfg").read_text())
    d0, s0 = preset("d0", MAPS), preset("s0", MAPS)
    s3 = preset("s3", MAPS, beta_syn=from_pysm_beta(BETA_S))
    assert float(d0.beta_dust) == theirs["d0"]["map_mbb_index"]
    assert float(d0.T_dust) == theirs["d0"]["map_mbb_temperature"]
    assert -float(s0.beta_syn) == theirs["s0"]["map_pl_index"]
    assert float(s3.curvature) == theirs["s3"]["spectral_curvature"]
    assert f"{float(s3.nu_piv):g} GHz" == theirs["s3"]["freq_curve"]
    d1 = preset("d1", MAPS, beta_dust=1.5, T_dust=20.0)
    s1 = preset("s1", MAPS, beta_syn=3.0)
    for name, component in {"d0": d0, "d1": d1, "s0": s0, "s1": s1, "s3": s3}.items():
        assert f"{float(component.nu_ref):g} GHz" == theirs[name]["freq_ref_P"]


def test_the_sign_of_beta():
    # PySM's -3 is this package's 3: both fall as frequency rises.
    assert float(from_pysm_beta(-3.0)) == 3.0
    falling = preset("s1", MAPS, beta_syn=from_pysm_beta(np.full(NPIX, -3.0)))
    np.testing.assert_allclose(falling.sed(46.0), 1 / 8, rtol=1e-14)
    with pytest.raises(ValueError, match=r"`beta_syn` must be from 0 .*its median.*from_pysm_beta"):
        preset("s1", MAPS, beta_syn=BETA_S)


def test_baseline():
    dust = preset("baseline_dust", MAPS[1:])
    synchrotron = preset("baseline_synchrotron", 2 * MAPS[1:])
    assert isinstance(dust, Dust)
    assert isinstance(synchrotron, Synchrotron)
    assert [float(x) for x in (dust.beta_dust, dust.T_dust, dust.nu_ref)] == [1.53, 21.0, 353.0]
    assert [float(x) for x in (synchrotron.beta_syn, synchrotron.nu_ref)] == [3.1, 30.0]
    assert float(synchrotron.curvature) == 0
    np.testing.assert_array_equal(synchrotron.amplitude, 2 * MAPS[1:])


def test_names_and_maps():
    for arguments, error, words in cases("presets/names_and_maps"):
        raises(getattr(builtins, error), words, preset, arguments.pop("name"), MAPS, **arguments)


@pytest.mark.parametrize("name", ["planck", "wmap", "core", "litebird", "pico", "so-lat", "spt-3g"])
def test_presets_are_sound(name):
    tables, instrument = band_tables(name), load_instrument(name, stokes="I", samples=7)
    assert list(instrument) == [table["name"] for table in tables]
    beams = [float(channel.beam) for channel in instrument.values()]
    assert beams == sorted(beams, reverse=True)
    centers = [float(channel.band.center) for channel in instrument.values()]
    assert centers == sorted(centers)
    for table, channel in zip(tables, instrument.values(), strict=True):
        center, width = table["bandpass"].values()
        assert channel.band.nu.size == 7
        assert float(channel.band.center) == pytest.approx(center)
        assert float(channel.band.nu[-1] - channel.band.nu[0]) == pytest.approx(width)
        assert 0.05 < width / center < 0.45


def levels(name):
    """Noise of an instrument as it was published, by channel."""
    found = {table["name"]: table["noise"]["level"] for table in band_tables(name)}
    return {band: level for band, level in found.items() if not isinstance(level, list)}


def test_published_figures():
    planck, core, litebird = (levels(name) for name in ("planck", "core", "litebird"))
    assert tuple(planck) == ("30", "44", "70", "100", "143", "217", "353")
    # Planck 2018 results I, table 4, in uK deg.
    published = [3.5, 4.0, 5.0, 1.96, 1.17, 1.75, 7.31]
    np.testing.assert_allclose([*planck.values()], np.multiply(published, 60))
    assert (len(core), len(litebird), len(levels("wmap"))) == (15, 15, 5)
    assert {table["noise"]["unit"] for table in band_tables("core")} == {"uK_RJ"}
    assert core["795"] == pytest.approx(3.60)
    assert float(load_instrument("core")["45"].beam) == pytest.approx(23.3)
    # The arrays at 68 GHz have 19.91 and 31.77 uK arcmin; all bands together 2.16 (PTEP 2023).
    combined = 1 / np.sqrt(19.91**-2 + 31.77**-2)
    assert litebird["68"] == pytest.approx(combined, abs=0.01)
    total = 1 / np.sqrt(sum(level**-2 for level in litebird.values()))
    assert total == pytest.approx(2.16, abs=0.01)


def test_some_channels():
    planck = load_instrument("planck")
    some = load_instrument("planck", ["353", "30"])
    assert list(some) == ["353", "30"]
    assert float(some["30"].noise) == float(planck["30"].noise)


def test_unknown_names():
    with pytest.raises(
        KeyError, match="Unknown instrument 'spt'; known are planck, wmap, core, litebird"
    ):
        load_instrument("spt")
    with pytest.raises(KeyError, match="has no channel 'k'; it has K, Ka, Q, V, W"):
        load_instrument("wmap", ["K", "k"])
    with pytest.raises(TypeError, match="list of names, not the string 'Ka'"):
        load_instrument("wmap", "Ka")


def test_noise_is_in_antenna_temperature():
    published = levels("planck")
    for name, channel in load_instrument("planck", target=60.0, samples=11).items():
        factor = channel.band.conversion("uK_CMB", "uK_RJ")
        assert float(channel.noise) == pytest.approx(float(published[name] * factor))
        assert float(channel.target) == 60.0
        assert channel.band.nu.size == 11
    core = load_instrument("core")["45"]
    assert core.target is None
    # COrE's noise is in antenna temperature already.
    assert float(core.noise) == pytest.approx(8.61)
