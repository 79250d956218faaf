"""Intensity: alone and with polarization, in simulations, fits, separations and comparisons."""

import json

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import commands
from fits.commands.run import DEFAULTS
from fits.common import common_maps
from fits.fluctuations import Fluctuations, MapNoise
from fits.inputs import inputs_of
from fits.optimize import best_fit
from fits.separated_data import modelled_laws
from fits.template_likelihood import PixelLikelihood, likelihood
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe, set_parameters
from jaxsky.cmb import camb_spectra, field_spectra
from jaxsky.components.laws import FreeFree
from jaxsky.experiment import simulation_inputs
from jaxsky.harmonics import Preparation, expand, synthesis
from jaxsky.io import read_maps, write_maps
from jaxsky.noise import cholesky, stokes_noise
from jaxsky.observation import load_instrument
from jaxsky.settings import BandTable, SettingsError, load
from settings_fuzz import written
from systems import random_maps, small_experiment

STOKES = ("I", "IQU")
FREE = {
    "dust.beta_dust": {"start": 1.6, "uniform": [0.5, 2.5]},
    "synchrotron.beta_syn": {"start": 3.0, "uniform": [2.0, 4.5]},
}
TRUTH = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.1}


def experiment(stokes, channels=("30", "44", "70", "353"), **tables):
    common = {"nside": 16, "fwhm": 480.0, "stokes": stokes}
    simulate = {"stokes": "IQU", "nside": 32, "fwhm": 300.0, "precision": "double", "sheet": False}
    given = {"common": common, "simulate": simulate, "free": FREE} | tables
    return small_experiment(channels, nside=32, **given)


def test_instruments_know_the_noise_of_intensity_and_of_polarization():
    """Simulated noise has the levels of Planck's table."""
    settings = load(DEFAULTS / "fit.toml", ["common.stokes=IQU", "sky.embedded.nside=16",
        'bands.0.channels=["30"]', "simulate.nside=16"])  # fmt: skip
    level = settings.bands[0].noise.level
    planck = load_instrument("planck", ["30"])
    to_RJ = planck["30"].band.conversion("uK_CMB", "uK_RJ")
    wanted = [float(planck.noise_I["30"]), float(planck["30"].noise)]
    assert np.array(level) * to_RJ == pytest.approx(wanted)
    assert level[0] < level[1]
    noise = simulation_inputs(settings, written=False).observation.channels["30"].noise
    np.testing.assert_allclose(noise, [wanted[0], wanted[1], wanted[1]], rtol=1e-9)


def test_noise_of_each_stokes_parameter_is_the_same_with_and_without_others():
    key = jax.random.key(1)
    alone, polarized, whole = (stokes_noise(key, n, 48, np.dtype(float)) for n in (1, 2, 3))
    np.testing.assert_array_equal(whole, jnp.concatenate([alone, polarized]))


