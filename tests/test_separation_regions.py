"""Regions, parameters of each pixel, simulations, and bad input of component separation."""

import builtins

import healpy
import jax
import numpy as np
import pytest

from fits import mixing, systems
from fits.compress import as_noise
from fits.grid import grid_fit
from fits.optimize import best_fit
from fits.posterior import Gaussian, Uniform, chi2
from fits.profile_likelihood import spectral_likelihood
from fits.regions import clusters, latitude_bands, superpixels
from fits.results import FitError
from fits.separated_maps import component_maps
from jaxsky import CMB, Bandpass, Dust, Sky, Synchrotron, observe, set_parameters
from refusals import cases, raises
from test_separation import BANDS, NPIX, START, TRUTH, problem, random_sky

HALVES = np.arange(NPIX) % 2
THIRDS = np.arange(NPIX) % 3
LABELS = {"dust.beta_dust": HALVES, "dust.T_dust": HALVES, "synchrotron.beta_syn": THIRDS}


def with_empty_regions():
    """Data, noise and labels, with a region without pixels and one with masked ones alone."""
    _, data, given, _ = problem("separable")
    data[..., :4], given[..., :4] = np.nan, np.inf
    return data, given, LABELS | {"dust.T_dust": np.where(np.arange(NPIX) < 4, 1, 2)}


def test_superpixels_are_the_healpix_pixels_that_hold_a_pixel():
    labels = superpixels(16, 2)
    direction = healpy.pix2vec(16, np.arange(healpy.nside2npix(16)))
    np.testing.assert_array_equal(labels, healpy.vec2pix(2, *direction))


def test_latitude_bands_and_clusters():
    labels = latitude_bands(8, [20.0, 50.0])
    latitude = np.abs(healpy.pix2ang(8, np.arange(768), lonlat=True)[1])
    np.testing.assert_array_equal(labels, 1 * (latitude >= 20) + (latitude >= 50))
    rng = np.random.default_rng(0)
    kind = rng.integers(3, size=500)
    maps = np.stack([kind * 10.0, (kind == 1) * 1e6]) + rng.normal(size=(2, 500))
    maps[0, 7] = np.nan
    found = clusters(maps, 3, seed=1)
    pairs = set(zip(np.delete(found, 7), np.delete(kind, 7), strict=True))
    assert len(pairs) == 3
    assert 0 <= found[7] < 3


@pytest.mark.slow
def test_two_regions_at_once_are_each_alone():
    _, data, given, _ = problem("full")
    labels = dict.fromkeys(LABELS, HALVES)
    start = START | {"dust.T_dust": np.array([20.0, 22.0])}
    like = spectral_likelihood(random_sky(), BANDS, data, given, start, labels=labels)
    both = best_fit(like)
    maps = component_maps(like, both.best_fit, data, given)
    for half in range(2):
        here = half == HALVES
        noise = given[..., here]
        alone = spectral_likelihood(random_sky(), BANDS, data[..., here], noise, START)
        fit = best_fit(alone)
        for name in START:
            assert both.best_fit[name][half] == pytest.approx(fit.best_fit[name], rel=1e-8)
            assert both.sigma[name][half] == pytest.approx(fit.sigma[name], rel=1e-6)
        expected = component_maps(alone, fit.best_fit, data[..., here], noise)
        np.testing.assert_allclose(maps.amplitude[..., here], expected.amplitude, rtol=1e-6)
        np.testing.assert_allclose(maps.chi2[here], expected.chi2, rtol=1e-6)
        sigma = maps.sigma("dust")[:, here]
        np.testing.assert_allclose(sigma, expected.sigma("dust"), rtol=1e-6)
    assert both.chi2 == pytest.approx(maps.chi2.sum(), rel=1e-9)
    assert both.dof == NPIX * 2 * 5 - 6
    assert both.labels[1] == "dust.T_dust[1]"
    assert abs(both.correlation("dust.T_dust[0]", "dust.beta_dust[0]")) > 0.9
    assert both.correlation("dust.T_dust[0]", "dust.beta_dust[1]") == pytest.approx(0, abs=1e-9)


