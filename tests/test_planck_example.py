"""The analysis of Planck's 44 and 70 GHz maps: its traps, the noise of templates, large maps."""

from pathlib import Path

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from commands import experiment
from fits import inputs as fit_inputs
from fits.commands.fit import _table, fit_numbers, fit_warnings
from fits.commands.run import DEFAULTS
from fits.common import Fluctuations, MapNoise, common_maps
from fits.inputs import Band, Inputs, TemplateNoise, level_spectrum, read_band
from fits.plots import label
from fits.posterior import chi2
from fits.products import gram, one_stokes_each
from fits.spectral_index import fit_regions, known_truth
from jaxsky import Bandpass, Dust, Sky, Synchrotron, inputs, observe
from jaxsky.harmonics import Preparation, alm_ell, gaussian_beam, resample, synthesis
from jaxsky.inputs import Template
from jaxsky.io import write_maps
from jaxsky.noise import draw, pixel_covariance, uniform_covariance
from jaxsky.settings import BandTable, Experiment, SettingsError, load
from refusals import cases, raises

NSIDE = 8
NPIX = healpy.nside2npix(NSIDE)
START = {"dust.beta_dust": 1.5, "synchrotron.beta_syn": 3.0}
TRUTH_OF_BANDS = {"angle.44": 0.0, "gain.30": 1.0}
TRUTH = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.1}  # the laws' defaults
EXAMPLES = Path(__file__).parents[1] / "examples"
SHIPPED = EXAMPLES / "planck_44_70.toml"


def test_the_example_is_what_init_writes():
    assert SHIPPED.read_text() == (DEFAULTS / "planck-44-70.toml").read_text()
    settings = load(SHIPPED)
    assert settings.fit.regions == ["strip", "full"]
    assert settings.fit.methods == ["grid", "gradient", "mcmc"]
    assert settings.fixed == {"dust.T_dust": 21.0}
    for band, channel in zip(settings.bands, ("044", "070"), strict=True):
        assert band.file == f"LFI_SkyMap_{channel}-BPassCorrected_1024_R3.00_full.fits"
        assert (band.bandpass.file, band.bandpass.band) == ("LFI_RIMO_R3.31.fits", channel)
        assert band.noise.covariance.fields == ["QQ_COV", "QU_COV", "UU_COV"]


@pytest.mark.parametrize(
    "path", [*DEFAULTS.glob("*.toml"), *EXAMPLES.glob("*.toml")], ids=lambda path: path.stem
)
def test_no_example_has_noise_in_a_unit_of_its_own_or_leakage(path):
    settings = load(path)
    assert len(settings.bands) >= 2
    assert all(band.noise.rms is None for band in settings.bands)
    assert settings.leaks() == []


@pytest.mark.parametrize(
    ("name", "corrected", "correction"), cases("planck_example/maps_with_leakage")
)
def test_maps_that_hold_leakage_are_known_by_name(name, corrected, correction):
    (warning,) = Experiment(bands=[band_of(name)]).leaks()
    for word in ("bands.x", Path(name).name, corrected, correction):
        assert word in warning


@pytest.mark.parametrize("name", cases("planck_example/maps_without_leakage"))
def test_other_maps_are_not(name):
    assert Experiment(bands=[band_of(name)]).leaks() == []


def test_a_leakage_that_is_subtracted_is_no_leak():
    band = band_of(
        "LFI_SkyMap_044_1024_R3.00_full.fits",
        leakage={"file": "LFI_CorrMap_044-BPassCorr_1024_R3.00_full.fits"},
    )
    assert Experiment(bands=[band]).leaks() == []


