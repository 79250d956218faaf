"""Instruments as data, and their bands."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky.instrument import Channel, Instrument, load_instrument

CHANNEL = {"name": "30", "center": 30.0, "width": 6.0, "fwhm": 32.0, "noise": 200.0}


@pytest.mark.parametrize("name", ["planck", "wmap", "core", "litebird"])
def test_presets_are_sound(name):
    instrument = load_instrument(name)
    centers = [float(channel.center) for channel in instrument]
    beams = [float(channel.fwhm) for channel in instrument]
    assert centers == sorted(centers)
    assert beams == sorted(beams, reverse=True)
    for channel, band in zip(instrument, instrument.bands(samples=7).values(), strict=True):
        assert band.nu.size == 7
        assert float(band.center) == pytest.approx(float(channel.center))
        assert float(band.nu[-1] - band.nu[0]) == pytest.approx(float(channel.width))
        assert 0.05 < float(channel.width / channel.center) < 0.45


def test_published_figures():
    planck, core, litebird = (load_instrument(n) for n in ("planck", "core", "litebird"))
    assert planck.names == ("30", "44", "70", "100", "143", "217", "353")
    # Planck 2018 results I, table 4, in uK deg.
    published = [3.5, 4.0, 5.0, 1.96, 1.17, 1.75, 7.31]
    np.testing.assert_allclose([c.noise for c in planck], np.multiply(published, 60))
    assert (len(core), len(litebird), len(load_instrument("wmap"))) == (15, 15, 5)
    assert {c.noise_unit for c in core} == {"uK_RJ"}
    assert float(core["795"].noise) == pytest.approx(3.60)
    assert float(core["45"].fwhm) == pytest.approx(23.3)
    # The arrays at 68 GHz have 19.91 and 31.77 uK arcmin; all bands together 2.16 (PTEP 2023).
    combined = 1 / np.sqrt(19.91**-2 + 31.77**-2)
    assert float(litebird["68"].noise) == pytest.approx(combined, abs=0.01)
    total = 1 / np.sqrt(sum(float(c.noise) ** -2 for c in litebird))
    assert total == pytest.approx(2.16, abs=0.01)


def test_select():
    planck = load_instrument("planck")
    some = planck.select(["353", "30"])
    assert some.names == ("353", "30")
    assert some["30"] is planck["30"]
    assert len(some.bands()) == 2


def test_numbers_are_traced():
    instrument = load_instrument("planck").select(["30", "44"])
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(instrument))

    @jax.grad
    def slope(channel):
        return jnp.sum(channel.band(5).nu ** 2)

    assert float(slope(instrument["44"]).center) == pytest.approx(2 * 5 * 44.1)


def test_unknown_names():
    with pytest.raises(
        KeyError, match="Unknown instrument 'spt'; known are planck, wmap, core, litebird"
    ):
        load_instrument("spt")
    wmap = load_instrument("wmap")
    with pytest.raises(KeyError, match="has no channel '44'; it has K, Ka, Q, V, W"):
        wmap["44"]
    with pytest.raises(KeyError, match="has no channel 'k'"):
        wmap.select(["K", "k"])
    with pytest.raises(TypeError, match="list of names, not the string 'Ka'"):
        wmap.select("Ka")


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"center": 0.0}, ValueError, "`center` must be positive"),
        ({"width": -1.0}, ValueError, "`width` must be positive"),
        ({"fwhm": 0}, ValueError, "`fwhm` must be positive"),
        ({"noise": float("nan")}, ValueError, "`noise` has 1 of 1 values that are not finite"),
        ({"width": 61.0}, ValueError, "`center - width / 2` must be positive"),
        ({"noise": [1.0, 2.0]}, ValueError, r"`noise` must be a number, but has shape \(2,\)"),
        ({"noise_unit": "uK"}, ValueError, "Unknown unit 'uK'"),
        ({"center": "30 GHz"}, TypeError, "`center` must be a number"),
    ],
)
def test_bad_channels(change, error, words):
    with pytest.raises(error, match=words):
        Channel(**(CHANNEL | change))


def test_bad_instruments():
    channel = Channel(**CHANNEL)
    for channels, error, words in [
        ([], ValueError, "at least one channel"),
        ([channel, channel], ValueError, r"different names, but are \['30', '30'\]"),
        ([channel, 44.0], TypeError, "Entry 1 of `channels` must be a Channel, not float"),
    ]:
        with pytest.raises(error, match=words):
            Instrument("mine", channels)


def test_observed_channels_have_their_noise_in_antenna_temperature():
    planck = load_instrument("planck")
    for name, band in planck.observed(target=60.0, samples=11).items():
        channel = planck[name]
        factor = channel.band(11).conversion("uK_CMB", "uK_RJ")
        assert float(band.noise) == pytest.approx(float(channel.noise * factor))
        assert (float(band.beam), float(band.target)) == (float(channel.fwhm), 60.0)
        assert band.band.nu.size == 11
    assert load_instrument("core").observed()["45"].target is None
    # COrE's noise is in antenna temperature already.
    assert float(load_instrument("core").observed()["45"].noise) == pytest.approx(8.61)
