"""The spectral-index fit: common resolution, honest errors over simulated skies, the real sky."""

import json
from pathlib import Path

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from commands import jaxsky
from fits.commands.run import DEFAULTS
from fits.common import Fluctuations, MapNoise, common_maps, prepare_component
from fits.inputs import Band, Inputs, inputs_of
from fits.optimize import best_fit
from fits.regions import region_masks
from fits.spectral_index import fit_regions
from jaxsky import Bandpass, Dust, observe
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import (
    Preparation,
    alm_ell,
    analysis,
    gaussian_beam,
    power_spectrum,
    synthesis,
)
from jaxsky.inputs import Template
from jaxsky.noise import draw, fit_knee, knee_spectrum, uniform_covariance
from jaxsky.settings import SettingsError, load
from refusals import cases, raises

QUICK = ["common.nside=16", "common.fwhm=300.0", "seed=3", "sky.embedded.nside=32"]


def random_alm(lmax: int, seed: int = 0) -> jnp.ndarray:
    ell = alm_ell(lmax)
    alm = np.random.default_rng(seed).normal(size=(2, ell.size)) / (1 + ell)
    return jnp.asarray(np.where(ell > 1, alm, 0))


@pytest.mark.parametrize(
    "preparation",
    [
        Preparation.smoothing(16, 100.0, 8, 600.0, 23),
        Preparation(None, 16, 8),
        Preparation(None, 8, 8),
    ],
)
def test_preparation_is_linear_with_an_exact_transpose(preparation):
    rng = np.random.default_rng(1)
    a = jnp.asarray(rng.normal(size=(2, healpy.nside2npix(preparation.nside_in))))
    b = jnp.asarray(rng.normal(size=(2, healpy.nside2npix(preparation.nside))))
    left, right = jnp.vdot(preparation(a), b), jnp.vdot(a, preparation.transpose(b))
    assert float(left) == pytest.approx(float(right), rel=1e-10)


def test_own_beams_are_accounted_for():
    """A sky seen with two beams is the same map at the common resolution."""
    lmax, alm = 32, random_alm(32)
    prepared = []
    for own in (0.0, 200.0, 500.0):
        seen = synthesis(alm * gaussian_beam(own, lmax)[alm_ell(lmax)], 16)
        prepared.append(Preparation.smoothing(16, own, 8, 600.0, 23)(seen))
    np.testing.assert_allclose(prepared[1], prepared[0], atol=2e-4 * float(prepared[0].std()))
    np.testing.assert_allclose(prepared[2], prepared[0], atol=2e-4 * float(prepared[0].std()))


@pytest.mark.slow
def test_variance_of_prepared_noise():
    """Against 400 draws: a map of variances is smoothed by the square of the kernel."""
    nside_in, nside = 32, 16
    keys = jax.random.split(jax.random.key(0), 400)
    latitude = healpy.pix2ang(nside_in, np.arange(healpy.nside2npix(nside_in)), lonlat=True)[1]
    covariance = uniform_covariance(1000.0, nside_in) * (1.5 + np.cos(np.radians(latitude)))
    for preparation in (
        Preparation.smoothing(nside_in, 60.0, nside, 400.0, 47),
        Preparation(None, nside_in, nside),
    ):
        draws = jax.lax.map(lambda k, p=preparation: p(draw(k, covariance)), keys, batch_size=50)
        noises = (MapNoise(preparation, covariance, None),)
        model = Fluctuations(noises, None, None, jnp.ones(1), ("44",))
        ratio = np.asarray(draws.var(axis=0) / model.sigma()[0] ** 2)
        inside = np.abs(healpy.pix2ang(nside, np.arange(ratio.shape[1]), lonlat=True)[1])
        for low in (0, 30, 60):
            band = (inside >= low) & (inside < low + 30)
            # Some 100 independent smoothed pixels x 400 draws: below 1 % of sampling error.
            assert ratio[:, band].mean() == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_uniform_noise_is_drawn_by_multipoles():
    """As smoothed white noise in pixels: the same variance and the same spectrum."""
    nside_in, nside, lmax = 32, 16, 47
    preparation = Preparation.smoothing(nside_in, 60.0, nside, 400.0, lmax)
    model, pixels = (
        Fluctuations((MapNoise(preparation, noise, None),), None, None, jnp.ones(1), ("44",))
        for noise in (1000.0, uniform_covariance(1000.0, nside_in))
    )
    np.testing.assert_allclose(model.sigma(), pixels.sigma(), rtol=1e-6)
    keys = jax.random.split(jax.random.key(0), 200)
    maps = [np.stack([m.noise_realisation(k)[0] for k in keys]) for m in (model, pixels)]
    # Some 1600 modes x 200 draws: 0.3 % of sampling error.
    for drawn in maps:
        assert np.mean(drawn**2 / model.sigma()[0] ** 2) == pytest.approx(1.0, abs=0.015)
    powers = [
        np.mean([power_spectrum(analysis(jnp.asarray(m), 24)) for m in drawn], axis=0)[:, 2:]
        for drawn in maps
    ]
    np.testing.assert_allclose(powers[0].mean(), powers[1].mean(), rtol=0.02)
    np.testing.assert_allclose(powers[0][0].mean(), powers[0][1].mean(), rtol=0.03)


