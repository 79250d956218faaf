"""What settings name, read: noise in all its forms, templates with and without intensity."""

import healpy
import numpy as np
import pytest
from astropy.io import fits as pyfits

from fits.inputs import inputs_of
from jaxsky.bandpass import Bandpass
from jaxsky.inputs import bandpass_of, read, read_sky, set_parameters_of
from jaxsky.io import InputError
from jaxsky.noise_inputs import read_noise
from jaxsky.settings import (
    BandTable,
    Experiment,
    MapFile,
    NoiseTable,
    SeenKeys,
    SettingsError,
    load,
)
from mapfiles import table, write
from refusals import cases, raises

NSIDE = 4
NPIX = 12 * NSIDE**2
BAND = Bandpass.top_hat(44.0, 8.0)
#: uK_RJ in a K_CMB.
FACTOR = float(BAND.conversion("K_CMB", "uK_RJ"))
SIX = ["II_COV", "IQ_COV", "IU_COV", "QQ_COV", "QU_COV", "UU_COV"]
HOLE = 7


def save(path, columns, units, **header):
    write(path, table(columns, units, form="D", **header))


@pytest.fixture(scope="module")
def matrices():
    """Covariances of I, Q, U [K_CMB^2], all elements different."""
    roots = np.random.default_rng(3).normal(size=(NPIX, 3, 3))
    return 1e-12 * (np.einsum("pik,pjk->ijp", roots, roots) + np.eye(3)[..., None])


@pytest.fixture(scope="module")
def hits():
    found = np.random.default_rng(4).integers(1, 900, NPIX).astype(float)
    found[HOLE] = 0
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory, matrices, hits):
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(5)
    maps = {f"{s}_STOKES": rng.normal(size=NPIX) for s in "IQU"}
    # As Planck's: NESTED, K_CMB, a pixel without a value.
    rows, columns = np.triu_indices(3)
    covariance = dict(zip(SIX, matrices[rows, columns].copy(), strict=True))
    covariance["UU_COV"][HOLE] = healpy.UNSEEN
    units = ["K_CMB"] * 3 + ["K_CMB^2"] * 6
    save(folder / "planck.fits", maps | covariance, units, ORDERING="NESTED")
    # As WMAP's: mK that may be anything, "counts", no coordinates.
    wmap = {"TEMPERATURE": maps["I_STOKES"], "Q_POLARISATION": maps["Q_STOKES"]}
    wmap |= {"U_POLARISATION": maps["U_STOKES"], "N_OBS": hits, "MINUS": -hits}
    units = ["mK", *["mK,thermodynamic"] * 2, "counts", "counts"]
    save(folder / "wmap.fits", wmap, units, ORDERING="NESTED", COORDSYS=None)
    rms = {f"{s}_RMS": 1e-6 * (1 + rng.random(NPIX)) for s in "IQU"}
    rms["Q_RMS"][HOLE] = np.nan
    rms |= {"MINUS": -rms["I_RMS"], "ZERO": 0 * rms["I_RMS"]}
    save(folder / "rms.fits", rms, ["K_CMB"] * 5)
    save(folder / "wide.fits", {"RMS": np.ones(12 * 2**2)}, ["uK_RJ"])
    save(folder / "iqu.fits", maps, ["uK_RJ"] * 3)
    polarized = {k: v for k, v in maps.items() if k != "I_STOKES"}
    save(folder / "qu.fits", polarized, ["uK_RJ"] * 2)
    save(folder / "beta.fits", {"BETA_D": 1.5 + 0.1 * rng.random(NPIX)}, ["1"])
    save(folder / "ame.fits", {"I": 1 + rng.random(NPIX)}, ["K_RJ"])
    return folder


PLANCK = MapFile(file="planck.fits", fields=["Q_STOKES", "U_STOKES"])
WMAP = MapFile(
    file="wmap.fits", fields=["Q_POLARISATION", "U_POLARISATION"], unit="mK_CMB", coordinates="G"
)


