"""Moments, derivatives of laws as components, and priors of amplitudes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from fits import (
    best_fit,
    chi2,
    component_maps,
    separate,
    separate_moments,
    spectral_likelihood,
)
from fits.posterior import fisher_matrix, hessian, value_and_gradient
from fits.separated_maps import emission_maps
from fits.separated_moments import moment_prior
from jaxsky import (
    CMB,
    Bandpass,
    Dust,
    Sky,
    Synchrotron,
    moments,
    observe,
    observe_components,
    parameter_names,
    set_parameters,
)
from jaxsky.components import Moment, declared
from jaxsky.components.laws import LineEmission
from refusals import cases, raises

NU = 95.0
ONES = jnp.ones((2, 1))
LAWS = {"cmb": CMB(ONES), "dust": Dust(ONES), "synchrotron": Synchrotron(ONES)}
CENTERS = (30.0, 44.0, 70.0, 100.0, 143.0, 217.0, 280.0, 353.0)
BANDS = {f"{nu:g}": Bandpass.top_hat(nu, 0.2 * nu, samples=5) for nu in CENTERS}
WHITE = np.array([3.0, 2.0, 1.5, 0.7, 0.5, 0.6, 0.8, 1.2])


def law(name, parameters, **values):
    """The law of a moment at one frequency."""
    own = LAWS | {name: type(LAWS[name])(ONES, **values)}
    label = "_".join((name, *parameters))
    sky = Sky(own | {label: Moment(ONES, name, parameters)})
    return float(sky[label].sed(NU))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_of_a_power_law_are_powers_of_the_logarithm(order):
    x = -np.log(NU / 30.0)
    expected = x**order * (NU / 30.0) ** -3.05
    assert law("synchrotron", ["beta_syn"] * order, beta_syn=3.05) == pytest.approx(expected, 1e-13)


def test_derivatives_of_a_modified_black_body():
    """ln(nu / nu_ref) S in beta, and S (f(x) - f(x_ref)) / T in T, f = x e^x / (e^x - 1)."""
    beta, T = 1.6, 18.0
    value = float(Dust(ONES, beta, T).sed(NU))
    x, ref = (0.04799243073366221 * nu / T for nu in (NU, 353.0))  # h / k in K / GHz, CODATA 2018
    f = [y * np.exp(y) / np.expm1(y) for y in (x, ref)]
    slope, log = (f[0] - f[1]) / T, np.log(NU / 353.0)
    given = {"beta_dust": beta, "T_dust": T}
    assert law("dust", ["beta_dust"], **given) == pytest.approx(log * value, rel=1e-13)
    assert law("dust", ["T_dust"], **given) == pytest.approx(slope * value, rel=1e-12)
    mixed = law("dust", ["beta_dust", "T_dust"], **given)
    assert mixed == pytest.approx(log * slope * value, rel=1e-12)


SMOOTH = [n for n, one in systems.components().items() if not isinstance(one, LineEmission)]


def test_what_has_no_derivatives_is_said():
    laws = systems.components()
    raises(ValueError, "'line' has no law at one frequency", moments, laws, "line", ["nu_line"])
    words = "'spinning_dust' has no parameter 'emissivity'"
    raises(KeyError, words, moments, laws, "spinning_dust", ["emissivity"])


@pytest.mark.parametrize("name", SMOOTH)
def test_first_derivatives_are_finite_differences_for_every_law(name):
    component = systems.components()[name]
    sky = Sky({"one": component})
    own = [n.partition(".")[2] for n in parameter_names(sky) if not n.endswith(".amplitude")]
    own = [n for n in own if "table" not in declared(type(component), n.split(".")[0])]
    both = Sky({"one": component} | moments({"one": component}, "one", own))
    for parameter in own:
        value, step = both["one"], 1e-5

        def at(shift, parameter=parameter):
            moved = set_parameters(both, {f"one.{parameter}.offset": shift})
            return float(moved["one"].sed(NU))

        expected = (at(step) - at(-step)) / (2 * step)
        found = float(both[f"one_{parameter}".replace(".", "_")].sed(NU))
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-9 * abs(float(value.sed(NU))))


def small_sky(amplitude=0.0, **values):
    maps = [systems.random_maps(seed) for seed in (3, 4)]
    laws = {"dust": Dust(maps[0], **values), "synchrotron": Synchrotron(maps[1])}
    found = moments(laws, "dust", ["beta_dust", "T_dust"], order=2)
    assert list(found) == [
        "dust_beta_dust",
        "dust_T_dust",
        "dust_beta_dust_beta_dust",
        "dust_beta_dust_T_dust",
        "dust_T_dust_T_dust",
    ]
    return Sky(laws | found)


def test_moments_have_amplitudes_only_and_follow_the_component():
    sky = small_sky()
    own = [name for name in parameter_names(sky) if name.startswith("dust_")]
    assert own == sorted(f"{name}.amplitude" for name in sky if name.startswith("dust_"))
    sky = set_parameters(sky, {"dust_beta_dust.amplitude": systems.random_maps(5)})
    band = [Bandpass.delta(NU)]

    def ratio(beta):
        maps = observe_components(set_parameters(sky, {"dust.beta_dust": beta}), band)
        return (maps["dust_beta_dust"] / sky["dust_beta_dust"].amplitude)[0, 0, 0]

    for beta in (1.4, 1.7):
        expected = np.log(NU / 353.0) * float(Dust(ONES, beta).sed(NU))
        assert float(ratio(beta)) == pytest.approx(expected, rel=1e-12)
    slope = jax.grad(ratio)(1.4)
    assert float(slope) == pytest.approx(np.log(NU / 353.0) * float(ratio(1.4)), rel=1e-12)
    # A sky differentiates in the one parameter that both have.
    tree = jax.grad(lambda own: observe(own, band).sum())(sky)
    both = jax.jvp(
        lambda beta: observe(set_parameters(sky, {"dust.beta_dust": beta}), band).sum(),
        (jnp.asarray(1.53),),
        (jnp.asarray(1.0),),
    )[1]
    assert float(tree["dust"].beta_dust) == pytest.approx(float(both), rel=1e-12)


def test_the_expansion_converges_to_maps_of_parameters():
    """Errors fall with the order as powers of the deviations."""
    rng, bands = np.random.default_rng(2), systems.bands()
    beta, T = (width * jnp.asarray(rng.uniform(-1, 1, systems.NPIX)) for width in (0.03, 0.8))
    sky = small_sky()
    amplitude = sky["dust"].amplitude
    exact = observe(small_sky(beta_dust=1.53 + beta, T_dust=21.0 + T), bands)
    first = {"dust_beta_dust": beta, "dust_T_dust": T}
    second = {
        "dust_beta_dust_beta_dust": beta**2 / 2,
        "dust_beta_dust_T_dust": beta * T,
        "dust_T_dust_T_dust": T**2 / 2,
    }
    errors = []
    for terms in ({}, first, first | second):
        maps = {f"{name}.amplitude": amplitude * value for name, value in terms.items()}
        expanded = observe(set_parameters(sky, maps), bands)
        errors.append(float(jnp.abs(expanded - exact).max()))
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.1 * errors[1]


def test_moments_about_a_map_of_a_parameter():
    maps, delta = systems.random_maps(3), 0.01
    beta, bands = systems.spread(1.53, 0.1), systems.bands()
    laws = {"dust": Dust(maps, beta)}
    sky = Sky(laws | moments(laws, "dust", ["beta_dust"]))
    sky = set_parameters(sky, {"dust_beta_dust.amplitude": delta * maps})
    exact = observe(Sky({"dust": Dust(maps, beta + delta)}), bands)
    middle = observe(Sky(laws), bands)
    assert jnp.abs(observe(sky, bands) - exact).max() < 0.02 * jnp.abs(middle - exact).max()


@pytest.mark.parametrize(("error", "given", "words"), cases("moments/moments"))
def test_what_moments_refuse(error, given, words):
    raises(getattr(__import__("builtins"), error), words, moments, LAWS, *given)


def test_a_moment_belongs_to_a_sky():
    moment = Moment(ONES, "dust", ["beta_dust"])
    raises(KeyError, "moment of 'dust', which is no component of the sky", Sky, {"m": moment})
    raises(ValueError, "at least one parameter", Moment, ONES, "dust", [])
    raises(ValueError, "has no law of its own", moment.sed, NU)
    wrong = LAWS | {"m": Moment(ONES, "dust", ["beta_syn"])}
    raises(KeyError, "'dust' has no parameter 'beta_syn'", Sky, wrong)


# Priors of amplitudes.

NPIX = 24
FULL = LAWS | moments(LAWS, "dust", ["beta_dust"])
NAMES = sorted(FULL)
START = {"dust.beta_dust": 1.5, "synchrotron.beta_syn": 3.0}


def drawn(npix=NPIX, scatter=0.1, seed=0):
    """Data with deviations of beta_dust to first order, and the CMB in them."""
    rng = np.random.default_rng(seed)
    cmb, dust, synchrotron = (size * rng.normal(size=(2, npix)) for size in (1.0, 20.0, 15.0))
    delta = scatter * rng.normal(size=npix)
    sky = Sky(
        {
            "cmb": CMB(cmb),
            "dust": Dust(dust, 1.5),
            "synchrotron": Synchrotron(synchrotron, 3.0),
            "m": Moment(dust * delta, "dust", ["beta_dust"]),
        }
    )
    maps = np.asarray(observe(sky, list(BANDS.values())))
    return maps + WHITE[:, None, None] * rng.normal(size=maps.shape), cmb


def covariance_of(prior, npix=NPIX):
    """(pix, 2, 2) of a prior in any form."""
    if np.ndim(prior) == 3:
        return np.moveaxis(prior, -1, 0)
    sigma = np.broadcast_to(prior if np.ndim(prior) == 2 else np.reshape(prior, (-1, 1)), (2, npix))
    return np.einsum("sp,st->pst", sigma**2, np.eye(2))


def dense(data, prior):
    """The estimate with S^-1 in full matrices: amplitudes, covariance and chi^2 of each pixel."""
    like = spectral_likelihood(FULL, BANDS, data, WHITE, START)
    one = np.asarray(like.matrices(like.flat({})[like.index])[0][0])
    M, W = np.kron(one, np.eye(2)), np.diag(np.repeat(WHITE**-2.0, 2))
    at = 2 * NAMES.index("dust_beta_dust")
    results = []
    for p, S in enumerate(covariance_of(prior)):
        inverse = np.zeros((8, 8))
        inverse[at : at + 2, at : at + 2] = np.linalg.inv(S)
        d = data[..., p].ravel()
        covariance = np.linalg.inv(M.T @ W @ M + inverse)
        s = covariance @ M.T @ W @ d
        rest = d - M @ s
        results.append((s.reshape(4, 2), covariance, rest @ W @ rest + s @ inverse @ s))
    return [np.array(each) for each in zip(*results, strict=True)]


def forms():
    rng = np.random.default_rng(7)
    a = rng.normal(size=(2, NPIX))
    correlated = 0.01 * (a[:, None] * a + 0.1 * np.eye(2)[..., None])
    maps = rng.uniform(0.1, 1.0, (2, NPIX))
    return {"number": 0.3, "stokes": np.array([0.2, 0.5]), "map": maps, "covariance": correlated}


@pytest.mark.parametrize("form", forms())
def test_a_prior_is_that_of_the_dense_formula(form):
    data, _ = drawn()
    prior = forms()[form]
    s, covariance, square = dense(data, prior)
    like = spectral_likelihood(FULL, BANDS, data, WHITE, START, prior={"dust_beta_dust": prior})
    found = component_maps(like, START, data, WHITE)
    np.testing.assert_allclose(np.moveaxis(found.amplitude, -1, 0), s, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.chi2, square, rtol=1e-9)
    assert float(chi2(like, START)) == pytest.approx(square.sum(), rel=1e-10)
    for name in NAMES:
        at = 2 * NAMES.index(name)
        expected = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, at : at + 2].T)
        shape = expected.shape
        np.testing.assert_allclose(np.broadcast_to(found.sigma(name), shape), expected, rtol=1e-8)
    assert like.values == NPIX * 2 * (len(BANDS) + 1 - 4)
    rest = data - emission_maps(like, START, found.amplitude)
    assert rest.shape == data.shape


@pytest.mark.parametrize("form", ["number", "covariance"])
def test_derivatives_with_a_prior_are_finite_differences(form):
    data, _ = drawn()
    prior = {"dust_beta_dust": forms()[form]}
    like = spectral_likelihood(FULL, BANDS, data, WHITE, START, prior=prior)
    theta, step = np.asarray(like.flat(START)), 1e-4 * np.eye(2)
    value, gradient = value_and_gradient(like, theta)
    assert float(value) == pytest.approx(float(chi2(like, START)) / 2, rel=1e-12)
    up, down = ([value_and_gradient(like, theta + k * h) for h in step] for k in (1, -1))
    slope = [(u[0] - d[0]) / 2e-4 for u, d in zip(up, down, strict=True)]
    np.testing.assert_allclose(gradient, slope, rtol=1e-5)
    curvature = [(u[1] - d[1]) / 2e-4 for u, d in zip(up, down, strict=True)]
    np.testing.assert_allclose(hessian(like, START), curvature, rtol=1e-5)
    # The Fisher matrix is the second derivatives for data that equal the prediction.
    assert np.linalg.eigvalsh(fisher_matrix(like, START))[0] > 0


def test_a_wide_prior_changes_nothing_and_a_narrow_one_removes_the_moment():
    data, _ = drawn()

    def cmb(laws, prior=None):
        like = spectral_likelihood(laws, BANDS, data, WHITE, START, prior=prior)
        return component_maps(like, START, data, WHITE).map("cmb")

    wide, narrow = (cmb(FULL, {"dust_beta_dust": size}) for size in (1e6, 1e-6))
    np.testing.assert_allclose(wide, cmb(FULL), rtol=1e-6)
    np.testing.assert_allclose(narrow, cmb(LAWS), rtol=1e-6)


def test_masked_pixels_stay_masked():
    data, _ = drawn()
    sigma = np.broadcast_to(WHITE[:, None, None], data.shape).copy()
    sigma[..., :5] = np.inf
    prior = {"dust_beta_dust": forms()["covariance"]}
    like = spectral_likelihood(FULL, BANDS, data, sigma, START, prior=prior)
    found = component_maps(like, START, data, sigma)
    assert np.isnan(found.amplitude[..., :5]).all()
    rest = {"dust_beta_dust": prior["dust_beta_dust"][..., 5:]}
    alone = spectral_likelihood(FULL, BANDS, data[..., 5:], WHITE, START, prior=rest)
    expected = component_maps(alone, START, data[..., 5:], WHITE).amplitude
    np.testing.assert_allclose(found.amplitude[..., 5:], expected, rtol=1e-9)


@pytest.mark.parametrize(("error", "given", "words"), cases("moments/priors"))
def test_what_priors_refuse(error, given, words):
    data, _ = drawn()
    kind = getattr(__import__("builtins"), error)
    raises(kind, words, spectral_likelihood, LAWS, BANDS, data, WHITE, START, prior=given)


def test_separate_takes_a_prior():
    data, _ = drawn(200)
    found = separate(FULL, BANDS, data, noise=WHITE, unit="uK_RJ", prior={"dust_beta_dust": 0.4})
    assert found.maps.components == tuple(NAMES)
    like = spectral_likelihood(FULL, BANDS, data, WHITE, START, prior={"dust_beta_dust": 0.4})
    assert found.fit.chi2 == pytest.approx(best_fit(like).chi2, rel=1e-9)


def test_the_scatter_is_found_and_the_errors_are_right():
    """With a scatter of 0.1 in 3000 pixels, the CMB is better than with either kind of law."""
    data, cmb = drawn(3000)
    free = list(START)
    found = separate_moments(FULL, BANDS, data, free, noise=WHITE, unit="uK_RJ")
    assert abs(np.log(found.scatter["dust_beta_dust"] / 0.1)) < 4 * found.sigma["dust_beta_dust"]
    assert found.sigma["dust_beta_dust"] < 0.1
    for name, value in START.items():
        assert abs(found.params[name] - value) < 4 * found.sigma[name], name
    off = found.maps.map("cmb") - cmb
    assert np.std(off / found.maps.sigma("cmb")) == pytest.approx(1.0, abs=0.05)
    assert off.std() < 0.97 * (found.base.maps.map("cmb") - cmb).std()
    free_moments = separate(FULL, BANDS, data, START, noise=WHITE, unit="uK_RJ")
    assert off.std() < 0.97 * (free_moments.maps.map("cmb") - cmb).std()
    # The prior is <a a^T> of the dust, and its scatter can be given.
    again = moment_prior(found.base.maps, "dust", found.scatter["dust_beta_dust"])
    np.testing.assert_array_equal(again, found.prior["dust_beta_dust"])
    known = {"dust_beta_dust": 0.1}
    given = separate_moments(FULL, BANDS, data, free, noise=WHITE, unit="uK_RJ", scatter=known)
    assert given.scatter == known
    assert set(given.sigma) == set(START)


def test_what_separate_moments_refuses():
    data, _ = drawn()

    def given(laws=FULL, maps=data, **options):
        return separate_moments(laws, BANDS, maps, noise=WHITE, unit="uK_RJ", **options)

    raises(ValueError, "`components` has no moments", given, LAWS)
    raises(KeyError, "scatter for 'dust'; moments are dust_beta_dust", given, scatter={"dust": 1.0})
    wrong = {"dust_beta_dust": 0.0}
    raises(ValueError, "'dust_beta_dust' must be positive, but is 0", given, scatter=wrong)
    three = np.concatenate([data, data[:, :1]], axis=1)
    raises(ValueError, "`data` must have shape .* Stokes Q, U", given, maps=three)
