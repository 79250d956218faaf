"""Maps in files as they occur: what columns are, which pixels have no value, which files are none.

Truth is healpy's: its Rotator for coordinates, its write_map for files.
"""

import healpy
import numpy as np
import pytest
from astropy.io import fits as pyfits

import mapfiles
from jaxsky.io import read_maps, read_mask
from mapfiles import NSIDE, sky
from refusals import cases, refused, refuses

NPIX = 12 * NSIDE**2
RNG = np.random.default_rng(7)
I, Q, U = RNG.normal(size=(3, NPIX))  # noqa: E741


def save(path, columns, unit="K_CMB", **header):
    return mapfiles.save(path, columns, unit, **header)


# Sign of U and rotation


@pytest.mark.parametrize("scheme", ["RING", "NESTED"])
def test_spass_has_one_stokes_parameter_per_file(tmp_path, scheme):
    """IAU, a file each, the column called UNKNOWN1: only the argument can say which is U."""
    nested = scheme == "NESTED"
    paths = [
        save(
            tmp_path / f"spass.{name}.fits",
            {"UNKNOWN1": healpy.reorder(values, r2n=True) if nested else values},
            "K_RJ",
            ORDERING=scheme,
            POLCCONV="IAU",
        )
        for name, values in zip("iqu", (I, Q, U), strict=True)
    ]
    refuses(r"spass.u.*IAU sign of U.*UNKNOWN1.*give `stokes`", read_maps, paths[2])
    found = read_maps(paths[1:], stokes="QU")
    np.testing.assert_array_equal(found.maps, [Q, -U])
    assert found.stokes == ("Q", "U")
    np.testing.assert_array_equal(read_maps(paths, stokes="IQU").maps, [I, Q, -U])
    np.testing.assert_array_equal(read_maps(paths[2], stokes="U").maps[0], -U)
    np.testing.assert_array_equal(read_maps(paths[0], stokes="I").maps[0], I)


@pytest.mark.parametrize("frame", ["C", "E"])
def test_columns_without_names_are_turned_as_they_are_said_to_be(tmp_path, frame):
    source, expected = sky(16, frame)
    path = tmp_path / "four.fits"
    extra = np.ones_like(source[0])
    healpy.write_map(path, [extra, *source], coord=frame, column_units="K_RJ", dtype=np.float64)
    columns = ["COLUMN_2", "COLUMN_3", "COLUMN_4"]
    words = r"not in Galactic coordinates.*COLUMN_3.*give `stokes`"
    refuses(words, read_maps, path, fields=columns[1:])
    found = read_maps(path, fields=columns, stokes="IQU").maps
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
    for given in ("Q", "U"):
        with refused(r"COLUMN_3 cannot be turned.*Q followed by U"):
            read_maps(path, fields="COLUMN_3", stokes=given)
    refuses("cannot be turned", read_maps, path, fields=columns[1:], stokes="UQ")


def test_q_and_u_of_two_files_or_hdus_are_one_field(tmp_path):
    source, expected = sky(16, "C")
    keys = {"NSIDE": 16, "COORDSYS": "C"}
    files = [
        save(tmp_path / f"{n}.fits", {f"{n}_STOKES": v}, **keys)
        for n, v in zip("QU", source[1:], strict=True)
    ]
    both = tmp_path / "both.fits"
    with pyfits.open(files[0]) as one, pyfits.open(files[1]) as two:
        pyfits.HDUList([one[0], one[1], two[1]]).writeto(both)
    for arguments in ({"path": files}, {"path": both, "hdu": [1, 2]}):
        found = read_maps(**arguments)
        assert np.abs(found.maps - expected[1:]).max() < 1e-6 * np.abs(expected).max()
        assert found.names == ("Q_STOKES", "U_STOKES")
    # healpy calls any map T that is alone in its file: no evidence.
    for path, values in zip(files, source[1:], strict=True):
        options = {"coord": "C", "column_units": "K_CMB", "overwrite": True, "dtype": np.float64}
        healpy.write_map(path, values, **options)
    refuses(r"name of column T does not say.*give `stokes`", read_maps, files)
    found = read_maps(files, stokes=["Q", "U"]).maps
    assert np.abs(found - expected[1:]).max() < 1e-6 * np.abs(expected).max()
    np.testing.assert_array_equal(
        read_maps(save(files[0], {"T": U}, POLCCONV="IAU"), stokes="U").maps[0], -U
    )
    # Alone, and not said to be anything else, it is a temperature: a scalar.
    healpy.write_map(files[0], source[0], **options)
    alone = read_maps(files[0]).maps[0]
    assert np.abs(alone - expected[0]).max() < 1e-6 * np.abs(expected).max()


