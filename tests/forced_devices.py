"""Tests on eight devices that XLA makes of this machine's cores; `test_mesh.py` runs them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.sharding import AxisType, Mesh, NamedSharding

import pixels
from benchmarks.pixel_programs import ALONE, moved, programs
from fits.grid import grid_fit
from fits.optimize import best_fit
from fits.posterior import Uniform
from fits.profile_likelihood import spectral_likelihood
from fits.sampling import sample
from fits.template_likelihood import likelihood
from jaxsky import Synchrotron, mesh, observe
from jaxsky.mesh import along, distribute, maps_of
from refusals import raises


def ordinary(maps, fill=None):
    return maps


def explicit(maps, fill=np.nan):
    return distribute(maps, fill=fill)


def automatic(maps, fill=None):
    """As any user's mesh: with automatic axes."""
    devices = Mesh(np.array(jax.devices()), ("pix",), axis_types=(AxisType.Auto,))
    return jax.device_put(maps, NamedSharding(devices, maps_of(maps.ndim)))


# 50 pixels are padded to 56.
@pytest.mark.parametrize(
    ("place", "npix", "varying"),
    [(explicit, 192, False), (explicit, 50, True), (automatic, 192, False), (automatic, 48, True)],
)
def test_template_likelihoods_are_those_of_one_device(place, npix, varying):
    found = pixels.of_templates(npix, place, varying)
    pixels.same(found, pixels.of_templates(npix, ordinary, varying))


@pytest.mark.parametrize(
    ("place", "npix", "kind", "regions", "compress"),
    [
        (explicit, 192, "bands", False, None),
        (explicit, 50, "factor", True, False),
        (explicit, 50, "pixels", True, None),
        (automatic, 192, "pixels", False, None),
        (automatic, 192, "covariance", True, None),
    ],
)
def test_components_are_those_of_one_device(place, npix, kind, regions, compress):
    found = pixels.of_components(npix, place, kind, regions, compress)
    pixels.same(found, pixels.of_components(npix, ordinary, kind, regions, compress))


@pytest.mark.parametrize("piece", [4, 7, 8])
def test_pixels_lie_where_they_belong(piece, monkeypatch):
    monkeypatch.setattr(mesh, "PIECE", piece)
    maps = distribute(np.arange(50.0), fill=None)
    assert maps.shape == (56,)
    parts = [np.asarray(shard.data) for shard in maps.addressable_shards]
    np.testing.assert_array_equal(np.concatenate(parts)[:50], np.arange(50.0))
    np.testing.assert_array_equal(np.concatenate(parts)[50:], 49.0)
    assert np.isinf(distribute(np.arange(9.0), fill=np.inf)).sum() == 7
    monkeypatch.undo()
    asked = []

    def read(part):
        asked.append((part.start, part.stop))
        return np.zeros((2, part.stop - part.start))

    assert distribute(read, shape=(2, 48)).shape == (2, 48)
    assert sorted(asked) == [(start, start + 6) for start in range(0, 48, 6)]


def test_one_distributed_array_is_enough():
    sky = pixels.sky_of(48, False)
    data, sigma = pixels.data_of(48, False)
    like = likelihood(sky, pixels.BANDS, explicit(data), sigma, pixels.START)
    expected = likelihood(sky, pixels.BANDS, data, sigma, pixels.START)
    np.testing.assert_allclose(like.matrix, expected.matrix, rtol=1e-12, atol=1e-9)
    assert along(data, sigma) is sigma


def test_grids_and_chains_take_distributed_pixels():
    data, noise = pixels.data_of(48, False)[0], pixels.noise_of("pixels", 48, ordinary)
    ranges = {"dust.beta_dust": Uniform(1.4, 1.7), "synchrotron.beta_syn": Uniform(2.8, 3.4)}

    def errors(place):
        given = pixels.sky_of(1, False), pixels.BANDS, place(data), place(noise, np.inf)
        like = spectral_likelihood(*given, pixels.START)
        grid = grid_fit(like, priors=ranges, points=20)
        options = {"nsteps": 20, "progress": False, "throw": False}
        chain = sample(like, priors=ranges, **options)
        return [grid.sigma[name] for name in ranges], chain.sigma.keys()

    (grid, chain), (expected, names) = errors(explicit), errors(ordinary)
    np.testing.assert_allclose(grid, expected, rtol=1e-9)
    assert chain == names


