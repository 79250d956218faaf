"""Component separation in multipoles against dense algebra, finite differences and simulations."""

import dataclasses

import healpy
import jax
import numpy as np
import pytest
import scipy.stats

from fits.multipoles import harmonic_coefficients, harmonic_likelihood, white_spectrum
from fits.optimize import best_fit
from fits.posterior import Gaussian, chi2, fisher_matrix
from fits.profile_likelihood import spectral_likelihood
from fits.separated_maps import harmonic_component_maps
from jaxsky import Dust
from jaxsky import harmonics as h
from jaxsky.noise import uniform_alm
from refusals import cases, raises
from test_separation import BANDS, START, TRUTH, check_derivatives, dense_matrix, random_sky

#: Most tests have the shapes of each other, so that programs are compiled once.
NSIDE, LMAX = 8, 16
SKY = {stokes: random_sky(stokes, npix=1) for stokes in (2, 3)}
FWHM = np.array([600.0, 500.0, 400.0, 300.0, 250.0, 200.0, 170.0, 150.0])
#: Its first band is lost beyond l = 12.
WIDE = np.where(np.arange(8) == 0, 3000.0, 1.5 * FWHM)
LEVEL = np.linspace(60.0, 20.0, 8)
LEVELS = white_spectrum(LEVEL)
TURNED = START | {"angle.95": 1.5, "gain.145": 1.02, "shift.220": 0.01}


def windows(fwhm, lmax):
    return np.stack([np.asarray(h.gaussian_beam(each, lmax)) for each in fwhm])


def components(stokes=2, lmax=LMAX, seed=0):
    """Amplitudes of cmb, dust and synchrotron; no polarization below l = 2."""
    rng = np.random.default_rng(seed)
    ell = h.alm_ell(lmax)
    return rng.normal(size=(3, stokes, ell.size)) * np.where(ell < 2, 0, 10 / (ell + 1.0))


def observed(amplitudes, fwhm, params=TRUTH):
    stokes = amplitudes.shape[1]
    lmax = int(np.sqrt(amplitudes.shape[-1])) - 1
    matrix = dense_matrix(params, stokes).real.reshape(len(BANDS), stokes, 3, stokes)
    alm = np.einsum("bsct,ctn->bsn", matrix, amplitudes)
    return alm * windows(fwhm, lmax)[:, None, h.alm_ell(lmax)]


@jax.jit
def total(like, params):
    return chi2(like, params)


def problem(stokes=2, lmax=LMAX, fwhm=FWHM, kind="band", seed=0):
    """Coefficients with noise, its spectra as they are given, and in full."""
    rng = np.random.default_rng(seed)
    ell = h.alm_ell(lmax)
    spectra = np.broadcast_to(LEVELS[:, None, None], (8, stokes, lmax + 1))
    given = spectra[:, 0, 0]
    if kind == "stokes":
        spectra = spectra * rng.uniform(0.5, 1.5, (8, stokes, 1))
        given = spectra[..., 0]
    if kind == "ell":
        given = spectra = spectra * rng.uniform(0.5, 1.5, spectra.shape)
    noise = np.sqrt(spectra[..., ell]) * (ell > 1) * rng.normal(size=(8, stokes, ell.size))
    return observed(components(stokes, lmax), fwhm) + noise, given, spectra


def dense(alm, spectra, window, params):
    """-2 ln L for each l, amplitudes, their variance, and the Fisher matrix, by loops over l, m."""
    lmax, stokes = window.shape[1] - 1, alm.shape[1]
    harmonics = h.alm_to_healpy(alm, lmax)
    names = sorted(params)
    steps = [dense_matrix(params | {n: params[n] + 1e-30j}, stokes).imag / 1e-30 for n in names]
    M = dense_matrix(params, stokes).real
    value, information = np.zeros(lmax + 1), np.zeros((len(names), len(names)))
    amplitudes = np.zeros((3 * stokes, harmonics.shape[-1]), complex)
    variance = np.zeros((3 * stokes, lmax + 1))
    for ell in range(2, lmax + 1):
        beam = np.repeat(window[:, ell], stokes)
        W = np.diag(np.where(beam > 1e-5, 1 / spectra[..., ell].ravel(), 0))
        A = beam[:, None] * M
        inverse = np.linalg.inv(A.T @ W @ A)
        Q = W - W @ A @ inverse @ A.T @ W
        variance[:, ell] = np.diag(inverse)
        for m in range(ell + 1):
            at = healpy.Alm.getidx(lmax, ell, m)
            d, twice = harmonics[..., at].ravel(), 1 + (m > 0)
            s = inverse @ A.T @ W @ d
            slopes = np.array([beam * (step @ s) for step in steps])
            amplitudes[:, at] = s
            value[ell] += twice * (d.conj() @ Q @ d).real
            information += twice * (slopes.conj() @ Q @ slopes.T).real
    return value, amplitudes.reshape(3, stokes, -1), variance.reshape(3, stokes, -1), information


