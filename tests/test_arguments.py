"""What exported functions say to arguments that cannot be meant."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from fits import (
    FitResult,
    apodize,
    as_noise,
    best_fit,
    bin_edges,
    separate,
)
from fits.regions import clusters
from fits.results import Convergence
from jaxsky import (
    Bandpass,
    Observation,
    ObservedBand,
    Sky,
    Source,
    get_parameters,
    load_instrument,
    observe,
    observe_components,
    simulate,
    smooth,
)
from jaxsky.archive import fetch
from refusals import refused

BAND = Bandpass.delta(100.0)
BANDS = {"100": ObservedBand(BAND, 30.0)}
MAPS = np.ones((2, 2, 48))
KEY = jax.random.key(0)
PLANCK = load_instrument("planck", ["44", "70"], samples=3)
RESULT = FitResult("grid", {}, {}, {}, ("x", "y"), np.eye(2), 0.0, 1, Convergence.converged, "", {})


def sky():
    return Sky(systems.components())


@pytest.mark.parametrize(
    ("words", "error", "call"),
    [
        ("`beam` must not be negative, but is -30", ValueError, lambda: ObservedBand(BAND, -30.0)),
        ("`beam` has 1 of 1 values", ValueError, lambda: ObservedBand(BAND, np.nan)),
        ("`noise` .* but is -10", ValueError, lambda: ObservedBand(BAND, 30.0, noise=-10.0)),
        ("`target` .* but is -1", ValueError, lambda: load_instrument("core", target=-1.0)),
        ("`nside` must be a power of 2, but is 33", ValueError, lambda: Observation(BANDS, 33)),
        ("`nside` must be a power of 2, but is 0", ValueError, lambda: Observation(BANDS, 0)),
        ("`lmax` must be at least 30, but is 2", ValueError, lambda: bin_edges(30, 2, 5)),
        ("`width` must be at least 1, but is 0", ValueError, lambda: bin_edges(2, 30, 0)),
        ("`maps` has 1 different .* 4 clusters", ValueError, lambda: clusters(np.ones(100), 4)),
        ("`max_steps` .* but is -1", ValueError, lambda: best_fit(None, max_steps=-1)),
        (r"`maps` .* shape \(2, 100\)", ValueError, lambda: smooth(np.ones((2, 100)), 300.0)),
        (r"`maps` .* shape \(48,\)", ValueError, lambda: smooth(np.ones(48), 300.0)),
        (r"`data` .* \(2, 2, 40\)", ValueError, lambda: separate(["cmb"], PLANCK, MAPS[..., :40])),
        (r"`shape` .* shape \(2, 2, 48\)", ValueError, lambda: as_noise(3.0, MAPS)),
        ("`used` .* but is of float64", TypeError, lambda: apodize(np.ones(48), 10.0)),
        ("`product` .* but is 'nope'", ValueError, lambda: fetch("nope")),
        ("`sky` must be a Sky, but is ndarray", TypeError, lambda: observe(MAPS[0], [BAND])),
        ("`sky` .* is dict", TypeError, lambda: observe_components({}, [BAND])),
        ("`components` must be a dict.* is list", TypeError, lambda: Sky([1])),
        ("`sources` .* is Sky", TypeError, lambda: simulate(KEY, sky(), Observation(BANDS, 2))),
        (
            "'x' must be a Source, but is int",
            TypeError,
            lambda: simulate(KEY, {"x": 1}, Observation(BANDS, 2)),
        ),
        ("`second` must be one of x, y, not 'b'", ValueError, lambda: RESULT.correlation("x", "b")),
        ("`components` .* the string 'dust'", TypeError, lambda: separate("dust", PLANCK, MAPS)),
        ("`free` .* string 'a'", TypeError, lambda: separate(["dust"], PLANCK, MAPS, "a")),
        ("`names` .* the string 'dust.x'", TypeError, lambda: get_parameters(sky(), "dust.x")),
    ],
)
def test_refused_by_name(words, error, call):
    with refused(words, error):
        call()


def test_values_that_are_traced_are_taken():
    def maps(beam, level):
        channels = {"100": ObservedBand(BAND, beam, 2 * beam, level)}
        source = Source(next(iter(systems.components().values())))
        nside = int(np.sqrt(source.component.amplitude.shape[-1] // 12))
        return simulate(KEY, {"x": source}, Observation(channels, nside)).sum()

    slopes = jax.jit(jax.grad(maps, argnums=(0, 1)))(600.0, 10.0)
    assert np.all(np.isfinite(slopes))
    smoothed = jax.jit(lambda m: smooth(m, 6000.0))(jnp.ones((2, 48)))
    assert smoothed.shape == (2, 48)


def test_names_may_come_from_a_generator():
    names = ["dust.beta_dust"] if "dust" in sky() else [f"{next(iter(sky()))}.amplitude"]
    assert list(get_parameters(sky(), (name for name in names))) == names
