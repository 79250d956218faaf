"""Spectra and beam windows in files: formats, units, a sentence for whatever is wrong."""

import camb
import healpy
import numpy as np
import pytest
from astropy.io import fits as pyfits

from jaxsky.cmb import camb_spectra
from jaxsky.harmonics import gaussian_beam
from jaxsky.io import read_beam, read_spectra
from jaxsky.observation import load_instrument
from refusals import cases, raises, refused, refuses

LMAX = 30
ELL = np.arange(LMAX + 1)
D_ELL = ELL * (ELL + 1) / (2 * np.pi)
#: Healthy TT, EE, BB, TE [uK^2] without monopole and dipole.
CL = np.array([1000.0, 20.0, 0.5, -90.0])[:, None] / (ELL + 1.0) ** 2 * (ELL > 1)


def text(path, columns, header=None, start=2, stop=None):
    """Text as CAMB and Planck write it: l and D_l of columns, by name, from l = start."""
    rows = dict(zip(("TT", "EE", "BB", "TE"), CL * D_ELL, strict=True))
    rows |= {"L": ELL, "PP": 1e-7 * ELL, "TP": 0 * ELL}
    table = np.array([rows[name] for name in columns.split()])[:, start:stop]
    fmt = ["%5d"] + ["%.12e"] * (len(table) - 1)
    np.savetxt(path, table.T, fmt=fmt, header=header or "", comments="# " if header else "")
    return path


def fits(path, cl=CL, **arguments):
    healpy.write_cl(path, cl, **arguments)
    return path


def test_planck_theory(data_dir):
    spectra = read_spectra(next(data_dir.glob("spectra/COM_PowerSpect*theory*.txt")), 2000)
    assert spectra.shape == (4, 2001)
    assert not spectra[:, :2].any()
    # The first line of the file, l = 2: D_l of TT, TE, EE, BB.
    expected = np.array([0.101673e4, 0.308827e-1, 0.181847e-5, 0.261753e1]) * 2 * np.pi / 6
    np.testing.assert_allclose(spectra[:, 2], expected, rtol=1e-12)
    # CAMB for the rounded best fit (mean values rather than the maximum of the posterior): 2 % of
    # each spectrum, of sqrt(TT EE) for TE, which changes its sign.
    ours = camb_spectra(2000)[:, 30:1500]
    scale = ours.copy()
    scale[3] = np.sqrt(ours[0] * ours[1])
    assert np.abs((spectra[:, 30:1500] - ours) / scale).max() < 0.02


@pytest.mark.parametrize("start", [0, 1, 2])
def test_text_by_header_or_name(tmp_path, start):
    for name, columns, header, arguments in cases("io_spectra/text_by_header_or_name"):
        path = text(tmp_path / name, columns, header, start)
        np.testing.assert_allclose(read_spectra(path, LMAX, **arguments), CL, rtol=1e-11)
    path = text(tmp_path / "odd.txt", "L TE BB EE TT", "ell te bb ee tt", start)
    np.testing.assert_allclose(read_spectra(path, LMAX - 5), CL[:, : LMAX - 4], rtol=1e-11)


def test_camb_writes_what_is_read(tmp_path):
    results = camb.get_results(camb.set_params(H0=67.0, ombh2=0.022, omch2=0.12, lmax=300))
    path = tmp_path / "camb.dat"
    results.save_cmb_power_spectra(str(path), 200)
    expected = results.get_total_cls(200, CMB_unit="muK", raw_cl=True).T
    # Text with eight digits.
    np.testing.assert_allclose(read_spectra(path, 200), expected, rtol=1e-7)


