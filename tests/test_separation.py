"""The spectral likelihood against dense linear algebra, finite differences and itself."""

import dataclasses

import healpy
import jax
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from fits.compress import as_noise
from fits.optimize import best_fit
from fits.posterior import Uniform, chi2, fisher_matrix, hessian
from fits.profile_likelihood import spectral_likelihood
from fits.results import FitError
from fits.separated_maps import component_maps, emission_maps, separate
from jaxsky import (
    AME,
    CMB,
    Bandpass,
    Dust,
    Sky,
    Synchrotron,
    get_parameters,
    load_instrument,
    observe,
    set_parameters,
)
from jaxsky.sed import H_OVER_K, T_CMB
from refusals import raises

NPIX = 48
CENTERS = [23.0, 35.0, 60.0, 95.0, 145.0, 220.0, 280.0, 353.0]
BANDS = {f"{c:g}": Bandpass.top_hat(c, 0.25 * c, samples=5) for c in CENTERS}
TRUTH = {"dust.beta_dust": 1.55, "dust.T_dust": 19.5, "synchrotron.beta_syn": 3.05}
START = {"dust.beta_dust": 1.5, "dust.T_dust": 21.0, "synchrotron.beta_syn": 3.0}


def random_sky(stokes: int = 2, npix: int = NPIX, size: float = 30.0, seed: int = 0) -> Sky:
    rng = np.random.default_rng(seed)
    maps = rng.normal(size=(3, stokes, npix)) * size
    return Sky(
        {
            "cmb": CMB(maps[0]),
            "dust": Dust(maps[1], TRUTH["dust.beta_dust"], TRUTH["dust.T_dust"]),
            "synchrotron": Synchrotron(maps[2], TRUTH["synchrotron.beta_syn"]),
        }
    )


def problem(kind: str = "band", stokes: int = 2, sky: Sky | None = None, seed: int = 0):
    """A sky, data, noise as it is given, and the covariance of all values of each pixel."""
    sky = sky or random_sky(stokes)
    rng = np.random.default_rng(seed)
    npix = sky.shape[1]
    shape = (len(BANDS), stokes, npix)
    sigma = np.broadcast_to(rng.uniform(0.5, 1.5, len(BANDS))[:, None, None], shape)
    given = sigma[:, 0, 0]
    if kind == "stokes":
        given = rng.uniform(0.5, 1.5, shape[:2])
        sigma = np.broadcast_to(given[..., None], shape)
    if kind == "separable":
        given = sigma = sigma * rng.uniform(0.5, 1.5, npix)
    if kind in ("full", "covariance"):
        given = sigma = rng.uniform(0.5, 1.5, shape)
    dense = np.zeros((npix, *shape[:2], *shape[:2]))
    for b in range(len(BANDS)):
        for s in range(stokes):
            dense[:, b, s, b, s] = sigma[b, s] ** 2
    if kind == "covariance":
        QU = rng.uniform(-0.8, 0.8, (len(BANDS), npix)) * sigma[:, 0] * sigma[:, 1]
        for b in range(len(BANDS)):
            dense[:, b, 0, b, 1] = dense[:, b, 1, b, 0] = QU[b]
        given = np.stack([np.stack([sigma[:, 0] ** 2, QU], 1), np.stack([QU, sigma[:, 1] ** 2], 1)])
        given = given.transpose(1, 0, 2, 3)
    dense = dense.reshape(npix, shape[0] * stokes, -1)
    noise = np.einsum("pij,pj->pi", np.linalg.cholesky(dense), rng.normal(size=dense.shape[:2]))
    data = np.asarray(observe(sky, list(BANDS.values())))
    return sky, data + noise.T.reshape(shape), given, dense


def law(name, nu, params):
    """The laws once more, in a form that complex arguments go through."""
    if name == "cmb":
        x = H_OVER_K * nu / T_CMB
        return x**2 * np.exp(x) / np.expm1(x) ** 2
    if name == "synchrotron":
        return (nu / 30.0) ** -params["synchrotron.beta_syn"]
    beta, T = params["dust.beta_dust"], params["dust.T_dust"]
    planck = [np.exp(H_OVER_K * f / T) - 1 for f in (nu, 353.0)]
    return (nu / 353.0) ** (beta + 1) * planck[1] / planck[0]