def noise_of(folder, spec, stokes="QU", unit="K_CMB", own=None):
    file = {} if own is None else own.model_dump(exclude_none=True)
    table = SeenKeys(**file, noise=NoiseTable.model_validate(spec))
    return read_noise(folder, table, BAND, NSIDE, "noise", unit, stokes)


def others():
    return np.arange(NPIX) != HOLE


@pytest.mark.parametrize("stokes", ["QU", "IQU"])
def test_rms_is_in_the_unit_of_the_map(folder, stokes):
    pixel = healpy.nside2resol(NSIDE, arcmin=True)
    level, known = noise_of(folder, {"rms": 2e-6}, stokes)
    assert known.all()
    assert known.shape == (NPIX,)
    assert level == pytest.approx(2e-6 * FACTOR * pixel, rel=1e-12)
    assert noise_of(folder, {"rms": 2.0}, stokes, unit="uK_RJ")[0] == pytest.approx(2.0 * pixel)


@pytest.mark.parametrize(("fields", "stokes", "used"), cases("inputs/rms_maps"))
def test_rms_maps(folder, fields, stokes, used):
    spec = {"rms": {"file": "rms.fits", "fields": fields}}
    covariance, known = noise_of(folder, spec, stokes)
    np.testing.assert_array_equal(known, others() if "Q_RMS" in fields else np.ones(NPIX, bool))
    table = pyfits.getdata(folder / "rms.fits")
    rms = np.stack([table[name] for name in used]) * FACTOR
    expected = np.where(known, np.eye(len(used))[..., None] * rms**2, 0)
    np.testing.assert_allclose(covariance, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("names", "stokes"), [(SIX, "IQU"), (SIX, "QU"), (SIX[3:], "QU")], ids=["6", "6QU", "3QU"]
)
@pytest.mark.parametrize("inside", [True, False])
def test_covariance_columns(folder, matrices, names, stokes, inside):
    """In the file of the map, or in another one: the same matrices, in uK_RJ^2."""
    if inside:
        covariance, known = noise_of(folder, {"covariance": names}, stokes, own=PLANCK)
    else:
        spec = {"covariance": {"file": "planck.fits", "fields": names}}
        covariance, known = noise_of(folder, spec, stokes, unit="uK_RJ")
    np.testing.assert_array_equal(known, others())
    n = len(stokes)
    expected = np.where(known, matrices[-n:, -n:] * FACTOR**2, 0)
    np.testing.assert_allclose(covariance, expected, rtol=1e-12)


@pytest.mark.parametrize(("sigma0", "stokes", "each"), cases("inputs/hits"))
def test_hits_are_wmaps_numbers_of_observations(folder, hits, sigma0, stokes, each):
    """The variance is sigma_0^2 / N_obs; ordering and coordinates are those of the map."""
    spec = {"hits": {"fields": ["N_OBS"], "sigma0": sigma0}}
    covariance, known = noise_of(folder, spec, stokes, unit="mK_CMB", own=WMAP)
    np.testing.assert_array_equal(known, others())
    variance = (np.array(each)[:, None] * 1e-3 * FACTOR) ** 2 / np.where(known, hits, np.inf)
    np.testing.assert_allclose(covariance, np.eye(len(each))[..., None] * variance, rtol=1e-12)


def test_hits_in_another_file_with_a_unit_of_sigma0(folder):
    own = {"hits": {"fields": ["N_OBS"], "sigma0": 1.4}}
    expected, _ = noise_of(folder, own, unit="mK_CMB", own=WMAP)
    table = {"file": "wmap.fits", "fields": ["N_OBS"], "coordinates": "G"}
    spec = {"hits": table | {"sigma0": 1400.0}, "unit": "uK_CMB"}
    found, _ = noise_of(folder, spec, unit="K_RJ")
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(("spec", "stokes", "own", "words"), cases("inputs/mistakes_in_noise"))
def test_mistakes_in_noise_are_one_sentence(folder, spec, stokes, own, words):
    own = {"planck": PLANCK, "wmap": WMAP}.get(own)
    raises(SettingsError, words, noise_of, folder, spec, stokes, own=own)


