"""Map entries of settings: files as the archives and other codes write them, through to values."""

from pathlib import Path

import healpy
import numpy as np
import pytest

from fits.commands.run import DEFAULTS
from fits.inputs import inputs_of, read_band
from fits.regions import region_masks
from fits.separated_data import separation_data
from jaxsky.inputs import read, read_sky
from jaxsky.io import InputError
from jaxsky.settings import BandTable, Experiment, MapFile, SettingsError, load
from mapfiles import NSIDE, table, write
from refusals import cases, raises

NPIX = 12 * NSIDE**2
RNG = np.random.default_rng(11)
I, Q, U = RNG.normal(size=(3, NPIX))  # noqa: E741


def band(folder, entry, unit="uK_RJ"):
    """Q and U of a band at one frequency in the unit of its file, and where they are known."""
    full = {"name": "b", "bandpass": {"center": 30.0}, "noise": {"rms": 1.0}} | entry
    found = read_band(folder, BandTable.model_validate(full))
    return np.asarray(found.maps) / float(found.bandpass.conversion(unit, "uK_RJ")), found


def template(folder, entry):
    """A template that is called t."""
    settings = Experiment.model_validate({"data_dir": str(folder), "sky": {"t": entry}})
    return read_sky(settings)[0]["t"]


def test_spass_with_files_of_its_noise(tmp_path):
    """IAU, a file for each Stokes parameter and each noise; all columns are called UNKNOWN1."""
    keys = {"POLCCONV": "IAU"}
    for name, values in {
        "q": Q,
        "u": U,
        "sq": 1 + Q**2,
        "su": 2 + U**2,
        "squ": 0.1 + 0 * Q,
    }.items():
        unit = "K_RJ^2" if name == "squ" else "K_RJ"
        write(tmp_path / f"{name}.fits", table({"UNKNOWN1": values}, [unit], form="D", **keys))
    entry = {"file": ["q.fits", "u.fits"], "noise": {"rms": {"file": ["sq.fits", "su.fits"]}}}
    raises(InputError, r"q.fits.*UNKNOWN1.*give `stokes`", band, tmp_path, entry)
    values, found = band(tmp_path, entry | {"stokes": "QU"}, "K_RJ")
    np.testing.assert_allclose(values, [Q, -U], rtol=1e-12)
    rms = np.sqrt(np.einsum("iip->ip", found.noise)) / 1e6
    np.testing.assert_allclose(rms, [1 + Q**2, 2 + U**2], rtol=1e-12)
    with pytest.raises(SettingsError, match=r"bands.b.fields: UNKNOWN1, UNKNOWN1 are not Q and U"):
        band(tmp_path, entry | {"stokes": ["U", "Q"]})
    # The order of a covariance is that of the settings: U in it changes the sign.
    spec = {"fields": ["A", "B", "C"], "file": "cov.fits"}
    columns = {"A": np.full(NPIX, 3.0), "B": np.full(NPIX, 0.5), "C": np.full(NPIX, 2.0)}
    write(tmp_path / "cov.fits", table(columns, ["K_RJ^2"] * 3, **keys))
    _, found = band(tmp_path, entry | {"stokes": "QU", "noise": {"covariance": spec}})
    np.testing.assert_allclose(found.noise[0, 1], -0.5e12, rtol=1e-6)
    # What is of the map is not taken for its noise where the map has several files.
    with pytest.raises(SettingsError, match=r"bands.b.noise.covariance: the map has several files"):
        band(tmp_path, entry | {"stokes": "QU", "noise": {"covariance": ["A", "B", "C"]}})


