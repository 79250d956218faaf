"""Instruments as data, and their bands."""

import numpy as np
import pytest

from jaxsky.observation import band_tables, load_instrument


@pytest.mark.parametrize("name", ["planck", "wmap", "core", "litebird"])
def test_presets_are_sound(name):
    tables, instrument = band_tables(name), load_instrument(name, samples=7)
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
    return {table["name"]: table["noise"]["level"] for table in band_tables(name)}


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