def dense_matrix(params, stokes=2):
    """(band stokes, component stokes), with the rotation of bands."""
    full = START | params
    total = np.zeros((len(BANDS), stokes, 3, stokes), complex)
    for b, (label, band) in enumerate(BANDS.items()):
        nu = np.asarray(band.nu)
        center = np.dot(band.quadrature, nu)
        nu = center + full.get(f"width.{label}", 1.0) * (nu - center)
        nu = nu + full.get(f"shift.{label}", 0.0) * center
        steps = np.array([1, 2, 2, 2, 1]) / 8
        turn = np.eye(stokes, dtype=complex)
        angle = full.get(f"angle.{label}", 0.0) * np.pi / 90
        turn[-2:, -2:] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        for c, name in enumerate(("cmb", "dust", "synchrotron")):
            value = np.sum(steps * law(name, nu, full)) * full.get(f"gain.{label}", 1.0)
            total[b, :, c] = value * turn
    return total.reshape(len(BANDS) * stokes, -1)


def dense(data, covariance, params):
    """-2 ln L, amplitudes and their covariance, pixel by pixel."""
    value, amplitudes, errors = 0.0, [], []
    M = dense_matrix(params, data.shape[1]).real
    for p in range(data.shape[-1]):
        d, W = data[..., p].ravel(), np.linalg.inv(covariance[p])
        inverse = np.linalg.inv(M.T @ W @ M)
        amplitudes.append(inverse @ M.T @ W @ d)
        errors.append(inverse)
        value += d @ W @ d - (M.T @ W @ d) @ amplitudes[-1]
    return value, np.array(amplitudes), np.array(errors)


def dense_fisher(data, covariance, params):
    _, amplitudes, _ = dense(data, covariance, params)
    M = dense_matrix(params, data.shape[1]).real
    slopes = []
    for name in sorted(params):
        step = params | {name: params[name] + 1e-30j}
        slopes.append(dense_matrix(step, data.shape[1]).imag / 1e-30)
    total = 0.0
    for s, N in zip(amplitudes, covariance, strict=True):
        W = np.linalg.inv(N)
        Q = W - W @ M @ np.linalg.inv(M.T @ W @ M) @ M.T @ W
        v = np.array([slope @ s for slope in slopes])
        total = total + v @ Q @ v.T
    return total


TURNED = START | {"angle.95": 1.5, "gain.145": 1.02, "shift.220": 0.01, "width.220": 1.1}


@pytest.mark.parametrize(
    ("kind", "stokes", "params"),
    [
        ("stokes", 3, START),
        pytest.param("separable", 3, TURNED, marks=pytest.mark.slow),
        pytest.param("covariance", 2, TURNED, marks=pytest.mark.slow),
    ],
)
def test_value_amplitudes_and_fisher_are_the_dense_ones(kind, stokes, params):
    _, data, given, covariance = problem(kind, stokes)
    like = spectral_likelihood(random_sky(stokes), BANDS, data, given, params)
    assert like.pixels[0].data.shape[-1] < NPIX or kind in ("full", "covariance")
    value, amplitudes, errors = dense(data, covariance, params)
    assert float(chi2(like, params)) == pytest.approx(value, rel=1e-8)
    expected = dense_fisher(data, covariance, params)
    scale = np.sqrt(np.diag(expected))
    scale = np.outer(scale, scale)
    np.testing.assert_allclose(fisher_matrix(like, params) / scale, expected / scale, atol=1e-8)
    maps = component_maps(like, params, data, given)
    found = amplitudes.reshape(NPIX, 3, stokes).transpose(1, 2, 0)
    np.testing.assert_allclose(maps.amplitude, found, rtol=1e-8, atol=1e-8)
    variances = np.einsum("pii->ip", errors).reshape(3, stokes, NPIX)
    spread = np.stack([np.broadcast_to(maps.sigma(c), (stokes, NPIX)) for c in maps.components])
    np.testing.assert_allclose(spread**2, variances, rtol=1e-8)
    assert maps.chi2.sum() == pytest.approx(value, rel=1e-8)
    assert np.all(maps.dof == (len(BANDS) - 3) * stokes)
    rest = data - emission_maps(like, params, maps.amplitude)
    M = dense_matrix(params, stokes).real
    expected = data.reshape(-1, NPIX) - M @ amplitudes.T
    np.testing.assert_allclose(rest.reshape(-1, NPIX), expected, atol=1e-9)
    W = np.linalg.inv(covariance)
    for s in range(stokes):
        alone = 1 / np.einsum("i,pij,j->p", M[:, s], W, M[:, s])
        ratio = maps.degradation("cmb")[s]
        np.testing.assert_allclose(ratio**2, (variances[0, s] / alone)[: ratio.size], rtol=1e-8)