def test_healpix_fits(tmp_path):
    for i, (scale, arguments, given) in enumerate(cases("io_spectra/healpix_fits")):
        path = fits(tmp_path / f"{i}.fits", CL * scale, **arguments)
        np.testing.assert_allclose(read_spectra(path, LMAX, **given), CL, rtol=1e-12)
    # Six spectra, single precision.
    six = np.concatenate([CL, CL[2:] * 0]).astype(np.float32)
    path = fits(tmp_path / "six.fits", six, column_units="uK^2")
    np.testing.assert_allclose(read_spectra(path, 20), CL[:, :21], rtol=1e-6)
    # HEALPix Fortran's ASCII tables, columns in another order, multipoles in one of them.
    names = ("B-mode C_l", "INDEX", "Temperature C_l", "T-E cross C_l", "E-mode C_l")
    columns = [
        pyfits.Column(name=n, format="E15.7", array=v[2:], unit="uK^2")
        for n, v in zip(names, [CL[2], ELL, CL[0], CL[3], CL[1]], strict=True)
    ]
    pyfits.TableHDU.from_columns(columns).writeto(tmp_path / "ascii.fits")
    np.testing.assert_allclose(read_spectra(tmp_path / "ascii.fits", LMAX), CL, rtol=1e-6)


def test_low_multipoles_alone(tmp_path):
    path = text(tmp_path / "a_totCls.dat", "L TT EE BB TE")
    for lmax in (0, 1, 2):
        np.testing.assert_allclose(read_spectra(path, lmax), CL[:, : lmax + 1], rtol=1e-11)
    raises(ValueError, "`lmax` must not be negative, but is -1", read_spectra, path, -1)


def test_text_that_leaves_something_open(tmp_path):
    for name, columns, header, arguments, words in cases("io_spectra/text_left_open"):
        path = text(tmp_path / name, columns, header)
        refuses(words, read_spectra, path, LMAX, **arguments)


def test_damaged_text(tmp_path):
    good = text(tmp_path / "a_totCls.dat", "L TT EE BB TE").read_text().splitlines()
    bad = tmp_path / "b_totCls.dat"
    for lines, words in [
        (good[1:], "b_totCls.dat: begins at l = 3, but l = 2 is needed"),
        (good[:4] + good[5:], "l = 5 is followed by l = 7"),
        (good[:4] + good[3:], "l = 5 is followed by l = 5"),
        (good[:-1], "ends at l = 29, but lmax is 30"),
        ([*good[:4], "x y"], "line 5: not a row of numbers: 'x y'"),
        ([*good[:-1], good[-1][:30]], "line 29: 3 numbers, but 5 in the lines above"),
        (["2.5" + good[0][5:], *good[1:]], "1 of 29 rows do not begin with a multipole"),
        (["nan" + good[0][5:], *good[1:]], "1 of 29 rows do not begin with a multipole"),
        (["# L TT EE BB TE"], "b_totCls.dat: no line has numbers"),
    ]:
        bad.write_text("\n".join(lines) + "\n")
        refuses(words, read_spectra, bad, LMAX)
    bad.write_bytes(b"\xff\xfe\x00")
    refuses("neither a FITS file nor a text table", read_spectra, bad, LMAX)
    refuses(r"none.txt: no such file", read_spectra, tmp_path / "none.txt", LMAX)


def test_spectra_that_cannot_be(tmp_path):
    for i, (row, value, words) in enumerate(
        [
            (0, np.nan, "TT must be finite and not negative, but is not at 1 .* first l = 7"),
            (1, np.inf, "EE must be finite"),
            (2, -1e-9, "BB must be finite and not negative"),
            (3, np.nan, "TE must be finite, but"),
            (
                3,
                1.0001 * np.sqrt(CL[0, 7] * CL[1, 7]),
                r"\|TE\| exceeds sqrt\(TT EE\) at 1 .* l = 7",
            ),
        ]
    ):
        cl = CL.copy()
        cl[row, 7] = value
        path = fits(tmp_path / f"{i}.fits", cl, column_units="uK^2")
        refuses(words, read_spectra, path, LMAX)
        # What is wrong above lmax does not matter.
        assert read_spectra(path, 6).shape == (4, 7)
    full = CL.copy()
    full[3] = np.sqrt(CL[0] * CL[1])
    assert read_spectra(fits(tmp_path / "f.fits", full, column_units="uK^2"), LMAX)[3].any()


