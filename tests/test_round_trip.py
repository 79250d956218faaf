"""One experiment file through all commands: simulated maps are read back as they were made."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from commands import experiment, jaxsky
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.results import misfit
from fits.spectral_index import _look
from jaxsky import Bandpass
from jaxsky.experiment import cmb_spectra, simulation_inputs
from jaxsky.harmonics import gaussian_beam
from jaxsky.io import InputError, write_maps
from jaxsky.montecarlo import other_sky, run
from jaxsky.observed import Observed, observed_tables, read_observed
from jaxsky.settings import SettingsError, load
from refusals import raises

NSIDE, NPIX = 16, 12 * 16**2


SETTINGS, BANDS = experiment("round_trip"), experiment("bands")


def settings_in(folder, text=SETTINGS):
    (folder / "x.toml").write_text(text)
    return folder / "x.toml"


def written(path, out, *values):
    """The maps of the first realisation that settings describe; their folder."""
    settings = load(path, values)
    assert len(list(run(settings, simulation_inputs(settings), out, range(1)))) == len(
        settings.bands
    )
    return out / "sim_00000"


def assert_same_bands(first, second, rtol=1e-9):
    assert list(first) == list(second)
    for name, one in first.items():
        other = second[name]
        scale = float(jnp.abs(one.maps).max())
        np.testing.assert_allclose(one.maps, other.maps, rtol=0, atol=rtol * scale)
        np.testing.assert_allclose(one.noise, other.noise, rtol=rtol, atol=0)
        np.testing.assert_array_equal(one.beam, other.beam)
        np.testing.assert_array_equal(one.bandpass.nu, other.bandpass.nu)
        np.testing.assert_array_equal(one.bandpass.quadrature, other.bandpass.quadrature)
        assert (one.correlated is None) == (other.correlated is None)
        if one.correlated is not None:
            np.testing.assert_allclose(one.correlated, other.correlated, rtol=rtol)
        assert (one.leakage is None) == (other.leakage is None)
        if one.leakage is not None:
            np.testing.assert_allclose(one.leakage.maps, other.leakage.maps, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Maps at a common beam."""
    folder = tmp_path_factory.mktemp("round trip")
    written(settings_in(folder), folder / "sims")
    return folder


def test_simulated_maps_are_read_as_commands_simulate_them(folder):
    settings = load(folder / "x.toml")
    maps = load(folder / "x.toml", [f'common.maps = "{folder / "sims/sim_00000"}"'])
    own, read = inputs_of(settings), inputs_of(maps)
    assert_same_bands(own.bands, read.bands)
    assert own.truth == read.truth
    assert own.truth["synchrotron.beta_syn"] == 3.05
    assert own.truth["r"] == 0.0


@pytest.mark.parametrize("value", ["precision = 'single'", "stokes = 'IQU'", "unit = 'uK_CMB'"])
def test_what_files_hold_does_not_change_the_sky(folder, value, tmp_path):
    maps = written(folder / "x.toml", tmp_path, f"simulate.{value}")
    own = inputs_of(load(folder / "x.toml")).bands
    read = inputs_of(load(folder / "x.toml", [f'common.maps = "{maps}"'])).bands
    for name, band in own.items():
        # Single precision of maps, and of their transforms, is 1e-7 of the rms of the sky.
        atol = 1e-5 * float(band.maps.std())
        np.testing.assert_allclose(read[name].maps, band.maps, rtol=0, atol=atol)


def near(value, truth, sigma):
    assert abs(value - truth) < 3 * sigma, (value, truth, sigma)


TRUTH = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.05}


@pytest.mark.parametrize(
    "command", ["separate", *(pytest.param(n, marks=pytest.mark.slow) for n in ("fit", "compare"))]
)
def test_commands_find_the_truth_in_simulated_maps(folder, command, monkeypatch):
    out, maps = folder / command, folder / "sims/sim_00000"
    # With "compare" the model is the sky itself.
    more = ("--set", "truth = {}") if command == "compare" else ()
    if command == "compare":
        path = settings_in(folder, SETTINGS.replace("3.05", "3.1"))
        maps = written(path, folder / "sims of the model")
    arguments = (command, folder / "x.toml", "--maps", maps, "--out", out, *more)
    assert jaxsky(monkeypatch, *arguments) == 0
    if command == "compare":
        found = json.loads((out / "comparison.json").read_text())
        for band in found["pixels"].values():
            near(band["full"]["QU"]["slope"], 1.0, band["full"]["QU"]["error"])
    elif command == "fit":
        found = json.loads((out / "result.json").read_text())
        result = found["results"]["full"]["QU"]["gradient"]
        for i, name in enumerate(result["free"]):
            near(result["best_fit"][name], TRUTH[name], result["covariance"][i][i] ** 0.5)
            assert found["truth"][name] == TRUTH[name]
    else:
        found = json.loads((out / "result.json").read_text())
        for name, value in found["parameters"].items():
            near(value["best_fit"], TRUTH[name], value["sigma"])
            assert value["truth"] == TRUTH[name]
        near(found["r"]["best_fit"], 0.0, found["r"]["sigma"])
        assert found["r"]["truth"] == 0.0