@pytest.mark.parametrize("kind", ["band", "full"])
def test_the_maximum_is_that_of_the_dense_likelihood(kind):
    _, data, given, covariance = problem(kind)
    like = spectral_likelihood(random_sky(), BANDS, data, given, START)
    fit = best_fit(like)

    def objective(theta):
        return dense(data, covariance, dict(zip(sorted(START), theta, strict=True)))[0]

    # The gradient of the dense value, by extrapolated differences, vanishes at the fit.
    for i, name in enumerate(fit.free):
        theta = np.array([fit.best_fit[n] for n in fit.free])
        step = np.zeros(3)
        step[i] = 0.02 * fit.sigma[name]
        slopes = [(objective(theta + h * step) - objective(theta - h * step)) / h for h in (1, 2)]
        assert abs((4 * slopes[0] - slopes[1]) / 3) < 1e-5
    assert objective(theta) == pytest.approx(fit.chi2, rel=1e-8)
    other = scipy.optimize.minimize(objective, list(fit.best_fit.values()), method="Nelder-Mead")
    assert other.fun >= fit.chi2 * (1 - 1e-10)
    for name, value in TRUTH.items():
        assert abs(fit.best_fit[name] - value) < 4 * fit.sigma[name]


EVERY_LAW = {
    "ame": AME(np.ones((2, 1)), m60=4.0, nu_max=25.0),
    "cmb": CMB(np.ones((2, 1))),
    "dust": Dust(np.ones((2, 1)), (1.6, 2.4), (12.0, 19.0), (0.4, 1.0)),
    "synchrotron": Synchrotron(np.ones((2, 1)), 3.0, -0.05),
}
LAW_PARAMETERS = {
    "ame.m60": 4.0,
    "ame.nu_max": 25.0,
    "cmb.T_cmb": 2.7,
    "dust.beta_dust.0": 1.6,
    "dust.T_dust.1": 19.0,
    "dust.E_dust.1": 1.0,
    "dust.nu_pivot": 3000.0,
    "synchrotron.beta_syn": 3.0,
    "synchrotron.curvature": -0.05,
    "synchrotron.nu_piv": 23.0,
    "shift.145": 0.01,
    "width.220": 1.05,
    "gain.95": 1.01,
}
BAND_PARAMETERS = {"dust.beta_dust.0": 1.6, "gain.95": 1.1, "angle.60": 0.7, "shift.145": 0.01}


def total(theta, like):
    return like.total(theta[like.index])


slope = jax.jit(jax.grad(total))
value_and_slope = jax.jit(jax.value_and_grad(total))
chi2_slope = jax.jit(jax.grad(lambda params, like: chi2(like, params)))


def check_derivatives(like):
    """The slope and the Hessian against finite differences."""
    theta = np.array(like.flat({}))
    gradient = value_and_slope(theta, like)[1]
    curvature = 2 * hessian(like, {})
    scale = np.sqrt(np.abs(np.diag(curvature)))
    for i, name in enumerate(like.free):
        step = np.zeros(theta.size)
        step[i] = 1e-4 * max(abs(theta[i]), 0.1)
        steps = [value_and_slope(theta + k * step, like) for k in (-2, -1, 1, 2)]
        first, second = (
            np.array([1, -8, 8, -1]) / 12 @ np.array(x) for x in zip(*steps, strict=True)
        )
        found = float(gradient[i] * step[i])
        assert found != 0
        assert found == pytest.approx(first, rel=1e-6, abs=1e-6), name
        second = second / scale
        np.testing.assert_allclose(
            curvature[i] * step[i] / scale, second, atol=1e-5 * np.abs(second).max()
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "names", "params"),
    [("band", list(EVERY_LAW), LAW_PARAMETERS), ("covariance", ["cmb", "dust"], BAND_PARAMETERS)],
)
def test_derivatives_in_every_parameter_are_finite_differences(kind, names, params):
    _, data, given, _ = problem(kind)
    sky = {name: EVERY_LAW[name] for name in names}
    check_derivatives(spectral_likelihood(sky, BANDS, data, given, params, unit="uK_CMB"))