def test_fits_that_leave_something_open(tmp_path):
    names = ["ELL", "TT", "EE", "BB", "TE"]
    gap = np.concatenate([[np.where(ELL > 9, ELL + 1, ELL)], CL])
    primary = pyfits.PrimaryHDU()
    pyfits.HDUList([primary, pyfits.ImageHDU(np.ones(3))]).writeto(tmp_path / "image.fits")
    primary.writeto(tmp_path / "empty.fits")
    unit = {"column_units": "uK^2"}
    for path, arguments, words in [
        (fits(tmp_path / "a.fits"), {}, "column TEMPERATURE has no unit; give `unit`, such as"),
        (fits(tmp_path / "b.fits", **unit), {"unit": "K^2"}, "`unit` is K.2, but .* is in uK"),
        (tmp_path / "b.fits", {"fields": ["L", "TT"]}, "`fields` is for text files, columns of"),
        (fits(tmp_path / "c.fits", column_units="uK"), {},
         "unit 'uK', which is no square of K_CMB"),
        (fits(tmp_path / "d.fits", column_units="K_RJ^2"), {}, "'K_RJ.2', which is no square"),
        (tmp_path / "a.fits", {"unit": "sheep"}, "'sheep', which is no square"),
        (fits(tmp_path / "e.fits", CL[0], **unit), {}, "no column EE, BB, TE; it has TEMPERATURE"),
        (fits(tmp_path / "f.fits", CL[:, :-1], **unit), {}, "ends at l = 29, but lmax is 30"),
        (fits(tmp_path / "g.fits", gap, column_names=names, **unit), {},
         "l = 9 is followed by l = 11"),
        (fits(tmp_path / "h.fits", extra_header=[("SPECTRUM", "D_ell")], **unit), {},
         "the header says 'D_ell'; spectra in FITS files must be C_l"),
        (fits(tmp_path / "i.fits", extra_header=[("COMMENT", "times l(l+1)/2pi")], **unit), {},
         r"the header says 'l\(l\+1\)'"),
        (tmp_path / "image.fits", {}, "image.fits: HDU 1 holds no table"),
        (tmp_path / "empty.fits", {}, r"empty.fits: no HDU 1; it has 0 \(PRIMARY\)"),
    ]:  # fmt: skip
        refuses(words, read_spectra, path, LMAX, **arguments)
    whole = (tmp_path / "b.fits").read_bytes()
    (tmp_path / "cut.fits").write_bytes(whole[:-2880])
    with refused(r"cut.fits: not a FITS file, or a truncated one"):
        read_spectra(tmp_path / "cut.fits", LMAX)


@pytest.mark.parametrize(("content", "words"), cases("io_spectra/damaged_rows"))
def test_damaged_rows_are_not_skipped(tmp_path, content, words):
    path = tmp_path / "b.txt"
    path.write_text(content)
    refuses(rf"b.txt.*{words}", read_spectra, path, 2)


def test_marks_of_the_encoding_and_exponents_of_fortran(tmp_path):
    content = "# L TT TE EE BB\n2;1,5D+0;0;1d0;.5\n".encode("utf-8-sig")
    (tmp_path / "b.txt").write_bytes(content)
    spectra = read_spectra(tmp_path / "b.txt", 2)
    np.testing.assert_allclose(spectra[:, 2], np.array([1.5, 1, 0.5, 0]) * 2 * np.pi / 6)


BEAM_LMAX = 40
BEAM_ELL = np.arange(BEAM_LMAX + 1)
WINDOW = np.asarray(gaussian_beam(120.0, BEAM_LMAX))


def beam_text(path, *columns, header=""):
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
    refuses(rf"wmap_beam_{band}.tbl: ends at l = {lmax}, but lmax is", read_beam, path, lmax + 1)


def test_planck_instrument_model(data_dir):
    path = data_dir / "bandpass" / "LFI_RIMO_R3.31.fits"
    for band, fwhm in [("030", 32.288), ("044", 26.997), ("070", 13.218)]:
        window = read_beam(path, 1000, hdu=f"BEAMWF_{band}X{band}")
        assert window[0] == 1
        # The effective beams are nearly Gaussian; the square is off by 0.2 and more.
        assert np.abs(window - gaussian_beam(fwhm, 1000)).max() < 0.03
    refuses(r"give `hdu`, one of BEAMWF_030X030, BEAMWF_044X044", read_beam, path, 1000)


