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
from jaxsky import Observation, ObservedBand, Sky, Source, harmonics, set_parameters, simulate
from jaxsky.harmonics import transforms
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
    mlir.register_lowering(jaxbind._prim, transforms._lower_callback, platform="cpu")
    try:
        yield
    finally:
        mlir.register_lowering(jaxbind._prim, transforms._lower, platform="cpu")


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
    "rotation": (lambda alm: harmonics.rotate(alm, "G", "C"), ALM),
    "smoothing": (lambda fwhm: harmonics.smooth(jnp.asarray(MAPS), fwhm, lmax=LMAX), 600.0),
    "preparation": (lambda maps: SMOOTHING(maps), MAPS),
    "its transpose": (lambda maps: SMOOTHING.transpose(maps), MAPS[:, : NPIX // 4]),
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


def test_wrong_numbers_are_missed_by_the_script(monkeypatch):
    monkeypatch.setattr(gpu, "ACCURACY", {np.float64: 1e-20})
    assert gpu.band_average(8, np.float64, trial=True).met is False
    monkeypatch.setattr(gpu, "ACCURACY", {np.float64: 1e-9})
    assert gpu.band_average(8, np.float64, trial=True).met is None