def test_gradients_through_a_distributed_sky():
    sky = pixels.sky_of(192, True)

    @jax.jit
    def slope(sky):
        return jax.grad(lambda s: jnp.sum(observe(s, [pixels.BANDS["70"]]) ** 2))(sky)

    found, expected = slope(pixels.placed(sky, explicit)), slope(sky)
    for one, two in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-10)


def test_what_cannot_be_distributed_is_refused():
    words = "Argument `mesh` has 8 devices for 5 pixels; take one with fewer"
    raises(ValueError, words, distribute, np.zeros((2, 5)))
    raises(TypeError, "Argument `shape` is missing", distribute, lambda part: part)
    data, sigma = map(explicit, pixels.data_of(48, True))
    like = likelihood(pixels.sky_of(48, True), pixels.BANDS, data, sigma, {"offset.70.Q": 0.0})
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    words = "is LevenbergMarquardt, and optimistix does not take distributed pixels"
    raises(ValueError, words, best_fit, like, solver=solver)
    call = partial(likelihood, pixels.sky_of(48, True), pixels.BANDS, data, sigma)
    words = "`covariance_of` takes parameters that are numbers where pixels are distributed"
    raises(ValueError, words, call, {"offset.70.Q": 0.0}, covariance_of=np.asarray)
    law = partial(Synchrotron, explicit(np.ones((2, 48))))
    words = "`beta_syn` must be from .* but its mean is -3"
    raises(ValueError, words, law, explicit(np.full(48, -3.0)))
    words = "`beta_syn` has 2 of 48 values that are not finite"
    raises(ValueError, words, law, explicit(np.r_[np.full(46, 3.0), np.nan, np.inf]))


def test_data_are_refused_as_on_one_device():
    data, sigma = pixels.data_of(48, False)
    sky, bands, start = pixels.sky_of(1, False), pixels.BANDS, pixels.START

    def refused(words, noise, data=data, error=ValueError, sky=sky, **options):
        for place in (explicit, ordinary):
            call = partial(spectral_likelihood, sky, bands, place(data), place(noise, np.inf))
            raises(error, words, call, start, **options)

    refused(
        "5 of 480 values that are not > 0", np.where(np.arange(48) < 1, [[[0], [1]]], sigma)[:5]
    )
    refused(
        "42 pixels are seen in fewer bands",
        np.where(np.arange(5)[:, None, None] < 4, np.inf, sigma),
    )
    refused("No pixel is left", np.full_like(sigma, np.inf))
    refused(
        "`data` has 30 values that are not",
        np.ones_like(sigma),
        np.where(np.arange(48) < 3, np.nan, data),
    )
    labels = {"dust.beta_dust": np.arange(48) - 2}
    refused("negative in 2 pixels that are used", np.ones_like(sigma), labels=labels)
    labels = {"dust.beta_dust": np.ones(48)}
    refused("must be integers", np.ones_like(sigma), error=TypeError, labels=labels)
    labels = {"dust.beta_dust": np.ones(47, int)}
    refused("must have shape .48,. like a map", np.ones_like(sigma), labels=labels)
    covariance = np.broadcast_to(np.array([[1.0, 2.0], [2.0, 1.0]])[..., None], (5, 2, 2, 48))
    refused("not positive definite in 240 of 240 values", covariance)


def test_what_only_distributed_pixels_refuse():
    data, _ = pixels.data_of(50, False)
    call = partial(spectral_likelihood, bands=pixels.BANDS, data=explicit(data), noise=np.ones(5))
    sky = pixels.sky_of(50, True)
    raises(ValueError, "`data` has 60 values that are not finite", call, sky, start=pixels.START)
    sky, start = pixels.sky_of(48, True), {"synchrotron.beta_syn": 3.0}
    data = explicit(pixels.data_of(48, False)[0])
    raises(ValueError, "'dust.beta_dust' is a map", call, sky, data=data, start=start)


def test_nothing_that_grows_with_nside_is_moved():
    small, large = programs(4), programs(16)
    for name, program in small.items():
        assert (moved(program) == 0) == (name in ALONE), name
        assert moved(program) == moved(large[name]), name


def test_what_grows_with_nside_is_seen():
    turned = jax.jit(lambda maps: jnp.cumsum(maps, axis=-1))
    few, many = (moved(turned.lower(automatic(np.ones((2, 12 * n**2))))) for n in (4, 16))
    assert many > few > 0
