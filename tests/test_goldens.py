"""Numbers that a change of the code must leave as they are.

`python tests/test_goldens.py` writes those of the present code; the difference of the two files is
then part of the change, and its message says why.
"""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from fits.fluctuations import Fluctuations, MapNoise
from fits.multipoles import harmonic_likelihood
from fits.posterior import chi2, hessian
from fits.profile_likelihood import spectral_likelihood
from fits.pseudo_cl import masked_spectra
from fits.template_likelihood import likelihood
from jaxsky import Bandpass, Sky, get_parameters, observe, parameter_names, set_parameters
from jaxsky.cmb import realisation
from jaxsky.components import FreeFree, KinematicQuadrupole, ThermalSZ
from jaxsky.harmonics import Preparation, gaussian_beam, synthesis

PATH = Path(__file__).with_name("goldens.json")
#: Relative to the largest number of an entry: sums in another order differ by less.
TOLERANCE = 1e-9
NSIDE = 8
jax.config.update("jax_enable_x64", True)  # before the bands below, where this is a script
BANDS = {f"{c:g}": Bandpass.top_hat(c, 0.25 * c, samples=5) for c in (30.0, 95.0, 220.0, 353.0)}
START = {"dust.beta_dust": 1.55, "synchrotron.beta_syn": 3.05}
#: Steps from there at which likelihoods are taken.
POINTS = ((0, 0), (0.02, -0.01), (-0.05, 0.03), (0.1, 0.1), (-0.1, -0.2))


def observations():
    """Each law in bands of all conventions, and its gradient in all its parameters."""
    bands = [*systems.bands(), Bandpass.delta(44.0), Bandpass.top_hat(100.0, 30.0, "CMB", 9)]
    maps = systems.random_maps(1, 3)
    intensity = maps.at[1:].set(0.0)
    laws = systems.components() | {
        "free_free": FreeFree(intensity, 8000.0),
        "sz": ThermalSZ(intensity),
        "kinematic_quadrupole": KinematicQuadrupole(intensity),
    }
    weights = jnp.cos(jnp.arange(len(bands)))[:, None, None]
    for name, component in laws.items():
        sky = Sky({"x": component})
        params = get_parameters(sky, [n for n in parameter_names(sky) if "amplitude" not in n])
        yield f"observe {name}", observe(sky, bands)[:, :, ::16]

        def total(values, sky=sky):
            return jnp.sum(weights * observe(set_parameters(sky, values), bands))

        for key, value in jax.grad(total)(params).items():
            yield f"gradient {name} {key}", value if value.ndim < 3 else value[20:40:7, 1:8:4]


def fluctuations():
    """Noise and CMB after a smoothing, as those of two bands."""
    rng, npix = np.random.default_rng(3), 12 * NSIDE**2
    lmax = 2 * NSIDE
    operator = Preparation.smoothing(NSIDE, 0.0, NSIDE, 900.0, lmax)
    noise = jnp.eye(2)[..., None] * jnp.asarray(rng.uniform(1.0, 2.0, npix))
    spectra = jnp.asarray(np.outer([1.0, 0.1], 1 / (1.0 + np.arange(lmax + 1)) ** 2))
    return Fluctuations(
        (MapNoise(operator, noise, None), MapNoise(operator, 2 * noise, spectra[0])),
        spectra,
        jnp.stack([gaussian_beam(900.0, lmax)] * 2),
        jnp.array([0.9, 0.7]),
        ("44", "70"),
    )


def at_points(like):
    """chi^2 at the points."""
    for step in POINTS:
        params = {name: value + d for (name, value), d in zip(START.items(), step, strict=True)}
        yield chi2(like, params), params


def likelihoods():
    """chi^2 and second derivatives of each likelihood."""
    rng, npix = np.random.default_rng(5), 48
    sky = systems.dust_and_synchrotron(npix)
    seen = observe(sky, list(BANDS.values()))
    sigma = rng.uniform(0.5, 1.5, seen.shape)
    data = np.asarray(seen) + sigma * rng.normal(size=seen.shape)
    for pixelwise in (False, True):
        like = likelihood(sky, BANDS, data, sigma, START, pixelwise=pixelwise)
        kind = "pixels" if pixelwise else "templates"
        for i, (value, params) in enumerate(at_points(like)):
            yield f"{kind} chi2 {i}", value
            names = list(params)

            def flat(theta, like=like, names=names):
                return chi2(like, dict(zip(names, theta, strict=True)))

            yield f"{kind} hessian {i}", jax.hessian(flat)(jnp.array(list(params.values())))
    like = spectral_likelihood(sky, BANDS, data, sigma, START)
    for i, (value, params) in enumerate(at_points(like)):
        yield f"separation chi2 {i}", value
        yield f"separation hessian {i}", hessian(like, params)
    lmax = 2 * NSIDE
    alm = rng.normal(size=(len(BANDS), 2, (lmax + 1) ** 2))
    one = systems.dust_and_synchrotron(1)
    fwhm = np.array([600.0, 300.0, 200.0, 150.0])
    like = harmonic_likelihood(one, BANDS, alm, np.full(4, 0.1), START, beams=fwhm)
    for i, (value, params) in enumerate(at_points(like)):
        yield f"harmonic chi2 {i}", value
        yield f"harmonic hessian {i}", hessian(like, params)


def maps():
    """Covariances, windows of a mask, a realisation."""
    rng, npix = np.random.default_rng(7), 12 * NSIDE**2
    found = fluctuations()
    yield "covariance", found.covariance(jnp.asarray(rng.normal(size=(2, 3, 2, npix))))
    yield "sigma", found.sigma()[:, :, ::64]
    yield "noise", found.noise_realisation(jax.random.key(1))[:, :, ::64]
    z = np.linspace(1, -1, npix)
    for pure in (False, True):
        spectra = masked_spectra(np.clip(1.5 * np.abs(z) - 0.3, 0, 1), (2, 5, 9, 13), pure=pure)
        yield f"windows {pure}", spectra.windows[:, :, :, ::3]
        yield f"mixing {pure}", spectra.mixing[:, :, ::5, ::5]
    alm = realisation(
        jax.random.key(2), jnp.ones((4, 2 * NSIDE + 1)) * jnp.array([9, 2, 1, 1])[:, None]
    )
    yield "realisation", synthesis(alm, NSIDE)[:, ::64]


@functools.cache
def numbers(source):
    """The entries of one kind by name."""
    return {name: np.asarray(value, float).ravel() for name, value in source()}


SOURCES = (observations, likelihoods, maps)


@pytest.fixture(scope="module")
def goldens():
    return {name: np.array(values) for name, values in json.loads(PATH.read_text()).items()}


@pytest.mark.parametrize("source", SOURCES)
def test_numbers_stay(source, goldens):
    for name, value in numbers(source).items():
        known = goldens[name]
        scale = TOLERANCE * np.abs(known).max()
        np.testing.assert_allclose(value, known, rtol=0, atol=scale, err_msg=name)


def test_no_golden_is_left_over(goldens):
    assert set(goldens) == {name for source in SOURCES for name in numbers(source)}


if __name__ == "__main__":
    entries = {name: values for source in SOURCES for name, values in numbers(source).items()}
    lines = [
        f"{json.dumps(name)}: {json.dumps([float(f'{x:.12g}') for x in values])}"
        for name, values in entries.items()
    ]
    PATH.write_text("{\n" + ",\n".join(lines) + "\n}\n")
