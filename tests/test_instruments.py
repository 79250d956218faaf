"""Instruments: presets against the papers' figures, tables of one's own, channels and bands."""

import json
from collections import OrderedDict
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pysm3.units as pysm
import pytest
from astropy import units as u
from astropy.constants import c, k_B
from astropy.table import QTable, Table

from fits.fisher import ForecastModel, fiducial, fisher_errors, noise_weights
from fits.mixing import Mixing
from jaxsky import (
    CMB,
    Bandpass,
    Dust,
    Instrument,
    Observation,
    Sky,
    Source,
    Synchrotron,
    load_instrument,
    observe,
    observe_components,
    simulate,
)
from jaxsky.observation import band_tables
from jaxsky.public import packaged
from jaxsky.settings import SettingsError, load
from jaxsky.sky import interpolation_nodes
from refusals import cases, refused, refuses

PRESETS = list(packaged("instruments.toml"))
NSIDE, NPIX = 8, 768
MAPS = np.random.default_rng(3).normal(size=(2, NPIX))


@pytest.mark.parametrize("name", PRESETS)
def test_presets_load_print_and_simulate(tmp_path, name):
    file = tmp_path / "x.toml"
    file.write_text(f'[sky]\nembedded = {{ nside = 8 }}\n[[bands]]\ninstrument = "{name}"\n')
    instrument, tables = load_instrument(name, samples=3), band_tables(name)
    assert list(load_instrument(name, stokes="I")) == [table["name"] for table in tables]
    tables = [table for table in tables if not isinstance(table["noise"]["level"], list)]
    assert list(instrument) == [table["name"] for table in tables]
    assert [band.name for band in load(file).bands_of("QU")] == list(instrument)
    lines = str(instrument).splitlines()
    assert lines[0].startswith(f"Instrument {instrument.title}")
    assert len(lines) == 2 + len(instrument)
    assert all("." not in channel for channel in instrument)
    for table, channel in zip(tables, instrument.values(), strict=True):
        width = float(channel.band.nu[-1] - channel.band.nu[0])
        assert 0.05 < width / float(channel.band.center) < 0.5
        # Ground, balloon and space: from a 6 m dish to a few degrees, from 0.5 uK to 10 mK arcmin.
        assert 0.5 < float(channel.beam) < 150
        assert 0.5 < table["noise"]["level"] < 1e4
        assert set(table) - {"noise_I"} == {"name", "bandpass", "fwhm", "noise"}
        assert ("noise_I" in table) == (table["name"] in instrument.noise_I)
    # No dish is larger than 15 m or smaller than 5 cm: fwhm is about 1.2 wavelengths by diameter.
    for channel in instrument.values():
        meters = 1.2 * 0.2998 / float(channel.band.center) / np.radians(float(channel.beam) / 60)
        assert 0.05 < meters < 100
    there = {"dust": Source(Dust(MAPS))}
    maps = simulate(jax.random.key(0), there, Observation(instrument, NSIDE))
    assert maps.shape == (len(instrument), 2, NPIX)
    assert np.isfinite(maps).all()
    weights = [noise_weights(channel, 30) for channel in instrument.values()]
    assert np.isfinite(weights).all()
    assert (np.diff(weights) <= 0).all()  # the beams


def test_simulated_noise_is_that_of_the_table():
    instrument = load_instrument("so-sat")
    maps = simulate(jax.random.key(1), {}, Observation(instrument, NSIDE, lmax=3 * NSIDE - 1))
    ratios = np.std(maps, axis=(1, 2)) / np.array([c.noise for c in instrument.values()])
    np.testing.assert_allclose(ratios / ratios.mean(), 1, atol=0.1)