@pytest.mark.parametrize(
    ("kind", "stokes", "params", "fwhm"),
    [
        ("band", 2, START, FWHM),
        pytest.param("stokes", 3, START, WIDE, marks=pytest.mark.slow),
        pytest.param("ell", 3, TURNED, WIDE, marks=pytest.mark.slow),
    ],
)
def test_value_amplitudes_and_fisher_are_the_dense_ones(kind, stokes, params, fwhm):
    alm, given, spectra = problem(stokes, fwhm=fwhm, kind=kind)
    window = windows(fwhm, LMAX)
    value, amplitudes, variance, information = dense(alm, spectra, window, params)
    like = harmonic_likelihood(SKY[stokes], BANDS, alm, given, params, beams=fwhm)
    assert float(total(like, params)) == pytest.approx(value.sum(), rel=1e-8)
    scale = np.sqrt(np.outer(np.diag(information), np.diag(information)))
    np.testing.assert_allclose(fisher_matrix(like, params) / scale, information / scale, atol=1e-8)
    maps = harmonic_component_maps(like, params, alm, given, beams=window)
    found = h.alm_to_healpy(maps.amplitude, LMAX)
    np.testing.assert_allclose(found, amplitudes, atol=1e-8 * np.abs(amplitudes).max())
    for i, name in enumerate(maps.components):
        np.testing.assert_allclose(maps.noise(name)[:, 2:], variance[i, :, 2:], rtol=1e-8)
    assert np.isnan(maps.covariance[..., :2]).all()
    np.testing.assert_allclose(maps.chi2[2:], value[2:], rtol=1e-8)
    ell = np.arange(2, LMAX + 1)
    used = (window[:, 2:] > 1e-5).sum(axis=0)
    assert (used < 8).any() == (kind != "band")
    np.testing.assert_array_equal(maps.dof[2:], (2 * ell + 1) * stokes * (used - 3))
    assert like.values == maps.dof[2:].sum()
    np.testing.assert_allclose(
        maps.probability[2:], scipy.stats.chi2.sf(value[2:], maps.dof[2:]), rtol=1e-6, atol=1e-12
    )


@pytest.mark.slow
def test_derivatives_are_finite_differences():
    alm, given, _ = problem(3, fwhm=WIDE, kind="ell")
    check_derivatives(harmonic_likelihood(SKY[3], BANDS, alm, given, TURNED, beams=WIDE))


def test_without_beams_it_is_the_likelihood_of_the_pixels():
    alm, given, _ = problem(fwhm=0 * FWHM)
    maps = np.stack([np.asarray(h.synthesis(each, NSIDE)) for each in alm])
    coefficients = harmonic_coefficients(maps)
    # Analysis at nside 8 has errors of 1e-5 at 2 nside.
    np.testing.assert_allclose(coefficients, alm, atol=5e-5 * alm.std(axis=-1).max())
    pixels = spectral_likelihood(
        SKY[2], BANDS, maps, np.sqrt(given / healpy.nside2pixarea(NSIDE)), START
    )
    harmonic = harmonic_likelihood(SKY[2], BANDS, coefficients, given, START, beams=0 * FWHM)
    # Sums of squares over pixels are integrals to 1e-3, as good as HEALPix without weights.
    for shift in (0.0, 0.05):
        moved = {name: value + shift for name, value in TRUTH.items()}
        ratio = float(total(pixels, moved)) / float(total(harmonic, moved))
        assert ratio == pytest.approx(1, abs=2e-3)
    one, other = best_fit(pixels), best_fit(harmonic)
    for name in one.free:
        assert abs(one.best_fit[name] - other.best_fit[name]) < 0.03 * one.sigma[name]
        assert other.sigma[name] == pytest.approx(one.sigma[name], rel=2e-3)
    # The laws of either serve for the maps.
    made = [
        harmonic_component_maps(like, TRUTH, coefficients, given, beams=0 * FWHM)
        for like in (pixels, harmonic)
    ]
    np.testing.assert_allclose(made[0].amplitude, made[1].amplitude, atol=1e-12)


