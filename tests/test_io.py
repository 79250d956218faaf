"""Maps and masks in and out: conventions, round trips, a sentence for whatever is wrong."""

import gzip

import healpy
import numpy as np
import pytest
from astropy.io import fits as pyfits

from jaxsky.bandpass import Bandpass
from jaxsky.io import degrade_mask, read_maps, read_mask, write_maps
from jaxsky.io.stacks import Computed
from mapfiles import NSIDE, save, sky
from refusals import cases, raises, refused, refuses

NPIX = 12 * NSIDE**2
PLANCK = ["I_STOKES", "Q_STOKES", "U_STOKES", "HITS", "II_COV", "IQ_COV", "IU_COV"]
PLANCK += ["QQ_COV", "QU_COV", "UU_COV"]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def planck(tmp_path, rng):
    """An LFI frequency map: NESTED, K_CMB, covariances, one pixel UNSEEN in Q only."""
    maps = {name: rng.normal(size=NPIX).astype(np.float32) for name in PLANCK}
    maps["Q_STOKES"][5] = healpy.UNSEEN
    units = {n: "(K_CMB)^2" if "COV" in n else "K_CMB" for n in PLANCK} | {"HITS": "n/a"}
    header = {"ORDERING": "NESTED", "COORDSYS": "GALACTIC", "POLCCONV": "COSMO", "NSIDE": "8"}
    return save(tmp_path / "planck.fits", maps, units, **header), maps


@pytest.fixture
def bare(tmp_path, rng):
    """A map that says nothing about itself, as the WMAP ones."""
    maps = {f"{s}_STOKES": rng.normal(size=NPIX) for s in "IQU"}
    return save(tmp_path / "bare.fits", maps, COORDSYS=None)


def test_planck_map(planck):
    path, nested = planck
    maps = read_maps(path, nside=NSIDE)
    assert (maps.names, maps.unit, maps.nside) == (tuple(PLANCK[:3]), "K_CMB", NSIDE)
    assert maps.maps.dtype == np.float64
    assert maps.maps.dtype.isnative
    hole = healpy.nest2ring(NSIDE, 5)
    assert np.flatnonzero(~maps.mask).tolist() == [hole]
    assert (maps.maps[:, hole] == 0).all()
    expected = healpy.reorder(np.where(np.arange(NPIX) == 5, 0, nested["U_STOKES"]), n2r=True)
    np.testing.assert_array_equal(maps.maps[2], expected)


def test_covariance_columns_have_squared_units(planck):
    covariance = read_maps(planck[0], fields=["QQ_COV", 8, "uu_cov"])
    assert covariance.unit == "K_CMB^2"
    band = Bandpass.top_hat(30.0, 6.0)
    converted = covariance.to("uK_RJ^2", at=band)
    factor = float(band.conversion("K_CMB", "uK_RJ"))
    np.testing.assert_allclose(converted.maps, covariance.maps * factor**2, rtol=1e-12)
    assert converted.unit == "uK_RJ^2"
    assert read_maps(planck[0], fields="HITS").unit == ""


def test_wmap_map_needs_unit_and_coordinates(tmp_path, rng):
    names = ["TEMPERATURE", "Q_POLARISATION", "U_POLARISATION", "N_OBS"]
    units = dict(zip(names, ["mK", *["mK,thermodynamic"] * 2, "counts"], strict=True))
    maps = {name: rng.normal(size=NPIX) for name in names}
    path = save(tmp_path / "wmap.fits", maps, units, ORDERING="NESTED", COORDSYS=None)
    refuses(r"TEMPERATURE has the unit 'mK', which leaves open", read_maps, path, coordinates="G")
    refuses(r"wmap.fits, HDU 1: the header has no COORDSYS; give", read_maps, path, unit="mK_CMB")
    read = read_maps(path, unit="mK_CMB", coordinates="G")
    assert (read.unit, read.names) == ("mK_CMB", tuple(names[:3]))
    np.testing.assert_allclose(read.to("uK_CMB").maps, 1e3 * read.maps)