def test_files_of_one_field_must_agree(tmp_path):
    q = save(tmp_path / "q.fits", {"Q": Q}, POLCCONV="IAU")
    for header, unit, arguments, words in cases("bad_maps/files_of_one_field"):
        u = save(tmp_path / "u.fits", {"U": U}, unit, **header)
        refuses(words, read_maps, [q, u], **arguments)
    save(u, {"U": U})
    np.testing.assert_array_equal(read_maps([q, u], polarization="IAU").maps, [Q, -U])
    coarse = save(tmp_path / "c.fits", {"U": np.ones(48)}, NSIDE=2, POLCCONV="IAU")
    with refused(r"c.fits, HDU 1: nside of column U is 2, but that of Q in .*q.fits.* is 8"):
        read_maps([q, coarse])


@pytest.mark.parametrize(
    ("names", "sign"), [(cases("bad_maps/names_of_u"), -1), (cases("bad_maps/names_of_others"), 1)]
)
def test_names_that_are_certain_tell_the_sign(tmp_path, names, sign):
    for name in names:
        path = save(tmp_path / "m.fits", {name: U, "X": Q}, POLCCONV="IAU")
        np.testing.assert_array_equal(read_maps(path, fields=name).maps[0], sign * U, name)


@pytest.mark.parametrize("name", ["COLUMN_2", "UNKNOWN1", "UNITS", "USTOKES", "SIGNAL", "U_X"])
def test_other_names_are_asked_about(tmp_path, name):
    path = save(tmp_path / "m.fits", {name: U, "X": Q}, POLCCONV="IAU")
    refuses(f"the name of column {name} does not say.*`stokes`", read_maps, path, fields=name)
    np.testing.assert_array_equal(read_maps(path, fields=name, stokes="U").maps[0], -U)
    np.testing.assert_array_equal(read_maps(path, fields=name, stokes=["QU"]).maps[0], -U)
    np.testing.assert_array_equal(read_maps(path, fields=name, stokes="").maps[0], U)
    # Galactic and COSMO, no name is needed.
    path = save(path, {name: U, "X": Q})
    np.testing.assert_array_equal(read_maps(path, fields=name).maps[0], U)


# Missing values


def integers(path, stored, null=None, scale=None, zero=None, kind="I", name="I_STOKES"):
    """A column of integers as stored, with the keywords that say what they are."""
    types = {"B": ">u1", "I": ">i2", "J": ">i4", "K": ">i8"}
    table = pyfits.BinTableHDU(np.array(stored).astype([(name, types[kind])]))
    header = {"NSIDE": NSIDE, "ORDERING": "RING", "COORDSYS": "G", "TUNIT1": "K_CMB"}
    header |= {"TNULL1": null, "TSCAL1": scale, "TZERO1": zero}
    table.header.update({k: v for k, v in header.items() if v is not None})
    table.writeto(path, overwrite=True)
    return path


@pytest.mark.parametrize(("kind", "null", "scale", "zero"), cases("bad_maps/nulls_of_integers"))
def test_null_of_integers_is_missing(tmp_path, kind, null, scale, zero):
    stored = np.random.default_rng(0).integers(1, 200, NPIX)
    holes = np.arange(NPIX) % 5 == 0
    path = integers(tmp_path / "i.fits", np.where(holes, null, stored), null, scale, zero, kind)
    found = read_maps(path)
    np.testing.assert_array_equal(found.mask, ~holes)
    expected = stored * (scale or 1.0) + (zero or 0.0)
    np.testing.assert_allclose(found.maps[0], np.where(holes, 0, expected), rtol=1e-12)


def test_hits_have_nulls_too(tmp_path):
    hits = np.where(np.arange(NPIX) < 9, -1, 5 + np.arange(NPIX))
    path = integers(tmp_path / "h.fits", hits, -1, kind="J", name="N_OBS")
    assert (~read_maps(path, fields="N_OBS").mask).sum() == 9
    bad = integers(tmp_path / "b.fits", hits, "many", kind="J")
    refuses("TNULL1 is many, which is not a whole number", read_maps, bad)