def test_noise_in_celestial_coordinates(tmp_path):
    columns = {"Q_RMS": 1 + Q**2, "U_RMS": 1 + U**2}
    write(tmp_path / "rms.fits", table(columns, ["uK_RJ"] * 2, COORDSYS="C"))
    write(tmp_path / "m.fits", table({"Q": Q, "U": U}, ["uK_RJ"] * 2))
    entry = {"file": "m.fits", "noise": {"rms": {"file": "rms.fits", "fields": ["Q_RMS", "U_RMS"]}}}
    raises(InputError, r"rms.fits.*Q_RMS cannot be turned", band, tmp_path, entry)
    columns = {"Q_RMS": np.full(NPIX, 2.0)}
    write(tmp_path / "rms.fits", table(columns, ["uK_RJ"], COORDSYS="C"))
    entry["noise"]["rms"]["fields"] = ["Q_RMS"]
    np.testing.assert_allclose(band(tmp_path, entry)[1].noise[1, 1], 4.0, rtol=1e-6)


def test_healpy_and_pysm(tmp_path):
    """Full, partial and NESTED with healpy's own names; PySM's names with their frequency."""
    path, options = tmp_path / "m.fits", {"overwrite": True, "coord": "G", "dtype": np.float64}
    part = np.where(np.arange(NPIX) % 3 == 0, healpy.UNSEEN, [I, Q, U])
    for maps, nest, partial in [
        ([I, Q, U], False, False),
        ([I, Q, U], True, False),
        (part, False, True),
        (part[1:], True, True),
    ]:
        given = [healpy.reorder(m, r2n=True) for m in maps] if nest else maps
        healpy.write_map(path, given, nest=nest, partial=partial, column_units="uK_RJ", **options)
        values, found = band(tmp_path, {"file": "m.fits"})
        expected = np.ones(NPIX, bool) if maps is not part and not partial else part[0] > -1e30
        np.testing.assert_array_equal(found.used, expected)
        np.testing.assert_array_equal(values[:, expected], np.array([Q, U])[:, expected])
    columns = {"Q_353GHz": Q, "U_353GHz": U, "BETA_D": 1.5 + 0.01 * I, "T_D": 20 + I}
    write(tmp_path / "pysm.fits", table(columns, ["uK_RJ"] * 2 + [None, "K"], form="D"))
    parameters = {
        "beta_dust": {"file": "pysm.fits", "fields": ["BETA_D"], "unit": ""},
        "T_dust": {"file": "pysm.fits", "fields": ["T_D"], "unit": "K"},
    }
    spec = {"law": "dust", "file": "pysm.fits", "nu_ref": 353.0, "parameters": parameters}
    dust = template(tmp_path, spec).component
    np.testing.assert_array_equal(dust.amplitude, [Q, U])
    np.testing.assert_array_equal(dust.beta_dust, 1.5 + 0.01 * I)
    np.testing.assert_array_equal(dust.T_dust, 20 + I)


def test_footprints_and_marks_in_settings(tmp_path):
    north = np.arange(NPIX) < 0.4 * NPIX
    columns = {"Q": np.where(north, 0, Q), "U": np.where(north, 0, U)}
    write(tmp_path / "zeros.fits", table(columns, ["uK_RJ"] * 2))
    marked = {n: np.where(north, -999.0, v) for n, v in columns.items()}
    write(tmp_path / "marked.fits", table(marked, ["uK_RJ"] * 2))
    for name, missing in (("zeros", 0.0), ("marked", -999), ("marked", [-999.0, 0.0])):
        with pytest.raises(InputError, match=rf"{name}.fits.*give `missing`"):
            band(tmp_path, {"file": f"{name}.fits"})
        found = band(tmp_path, {"file": f"{name}.fits", "missing": missing})[1]
        np.testing.assert_array_equal(found.used, ~north)
    assert band(tmp_path, {"file": "zeros.fits", "missing": []})[1].used.all()
    spec = {"law": "dust", "file": "zeros.fits", "nu_ref": 353.0}
    raises(InputError, r"zeros.fits.*give `missing`", template, tmp_path, spec)
    # A correction is zero where there is nothing to correct.
    write(tmp_path / "m.fits", table({"Q": Q, "U": U}, ["uK_RJ"] * 2))
    leakage = band(tmp_path, {"file": "m.fits", "leakage": {"file": "zeros.fits"}})[1].leakage
    assert leakage.used.all()
    with pytest.raises(InputError, match=r"marked.fits.*give `missing`"):
        band(tmp_path, {"file": "m.fits", "leakage": {"file": "marked.fits"}})
    with pytest.raises(SettingsError, match=r"leakage: 0.02 is of a simulation, but m.fits holds"):
        band(tmp_path, {"file": "m.fits", "leakage": 0.02})