def test_iau_changes_the_sign_of_u(planck, tmp_path):
    maps = {n: v for n, v in planck[1].items() if n != "HITS"}
    units = dict.fromkeys(maps, "K_CMB")
    kwargs = {"fields": list(maps), "unit": "K_CMB"}
    cosmo = read_maps(save(tmp_path / "cosmo.fits", maps, units), **kwargs).maps
    for name, header, arg in [("a", {"POLCCONV": "IAU"}, None), ("b", {}, "IAU")]:
        path = save(tmp_path / f"{name}.fits", maps, units, **header)
        iau = read_maps(path, **kwargs, polarization=arg).maps
        flipped = [n in ("U_STOKES", "IU_COV", "QU_COV") for n in maps]
        np.testing.assert_array_equal(iau, np.where(np.array(flipped)[:, None], -cosmo, cosmo))


def test_bad_data_and_not_finite_are_masked(tmp_path):
    values = np.ones(NPIX)
    values[:4] = [np.nan, np.inf, -999.0, healpy.UNSEEN]
    path = save(tmp_path / "m.fits", {"I": values}, {"I": "uK_RJ"}, BAD_DATA=-999.0)
    read = read_maps(path)
    assert (~read.mask).nonzero()[0].tolist() == [0, 1, 2, 3]
    assert read.maps[0].sum() == NPIX - 4
    empty = save(tmp_path / "e.fits", {"I": np.full(NPIX, np.nan)}, {"I": "uK_RJ"})
    refuses(r"e.fits.*no pixel has values in I", read_maps, empty)


def test_maps_in_another_hdu(tmp_path):
    other = pyfits.BinTableHDU.from_columns([pyfits.Column(name="I", format="D", array=[1.0])])
    path = save(tmp_path / "m.fits", {"I": np.ones(NPIX)}, {"I": "K_CMB"}, before=[other])
    assert read_maps(path, hdu=2).maps.sum() == NPIX
    assert read_mask(path, hdu=2).all()


def test_coordinates_are_turned_with_spin_two(tmp_path):
    source, expected = sky(16, "C", 20)
    path = tmp_path / "c.fits"
    healpy.write_map(path, source, coord="C", column_units="uK_RJ", dtype=np.float64)
    read = read_maps(path)
    assert np.abs(read.maps - expected).max() < 1e-6 * np.abs(expected).max()
    assert read.mask.all()
    silent = tmp_path / "silent.fits"
    healpy.write_map(silent, source[1:], column_units="uK_RJ", dtype=np.float64)
    pair = read_maps(silent, fields=[0, 1], coordinates="equatorial")
    np.testing.assert_allclose(pair.maps, read.maps[1:], atol=1e-12)


def test_masked_maps_are_turned_between_pixels(tmp_path):
    source, expected = sky(64, "C", 8)
    source[1, healpy.query_disc(64, [1, 0, 0], 0.3)] = healpy.UNSEEN
    path = tmp_path / "c.fits"
    healpy.write_map(path, source, coord="C", column_units="uK_RJ", dtype=np.float64)
    read = read_maps(path)
    center = healpy.Rotator(coord=["C", "G"])(np.array([1.0, 0, 0]))
    hole = np.isin(np.arange(read.mask.size), healpy.query_disc(64, center, 0.29))
    assert not read.mask[hole].any()
    assert read.mask[~hole].mean() > 0.98
    assert np.abs(read.maps - expected)[:, read.mask].max() < 0.01 * np.abs(expected).max()


def test_round_trip_is_exact(tmp_path, rng):
    maps, mask = rng.normal(size=(3, NPIX)), rng.random(NPIX) > 0.1
    path = tmp_path / "out.fits"
    names, unit = ["I_STOKES", "Q_STOKES", "U_STOKES"], "uK_CMB"
    write_maps(path, maps, names=names, unit=unit, mask=mask, extra_header={"FWHM": 60.0})
    read = read_maps(path)
    np.testing.assert_array_equal(read.maps, np.where(mask, maps, 0))
    np.testing.assert_array_equal(read.mask, mask)
    assert (list(read.names), read.unit) == (names, unit)
    header = pyfits.getheader(path, 1)
    assert [header[k] for k in ("ORDERING", "COORDSYS", "POLCCONV")] == ["RING", "G", "COSMO"]
    assert (header["TUNIT3"], header["NSIDE"], header["FWHM"]) == (unit, NSIDE, 60.0)
    peer = healpy.read_map(path, field=(0, 1, 2), dtype=None)
    np.testing.assert_array_equal(peer, np.where(mask, maps, healpy.UNSEEN))
    assert [p.name for p in tmp_path.iterdir()] == ["out.fits"]


