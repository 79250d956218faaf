"""Bandpasses in files, and quantities with units."""

import numpy as np
import pysm3.units as pu
import pytest
from astropy import units as u
from astropy.io import fits as pyfits

from jaxsky.bandpass import Bandpass
from jaxsky.io import from_quantity, read_bandpass, unit_factor, unit_name
from refusals import cases, raises, refused, refuses

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


@pytest.mark.parametrize(("content", "arguments"), cases("io_bandpasses/read_right"))
def test_text_that_is_read_right(tmp_path, content, arguments):
    path = tmp_path / "b.txt"
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(content.removeprefix("\ufeff" * (encoding != "utf-8")).encode(encoding))
        band = read_bandpass(path, convention="RJ", **arguments)
        np.testing.assert_allclose((band.nu, band.weights), SAMPLES, rtol=1e-12)


@pytest.mark.parametrize(("content", "arguments"), cases("io_bandpasses/wavenumbers"))
def test_wavenumbers_and_wavelengths(tmp_path, content, arguments):
    band = read_bandpass(table(tmp_path / "b.txt", content), convention="power", **arguments)
    np.testing.assert_allclose((band.nu, band.weights), ([29.9792458, 59.9584916], [1, 3]))


@pytest.mark.parametrize(("content", "arguments", "words"), cases("io_bandpasses/refused"))
def test_text_that_is_refused(tmp_path, content, arguments, words):
    path = tmp_path / "b.txt"
    path.write_bytes(content.encode())
    with refused(rf"b\.txt.*{words}", file=path):
        read_bandpass(path, convention="RJ", **arguments)


def test_other_text_that_is_refused(tmp_path):
    path = tmp_path / "b.txt"
    for content, words in (
        ("30 1\n31 1\n".encode("utf-16-le"), "for it has NUL bytes"),
        (b" ".join([b"1"] * 3000) + b"\n", "3000 columns; give `fields`"),
        (bytes(range(128, 200)), "text"),
    ):
        path.write_bytes(content)
        refuses(rf"b\.txt.*{words}", read_bandpass, path, convention="RJ")


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
    for name, arguments, words in cases("io_bandpasses/bad_rimos"):
        refuses(words, read_bandpass, files[name], **arguments)
    whole = files["good"].read_bytes()
    for length in (2000, 3000, len(whole) - 3000):
        cut = tmp_path / "cut.fits"
        cut.write_bytes(whole[:length])
        refuses(r"cut.fits", read_bandpass, cut, "30")


def test_bad_arguments(tmp_path):
    table(tmp_path / "b.txt", "28 1", "30 2")
    (tmp_path / "b.dat").write_bytes(b"\xff\xfe\x00")
    for arguments, words in cases("io_bandpasses/bad_arguments"):
        raises(ValueError, words, read_bandpass, tmp_path / arguments.pop("path"), **arguments)


def test_unit_names():
    for name, texts in cases("io_bandpasses/spellings").items():
        assert {unit_name(text) for text in texts} == {name}
    for text in ("K_BANANA", "furlong_CMB", "counts of sheep"):
        raises(ValueError, "Unknown unit", unit_name, text)


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
    raises(TypeError, "`quantity` must carry a unit, but is float", from_quantity, 353.0, "GHz")
    for quantity, unit, words in [
        (1 * pu.K_CMB, "K_RJ", "'K_CMB' to 'K_RJ' depends on frequency; give `at`"),
        (1 * u.K, "K_RJ", "'K' does not convert to 'K_RJ'; say K_CMB or K_RJ"),
        (1 * u.GHz, "arcmin", "'GHz' does not convert to 'arcmin'"),
        (1 * pu.K_CMB**2, "K_CMB", "does not convert to 'K_CMB'"),
    ]:
        raises(ValueError, words, from_quantity, quantity, unit)
