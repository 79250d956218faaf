"""Likelihoods against dense sums over pixels, each other, and finite differences."""

import builtins
import functools

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.test_util import check_grads

import systems
from fits.fluctuations import Fluctuations, MapNoise
from fits.mixing import NOMINAL
from fits.optimize import best_fit
from fits.posterior import Gaussian, chi2
from fits.products import gram
from fits.systems import square_root
from fits.template_likelihood import likelihood
from jaxsky import (
    AME,
    Bandpass,
    Dust,
    Sky,
    Synchrotron,
    get_parameters,
    observe,
    parameter_names,
    set_parameters,
)
from jaxsky.cmb import camb_spectra
from jaxsky.harmonics import Preparation, adjoint_synthesis, alm_ell, gaussian_beam
from jaxsky.noise import uniform_covariance
from refusals import cases, raises

NSIDE = 4
NPIX = healpy.nside2npix(NSIDE)
BANDS = {
    "44": Bandpass.top_hat(44.0, 10.0, samples=11),
    "70": Bandpass(np.linspace(63.0, 77.0, 15), np.hanning(17)[1:-1], "power"),
}
START = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}


def problem(seed: int = 0, sky: Sky | None = None):
    sky = sky or systems.dust_and_synchrotron(NPIX)
    rng = np.random.default_rng(seed)
    data = observe(sky, list(BANDS.values()))
    sigma = jnp.asarray(rng.uniform(0.5, 1.5, data.shape))
    return sky, data + sigma * rng.normal(size=data.shape), sigma


def fitted(**changes):
    """The likelihood of the problem, with other arguments of `likelihood`."""
    sky, data, sigma = problem()
    given = {"sky": sky, "bands": BANDS, "data": data, "sigma": sigma, "start": START}
    return likelihood(**(given | changes))


def papers_chi2(sky, params, data, sigma, gain=(1.0, 1.0), offset=0.0):
    """The formula of the paper, summed with numpy."""
    model = np.asarray(observe(set_parameters(sky, params), list(BANDS.values())))
    model = model * np.asarray(gain)[:, None, None] + offset
    return np.sum(((np.asarray(data) - model) / np.asarray(sigma)) ** 2)


@functools.cache
def fluctuations(cmb: bool = True) -> Fluctuations:
    """Noise at nside 8, smoothed to nside 4; correlated noise in one band; CMB."""
    lmax, nside_in = 8, 8
    preparations = tuple(
        Preparation.smoothing(nside_in, own, NSIDE, 1500.0, lmax) for own in (900.0, 300.0)
    )
    tilt = 1 + 0.5 * healpy.pix2vec(nside_in, np.arange(healpy.nside2npix(nside_in)))[2]
    first, second = (uniform_covariance(s, nside_in) * tilt for s in (2000.0, 3000.0))
    rows, columns = np.array([0, 1]), np.array([1, 0])
    noise = first.at[rows, columns].set(0.3 * first[0, 0]), second
    spectra = jnp.asarray(camb_spectra(lmax))[1:3] * 1e4
    windows = jnp.stack([gaussian_beam(fwhm, lmax) for fwhm in (1500.0, 1200.0)])
    correlated = (None, jnp.zeros(lmax + 1).at[2:].set(3.0 / jnp.arange(2, lmax + 1) ** 2))
    noises = tuple(map(MapNoise, preparations, noise, correlated))
    seen = spectra if cmb else None, windows, jnp.array([0.95, 0.9])
    return Fluctuations(noises, *seen, ("44", "70"))


@functools.cache
def dense_covariance(cmb: bool = True) -> np.ndarray:
    """Covariance of all values (band, stokes, pix) of the prepared maps, mode by mode."""
    model, blocks = fluctuations(cmb), []
    Y, ell = synthesis_matrix(8), alm_ell(8)
    for preparation, noise, correlated, _ in model.noises:
        npix_in = noise.shape[-1]
        basis = jnp.eye(2 * npix_in).reshape(-1, 2, npix_in)
        A = np.asarray(jax.lax.map(preparation, basis, batch_size=256))
        A = A.reshape(2 * npix_in, -1).T
        N = np.block([[np.diag(noise[s, t]) for t in range(2)] for s in range(2)])
        blocks.append(A @ N @ A.T)
        if correlated is not None:
            blocks[-1] += Y @ np.diag(np.tile(correlated[ell], 2)) @ Y.T
    total = scipy.linalg.block_diag(*blocks)
    if model.cmb_spectra is not None:
        f, windows = np.asarray(model.cmb_factors), np.asarray(model.cmb_windows)
        seen = [np.sqrt(model.cmb_spectra) * f[b] * windows[b] for b in range(2)]
        rows = np.concatenate([Y * x[:, ell].ravel() for x in seen])
        total = total + rows @ rows.T
    return total


