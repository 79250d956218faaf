"""Bandpasses in files, and quantities with units."""

import numpy as np
import pysm3.units as pu
import pytest
from astropy import units as u
from astropy.io import fits as pyfits

from jaxsky.bandpass import Bandpass
from jaxsky.io import from_quantity, read_bandpass, unit_factor, unit_name
from refusals import refused

#: MJy/sr per K_CMB, Planck 2013 results IX, table 6.
HFI = {"100": 244.10, "143": 371.74, "217": 483.690, "353": 287.450, "545": 58.04, "857": 2.27}
NU = np.linspace(25.0, 35.0, 11)


def rimo(path, bands, unit="GHz", names=("WAVENUMBER", "TRANSMISSION")):
    """A Planck instrument model with some (name, frequencies, weights)."""
    tables = []
    for name, nu, weights in bands:
        columns = [
            pyfits.Column(name=n, format="D", array=v, unit=x)
            for n, v, x in zip(names, (nu, weights), (unit, "n/a"), strict=True)
        ]
        tables.append(pyfits.BinTableHDU.from_columns(columns, name=name))
    pyfits.HDUList([pyfits.PrimaryHDU(), *tables]).writeto(path)
    return path


def table(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("band", HFI)
def test_hfi_unit_conversions(data_dir, band):
    path = data_dir / "bandpass" / "HFI_RIMO_R3.00.fits"
    whole = read_bandpass(path, band)
    assert whole.convention == "power"
    factor = float(whole.conversion("K_CMB", "MJy/sr", float(band)))
    # 857 GHz hardly sees the CMB: its factor is all in the low-frequency tail.
    assert factor == pytest.approx(HFI[band], rel=0.01 if band == "857" else 0.005)


def test_trimmed_hfi_band(data_dir):
    path = data_dir / "bandpass" / "HFI_RIMO_R3.00.fits"
    bands = [read_bandpass(path, "353", trim=trim) for trim in (0, 1e-6)]
    whole, short = (float(b.conversion("K_CMB", "MJy/sr", 353.0)) for b in bands)
    assert bands[1].nu.size < bands[0].nu.size / 10
    assert short == pytest.approx(whole, rel=1e-7)


def test_hfi_polarized_average_differs(data_dir):
    path = data_dir / "bandpass" / "HFI_RIMO_R3.00.fits"
    factors = [
        float(read_bandpass(path, band).conversion("K_CMB", "MJy/sr", 353.0))
        for band in ("353", "PSB353")
    ]
    assert factors[1] / factors[0] == pytest.approx(1.00346, abs=1e-5)


def test_lfi_bands_and_detectors(data_dir):
    path = data_dir / "bandpass" / "LFI_RIMO_R3.31.fits"
    for band, center in {"030": 28.456, 44: 44.121, "70": 70.467}.items():
        average = read_bandpass(path, band)
        assert average.convention == "RJ"
        assert float(average.center) == pytest.approx(center, abs=1e-3)
    pair = [read_bandpass(path, "44", detectors=[d]) for d in ("24M", "LFI24s")]
    both = read_bandpass(path, detectors=("24M", "24S"))
    mean = sum(float(band.center) for band in pair) / 2
    assert float(both.center) == pytest.approx(mean, rel=1e-9)


def test_wmap_tables(data_dir):
    for band, center in {"K": 22.71, "Ka": 32.96, "Q": 40.66, "V": 60.65, "W": 93.45}.items():
        read = read_bandpass(data_dir / "bandpass" / f"wmap_{band}.tbl")
        assert read.convention == "power"
        assert float(read.center) == pytest.approx(center, abs=0.01)


def test_rimo_of_either_instrument(tmp_path):
    weights = np.exp(-((NU - 30) ** 2))
    bands = [("BANDPASS_030", NU, weights), ("BANDPASS_030", NU, weights)]
    lfi = read_bandpass(rimo(tmp_path / "lfi.fits", bands), "30")
    np.testing.assert_array_equal(lfi.nu, NU)
    assert lfi.convention == "RJ"
    # Wavenumbers from 0 on, one of them twice.
    k = np.concatenate([[0.0], NU[:6], NU[5:]]) / 29.9792458
    values = np.concatenate([[1e-9], weights[:5], [0.9, 1.1], weights[6:]])
    path = rimo(tmp_path / "hfi.fits", [("BANDPASS_F353", k, values)], "1/cm")
    hfi = read_bandpass(path, "F353")
    np.testing.assert_allclose(hfi.nu, NU, rtol=1e-15)
    assert float(hfi.weights[5]) == pytest.approx(1.0)
    assert hfi.convention == "power"
    assert read_bandpass(path, 353, convention="CMB").convention == "CMB"


def test_detectors_count_equally(tmp_path):
    wide = np.arange(20.0, 40.5, 0.5)
    bands = [("BANDPASS_030-27M", NU, 5 * np.ones(11)), ("BANDPASS_030-27S", wide, 0 * wide + 2)]
    path = rimo(tmp_path / "lfi.fits", bands)
    both = read_bandpass(path, "30", detectors=["27M", "27S"])
    weights = dict(zip(np.asarray(both.nu), np.asarray(both.weights), strict=True))
    assert weights[30.0] == pytest.approx((1 / 10 + 1 / 20) / 2)
    assert weights[22.0] == pytest.approx(1 / 20 / 2)


def test_text_tables(tmp_path):
    path = table(
        tmp_path / "b.txt", "nu weight", "# GHz", "28, 1", "", "30 2.0 0.1", "! end", "3.2D1\t1"
    )
    read = read_bandpass(path, convention="RJ")
    assert (read.nu.tolist(), read.weights.tolist()) == ([28, 30, 32], [1, 2, 1])
    ipac = ["\\ comment", "|nu|w|", "|double|double|", "|MHz| |", "|null|null|"]
    ipac = read_bandpass(table(tmp_path / "b.tbl", *ipac, "28000 1", "30000 2", "32000 1"))
    np.testing.assert_allclose(ipac.nu, [28, 30, 32])
    assert ipac.convention == "power"
    trimmed = read_bandpass(
        table(tmp_path / "t.txt", "1 1e-9", "2 1", "3 1e-9", "4 1", "5 1e-9"),
        convention="power",
        trim=1e-6,
    )
    assert trimmed.nu.tolist() == [2, 3, 4]


#: Columns of frequency and weight in GHz, and as other files have them.
SAMPLES = ([28.0, 30.5, 32.0], [1.0, 2.0, 0.5])


@pytest.mark.parametrize(
    ("content", "arguments"),
    [
        (b"28 1\n30.5 2\n32 .5\n", {}),
        (b"\xef\xbb\xbf28 1\n30.5 2\n32 .5\n", {}),
        ("28 1\n30.5 2\n32 .5\n".encode("utf-16"), {}),
        (b"28\t1\r\n30.5\t2\r\n32\t.5\r\n", {}),
        (b"28,1,0\n30.5,2,0\n32,.5,0\n", {}),
        (b"28;1\n30,5;2,0\n32;,5\n", {}),
        (b"nu weight\n2.8D+01 1d0\n30.5 2\n32 5D-01\n", {}),
        (b"# 30 GHz band\n28 1 # low\n30.5 2 ok\n32 .5\n", {}),
        (b"0 0\n28 1\n30.5 2\n32 .5\n", {}),
        (b"nu_MHz weight\n28000 1\n30500 2\n32000 .5\n", {}),
        (b"# the 30 GHz band: nu [Hz], T [K/GHz]\n28e9 1\n30.5e9 2\n32e9 .5\n", {}),
        (b"# nu/THz, weight\n.028 1\n.0305 2\n.032 .5\n", {}),
        (b"# channels in kHz\n# nu [MHz]\n28000 1\n30500 2\n32000 .5\n# mm\n", {}),
        (b".028 1\n.0305 2\n.032 .5\n", {"unit": "THz"}),
        (b"28 1\n30.5 2\n32 .5\n", {"unit": "GHz"}),
        (b"28000 1\n30500 2\n32000 .5\n", {"unit": "mhz"}),
        (b"i nu w\n0 28 1\n1 30.5 2\n2 32 .5\n", {"fields": [1, 2]}),
        (b"i nu w\n0 28 1\n1 30.5 2\n2 32 .5\n", {"fields": ["nu", "w"]}),
        (b"|i|nu|w|\n|int|d|d|\n||GHz||\n 0 28 1\n 1 30.5 2\n 2 32 .5\n", {"fields": ["nu", "w"]}),
    ],
)
def test_text_that_is_read_right(tmp_path, content, arguments):
    path = tmp_path / "b.txt"
    path.write_bytes(content)
    band = read_bandpass(path, convention="RJ", **arguments)
    np.testing.assert_allclose((band.nu, band.weights), SAMPLES, rtol=1e-12)


@pytest.mark.parametrize(
    ("content", "arguments"),
    [
        (b"# wavenumber [cm^-1]\n1 1\n2 3\n", {}),
        (b"1 1\n2 3\n", {"unit": "1/cm"}),
        (b"# wavelength in microns\n5000 3\n10000 1\n", {}),
        (b"5 3\n10 1\n", {"unit": "mm"}),
    ],
)
def test_wavenumbers_and_wavelengths(tmp_path, content, arguments):
    path = tmp_path / "b.txt"
    path.write_bytes(content)
    band = read_bandpass(path, convention="power", **arguments)
    np.testing.assert_allclose((band.nu, band.weights), ([29.9792458, 59.9584916], [1, 3]))


@pytest.mark.parametrize(
    ("content", "arguments", "words"),
    [
        (b"-1 1\n0 1\n", {}, "no sample at a positive frequency"),
        (b"|nu|w|\n|d|d|\n|parsec| |\n30 1\n", {}, "unit is 'parsec', not one of Hz, kHz, MHz"),
        (b"30,5 2,0\n31,0 1,0\n", {}, "line 1: '30,5' is two numbers or one with a decimal comma"),
        (b"nu w\n30.5 2\n31,5\t1\n", {}, "line 3: '31,5' is two numbers or one"),
        (b"30,5,2,0\n31,5,1,0\n", {}, "line 1: '30,5,2,0' may have decimal commas"),
        (b"3O.5 2\n31 1\n", {}, "line 1: not a row of numbers: '3O.5 2'"),
        (b"\xef\xbb\xbf3x 2\n31 1\n", {}, "line 1: not a row of numbers"),
        (b"nu 1\n30 1\n", {}, "line 1: not a row of numbers: 'nu 1'"),
        (b"30 1\n\n31 1_0\n", {}, "line 3: not a row of numbers: '31 1_0'"),
        (b"30 1\n|31 1|\n", {}, "line 2: a header among the rows"),
        (b"30 1\n31\x00 1\n", {}, "for it has NUL bytes"),
        ("30 1\n31 1\n".encode("utf-16-le"), {}, "for it has NUL bytes"),
        (b"", {}, "no line has numbers"),
        (b"0 28 1\n1 30 2\n2 32 1\n", {}, "first of 3 columns may not be the frequency; give"),
        (b"1 28 1\n2 30 2\n3 32 1\n", {}, "give `fields`, the columns of frequency and weight"),
        (b"row nu w\n7 28 1\n8 30 2\n", {}, r"the first of 3 columns \(row nu w\) may not be"),
        (b"weight nu\n1 28\n2 30\n", {}, r"the first of 2 columns \(weight nu\) may not be"),
        (b"28 30 1\n30 31 1\n", {"fields": [1, 3]}, "no column 3; it has 0 to 2"),
        (b"28 30 1\n30 31 1\n", {"fields": ["w", 1]}, "no column 'w'; it has 0 to 2"),
        (b"28 30 1\n30 31 1\n", {"fields": [1, 1]}, "`fields` names column 1 twice"),
        (b"28 30 1\n30 31 1\n", {"fields": [1]}, r"`fields` must name two columns, not \[1\]"),
        (b" ".join([b"1"] * 3000) + b"\n", {}, "3000 columns; give `fields`"),
        (b"28000 1\n30000 1\n", {}, "middle of the band is at 29000 GHz, .* give `unit`"),
        (b"0.028 1\n0.03 1\n", {}, "is at 0.029 GHz, outside of 1 to 3000 GHz; give `unit`"),
        (b"28e9 1\n30e9 1\n", {}, "outside of 1 to 3000 GHz; give `unit`"),
        (b"# nu [GHz]\n28e9 1\n30e9 1\n", {}, "is at 2.9e.10 GHz, outside of 0.01 to 30000 GHz"),
        (b"# nu [GHz] or [MHz]\n28 1\n30 1\n", {}, "names the units GHz, MHz; give `unit`"),
        (b"# nu [GHz]\n28 1\n30 1\n", {"unit": "MHz"}, "is 'MHz', but the file says 'GHz'"),
        (b"# horns in mm\n28 1\n30 1\n", {}, "what is in mm is not said; give `unit`"),
        (b"'30','1'\n31 1\n", {}, "line 1: not a row of numbers"),
        (b"3O,1x\n31 1\n", {}, "line 1: not a row of numbers"),
        (b"30 1\n31 2\n", {"fields": [0, True]}, "no column True; it has 0 to 1"),
        (b"# wavelength\n28 1\n30 1\n", {}, "unit of the frequencies is missing; give `unit`"),
        (b"|nu|w|\n|d|d|\n28 1\n30 1\n", {}, "unit of the frequencies is missing; give `unit`"),
        (b"28 1\n30 1\n", {"unit": "K"}, "unit is 'K', not one of Hz, kHz, MHz"),
        (b"-1 .5\n0 1\n30 1\n31 1\n", {}, "2 samples at nu <= 0 have weights"),
    ],
)
def test_text_that_is_refused(tmp_path, content, arguments, words):
    path = tmp_path / "b.txt"
    path.write_bytes(content)
    with refused(rf"b\.txt.*{words}"):
        read_bandpass(path, convention="RJ", **arguments)


def test_bad_rimos(tmp_path):
    ones = np.ones(11)
    good = [("BANDPASS_030", NU, ones), ("BANDPASS_030-27M", NU, ones), ("BEAM", NU, ones)]
    files = {
        "good": rimo(tmp_path / "good.fits", good),
        "beams": rimo(tmp_path / "beams.fits", good[2:]),
        "columns": rimo(tmp_path / "c.fits", good, names=("FREQ", "TRANSMISSION")),
        "unit": rimo(tmp_path / "unit.fits", good, "Angstrom"),
        "twice": rimo(tmp_path / "twice.fits", [*good, ("BANDPASS_030", NU, 1 + NU)]),
        "falling": rimo(tmp_path / "falling.fits", [("BANDPASS_030", NU[::-1], ones)]),
    }
    for name, arguments, words in [
        ("good", {}, r"good.fits: give `band`; it has 30\."),
        ("good", {"band": "44"}, r"no band '44'; it has 30\."),
        ("good", {"band": "30", "detectors": ["28S"]}, r"'28S' in band 30; it has 27M\."),
        ("good", {"detectors": []}, "`detectors` is empty"),
        ("beams", {"band": "30"}, r"no HDU is named BANDPASS_"),
        ("columns", {"band": "30"}, "no column 'WAVENUMBER'; it has FREQ, TRANSMISSION"),
        ("unit", {"band": "30"}, "has the unit 'Angstrom', not GHz or 1/cm"),
        ("twice", {"band": "30"}, "2 HDUs are named 'BANDPASS_030' and differ"),
        ("falling", {"band": "30"}, r"falling.fits: frequencies must increase"),
    ]:
        with refused(words):
            read_bandpass(files[name], **arguments)
    whole = files["good"].read_bytes()
    for length in (2000, 3000, len(whole) - 3000):
        cut = tmp_path / "cut.fits"
        cut.write_bytes(whole[:length])
        with refused(r"cut.fits"):
            read_bandpass(cut, "30")


def test_bad_arguments(tmp_path):
    path = table(tmp_path / "b.txt", "28 1", "30 2")
    binary = tmp_path / "b.dat"
    binary.write_bytes(b"\xff\xfe\x00")
    for arguments, words in [
        ({"path": path}, "b.txt: the file does not say it; give `convention`, one of RJ, power"),
        ({"path": path, "band": "30", "convention": "RJ"}, "a text table has one band"),
        ({"path": path, "convention": "flux"}, "one of RJ, power, CMB, not 'flux'"),
        ({"path": path, "convention": "RJ", "trim": 1.0}, r"`trim` must be within \[0, 1\)"),
        ({"path": tmp_path / "none.fits"}, "none.fits: no such file"),
        ({"path": binary}, "b.dat: neither a FITS file nor a text table"),
    ]:
        with pytest.raises(ValueError, match=words):
            read_bandpass(**arguments)


def test_unit_names():
    spellings = {
        "uK_RJ": ["uK_RJ", "uK RJ", "muK_rj", "\u03bcK_A", "microK_RJ", "uKantenna"],
        "K_CMB": ["K_CMB", "Kcmb", "K CMB", "K_cmb", "K,thermodynamic", "KCMB"],
        "mK_CMB^2": ["mK_CMB^2", "(mK_CMB)^2", "mKcmb**2", "mK_CMB2"],
        "MJy/sr": ["MJy/sr", "MJy sr-1", "MJy sr^-1", "Mjy/sr", "MJy / sr", "MJy.sr-1"],
        "MJy/sr^2": ["(MJy/sr)^2", "MJy2 / sr2"],
        "mK": ["mK"],
        "": ["", "1", "n/a", "dimensionless"],
        "GHz": ["GHz"],
    }
    for name, texts in spellings.items():
        assert {unit_name(text) for text in texts} == {name}
    for text in ("K_BANANA", "furlong_CMB", "counts of sheep"):
        with pytest.raises(ValueError, match="Unknown unit"):
            unit_name(text)


def test_quantities():
    band = Bandpass.top_hat(353.0, 80.0)
    assert from_quantity(353 * u.GHz, "GHz") == 353
    assert from_quantity([1.0, 2.0] * u.deg, "arcmin").tolist() == [60, 120]
    assert from_quantity(20000 * u.mK, "K") == pytest.approx(20)
    assert from_quantity(2 * pu.uK_CMB, "K_CMB") == pytest.approx(2e-6)
    assert from_quantity(1 * pu.MJy / pu.sr, "kJy/sr") == pytest.approx(1e3)
    # The CMB temperatures differ: 2.72548 K here, 2.7255 K in PySM.
    peer = (1 * pu.K_CMB).to("uK_RJ", equivalencies=pu.cmb_equivalencies(353 * u.GHz)).value
    for at in (353.0, 0.353 * u.THz):
        assert from_quantity(1 * pu.K_CMB, "uK_RJ", at=at) == pytest.approx(peer, rel=5e-5)
    expected = float(band.conversion("K_CMB", "MJy/sr", 353.0))
    factor = from_quantity(1 * pu.K_CMB, "MJy/sr", at=band, nu_ref=353.0)
    assert factor == pytest.approx(expected, rel=1e-12)
    assert unit_factor("K_CMB^2", "mK_CMB^2") == pytest.approx(1e6)


def test_bad_quantities():
    with pytest.raises(TypeError, match="`quantity` must carry a unit, but is float"):
        from_quantity(353.0, "GHz")
    for quantity, unit, words in [
        (1 * pu.K_CMB, "K_RJ", "'K_CMB' to 'K_RJ' depends on frequency; give `at`"),
        (1 * u.K, "K_RJ", "'K' does not convert to 'K_RJ'; say K_CMB or K_RJ"),
        (1 * u.GHz, "arcmin", "'GHz' does not convert to 'arcmin'"),
        (1 * pu.K_CMB**2, "K_CMB", "does not convert to 'K_CMB'"),
    ]:
        with pytest.raises(ValueError, match=words):
            from_quantity(quantity, unit)