def test_beams_of_the_bands_are_taken_out():
    truth = components()
    alm = observed(truth, WIDE)
    coefficients = harmonic_coefficients([np.asarray(h.synthesis(each, NSIDE)) for each in alm])
    given = LEVELS
    for data, tolerance in ((alm, 1e-9), (coefficients, 1e-6)):
        like = harmonic_likelihood(SKY[2], BANDS, data, given, START, beams=WIDE)
        fit = best_fit(like)
        for name, value in TRUTH.items():
            assert fit.best_fit[name] == pytest.approx(value, rel=tolerance)
    made = harmonic_component_maps(like, fit.best_fit, data, given, beams=WIDE)
    assert made.chi2[2:].max() < 1e-6
    window = h.gaussian_beam(900.0, 8)
    for found in (made.maps(4, 900.0), made.maps(4, window)):
        for one, whole in zip(found, truth, strict=True):
            expected = np.asarray(h.synthesis(h.resize(whole, 8) * h.expand(window), 4))
            np.testing.assert_allclose(one, expected, atol=1e-5 * expected.std())
    # As if all had the same beam, the law of the bands with the widest is off by 180 sigma.
    same = harmonic_likelihood(SKY[2], BANDS, alm, given, START, beams=0 * WIDE)
    ignored = best_fit(same, throw=False)
    assert not ignored.converged
    assert "does not describe the data" in ignored.message
    name = "synchrotron.beta_syn"
    assert abs(ignored.best_fit[name] - TRUTH[name]) > 100 * ignored.sigma[name]


def test_parameters_of_bands_are_found():
    truth = TRUTH | {"angle.95": -2.0, "gain.145": 1.03, "shift.220": -0.02}
    alm = observed(components(3), WIDE, truth)
    noise = np.broadcast_to(LEVELS[:, None, None], (8, 3, LMAX + 1))
    like = harmonic_likelihood(SKY[3], BANDS, alm, noise, TURNED, beams=WIDE)
    fit = best_fit(like, priors={"synchrotron.beta_syn": Gaussian(3.05, 0.1)})
    for name, value in truth.items():
        assert fit.best_fit[name] == pytest.approx(value, rel=1e-8, abs=1e-8)


@pytest.mark.slow
def test_estimates_scatter_as_they_say():
    number, truth = 200, components()
    signal, given = observed(truth, FWHM), LEVELS
    pulls, power = [], 0.0
    draw = jax.jit(jax.vmap(lambda key, level: uniform_alm(key, level, LMAX)))
    for seed in range(number):
        data = signal + draw(jax.random.split(jax.random.key(seed), 8), LEVEL)
        like = harmonic_likelihood(SKY[2], BANDS, data, given, START, beams=FWHM)
        fit = best_fit(like, TRUTH)
        pulls.append([(fit.best_fit[n] - TRUTH[n]) / fit.sigma[n] for n in fit.free])
        made = harmonic_component_maps(like, TRUTH, data, given, beams=FWHM)
        power = power + np.asarray(h.power_spectrum(made.map("cmb") - truth[0]))
    mean, scatter = np.mean(pulls, axis=0), np.std(pulls, axis=0)
    # Statistical errors of mean and scatter are 0.07 and 0.05; 2000 simulations have 0.05 and 1.01.
    assert np.all(np.abs(mean) < 0.15 + 0.07)
    assert np.all(np.abs(scatter - 1) < 0.1 + 0.05)
    ell = np.arange(2, LMAX + 1)
    ratio = power[:, 2:] / number / made.noise("cmb")[:, 2:]
    deviation = (ratio - 1) / np.sqrt(2 / (2 * ell + 1) / number)
    assert np.abs(deviation).max() < 4
    assert scipy.stats.chi2.sf(np.sum(deviation**2), deviation.size) > 1e-3