def test_units_of_each_column_survive(tmp_path):
    path = tmp_path / "parameters.fits.gz"
    names, unit = ["beta_dust", "T_dust"], ["", "K"]
    write_maps(path, np.ones((2, NPIX)), names=names, unit=unit)
    assert gzip.decompress(path.read_bytes()).startswith(b"SIMPLE")
    assert read_maps(path, fields="beta_dust").unit == ""
    assert read_maps(path, fields="T_dust", unit="K").unit == "K"


def test_writing_never_overwrites_unasked(tmp_path):
    path = tmp_path / "out.fits"
    write_maps(path, np.ones(NPIX), names="I", unit="uK_RJ")
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"out.fits: file exists"):
        write_maps(path, np.zeros(NPIX), names="I", unit="uK_RJ")
    assert path.read_bytes() == before
    write_maps(path, np.zeros(NPIX), names="I", unit="uK_RJ", overwrite=True)
    assert read_maps(path, missing=[]).maps.sum() == 0


@pytest.mark.parametrize(("change", "words"), cases("io/bad_output"))
def test_bad_output_leaves_nothing(tmp_path, change, words):
    arguments = {"path": "out.fits", "maps": np.ones(NPIX), "names": "I", "unit": "uK_RJ"} | change
    path = tmp_path / arguments.pop("path")
    raises(ValueError, words, write_maps, path, arguments.pop("maps"), **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["out.fits", "out.fits.gz"])
def test_failure_while_writing_leaves_the_old_file(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"old")
    looked = []

    def fail(pixels):
        looked.append(pixels)
        if len(looked) > 1:  # after the check of the values, with half a file
            assert len(list(tmp_path.iterdir())) == 2
            raise OSError("disk full")
        return np.ones((1, NPIX))[:, pixels]

    with pytest.raises(OSError, match="disk full"):
        write_maps(path, Computed((1, NPIX), fail), names="I", unit="uK_RJ", overwrite=True)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


GOOD = {"unit": "uK_CMB", "coordinates": "G"}


@pytest.mark.parametrize(("arguments", "words"), cases("io/bad_arguments"))
def test_bad_arguments(bare, arguments, words):
    with refused(words, ValueError, bare):
        read_maps(bare, **(GOOD | arguments))


@pytest.mark.parametrize(("header", "arguments", "words"), cases("io/bad_headers"))
def test_bad_headers(tmp_path, header, arguments, words):
    maps, units = {k: np.ones(NPIX) for k in ("Q_X", "T_D", "V")}, ("uK_CMB", "K", "MJy/sr")
    path = save(tmp_path / "m.fits", maps, dict(zip(maps, units, strict=True)), **header)
    with refused(words, file=path) as info:
        read_maps(path, **arguments)
    assert str(path) in str(info.value)


def test_files_that_are_no_maps(tmp_path, bare):
    refuses(r"none.fits: no such file", read_maps, tmp_path / "none.fits")
    text = tmp_path / "text.fits"
    simple = b"SIMPLE  =                    T".ljust(80)
    for content in (b"not a map", b"", np.random.default_rng(5).bytes(5000), simple):
        text.write_bytes(content)
        with refused(r"text.fits.*FITS", file=text):
            read_maps(text, **GOOD)
    odd = save(tmp_path / "odd.fits", {"I": np.ones(100)}, NSIDE=None)
    refuses("its columns have 100 values", read_maps, odd, unit="K_RJ")
    cut = tmp_path / "cut.fits.gz"
    cut.write_bytes(gzip.compress(bare.read_bytes())[:-2000])
    refuses(r"cut.fits.gz.*truncated", read_maps, cut, **GOOD)
    two = save(tmp_path / "two.fits", {"A": np.ones(NPIX), "B": np.ones(NPIX)})
    refuses("no column is named as I, Q or U; give `fields` out of", read_maps, two, unit="K_RJ")
    whole = bare.read_bytes()
    for length in (100, 2880, 3500, 6000, len(whole) - 2881, len(whole) - 1):
        cut = tmp_path / "cut.fits"
        cut.write_bytes(whole[:length])
        with refused(r"cut.fits.*truncated", file=cut):
            read_maps(cut, **GOOD)