def synthesis_matrix(lmax: int) -> np.ndarray:
    rows = jnp.eye(2 * NPIX).reshape(-1, 2, NPIX)
    columns = jax.lax.map(lambda r: adjoint_synthesis(r, lmax), rows, batch_size=256)
    return np.asarray(columns).reshape(len(rows), -1)


def test_inner_products_do_not_depend_on_chunks_and_add_up(monkeypatch):
    sky, data, sigma = problem()
    templates = jnp.stack([c.amplitude for c in sky.components.values()])
    weights = 1 / sigma**2
    whole = gram(data, templates, weights)
    both = np.broadcast_to(templates, (2, *templates.shape)).swapaxes(1, 2)
    rows = np.concatenate([data[:, :, None], both, np.ones((2, 2, 1, NPIX))], axis=2)
    dense = np.einsum("bsip,bsp,bsjp->bsij", rows, weights, rows)
    np.testing.assert_allclose(whole, dense, rtol=1e-12, atol=1e-9)
    north = jnp.arange(NPIX) < 70
    parts = [gram(data, templates, weights * half) for half in (north, ~north)]
    np.testing.assert_allclose(parts[0] + parts[1], dense, atol=1e-9)
    # One pixel more than before, of no weight, so that it is compiled anew.
    monkeypatch.setattr("fits.products.CHUNK", 50)
    wider = (jnp.pad(maps, [(0, 0), (0, 0), (0, 1)]) for maps in (data, templates, weights))
    np.testing.assert_allclose(gram(*wider), dense, atol=1e-9)


def test_square_root_of_singular_and_badly_scaled_matrices():
    rows = np.random.default_rng(0).normal(size=(4, 9)) * np.array([1e8, 1, 1e-8, 0])[:, None]
    rows[1] = 2e-8 * rows[0]
    G = jnp.asarray(rows @ rows.T)
    R = square_root(G)
    scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
    squares = np.outer(scale, scale)
    np.testing.assert_allclose(R.T @ R / squares, G / squares, atol=1e-12)


@pytest.mark.parametrize("pixelwise", [False, True])
@pytest.mark.parametrize("stokes", ["Q", "U", "QU"])
def test_diagonal_likelihood_is_the_papers_chi2(stokes, pixelwise):
    sky, data, sigma = problem()
    like = fitted(stokes=stokes, pixelwise=pixelwise)
    kept = jnp.where(jnp.array([s in stokes for s in "QU"])[:, None], sigma, jnp.inf)
    for params in (START, {"dust.beta_dust": 1.2, "synchrotron.beta_syn": 3.7}):
        expected = papers_chi2(sky, params, data, kept)
        assert float(chi2(like, params)) == pytest.approx(expected, rel=1e-11)


#: Parameters of bands that are not as they should be.
MOVED = {"gain.44": 1.02, "shift.44": 0.03, "width.70": 1.2, "shift.70": -0.02, "angle.44": 3.0}


def moved_bands(params):
    """What is seen in bands with parameters, calibrated on the CMB, with numpy."""
    sky = set_parameters(systems.dust_and_synchrotron(NPIX), START)
    seen = []
    for name, band in BANDS.items():
        at = {kind: params.get(f"{kind}.{name}", value) for kind, value in NOMINAL.items()}
        wide = band.center + at["width"] * (band.nu - band.center)
        center = Bandpass(wide, band.weights, band.convention).center
        moved = Bandpass(wide + at["shift"] * center, band.weights, band.convention)
        Q, U = observe(sky, [moved])[0] * moved.conversion("uK_RJ", "uK_CMB") * at["gain"]
        turned = (Q + 1j * U) * np.exp(2j * np.radians(at["angle"]))
        factor = band.conversion("uK_CMB", "uK_RJ")
        seen.append(np.stack([turned.real, turned.imag]) * factor)
    return np.stack(seen)