def test_covariance_with_temperature_and_polarization_is_that_of_the_modes():
    """Of products with the CMB, whose T and E are correlated, from an explicit matrix."""
    nside, lmax = 4, 8
    npix, spectra = healpy.nside2npix(nside), jnp.asarray(camb_spectra(lmax))
    how = Preparation(jnp.ones(lmax + 1), nside, nside)
    noise = MapNoise(how, 3.0, None, "IQU")
    window = jnp.linspace(1.0, 0.5, lmax + 1)[None]
    model = Fluctuations((noise,), spectra, window, jnp.ones(1), ("a",))
    rows = jnp.asarray(np.random.default_rng(0).normal(size=(1, 5, 3, npix)))
    root = cholesky(field_spectra(spectra)) * window[0]

    def maps(white):
        alm = [sum(expand(root[i, j]) * white[j] for j in range(i + 1)) for i in range(3)]
        return synthesis(jnp.stack(alm), nside)

    basis = jax.jacobian(maps)(jnp.zeros((3, (lmax + 1) ** 2)))
    products = np.einsum("rsp,spim->rim", rows[0], basis).reshape(5, -1)
    quiet = Fluctuations((noise,), None, None, jnp.ones(1), ("a",))
    found = model.covariance(rows) - quiet.covariance(rows)
    np.testing.assert_allclose(found, products @ products.T, rtol=1e-9, atol=1e-9 * found.max())


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Settings and maps I, Q, U of `jaxsky simulate`."""
    folder = tmp_path_factory.mktemp("simulated")
    path = written(folder / "experiment.toml", experiment("IQU"))
    with pytest.MonkeyPatch.context() as patch:
        assert commands.jaxsky(patch, "simulate", path, "--out", folder / "sims") == 0
    return path, folder / "sims" / "sim_00000"


def found_by(monkeypatch, command, path, out, *options):
    """The results of a command."""
    assert commands.jaxsky(monkeypatch, command, path, "--out", out, *options) == 0
    return json.loads(next(out.glob("*[!g].json")).read_text())


@pytest.mark.parametrize("stokes", STOKES)
def test_fits_find_the_truth_in_simulated_maps(stokes, simulated, tmp_path, monkeypatch):
    path, maps = simulated
    options = (
        "--maps",
        maps,
        "--set",
        f"common.stokes={stokes}",
        "--set",
        'fit.methods=["gradient"]',
    )
    found = found_by(monkeypatch, "fit", path, tmp_path / "out", *options)
    for choices in found["results"].values():
        assert set(choices) == {"I": {"I"}, "IQU": {"I", "QU", "IQU"}}[stokes]
        for methods in choices.values():
            found = methods["gradient"]
            sigmas = np.sqrt(np.diag(found["covariance"]))
            for name, sigma in zip(found["free"], sigmas, strict=True):
                assert abs(found["best_fit"][name] - TRUTH[name]) < 3 * sigma


def test_intensity_has_the_same_likelihood_with_and_without_polarization():
    likes = {}
    for stokes in STOKES:
        settings = load(DEFAULTS / "fit.toml", ['common.nside=16', "common.fwhm=300.0",
            "sky.embedded.nside=32", f"common.stokes={stokes}"])  # fmt: skip
        prepared = common_maps(inputs_of(settings), 16, 300.0)
        likes[stokes] = prepared.likelihood(TRUTH, stokes="I")
    alone, among = likes.values()
    for params in (TRUTH, {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}):
        a, b = (np.sum(np.square(like.residuals(params))) for like in (alone, among))
        assert a == pytest.approx(b, rel=1e-7)


@pytest.mark.parametrize(
    ("stokes", "domain"),
    [
        ("I", "pixel"),
        pytest.param("I", "harmonic", marks=pytest.mark.slow),
        pytest.param("IQU", "pixel", marks=pytest.mark.slow),
        pytest.param("IQU", "harmonic", marks=pytest.mark.slow),
    ],
)
def test_separations_find_the_truth(stokes, domain, tmp_path, monkeypatch):
    separate = {"domain": domain, "region": "full" if domain == "harmonic" else "outside"}
    separate |= {"nsims": 20, "sampler": "none", "lmax": 20, "width": 6}
    channels = ("30", "44", "70", "100", "143", "353")
    path = written(tmp_path / "x.toml", experiment(stokes, channels, separate=separate))
    found = found_by(monkeypatch, "separate", path, tmp_path / "out")
    for name, truth in TRUTH.items():
        one = found["parameters"][name]
        assert abs(one["best_fit"] - truth) < 4 * one["sigma"]
    assert ("r" in found) == ("BB" in found) == (stokes == "IQU")
    assert (tmp_path / "out" / "r.png").exists() == (stokes == "IQU")
    maps = read_maps(tmp_path / "out" / "components.fits", fields=[f"CMB_{s}" for s in stokes],
        stokes=stokes, missing=[])  # fmt: skip
    assert np.isfinite(maps.maps[:, maps.mask]).all()


@pytest.mark.parametrize("stokes", ["I", pytest.param("IQU", marks=pytest.mark.slow)])
def test_comparisons_have_spectra_of_what_is_seen(stokes, tmp_path, monkeypatch):
    compare = {"nsims": 20, "lmax": 20, "width": 4, "regions": ["full"]}
    path = written(tmp_path / "x.toml", experiment(stokes, ("44", "353"), compare=compare))
    found = found_by(monkeypatch, "compare", path, tmp_path / "out")
    choices = found["pixels"]["353"]["full"]
    assert list(choices) == ["I"] if stokes == "I" else ["I", "Q", "U", "QU"]
    for s in choices.values():
        assert abs(s["slope"] - 1) < 4 * s["error"]
    assert np.shape(found["spectra"]["353"]["pte"]) == (len(stokes),)
    assert {p.name for p in (tmp_path / "out").glob("maps_*")} == {f"maps_{s}.png" for s in stokes}


def test_templates_have_a_reference_for_intensity_of_their_own(tmp_path):
    """The sky of files with two frequencies is that of the same maps brought to one."""
    npix = healpy.nside2npix(16)
    dust, synchrotron, free_free = (jnp.abs(random_maps(i, 3, npix)) for i in (1, 2, 3))
    for name, maps, names in (("dust", dust, "IQU"), ("ff", free_free[:1], "I"),
        ("synchrotron", synchrotron, "IQU")):  # fmt: skip
        write_maps(tmp_path / f"{name}.fits", np.asarray(maps), names=list(names), unit="uK_RJ")
    sky = {
        "dust": {"law": "dust", "file": "dust.fits", "nu_ref": [545.0, 353.0]},
        "synchrotron": {"law": "synchrotron", "file": "synchrotron.fits", "nu_ref": [0.408, 23.0]},
        "ff": {"law": "free_free", "file": "ff.fits", "nu_ref": 40.0},
    }
    expected = {
        "dust": Dust(dust, nu_ref=353.0, nu_ref_I=545.0),
        "synchrotron": Synchrotron(synchrotron, nu_ref=23.0, nu_ref_I=0.408),
        "ff": FreeFree(jnp.pad(free_free[:1], ((0, 2), (0, 0))), nu_ref=40.0),
    }
    seen = observe(Sky(expected), [Bandpass.delta(30.0)])[0]
    alone = {"dust": Dust(dust[:1], nu_ref=545.0), "ff": FreeFree(free_free[:1], nu_ref=40.0),
        "synchrotron": Synchrotron(synchrotron[:1], nu_ref=0.408)}  # fmt: skip
    np.testing.assert_allclose(observe(Sky(alone), [Bandpass.delta(30.0)])[0, 0], seen[0], 1e-12)
    for stokes in ("I", "IQU"):
        settings = experiment(stokes, ("30", "44", "353")) | {"sky": sky, "data_dir": str(tmp_path)}
        settings["common"]["fwhm"] = settings["simulate"]["fwhm"] = 0.0
        inputs = inputs_of(load(written(tmp_path / "x.toml", settings), ["simulate.nside=16",
            "simulate.fwhm=300.0"]))  # fmt: skip
        own = Sky({name: one.component for name, one in inputs.templates.items()})
        np.testing.assert_allclose(
            observe(own, [Bandpass.delta(30.0)])[0], seen[: len(stokes)], 1e-6
        )


@pytest.mark.parametrize(("stokes", "expected"), [("I", 545.0), ("QU", 353.0), ("IQU", 353.0)])
def test_separations_take_the_reference_of_what_they_separate(stokes, expected, tmp_path):
    sky = {"dust": {"law": "dust", "nu_ref": [545.0, 353.0]}}
    settings = experiment(stokes) | {"sky": sky, "free": {}}
    laws, _ = modelled_laws(load(written(tmp_path / "x.toml", settings)))
    assert float(laws["dust"].nu_ref) == expected
    assert laws["dust"].nu_ref_I is None


@pytest.mark.parametrize("stokes", ["I", "QU", "IQU"])
def test_leakage_into_polarization_is_no_matter_of_intensity(stokes, tmp_path):
    name = "LFI_SkyMap_044_1024_R3.00_full.fits"
    band = {"name": "44", "bandpass": {"center": 44.0}, "fwhm": 27.0, "file": name}
    settings = experiment(stokes) | {"bands": [band | {"noise": {"level": 240.0}}]}
    assert bool(load(written(tmp_path / "x.toml", settings)).leaks()) == (stokes != "I")


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("stokes", ["I", "QU", "IQU"])
def test_fits_find_laws_whose_references_differ(stokes, varying):
    """In data without noise, on inner products and pixel by pixel."""
    npix = 192
    sky = Sky(
        {
            "dust": Dust(random_maps(1, 3, npix), nu_ref=353.0, nu_ref_I=545.0,
                T_dust=jnp.linspace(18.0, 22.0, npix) if varying else 19.0),
            "synchrotron": Synchrotron(random_maps(2, 3, npix), nu_ref=23.0, nu_ref_I=30.0),
        }
    )  # fmt: skip
    bands = [Bandpass.delta(20.0), Bandpass.top_hat(44.0, 10.0), Bandpass.top_hat(353.0, 60.0)]
    data = observe(set_parameters(sky, TRUTH), bands)
    start = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}
    like = likelihood(sky, bands, data, 0.01, start, stokes=stokes)
    assert isinstance(like, PixelLikelihood) == varying
    assert best_fit(like).best_fit == pytest.approx(TRUTH, abs=1e-9)


def test_bands_without_polarization(tmp_path, monkeypatch, capsys):
    """All bands of Planck are simulated and fitted in I, and those with polarization in Q and U."""
    settings = experiment("I", bands=[{"instrument": "planck"}]) | {
        "fit": {"methods": ["gradient"]}
    }
    path = written(tmp_path / "x.toml", settings)
    left = "Left out, as they have no polarization: 545, 857."
    assert len(load(path).bands_of("I")) == 9
    assert [b.name for b in load(path).bands_of("QU")] == ["30", "44", "70", "100", "143", "217",
        "353"]  # fmt: skip
    errors = {}
    for stokes in ("I", "QU"):
        option = "--set", f"common.stokes={stokes}"
        found = found_by(monkeypatch, "fit", path, tmp_path / stokes, *option)
        assert (left in found["warnings"]) == (stokes == "QU")
        one = found["results"]["full"][stokes]["gradient"]
        sigmas = np.sqrt(np.diag(one["covariance"]))
        errors[stokes] = dict(zip(one["free"], sigmas, strict=True))
        for name, sigma in errors[stokes].items():
            assert abs(one["best_fit"][name] - TRUTH[name]) < 4 * sigma
    inputs = inputs_of(load(path))
    noise = inputs.bands["545"].noise
    assert inputs.bands["545"].correlated is not None or noise == pytest.approx(4.79)


@pytest.mark.parametrize("stokes", ["QU", "IQU"])
def test_no_band_has_polarization(stokes, tmp_path):
    settings = load(written(tmp_path / "x.toml", experiment(stokes, ("545", "857"))))
    with pytest.raises(SettingsError, match=r"^bands: 545 and 857 have no polarization"):
        inputs_of(settings)
    with pytest.raises(SettingsError, match=r"^bands: 545 and 857 have no polarization"):
        simulation_inputs(settings)  # of I, Q, U
    own = {"name": "x", "bandpass": {"center": 545.0}, "fwhm": 5.0}
    for noise, polarized in (([3.0], False), (3.0, True), ([3.0, 4.0], True)):
        band = BandTable.model_validate(own | {"noise": {"level": noise}})
        assert band.polarized == polarized
        assert band.noise.level_of("I") == 3.0


@pytest.mark.parametrize(
    ("command", "keys", "words"),
    [
        ("fit", ['fit.stokes=["I"]'], "fit.stokes: 'I' is none of Q, U, QU"),
        ("fit", ["common.stokes=I", 'fit.stokes=["QU"]'], "fit.stokes: 'QU' is none of I"),
        ("fit", ["common.stokes=V"], "common.stokes"),
        ("forecast", ["common.stokes=I"], "jaxsky forecast takes QU or IQU, not I"),
        ("paper", ["common.stokes=IQU"], "common.stokes: jaxsky paper takes QU, not IQU"),
        (
            "compare",
            ["common.stokes=I", 'compare.patches="353"'],
            "compare.patches: takes Q and U alone",
        ),
    ],
)
def test_choices_that_do_not_fit_are_refused(command, keys, words, tmp_path, monkeypatch, capsys):
    path = written(tmp_path / "x.toml", experiment("QU"))
    options = [word for key in keys for word in ("--set", key)]
    assert commands.jaxsky(monkeypatch, command, path, "--out", tmp_path / "out", *options) == 2
    assert words in commands.said(capsys)