def test_noise_of_a_band_is_that_of_its_name():
    how = Preparation.smoothing(16, 60.0, 8, 900.0, 16)

    def drawn(names, noise):
        count = len(names)
        noises = (MapNoise(how, noise, None),) * count
        model = Fluctuations(noises, None, None, jnp.ones(count), names)
        return dict(zip(names, np.asarray(model.noise_realisation(jax.random.key(5))), strict=True))

    for noise in (1000.0, uniform_covariance(1000.0, 16)):
        both, other = drawn(("44", "70"), noise), drawn(("30", "70"), noise)
        np.testing.assert_array_equal(both["70"], other["70"])
        assert abs(np.corrcoef(both["44"].ravel(), both["70"].ravel())[0, 1]) < 0.5


def test_component_maps_are_prepared_with_their_templates():
    nside = 8
    maps = jnp.ones((2, healpy.nside2npix(nside)))
    beta = jnp.full(maps.shape[1], 1.6)
    component = prepare_component(Dust(maps, beta), Preparation.smoothing(8, 0.0, 4, 900.0, 11))
    assert component.amplitude.shape == (2, healpy.nside2npix(4))
    np.testing.assert_allclose(component.beta_dust, 1.6, rtol=1e-4)
    assert component.T_dust.shape == ()


def one_band_inputs(nside=16, fwhm=0.0, used=None, template_fwhm=0.0) -> Inputs:
    npix = healpy.nside2npix(nside)
    used = np.ones(npix, bool) if used is None else used
    maps = synthesis(random_alm(2 * nside), nside)
    template = Template(Dust(maps), template_fwhm, np.ones(npix, bool))
    band = Band(maps, used, Bandpass.delta(353.0), fwhm, uniform_covariance(1.0, nside))
    return Inputs({"dust": template}, {"353": band}, None, None, "")


def test_a_target_finer_than_a_map_names_both():
    words = r"target beam of 30 arcmin is finer than that of band '353', 60 arcmin"
    raises(ValueError, words, common_maps, one_band_inputs(fwhm=60.0), 8, 30.0)
    words = r"target beam of 30 arcmin is finer than that of template 'dust', 40 arcmin"
    raises(ValueError, words, common_maps, one_band_inputs(template_fwhm=40.0), 8, 30.0)
    with pytest.raises(ValueError, match=r"nside 32 is larger than that of template 'dust', 16"):
        common_maps(one_band_inputs(), 32, 0.0)


def test_missing_pixels_take_their_surroundings_along():
    used = np.ones(healpy.nside2npix(16), bool)
    hole = healpy.query_disc(16, healpy.ang2vec(np.pi / 2, 0), np.radians(10))
    used[hole] = False
    smoothed = common_maps(one_band_inputs(used=used), 8, 400.0).used
    angle = healpy.rotator.angdist(healpy.pix2ang(8, np.arange(768)), (np.pi / 2, 0.0))
    assert not smoothed[angle < np.radians(12)].any()
    assert smoothed[angle > np.radians(25)].all()
    averaged = common_maps(one_band_inputs(used=used), 8, 0.0).used
    assert 700 < averaged.sum() < 768


@pytest.mark.slow
def test_missing_pixels_do_not_bias():
    """Data without the plane, templates with it: both get the same holes before smoothing."""
    nside = 32
    galaxy = embedded_sky(nside).sky("QU")
    latitude = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)[1]
    whole, holed = np.ones(latitude.size, bool), np.abs(latitude) > 5
    bands = [Bandpass.delta(44.0), Bandpass.delta(70.0)]
    noise = uniform_covariance(300.0, nside)
    inputs = Inputs(
        {name: Template(galaxy[name], 0.0, whole) for name in galaxy},
        {
            str(i): Band(m * holed, holed, band, 0.0, noise)
            for i, (m, band) in enumerate(zip(observe(galaxy, bands), bands, strict=True))
        },
        None,
        None,
        "",
    )
    start = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}
    fit = best_fit(common_maps(inputs, 16, 200.0).likelihood(start), start)
    for name, truth in (("dust.beta_dust", 1.53), ("synchrotron.beta_syn", 3.1)):
        assert abs(fit.best_fit[name] - truth) < 0.05 * fit.sigma[name]


def test_both_ways_of_preparing_reproduce_the_sky():
    for fwhm in (0.0, 400.0):
        prepared = common_maps(one_band_inputs(), 8, fwhm)
        np.testing.assert_allclose(
            observe(prepared.sky, list(prepared.bands.values())), prepared.data, atol=1e-12
        )