@pytest.mark.parametrize(("entry", "words"), cases("map_settings/mistakes_in_map_entries"))
def test_mistakes_in_map_entries(entry, words):
    raises(ValueError, f"(?s){words}", MapFile.model_validate, {"file": "m.fits"} | entry)


def test_masks_that_are_coarser_are_named_with_their_key(tmp_path):
    write(tmp_path / "mask.fits", table({"M": np.ones(48)}, ["1"]))
    mask, common = {"file": "mask.fits"}, {"nside": NSIDE, "fwhm": 900.0}
    words = "`nside` must be a power of 2 up to that of the mask, 2, not 8"
    for key, change in (
        ("common.mask", {"common": common | {"mask": mask}}),
        ("regions.m", {"common": common, "regions": {"m": mask}, "separate": {"region": "m"}}),
    ):
        settings = separation(tmp_path, **change)
        raises(SettingsError, rf"{key}: .*{words}", region_masks, settings, list(settings.regions))
        raises(SettingsError, rf"{key}: .*{words}", separation_data, settings)


def test_too_many_columns_or_others(tmp_path):
    columns = {"I": I, "Q": Q, "U": U, "HITS": 9 + 0 * I, "X": Q}
    write(tmp_path / "m.fits", table(columns, ["uK_RJ"] * 5))
    for fields, words in cases("map_settings/other_columns"):
        raises(SettingsError, words, band, tmp_path, {"file": "m.fits", "fields": fields})
    np.testing.assert_allclose(band(tmp_path, {"file": "m.fits", "fields": ["Q", "X"]})[0][1], Q)


def test_units_that_are_none_are_named_with_their_key(tmp_path):
    write(tmp_path / "m.fits", table({"Q": Q, "U": U, "HITS": 9 + 0 * I}, ["K", "K", "count"]))
    entry = {"file": "m.fits", "unit": "K"}
    with pytest.raises(SettingsError, match=r"bands.b.unit: Unit 'K' does not convert to 'uK_RJ'"):
        band(tmp_path, entry)
    spec = {"law": "dust", "nu_ref": 353.0} | entry
    raises(SettingsError, r"sky.t.unit: Unit 'K' does not convert", template, tmp_path, spec)
    entry = {"file": "m.fits", "unit": "K_RJ"}
    with pytest.raises(SettingsError, match=r"leakage.unit: Unit 'K' does not convert"):
        band(tmp_path, entry | {"leakage": {"file": "m.fits", "unit": "K"}})
    write(
        tmp_path / "m.fits", table({"Q": Q, "U": U, "HITS": 9 + 0 * I}, ["uK_RJ"] * 2 + ["count"])
    )
    hits = {"fields": ["HITS"], "sigma0": 3.0}
    noise = band(tmp_path, {"file": "m.fits", "noise": {"hits": hits}})[1].noise
    np.testing.assert_allclose(noise[0, 0], 1.0, rtol=1e-6)
    for change, words in (
        ({"fields": ["Q"]}, "column Q is in uK_RJ"),
        ({"unit": "s"}, "is s, but column HITS is"),
    ):
        with pytest.raises(ValueError, match=words):
            band(tmp_path, {"file": "m.fits", "noise": {"hits": hits | change}})