def test_intersections_of_regions_compressed_pixel_by_pixel_and_sparse(monkeypatch):
    data, given, labels = with_empty_regions()
    priors = {"dust.beta_dust": Gaussian(1.5, 0.1)}
    like, pixels = (
        spectral_likelihood(random_sky(), BANDS, data, given, START, labels=labels, compress=each)
        for each in (True, False)
    )
    fits = [best_fit(each, priors=priors) for each in (like, pixels)]
    monkeypatch.setattr(systems, "DENSE", 0)
    fits.append(best_fit(like, priors=priors))
    for name in START:
        for other in fits[1:]:
            np.testing.assert_allclose(other.best_fit[name], fits[0].best_fit[name], rtol=1e-7)
            np.testing.assert_allclose(other.sigma[name], fits[0].sigma[name], rtol=1e-5)
    assert 0.5 < abs(fits[0].correlation("dust.T_dust[2]", "dust.beta_dust[0]")) < 1
    # Regions 0 and 1 of T_dust have no pixel, or only masked ones.
    assert np.isnan(fits[0].best_fit["dust.T_dust"]).tolist() == [True, True, False]
    maps = component_maps(like, fits[0].best_fit, data, given)
    assert np.isnan(maps.amplitude).all(axis=(0, 1)).tolist() == [True] * 4 + [False] * 44


def test_each_pixel_its_own_region(monkeypatch):
    """With priors, and dense as well as sparse."""
    _, data, given, _ = problem("full", sky=random_sky(size=100.0))
    labels = {"dust.beta_dust": np.arange(NPIX), "synchrotron.beta_syn": np.arange(NPIX)}
    start = {n: START[n] for n in labels}
    priors = {"dust.beta_dust": Gaussian(1.5, 0.2), "synchrotron.beta_syn": Gaussian(3.1, 0.2)}
    like = spectral_likelihood(random_sky(), BANDS, data, given, start, labels=labels)
    assert like.pixels[0].data.shape == (NPIX, 2, 8, 1)
    dense = best_fit(like, priors=priors)
    monkeypatch.setattr(systems, "DENSE", 0)
    sparse = best_fit(like, priors=priors)
    for name in start:
        np.testing.assert_allclose(sparse.best_fit[name], dense.best_fit[name], rtol=1e-7)
        np.testing.assert_allclose(sparse.sigma[name], dense.sigma[name], rtol=1e-7)
        assert np.all(dense.sigma[name] < 0.2)
    assert sparse.covariance is None
    assert dense.covariance.shape == (2 * NPIX, 2 * NPIX)


def test_laws_of_many_cells_are_interpolated(monkeypatch):
    _, data, given, _ = problem()
    bands = {name: BANDS[name] for name in ("23", "60", "145", "353")}
    data, given = data[:4], given[:4]
    like = spectral_likelihood(random_sky(), bands, data, given, START | {"gain.60": 1.1})
    rng = np.random.default_rng(5)
    local = np.array(like.flat({})) * (1 + 0.05 * rng.uniform(-1, 1, (30, 4)))
    local[:, list(like.free).index("gain.60")] = 1.1
    each = jax.jit(jax.vmap(lambda x: like.mixing.one(like.named(x))))(local)
    monkeypatch.setattr(mixing, "CELLS", 0)
    interpolated = jax.jit(lambda x: like.matrices(x)[0])(local)
    np.testing.assert_allclose(interpolated, each, rtol=1e-9)
    moving = spectral_likelihood(random_sky(), bands, data, given, START | {"shift.60": 0.1})
    local[:, list(moving.free).index("shift.60")] = 0.1
    monkeypatch.setattr(mixing, "CELLS", 7)
    each = jax.jit(jax.vmap(lambda x: moving.mixing.one(moving.named(x))))(local)
    in_parts = jax.jit(lambda x: moving.matrices(x)[0])(local)
    np.testing.assert_allclose(in_parts, each, rtol=1e-12)


def test_a_known_map_of_a_parameter():
    warm = np.random.default_rng(3).uniform(size=NPIX) < 0.4
    maps = random_sky()
    parts = [{n: maps[n] for n in maps} for _ in range(3)]
    for part, T in zip(parts, (18.0, 21.0, np.where(warm, 21.0, 18.0)), strict=True):
        part["dust"] = Dust(maps["dust"].amplitude, TRUTH["dust.beta_dust"], T)
    cold, hot = (np.asarray(observe(Sky(part), list(BANDS.values()))) for part in parts[:2])
    data = np.where(warm, hot, cold)
    like = spectral_likelihood(parts[2], BANDS, data, np.ones(8), {"dust.beta_dust": 1.4})
    fit = best_fit(like)
    assert fit.best_fit["dust.beta_dust"] == pytest.approx(TRUTH["dust.beta_dust"], rel=1e-8)
    assert fit.chi2 < 1e-6
    found = component_maps(like, fit.best_fit, data, np.ones(8))
    np.testing.assert_allclose(found.map("dust"), maps["dust"].amplitude, atol=1e-6)