def test_bands_without_weight_and_multipoles_that_are_cut():
    alm, _, spectra = problem(2, 20)
    noise = spectra * np.linspace(0.5, 1.5, 21)
    noise[3] = np.inf
    whole = harmonic_likelihood(SKY[2], BANDS, alm, noise, START, beams=FWHM, lmin=4, lmax=18)
    keep = np.arange(8) != 3
    rest = {name: BANDS[name] for name, kept in zip(BANDS, keep, strict=True) if kept}
    cut = np.array(h.resize(alm, 18))[keep]
    cut[..., h.alm_ell(18) < 4] = 1e3
    alone = harmonic_likelihood(
        SKY[2], rest, cut, noise[keep], START, beams=windows(FWHM, 20)[keep], lmin=4
    )
    assert float(total(whole, START)) == pytest.approx(float(total(alone, START)), rel=1e-12)
    assert whole.values == alone.values == 2 * 4 * (19**2 - 4**2)
    maps = harmonic_component_maps(whole, START, alm, noise, beams=FWHM, lmin=4, lmax=18)
    assert maps.amplitude.shape == (3, 2, 19**2)
    assert not maps.amplitude[..., h.alm_ell(18) < 4].any()
    assert maps.chi2[4:].sum() == pytest.approx(float(total(alone, START)), rel=1e-12)


def test_units_of_the_coefficients_do_not_matter():
    alm, given, _ = problem()
    factors = np.array([float(b.conversion("uK_RJ", "mK_CMB")) for b in BANDS.values()])
    in_mK = alm * factors[:, None, None]
    values = [
        float(total(harmonic_likelihood(SKY[2], BANDS, d, n, START, beams=FWHM, unit=u), START))
        for d, n, u in ((alm, given, "uK_RJ"), (in_mK, given * factors**2, "mK_CMB"))
    ]
    assert values[0] == pytest.approx(values[1], rel=1e-10)


def test_levels_are_those_of_simulated_noise():
    power = h.power_spectrum(uniform_alm(jax.random.key(0), 3.0, 200))[:, 2:]
    weights = 2 * np.arange(2, 201) + 1
    ratio = np.average(power, axis=1, weights=weights) / white_spectrum(3.0)
    np.testing.assert_allclose(ratio, 1, atol=4 * np.sqrt(2 / weights.sum()))


def test_maps_of_bands_may_differ_in_resolution():
    alm = components(3, 8)
    maps = [np.asarray(h.synthesis(alm[0], n), np.float32) for n in (8, 16)]
    found = harmonic_coefficients(maps, 8)
    assert found.shape == (2, 3, 81)
    assert found.dtype == float
    for each in found:
        np.testing.assert_allclose(each, alm[0], atol=1e-5 * alm.std())


GOOD = np.random.default_rng(0).normal(size=(8, 2, 12 * 4**2))


@pytest.mark.parametrize(("change", "lmax", "message"), cases("separation_harmonic/maps_of_a_part"))
def test_maps_of_a_part_of_the_sky_are_refused(change, lmax, message):
    maps = GOOD.copy()
    maps[3, :, 5:7] = change
    raises(ValueError, message, harmonic_coefficients, maps, lmax)


@pytest.mark.parametrize(
    "maps",
    [
        GOOD[..., :-1],
        GOOD[..., :108],
        GOOD[:, :0],
        GOOD[0],
        [GOOD[0], GOOD[0, 0]],
        [GOOD[0], GOOD[0, :, :-1]],
        [],
    ],
)
def test_arrays_that_are_no_maps_are_refused(maps):
    raises(ValueError, r"`maps` must have shape \(band, stokes, pix\)", harmonic_coefficients, maps)