@pytest.mark.parametrize(
    ("kind", "params"), [("band", START), pytest.param("separable", TURNED, marks=pytest.mark.slow)]
)
def test_compressed_and_pixel_likelihoods_are_one(kind, params):
    _, data, given, _ = problem(kind, 3)
    mask = np.ones(NPIX)
    mask[:9] = np.inf
    noise = as_noise(given, data.shape, mask) if kind == "band" else given
    small, large = (
        spectral_likelihood(random_sky(3), BANDS, data, noise, params, compress=c)
        for c in (True, False)
    )
    for shift in (0.0, 0.02):
        moved = {name: value + shift for name, value in params.items()}
        assert float(chi2(small, moved)) == pytest.approx(float(chi2(large, moved)), rel=1e-11)
        slopes = [slope(like.flat(moved), like) for like in (small, large)]
        np.testing.assert_allclose(*slopes, rtol=1e-8)
    if kind == "band":
        # What the residuals' own derivative says, through all of the algebra.
        other = chi2_slope(large.check(moved), large)
        np.testing.assert_allclose(large.flat(other), slopes[1], rtol=1e-8)
    assert small.values == large.values
    assert small.values == (NPIX - 9 * (kind == "band")) * 3 * 5


def test_derivatives_in_data_and_weights():
    _, data, given, _ = problem("covariance")
    like = spectral_likelihood(random_sky(), BANDS, data, given, START)

    @jax.jit
    def value(factor):
        pixels = tuple(jax.tree.map(lambda x: x * factor, p) for p in like.pixels)
        return dataclasses.replace(like, pixels=pixels).total(like.flat({})[like.index])

    assert float(jax.grad(value)(1.0)) == pytest.approx(3 * float(value(1.0)), rel=1e-10)


@pytest.mark.parametrize("kind", ["band", "full"])
def test_order_of_pixels_bands_and_components_does_not_matter(kind):
    sky, data, given, _ = problem(kind)
    fit = best_fit(spectral_likelihood(sky, BANDS, data, given, START))
    rng = np.random.default_rng(4)
    pixels, order = rng.permutation(NPIX), rng.permutation(len(BANDS))
    noise = given[order] if kind == "band" else given[order][..., pixels]
    bands = {list(BANDS)[i]: BANDS[list(BANDS)[i]] for i in order}
    renamed = {"z": sky["cmb"], "b": sky["synchrotron"], "a": sky["dust"]}
    start = {"a.beta_dust": 1.5, "a.T_dust": 21.0, "b.beta_syn": 3.0}
    again = best_fit(spectral_likelihood(renamed, bands, data[order][..., pixels], noise, start))
    for one, other in zip(fit.free, ("a.T_dust", "a.beta_dust", "b.beta_syn"), strict=True):
        assert again.best_fit[other] == pytest.approx(fit.best_fit[one], rel=1e-8)
        assert again.sigma[other] == pytest.approx(fit.sigma[one], rel=1e-6)


@pytest.mark.parametrize("unit", ["K_RJ", "mK_CMB"])
def test_units_of_the_maps_do_not_matter(unit):
    sky, data, given, _ = problem()
    fit = best_fit(spectral_likelihood(sky, BANDS, data, given, START))
    factors = np.array([float(b.conversion("uK_RJ", unit)) for b in BANDS.values()])
    data, given = data * factors[:, None, None], given * factors
    like = spectral_likelihood(sky, BANDS, data, given, START, unit=unit)
    again = best_fit(like)
    np.testing.assert_allclose(like.flat(again.best_fit), like.flat(fit.best_fit), rtol=1e-8)
    np.testing.assert_allclose(again.covariance, fit.covariance, rtol=1e-6, atol=1e-12)
    maps = component_maps(like, again.best_fit, data, given)
    expected = np.asarray(sky["cmb"].amplitude)
    assert np.abs(maps.map("cmb") - expected).max() < 6 * maps.sigma("cmb").max()


def test_a_band_in_K_CMB_is_calibrated_on_the_CMB():
    sky, data, given, _ = problem()
    moved = START | {"shift.220": 0.03, "width.145": 1.2}
    in_cmb, in_rj = (
        np.asarray(like.mixing.one(like.check({})))
        for unit in ("uK_CMB", "uK_RJ")
        for like in [spectral_likelihood(sky, BANDS, data, given, moved, unit=unit)]
    )
    np.testing.assert_allclose(in_cmb[:, 0], 1, rtol=1e-12)
    np.testing.assert_allclose(in_cmb, in_rj / in_rj[:, :1], rtol=1e-12)