def simulate(size: float, npix: int, count: int = 200):
    """Deviations in units of their errors, and probabilities to exceed chi2."""
    bands = {name: BANDS[name] for name in ("35", "60", "95", "145", "280", "353")}
    sky = random_sky(size=size, npix=npix)
    clean = np.asarray(observe(sky, list(bands.values())))
    sigma = np.array([1.0, 0.8, 0.6, 0.6, 0.8, 1.0])
    rng = np.random.default_rng(11)
    pulls, probabilities = [], []
    for i in range(count):
        data = clean + sigma[:, None, None] * rng.normal(size=clean.shape)
        like = spectral_likelihood(sky, bands, data, sigma, START)
        prior = {"dust.T_dust": Gaussian(19.5 + 0.5 * rng.normal(), 0.5)}
        fit = best_fit(like, priors=prior)
        pulls.append([(fit.best_fit[n] - TRUTH[n]) / fit.sigma[n] for n in fit.free])
        if i < 50:
            probabilities.append(component_maps(like, fit.best_fit, data, sigma).probability)
    return np.array(pulls), np.array(probabilities)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "npix"), [(30.0, 48), (3.0, 768)])
def test_errors_are_honest(size, npix):
    """Also where signals are only a few times the noise of a pixel."""
    pulls, probabilities = simulate(size, npix)
    assert np.all(np.abs(pulls.mean(axis=0)) < 0.15 + 0.06)
    assert np.all((pulls.std(axis=0) > 0.9) & (pulls.std(axis=0) < 1.1))
    # Uniform, but for the few spectral parameters that were fitted.
    shares = np.histogram(probabilities, 10, (0, 1))[0] / probabilities.size
    assert np.abs(shares - 0.1).max() < 0.03


def call(**changes):
    _, data, given, _ = problem()
    arguments = {"sky": random_sky(), "bands": BANDS, "data": data, "noise": given, "start": START}
    return spectral_likelihood(**(arguments | changes))


def fit(**changes):
    options = changes.pop("fit", {})
    return best_fit(call(**changes), **options)


def two_bodies(**changes):
    sky = {
        "cmb": CMB(np.ones((2, 1))),
        "dust": Dust(np.ones((2, 1)), (1.5, 2.5), (9.0, 16.0), (1, 2)),
    }
    return {"sky": sky} | changes


@pytest.mark.parametrize(("changes", "error", "words"), cases("separation_regions/bad_input"))
def test_bad_input_is_refused(changes, error, words):
    raises(getattr(builtins, error), words, call, **changes)


def test_laws_that_are_alike_are_refused():
    maps = np.ones((2, 1))
    sky = {"a": Synchrotron(maps, 3.1), "b": Synchrotron(maps, 3.1), "cmb": CMB(maps)}
    raises(ValueError, "a, b, cmb cannot be told", call, sky=sky, start={"a.beta_syn": 3.1})


def test_too_few_bands_are_refused():
    few = {name: BANDS[name] for name in list(BANDS)[:3]}
    with pytest.raises(ValueError, match="3 bands are too few: amplitudes of 3 components"):
        call(bands=few, data=np.ones((3, 2, 48)), noise=np.ones(3))
    sigma = np.ones((8, 2, 48))
    sigma[:6, 0, :5] = np.inf
    raises(ValueError, "5 pixels are seen in fewer bands than the 3 components", call, noise=sigma)
    sigma[0, 0, 0] = 2.0
    with pytest.raises(ValueError, match="Only noise that is separable"):
        call(noise=np.where(np.isfinite(sigma), sigma, 1.0), compress=True)
    with pytest.raises(ValueError, match="`pixel_sigma` must have shape"):
        as_noise(np.ones(8), (8, 2, 48), np.ones(12))


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        (two_bodies(start={"dust.E_dust.0": 1.0, "dust.E_dust.1": 2.0}), FitError,
         "do not determine dust.E_dust.0, dust.E_dust.1"),
        ({"start": {f"gain.{name}": 1.0 for name in BANDS}}, FitError,
         "do not determine gain.145, gain.220, .* degenerate"),
        ({"start": {}}, ValueError, "`start` must name at least one free parameter"),
        ({"fit": {"start": {"dust.T": 1.0}}}, KeyError, "Unknown parameter 'dust.T'"),
        ({"fit": {"start": {"gain.23": 1.0}}}, ValueError, "'gain.23' is not free"),
        ({"fit": {"priors": {"gain.23": Gaussian(1, 1)}}}, KeyError,
         "'gain.23', which is not free"),
        ({"fit": {"max_steps": 1}}, FitError, "The search stopped after 1 steps"),
    ],
)  # fmt: skip
def test_fits_that_cannot_be_made_say_why(changes, error, words):
    raises(error, words, fit, **changes)