def test_files_that_cannot_be_read_are_named_once(folder):
    with pytest.raises(InputError, match=r"^[^:]*none.fits: no such file, and none in [^:]*\.$"):
        noise_of(folder, {"rms": {"file": "none.fits"}})
    with pytest.raises(InputError, match=r"rms.fits.*missing"):
        noise_of(folder, {"rms": {"file": "rms.fits", "fields": ["ZERO"]}})
    with pytest.raises(InputError, match=r"no column 'XX'"):
        noise_of(folder, {"covariance": ["XX", *SIX[4:]]}, own=PLANCK)


@pytest.mark.parametrize(("noise", "words"), cases("inputs/mistakes_in_the_table_of_noise"))
def test_mistakes_in_the_table_of_noise_are_one_sentence(tmp_path, noise, words):
    path = tmp_path / "settings.toml"
    path.write_text(f"[[bands]]\nname = 'a'\nfile = 'a.fits'\nnoise = {noise}")
    with pytest.raises(SettingsError) as mistake:
        load(path)
    assert str(mistake.value).startswith(f"{path}: ")
    assert words in str(mistake.value)


def specs(file, **more):
    """Dust from a file, with a map of its index, and AME along it that is named before it."""
    dust = {"law": "dust", "file": file, "nu_ref": 353.0, "fwhm": 10.0}
    dust["parameters"] = {"beta_dust": {"file": "beta.fits"}, "T_dust": 20.0}
    ame = {"law": "ame", "file": "ame.fits", "nu_ref": 22.8, "angles": "dust"}
    return {"ame": ame, "dust": dust | more}


def templates_of(folder, sky, stokes="QU", **settings):
    settings = Experiment.model_validate(settings | {"data_dir": str(folder), "sky": sky})
    return read_sky(settings, stokes)[0]


def test_templates_with_intensity(folder):
    templates = templates_of(folder, specs("iqu.fits"), "IQU")
    maps = read(folder, MapFile(file="iqu.fits")).maps
    dust, ame = templates["dust"], templates["ame"].component
    np.testing.assert_array_equal(dust.component.amplitude, maps)
    assert (float(dust.component.T_dust), dust.fwhm) == (20.0, 10.0)
    np.testing.assert_array_equal(
        dust.component.beta_dust, pyfits.getdata(folder / "beta.fits")["BETA_D"]
    )
    # AME: its own intensity, the angles of the dust, a polarization of 1 %.
    intensity = 1e6 * pyfits.getdata(folder / "ame.fits")["I"]
    np.testing.assert_allclose(ame.template[0], intensity, rtol=1e-12)
    np.testing.assert_allclose(
        np.arctan2(ame.template[2], ame.template[1]), np.arctan2(maps[2], maps[1]), atol=1e-12
    )
    np.testing.assert_allclose(
        np.hypot(ame.template[1], ame.template[2]), 0.01 * intensity, rtol=1e-12
    )


def test_polarization_is_the_same_with_and_without_intensity(folder):
    whole = templates_of(folder, specs("iqu.fits"), "IQU")
    for file in ("iqu.fits", "qu.fits"):
        polarized = templates_of(folder, specs(file))
        assert list(polarized) == list(whole) == ["ame", "dust"]
        for name, template in polarized.items():
            assert template.component.amplitude.shape == (2, NPIX)
            expected = whole[name].component.amplitude[1:]
            np.testing.assert_array_equal(template.component.amplitude, expected)


@pytest.mark.parametrize(
    ("file", "fields", "stokes", "words"), cases("inputs/templates_without_all")
)
def test_templates_without_all_that_is_needed_are_refused(folder, file, fields, stokes, words):
    raises(SettingsError, words, templates_of, folder, specs(file, fields=fields), stokes)


