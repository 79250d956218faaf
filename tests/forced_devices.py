"""Tests on eight devices that XLA makes of this machine's cores; `test_mesh.py` runs them."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.sharding import AxisType, Mesh, NamedSharding

import pixels
from fits import distributed
from fits.optimize import best_fit
from fits.posterior import _cell_derivatives, value_and_gradient
from fits.products import gram
from fits.profile_likelihood import spectral_likelihood
from fits.separated_maps import _on_devices
from fits.template_likelihood import likelihood
from jaxsky import Synchrotron, mesh, observe
from jaxsky.mesh import along, distribute, maps_of
from jaxsky.sky import _observe, interpolation_nodes
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
        (explicit, 192, "factor", False, None),
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
    raises(ValueError, "takes the residuals of all pixels to one", best_fit, like, solver=solver)
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


COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")
BYTES = {"f64": 8, "f32": 4, "s64": 8, "s32": 4, "u32": 4, "u8": 1, "pred": 1}


def moved(program: jax.stages.Lowered) -> int:
    """Bytes that the collectives of a compiled program move."""
    text = program.compile().as_text()
    found = re.findall(rf"= (\(?[^=]*?) (?:{'|'.join(COLLECTIVES)})(?:-start)?\(", text)
    shapes = [shape for result in found for shape in re.findall(r"(\w+)\[([\d,]*)\]", result)]
    assert sum(text.count(f" {word}(") for word in COLLECTIVES) == len(found)
    return sum(
        BYTES[kind] * int(np.prod([int(n) for n in axes.split(",") if n])) for kind, axes in shapes
    )


def programs(nside: int) -> dict[str, jax.stages.Lowered]:
    """The passes over pixels as they are compiled for distributed maps."""
    npix = 12 * nside**2
    data, sigma = map(explicit, pixels.data_of(npix, True))
    sky = pixels.placed(pixels.sky_of(npix, True), explicit)
    bands = tuple(pixels.BANDS.values())
    templates = explicit(np.ones((2, 2, npix)))
    nodes = interpolation_nodes(sky, bands, 1e-10)
    noise, labels = pixels.noise_of("factor", npix, explicit), np.arange(npix) // 5 % 3
    like = spectral_likelihood(
        *(pixels.sky_of(1, False), pixels.BANDS, data, noise, pixels.START),
        labels={"dust.beta_dust": labels},
        compress=False,
    )
    used = distributed.look(data, noise, 2).used
    labels = distributed.check_labels("labels", labels, used)
    blocks = distributed.blocks(distributed.intersections({"labels": labels}, used), used)
    (layout,) = like.layout
    return {
        "observe": _observe.lower(sky, bands, nodes, False),
        "gram": jax.jit(gram).lower(data, templates, sigma),
        "likelihood": _cell_derivatives.lower(like, like.flat({})),
        "gradient": jax.jit(value_and_gradient).lower(like, like.flat({})),
        "band covariance": distributed._covariance.lower(data, noise, blocks, layout, 3),
        "blocks": jax.jit(partial(distributed.gathered, layout=layout)).lower(data, noise, blocks),
        "used pixels": distributed._look.lower(data, noise, 2),
        "maps": _on_devices.lower(None, (np.ones((1, 5, 2)),), data, noise, (layout,), True),
    }


def test_nothing_that_grows_with_nside_is_moved():
    small, large = programs(4), programs(16)
    for name, program in small.items():
        # Maps of components and blocks take nothing from other devices.
        assert (moved(program) == 0) == (name in ("maps", "blocks")), name
        assert moved(program) == moved(large[name]), name


def test_what_grows_with_nside_is_seen():
    turned = jax.jit(lambda maps: jnp.cumsum(maps, axis=-1))
    few, many = (moved(turned.lower(automatic(np.ones((2, 12 * n**2))))) for n in (4, 16))
    assert many > few > 0
