"""What runs on an accelerator, without one: transforms through a callback, programs for CUDA."""

import contextlib
import sys

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters import mlir
from jaxbind import jaxbind

from benchmarks import gpu
from fits.optimize import best_fit
from fits.posterior import chi2
from fits.products import gram
from fits.profile_likelihood import spectral_likelihood
from fits.separated_maps import component_maps
from jaxsky import (
    Bandpass,
    Dust,
    Observation,
    ObservedBand,
    Sky,
    Source,
    checks,
    ducc,
    harmonics,
    mesh,
    observe,
    set_parameters,
    simulate,
)
from systems import bands, dust_and_synchrotron

NSIDE, LMAX = 8, 16
NPIX = healpy.nside2npix(NSIDE)
DRAWN = np.random.default_rng(1)
MAPS, ALM = DRAWN.normal(size=(3, NPIX)), DRAWN.normal(size=(3, (LMAX + 1) ** 2))
SKY = dust_and_synchrotron(NPIX)
CHANNELS = {f"{band.center:.0f}": ObservedBand(band, 600.0, noise=20.0) for band in bands()}
CALLBACK, DIRECT = "xla_ffi_python_cpu_callback", "cpu_pycall"


@contextlib.contextmanager
def as_on_accelerators():
    """Programs made here call transforms as those for a GPU do."""
    mlir.register_lowering(jaxbind._prim, ducc._lower_callback, platform="cpu")
    try:
        yield
    finally:
        mlir.register_lowering(jaxbind._prim, ducc._lower, platform="cpu")


def simulated(beta):
    """Maps with CMB and noise, as a function of a parameter."""
    sky: Sky = set_parameters(SKY, {"dust.beta_dust": beta})
    sources = {name: Source(sky[name], 300.0) for name in sky}
    spectra = jnp.ones((4, LMAX + 1)) * jnp.array([9.0, 2.0, 1.0, 1.0])[:, None]
    return simulate(jax.random.key(1), sources, Observation(CHANNELS, NSIDE), spectra)