def test_maps_of_other_settings_are_told(folder, monkeypatch, capsys):
    path, maps = settings_in(folder), folder / "sims/sim_00000"
    words = "were simulated with other settings in the tables {};"
    for value, table in [("seed=7", None), ("bands.0.fwhm=50", "bands"), ("cmb.r=0.1", "cmb")]:
        warned = other_sky(load(path, [value, f'common.maps = "{maps}"']))
        assert (words.format(table) in warned[0]) if table else not warned
    fewer = 'bands.0.channels=["40", "402"]', 'fit.stokes=["Q"]', "fit.likelihood=diagonal"
    options = [word for value in fewer for word in ("--set", value)]
    arguments = ("--maps", maps, *options, "--out", folder / "told")
    assert jaxsky(monkeypatch, "fit", path, *arguments) == 0
    assert words.format("bands") in " ".join(capsys.readouterr().err.split())


def test_what_a_band_sees_does_not_depend_on_the_others(folder):
    settings = load(folder / "x.toml")
    alone = load(folder / "x.toml", ['bands.0.channels = ["140"]'])
    for name in ("40", "140"):
        assert (name in inputs_of(alone).bands) == (name == "140")
    np.testing.assert_allclose(
        inputs_of(alone).bands["140"].maps, inputs_of(settings).bands["140"].maps, atol=1e-9
    )


@pytest.fixture
def files(tmp_path):
    """Bands with a table of a bandpass, a window and noise in pixels; one leaks."""
    ell = np.arange(2 * NSIDE + 1)
    beam = np.asarray(gaussian_beam(350.0, 2 * NSIDE)) * (1 + 1e-3 * np.sin(ell))
    np.savetxt(tmp_path / "beam.txt", np.stack([ell, beam / beam[0]], axis=1))
    nu = np.linspace(95.0, 105.0, 21)
    np.savetxt(
        tmp_path / "band.txt", np.stack([nu, 1 + 0.1 * np.cos(nu)], axis=1), header="GHz weight"
    )
    level = np.linspace(1.0, 4.0, NPIX)
    noise = np.stack([level, 0.3 * level, 2 * level])
    write_maps(tmp_path / "noise.fits", noise, names=["QQ", "QU", "UU"], unit="uK_RJ^2")
    start, rest = SETTINGS.split("[[bands]]")[0], SETTINGS.split('"402"]')[1]
    text = (start + BANDS + rest).replace("fwhm = 400.0", "")
    return settings_in(tmp_path, text)


def test_tables_of_bands_are_read_back(files, tmp_path):
    settings, maps = load(files), written(files, tmp_path / "sims")
    own, read = inputs_of(settings), inputs_of(load(files, [f'common.maps = "{maps}"']))
    assert_same_bands(own.bands, read.bands)
    assert np.ndim(own.bands["70"].beam) == 1
    assert float(own.bands["own"].noise[0, 1, 5]) > 0
    assert own.bands["70"].leakage is not None


def test_a_band_may_be_a_simulated_file(files, tmp_path):
    path = written(files, tmp_path / "sims") / "own.fits"
    band = f'\n[[bands]]\nname = "x"\nfile = "{path}"\nfields = ["Q", "U"]\n'
    text = SETTINGS.split("[[bands]]")[0] + band + SETTINGS.split('"402"]')[1]
    inputs = inputs_of(load(settings_in(tmp_path, text)))
    assert inputs.bands["x"].beam == 330.0
    assert inputs.truth["dust.beta_dust"] == 1.53
    with pytest.raises(SettingsError, match=r"bands.x.fwhm: 60 arcmin, but .*330 arcmin"):
        inputs_of(load(settings_in(tmp_path, text), ["bands.0.fwhm = 60.0"]))
    with pytest.raises(SettingsError, match=r"bands.x.beam: beam.txt, but .*330 arcmin"):
        inputs_of(load(settings_in(tmp_path, text), ["bands.0.beam = 'beam.txt'"]))
    table = settings_in(tmp_path, text.replace("own.fits", "70.fits"))
    np.testing.assert_array_equal(
        inputs_of(load(table, ["bands.0.beam = 'beam.txt'"])).bands["x"].beam,
        inputs_of(load(table)).bands["x"].beam,
    )
    with pytest.raises(SettingsError, match=r"bands.x.fwhm: 60 arcmin, but .*another table"):
        inputs_of(load(table, ["bands.0.fwhm = 60.0"]))


