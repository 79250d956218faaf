"""One sweep over every kind of component, then what is particular to each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import systems
from jaxsky import (
    AME,
    CMB,
    Bandpass,
    Component,
    Dust,
    Sky,
    Synchrotron,
    get_parameters,
    observe,
    observe_components,
    parameter_names,
    set_parameters,
)
from jaxsky.components import Moment
from refusals import cases, raises

NAMES = list(systems.components())


def subclasses(cls):
    return {cls} | {c for child in cls.__subclasses__() for c in subclasses(child)}


def spectral(sky):
    return [name for name in parameter_names(sky) if not name.endswith(".amplitude")]


@pytest.fixture(params=NAMES)
def sky(request):
    return Sky({request.param: systems.components()[request.param]})


def test_the_sweep_covers_every_component():
    ours = "jaxsky.components."
    own = {c for c in subclasses(Component) if c.__module__.startswith(ours)} - {Component}
    # A moment has no law of its own, and tests of its own.
    polarized = {c for c in own if c.polarized} - {Moment}
    assert {type(c) for c in systems.components().values()} == polarized


def test_eager_jit_and_vmap_agree(sky):
    bands = systems.bands()
    eager = observe(sky, bands)
    jitted = jax.jit(observe)(sky, bands)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), sky)
    mapped = jax.vmap(lambda s: observe(s, bands))(batch)
    np.testing.assert_allclose(jitted, eager, rtol=1e-12)
    np.testing.assert_allclose(mapped[1], eager, rtol=1e-12)


def test_linear_in_the_amplitude(sky):
    (name,) = sky
    doubled = set_parameters(sky, {f"{name}.amplitude": 2 * sky[name].amplitude})
    np.testing.assert_allclose(
        observe(doubled, systems.bands()), 2 * observe(sky, systems.bands()), rtol=1e-13
    )


def test_every_parameter_changes_the_observation(sky):
    before = observe(sky, systems.bands())
    for name in parameter_names(sky):
        moved = set_parameters(sky, {name: 1.01 * get_parameters(sky, [name])[name]})
        # A line is not in all bands.
        change = jnp.abs(observe(moved, systems.bands()) / before - 1)
        assert float(jnp.nanmax(change)) > 1e-6, name


def test_gradients_against_finite_differences(sky):
    params = get_parameters(sky, spectral(sky))

    @jax.jit
    def seen(logs):
        # In units of each parameter, so that one step of the differences suits all.
        moved = {n: params[n] * (1 + x) for n, x in logs.items()}
        return observe(set_parameters(sky, moved), systems.bands())[:, :, :3]

    zeros = {name: jnp.zeros(()) for name in params}
    check_grads(seen, (zeros,), order=1, modes=["fwd", "rev"], rtol=1e-5, atol=1e-4)


def test_constant_maps_of_all_parameters_are_their_numbers(sky):
    params = get_parameters(sky, spectral(sky))
    maps = {name: jnp.full(systems.NPIX, x) for name, x in params.items() if not x.ndim}
    np.testing.assert_allclose(
        observe(set_parameters(sky, maps), systems.bands()),
        observe(sky, systems.bands()),
        rtol=1e-9,
    )


@pytest.mark.parametrize("stokes", [1, 2, 3])
def test_stokes_rows_share_the_law(stokes):
    for name, component in systems.components(stokes).items():
        seen = observe(Sky({name: component}), systems.bands())
        ratio = seen / component.template
        np.testing.assert_allclose(ratio, ratio[:, :1, :1] * jnp.ones_like(ratio), rtol=1e-12)


@pytest.mark.parametrize("law", [Dust, Synchrotron, AME])
@pytest.mark.parametrize("varying", [False, True])
def test_intensity_and_polarization_have_their_own_reference(law, varying):
    maps, own = systems.random_maps(7, 3), law(systems.random_maps(7, 3))
    name = {Dust: "T_dust", Synchrotron: "beta_syn", AME: "m60"}[law]
    value = getattr(own, name) * (jnp.linspace(0.9, 1.1, systems.NPIX) if varying else 1.0)
    component = law(maps, nu_ref_I=31.0, **{name: value})
    at_I, at_P = observe(Sky({"x": component}), [Bandpass.delta(31.0), Bandpass.delta(own.nu_ref)])
    np.testing.assert_allclose(at_I[0], maps[0], rtol=1e-9)
    np.testing.assert_allclose(at_P[1:], maps[1:], rtol=1e-9)
    scaled = component.sed(31.0)  # the same law for both
    np.testing.assert_allclose(at_I[1:], maps[1:] * scaled, rtol=1e-9)

    def seen(x, nu):
        moved = law(maps, nu_ref_I=nu, **{name: value * x})
        return observe(Sky({"x": moved}), systems.bands())[..., :3]

    one, at = jnp.asarray(1.0), jnp.asarray(31.0)
    check_grads(seen, (one, at), order=1, modes=["fwd", "rev"], rtol=1e-5, atol=1e-4)


def test_single_precision_in_single_precision_out(sky):
    single = jax.tree.map(lambda x: x.astype(jnp.float32), sky)
    bands = [jax.tree.map(lambda x: x.astype(jnp.float32), b) for b in systems.bands()]
    seen = observe(single, bands)
    assert seen.dtype == jnp.float32
    np.testing.assert_allclose(seen, observe(sky, systems.bands()), rtol=1e-4)


def test_components_are_seen_apart_and_sum_up():
    sky = Sky(systems.components())
    apart = observe_components(sky, systems.bands())
    assert set(apart) == set(NAMES)
    np.testing.assert_allclose(
        sum(apart.values()), observe(sky, systems.bands()), rtol=1e-12, atol=1e-12
    )


def test_ame_has_the_dusts_angle_and_its_own_fraction():
    intensity = jnp.abs(systems.random_maps(5)[0])
    dust = systems.random_maps(6, 3)
    ame = AME.from_dust_angles(intensity, dust)
    intensity_seen, Q, U = ame.template
    np.testing.assert_allclose(intensity_seen, intensity)
    np.testing.assert_allclose(jnp.hypot(Q, U), 0.01 * intensity, rtol=1e-12)
    np.testing.assert_allclose(jnp.arctan2(U, Q), jnp.arctan2(dust[2], dust[1]), rtol=1e-12)


def test_ame_is_unpolarized_where_the_dust_is():
    dust = jnp.zeros((2, 12)).at[:, 0].set(1.0)
    ame = AME.from_dust_angles(jnp.ones(12), dust)
    assert float(jnp.abs(ame.template[:, 1:]).max()) == 0.0
    gradient = jax.grad(lambda d: AME.from_dust_angles(jnp.ones(12), d).template.sum())(dust)
    assert bool(jnp.isfinite(gradient).all())


MAPS = np.ones((2, 12))


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: Dust(np.ones((4, 12))), ValueError, r"`amplitude` .* has shape \(4, 12\)"),
        (lambda: Dust(np.ones(12)), ValueError, r"`amplitude` .* shape \(12,\)"),
        (lambda: Dust(MAPS * np.nan), ValueError, "`amplitude` has 24 of 24 values"),
        (lambda: Dust(MAPS * 1j), TypeError, "`amplitude` must be real"),
        (lambda: Dust(MAPS, np.ones(11)), ValueError, r"`beta_dust` .* shape \(12,\), .* \(11,\)"),
        (lambda: Dust(MAPS, T_dust=-np.ones(12)), ValueError, "`T_dust` must be positive.* is -1"),
        (lambda: Dust(MAPS, E_dust=(1.0,)), ValueError,
         "`E_dust` has no effect with a single body"),
        (lambda: Dust(MAPS, nu_pivot=1.0), ValueError, "`nu_pivot` has no effect"),
        (lambda: Dust(MAPS, (1.6, 2.7), (9.4,), (1.0, 1.0)), ValueError,
         r"tuples with one entry a body, but have lengths \[2, 1, 2\]"),
        (lambda: Dust(MAPS, (1.6, 2.7)), ValueError, "must be tuples with one entry a body"),
        (lambda: Synchrotron(MAPS, "steep"), TypeError, "`beta_syn` must be a number"),
        (lambda: Synchrotron(MAPS, 3j), TypeError, "`beta_syn` must be real"),
        (lambda: Synchrotron(MAPS, np.inf), ValueError, "`beta_syn` has 1 of 1 values"),
        (lambda: CMB(MAPS, T_cmb=-1.0), ValueError, "`T_cmb` must be positive"),
        (lambda: Dust(MAPS, nu_ref_I=545.0), ValueError, "`nu_ref_I` of Dust is for .* with I"),
        (lambda: CMB(np.ones((3, 12)), nu_ref_I=1.0), ValueError, "is for a law with nu_ref"),
        (lambda: Dust(np.ones((3, 12)), nu_ref_I=0.5), ValueError, "`nu_ref_I` .* from 1 to"),
        (lambda: AME.from_dust_angles(np.ones(3), MAPS), ValueError,
         r"`intensity` must have shape"),
        (lambda: AME.from_dust_angles(np.ones(12), np.ones((1, 12))), ValueError,
         r"`dust` must have shape \(stokes, pix\) with Stokes Q, U or I, Q, U"),
    ],
)  # fmt: skip
def test_bad_arguments_are_refused(make, error, words):
    raises(error, words, make)


def test_big_endian_maps_are_taken():
    assert Dust(MAPS.astype(">f8")).amplitude.dtype == jnp.float64


@pytest.mark.parametrize(
    ("component", "parameters", "words"),
    [
        *cases("components/signs_and_units"),
        ("Synchrotron", {"beta_syn": np.linspace(-3.2, 0.1, 12)}, "its median is -1.55"),
    ],
)
def test_signs_and_units_that_are_meant_otherwise(component, parameters, words):
    (name,) = parameters
    component = {"Synchrotron": Synchrotron, "Dust": Dust, "AME": AME}[component]
    raises(ValueError, rf"Argument `{name}` .*{words}", component, np.ones((2, 12)), **parameters)
    sky = Sky({"one": component(np.ones((2, 12)))})
    with pytest.raises(ValueError, match=rf"Argument `one.{name}` .*{words}"):
        set_parameters(sky, {f"one.{name}": parameters[name]})
    # What is traced is not looked at, and a map may scatter beyond.
    jax.jit(lambda x: set_parameters(sky, {f"one.{name}": x})["one"].sed(30.0))(1.0)
    Synchrotron(np.ones((2, 12)), beta_syn=np.linspace(-0.1, 3.2, 12))