@pytest.mark.slow
def test_uniform_priors_bound_the_fit_and_edges_are_reported():
    sky, data, given, _ = problem()
    like = spectral_likelihood(sky, BANDS, data, given, START)
    T = best_fit(like).best_fit["dust.T_dust"]
    wide = best_fit(like, priors={"dust.T_dust": Uniform(10.0, 40.0)})
    assert wide.best_fit["dust.T_dust"] == pytest.approx(T, rel=1e-8)
    above_start = {"dust.T_dust": T + 2}
    above = {"dust.T_dust": Uniform(T + 0.05, 40.0)}
    with pytest.raises(FitError, match=r"'dust.T_dust' lies at the edge .* of its uniform prior"):
        best_fit(like, above_start, priors=above)
    kept = best_fit(like, above_start, priors=above, throw=False)
    for solver in (optx.LevenbergMarquardt(1e-10, 1e-8), optx.BFGS(1e-10, 1e-8)):
        other = best_fit(like, above_start, priors=above, solver=solver, throw=False)
        assert other.message == kept.message
        # Flat there, and residuals say nothing of how it curves.
        assert other.best_fit["dust.T_dust"] == pytest.approx(T + 0.05, abs=1e-6)
        for name in ("dust.beta_dust", "synchrotron.beta_syn"):
            assert abs(other.best_fit[name] - kept.best_fit[name]) < 1e-5 * kept.sigma[name]
            assert other.sigma[name] == pytest.approx(kept.sigma[name], rel=1e-6)
    assert kept.best_fit["dust.T_dust"] == pytest.approx(T + 0.05, rel=1e-12)
    cold = {name: sky[name] for name in sky} | {"dust": Dust(sky["dust"].amplitude, 1.5, T + 0.05)}
    free = {n: START[n] for n in ("dust.beta_dust", "synchrotron.beta_syn")}
    fixed = best_fit(spectral_likelihood(cold, BANDS, data, given, free))
    assert kept.best_fit["dust.beta_dust"] == pytest.approx(
        fixed.best_fit["dust.beta_dust"], rel=1e-8
    )
    assert kept.sigma["dust.beta_dust"] == pytest.approx(fixed.sigma["dust.beta_dust"], rel=1e-6)
    with pytest.raises(ValueError, match=r"Start value 21 of 'dust.T_dust' is not inside"):
        best_fit(like, priors={"dust.T_dust": Uniform(30.0, 40.0)})


def test_separate_is_fit_and_component_maps_in_one_call():
    """Laws by name, start values by default and noise of the instrument, against each step."""
    channels = ["40", "50", "78", "119", "195", "280", "337", "402"]
    instrument = load_instrument("litebird", channels, samples=5)
    bands, ones = instrument.bands(), np.ones((2, 1))
    laws = {"cmb": CMB(ones), "dust": Dust(ones), "synchrotron": Synchrotron(ones)}
    rng, names = np.random.default_rng(3), ["dust.beta_dust", "synchrotron.beta_syn"]
    truth = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}
    maps = {name: rng.normal(size=(2, NPIX)) * 30 for name in laws}
    sky = Sky({name: type(one)(maps[name]) for name, one in laws.items()})
    factors = np.array([band.conversion("uK_RJ", "uK_CMB") for band in bands.values()])
    seen = observe(set_parameters(sky, truth), list(bands.values())) * factors[:, None, None]
    levels = np.array([c.noise for c in instrument.values()]) * factors
    levels /= healpy.nside2resol(2, arcmin=True)
    data = seen + levels[:, None, None] * rng.normal(size=seen.shape)
    found = separate(list(laws), instrument, data)
    assert found.fit.free == tuple(names)
    for name, value in truth.items():
        assert abs(found.fit.best_fit[name] - value) < 4 * found.fit.sigma[name]
    start = get_parameters(sky, names)
    like = spectral_likelihood(laws, bands, data, levels, start, unit="uK_CMB")
    fit = best_fit(like)
    assert found.fit.best_fit == pytest.approx(fit.best_fit)
    expected = component_maps(like, fit.best_fit, data, levels).amplitude
    np.testing.assert_allclose(found.maps.amplitude, expected)
    raises(ValueError, "`noise` is missing", separate, laws, bands, data)
    raises(ValueError, "there is no law 'stars'", separate, ["stars"], instrument, data)
    intensity = np.concatenate([data[:, :1], data], axis=1)
    more = [*laws, "free_free"]
    again = separate(more, bands, intensity, {"dust.beta_dust": 1.5}, noise=levels)
    assert again.fit.free == ("dust.beta_dust",)
    assert again.maps.components == ("cmb", "dust", "free_free", "synchrotron")