@pytest.mark.parametrize("pixelwise", [False, True])
@pytest.mark.parametrize("stokes", ["Q", "QU"])
def test_bands_with_parameters_against_a_sum_over_pixels(stokes, pixelwise):
    _, data, sigma = problem()
    kept = np.where(np.array([s in stokes for s in "QU"])[:, None], sigma, np.inf)
    like = fitted(start=MOVED | START, stokes=stokes, pixelwise=pixelwise)
    for params in (MOVED, MOVED | {"angle.44": -40.0, "angle.70": 1.0}):
        expected = np.sum(((np.asarray(data) - moved_bands(params)) / kept) ** 2)
        assert float(chi2(like, params | START)) == pytest.approx(expected, rel=1e-10)


def test_an_angle_does_not_change_the_intensity():
    maps = systems.random_maps(1, npix=NPIX, stokes=3)
    sky, bands = Sky({"dust": Dust(maps)}), [Bandpass.delta(353.0)]
    data = 2 * observe(sky, bands)
    free = {"dust.beta_dust": 1.5, "angle.0": 2.0}
    for options in ({}, {"covariance_of": white_covariance(jnp.ones_like(data))}):
        by_template, by_pixel = (
            likelihood(sky, bands, data, 1.0, free, pixelwise=p, **options) for p in (False, True)
        )
        assert float(chi2(by_template, free)) == pytest.approx(float(chi2(by_pixel, free)))
    turned = likelihood(sky, bands, data, 1.0, free)
    alone = likelihood(sky, bands, data, 1.0, free, stokes="QU")
    plain = likelihood(sky, bands, data, 1.0, {"dust.beta_dust": 1.5}, stokes="I")
    rest = float(chi2(turned, free)) - float(chi2(alone, free))
    assert rest == pytest.approx(float(chi2(plain, {"dust.beta_dust": 1.5})))


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True])
def test_what_is_wrong_with_bands_is_found(exact):
    """The truth is within the errors, and found where there is no noise."""
    sky, _, sigma = problem()
    sky, truth = set_parameters(sky, START), {n: v for n, v in MOVED.items() if n != "gain.44"}
    truth |= START
    priors = {"shift.70": Gaussian(-0.02, 0.02), "width.70": Gaussian(1.2, 0.2)}
    start = {name: NOMINAL.get(name.split(".")[0], value) for name, value in truth.items()}
    options = {"covariance_of": white_covariance(0.01 * sigma)} if exact else {}
    like = likelihood(sky, BANDS, moved_bands(truth), 0.01 * sigma, start, **options)
    found = best_fit(like, start, priors=priors)
    assert found.best_fit == pytest.approx(truth, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("stokes", ["Q", "QU"])
@pytest.mark.parametrize("exact", [False, True])
def test_pulls_of_bands_with_parameters(exact, stokes):
    sky, _, sigma = problem()
    truth = {"gain.70": 1.02, "shift.44": 0.03, "angle.70": -1.0, "angle.44": 3.0, **START}
    priors = {"gain.70": Gaussian(1.0, 0.02), "shift.44": Gaussian(0.0, 0.03)}
    options = {"covariance_of": white_covariance(sigma)} if exact else {}
    pulls = []
    for seed in range(100):
        # Pulls are standard normal if the truth is drawn from the priors.
        rng = np.random.default_rng(seed)
        drawn = {n: p.mean + p.sigma * rng.normal() for n, p in priors.items()}
        data = moved_bands(truth | drawn) + np.asarray(sigma) * rng.normal(size=sigma.shape)
        like = likelihood(sky, BANDS, data, sigma, truth, stokes=stokes, **options)
        found = best_fit(like, truth, priors=priors)
        pulls.append([(found.best_fit[n] - (truth | drawn)[n]) / found.sigma[n] for n in truth])
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 3.5 / np.sqrt(100))
    assert np.all(np.abs(np.std(pulls, axis=0) - 1) < 3.5 / np.sqrt(200))


def test_an_angle_that_was_not_free_is_refused():
    words, start = "'angle.44' must be free in the likelihood already", START | {"angle.44": 0.0}
    raises(ValueError, words, best_fit, fitted(), start)