def test_smoothed_noise_of_pixels_is_not_guessed(files, tmp_path):
    values = ["simulate.fwhm = 400.0", 'bands.1 = { name = "70", instrument = "planck" }']
    settings = load(files, values)
    out = tmp_path / "sims"
    assert list(run(settings, simulation_inputs(settings), out, range(1)))
    with pytest.raises(SettingsError, match=r"bands.own.noise: .*smoothed"):
        inputs_of(load(files, [*values, f'common.maps = "{out / "sim_00000"}"']))


def test_maps_of_others_are_refused(files, tmp_path):
    (tmp_path / "maps").mkdir()
    maps = np.ones((2, NPIX))
    write_maps(tmp_path / "maps/44.fits", maps, names=["Q", "U"], unit="uK_RJ")
    with pytest.raises(SettingsError, match=r"common.maps: .*44.fits was not written by"):
        inputs_of(load(files, ['common.maps = "maps"']))
    missing = r"common.maps: .*none/44.fits: no such file, nor folder"
    with pytest.raises(SettingsError, match=missing):
        inputs_of(load(files, ['common.maps = "none"']))


def test_an_instrument_is_a_list_of_bands(files, tmp_path):
    own_44 = 'name = "44"\nbandpass = { center = 44.1, width = 10.72 }'
    own_70 = "bandpass = { center = 70.4, width = 14.9 }\nnoise = { level = 300.0 }"
    bands = BANDS.replace('instrument = "planck"\nchannels = ["44"]', own_44)
    (tmp_path / "mine.toml").write_text(bands.replace('instrument = "planck"', own_70))
    entry = '\n[[bands]]\ninstrument = "mine.toml"\n'
    start, rest = SETTINGS.split("[[bands]]")[0], SETTINGS.split('"402"]')[1]
    text = (start + entry + rest).replace("fwhm = 400.0", "")
    own, same = inputs_of(load(files)), inputs_of(load(settings_in(tmp_path, text)))
    assert_same_bands(own.bands, same.bands)
    with pytest.raises(SettingsError, match=r"bands.0.instrument: .*no channel '9'.*44, 70, own"):
        load(settings_in(tmp_path, text), ['bands.0.channels = ["9"]'])
    with pytest.raises(SettingsError, match=r"bands.0.instrument: Unknown instrument 'acme'"):
        load(settings_in(tmp_path, text), ['bands.0.instrument = "acme"'])


def test_embedded_and_file_components_mix(tmp_path):
    rng = np.random.default_rng(2)
    maps = rng.normal(size=(2, NPIX))
    write_maps(tmp_path / "dust.fits", maps, names=["Q", "U"], unit="uK_RJ")
    write_maps(tmp_path / "ame.fits", np.abs(maps[:1]), names=["I"], unit="uK_RJ")
    text = SETTINGS + (
        '[sky.dust]\nlaw = "dust"\nfile = "dust.fits"\nnu_ref = 353.0\n'
        '[sky.synchrotron]\nparameters = { beta_syn = 2.9 }\n'
        '[sky.ame]\nlaw = "ame"\nfile = "ame.fits"\nangles = "dust"\nnu_ref = 22.8\n'
    )  # fmt: skip
    inputs = inputs_of(load(settings_in(tmp_path, text)))
    assert list(inputs.templates) == ["dust", "synchrotron", "ame"]
    np.testing.assert_allclose(inputs.templates["dust"].component.amplitude, maps)
    assert float(inputs.templates["synchrotron"].component.beta_syn) == 2.9
    assert inputs.truth["synchrotron.beta_syn"] == 3.05  # as the table truth says
    fewer = inputs_of(load(tmp_path / "x.toml", ['common.components = ["dust"]']))
    assert list(fewer.templates) == ["dust"]
    np.testing.assert_array_equal(fewer.bands["40"].maps, inputs.bands["40"].maps)
    with pytest.raises(SettingsError, match=r"sky.x: file is missing"):
        inputs_of(load(tmp_path / "x.toml", ['sky.x.law = "dust"']))