def test_angles_come_from_a_template_with_some(tmp_path):
    path = tmp_path / "settings.toml"
    spec = 'sky.{} = {{ law = "ame", file = "ame.fits", nu_ref = 22.8{} }}\n'
    first, second = spec.format("a", ', angles = "b"'), spec.format("b", ', angles = "a"')
    path.write_text(first + spec.format("b", ""))
    assert load(path).sky.templates == ["a", "b"]
    for text, words in (
        (first, "there is no map of b"),
        (first + spec.format("b", "").replace('file = "ame.fits", ', ""), "there is no map of b"),
        (first + second, "b has none of its own"),
    ):
        path.write_text(text)
        raises(SettingsError, rf"settings.toml: sky.a.angles: {words}\.", load, path)


def test_parameters_are_set_in_a_copy(folder):
    templates = templates_of(folder, specs("qu.fits"))
    changed = set_parameters_of(templates, {"dust.T_dust": 25.0})
    assert float(changed["dust"].component.T_dust) == 25.0
    assert float(templates["dust"].component.T_dust) == 20.0
    assert changed["ame"] is templates["ame"]
    raises(KeyError, r"Unknown parameter 'dust.T'", set_parameters_of, templates, {"dust.T": 3.0})
    for fixed, words in (
        ("cmb.T_cmb", r"there is no component 'cmb'; components are ame, dust\."),
        ("dust.T", r"Unknown parameter 'dust.T'"),
    ):
        with pytest.raises(SettingsError, match=f"fixed: {words}"):
            templates_of(folder, specs("qu.fits"), fixed={fixed: 3.0})


def band(**keys):
    return BandTable.model_validate({"name": "b", "bandpass": keys})


def test_bandpasses_of_settings(folder):
    assert bandpass_of(folder, band(center=70.0)).nu.tolist() == [70.0]
    top_hat = bandpass_of(folder, band(center=70.0, width=14.0, convention="power"))
    assert (float(top_hat.nu[0]), float(top_hat.nu[-1])) == (63.0, 77.0)
    assert top_hat.convention == "power"
    table = np.array([[60.0, 0.0], [70.0, 1.0], [80.0, 0.0]])
    np.savetxt(folder / "band.txt", table)
    read_in = bandpass_of(folder, band(file="band.txt", convention="RJ"))
    np.testing.assert_array_equal(read_in.nu, table[:, 0])


def test_fits_take_hits_and_six_columns(folder, matrices, hits):
    """Both as noise of Q and U; pixels without either are not used."""
    common = {"bandpass": {"center": 44.0, "width": 8.0}, "fwhm": 30.0}
    wmap = WMAP.model_dump() | {"noise": {"hits": {"fields": ["N_OBS"], "sigma0": 1.4}}}
    planck = PLANCK.model_dump() | {"noise": {"covariance": SIX}}
    settings = Experiment.model_validate(
        {
            "data_dir": str(folder),
            "free": {"dust.T_dust": {"start": 21.0}},
            "sky": {"dust": specs("qu.fits")["dust"]},
            "bands": [common | wmap | {"name": "W"}, common | planck | {"name": "P"}],
            "cmb": {"include": False},
        }
    )
    # What was written into a log is read again.
    bands = inputs_of(Experiment.model_validate(settings.model_dump())).bands
    for band in bands.values():
        np.testing.assert_array_equal(band.used, others())
        assert not band.maps[:, HOLE].any()
    variance = (1.4e-3 * FACTOR) ** 2 / hits[others()]
    expected = np.eye(2)[..., None] * variance
    np.testing.assert_allclose(bands["W"].noise[..., others()], expected, rtol=1e-12)
    expected = matrices[1:, 1:, others()] * FACTOR**2
    np.testing.assert_allclose(bands["P"].noise[..., others()], expected, rtol=1e-12)


def test_bandpasses_with_unit_and_columns_from_settings(tmp_path):
    (tmp_path / "b.txt").write_text("0 28000 1\n1 30000 1\n")
    spec = {"file": "b.txt", "convention": "RJ", "unit": "MHz", "fields": [1, 2]}
    np.testing.assert_allclose(bandpass_of(tmp_path, band(**spec)).nu, [28, 30])
    with pytest.raises(ValueError, match="unit and fields are of a file, but file is missing"):
        band(center=30.0, unit="MHz", fields=[1, 2])