#: Some channels: center, fwhm, noise of Q and U as published, and of I where it was.
PUBLISHED = {
    "so-sat": {"93": (93, 30, 2.6 * 2**0.5, 2.6), "280": (280, 9, 16 * 2**0.5, 16)},
    "so-sat-goal": {"27": (27, 91, 25 * 2**0.5, 25), "145": (145, 17, 2.1 * 2**0.5, 2.1)},
    "so-lat": {"27": (27, 7.4, 71 * 2**0.5, 71), "93": (93, 2.2, 8 * 2**0.5, 8)},
    "so-lat-goal": {"145": (145, 1.4, 6.3 * 2**0.5, 6.3), "225": (225, 1.0, 15 * 2**0.5, 15)},
    "pico": {"21": (21, 38.4, 23.9, None), "155": (154.8, 6.2, 1.8, None),
             "799": (798.7, 1.1, 1050, None)},
    "litebird-arrays": {"L1-040": (40, 70.5, 37.42, None), "M2-119": (119, 33.6, 5.70, None),
                        "H3-402": (402, 17.9, 47.45, None)},
    "cmb-s4-sat": {"95": (95, 22.7, 0.78, None), "270": (270, 13, 6.0, None)},
    "cmb-s4-lat": {"93": (93, 2.2, 2.9, 2.0), "278": (278, 0.9, 23.6, 16.7)},
    "spt-3g": {"95": (93.8, 1.57, 8.4, 5.4), "220": (219.9, 1.04, 25.8, 16.2)},
    "advact": {"90": (95.9, 2.2, 7.8 * 2**0.5, 7.8), "220": (221.7, 0.9, 25 * 2**0.5, 25)},
    "bicep-keck": {"95": (95.5, 43.1, 5.2, None), "150": (148.9, 29.7, 2.9, None)},
    "planck": {"100": (101.3, 9.68, 1.96 * 60, 1.29 * 60),
               "353": (361.3, 4.94, 7.31 * 60, 2.56 * 60)},
    # A beam of 8.9 arcmin has 2 pi sigma^2 = 89.8 arcmin^2, and the noise in it is 0.81 mK.
    "s-pass": {"S": (2.303, 8.9, 810 * 89.75**0.5, None)},
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_figures(name):
    instrument = load_instrument(name)
    for channel, (center, fwhm, noise, intensity) in PUBLISHED[name].items():
        one = instrument[channel]
        unit = "uK_RJ" if name == "s-pass" else "uK_CMB"
        factor = float(one.band.conversion("uK_RJ", unit))
        assert float(one.band.center) == pytest.approx(center)
        assert float(one.beam) == pytest.approx(fwhm)
        assert float(one.noise) * factor == pytest.approx(noise, rel=2e-3)
        if intensity is None:
            assert channel not in instrument.noise_I
        else:
            assert float(instrument.noise_I[channel]) * factor == pytest.approx(intensity)


def test_bands_of_planck_without_polarization():
    """Noise as published, 0.78 and 0.72 kJy/sr deg, in HFI's calibration."""
    instrument = load_instrument("planck", stokes="I")
    assert list(instrument) == [*load_instrument("planck"), "545", "857"]
    assert [float(instrument[name].beam) for name in ("545", "857")] == [4.83, 4.64]
    for name, published in (("545", 0.78e3), ("857", 0.72e3)):
        # Jy/sr at nu_0 of nu I_nu = const per K_RJ, over a band in units of power.
        band = instrument[name].band
        nu, nu_0 = np.asarray(band.nu) * 1e9, float(name) * 1e9
        brightness = 2 * nu**2 * k_B.value / c.value**2
        # Weights of antenna temperature hold nu^2 of those of power.
        power = np.asarray(band.weights) / nu**2
        per_K = np.trapezoid(power * brightness, nu) / np.trapezoid(power * nu_0 / nu, nu)
        level = published / (per_K * 1e26) * 60 * 1e6
        assert float(instrument[name].noise) == pytest.approx(level, rel=0.05)  # a top-hat
    for row in instrument.values():
        assert float(row.noise) < 200
    whole = load_instrument("planck", ["353"], stokes="IQU")
    assert whole["353"].noise.shape == (3,)
    np.testing.assert_allclose(whole["353"].noise[0], instrument["353"].noise)
    np.testing.assert_allclose(whole["353"].noise[1:], load_instrument("planck")["353"].noise)
    with pytest.raises(ValueError, match="planck: channel '545' has no polarization; choose"):
        load_instrument("planck", ["353", "545"])


def test_infinite_noise_is_of_bands_without_polarization():
    table = COLUMNS | {"depth_i": [7.0, 2.0, 3.0], "depth": [10.0, 3.0, np.inf]}
    whole = Instrument.from_table(table, stokes="I")
    assert list(Instrument.from_table(table)) == ["30", "95"]
    factors = [float(one.band.conversion("uK_CMB", "uK_RJ")) for one in whole.values()]
    np.testing.assert_allclose(
        [float(c.noise) for c in whole.values()], np.multiply(table["depth_i"], factors)
    )
    with refused("column depth, row 3: is inf, no finite number"):
        Instrument.from_table({k: v for k, v in table.items() if k != "depth_i"})
    alone = {k: v[2:] for k, v in table.items()}
    with pytest.raises(ValueError, match="no channel has polarization; choose stokes 'I'"):
        Instrument.from_table(alone)


def combined(name):
    """The noise of all bands together [uK_CMB arcmin]."""
    return sum(table["noise"]["level"] ** -2 for table in band_tables(name)) ** -0.5


def test_published_sums():
    # LiteBIRD 2023: 2.16 uK arcmin; the PICO report: 0.87; SO: 2 (SAT) and 6 (LAT) of 93 and 145
    # GHz together in intensity, which the abstract rounds.
    assert combined("litebird-arrays") == pytest.approx(combined("litebird"), rel=1e-3)
    assert combined("litebird-arrays") == pytest.approx(2.16, abs=0.01)
    assert combined("pico") == pytest.approx(0.87, abs=0.015)
    for name, expected in (("so-sat", 2.0), ("so-lat", 6.2)):
        tables = packaged("instruments.toml")[name]["bands"][2:4]
        assert sum(t["noise_I"] ** -2 for t in tables) ** -0.5 == pytest.approx(expected, abs=0.05)


def test_arrays_are_those_of_the_bands():
    bands, arrays = load_instrument("litebird"), load_instrument("litebird-arrays")
    for name, band in bands.items():
        same = [one for array, one in arrays.items() if int(array[-3:]) == int(name)]
        level = sum(float(one.noise) ** -2 for one in same) ** -0.5
        assert level == pytest.approx(float(band.noise), rel=1e-3)
        assert max(float(one.beam) for one in same) == pytest.approx(float(band.beam))


def test_the_sky_fraction_and_the_noise_of_intensity_are_shown():
    lines = str(load_instrument("so-lat", ["93", "27"])).splitlines()
    assert lines[0] == "Instrument Simons Observatory, LAT, baseline, 40 % of the sky"
    assert lines[1].split()[-4:] == ["noise", "noise", "of", "I"]
    assert lines[2].split()[-3:] == ["6.4242", "uK_RJ", "arcmin"]
    assert str(load_instrument("pico")).startswith("Instrument PICO, baseline\n")
    assert load_instrument("so-lat").sky_fraction == 0.4
    assert load_instrument("cmb-s4-lat").sky_fraction is None


def sigma_r(name):
    """The error on r from B modes, with dust and synchrotron, of a survey of its sky."""
    instrument, one = load_instrument(name, samples=5), jnp.ones((2, 1))
    ell = np.arange(30, 150)
    sky = Sky({"dust": Dust(one), "synchrotron": Synchrotron(one)})
    weights = jnp.stack([noise_weights(c, int(ell[-1]))[ell] for c in instrument.values()], 1)
    spectra = [1.0 / ell**2.0], [2e-6 * np.ones(ell.size)]
    mixing = Mixing.of(sky, instrument.bands(), "uK_CMB")
    system = ForecastModel(
        mixing, weights, *map(jnp.asarray, spectra), jnp.asarray(ell, float),
        jnp.asarray(instrument.sky_fraction), ("BB",),
    )  # fmt: skip
    foregrounds = {"BB.dust.synchrotron.correlation": 0.0}
    for name, amplitude in (("dust", 0.1), ("synchrotron", 1.0)):
        foregrounds |= {f"BB.{name}.amplitude": amplitude, f"BB.{name}.slope": -2.5}
    free = ("r", "dust.beta_dust", "synchrotron.beta_syn")
    return fisher_errors(system, fiducial(sky, foregrounds, 0.01, 1.0), free).sigma["r"]


def test_forecasts_take_presets():
    errors = {name: sigma_r(name) for name in ("so-sat", "so-sat-goal", "planck", "pico")}
    assert errors["pico"] < errors["so-sat-goal"] < errors["so-sat"] < errors["planck"]


COLUMNS = {
    "name": ["30", "95", "150"],
    "frequency": [30.0, 95.0, 150.0],
    "width": [8.0, 20.0, 30.0],
    "fwhm": [60.0, 30.0, 15.0],
    "depth": [10.0, 3.0, 5.0],
}
ROWS = [dict(zip(COLUMNS, row, strict=True)) for row in zip(*COLUMNS.values(), strict=True)]
IN_UNITS = {
    "channel": COLUMNS["name"],
    "center": [0.030, 0.095, 0.150] * u.THz,
    "bandwidth": [8e9, 20e9, 30e9] * u.Hz,
    "beam": [1.0, 0.5, 0.25] * u.deg,
    "noise": [10.0, 3.0, 5.0] * pysm.uK_CMB * u.arcmin,
}


def assert_same(one, other, rtol=1e-14):
    assert list(one) == list(other)
    for name, channel in one.items():
        same = other[name]
        for value in ("beam", "noise"):
            np.testing.assert_allclose(getattr(channel, value), getattr(same, value), rtol=rtol)
        np.testing.assert_allclose(channel.band.nu, same.band.nu, rtol=rtol)
        assert channel.band.convention == same.band.convention


def written(folder, ending):
    """The file of the columns, in one of the formats."""
    path = folder / f"mine.{ending}"
    if ending in ("csv", "ecsv"):
        table = QTable(IN_UNITS) if ending == "ecsv" else Table(COLUMNS)
        table.write(path, format=f"ascii.{ending}")
    elif ending == "toml":
        path.write_text("\n".join(f"{name} = {value}" for name, value in COLUMNS.items()))
    else:  # JSON is YAML, too
        path.write_text(json.dumps({"bands": ROWS} if ending == "json" else COLUMNS))
    return path


def expected():
    bands = [Bandpass.top_hat(row["frequency"], row["width"]) for row in ROWS]
    return bands, [float(b.conversion("uK_CMB", "uK_RJ")) for b in bands]


def test_a_table_is_an_instrument():
    mine = Instrument.from_table(COLUMNS, "Mine")
    bands, factors = expected()
    assert str(mine).splitlines()[0] == "Instrument Mine"
    for row, band, factor, channel in zip(ROWS, bands, factors, mine.values(), strict=True):
        np.testing.assert_array_equal(channel.band.nu, band.nu)
        assert float(channel.beam) == row["fwhm"]
        assert float(channel.noise) == pytest.approx(row["depth"] * factor, rel=1e-14)
    maps = simulate(jax.random.key(0), {"dust": Source(Dust(MAPS))}, Observation(mine, NSIDE))
    assert maps.shape == (3, 2, NPIX)


@pytest.mark.parametrize(
    "table",
    [
        ROWS,
        tuple(ROWS),
        Table(COLUMNS),
        QTable(IN_UNITS),
        IN_UNITS,
        {"bands": ROWS, "title": "Mine"},
        {"nu [GHz]": [30, 95, 150], "width (MHz)": [8e3, 2e4, 3e4], "FWHM [deg]": [1, 0.5, 0.25],
         "Depth [mK_CMB arcmin]": [0.01, 0.003, 0.005]},
        [{"center": one * u.GHz, "width": width, "fwhm": (fwhm * 60) * u.arcsec,
          "noise": (depth / 60) * u.uK * u.deg}
         for one, width, fwhm, depth in zip(*list(COLUMNS.values())[1:], strict=True)],
    ],
)  # fmt: skip
def test_the_forms_of_a_table(table):
    assert_same(Instrument.from_table(table), Instrument.from_table(COLUMNS))


@pytest.mark.parametrize("ending", ["csv", "ecsv", "json", "yaml", "toml"])
def test_files(tmp_path, ending):
    path = written(tmp_path, ending)
    mine = Instrument.from_table(path)
    assert mine.title == "mine"
    assert_same(mine, Instrument.from_table(str(path)))
    assert_same(mine, Instrument.from_table(COLUMNS))


def test_tables_of_pandas():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(COLUMNS)
    assert_same(Instrument.from_table(frame), Instrument.from_table(COLUMNS))


def test_presets_are_tables():
    for name in ("planck", "core", "so-lat", "s-pass"):
        preset = packaged("instruments.toml")[name]
        mine, same = Instrument.from_table(preset), load_instrument(name)
        assert_same(mine, same)
        assert (mine.title, mine.sky_fraction) == (same.title, same.sky_fraction)
        assert mine.noise_I == same.noise_I


def test_antenna_temperature():
    noise = [10.0, 3.0, 5.0] * pysm.uK_RJ * u.arcmin
    mine = Instrument.from_table({**IN_UNITS, "noise": noise})
    np.testing.assert_allclose([c.noise for c in mine.values()], [10.0, 3.0, 5.0], rtol=1e-14)
    with refused("band '30' has noise in uK_RJ, but noise of I in uK_CMB"):
        Instrument.from_table({**IN_UNITS, "noise": noise, "depth_i": [7.0, 2.0, 3.0]})


def test_tables_of_fgbuster():
    table = {
        "frequency": [28.4, 90.0],
        "depth_p": [20.0, 2.8],
        "depth_i": [14.0, 2.0],
        "fwhm": [30.0, 9.5],
        "bandwidth": [0.25, 0.2],
        "detectors": [120, 200],
        "meta": {"f_sky": 0.1, "type": "ground"},
    }
    mine = Instrument.from_table(table)
    assert (list(mine), mine.sky_fraction) == (["28", "90"], 0.1)
    widths = [float(one.band.nu[-1] - one.band.nu[0]) for one in mine.values()]
    np.testing.assert_allclose(widths, [0.25 * 28.4, 0.2 * 90], rtol=1e-12)
    factor = float(mine[90].band.conversion("uK_CMB", "uK_RJ"))
    assert float(mine[90].noise) == pytest.approx(2.8 * factor)
    assert float(mine.noise_I["90"]) == pytest.approx(2.0 * factor)
    # Most of its tables say nothing of a width: what it observes is one frequency.
    del table["bandwidth"], table["meta"]
    mine = Instrument.from_table(table | {"f_sky": [0.1, 0.1], "experiment": ["x", "x"]})
    assert mine.sky_fraction == 0.1
    np.testing.assert_array_equal(mine["28"].band.nu, [28.4])


@dataclass
class Channel:
    """The fields of a frequency channel of litebird_sim."""

    bandcenter_ghz: float
    channel: str
    bandwidth_ghz: float
    fwhm_arcmin: float
    pol_sensitivity_channel_ukarcmin: float
    fknee_mhz: float = 20.0
    band: object = None
    detector_names: list = field(default_factory=list)


def test_channels_of_litebird_sim():
    rows = [
        Channel(40.0, "L1-040", 12.0, 70.5, 37.42),
        Channel(402.0, "H3-402", 92.46, 17.9, 47.45),
    ]
    same = load_instrument("litebird-arrays", ["L1-040", "H3-402"])
    assert_same(Instrument.from_table(rows), same)
    metadata = [{**vars(row), "net_channel_ukrts": 18.5} for row in rows]
    metadata = [{k: v for k, v in row.items() if k != "band"} for row in metadata]
    assert_same(Instrument.from_table(metadata), same)


def test_bad_tables(tmp_path):
    good = {name: column for name, column in COLUMNS.items() if name != "name"}
    for change, words in cases("instruments/bad_tables"):
        table = {name: column for name, column in (good | change).items() if column is not None}
        refuses(words, Instrument.from_table, table)
    for rows, words in cases("instruments/bad_rows"):
        refuses(words, Instrument.from_table, rows)
    for name, text, words in cases("instruments/bad_files"):
        (tmp_path / name).write_text(text)
        with refused(words, ValueError):
            Instrument.from_table(tmp_path / name)
    refuses("none.csv: no such file", Instrument.from_table, tmp_path / "none.csv")
    refuses("is int", Instrument.from_table, 3)


@pytest.mark.parametrize("ending", ["csv", "ecsv", "json", "yaml", "toml"])
def test_experiment_files_take_such_files(tmp_path, ending):
    written(tmp_path, ending)
    (tmp_path / "x.toml").write_text(
        f'[sky]\nembedded = {{ nside = 8 }}\n[[bands]]\ninstrument = "mine.{ending}"\n'
        'channels = ["150", "30"]\n'
    )
    bands = load(tmp_path / "x.toml").bands
    assert [(band.name, band.fwhm, band.noise.level) for band in bands] == [
        ("150", 15.0, 5.0), ("30", 60.0, 10.0)
    ]  # fmt: skip
    assert [band.noise.unit for band in bands] == ["uK_CMB"] * 2
    with pytest.raises(SettingsError, match=r"bands.0.instrument: .*no channel '9'.*30, 95, 150"):
        load(tmp_path / "x.toml", ['bands.0.channels = ["9"]'])


def test_a_bad_file_of_an_experiment_is_one_sentence(tmp_path):
    (tmp_path / "mine.csv").write_text("frequency,fwhm,depth\n30,60,-3\n")
    (tmp_path / "x.toml").write_text(
        '[sky]\nembedded = { nside = 8 }\n[[bands]]\ninstrument = "mine.csv"\n'
    )
    with pytest.raises(SettingsError, match=r"mine.csv: column depth, row 1: .*but is -3"):
        load(tmp_path / "x.toml")


def test_channels_are_found_by_number():
    planck = load_instrument("planck")
    assert planck[44] is planck["44"]
    assert planck[np.int64(353)] is planck["353"]
    for name in (45, "45", 44.0):
        with pytest.raises(KeyError, match=f"Planck has no channel {name!r}; it has 30, 44, 70"):
            planck[name]


def test_bands_are_observed_in_order():
    # Sorted, as a dictionary is under jit, 100 comes before 30.
    instrument = load_instrument("planck", ["30", "353", "100"], samples=5)
    bands, ones = instrument.bands(), np.ones((2, 12))
    sky = Sky({"cmb": CMB(ones), "dust": Dust(ones)})
    right = observe(sky, [instrument[nu].band for nu in (30, 353, 100)])
    assert right[0, 0, 0] != right[2, 0, 0]
    np.testing.assert_array_equal(observe(sky, bands), right)
    np.testing.assert_allclose(jax.jit(observe)(sky, bands), right, rtol=1e-12)
    parts = observe_components(sky, bands)
    np.testing.assert_allclose(parts["cmb"] + parts["dust"], right, rtol=1e-12)
    moved = jax.grad(lambda b: observe(sky, b)[1].sum())(bands)  # of the second band only
    assert isinstance(moved, OrderedDict)
    assert list(moved) == list(bands)
    assert [bool(jnp.any(one.nu != 0)) for one in moved.values()] == [False, True, False]
    varying = Sky({"dust": Dust(ones, jnp.linspace(1.4, 1.6, 12))})
    plan = interpolation_nodes(varying, list(bands.values()), 1e-10)
    assert interpolation_nodes(varying, bands, 1e-10) == plan
    with pytest.raises(TypeError, match="for a dictionary list"):
        observe(sky, dict(bands))