# Maps of parameters


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "m.fits", table({"Q": Q, "U": U}, ["uK_RJ"] * 2))
    holes = np.arange(NPIX) < 40
    columns = {
        "BETA": 1.5 + 0.01 * I,
        "K": 1.5 + 0.01 * I,
        "KELVIN": 20 + I,
        "MILLI": 1e3 * (20 + I),
        "NEGATIVE": -3.0 + 0.01 * I,
        "THERMODYNAMIC": 1.5 + 0.01 * I,
        "ZEROS": np.where(holes, 0, 1.5 + 0.01 * I),
        "HOLES": np.where(holes, healpy.UNSEEN, 20 + I),
    }
    units = ["1", "K", "K", "mK", "1", "uK_CMB", "1", "K"]
    write(tmp_path / "p.fits", table(columns, units, form="D"))
    write(tmp_path / "coarse.fits", table({"BETA": np.full(48, 1.5)}, ["1"]))
    return tmp_path


DUST = {"law": "dust", "file": "m.fits", "nu_ref": 353.0}
SYNCHROTRON = {"law": "synchrotron", "file": "m.fits", "nu_ref": 30.0}


def parameter(folder, spec, name, entry):
    full = spec | {"parameters": {name: {"file": "p.fits"} | entry}}
    found = template(folder, full)
    return np.asarray(getattr(found.component, name)), found.used


@pytest.mark.parametrize(
    ("law", "name", "entry", "words"), cases("map_settings/maps_of_parameters")
)
def test_maps_of_parameters_are_checked(folder, law, name, entry, words):
    spec = {"dust": DUST, "synchrotron": SYNCHROTRON}[law]
    with pytest.raises(SettingsError, match=rf"sky.t.parameters.{name}: .*{words}"):
        parameter(folder, spec, name, entry)


def test_maps_of_parameters_that_are_right(folder):
    for entry in ({"fields": ["KELVIN"], "unit": "K"}, {"fields": ["MILLI"], "unit": "mK"}):
        found, used = parameter(folder, DUST, "T_dust", entry)
        np.testing.assert_allclose(found, 20 + I, rtol=1e-12)
        assert used.all()
    # Pixels without a value are not used, and hold one that the law can be computed with.
    found, used = parameter(folder, DUST, "T_dust", {"fields": ["HOLES"], "unit": "K"})
    np.testing.assert_array_equal(used, np.arange(NPIX) >= 40)
    np.testing.assert_array_equal(found[used], (20 + I)[used])
    np.testing.assert_array_equal(found[~used], np.median((20 + I)[used]))
    found, used = parameter(folder, DUST, "beta_dust", {"fields": ["ZEROS"], "missing": 0.0})
    assert used.sum() == NPIX - 40
    assert (found > 1).all()
    raises(
        InputError,
        "'K', which leaves open",
        parameter,
        folder,
        DUST,
        "beta_dust",
        {"fields": ["K"]},
    )


def test_noise_of_an_instrument_keeps_its_unit(folder):
    """That of Planck is in uK_CMB, whatever the unit of the map."""
    entry = {"name": "44", "instrument": "planck", "file": "m.fits"}
    settings = Experiment.model_validate({"data_dir": str(folder), "bands": [entry]})
    found = read_band(folder, settings.bands[0])
    expected = 240.0 / float(found.bandpass.conversion("uK_RJ", "uK_CMB"))
    np.testing.assert_allclose(found.noise, expected, rtol=1e-6)


@pytest.mark.parametrize(("change", "words"), cases("map_settings/numbers_of_templates"))
def test_numbers_of_templates_are_checked(change, words):
    raises(ValueError, words, Experiment.model_validate, {"sky": {"t": DUST | change}})