@pytest.mark.parametrize(
    ("mark", "share"),
    [(-1e30, 0.3), (-999.0, 0.05), (-9999.0, 0.5), (-32768.0, 0.03), (99999.0, 0.1), (1e20, 0.01)],
)
def test_undeclared_marks_are_asked_about(tmp_path, mark, share):
    holes = np.arange(NPIX) < max(2, share * NPIX)
    values = np.where(holes, mark, 100 * I)
    path = save(tmp_path / "m.fits", {"I": values}, formats={"I": "E"})
    words = rf"m.fits.*column I is .* in {holes.sum()} of 768 pixels.*give `missing`"
    refuses(words, read_maps, path)
    found = read_maps(path, missing=mark)
    np.testing.assert_array_equal(found.mask, ~holes)
    np.testing.assert_array_equal(read_maps(path, missing=[1, mark]).mask, ~holes)
    assert read_maps(path, missing=[]).mask.all()
    # A mark that is not in the file does not answer the question.
    refuses(words, read_maps, path, missing=-12345.0)


def test_the_lowest_integer_is_asked_about(tmp_path):
    stored = np.where(np.arange(NPIX) < 20, -32768, np.arange(NPIX))
    for scale in (None, 0.01):
        path = integers(tmp_path / "i.fits", stored, scale=scale)
        refuses(r"I_STOKES is -32[76.8]+ in 20 of 768 pixels", read_maps, path)
    assert read_maps(path, missing=-327.68).mask.sum() == NPIX - 20


def test_two_marks_are_named_at_once(tmp_path):
    values = I.copy()
    values[:30], values[30:60] = -999.0, 1e30
    path = save(tmp_path / "m.fits", {"I": values})
    refuses(r"is -999 in 30 .*; column I is 1e.30 in 30", read_maps, path)
    assert read_maps(path, missing=[-999, 1e30]).mask.sum() == NPIX - 60


@pytest.mark.parametrize("share", [0.35, 0.9, 1.0])
def test_footprints_of_zeros_are_asked_about(tmp_path, share):
    holes = np.arange(NPIX) < share * NPIX
    columns = {n: np.where(holes, 0.0, v) for n, v in {"Q": Q, "U": U}.items()}
    path = save(tmp_path / "m.fits", columns | {"I": I})
    refuses(rf"Q, U: exactly 0 in .*{share:.0%} of.*`missing`", read_maps, path, fields=["Q", "U"])
    assert read_maps(path).mask.all()  # I has values there
    assert read_maps(path, fields=["Q", "U"], missing=[]).mask.all()
    assert read_maps(path, fields=["Q", "U"], zeros_are_data=True).mask.all()
    if share < 1:
        mask = read_maps(path, fields=["Q", "U"], missing=0.0).mask
        np.testing.assert_array_equal(mask, ~holes)


def theta(nside):
    return healpy.pix2ang(nside, np.arange(12 * nside**2))[0]


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (np.full(NPIX, 3.0), "K_CMB"),
        (np.where(np.arange(NPIX) < 200, 0.0, I), "K_CMB"),
        (np.where(np.arange(NPIX) < 500, 0.0, 1.0), "1"),
        (np.where(np.arange(NPIX) < 40, 0.0, 1.0), "1"),
        (np.exp(-((theta(NSIDE) / 0.3) ** 2)), "K_CMB"),
        (1 / theta(NSIDE), "K_CMB"),
        (np.clip(I, -1, 1), "K_CMB"),
        (np.round(I * 3), "K_CMB"),
        (np.where(np.arange(NPIX) == 5, 1e6, 0.0) + 1e-9 * I, "K_CMB"),
        (np.maximum(0, np.arange(NPIX) - 300) // 7, "counts"),
        (np.exp(5 * I), "MJy/sr"),
        (np.arange(NPIX) % 12, "1"),
        (np.array([0, 1, 2, 50])[np.repeat([0, 1, 2, 3], [300, 300, 8, 160])], "1"),
        (np.where(np.arange(NPIX) < 60, 9.0, np.where(np.arange(NPIX) < 65, 2.0, 1.0)), "K_RJ"),
    ],
)
def test_maps_without_missing_pixels_are_read(tmp_path, values, unit):
    path = save(tmp_path / "m.fits", {"I": values}, unit)
    arguments = {"unit": ""} if unit == "counts" else {}
    if arguments:
        path = save(path, {"I": values}, None)
    found = read_maps(path, **arguments)
    assert found.mask.all()
    np.testing.assert_array_equal(found.maps[0], values)


