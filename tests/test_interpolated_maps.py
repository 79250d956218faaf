"""Maps at several frequencies, linear in between, against PySM's code."""

import jax
import jax.numpy as jnp
import numpy as np
import pysm3
import pytest
from jax.test_util import check_grads
from pysm3.models import interpolating

from jaxsky import Bandpass, Sky, observe, observe_band
from jaxsky.components import InterpolatedMap, interpolated_maps
from refusals import raises

NSIDE = 2
AT = np.array([90.0, 100.0, 143.0, 217.0, 353.0])
MAPS = np.random.default_rng(8).normal(size=(len(AT), 3, 12 * NSIDE**2))
NU = np.linspace(95.0, 230.0, 28)
WEIGHTS = 0.1 + np.hanning(NU.size)


@pytest.fixture
def model(monkeypatch):
    """PySM's model with our maps in place of files, without numba."""
    for module in (interpolating, pysm3.utils):
        for name, function in list(vars(module).items()):
            if hasattr(function, "py_func"):
                monkeypatch.setattr(module, name, function.py_func)
    one = object.__new__(interpolating.InterpolatingComponent)
    one.nside, one.freqs, one.pre_applied_beam = NSIDE, AT, None
    one.cached_maps = dict(zip(AT, MAPS, strict=True))
    monkeypatch.setattr(one, "read_map_by_frequency", one.cached_maps.get, raising=False)
    return one


def test_interpolation_is_pysms(model):
    sky = Sky(interpolated_maps("cib", MAPS, AT))
    assert list(sky) == [f"cib{i}" for i in range(len(AT))]
    for nu, weights in (
        *((np.array([x]), np.ones(1)) for x in (100.0, 120.0, 352.0)),
        (NU, WEIGHTS),
    ):
        expected = model.get_emission(nu * pysm3.units.GHz, weights).value
        found = observe_band(sky, Bandpass(nu, weights, "power"))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_at_their_frequencies_maps_are_themselves_and_beyond_there_is_nothing():
    sky = Sky(interpolated_maps("cib", MAPS, AT))
    np.testing.assert_allclose(observe(sky, [*map(Bandpass.delta, AT)]), MAPS, rtol=1e-14)
    assert float(jnp.abs(observe(sky, [*map(Bandpass.delta, (89.9, 353.1))])).max()) == 0


def test_derivatives_against_finite_differences():
    bands = [Bandpass(NU, WEIGHTS, "power")]

    @jax.jit
    def seen(maps, nu):
        return observe(Sky(interpolated_maps("cib", maps, nu)), bands)

    given = jnp.asarray(MAPS[:, :, :2]), jnp.asarray(AT + 0.7)
    check_grads(seen, given, order=1, modes=["rev"], rtol=1e-6)


def test_bad_arguments_are_refused():
    words = "must increase, but are 200, 100, 300 GHz"
    raises(ValueError, words, InterpolatedMap, MAPS[0], 200.0, 300.0, 100.0)
    raises(
        ValueError,
        "must increase, but are 100, 90 GHz",
        interpolated_maps,
        "x",
        MAPS[:2],
        [100, 90],
    )
    raises(ValueError, r"`maps` must have shape \(frequency", interpolated_maps, "x", MAPS[0], AT)
    raises(ValueError, r"`nu` must have shape \(5,\)", interpolated_maps, "x", MAPS, AT[1:])