@pytest.mark.parametrize("table_", cases("map_settings/the_other_sign"))
def test_the_other_sign_of_beta_syn_is_named_with_its_key(table_):
    key = next(iter(table_))
    words = rf"{key}.synchrotron.beta_syn: beta_syn is the index in T ~ nu\^-beta_syn"
    entry = {"name": "b", "file": "m.fits", "bandpass": {"center": 30.0}, "noise": {"rms": 1.0}}
    raw = {"sky": {"synchrotron": SYNCHROTRON}, "bands": [entry]}
    for change in ({}, {"sky": {"s": {"law": "synchrotron"}}}, {"bands": [{"instrument": "wmap"}]}):
        raises(ValueError, words, Experiment.model_validate, raw | change | table_)
    twice = {"fixed": {"synchrotron.nu_ref": 23.0}}
    with pytest.raises(ValueError, match=r"fixed.synchrotron.nu_ref: belongs next to law"):
        Experiment.model_validate(raw | twice)
    offset = {"free": {"synchrotron.beta_syn.offset": {"start": -0.1, "uniform": [-1.0, 0.5]}}}
    Experiment.model_validate(raw | offset)


def separation(folder, **change):
    names = ("a", "b", "c")
    bands = [
        {"name": n, "file": "m.fits", "bandpass": {"center": 30.0 + 60 * i}, "noise": {"rms": 1.0}}
        for i, n in enumerate(names)
    ]
    raw = {
        "data_dir": str(folder),
        "common": {"nside": NSIDE, "fwhm": 900.0},
        "separate": {"sampler": "none"},
        "sky": {"dust": {"law": "dust"}},
        "free": {"dust.beta_dust": {"start": 1.5}},
        "bands": bands,
    }
    return Experiment.model_validate(raw | change)


def test_maps_of_parameters_in_separations(folder):
    def with_(name, **entry):
        parameters = {name: {"file": "p.fits"} | entry}
        return separation_data(
            separation(folder, sky={"dust": {"law": "dust", "parameters": parameters}})
        )

    for entry, words in cases("map_settings/in_separations"):
        where = rf"sky.dust.parameters.{entry['name']}: {words}"
        raises(SettingsError, where, with_, **entry)
    found = with_("T_dust", fields=["HOLES"], unit="K")
    assert not found.used[:40].any()
    regions = {"file": "p.fits", "fields": ["HOLES"], "unit": "K"}
    free = {"dust.beta_dust": {"start": 1.5, "regions": regions}}
    words = r"free.dust.beta_dust.regions: 40 of 768 used pixels have no value"
    raises(SettingsError, words, separation_data, separation(folder, free=free))
    dust = {"law": "dust", "nu_ref": 353.0, "parameters": {"nu_ref": 545.0}}
    with pytest.raises(ValueError, match=r"parameters\.nu_ref: belongs next to law"):
        separation(folder, sky={"dust": dust})


def test_what_a_log_holds_is_read_again(tmp_path):
    """Settings with lists, as they were written into a log."""
    for name, values in {"q": Q, "u": U}.items():
        write(tmp_path / f"{name}.fits", table({"X": values}, ["uK_RJ"], POLCCONV="IAU"))
    entry = {"file": ["q.fits", "u.fits"], "hdu": [1, 1], "stokes": ["Q", "U"], "missing": [-1.0]}
    raw = {
        "data_dir": str(tmp_path),
        "sky": {"synchrotron": SYNCHROTRON | entry},
        "bands": [entry | {"name": "b", "bandpass": {"center": 30.0}, "noise": {"rms": 1.0}}],
        "cmb": {"include": False},
    }
    settings = Experiment.model_validate(raw)
    again = Experiment.model_validate(settings.model_dump(mode="json"))
    found = inputs_of(again)
    np.testing.assert_allclose(found.bands["b"].maps, [Q, -U], rtol=1e-6)
    assert again.bands[0].label == "q.fits, u.fits"
    assert read(tmp_path, again.bands[0]).stokes == ("Q", "U")
    for path in [*DEFAULTS.glob("*.toml"), *Path(__file__).parents[1].glob("examples/*.toml")]:
        settings = load(path)
        again = Experiment.model_validate(settings.model_dump(mode="json", exclude_none=True))
        assert again == settings