@pytest.mark.parametrize("text", ["-1.6375e30", "-1.6375D+30", "'-1.6375E+30'", "UNSEEN", "-99.0"])
def test_bad_data_as_text(tmp_path, text):
    values = I.copy()
    values[:7] = -99.0 if text == "-99.0" else healpy.UNSEEN
    path = save(tmp_path / "m.fits", {"I": values}, BAD_DATA=text)
    assert (~read_maps(path).mask).nonzero()[0].tolist() == list(range(7))
    path = save(path, {"I": values}, BAD_DATA="none")
    refuses("BAD_DATA is NONE, which is not a number", read_maps, path)


@pytest.mark.parametrize(
    ("form", "array", "what"),
    [
        ("C", Q + 1j * U, "complex numbers"),
        ("M", Q + 1j * U, "complex numbers"),
        ("L", Q > 0, "logical values"),
        ("4A", ["1.5"] * NPIX, "text"),
        ("8X", np.ones((NPIX, 8), bool), "bits"),
        ("PD()", np.array([np.ones(2)] * NPIX, dtype=object), "arrays of different lengths"),
    ],
)
def test_columns_that_are_no_real_numbers(tmp_path, form, array, what):
    path = save(tmp_path / "m.fits", {"Q": array, "I": I}, formats={"Q": form})
    refuses(f"column Q holds {what}, not real numbers", read_maps, path, fields="Q")
    np.testing.assert_array_equal(read_maps(path, fields="I").maps[0], I)


@pytest.mark.parametrize("missing", ["-999", True, [None], ["x"]])
def test_missing_must_be_numbers(tmp_path, missing):
    path = save(tmp_path / "m.fits", {"I": I})
    refuses("`missing` must be a number or a list of them, not", read_maps, path, missing=missing)


# Pixel numbers

SOME = np.array([3, 700, 41, 5])


def partial(path, pixels=SOME, name="PIXEL", form="J", values=None, **header):
    columns = {name: pixels, "I": I[: len(pixels)] if values is None else values}
    keys = {"INDXSCHM": "EXPLICIT", "OBJECT": "PARTIAL"} | header
    return save(path, columns, formats={name: form}, **keys)


@pytest.mark.parametrize("scheme", ["RING", "NESTED"])
@pytest.mark.parametrize("given", cases("bad_maps/partial_maps"))
def test_partial_maps(tmp_path, given, scheme):
    found = read_maps(partial(tmp_path / "p.fits", ORDERING=scheme, **given))
    pixels = healpy.nest2ring(NSIDE, SOME) if scheme == "NESTED" else SOME
    assert set(np.flatnonzero(found.mask)) == set(pixels)
    np.testing.assert_array_equal(found.maps[0, pixels], I[:4])


@pytest.mark.parametrize(("given", "words"), cases("bad_maps/pixel_numbers_that_are_none"))
def test_pixel_numbers_that_are_none(tmp_path, given, words):
    path = partial(tmp_path / "p.fits", **given)
    with refused(words, file=path) as info:
        read_maps(path)
    assert "truncated" not in str(info.value)


def test_full_maps_with_pixel_numbers(tmp_path):
    order = np.random.default_rng(0).permutation(NPIX)
    path = save(tmp_path / "m.fits", {"PIXEL": order, "I": I}, formats={"PIXEL": "J"})
    np.testing.assert_array_equal(read_maps(path).maps[0, order], I)
    columns = {"PIXEL": order, "I": I}
    path = save(path, columns, formats={"PIXEL": "J"}, INDXSCHM="IMPLICIT")
    refuses("IMPLICIT, but column PIXEL has another order", read_maps, path)
    columns["PIXEL"] = np.arange(NPIX)
    path = save(path, columns, formats={"PIXEL": "J"}, INDXSCHM="IMPLICIT")
    np.testing.assert_array_equal(read_maps(path).maps[0], I)


def test_nested_takes_powers_of_two_and_ring_any(tmp_path):
    values = np.random.default_rng(0).normal(size=12 * 12**2)
    path = save(tmp_path / "m.fits", {"I": values}, NSIDE=12)
    np.testing.assert_array_equal(read_maps(path).maps[0], values)
    path = save(tmp_path / "m.fits", {"I": values}, NSIDE=12, ORDERING="NESTED")
    refuses("ordering is NESTED, but nside is 12, no power of 2", read_maps, path)
    np.savez(tmp_path / "m.npz", a=np.ones(values.size))
    refuses("ordering is NESTED, but nside is 12", read_mask, tmp_path / "m.npz", ordering="NESTED")


