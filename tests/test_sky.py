"""Skies, parameters by name, and what is refused."""

import gc

import jax
import numpy as np
import pytest

import systems
from jaxsky import (
    Bandpass,
    Dust,
    Sky,
    Synchrotron,
    get_parameters,
    load_instrument,
    observe,
    observe_band,
    parameter_names,
    references,
    set_parameters,
)
from refusals import raises


def test_one_band_is_a_row_of_a_list():
    sky, bands = systems.dust_and_synchrotron(), systems.bands()
    seen = observe(sky, bands)
    assert seen.shape == (2, 2, systems.NPIX)
    np.testing.assert_allclose(observe_band(sky, bands[1]), seen[1], rtol=1e-14)


def test_nothing_is_special_at_the_reference_frequency():
    sky = Sky({"dust": Dust(systems.random_maps(1), nu_ref=545.0)})
    at = observe_band(sky, Bandpass.delta(545.0))
    near = observe_band(sky, Bandpass.delta(545.0 * (1 + 1e-9)))
    np.testing.assert_allclose(at, sky["dust"].amplitude, rtol=1e-14)
    np.testing.assert_allclose(near, at, rtol=1e-8)


def test_the_order_of_components_does_not_matter():
    """JAX sorts dictionaries; node counts chosen for one component must not reach another."""
    parts = {
        "synchrotron": Synchrotron(systems.random_maps(1), systems.spread(3.0, 0.6)),
        "dust": Dust(systems.random_maps(2), systems.spread(1.5, 0.05), systems.spread(20, 2)),
    }
    seen = [
        observe(Sky(dict(order)), systems.bands())
        for order in (parts.items(), reversed(parts.items()))
    ]
    np.testing.assert_array_equal(*seen)
    direct = observe(Sky(parts), systems.bands(), tolerance=0)
    np.testing.assert_allclose(seen[0], direct, rtol=1e-8, atol=1e-9)
    assert observe(Sky({k: parts[k] for k in ("synchrotron", "dust")}), systems.bands()).shape


def test_names_follow_the_tree():
    sky = Sky({"a": systems.components()["two_body_dust"], "b": Synchrotron(np.ones((2, 48)))})
    names = parameter_names(sky)
    assert {"a.beta_dust.0", "a.T_dust.1", "a.E_dust.0", "a.nu_pivot", "b.beta_syn"} <= set(names)


def test_set_and_get_are_inverse_and_leave_the_original():
    sky = systems.dust_and_synchrotron()
    values = {"dust.beta_dust": 1.7, "synchrotron.beta_syn": systems.spread(3.0, 0.1)}
    changed = set_parameters(sky, values)
    for name, value in get_parameters(changed, values).items():
        np.testing.assert_array_equal(value, values[name])
    assert float(sky["dust"].beta_dust) == 1.53


def test_offset_shifts_a_map_as_a_whole():
    beta = systems.spread(1.5, 0.1)
    sky = Sky({"dust": Dust(systems.random_maps(1), beta)})
    moved = set_parameters(sky, {"dust.beta_dust.offset": 0.05})
    np.testing.assert_allclose(moved["dust"].beta_dust, beta + 0.05)


def test_unknown_names_are_answered_with_the_known_ones():
    sky = systems.dust_and_synchrotron()
    for call in (
        lambda: get_parameters(sky, ["dust.beta"]),
        lambda: set_parameters(sky, {"dust.beta": 1.5}),
        lambda: set_parameters(sky, {"dust.beta.offset": 1.5}),
    ):
        raises(KeyError, r"Unknown parameter 'dust\.beta.*dust\.beta_dust, dust", call)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda s: Sky({}), ValueError, "at least one component"),
        (lambda s: Sky({"a.b": s["dust"]}), ValueError, "text without dots, not 'a.b'"),
        (lambda s: Sky({"": s["dust"]}), ValueError, "text without dots, not ''"),
        (lambda s: Sky({"dust": np.ones(3)}), TypeError, "'dust' must be a jaxsky Component"),
        (lambda s: Sky({"a": s["dust"], "b": Dust(np.ones((2, 12)))}), ValueError,
         r"share one shape \(stokes, pix\), but have .*\(2, 12\)"),
        (lambda s: observe(s, Bandpass.delta(30.0)), TypeError,
         "a list of Bandpass; .*observe_band"),
        (lambda s: observe(s, [30.0]), TypeError,
         "Entry 0 of `bands` must be a Bandpass, but is float"),
        (lambda s: observe(s, []), ValueError, "at least one band"),
        (lambda s: set_parameters(s, {"dust.beta_dust": np.ones(5)}), ValueError,
         r"'dust.beta_dust' must be a number or of shape \(48,\), but has shape \(5,\)"),
        (lambda s: set_parameters(s, {"dust.amplitude": 1.0}), ValueError,
         r"'dust.amplitude' must be shape \(2, 48\)"),
    ],
)  # fmt: skip
def test_bad_arguments_are_refused(call, error, words):
    raises(error, words, call, systems.dust_and_synchrotron())