def test_lensing_and_cosmology_are_those_of_the_settings(tmp_path):
    path = settings_in(tmp_path)
    plain, half = cmb_spectra(load(path), 30), cmb_spectra(load(path, ["cmb.A_lens = 0.5"]), 30)
    np.testing.assert_allclose(half[2], 0.5 * plain[2])
    np.testing.assert_array_equal(half[[0, 1, 3]], plain[[0, 1, 3]])
    other = cmb_spectra(load(path, ["cmb.cosmology = { H0 = 70.0, As = 4e-9 }"]), 30)
    assert other[1, 5] > 1.5 * plain[1, 5]


def test_truth_about_what_is_not_simulated_is_left_out(tmp_path):
    path = settings_in(tmp_path)
    for include in (["dust", "noise"], ["cmb"]):
        setup = simulation_inputs(load(path, [f"simulate.include = {include}"]))
        assert not any(name.startswith("synchrotron") for name in setup.truth)
    with pytest.raises(SettingsError, match=r"truth: there is no component 'ame'"):
        simulation_inputs(load(path, ['truth."ame.m60" = 1.0']))


def test_maps_without_noise_have_no_errors(folder):
    settings = load(settings_in(folder), ["simulate.include=['dust', 'synchrotron']"])
    raises(SettingsError, r"simulate.include: leaves out the noise", inputs_of, settings)


def test_only_is_of_what_is_included(tmp_path, monkeypatch, mistake):
    path, out = settings_in(tmp_path), tmp_path / "sims"
    include = ("--set", 'simulate.include = ["dust", "noise"]')
    arguments = ("simulate", path, "--out", out, *include, "--only")
    assert jaxsky(monkeypatch, *arguments, "signal") == 0
    log = json.loads((out / "simulation.json").read_text())
    assert log["settings"]["simulate"]["include"] == ["dust"]
    assert "--only cmb: nothing is left" in mistake(*arguments, "cmb")


def test_intensity_alone_has_no_part_in_maps_of_q_and_u(tmp_path):
    rng = np.random.default_rng(3)
    write_maps(tmp_path / "ff.fits", rng.random((1, NPIX)), names=["I"], unit="uK_RJ")
    path = settings_in(
        tmp_path, SETTINGS + '[sky.ff]\nlaw = "free_free"\nfile = "ff.fits"\nnu_ref = 30.0\n'
    )
    fewer = 'common.components = ["dust", "synchrotron"]'
    raises(SettingsError, r"sky.ff: FreeFree is not polarized.*components", inputs_of, load(path))
    own = inputs_of(load(path, [fewer]))
    (tmp_path / "without").mkdir()
    without = inputs_of(load(settings_in(tmp_path / "without")))
    assert_same_bands(own.bands, without.bands)
    with pytest.raises(SettingsError, match=r"sky.ff: FreeFree is not polarized.*simulate.stokes"):
        simulation_inputs(load(path))


def test_a_cmb_above_the_noise_is_no_misfit(folder):
    prepared = common_maps(
        inputs_of(load(folder / "x.toml", ['bands.0.channels = ["140"]'])), 16, 480
    )
    used = np.arange(NPIX) % 2 == 0
    _, expected, _ = _look(prepared, {}, used, "U")
    squares = []
    for key in jax.random.split(jax.random.key(0), 50):
        fluctuations = prepared.fluctuations
        maps = fluctuations.noise_realisation(key) + fluctuations.cmb_realisation(key)
        squares.append(np.mean((maps / prepared.sigma)[0, 1, used] ** 2))
    assert expected > 10
    np.testing.assert_allclose(expected, np.mean(squares), rtol=0.15)
    assert misfit(50.0 * expected * 1000, 1000, expected) is None
    assert misfit(150.0 * expected * 1000, 1000, expected) is not None


def test_tables_of_another_size_than_the_map_are_refused(tmp_path):
    observed = Observed(Bandpass.delta(100.0), 30.0, np.ones((2, 2, 48)))
    options = {"names": ["Q", "U"], "unit": "uK_RJ", "tables": observed_tables(observed)}
    write_maps(tmp_path / "a.fits", np.zeros((2, 192)), **options)
    with pytest.raises(InputError, match="its table NOISE has 48 pixels, its map 192"):
        read_observed(tmp_path / "a.fits")