@pytest.mark.parametrize("pixelwise", [False, True])
def test_gain_offset_and_mask(pixelwise):
    sky, data, sigma = problem()
    mask = np.arange(NPIX) % 3 > 0
    masked = jnp.where(mask, sigma, jnp.inf)
    holes = data.at[:, :, ~mask].set(jnp.nan)
    params = {"gain.70": 1.02, "offset.44.Q": 0.3, "dust.beta_dust": 1.55}
    like = fitted(data=holes, sigma=masked, start=params, pixelwise=pixelwise)
    offset = np.zeros((2, 2, 1))
    offset[0, 0] = 0.3
    expected = papers_chi2(sky, {"dust.beta_dust": 1.55}, data, masked, (1.0, 1.02), offset)
    assert float(chi2(like, params)) == pytest.approx(expected, rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("cmb", [False, True])
def test_exact_covariance_is_the_dense_one(cmb):
    model = fluctuations(cmb)
    rows = jnp.asarray(np.random.default_rng(3).normal(size=(2, 3, 2, NPIX)))
    dense = dense_covariance(cmb)
    flat = scipy.linalg.block_diag(*np.reshape(rows, (2, 3, -1)))
    np.testing.assert_allclose(model.covariance(rows), flat @ dense @ flat.T, rtol=1e-9, atol=1e-9)
    sigma = np.sqrt(np.diag(dense_covariance(False))).reshape(2, 2, NPIX)
    # The map of variances neglects the rotation of Q and U within the kernel and their
    # correlation, which at a beam of 25 degrees is at its worst.
    np.testing.assert_allclose(model.sigma(), sigma, rtol=0.15)


def test_exact_likelihood_is_that_of_the_amplitudes():
    """Against an independent, dense implementation: y = T^T W d, covariance T^T W C W T."""
    sky, data, sigma = problem()
    like = fitted(covariance_of=fluctuations().covariance)
    dense = dense_covariance()
    templates = np.stack([c.amplitude for c in sky.components.values()], axis=1)
    P = scipy.linalg.block_diag(*(templates / sigma[:, :, None] ** 2).reshape(4, 2, NPIX))
    for params in (START, {"dust.beta_dust": 1.2, "synchrotron.beta_syn": 3.7}):
        seen = np.asarray(observe(set_parameters(sky, params), list(BANDS.values())))
        y = P @ (np.asarray(data) - seen).ravel()
        expected = y @ np.linalg.solve(P @ dense @ P.T, y)
        assert float(chi2(like, params)) == pytest.approx(expected, rel=1e-8)


def white_covariance(sigma):
    """Covariance of inner products with data of independent pixels."""

    def covariance_of(rows):
        spread = np.asarray(rows) * np.asarray(sigma)[:, None]
        flat = spread.reshape(*spread.shape[:2], -1)
        return jnp.asarray(scipy.linalg.block_diag(*(own @ own.T for own in flat)))

    return covariance_of


@pytest.mark.parametrize("pixelwise", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "free",
    [
        pytest.param(START, marks=pytest.mark.slow),
        {**START, "offset.44.Q": 0.0, "offset.70.U": 0.0},
    ],
)
def test_with_white_noise_the_two_likelihoods_agree(free, pixelwise):
    exact, diagonal = (
        best_fit(fitted(start=free, covariance_of=c, pixelwise=pixelwise))
        for c in (white_covariance(problem()[2]), None)
    )
    np.testing.assert_allclose(exact.covariance, diagonal.covariance, rtol=1e-6, atol=1e-12)
    for name in free:
        assert exact.best_fit[name] == pytest.approx(diagonal.best_fit[name], abs=1e-6)


@pytest.mark.parametrize("exact", [False, True])
def test_pixel_and_template_paths_agree(exact):
    free = {**START, **MOVED, "dust.T_dust": 21.0, "offset.70.U": 0.0}
    covariance_of = fluctuations().covariance if exact else None
    templates, pixels = (
        fitted(start=free, pixelwise=p, covariance_of=covariance_of) for p in (False, True)
    )
    rng = np.random.default_rng(5)
    for _ in range(3):
        params = {n: v + 0.05 * rng.normal() for n, v in free.items()}
        expected = float(chi2(templates, params))
        assert float(chi2(pixels, params)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("exact", [False, True])
def test_a_constant_map_with_an_offset_is_a_constant(exact):
    mapped = set_parameters(problem()[0], {"dust.beta_dust": jnp.full(NPIX, 1.5)})
    covariance_of = fluctuations().covariance if exact else None
    shift = {"dust.beta_dust.offset": 0.0, "synchrotron.beta_syn": 3.0}
    by_map = fitted(sky=mapped, start=shift, covariance_of=covariance_of)
    by_number = fitted(covariance_of=covariance_of)
    for beta in (1.4, 1.55):
        a = chi2(by_map, {"dust.beta_dust.offset": beta - 1.5, "synchrotron.beta_syn": 3.1})
        b = chi2(by_number, {"dust.beta_dust": beta, "synchrotron.beta_syn": 3.1})
        assert float(a) == pytest.approx(float(b), rel=1e-8)


def test_an_offset_on_a_number_stays_on_inner_products():
    sky, data, sigma = problem()
    like = fitted(start={"dust.beta_dust.offset": 0.1})
    expected = papers_chi2(sky, {"dust.beta_dust": 1.53 + 0.02}, data, sigma)
    assert float(chi2(like, {"dust.beta_dust.offset": 0.02})) == pytest.approx(expected, rel=1e-11)


def test_a_varying_index_is_fitted_pixel_by_pixel():
    beta = systems.spread(1.53, 0.2, NPIX)
    sky = Sky({"dust": Dust(systems.random_maps(3, npix=NPIX), beta)})
    _, data, sigma = problem(sky=sky)
    like = likelihood(sky, BANDS, data, sigma, {"dust.beta_dust.offset": 0.0})
    expected = papers_chi2(sky, {"dust.beta_dust": beta + 0.03}, data, sigma)
    assert float(chi2(like, {"dust.beta_dust.offset": 0.03})) == pytest.approx(expected, rel=1e-9)


EVERYTHING = Sky(
    {
        "dust": Dust(
            systems.random_maps(1, npix=NPIX), (1.67, 2.70), (9.4, 16.2), (0.49, 1.0), 353.0, 3000.0
        ),
        "synchrotron": Synchrotron(systems.random_maps(2, npix=NPIX), 3.1, -0.2, 23.0, 30.0),
        "ame": AME.from_dust_angles(
            jnp.abs(systems.random_maps(4, npix=NPIX)[0]),
            systems.random_maps(1, npix=NPIX),
            nu_ref=22.8,
        ),
    }
)


@pytest.mark.slow
@pytest.mark.parametrize("pixelwise", [False, True])
def test_gradients_against_finite_differences(pixelwise):
    """Every parameter of the sky and of a band, and offsets."""
    sky, data, sigma = problem(sky=EVERYTHING)
    names = [n for n in parameter_names(sky) if not n.endswith(".amplitude")]
    free = {n: float(value) for n, value in get_parameters(sky, names).items()}
    free |= MOVED | {"offset.70.U": 0.1}
    like = likelihood(sky, BANDS, data, 10 * sigma, free, pixelwise=pixelwise)

    @jax.jit
    def value(relative):
        return chi2(like, {n: v * (1 + relative[n]) for n, v in free.items()}) / 1e3

    zero = {name: jnp.zeros(()) for name in free}
    check_grads(value, (zero,), order=1, modes=["fwd", "rev"], rtol=1e-5, atol=1e-5)
    assert all(float(jnp.abs(g)) > 0 for g in jax.grad(value)(zero).values())


@pytest.mark.parametrize(("changes", "error", "words"), cases("likelihood/bad_input"))
def test_bad_input_is_refused(changes, error, words):
    raises(getattr(builtins, error), words, fitted, **changes)


def test_missing_pixels_and_templates_that_are_alike_are_refused():
    hole = np.where(np.arange(NPIX) == 3, -1.6375e30, np.ones((2, 2, NPIX)))
    words = r"`data` has 4 values that are not finite \(or UNSEEN\) in pixels that are used"
    raises(ValueError, words, fitted, data=hole)
    maps = systems.random_maps(1, npix=NPIX)
    alike = Sky({"dust": Dust(maps), "synchrotron": Synchrotron(2 * maps)})
    covariance = fluctuations().covariance
    raises(ValueError, "cannot be told apart", fitted, sky=alike, covariance_of=covariance)


def test_single_precision_is_refused():
    jax.config.update("jax_enable_x64", False)
    try:
        raises(RuntimeError, "fits needs double precision", likelihood, None, [], 0, 0, {})
    finally:
        jax.config.update("jax_enable_x64", True)
