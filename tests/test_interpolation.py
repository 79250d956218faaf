"""Interpolated band averages against the direct sum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import systems
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.chebyshev import coefficients, evaluate, nodes
from jaxsky.interpolation import TRACED_NODES, choose_nodes

MAPS = systems.random_maps(1)
beta, T, beta_syn = systems.spread(1.54, 0.2), systems.spread(21, 4), systems.spread(3.0, 0.3)
SKIES = {
    "beta_dust": Dust(MAPS, beta),
    "T_dust": Dust(MAPS, T_dust=T),
    "beta_dust and T_dust": Dust(MAPS, beta, T),
    "beta_syn": Synchrotron(MAPS, beta_syn),
    "beta_syn and curvature": Synchrotron(MAPS, beta_syn, systems.spread(0.0, 0.2)),
    "one of two bodies": Dust(MAPS, (beta, 2.7), (9.4, 16.2), (0.5, 1.0)),
    "both of two bodies": Dust(MAPS, (beta, beta + 1), (9.4, 16.2), (0.5, 1.0)),
    "nu_ref": Dust(MAPS, nu_ref=systems.spread(353, 20)),
}
BANDS = [
    Bandpass.top_hat(44.0, 12.0, samples=31),
    Bandpass(np.linspace(280.0, 430.0, 60), np.hanning(62)[1:-1], "power"),
]


def error(sky, **options):
    direct = observe(sky, BANDS, tolerance=0)
    return float(jnp.abs(observe(sky, BANDS, **options) / direct - 1).max())


def test_chebyshev_series_reproduce_polynomials_in_two_variables():
    x, y = nodes(4), nodes(3)
    coefs = coefficients(jnp.asarray(x[:, None] ** 3 * (1 + y[None, :] ** 2)))
    a, b = jnp.linspace(-1, 1, 9), jnp.linspace(1, -1, 9)
    np.testing.assert_allclose(evaluate(coefs, a, b), a**3 * (1 + b**2), atol=1e-14)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-7, 1e-10, 1e-12])
@pytest.mark.parametrize("case", SKIES)
def test_error_is_within_the_tolerance(case, tolerance):
    assert error(Sky({"c": SKIES[case]}), tolerance=tolerance) <= tolerance


def test_node_counts_follow_from_tolerance_and_range():
    def count(half_width, tolerance):
        component = Dust(MAPS, systems.spread(1.54, half_width))
        (n,) = choose_nodes(component, tuple(BANDS), tolerance).counts
        return n

    assert count(0.2, 1e-12) > count(0.2, 1e-6) >= 2
    assert count(0.6, 1e-10) > count(0.05, 1e-10)


def test_numbers_need_no_nodes_and_many_maps_are_summed_directly():
    assert choose_nodes(Dust(MAPS), tuple(BANDS), 1e-10) is None
    three = Dust(MAPS, beta, T, nu_ref=systems.spread(353, 1))
    assert choose_nodes(three, tuple(BANDS), 1e-10) is None
    assert error(Sky({"c": three})) == 0.0


def test_the_fixed_count_under_jit_meets_the_stated_ranges():
    wide = Dust(MAPS, systems.spread(1.5, 0.7), systems.spread(22.5, 7.5))
    steep = Synchrotron(MAPS, systems.spread(3.0, 0.7))
    bands = [Bandpass.top_hat(c, 0.3 * c) for c in (23.0, 143.0, 860.0)]
    for component in (wide, steep):
        sky = Sky({"c": component})
        direct = observe(sky, bands, tolerance=0)
        traced = jax.jit(observe)(sky, bands)
        assert float(jnp.abs(traced / direct - 1).max()) < 1e-10
    assert choose_nodes(wide, tuple(bands), 1e-10).counts <= (TRACED_NODES,) * 2


def test_the_tolerance_holds_under_jit_where_the_fixed_count_does_not_do():
    for beta_range, T_range in ((0.5, 25.0), (3.5, 0.1)):
        harsh = Dust(MAPS, systems.spread(1.5, beta_range), systems.spread(35, T_range))
        sky = Sky({"c": harsh})
        bands = [Bandpass.top_hat(44.0, 12.0), Bandpass.top_hat(353.0, 100.0)]
        direct = observe(sky, bands, tolerance=0)
        assert float(jnp.abs(jax.jit(observe)(sky, bands) / direct - 1).max()) < 1e-10
        gradient = jax.grad(lambda s: jnp.sum(observe(s, bands)))(sky)  # noqa: B023
        exact = jax.grad(lambda s: jnp.sum(observe(s, bands, tolerance=0)))(sky)  # noqa: B023
        for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(exact), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8 * float(jnp.abs(b).max()))


@pytest.mark.parametrize("case", ["beta_dust", "beta_dust and T_dust", "beta_syn"])
def test_gradients_through_maps_are_those_of_the_direct_sum(case):
    sky = Sky({"c": SKIES[case]})

    def loss(s, tolerance):
        return jnp.sum(observe(s, BANDS, tolerance=tolerance) ** 2)

    interpolated = jax.grad(loss)(sky, 1e-10)
    direct = jax.grad(loss)(sky, 0)
    for a, b in zip(jax.tree.leaves(interpolated), jax.tree.leaves(direct), strict=True):
        # A derivative of the series loses a factor of about n^2 / range to its value.
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8 * float(jnp.abs(b).max()))


def test_single_precision_reaches_its_own_rounding():
    sky = jax.tree.map(lambda x: x.astype(jnp.float32), Sky({"c": SKIES["beta_dust"]}))
    bands = [jax.tree.map(lambda x: x.astype(jnp.float32), b) for b in BANDS]
    direct = observe(sky, bands, tolerance=0)
    # Rounding of ln S and of the sum over the band: a few 1e-6.
    np.testing.assert_allclose(observe(sky, bands), direct, rtol=1e-5)
