"""Interpolated band averages against the direct sum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebpts1

import systems
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.bandpass import average, stack_bands
from jaxsky.interpolation import (
    TRACED_NODES,
    _coefficients,
    _evaluate,
    band_sed,
    band_seds,
    choose_nodes,
    choose_terms,
    term,
    term_weights,
)

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


def one_and(first, *others):
    """A value for each run of the tests, and more of them for the slow ones."""
    return [first, *(pytest.param(value, marks=pytest.mark.slow) for value in others)]


def error(sky, **options):
    direct = observe(sky, BANDS, tolerance=0)
    return float(jnp.abs(observe(sky, BANDS, **options) / direct - 1).max())


def test_chebyshev_series_reproduce_polynomials_in_two_variables():
    x, y = chebpts1(4), chebpts1(3)
    coefs = _coefficients(jnp.asarray(x[:, None] ** 3 * (1 + y[None, :] ** 2)))
    a, b = jnp.linspace(-1, 1, 9), jnp.linspace(1, -1, 9)
    np.testing.assert_allclose(_evaluate(coefs, a, b), a**3 * (1 + b**2), atol=1e-14)


@pytest.mark.parametrize("tolerance", one_and(1e-10, 1e-4, 1e-7, 1e-12))
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


@pytest.mark.slow
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


@pytest.mark.parametrize("case", one_and("beta_dust", "beta_dust and T_dust", "beta_syn"))
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


#: More bands than terms, over a wide range.
MANY = tuple(Bandpass.delta(nu) for nu in (30.0, 60.0, 100.0, 143.0, 217.0, 353.0, 545.0, 857.0))


def summed(component, bands, terms):
    """The law in each band and pixel as a sum of terms, shape (band, pix)."""
    maps = jnp.stack([term(component, terms.coefs(i)) for i in range(len(terms.vectors))])
    return jnp.stack(term_weights(component, bands, terms)) @ maps


def law(component, bands):
    return jnp.stack([band_sed(component, band, None) for band in bands])


@pytest.mark.parametrize("tolerance", one_and(1e-6, 1e-3, 1e-9))
@pytest.mark.parametrize("case", ["beta_dust", "beta_dust and T_dust", "beta_syn"])
def test_terms_add_up_to_the_law(case, tolerance):
    component = SKIES[case]
    exact = law(component, MANY)
    importance = 1 / jnp.sqrt(jnp.mean(exact**2, axis=1))
    terms = choose_terms(component, MANY, importance, tolerance)
    error = jnp.sqrt(jnp.mean((summed(component, MANY, terms) - exact) ** 2, axis=1)) * importance
    # A term left out adds at most its size, `tolerance`; several may be.
    assert float(error.max()) < 3 * tolerance
    assert min(terms.sizes) > tolerance
    assert list(terms.sizes) == sorted(terms.sizes, reverse=True)
    np.testing.assert_allclose(
        terms.vectors @ terms.vectors.T, np.eye(len(terms.sizes)), atol=1e-12
    )


def test_there_are_no_more_terms_than_needed():
    def count(component, tolerance, bands=MANY):
        importance = 1 / jnp.sqrt(jnp.mean(law(component, bands) ** 2, axis=1))
        return len(choose_terms(component, bands, importance, tolerance).vectors)

    narrow = Dust(MAPS, systems.spread(1.54, 0.02))
    assert count(narrow, 1e-6) < count(SKIES["beta_dust"], 1e-6) < len(MANY)
    assert count(narrow, 1e-2) < count(narrow, 1e-6)
    assert count(SKIES["beta_dust"], 1e-12, MANY[:2]) == 2


def test_a_component_of_less_importance_needs_fewer_terms():
    component = SKIES["beta_dust"]
    importance = 1 / jnp.sqrt(jnp.mean(law(component, MANY) ** 2, axis=1))
    few, many = (
        len(choose_terms(component, MANY, f * importance, 1e-7).vectors) for f in (1e-4, 1)
    )
    assert few < many


def test_a_law_without_maps_is_one_exact_term():
    component = Dust(MAPS)
    terms = choose_terms(component, MANY, jnp.ones(len(MANY)), 1e-2)
    assert terms.counts == ()
    weights = jnp.stack(term_weights(component, MANY, terms))
    np.testing.assert_allclose(weights[:, 0], law(component, MANY))
    # Weights are for whatever the numbers are; a term chosen before serves all.
    other = Dust(MAPS, 1.7, 18.0)
    weights = jnp.stack(term_weights(other, MANY, terms))
    np.testing.assert_allclose(weights[:, 0], law(other, MANY))
    assert float(term(component, terms.coefs(0))) == 1.0


def test_no_terms_where_bands_are_better_averaged_one_by_one():
    ones = jnp.ones(len(MANY))
    three = Dust(MAPS, beta, T, nu_ref=systems.spread(353, 1))
    assert choose_terms(three, MANY, ones, 1e-7) is None
    unresolved = Dust(MAPS, systems.spread(1.5, 3.5), systems.spread(35, 25))
    assert choose_terms(unresolved, MANY, ones, 1e-10) is None
    found = []
    jax.jit(lambda beta: found.append(choose_terms(Dust(MAPS, beta), MANY, ones, 1e-7)))(beta)
    assert found == [None]


def test_derivatives_of_weights_are_those_of_the_law():
    """Of the frequency of a band, with terms that were chosen before."""
    component = SKIES["beta_dust"]
    terms = choose_terms(component, MANY, 1 / law(component, MANY).mean(axis=1), 1e-12)

    def by_terms(nu):
        return summed(component, (Bandpass.delta(nu),), terms)[0]

    exact = jax.jacfwd(lambda nu: law(component, (Bandpass.delta(nu),))[0])(200.0)
    # 200 GHz is none of the bands, between which the law goes smoothly.
    np.testing.assert_allclose(jax.jacfwd(by_terms)(200.0), exact, rtol=1e-5)


@pytest.mark.parametrize(
    "case", one_and("wide", "beta_syn", "beta_dust and T_dust", "both of two bodies")
)
def test_all_bands_at_once_are_each_alone(case):
    """Outside of jit, and inside, where a range that is too wide is summed directly."""
    wide = Dust(MAPS, systems.spread(1.5, 3.0), systems.spread(40.0, 35.0))
    component = SKIES.get(case, wide)
    direct = jnp.stack([average(component.sed, band) for band in BANDS], axis=1)
    samples, bands = stack_bands(BANDS), tuple(BANDS)

    @jax.jit
    def traced(component):
        return band_seds(component, samples, choose_nodes(component, bands, 1e-11))

    eager = band_seds(component, samples, choose_nodes(component, bands, 1e-11))
    for found in (eager, traced(component)):
        np.testing.assert_allclose(found, direct, rtol=1e-10)

    def total(function):
        return jax.grad(lambda c: jnp.sum(function(c) ** 2))(component)

    slopes = [total(f) for f in (traced, lambda c: jnp.stack([average(c.sed, b) for b in BANDS]))]
    for one, other in zip(*map(jax.tree.leaves, slopes), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9 * float(jnp.abs(other).max()))


def test_a_law_without_maps_is_a_number_in_each_band():
    law = band_seds(Dust(MAPS), stack_bands(BANDS), None)
    np.testing.assert_allclose(law, [average(Dust(MAPS).sed, band) for band in BANDS], rtol=1e-14)