def test_knee_of_correlated_noise_is_recovered():
    nside, lmax = 32, 64
    white = 0.02
    spectrum = knee_spectrum(white, 15.0, 2.0, 95)
    ell = alm_ell(95)
    errors = []
    for seed in range(12):
        alm = jnp.sqrt(spectrum)[ell] * jax.random.normal(jax.random.key(seed), (2, ell.size))
        maps = synthesis(alm, nside)
        latitude = healpy.pix2ang(nside, np.arange(maps.shape[1]), lonlat=True)[1]
        found = fit_knee(maps, np.abs(latitude) > 30, lmax)
        errors.append(np.log(np.array(found) / [white, 15.0, 2.0]))
    mean, scatter = np.mean(errors, axis=0), np.std(errors, axis=0)
    # The mask mixes multipoles of a steep spectrum, which is a bias of a few percent.
    assert np.all(np.abs(mean) < [0.06, 0.12, 0.12])
    assert np.all(scatter < [0.08, 0.15, 0.2])


@pytest.fixture(scope="module")
def quick_settings():
    return load(DEFAULTS / "fit.toml", QUICK)


@pytest.mark.slow
def test_embedded_run_recovers_the_truth(quick_settings, tmp_path):
    inputs = inputs_of(quick_settings)
    free = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.1}
    assert {name: inputs.truth[name] for name in free} == pytest.approx(free)
    assert "not data" in inputs.description
    prepared = common_maps(inputs, 16, 300.0)
    how = quick_settings.fit.model_copy(update={"stokes": ["U", "QU"]})
    quick_settings = quick_settings.model_copy(update={"fit": how})
    fits = fit_regions(quick_settings, prepared, region_masks(quick_settings, ["strip"]), tmp_path)
    assert [(f.region, f.stokes) for f in fits] == [("strip", "U"), ("strip", "QU")]
    for fit in fits:
        results = fit.results
        assert set(results) == {"grid", "gradient", "mcmc"}
        assert all(r.converged for r in results.values())
        assert fit.chi2["gradient"] / fit.dof < 1.5
        assert fit.probability_to_exceed("gradient") > 1e-3
        for name, truth in free.items():
            sigma = results["gradient"].sigma[name]
            for r in results.values():
                assert abs(r.best_fit[name] - truth) < 4 * sigma
                assert abs(r.best_fit[name] - results["gradient"].best_fit[name]) < 0.1 * sigma
                assert r.sigma[name] == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize(("name", "words"), cases("spectral_index/names_of_regions"))
def test_regions_with_names_that_results_cannot_bear(name, words):
    with pytest.raises(SettingsError, match=rf"fit.toml: .*{words}"):
        load(DEFAULTS / "fit.toml", [f"regions.{name!r} = {{ file = 'mask.fits' }}"])


def test_regions(quick_settings):
    masks = region_masks(quick_settings, ["strip", "outside", "full"])
    np.testing.assert_array_equal(masks["strip"] ^ masks["outside"], masks["full"])
    # |b| <= 20 deg covers sin(20 deg) of the sphere.
    assert masks["strip"].mean() == pytest.approx(np.sin(np.radians(20)), abs=0.03)


EXAMPLE = Path(__file__).parents[1] / "examples" / "wmap7_vw.toml"


@pytest.fixture
def wmap(data_dir, monkeypatch):
    monkeypatch.setenv("JAXSKY_DATA", str(data_dir))
    return load(EXAMPLE)


@pytest.mark.slow
def test_wmap_from_the_command_line(wmap, tmp_path, monkeypatch):
    assert jaxsky(monkeypatch, "fit", EXAMPLE, "--out", tmp_path) == 0
    results = json.loads((tmp_path / "result.json").read_text())["results"]
    assert set(results) == {"strip", "full"}
    for region in results.values():
        assert set(region) == {"Q", "U", "QU"}
        for methods in region.values():
            gradient, grid = methods["gradient"]["best_fit"], methods["grid"]["best_fit"]
            assert gradient == pytest.approx(grid, abs=0.02)
        # The indices of the real sky, which the templates' makers find to be 1.5 and 3.0.
        best = region["QU"]["gradient"]["best_fit"]
        assert 1.2 < best["dust.beta_dust"] < 1.8
        assert 2.7 < best["synchrotron.beta_syn"] < 3.9
    for picture in ("grid.png", "marginals.png", "posterior.png"):
        assert (tmp_path / picture).stat().st_size > 10_000


def test_published_noise_is_recovered_from_the_maps(wmap):
    """About 5.5 uK_CMB a pixel in V and 8.6 in W at high latitude, large scales included."""
    inputs = inputs_of(wmap)
    sigma = common_maps(inputs, 32, 0.0).sigma[:, :, 0]
    for (name, expected), row in zip({"V": 5.5, "W": 8.6}.items(), sigma, strict=True):
        factor = float(inputs.bands[name].bandpass.conversion("uK_CMB", "uK_RJ"))
        assert float(row[0]) / factor == pytest.approx(expected, rel=0.06)