def test_text_is_normalised(tmp_path):
    path = beam_text(tmp_path / "b.txt", BEAM_ELL, 0.97 * WINDOW)
    np.testing.assert_allclose(read_beam(path, BEAM_LMAX), WINDOW, rtol=1e-12)
    # As LAMBDA has them: a header, and errors in a third column.
    path = beam_text(tmp_path / "c.txt", BEAM_ELL, WINDOW, 0 * WINDOW, header="l b_l error")
    np.testing.assert_allclose(read_beam(path, 20), WINDOW[:21], rtol=1e-12)
    assert read_beam(path, 0) == 1


def test_fits_columns(tmp_path):
    healpy.write_cl(tmp_path / "a.fits", 2 * WINDOW)
    np.testing.assert_allclose(read_beam(tmp_path / "a.fits", BEAM_LMAX), WINDOW, rtol=1e-12)
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
    np.testing.assert_allclose(read_beam(path, BEAM_LMAX, hdu="SECOND"), other, rtol=1e-12)
    ascii = pyfits.TableHDU.from_columns(
        [pyfits.Column(name="TEMPERATURE", format="E15.7", array=WINDOW)]
    )
    ascii.writeto(tmp_path / "ascii.fits")
    np.testing.assert_allclose(read_beam(tmp_path / "ascii.fits", BEAM_LMAX), WINDOW, rtol=1e-6)


def test_bad_windows(tmp_path):
    nan, gone = WINDOW.copy(), WINDOW.copy()
    nan[3], gone[0] = np.nan, 0
    binary = tmp_path / "b.dat"
    binary.write_bytes(b"\xff\xfe\x00")
    squares = tables(tmp_path / "w.fits", WINDOW={"TT_2_TT": WINDOW**2})
    for path, arguments, words in [
        (
            beam_text(tmp_path / "a.txt", BEAM_ELL[1:], WINDOW[1:]),
            {},
            "begins at l = 1, but l = 0 is needed",
        ),
        (beam_text(tmp_path / "b.txt", 2 * BEAM_ELL, WINDOW), {}, "l = 0 is followed by l = 2"),
        (
            beam_text(tmp_path / "c.txt", BEAM_ELL[:-1], WINDOW[:-1]),
            {},
            "c.txt: ends at l = 39, but lmax is 40",
        ),
        (
            beam_text(tmp_path / "d.txt", BEAM_ELL, nan),
            {},
            "1 of 41 values of the window are not finite",
        ),
        (beam_text(tmp_path / "e.txt", BEAM_ELL, gone), {}, "must be positive at l = 0, but is 0"),
        (beam_text(tmp_path / "f.txt", WINDOW), {}, "one column, but l and b_l are needed"),
        (
            beam_text(tmp_path / "g.txt", BEAM_ELL / 60, WINDOW),
            {},
            "40 of 41 rows do not begin with a mult",
        ),
        (squares, {}, "no column is named TEMPERATURE, .* it has TT_2_TT"),
        (squares, {"hdu": 2}, r"w.fits: no HDU 2; it has 0 \(PRIMARY\), 1 \(WINDOW\)"),
        (squares, {"hdu": 0}, "HDU 0 holds no table"),
        (binary, {}, "b.dat: neither a FITS file nor a text table"),
        (tmp_path / "none.txt", {}, "none.txt: no such file"),
    ]:
        refuses(words, read_beam, path, BEAM_LMAX, **arguments)
    raises(ValueError, "`lmax` must not be negative, but is -1", read_beam, tmp_path / "c.txt", -1)


def test_damaged_rows_of_beams_are_not_skipped(tmp_path):
    path = tmp_path / "b.txt"
    path.write_bytes(b"\xef\xbb\xbf0 2D0\n1 1.0\n")
    assert read_beam(path, 1).tolist() == [1, 0.5]
    for content, words in [
        ("O 1\n1 1\n2 1\n", "line 1: not a row of numbers: 'O 1'"),
        ("l b_l\n0 1,0\n1 0,9\n", "line 2: '1,0' is two numbers or one with a decimal comma"),
        ("0 1\n1\n", "line 2: 1 numbers, but 2 in the lines above"),
    ]:
        path.write_text(content)
        refuses(rf"b.txt, {words}", read_beam, path, 1)