def test_real_maps(data_dir):
    dust = read_maps(data_dir / "templates" / "dust_d1_353GHz_n64.fits", nside=64)
    assert (dust.unit, dust.maps.shape, dust.mask.all()) == ("uK_RJ", (3, 49152), True)
    path = data_dir / "templates" / "pysm2_d1_QU353GHz_betad_Td_n64.fits"
    assert read_maps(path, fields="BETA_D", unit="").maps.mean() == pytest.approx(1.54, abs=0.01)
    path = data_dir / "wmap7" / "wmap_band_iqumap_r9_7yr_V_v4_udgraded32.fits"
    wmap = read_maps(path, unit="mK_CMB", coordinates="G").to("uK_RJ", at=61.0)
    assert 1 < wmap.maps[1].std() < 20


# Masks


def test_masks(tmp_path, rng):
    mask = rng.random(NPIX) > 0.4
    nested = save(tmp_path / "n.fits", {"GAL": healpy.reorder(mask, r2n=True)}, ORDERING="NEST")
    np.testing.assert_array_equal(read_mask(nested, nside=NSIDE), mask)
    np.savez(tmp_path / "m.npz", A=mask, B=~mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.npz", field="B"), ~mask)
    np.savez(tmp_path / "one.npz", A=healpy.reorder(mask, r2n=True).astype(np.uint8))
    np.testing.assert_array_equal(read_mask(tmp_path / "one.npz", ordering="NESTED"), mask)
    # A disc about the celestial pole, which lies at b = 27 degrees.
    cap = np.isin(np.arange(NPIX), healpy.query_disc(NSIDE, [0, 0, 1], 0.5))
    turned = read_mask(save(tmp_path / "c.fits", {"M": cap}, COORDSYS="C"))
    pole = healpy.Rotator(coord=["C", "G"])(np.array([0.0, 0, 1]))
    near = np.isin(np.arange(NPIX), healpy.query_disc(NSIDE, pole, 0.4))
    far = ~np.isin(np.arange(NPIX), healpy.query_disc(NSIDE, pole, 0.6))
    assert turned[near].all()
    assert not turned[far].any()


def test_bad_masks(tmp_path):
    save(tmp_path / "two.fits", {"A": np.ones(NPIX), "B": np.zeros(NPIX)}, ORDERING=None)
    np.savez(tmp_path / "m.npz", A=np.ones(NPIX), B=np.ones(100))
    (tmp_path / "bad.npz").write_bytes(b"PK not really")
    for path, arguments, words in cases("io/bad_masks"):
        refuses(words, read_mask, tmp_path / path, **arguments)


def test_degrade_mask(rng):
    mask = rng.random(NPIX) > 0.4
    fraction = healpy.reorder(mask.astype(float), r2n=True).reshape(-1, 4).mean(axis=1)
    for threshold in (0.25, 0.5, 1.0):
        expected = healpy.reorder(fraction, n2r=True) >= threshold
        np.testing.assert_array_equal(degrade_mask(mask, NSIDE // 2, threshold), expected)
    for nside in (16, 3):
        with pytest.raises(ValueError, match=f"power of 2 up to that of the mask, 8, not {nside}"):
            degrade_mask(mask, nside)
    raises(ValueError, r"`threshold` must be within \(0, 1\], but is 0", degrade_mask, mask, 4, 0)


def test_real_masks(data_dir):
    path = data_dir / "masks" / "GAL_PlanckMasks_64.npz"
    assert read_mask(path, field="GAL040").mean() == pytest.approx(0.4, abs=0.01)
    path = data_dir / "wmap7" / "wmap_temperature_analysis_mask_r9_7yr_v4_udgraded32.fits"
    assert 0.5 < read_mask(path, nside=32).mean() < 0.8


def test_a_column_is_not_two(tmp_path):
    healpy.write_map(tmp_path / "m.fits", np.ones((3, 12)), dtype=np.float64)
    with refused(r"m.fits, HDU 1: `fields` names a column twice"):
        read_maps(tmp_path / "m.fits", fields=["Q_POLARISATION", "Q_POLARISATION"], unit="K_CMB")