def band_of(file: str, **more) -> BandTable:
    noise = more.pop("noise", {"rms": 1.0})
    return BandTable(name="x", file=file, bandpass={"center": 44.0}, noise=noise, **more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A map with an rms of 1e-4 K_CMB, and columns about its noise."""
    folder = tmp_path_factory.mktemp("noise")
    rng = np.random.default_rng(1)
    unit = np.ones(NPIX)
    columns = {
        "Q_STOKES": 1e-4 * rng.normal(size=NPIX),
        "U_STOKES": 1e-4 * rng.normal(size=NPIX),
        "RMS": 5e-5 * unit,
        "RMS_BIG": 1e-2 * unit,
        "QQ_COV": 2.5e-9 * unit,
        "QU_COV": 0 * unit,
        "UU_COV": 2.5e-9 * unit,
        "UU_BIG": 2.5e-6 * unit,
        "HITS": 4 * unit,
        "QQ": 4 * unit,
        "QU": 0 * unit,
        "UU": 4 * unit,
    }
    units = ["K_CMB"] * 4 + ["K_CMB^2"] * 4 + [""] * 4
    write_maps(folder / "map.fits", list(columns.values()), names=list(columns), unit=units)
    return folder


@pytest.mark.parametrize(("noise", "wrong"), cases("planck_example/noise_far_from_the_rms"))
def test_noise_far_from_the_rms_of_its_map_is_refused(folder, noise, wrong):
    fields = ["Q_STOKES", "U_STOKES"]
    assert read_band(folder, band_of("map.fits", fields=fields, noise=noise)).used.all()
    with pytest.raises(SettingsError) as refused:
        read_band(folder, band_of("map.fits", fields=fields, noise=wrong))
    sentence = str(refused.value)
    assert sentence.startswith("bands.x.noise: the noise of a pixel is ")
    assert sentence.count("K_CMB (rms)") == 1
    assert "of the map in the same pixels is 0.000101 K_CMB" in sentence
    meant = band_of("map.fits", fields=fields, noise=wrong | {"plausible": True})
    assert read_band(folder, meant).used.all()


def sky_of(seed: int, scale: float = 100.0) -> Sky:
    rng = np.random.default_rng(seed)
    ell = alm_ell(2 * NSIDE)

    def maps():
        alm = scale * rng.normal(size=(2, ell.size)) / (1 + ell)
        return synthesis(jnp.asarray(np.where(ell > 1, alm, 0)), NSIDE)

    return Sky({"dust": Dust(maps()), "synchrotron": Synchrotron(maps())})


def settings_of(**more) -> Experiment:
    free = {name: {"start": value} for name, value in START.items()}
    fit = {"methods": ["gradient"], "stokes": ["QU"]}
    return Experiment(common={"nside": NSIDE, "fwhm": 0.0}, **{"free": free, "fit": fit} | more)


def inputs_of(sky: Sky, seen: dict[str, tuple[float, float]], noise=(), templates=None) -> Inputs:
    """Bands by name with their frequency and noise, of a sky whose templates may be others."""
    used = np.ones(NPIX, bool)
    bands = {}
    for name, (nu, level) in seen.items():
        covariance = uniform_covariance(level, NSIDE)
        maps = observe(sky, [Bandpass.delta(nu)])[0] + draw(jax.random.key(int(nu)), covariance)
        bands[name] = Band(maps, used, Bandpass.delta(nu), 0.0, covariance)
    return Inputs(templates_of(templates or sky.components), bands, None, None, "", dict(noise))


def templates_of(components) -> dict[str, Template]:
    return {n: Template(c, 0.0, np.ones(NPIX, bool)) for n, c in components.items()}


@pytest.mark.slow
def test_a_band_without_weight_is_named_and_not_counted():
    inside = {"all": np.ones(NPIX, bool)}
    bands = {"30": (30.0, 10.0), "353": (353.0, 10.0)}
    settings, sky = settings_of(), sky_of(2)
    (plain,) = fit_regions(settings, common_maps(inputs_of(sky, bands), NSIDE, 0.0), inside)
    made = inputs_of(sky, bands | {"70": (70.0, 1e12)})
    (fit,) = fit_regions(settings, common_maps(made, NSIDE, 0.0), inside)
    assert (plain.weightless, fit.weightless) == ((), ("70",))
    assert (fit.dof, fit.dof_amplitudes) == (plain.dof, plain.dof_amplitudes) == (3070, 6)
    said = " ".join(fit_warnings(made, settings, [fit]))
    assert "Band 70 carries no weight (all QU)" in said
    found = fit_numbers(settings, [fit], None)
    assert found["results"]["all"]["QU"]["gradient"]["bands_without_weight"] == ["70"]


TEMPLATE_NOISE = uniform_covariance(2000.0, NSIDE)


@pytest.mark.slow
@pytest.mark.parametrize("likelihood", ["exact", "diagonal"])
@pytest.mark.parametrize("shared", [{}, {"44": 0.7}])
def test_fits_with_noisy_templates_are_unbiased(likelihood, shared):
    """Pulls over noisy templates, whose noise moves a fit that does not know it."""
    sky, inside = sky_of(3), {"all": np.ones(NPIX, bool)}
    settings = settings_of(
        fit={"methods": ["gradient"], "stokes": ["QU"], "likelihood": likelihood}
    )
    bands = {"30": (30.0, 500.0), "44": (44.0, 500.0), "353": (353.0, 500.0)}
    given = TemplateNoise(TEMPLATE_NOISE, shared=shared)
    pulls = {"given": [], "not": []}
    for seed in range(100):
        key = jax.random.key(seed)
        observed, noise = noisy_bands(sky, bands, key)
        moved = draw(jax.random.fold_in(key, 99), TEMPLATE_NOISE)
        moved += sum(factor * noise[band] for band, factor in shared.items())
        templates = sky.components | {
            "synchrotron": Synchrotron(sky["synchrotron"].amplitude + moved)
        }
        for what, one in {"given": given, "not": TemplateNoise()}.items():
            noises = {"dust": TemplateNoise(), "synchrotron": one}
            made = observed._replace(templates=templates_of(templates), template_noise=noises)
            result = fitted(made, settings, inside).results["gradient"]
            pulls[what].append(
                [(result.best_fit[n] - TRUTH[n]) / result.sigma[n] for n in result.free]
            )
    means = {what: np.mean(rows, axis=0) for what, rows in pulls.items()}
    deviation = np.std(pulls["given"], axis=0)
    # Of N standard normal values the mean scatters by 1 / sqrt(N), the deviation by 1 / sqrt(2 N).
    assert np.all(np.abs(means["given"]) < 3 / np.sqrt(100)), means
    assert np.all(np.abs(deviation - 1) < 3 / np.sqrt(200)), deviation
    assert np.abs(means["not"]).max() > 1


def noisy_bands(sky, seen, key):
    """Bands, and their noise by name."""
    made = inputs_of(sky, seen)
    noise = {
        name: draw(jax.random.fold_in(key, i), band.noise)
        for i, (name, band) in enumerate(made.bands.items())
    }
    clean = observe(sky, [Bandpass.delta(nu) for nu, _ in seen.values()])
    bands = {
        name: band._replace(maps=maps + noise[name])
        for (name, band), maps in zip(made.bands.items(), clean, strict=True)
    }
    return made._replace(bands=bands), noise


def test_a_level_without_effect_changes_nothing():
    """The diagonal form of a template with noise is another sum of squares, and the same chi^2."""
    sky, bands = sky_of(5), {"30": (30.0, 10.0), "353": (353.0, 10.0)}
    params = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 2.9, "offset.30.Q": 3.0}
    made = common_maps(
        inputs_of(sky, bands, {"dust": TemplateNoise(1e-12 * TEMPLATE_NOISE)}), 8, 0.0
    )
    assert made.template_errors is not None
    for kind in ("exact", "diagonal"):
        for stokes in ("Q", "QU"):
            with_errors = made.likelihood(params, stokes=stokes, kind=kind)
            plain = made._replace(template_errors=None).likelihood(params, stokes=stokes, kind=kind)
            for shift in (0.0, 0.1):
                at = params | {"dust.beta_dust": 1.6 + shift}
                np.testing.assert_allclose(chi2(with_errors, at), chi2(plain, at), rtol=1e-7)
            assert with_errors.dof(3) == plain.dof(3)


def test_noise_of_templates_in_products_and_their_covariance():
    """Against the mean and scatter of the products over many realisations of the noise."""
    sky, bands, level = sky_of(6), {"30": (30.0, 10.0), "44": (44.0, 2000.0)}, TemplateNoise
    noises = {
        "dust": level(correlated=level_spectrum(3000.0, 600.0, 4 * NSIDE), shared={"44": 0.8}),
        "synchrotron": level(TEMPLATE_NOISE, shared={"44": -0.3}),
    }
    made = common_maps(inputs_of(sky, bands, noises), NSIDE, 0.0)
    errors, weights = made.template_errors, 1 / np.asarray(made.sigma) ** 2
    templates = jnp.stack([c.amplitude for c in sky.components.values()])
    rows = one_stokes_each(templates, weights)
    coefficients = np.random.default_rng(1).normal(size=(2, 4, 2))
    coefficients[:, :2], coefficients[:, 2:] = coefficients[:, :1], coefficients[:, 2:3]
    window = jnp.sqrt(noises["dust"].correlated)[alm_ell(4 * NSIDE)]

    @jax.jit
    def products(key):
        keys = jax.random.split(key, 4)
        data = jnp.stack([draw(k, b.noise) for k, b in zip(keys[:2], made_bands, strict=True)])
        own = jax.random.normal(keys[2], (2, window.size)) * window
        noise = jnp.stack([synthesis(own, NSIDE), draw(keys[3], TEMPLATE_NOISE)])
        noise = noise + jnp.array([0.8, -0.3])[:, None, None] * data[1]
        seen = data[:, None, :, :] - jnp.einsum("brk,ksp->brsp", coefficients, noise)
        return gram(data, noise, weights), jnp.einsum("brsp,brsp->br", rows, seen).ravel()

    made_bands = tuple(inputs_of(sky, bands).bands.values())
    both = [products(jax.random.key(i)) for i in range(400)]
    found = np.mean([mean for mean, _ in both], axis=0)[..., :-1, :-1]
    scatter = np.std([mean for mean, _ in both], axis=0)[..., :-1, :-1] / np.sqrt(400)
    expected = errors.mean_products(weights)[..., :-1, :-1]
    found[..., 0, 0] = expected[..., 0, 0]  # of the data with themselves: not of templates
    assert np.all(np.abs(found - expected) < 5 * scatter)
    covariance = made.fluctuations.covariance(rows) + errors.covariance(rows, coefficients)
    measured = np.cov(np.array([product for _, product in both]).T)
    scale = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose(
        measured / scale / scale[:, None],
        covariance / scale / scale[:, None],
        atol=5 / np.sqrt(400),
    )


def test_noise_that_is_all_of_a_template_is_refused():
    noisy = {"dust": TemplateNoise(1e6 * TEMPLATE_NOISE)}
    made = common_maps(
        inputs_of(sky_of(5), {"30": (30.0, 10.0), "353": (353.0, 10.0)}, noisy), 8, 0
    )
    for kind in ("exact", "diagonal"):
        with pytest.raises(ValueError, match="noise of the templates is all that they hold"):
            made.likelihood(START, kind=kind)


def fitted(made, settings, inside):
    (fit,) = fit_regions(settings, common_maps(made, NSIDE, 0.0), inside)
    return fit


def test_parameters_of_bands_are_fitted_and_named():
    sky, bands = sky_of(5), {"30": (30.0, 10.0), "44": (44.0, 10.0), "353": (353.0, 10.0)}
    inside = {"all": np.ones(NPIX, bool)}
    own = {"angle.44": {"gaussian": [0.0, 0.5]}, "gain.30": {"gaussian": [1.0, 0.01]}}
    free = own | {name: {"start": value} for name, value in START.items()}
    settings = settings_of(free=free, fit={"methods": ["gradient"], "stokes": ["Q"]})
    assert settings.start("fit") == settings.start("separate") == TRUTH_OF_BANDS | START
    made = inputs_of(sky, bands)._replace(truth=TRUTH)
    fit = fitted(made, settings, inside)
    truth, result = known_truth(made, [fit]), fit.results["gradient"]
    assert truth == TRUTH_OF_BANDS | TRUTH
    for name, value in truth.items():
        assert abs(result.best_fit[name] - value) < 4 * result.sigma[name]
    assert result.sigma["angle.44"] < 0.3  # so Q of this band has been compared with U
    assert _table([fit], truth).header[3:-1] == ("angle.44", "beta_dust", "gain.30", "beta_syn")
    assert [label(name) for name in own] == [r"\psi_{\rm 44}\ [^\circ]", r"g_{\rm 30}"]
    noisy = dict.fromkeys(("dust", "synchrotron"), TemplateNoise(TEMPLATE_NOISE / 1e4))
    words = "^free: Parameter 'angle.44' cannot be free where noise of templates is given"
    raises(SettingsError, words, fitted, inputs_of(sky, bands, noisy), settings, inside)
    del free["angle.44"]
    assert fitted(inputs_of(sky, bands, noisy), settings_of(free=free), inside).corrected


def test_a_level_is_seen_through_the_beam():
    """White noise of a level, smoothed by a template's beam, and its variance when prepared."""
    lmax, own, fwhm = 23, 300.0, 600.0
    preparation = Preparation.smoothing(16, own, NSIDE, fwhm, lmax)
    before = level_spectrum(1000.0, own, lmax)
    spectrum = before * preparation.window**2
    noises = (MapNoise(preparation, 0.0, spectrum),)
    noise = Fluctuations(noises, None, None, jnp.ones(1), ("x",))
    variance = noise.sigma() ** 2
    ell = alm_ell(48)
    level = np.radians(1000.0 / 60)
    maps = []
    for seed in range(20):
        alm = level * np.random.default_rng(seed).normal(size=(2, ell.size)) * (ell > 1)
        seen = synthesis(jnp.asarray(alm) * gaussian_beam(own, 48)[ell], 16)
        maps.append(preparation(seen))
    np.testing.assert_allclose(np.var(maps), variance[0, 0, 0], rtol=0.05)


@pytest.mark.slow
def test_templates_without_a_word_on_their_noise_are_warned_of():
    sky, settings, inside = sky_of(4), settings_of(), {"all": np.ones(NPIX, bool)}
    bands = {"30": (30.0, 10.0), "353": (353.0, 10.0)}
    made = inputs_of(sky, bands)
    fit = fitted(made, settings, inside)
    assert "noise of the templates (dust and synchrotron)" in fit_warnings(made, settings, [fit])[0]
    made = inputs_of(sky, bands, {"dust": TemplateNoise()})
    fit = fitted(made, settings, inside)
    assert "noise of the templates (synchrotron)" in fit_warnings(made, settings, [fit])[0]
    exact = dict.fromkeys(("dust", "synchrotron"), TemplateNoise())
    made = inputs_of(sky, bands, exact)
    fit = fitted(made, settings, inside)
    assert fit_warnings(made, settings, [fit]) == []
    for value, how in ((0.01, "too well"), (100.0, "badly")):
        results = {name: one._replace(chi2=value) for name, one in fit.results.items()}
        (said,) = fit_warnings(made, settings, [fit._replace(results=results)])
        assert f"fits the amplitudes of the templates {how} (chi2 {value:.1f}" in said
    noisy = dict.fromkeys(("dust", "synchrotron"), TemplateNoise(TEMPLATE_NOISE / 1e4))
    drawn = [draw(jax.random.key(i), TEMPLATE_NOISE / 1e4) for i in range(2)]
    maps = {
        name: type(one)(one.amplitude + more)
        for (name, one), more in zip(sky.components.items(), drawn, strict=True)
    }
    made = inputs_of(sky, bands, noisy, maps)
    fit = fitted(made, settings, inside)
    assert fit_warnings(made, settings, [fit]) == []
    said = fit_numbers(settings, [fit], None)["results"]["all"]["QU"]["gradient"]["template_noise"]
    assert said["corrected"]
    assert 0 < said["shares"]["dust"] < 0.1
    index = jnp.where(jnp.arange(NPIX) < 9, 3.099, 3.1)
    maps["synchrotron"] = Synchrotron(maps["synchrotron"].amplitude, index)
    settings = settings_of(free={"dust.beta_dust": {"start": 1.5}})
    made = inputs_of(sky, bands, noisy, maps)
    said = fit_warnings(made, settings, [fitted(made, settings, inside)])[0]
    assert said.startswith("all, QU: the noise of the templates attenuates dust by ")
    assert said.endswith("not corrected for it, as there are parameters with maps of values.")


def test_the_embedded_templates_are_exact():
    bands = [{"instrument": "planck", "channels": ["44", "70"]}]
    made = fit_inputs.inputs_of(Experiment(sky={"embedded": {"nside": 16}}, bands=bands))
    assert list(made.template_noise) == list(made.templates)
    assert not any(n.own for n in made.template_noise.values())


@pytest.mark.parametrize(("noise", "level", "variance"), cases("planck_example/noise_of_templates"))
def test_noise_of_templates_from_settings(folder, noise, level, variance):
    path = folder / "templates.toml"
    path.write_text(experiment("noisy_template", ("{ rms = 0.0 }", noise)))
    found = fit_inputs.inputs_of(load(path)).template_noise["dust"]
    factor = float(Bandpass.delta(353.0).conversion("K_CMB", "uK_RJ"))
    assert found.shared == ({"44": 0.5} if "shared" in noise else {})
    if level:
        expected = (level * factor * np.radians(1 / 60)) ** 2
        np.testing.assert_allclose(found.correlated[2:], expected, rtol=1e-6)  # no beam is given
    else:
        assert found.correlated is None
    covariance = pixel_covariance(found.noise, NSIDE)
    np.testing.assert_allclose(covariance[0, 0], (variance or 0.0) * factor**2)
    np.testing.assert_allclose(covariance[0, 1], 0)


@pytest.mark.parametrize(("noise", "words"), cases("planck_example/noise_that_cannot_be"))
def test_noise_of_templates_that_cannot_be(folder, noise, words):
    path = folder / "wrong.toml"
    path.write_text(experiment("noisy_template", ("{ rms = 0.0 }", noise)))
    with pytest.raises(SettingsError, match=words):
        fit_inputs.inputs_of(load(path))


def test_large_maps_are_kept_in_single_precision(folder, monkeypatch):
    noise = {"covariance": ["QQ_COV", "QU_COV", "UU_COV"]}
    spec = band_of("map.fits", fields=["Q_STOKES", "U_STOKES"], noise=noise)
    double = read_band(folder, spec)
    monkeypatch.setattr(inputs, "LARGE", NPIX)
    single = read_band(folder, spec)
    assert (double.maps.dtype, single.maps.dtype) == (np.float64, np.float32)
    assert single.noise.dtype == np.float32
    np.testing.assert_allclose(single.maps, double.maps, rtol=1e-6)
    np.testing.assert_allclose(single.noise, double.noise, rtol=1e-6)
    data = [common_maps(Inputs({}, {"x": b}, None, None, ""), 4, 900.0) for b in (double, single)]
    assert data[1].data.dtype == np.float64
    np.testing.assert_allclose(data[1].data, data[0].data, atol=1e-6 * float(data[0].data.std()))
    np.testing.assert_allclose(data[1].sigma, data[0].sigma, rtol=1e-6)


def test_fine_pixels_need_no_steps():
    """Quadrature alone, against the refined analysis; and its transpose is exact."""
    fine = Preparation.smoothing(64, 100.0, NSIDE, 600.0, 16)
    alm = np.random.default_rng(6).normal(size=(2, alm_ell(48).size)) / (1 + alm_ell(48))
    maps = synthesis(jnp.asarray(alm), 64)
    refined = resample(maps, fine.window, NSIDE)
    np.testing.assert_allclose(fine(maps), refined, atol=3e-6 * float(maps.std()))
    other = jnp.asarray(np.random.default_rng(7).normal(size=(2, NPIX)))
    left, right = jnp.vdot(fine(maps), other), jnp.vdot(maps, fine.transpose(other))
    assert float(left) == pytest.approx(float(right), rel=1e-10)