@pytest.mark.parametrize("nside", [1, 2, 64])
@pytest.mark.parametrize("form", ["E", "D", "I", "J", "1024E"])
def test_sizes_types_and_packing(tmp_path, nside, form):
    values = np.random.default_rng(0).integers(-90, 90, 12 * nside**2)
    if form == "1024E" and nside < 64:
        pytest.skip("fewer pixels than in a row")
    rows = values.reshape(-1, 1024) if form == "1024E" else values
    path = save(tmp_path / "m.fits.gz", {"I": rows}, formats={"I": form}, NSIDE=nside)
    np.testing.assert_array_equal(read_maps(path).maps[0], values)


def test_columns_in_the_table_by_name(tmp_path):
    path = save(tmp_path / "m.fits", {"beta": I, "BETA": Q})
    np.testing.assert_array_equal(read_maps(path, fields="BETA").maps[0], Q)
    refuses("2 columns are called 'Beta'", read_maps, path, fields="Beta")
    for odd in (True, -1, 7):
        refuses(f"no column {odd}; it has beta, BETA", read_maps, path, fields=[odd])
    refuses("no HDU True", read_maps, path, hdu=True, fields="BETA")
    columns = ("HITS", "Q_353GHz", "U_353GHz", "Q_RMS")
    path = save(tmp_path / "n.fits", dict.fromkeys(columns, I))
    assert read_maps(path).names == columns[1:3]
    cube = save(tmp_path / "c.fits", {"I": np.ones((NPIX, 4))}, formats={"I": "4D"}, NSIDE=None)
    assert read_maps(cube, nside=16).nside == 16  # packed by rows, as HEALPix writes
    with refused("NSIDE is 8, but its columns have 3072 pixels"):
        read_maps(save(cube, {"I": np.ones((NPIX, 4))}, formats={"I": "4D"}))


def test_only_what_is_cut_is_called_so(tmp_path):
    path = save(tmp_path / "m.fits", {"I": I})
    whole = path.read_bytes()
    assert b"TFORM1" in whole
    path.write_bytes(whole.replace(b"TFORM1  = 'D", b"TFORM1  = 'Y"))
    with refused("m.fits") as info:
        read_maps(path)
    assert "truncated" not in str(info.value)
    refuses("is a folder", read_maps, tmp_path)
    image = tmp_path / "image.fits"
    pyfits.HDUList([pyfits.PrimaryHDU(), pyfits.ImageHDU(np.ones((3, 4)))]).writeto(image)
    refuses("HDU 1 holds no binary table", read_maps, image)


# Masks


def test_masks_as_healpy_writes_them(tmp_path):
    used = RNG.random(NPIX) > 0.4
    path = tmp_path / "mask.fits"
    for values, options in [
        (np.where(used, 1.0, healpy.UNSEEN), {"partial": True}),
        (np.where(used, 1.0, healpy.UNSEEN), {}),
        (np.where(used, 1.0, healpy.UNSEEN), {"partial": True, "nest": True}),
        (np.where(used, 1.0, np.nan), {}),
        (used.astype(np.uint8), {}),
        (used.astype(np.int32), {"nest": True}),
        (used, {}),
    ]:
        given = healpy.reorder(values, r2n=True) if options.get("nest") else values
        healpy.write_map(path, given, overwrite=True, dtype=values.dtype, **options)
        np.testing.assert_array_equal(read_mask(path), used, err_msg=str(options))
    np.savez(tmp_path / "mask.npz", a=np.where(used, 1.0, healpy.UNSEEN))
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.npz"), used)


def test_masks_with_other_values_say_which(tmp_path):
    for values, words in [
        (np.where(np.arange(NPIX) < 9, -999.0, 1.0), "9 of 768 pixels have others, such as -999"),
        (np.where(np.arange(NPIX) < 9, 0.5, 1.0), "such as 0.5"),
        (np.full(NPIX, 255.0), "768 of 768 pixels have others, such as 255"),
    ]:
        path = save(tmp_path / "m.fits", {"M": values}, None)
        refuses(words, read_mask, path)
    # WMAP's: the mask is N_OBS, and the column TEMPERATURE is zero.
    columns = {"TEMPERATURE": np.zeros(NPIX), "N_OBS": (I > 0).astype(float)}
    wmap = save(tmp_path / "w.fits", columns, None)
    refuses("leaves no pixel; give `field` out of N_OBS", read_mask, wmap)
    np.testing.assert_array_equal(read_mask(wmap, field="N_OBS"), I > 0)
    for array in (np.full(NPIX, "a"), np.ones(NPIX, complex), np.ones((4, NPIX))):
        np.savez(tmp_path / "m.npz", a=array)
        refuses(r"m.npz: a is no mask, but has type", read_mask, tmp_path / "m.npz")