def test_a_delta_band_and_a_curved_law():
    bands = {str(nu): Bandpass.delta(float(nu)) for nu in (23, 33, 70, 143, 353)}
    sky = {"cmb": CMB(np.ones((2, 4))), "s": Synchrotron(np.ones((2, 4)), 3.0, -0.05)}
    data = np.asarray(observe(Sky(sky), list(bands.values())))
    start = {"s.beta_syn": 2.8, "s.curvature": 0.0}
    like = spectral_likelihood(sky, bands, data, np.full(5, 1e-3), start)
    assert float(chi2(like, {"s.beta_syn": 3.0, "s.curvature": -0.05})) < 1e-12
    fit = best_fit(like)
    assert fit.best_fit["s.curvature"] == pytest.approx(-0.05, abs=1e-8)


def test_pixels_that_fail_are_counted_with_the_prior_that_helps():
    _, data, given, _ = problem("full")
    dark = np.array(data)
    dark[..., :3] = 0.0
    start, labels = {"dust.beta_dust": 1.6}, {"dust.beta_dust": np.arange(NPIX)}
    like = spectral_likelihood(random_sky(), BANDS, dark, given, start, labels=labels)
    words = (
        rf"dust.beta_dust in \d+ of {NPIX} regions \(\d+ of {NPIX} pixels\).*; "
        r"a Gaussian prior on dust.beta_dust \(mean, standard deviation\) would help"
    )
    with pytest.raises(FitError, match=words) as caught:
        best_fit(like)
    assert not caught.value.result.converged
    held = best_fit(like, priors={"dust.beta_dust": Gaussian(1.6, 0.1)})
    np.testing.assert_allclose(held.best_fit["dust.beta_dust"][:3], 1.6, atol=1e-6)


def test_a_temperature_that_runs_away_is_no_fit():
    """At low frequencies dust has no temperature."""
    bands = {str(nu): Bandpass.delta(float(nu)) for nu in (5, 10, 20, 30, 40)}
    sky = {"dust": Dust(np.ones((2, 4))), "s": Synchrotron(np.ones((2, 4)))}
    data = np.asarray(observe(Sky(sky), list(bands.values())))
    data = data + 0.1 * np.random.default_rng(0).normal(size=data.shape)
    like = spectral_likelihood(sky, bands, data, np.full(5, 0.1), {"dust.T_dust": 19.6})
    words = r"do not constrain 'dust.T_dust': from .*; a Gaussian prior"
    with pytest.raises(FitError, match=words) as caught:
        best_fit(like)
    assert caught.value.result.best_fit["dust.T_dust"] > 1e4


@pytest.mark.parametrize("kind", ["bands", "full", "covariance"])
def test_a_band_without_weight_is_named_and_not_counted(kind):
    _, data, given, _ = problem("full")
    noise = np.array(given)
    if kind == "bands":
        noise = noise[:, 0, 0]
    if kind == "covariance":
        noise = np.einsum("bsp,st->bstp", noise**2, np.eye(2))
    without = spectral_likelihood(
        random_sky(), dict(list(BANDS.items())[1:]), data[1:], noise[1:], START
    )
    whole = spectral_likelihood(random_sky(), BANDS, data, noise, START)
    assert whole.weightless == without.weightless == ()
    noise[0] *= 1e12 if kind == "covariance" else 1e6
    light = spectral_likelihood(random_sky(), BANDS, data, noise, START)
    assert light.weightless == (next(iter(BANDS)),)
    assert light.dof(3) == without.dof(3) == whole.dof(3) - data[0].size


def test_a_grid_does_not_take_regions():
    _, data, given, _ = problem("full")
    labels = {"dust.beta_dust": HALVES}
    like = spectral_likelihood(
        random_sky(), BANDS, data, given, {"dust.beta_dust": 1.5}, labels=labels
    )
    with pytest.raises(ValueError, match=r"'dust.beta_dust' has 2, one for each region"):
        grid_fit(like, priors={"dust.beta_dust": Uniform(1.0, 2.0)})


def test_a_grid_knows_parameters_that_are_fixed_maps():
    _, data, given, _ = problem("full")
    T_dust = np.linspace(18.0, 22.0, NPIX)
    sky = set_parameters(random_sky(), {"dust.T_dust": T_dust})
    like = spectral_likelihood(sky, BANDS, data, given, {"dust.beta_dust": 1.5})
    fit = best_fit(like)
    value, sigma = (
        fit.best_fit["dust.beta_dust"],
        np.linalg.inv(fit.details["hessian"])[0, 0] ** 0.5,
    )
    prior = Uniform(value - 8 * sigma, value + 8 * sigma)
    grid = grid_fit(like, priors={"dust.beta_dust": prior})
    assert grid.best_fit["dust.beta_dust"] == pytest.approx(value, abs=0.1 * sigma)
    assert grid.sigma["dust.beta_dust"] == pytest.approx(sigma, rel=0.05)
    assert grid.chi2 == pytest.approx(fit.chi2, abs=0.01)