def test_importing_jaxsky_touches_neither_healpy_nor_precision():
    import subprocess
    import sys

    code = (
        "import sys, jax, jaxsky; assert not {'healpy', 'astropy'} & set(sys.modules);"
        "assert not jax.config.read('jax_enable_x64')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("what", "lines"),
    [
        (Dust(np.full((2, 12), 3.0), beta_dust=np.linspace(1.4, 1.6, 12)),
         ["Dust, law 'dust'", "  amplitude  Q, U in 12 pixels, rms 3 uK_RJ",
          "  beta_dust  map from 1.4 to 1.6, median 1.5", "  T_dust     21 K"]),
        (Sky({"dust": Dust(np.ones((3, 12)), (1.6, 2.7), (9.4, 16.2), (0.49, 1.0))}),
         ["Sky of dust", "  dust  amplitude  I, Q, U in 12 pixels, rms 1 uK_RJ",
          "  dust  beta_dust  1.6, 2.7", "  dust  T_dust     9.4 K, 16.2 K"]),
        (Bandpass.top_hat(44.0, 8.0),
         ["Bandpass, weights by the convention 'RJ'", "  center   44 GHz", "  from     40 GHz"]),
        (load_instrument("litebird", ["40", "402"]),
         ["Instrument LiteBIRD", "  channel  center   width      beam         noise",
          "  40       40 GHz   12 GHz     70.5 arcmin  35.901 uK_RJ arcmin"]),
        (load_instrument("litebird")["40"], ["Observed band", "  center  40 GHz"]),
    ],
)  # fmt: skip
def test_objects_print_their_values_with_units(what, lines):
    assert str(what).splitlines()[: len(lines)] == lines
    for line in lines[1:]:
        for cell in line.strip().split("  "):
            assert f"<td>{cell.strip()}</td>" in what._repr_html_() or not cell


def test_objects_print_while_jax_traces():
    seen = []
    jax.jit(lambda sky: seen.append(str(sky)) or 0)(Sky({"dust": Dust(np.ones((2, 12)))}))
    assert "unknown while JAX traces" in seen[0]


def test_the_reference_of_intensity_is_taken_once(monkeypatch):
    """For the same arrays, as long as they live; other ones, and derivatives, as without it."""
    npix = 48
    beta, T = np.linspace(1.4, 1.6, npix), np.linspace(18.0, 22.0, npix)
    maps = 1 + np.arange(3.0 * npix).reshape(3, npix)
    sky = Sky({"dust": Dust(maps, beta, T, nu_ref=353.0, nu_ref_I=545.0)})
    bands = [Bandpass.top_hat(143.0, 40.0)]

    def closed(beta):  # with the law at one frequency, apart
        alone = [Dust(maps, beta, T, nu_ref=nu) for nu in (545.0, 353.0)]
        found = [np.asarray(observe(Sky({"dust": one}), bands)) for one in alone]
        return np.concatenate([found[0][:, :1], found[1][:, 1:]], axis=1)

    made = []
    own = references._intensity
    monkeypatch.setattr(references, "_intensity", lambda one: made.append(1) or own(one))
    seen = [observe(sky, bands) for _ in range(3)]
    np.testing.assert_array_equal(seen[0], seen[2])
    np.testing.assert_allclose(seen[0], closed(beta), rtol=1e-10)
    np.testing.assert_allclose(jax.jit(lambda b: observe(sky, b))(bands), seen[0], rtol=1e-10)
    assert len(made) == 1
    moved = set_parameters(sky, {"dust.beta_dust": beta + 0.1})
    np.testing.assert_allclose(observe(moved, bands), closed(beta + 0.1), rtol=1e-10)
    np.testing.assert_allclose(observe(sky, bands), seen[0], rtol=1e-15)
    assert len(made) == 3

    def total(step):
        return observe(set_parameters(sky, {"dust.beta_dust.offset": step}), bands)[0, 0].sum()

    slope = (total(1e-5) - total(-1e-5)) / 2e-5
    assert float(jax.grad(total)(0.0)) == pytest.approx(float(slope), rel=1e-8)


def test_what_is_kept_goes_with_its_map():
    kept = len(references._KEPT)
    dust = Dust(np.ones((3, 48)), np.linspace(1.4, 1.6, 48), nu_ref=353.0, nu_ref_I=545.0)
    observe(Sky({"dust": dust}), [Bandpass.delta(143.0)])
    assert len(references._KEPT) == kept + 1
    del dust
    gc.collect()
    assert len(references._KEPT) == kept