SMOOTHING = harmonics.Preparation.smoothing(NSIDE, 300.0, NSIDE // 2, 900.0, LMAX)
#: What is built on transforms, and an argument.
TRANSFORMED = {
    "synthesis": (lambda alm: harmonics.synthesis(alm, NSIDE), ALM),
    "synthesis in single precision": (
        lambda alm: harmonics.synthesis(alm, NSIDE),
        ALM.astype(np.float32),
    ),
    "adjoint": (lambda maps: harmonics.adjoint_synthesis(maps, LMAX), MAPS),
    "analysis": (lambda maps: harmonics.analysis(maps, LMAX), MAPS),
    "preparation": (lambda maps: SMOOTHING(maps), MAPS),
    "simulation": (simulated, 1.6),
}


def numbers(function, x):
    """Values, a derivative forward and one in reverse, a batch; and the text of their program."""

    @jax.jit  # compiled anew in each call of `numbers`
    def everything(x):
        seen, slope = jax.jvp(function, (x,), (jnp.cos(x),))
        (back,) = jax.vjp(function, x)[1](jnp.sin(1 + seen))
        return seen, slope, back, jax.vmap(function)(jnp.stack([x, 1.1 * x]))

    x = jnp.asarray(x)
    return everything(x), everything.lower(x).as_text()


@pytest.mark.parametrize("name", TRANSFORMED)
def test_transforms_through_a_callback_are_the_same(name):
    direct, text = numbers(*TRANSFORMED[name])
    assert DIRECT in text
    assert CALLBACK not in text
    with as_on_accelerators():
        found, text = numbers(*TRANSFORMED[name])
    assert CALLBACK in text
    assert DIRECT not in text
    for one, other in zip(found, direct, strict=True):
        assert one.dtype == other.dtype
        size = float(jnp.abs(other).max())
        assert size > 0
        # Within rounding: the rest of a program may be fused in another way.
        accuracy = 1e-12 if one.dtype == np.float64 else 1e-6
        np.testing.assert_allclose(one, other, rtol=0, atol=accuracy * size)


@pytest.mark.slow
def test_the_script_for_a_gpu_runs(monkeypatch, capsys):
    """On small maps; the numbers are right, and there is no verdict on speed."""
    monkeypatch.setattr(sys, "argv", ["benchmarks.gpu", "--nside", "16"])
    with pytest.raises(SystemExit) as end:
        gpu.main()
    said = capsys.readouterr().out
    assert end.value.code == 0, said
    for words in ("band average", "likelihood and gradient", "separated", "smoothing", "A trial"):
        assert words in said
    assert "MISS" not in said


@pytest.mark.slow
def test_wrong_numbers_are_missed_by_the_script(monkeypatch):
    monkeypatch.setattr(gpu, "ACCURACY", {np.float64: 1e-20})
    assert gpu.band_average(8, np.float64, trial=True).met is False
    monkeypatch.setattr(gpu, "ACCURACY", {np.float64: 1e-9})
    assert gpu.band_average(8, np.float64, trial=True).met is None


@pytest.fixture
def on_an_accelerator(monkeypatch):
    """Arrays of JAX count as those of an accelerator."""
    for module in (mesh, checks):
        monkeypatch.setattr(module, "on_accelerator", lambda x: isinstance(x, jax.Array))


@pytest.mark.slow
def test_separations_stay_where_the_maps_are(on_an_accelerator):
    """With the same results as for numpy arrays."""
    rng, instrument = np.random.default_rng(3), [30.0, 95.0, 150.0, 220.0, 353.0]
    channels = {f"{nu:g}": Bandpass.top_hat(nu, nu / 4, samples=5) for nu in instrument}
    start = {"dust.beta_dust": 1.55, "synchrotron.beta_syn": 3.05}
    sigma = np.full((5, 2, NPIX), 0.3)
    sigma[..., :40] = np.inf
    data = np.asarray(observe(SKY, list(channels.values()))) + 0.3 * rng.normal(size=sigma.shape)
    data[..., :40] = np.nan
    varying = sigma * rng.uniform(1, 2, sigma.shape)
    labels = {"dust.beta_dust": np.arange(NPIX) // 400}
    for noise, options in ((sigma[..., -1:].mean(axis=(1, 2)), {}), (varying, {"labels": labels})):
        whole = data if noise.ndim > 1 else np.where(np.isnan(data), 0.0, data)
        found = {}
        for place in (np.asarray, jnp.asarray):
            given = place(whole), place(noise)
            like = spectral_likelihood(SKY, channels, *given, start, **options)
            fit = best_fit(like, throw=False)
            maps = component_maps(like, fit.best_fit, *given)
            assert isinstance(maps.amplitude, jax.Array) == (place is jnp.asarray)
            found[place] = fit.best_fit, maps.amplitude, maps.chi2, maps.sigma("dust")
        for one, other in zip(*map(jax.tree.leaves, found.values()), strict=True):
            # Errors of one noise are those of one pixel, or of all.
            one, other = np.broadcast_arrays(one, other)
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_passes_of_accelerators_give_the_same(monkeypatch):
    """More pixels are taken at once there."""
    npix, rng = 40_000, np.random.default_rng(4)
    channels = {f"{nu:g}": Bandpass.top_hat(nu, nu / 4, samples=5) for nu in (30.0, 95.0, 353.0)}
    one, start = dust_and_synchrotron(npix), {"dust.beta_dust": 1.55}
    sigma = rng.uniform(1, 2, (3, 2, npix))
    data = np.asarray(observe(one, list(channels.values()))) + sigma * rng.normal(size=sigma.shape)
    templates = jnp.stack([part.amplitude for part in one.components.values()])

    def results():
        like = spectral_likelihood(one, channels, data, sigma, start)
        slope = jax.jit(jax.grad(lambda x: chi2(like, {"dust.beta_dust": x})))
        products = jax.jit(lambda *maps: gram(*maps))
        found = slope(1.6), products(jnp.asarray(data), templates, jnp.asarray(1 / sigma**2))
        return found, str(jax.make_jaxpr(slope)(1.6))

    few, text = results()
    jax.clear_caches()  # a process has one kind of default device
    with monkeypatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        many, other = results()
    jax.clear_caches()
    assert text != other
    for one, two in zip(few, many, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-10, atol=1e-10 * float(jnp.abs(two).max()))


def test_maps_of_parameters_are_taken_on_an_accelerator(on_an_accelerator):
    varying = set_parameters(SKY, {"dust.beta_dust": jnp.linspace(1.5, 1.6, NPIX)})
    channels = {f"{nu:g}": Bandpass.top_hat(nu, nu / 4, samples=5) for nu in (30.0, 95.0, 353.0)}
    data = observe(varying, list(channels.values()))
    like = spectral_likelihood(varying, channels, data, np.ones(3), {})
    np.testing.assert_allclose(
        component_maps(like, {}, data, np.ones(3)).amplitude[0],
        varying["dust"].amplitude,
        rtol=1e-8,
    )


def test_checks_say_the_same_of_what_lies_elsewhere(on_an_accelerator):
    for array in (jnp.array([1.0, jnp.nan, -2e30]), np.array([1.0, np.nan, -2e30])):
        with pytest.raises(ValueError, match="`x` has 2 of 3 values that are not finite"):
            checks.check_finite("x", array)
    with pytest.raises(ValueError, match="positive, but its smallest value is -1"):
        checks.check_positive("x", jnp.array([1.0, -1.0]))
    with pytest.raises(ValueError, match=r"`nu_ref` must be from 1 to 20000, but is 0\.5"):
        Dust(jnp.ones((2, 12)), 1.5, 20.0, nu_ref=jnp.array(0.5))
