"""Spectra in files: formats, units, a sentence for whatever is wrong."""

import camb
import healpy
import numpy as np
import pytest
from astropy.io import fits as pyfits

from jaxsky.cmb import camb_spectra
from jaxsky.io import read_spectra
from refusals import refused

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
    planck, of_camb = "L TT TE EE BB PP", "L TT EE BB TE"
    for path, arguments in [
        (text(tmp_path / "planck.txt", planck, planck, start), {}),
        (text(tmp_path / "planck2.txt", planck, planck, start), {"format": "planck"}),
        (text(tmp_path / "planck3.txt", planck, None, start), {"format": "planck"}),
        (text(tmp_path / "a_totCls.dat", of_camb, None, start), {}),
        (text(tmp_path / "a_lensedCls.dat", of_camb, of_camb, start), {"format": "camb"}),
        (text(tmp_path / "bare.txt", of_camb, None, start), {"format": "camb"}),
        (text(tmp_path / "bare2.txt", "L TT EE BB TE PP", None, start), {"format": "camb"}),
    ]:
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
    for i, (scale, arguments, given) in enumerate(
        [
            (1.0, {"column_units": "uK^2"}, {}),
            (1.0, {"column_units": "uK_CMB^2"}, {"unit": "uK^2"}),
            (1e-12, {"column_units": "K^2"}, {}),
            (1e-6, {"column_units": "mK2"}, {"unit": "mK_CMB^2"}),
            (1.0, {}, {"unit": "uK_CMB^2"}),
            (1e-12, {"column_units": "unknown"}, {"unit": "K_CMB^2"}),
            (1.0, {"column_units": "uK^2", "column_names": ["TT", "EE", "BB", "TE"]}, {}),
        ]
    ):
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
    with pytest.raises(ValueError, match="`lmax` must not be negative, but is -1"):
        read_spectra(path, -1)


def test_text_that_leaves_something_open(tmp_path):
    scalar = "L TT EE TE PP TP"
    for path, arguments, words in [
        (text(tmp_path / "a.txt", "L TT EE BB TE"), {},
         "a.txt: no header names the columns; give `format`, 'planck' for L TT TE EE BB or"),
        (text(tmp_path / "s_scalCls.dat", scalar), {}, "no BB; read ..._lensedCls.dat and"),
        (text(tmp_path / "t_scalCls.dat", scalar, scalar), {},
         "no column BB; it has L, TT, EE, TE, PP, TP; CAMB writes it to ..._lensed"),
        (text(tmp_path / "u.txt", "L TT EE", "L TT EE"), {}, "no column BB, TE; it has L, TT, EE"),
        (text(tmp_path / "v.txt", "L TT EE BB TE", "x TT EE BB TE"), {}, "no column L; it has X"),
        (text(tmp_path / "w_totCls.dat", "L TT EE TE"), {}, "4 columns, but format 'camb' has L"),
        (text(tmp_path / "p.txt", "L TT TE EE BB", "L TT TE EE BB"), {"format": "camb"},
         "`format` is 'camb', but the columns are L TT TE EE BB"),
        (text(tmp_path / "q.txt", "L TT EE BB TE", "L TT EE BB"), {},
         r"the header names 4 columns \(L TT EE BB\), but there are 5"),
        (tmp_path / "p.txt", {"unit": "K^2"}, "`unit` is for FITS files, text is in uK"),
    ]:  # fmt: skip
        with refused(words):
            read_spectra(path, LMAX, **arguments)
    with pytest.raises(ValueError, match="`format` must be one of planck, camb, not 'class'"):
        read_spectra(tmp_path / "p.txt", LMAX, format="class")


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
        with refused(words):
            read_spectra(bad, LMAX)
    bad.write_bytes(b"\xff\xfe\x00")
    with refused("neither a FITS file nor a text table"):
        read_spectra(bad, LMAX)
    with refused(r"none.txt: no such file"):
        read_spectra(tmp_path / "none.txt", LMAX)


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
        with refused(words):
            read_spectra(path, LMAX)
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
        (tmp_path / "b.fits", {"format": "camb"}, "`format` is for text files, this is FITS"),
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
        with refused(words):
            read_spectra(path, LMAX, **arguments)
    whole = (tmp_path / "b.fits").read_bytes()
    (tmp_path / "cut.fits").write_bytes(whole[:-2880])
    with refused(r"cut.fits: not a FITS file, or a truncated one"):
        read_spectra(tmp_path / "cut.fits", LMAX)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("L TT TE EE BB\n2 1,5 0 1 1\n",
         "line 2: '1,5' is two numbers or one with a decimal comma"),
        ("L TT TE EE BB\n2 1O.5 0 1 1\n3 1 0 1 1\n",
         "line 2: not a row of numbers: '2 1O.5 0 1 1'"),
        ("L TT TE EE BB\n2 1 0 1 1\nx y z u v\n", "line 3: not a row of numbers: 'x y z u v'"),
        ("L TT TE EE BB\n2 1 0 1 1\x00\n", "for it has NUL bytes"),
        ("", "no line has numbers"),
    ],
)  # fmt: skip
def test_damaged_rows_are_not_skipped(tmp_path, content, words):
    path = tmp_path / "b.txt"
    path.write_text(content)
    with refused(rf"b.txt.*{words}"):
        read_spectra(path, 2)


def test_marks_of_the_encoding_and_exponents_of_fortran(tmp_path):
    content = "# L TT TE EE BB\n2;1,5D+0;0;1d0;.5\n".encode("utf-8-sig")
    (tmp_path / "b.txt").write_bytes(content)
    spectra = read_spectra(tmp_path / "b.txt", 2)
    np.testing.assert_allclose(spectra[:, 2], np.array([1.5, 1, 0.5, 0]) * 2 * np.pi / 6)
