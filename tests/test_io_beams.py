"""Beam windows in files: formats, normalisation, a sentence for whatever is wrong."""

import healpy
import numpy as np
import pytest
from astropy.io import fits as pyfits

from jaxsky.harmonics import gaussian_beam
from jaxsky.io import read_beam
from jaxsky.observation import load_instrument
from refusals import refused

LMAX = 40
ELL = np.arange(LMAX + 1)
WINDOW = np.asarray(gaussian_beam(120.0, LMAX))


def text(path, *columns, header=""):
    np.savetxt(path, np.array(columns).T, header=header)
    return path


def tables(path, **named):
    """Binary tables by name, each with columns by name."""
    hdus = [
        pyfits.BinTableHDU.from_columns(
            [pyfits.Column(name=n, format="D", array=v) for n, v in columns.items()], name=name
        )
        for name, columns in named.items()
    ]
    pyfits.HDUList([pyfits.PrimaryHDU(), *hdus]).writeto(path)
    return path


@pytest.mark.parametrize(
    ("band", "lmax"), [("K", 750), ("Ka", 850), ("Q", 1100), ("V", 1500), ("W", 2000)]
)
def test_wmap_tables_hold_amplitudes(data_dir, band, lmax):
    path = data_dir / "bandpass" / f"wmap_beam_{band}.tbl"
    window = read_beam(path, lmax)
    # The instrument's beam size is the root of the solid angle, 4 pi / sum (2l+1) b_l for a beam
    # of unit peak. The tables give 2 to 19 % more; were they b_l^2, it would be 19 to 30 % less.
    angle = 4 * np.pi / np.sum((2 * np.arange(lmax + 1) + 1) * window)
    size = float(load_instrument("wmap")[band].beam) / 60
    assert 1.0 < np.degrees(np.sqrt(angle)) / size < 1.2
    with refused(rf"wmap_beam_{band}.tbl: ends at l = {lmax}, but lmax is"):
        read_beam(path, lmax + 1)


def test_planck_instrument_model(data_dir):
    path = data_dir / "bandpass" / "LFI_RIMO_R3.31.fits"
    for band, fwhm in [("030", 32.288), ("044", 26.997), ("070", 13.218)]:
        window = read_beam(path, 1000, hdu=f"BEAMWF_{band}X{band}")
        assert window[0] == 1
        # The effective beams are nearly Gaussian; the square is off by 0.2 and more.
        assert np.abs(window - gaussian_beam(fwhm, 1000)).max() < 0.03
    with refused(r"give `hdu`, one of BEAMWF_030X030, BEAMWF_044X044"):
        read_beam(path, 1000)


def test_text_is_normalised(tmp_path):
    path = text(tmp_path / "b.txt", ELL, 0.97 * WINDOW)
    np.testing.assert_allclose(read_beam(path, LMAX), WINDOW, rtol=1e-12)
    # As LAMBDA has them: a header, and errors in a third column.
    path = text(tmp_path / "c.txt", ELL, WINDOW, 0 * WINDOW, header="l b_l error")
    np.testing.assert_allclose(read_beam(path, 20), WINDOW[:21], rtol=1e-12)
    assert read_beam(path, 0) == 1


def test_fits_columns(tmp_path):
    healpy.write_cl(tmp_path / "a.fits", 2 * WINDOW)
    np.testing.assert_allclose(read_beam(tmp_path / "a.fits", LMAX), WINDOW, rtol=1e-12)
    other = WINDOW**2
    for i, columns in enumerate(
        [
            {"T": WINDOW, "E": other, "B": other},
            {"NOMINAL": WINDOW, "EIGEN_1": other},
            {"EIGEN_1": other, "BL": WINDOW},
            {"INTENSITY": WINDOW, "TEMPERATURE": other},
        ]
    ):
        path = tables(tmp_path / f"{i}.fits", WINDOW=columns)
        np.testing.assert_allclose(read_beam(path, 30), WINDOW[:31], rtol=1e-12)
    path = tables(tmp_path / "two.fits", FIRST={"BL": WINDOW}, SECOND={"BL": other})
    np.testing.assert_allclose(read_beam(path, LMAX, hdu="SECOND"), other, rtol=1e-12)
    ascii = pyfits.TableHDU.from_columns(
        [pyfits.Column(name="TEMPERATURE", format="E15.7", array=WINDOW)]
    )
    ascii.writeto(tmp_path / "ascii.fits")
    np.testing.assert_allclose(read_beam(tmp_path / "ascii.fits", LMAX), WINDOW, rtol=1e-6)


def test_bad_windows(tmp_path):
    nan, gone = WINDOW.copy(), WINDOW.copy()
    nan[3], gone[0] = np.nan, 0
    binary = tmp_path / "b.dat"
    binary.write_bytes(b"\xff\xfe\x00")
    squares = tables(tmp_path / "w.fits", WINDOW={"TT_2_TT": WINDOW**2})
    for path, arguments, words in [
        (text(tmp_path / "a.txt", ELL[1:], WINDOW[1:]), {}, "begins at l = 1, but l = 0 is needed"),
        (text(tmp_path / "b.txt", 2 * ELL, WINDOW), {}, "l = 0 is followed by l = 2"),
        (
            text(tmp_path / "c.txt", ELL[:-1], WINDOW[:-1]),
            {},
            "c.txt: ends at l = 39, but lmax is 40",
        ),
        (text(tmp_path / "d.txt", ELL, nan), {}, "1 of 41 values of the window are not finite"),
        (text(tmp_path / "e.txt", ELL, gone), {}, "must be positive at l = 0, but is 0"),
        (text(tmp_path / "f.txt", WINDOW), {}, "one column, but l and b_l are needed"),
        (text(tmp_path / "g.txt", ELL / 60, WINDOW), {}, "40 of 41 rows do not begin with a mult"),
        (squares, {}, "no column is named TEMPERATURE, .* it has TT_2_TT"),
        (squares, {"hdu": 2}, r"w.fits: no HDU 2; it has 0 \(PRIMARY\), 1 \(WINDOW\)"),
        (squares, {"hdu": 0}, "HDU 0 holds no table"),
        (binary, {}, "b.dat: neither a FITS file nor a text table"),
        (tmp_path / "none.txt", {}, "none.txt: no such file"),
    ]:
        with refused(words):
            read_beam(path, LMAX, **arguments)
    with pytest.raises(ValueError, match="`lmax` must not be negative, but is -1"):
        read_beam(tmp_path / "c.txt", -1)


def test_damaged_rows_are_not_skipped(tmp_path):
    path = tmp_path / "b.txt"
    path.write_bytes(b"\xef\xbb\xbf0 2D0\n1 1.0\n")
    assert read_beam(path, 1).tolist() == [1, 0.5]
    for content, words in [
        ("O 1\n1 1\n2 1\n", "line 1: not a row of numbers: 'O 1'"),
        ("l b_l\n0 1,0\n1 0,9\n", "line 2: '1,0' is two numbers or one with a decimal comma"),
        ("0 1\n1\n", "line 2: 1 numbers, but 2 in the lines above"),
    ]:
        path.write_text(content)
        with refused(rf"b.txt, {words}"):
            read_beam(path, 1)