ALM = components(2, 6)[:1].repeat(8, axis=0)
NAN = np.where(np.arange(49) == 20, np.nan, ALM)
LATE = np.where(np.arange(7) < 5, 1.0, np.where(np.arange(8) < 6, 1e-6, 1.0)[:, None])
REST = np.ones((8, 2, 7))
REST[:6, 1, 6] = np.inf
MAP = {"dust": Dust(np.ones((2, 3)), np.array([1.5, 1.6, 1.7]))}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alm": GOOD}, r"`alm` must have shape .* as from `harmonic_coefficients`, but .*192\)"),
        ({"alm": ALM[:7]}, r"with 8 bands .* but has shape \(7, 2, 49\)"),
        ({"alm": ALM[:, :0]}, r"rows I, or E, B, or I, E, B"),
        ({"alm": NAN}, r"`alm` has 16 of 784 values that are not finite"),
        ({"noise": np.ones(7)}, r"`noise` must have shape \(8,\), .* but has shape \(7,\)"),
        ({"noise": REST[..., :6]}, r"`noise` must have shape .* l = 0 to 6 or above"),
        ({"noise": np.arange(8.0)}, r"`noise` has 1 of 8 values that are not > 0"),
        ({"noise": REST}, r"At l = 6 only 2 of 8 bands are left for 3 components"),
        ({"beams": FWHM[:4]}, r"`beams` must have shape \(8,\), .* but has shape \(4,\)"),
        ({"beams": LATE[:, :6]}, r"tables b_l from l = 0 to 6 or above, but has shape \(8, 6\)"),
        ({"beams": -FWHM}, r"`beams` must not be negative, but has -600 arcmin"),
        ({"beams": FWHM * np.nan}, r"`beams` has 8 of 8 values that are not finite"),
        ({"beams": LATE}, r"At l = 5 only 2 of 8 bands are left for 3 components, .* `lmax`"),
        ({"lmin": 1}, r"2 <= lmin <= lmax <= 6, .* but are 1 and 6"),
        ({"lmax": 7}, r"2 <= lmin <= lmax <= 6, .* but are 2 and 7"),
        ({"lmin": 5, "lmax": 4}, r"but are 5 and 4"),
        ({"sky": MAP, "start": {}}, r"'dust.beta_dust' is a map of 3 pixels, but .* be a number"),
        ({"unit": "MJy/sr"}, r"`unit` must be one of K_RJ or K_CMB"),
    ],
)
def test_bad_input_of_the_likelihood(change, message):
    given = {"alm": ALM, "noise": np.ones(8), "beams": FWHM, "sky": SKY[2], "start": START}
    given |= change
    first = [given.pop(name) for name in ("sky", "alm", "noise", "start")]
    raises(ValueError, message, harmonic_likelihood, first[0], BANDS, *first[1:], **given)


def test_other_bad_input():
    few = {name: BANDS[name] for name in list(BANDS)[:3]}
    with pytest.raises(ValueError, match=r"3 bands are too few"):
        harmonic_likelihood(SKY[2], few, ALM[:3], np.ones(3), START, beams=FWHM[:3])
    with pytest.raises(KeyError, match=r"dust.beta"):
        harmonic_likelihood(SKY[2], BANDS, ALM, np.ones(8), {"dust.beta": 1.5}, beams=FWHM)
    with pytest.raises(TypeError, match=r"`alm` must be a real array"):
        harmonic_likelihood(SKY[2], BANDS, 1j * ALM, np.ones(8), START, beams=FWHM)
    raises(ValueError, r"`level` must be positive, but has -1", white_spectrum, [1.0, -1.0])
    like = harmonic_likelihood(SKY[2], BANDS, ALM, np.ones(8), START, beams=FWHM)
    with pytest.raises(ValueError, match=r"`alm` must have 2 rows a band .* but has 3"):
        harmonic_component_maps(like, {}, np.zeros((8, 3, 49)), np.ones(8), beams=FWHM)
    with pytest.raises(ValueError, match=r"`alm` has 16 of 784 values that are not finite"):
        harmonic_component_maps(like, {}, NAN, np.ones(8), beams=FWHM)
    unused = np.where(np.arange(49) < 2, np.nan, ALM)  # the monopole and a dipole
    with_unused = harmonic_likelihood(SKY[2], BANDS, unused, np.ones(8), START, beams=FWHM)
    assert float(chi2(with_unused, START)) == float(chi2(like, START))
    many = dataclasses.replace(like, index=np.zeros((5, 3), int))
    with pytest.raises(ValueError, match=r"`like` has regions, 5 in all"):
        harmonic_component_maps(many, {}, ALM, np.ones(8), beams=FWHM)
    maps = harmonic_component_maps(like, {}, ALM, np.ones(8), beams=FWHM)
    raises(ValueError, r"`nside` must be a power of 2, but is 12", maps.maps, 12, 500.0)
    raises(ValueError, r"`beam` has 1 of 1 values", maps.maps, 4, np.nan)
    raises(ValueError, r"-5 arcmin", maps.maps, 4, -5.0)
    raises(ValueError, r"ends at l = 3, not at 6", maps.maps, 4, np.ones(4))
