"""Forecasts: the Fisher matrix in closed form, against differences and simulations."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fits import fisher
from fits.fisher import ForecastModel, fiducial, fisher_errors, noise_weights
from fits.mixing import Mixing, unit_sky
from jaxsky import AME, Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.noise import uniform_covariance
from jaxsky.observation import ObservedBand, load_instrument
from jaxsky.sky import set_parameters
from refusals import cases, raises
from systems import spread

LMIN, LMAX, FRACTION = 2, 40, 0.6
ELL = np.arange(LMIN, LMAX + 1)
TENSORS = 1e-3 * np.stack([0.2 / ELL**2.0, 1.0 / ELL**2.0])
SCALARS = np.stack([1e-3 / ELL, 2e-6 * np.ones(ELL.size)])
CENTERS = (30.0, 95.0, 150.0, 220.0, 340.0, 480.0)


def laws_sky(bodies: int = 1) -> Sky:
    one = jnp.ones((2, 1))
    two = ((1.67, 2.70), (9.4, 16.2), (0.49, 1.0))
    dust = Dust(one, *two) if bodies == 2 else Dust(one, 1.53, 21.0)
    return Sky({"dust": dust, "synchrotron": Synchrotron(one, 3.1, curvature=-0.05)})


def bandpasses(centers=CENTERS) -> dict[str, Bandpass]:
    return {f"{nu:g}": Bandpass.top_hat(nu, 0.2 * nu, samples=9) for nu in centers}


def model(centers=CENTERS, noise=2.0, fields=("BB",), bodies=1, sky=None) -> ForecastModel:
    rows = [("EE", "BB").index(field) for field in fields]
    levels = np.radians(noise / 60) * np.ones(len(centers))
    beams = np.exp(-1e-5 * np.outer(ELL**2, 1 + np.arange(len(centers))))
    return ForecastModel(
        Mixing.of(sky or laws_sky(bodies), bandpasses(centers), "uK_CMB"),
        jnp.asarray(beams / levels),
        jnp.asarray(TENSORS[rows]),
        jnp.asarray(SCALARS[rows]),
        jnp.asarray(ELL, float),
        jnp.asarray(FRACTION),
        tuple(fields),
    )


def values(system: ForecastModel, r=0.01, amplitudes=(0.1, 1.0), rho=0.4) -> dict[str, float]:
    foregrounds = {}
    for field in system.fields:
        for name, amplitude, slope in zip(system.sky, amplitudes, (-2.4, -2.6), strict=True):
            foregrounds |= {f"{field}.{name}.amplitude": amplitude, f"{field}.{name}.slope": slope}
        foregrounds[f"{field}.dust.synchrotron.correlation"] = rho
    return fiducial(system.sky, foregrounds, r, 0.7)


@jax.jit
def covariance_of_bands(params, system: ForecastModel):
    """The covariance C_l of bands, their beams taken out [uK_CMB^2]: the formula of the module."""
    laws, spectra = fisher._laws(params, system), fisher._spectra(params, system)
    noise = jax.vmap(jnp.diag)(system.weights**-2)
    return jnp.einsum("ic,flcd,jd->flij", laws, spectra, laws) + noise


def modes() -> np.ndarray:
    return FRACTION * (2 * ELL + 1) / 2


def test_one_band_without_foregrounds_in_closed_form():
    system = model(centers=(150.0,))
    params = values(system, amplitudes=(0.0, 0.0))
    total = params["r"] * TENSORS[1] + 0.7 * SCALARS[1] + np.asarray(system.weights[:, 0]) ** -2
    F_rr = np.sum(modes() * (TENSORS[1] / total) ** 2)
    F_AA = np.sum(modes() * (SCALARS[1] / total) ** 2)
    F_rA = np.sum(modes() * TENSORS[1] * SCALARS[1] / total**2)
    alone = fisher_errors(system, params, ["r"])
    np.testing.assert_allclose(alone.sigma["r"], F_rr**-0.5, rtol=1e-12)
    both = fisher_errors(system, params, ["r", "A_lens"])
    expected = np.linalg.inv([[F_rr, F_rA], [F_rA, F_AA]])
    np.testing.assert_allclose(both.covariance, expected, rtol=1e-10)
    np.testing.assert_allclose(both.known["r"], F_rr**-0.5, rtol=1e-12)
    prior = fisher_errors(system, params, ["r", "A_lens"], {"A_lens": 0.01})
    expected = np.linalg.inv([[F_rr, F_rA], [F_rA, F_AA + 1e4]])
    np.testing.assert_allclose(prior.covariance, expected, rtol=1e-10)


def test_lensing_is_left_in_B_only():
    system = model(centers=(150.0,), fields=("EE", "BB"))
    params = values(system, amplitudes=(0.0, 0.0))
    noise = np.asarray(system.weights[:, 0]) ** -2
    total = params["r"] * TENSORS + np.array([[1.0], [0.7]]) * SCALARS + noise
    expected = np.sum(modes() * (TENSORS / total) ** 2) ** -0.5
    np.testing.assert_allclose(fisher_errors(system, params, ["r"]).sigma["r"], expected)


def test_two_bands_and_two_components_in_closed_form():
    # Dust far above the noise is taken out by one combination of bands, of which this is the noise.
    system = model(centers=(95.0, 220.0))
    dust = 1e12
    params = values(system, amplitudes=(dust, 0.0))
    laws = [
        float(band.conversion("uK_RJ", "uK_CMB") * jnp.dot(band.quadrature, law))
        for band in bandpasses((95.0, 220.0)).values()
        for law in [jax.vmap(system.sky["dust"].sed)(band.nu)]
    ]
    noise = np.asarray(system.weights) ** -2
    cleaned = (laws[1] ** 2 * noise[:, 0] + laws[0] ** 2 * noise[:, 1]) / (laws[1] - laws[0]) ** 2
    total = params["r"] * TENSORS[1] + 0.7 * SCALARS[1] + cleaned
    expected = np.sum(modes() * (TENSORS[1] / total) ** 2) ** -0.5
    found = fisher_errors(system, params, ["r", "BB.dust.amplitude"])
    np.testing.assert_allclose(found.sigma["r"], expected, rtol=1e-6)
    # The dust's own amplitude is known as well as there are modes.
    np.testing.assert_allclose(
        found.sigma["BB.dust.amplitude"], dust * np.sum(modes()) ** -0.5, rtol=1e-4
    )


LAWS = ("beta_dust.0", "beta_dust.1", "T_dust.0", "T_dust.1", "E_dust.1")
SPECTRA = [f"{name}.{kind}" for kind in ("amplitude", "slope") for name in ("dust", "synchrotron")]
SPECTRA.append("dust.synchrotron.correlation")
FREE = (
    "r", "A_lens", *(f"dust.{law}" for law in LAWS), "synchrotron.beta_syn",
    "synchrotron.curvature", *(f"{field}.{name}" for field in ("EE", "BB") for name in SPECTRA),
)  # fmt: skip


def dense(system: ForecastModel, params: dict[str, float], free) -> np.ndarray:
    """The Fisher matrix from central differences of the covariance of bands."""
    C = np.asarray(covariance_of_bands(params, system))
    derivatives = []
    for name in free:
        step = 1e-5 * max(abs(params[name]), 0.1)
        up, down = (
            covariance_of_bands({**params, name: params[name] + s}, system) for s in (step, -step)
        )
        derivatives.append(np.asarray(up - down) / (2 * step))
    solved = [np.linalg.solve(C, d) for d in derivatives]
    return np.array([[np.einsum("l,flij,flji->", modes(), a, b) for a in solved] for b in solved])


def test_all_derivatives_against_differences():
    # Noise at which the inverse of the covariance is good to 1e-8.
    system = model(fields=("EE", "BB"), bodies=2, noise=20.0)
    params = values(system)
    root = np.asarray(fisher._root({k: jnp.asarray(v) for k, v in params.items()}, system, FREE))
    F, expected = root.T @ root, dense(system, params, FREE)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(F / size, expected / size, atol=1e-6)
    assert np.diag(expected).min() > 0


def test_scatter_of_the_likelihoods_slope():
    """The covariance of d log L / d theta over realisations is the Fisher matrix."""
    system = model(centers=(30.0, 150.0, 340.0))
    params = {k: jnp.asarray(v) for k, v in values(system).items()}
    free = ("r", "dust.beta_dust", "BB.synchrotron.amplitude")
    C = covariance_of_bands(params, system)[0]
    degrees = modes() * 2

    def log_likelihood(theta, seen):
        assumed = covariance_of_bands({**params, **dict(zip(free, theta, strict=True))}, system)[0]
        solved = jnp.linalg.solve(assumed, seen)
        terms = jnp.trace(solved, axis1=1, axis2=2) + jnp.linalg.slogdet(assumed)[1]
        return -0.5 * jnp.sum(degrees * terms)

    rng, count = np.random.default_rng(4), 600
    # Of f_sky (2 l + 1) modes; rounded, as one cannot draw parts of one.
    degrees = np.round(degrees).astype(int)
    root = np.linalg.cholesky(np.asarray(C))
    seen = np.empty((count, *C.shape))
    for i, n in enumerate(degrees):
        draws = np.einsum("ij,sjm->sim", root[i], rng.normal(size=(count, 3, n)))
        seen[:, i] = draws @ draws.swapaxes(1, 2) / n
    slopes = np.asarray(
        jax.jit(jax.vmap(jax.grad(log_likelihood), in_axes=(None, 0)))(
            jnp.stack([params[name] for name in free]), jnp.asarray(seen)
        )
    )
    errors = fisher_errors(
        with_modes(system, degrees), {k: float(v) for k, v in params.items()}, free
    )
    unit = slopes @ np.linalg.cholesky(errors.covariance)
    np.testing.assert_allclose(unit.mean(axis=0), 0, atol=5 / count**0.5)
    np.testing.assert_allclose(np.cov(unit.T), np.eye(3), atol=5 * (2 / count) ** 0.5)


def with_modes(system: ForecastModel, degrees: np.ndarray) -> ForecastModel:
    """The model with other numbers of modes."""
    return eqx.tree_at(lambda m: m.sky_fraction, system, jnp.asarray(degrees / (2 * ELL + 1)))


def test_order_of_bands_does_not_matter():
    system = model(fields=("BB",), noise=5.0)
    free = ("r", "dust.beta_dust", "dust.T_dust", "BB.dust.slope")
    straight = fisher_errors(system, values(system), free)
    order = [3, 0, 5, 1, 4, 2]
    mixing = Mixing.of(system.sky, bandpasses([CENTERS[i] for i in order]), "uK_CMB")
    weights = system.weights[:, jnp.array(order)]
    turned = dataclasses.replace(system, mixing=mixing, weights=weights)
    found = fisher_errors(turned, values(turned), free)
    np.testing.assert_allclose(found.covariance, straight.covariance, rtol=1e-7)
    # Nor that of the parameters.
    mixed = fisher_errors(system, values(system), free[::-1])
    np.testing.assert_allclose(mixed.covariance[::-1, ::-1], straight.covariance, rtol=1e-7)


def test_noise_is_the_same_in_all_units():
    band = Bandpass.top_hat(150.0, 40.0)
    level = 3.0 * float(band.conversion("uK_CMB", "uK_RJ"))
    noises = (level, uniform_covariance(level, 4))
    weights = [noise_weights(ObservedBand(band, 30.0, noise=noise), 2)[0] for noise in noises]
    np.testing.assert_allclose(weights, 180 * 60 / np.pi / 3.0, rtol=1e-12)
    observed = load_instrument("planck")["143"]
    sigma = np.radians(7.30 / 60) / np.sqrt(8 * np.log(2))
    expected = np.radians(70.2 / 60) ** 2 * np.exp(300 * 301 * sigma**2)
    np.testing.assert_allclose(noise_weights(observed, 300)[300] ** -2, expected, rtol=1e-6)


def test_better_or_other_data():
    free = ("r", "dust.beta_dust", "dust.T_dust", "synchrotron.beta_syn")
    sigmas = [
        fisher_errors(m, values(m), free).sigma["dust.beta_dust"]
        for m in (model(), model(noise=1.0), model(fields=("EE", "BB")), model(CENTERS[:-1]))
    ]
    assert sigmas[1] < 0.8 * sigmas[0]
    assert sigmas[2] < 0.9 * sigmas[0]
    assert sigmas[3] > 1.2 * sigmas[0]


@pytest.mark.parametrize(("bodies", "free", "apart"), cases("forecast/degenerate"))
def test_degenerate_parameters_are_named(bodies, free, apart):
    system = model(bodies=bodies)
    params = values(system)
    raises(ValueError, apart, fisher_errors, system, params, free)
    name = apart.removeprefix("apart: ").split(",")[0]
    prior = fisher_errors(system, params, free, {name: 0.1})
    assert 0 < prior.sigma[name] <= 0.1 * (1 + 1e-9)
    fewer = fisher_errors(system, params, [f for f in free if f != name])
    np.testing.assert_allclose(prior.sigma["r"], fewer.sigma["r"], rtol=1e-6)


def test_fewer_bands_than_parameters():
    system = model(centers=(150.0,))
    params = values(system)
    free = ("r", "BB.dust.amplitude", "BB.dust.slope", "dust.beta_dust")
    with pytest.raises(ValueError, match=r"apart: BB\.dust\.amplitude, dust\.beta_dust; hold one"):
        fisher_errors(system, params, free)
    assert np.isfinite(fisher_errors(system, params, free[:3]).covariance).all()


def test_refusals():
    system = model()
    params = values(system)
    with pytest.raises(KeyError, match=r"Unknown parameter 'dust.beta'.*dust.beta_dust"):
        fisher_errors(system, params, ["r", "dust.beta"])
    with pytest.raises(KeyError, match=r"Unknown parameter 'dust.amplitude'"):
        fisher_errors(system, params, ["dust.amplitude"])
    with pytest.raises(ValueError, match=r"The prior of 'dust.T_dust' has no effect"):
        fisher_errors(system, params, ["r"], {"dust.T_dust": 1.0})
    flat = {**params, "synchrotron.curvature": 0.0}
    with pytest.raises(ValueError, match=r"depends on synchrotron.nu_piv\."):
        fisher_errors(system, flat, ["r", "synchrotron.nu_piv"])
    with pytest.raises(ValueError, match=r"of BB, dust x synchrotron 1.1, are those of no sky"):
        values(system, rho=1.1)
    assert fisher_errors(system, values(system, rho=1.0), ["r"]).sigma["r"] > 0
    with pytest.raises(ValueError, match="not positive definite; an amplitude is negative, or"):
        fisher_errors(system, {**params, "BB.dust.amplitude": -1.0}, ["r"])


def test_covariance_is_that_of_maps_in_bands():
    """Fully correlated components: the bands see one map, as the library observes it."""
    one = jnp.ones((2, 1))
    components = {
        "ame": AME(one, 0.02),
        "dust": Dust(one, (1.67, 2.70), (9.4, 16.2), (0.49, 1.0)),
        "synchrotron": Synchrotron(one, 3.0, curvature=0.1),
    }
    amplitudes = {"ame": 3.0, "dust": 0.2, "synchrotron": 1.5}
    system = model(sky=Sky(components))
    spectra = {}
    for name, amplitude in amplitudes.items():
        spectra[f"BB.{name}.amplitude"] = 80 * 81 / (2 * np.pi) * amplitude**2
        spectra[f"BB.{name}.slope"] = -2.0
    spectra |= {f"BB.{a}.{b}.correlation": 1.0 for a, b in itertools.combinations(components, 2)}
    found = covariance_of_bands(fiducial(system.sky, spectra, 0.01, 0.5), system)[0]
    sky = Sky({n: eqx.tree_at(lambda c: c.amplitude, c, amplitudes[n] * one)
               for n, c in components.items()})  # fmt: skip
    bands = list(bandpasses().values())
    factors = [float(band.conversion("uK_RJ", "uK_CMB")) for band in bands]
    seen = np.asarray(observe(sky, bands))[:, 0, 0] * factors
    for i in (0, 17, -1):
        expected = np.outer(seen, seen) * (80 / ELL[i]) ** 2
        expected += 0.01 * TENSORS[1, i] + 0.5 * SCALARS[1, i]
        expected += np.diag(np.asarray(system.weights[i]) ** -2)
        np.testing.assert_allclose(found[i], expected, rtol=1e-10)


def test_laws_that_vary_enter_with_their_mean():
    maps = jnp.ones((2, 48))
    mask = np.where(np.arange(48) < 24, 1.0, 0.0)
    beta = spread(1.5, 0.2)
    sky = Sky({"dust": Dust(maps, beta), "synchrotron": Synchrotron(maps)})
    unit = unit_sky(sky, mask=mask)
    assert unit.shape == (2, 1)
    np.testing.assert_allclose(unit["dust"].beta_dust, beta[:24].mean())
    assert set_parameters(unit, {"dust.beta_dust": 1.0})["dust"].beta_dust == 1.0
