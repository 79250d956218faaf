"""Free-free emission, and components from outside of jaxsky in the commands."""

import json
import re

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from commands import experiment, jaxsky
from jaxsky import Bandpass, Component, Sky, observe, set_parameters
from jaxsky.components import FreeFree, amplitude_from_emission_measure
from jaxsky.io import read_maps, write_maps
from jaxsky.settings import Experiment, SettingsError
from refusals import cases, raises

NSIDE = 8
NPIX = 12 * NSIDE**2
#: A component as a user writes it, without a name for its law.
MODULE = """
from jaxsky import sed
from jaxsky.components import Component, parameter, reference, template

class Steep(Component):
    amplitude: object = template()
    slope: object = parameter(2.5, symbol="s")
    nu_ref: object = reference(30.0, within=(1.0, 1e3))

    def sed(self, nu):
        return sed.power_law(nu, self.slope, self.nu_ref)

class Nothing(Component):
    amplitude: object = template()
    nu_ref: object = reference(30.0, within=(1.0, 1e3))

class Undefined(Nothing):
    def sed(self, nu):
        return (30.0 - nu) ** 0.5

class Three(Nothing):
    def sed(self, nu):
        return sed.power_law(nu, 2.5, self.nu_ref)[None].repeat(3)
"""


def gaunt(nu, T_e):
    return np.log(np.exp(5.960 - np.sqrt(3) / np.pi * np.log(nu * (T_e / 1e4) ** -1.5)) + np.e)


def component(T_e=7000.0, **more):
    maps = jnp.zeros((3, 12)).at[0].set(jnp.arange(1.0, 13.0))
    return FreeFree(maps, T_e, **more)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Maps, and a module of the user's, in the current folder."""
    rng, lmax = np.random.default_rng(4), 2 * NSIDE
    steep = healpy.gauss_beam(np.radians(15.0), lmax) / (1 + np.arange(lmax + 1))
    alm = [
        healpy.almxfl(rng.normal(size=(healpy.Alm.getsize(lmax), 2)) @ [50, 50j], steep)
        for _ in range(3)
    ]
    maps = np.array(healpy.alm2map(alm, NSIDE, lmax=lmax))
    write_maps(tmp_path / "intensity.fits", maps[0], names="I", unit="uK_RJ")
    write_maps(tmp_path / "qu.fits", maps[1:], names=["Q", "U"], unit="uK_RJ")
    seen = maps[1:] * (70 / 30) ** -2.5 + 0.02 * rng.normal(size=(2, NPIX))
    write_maps(tmp_path / "seen.fits", seen, names=["Q", "U"], unit="uK_RJ")
    (tmp_path / "steep_law.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_law_is_the_papers():
    """Closed form, and the index of about -2.1 that free-free emission is known for."""
    nu, T_e = 70.0, 8000.0
    expected = (nu / 30) ** -2 * gaunt(nu, T_e) / gaunt(30.0, T_e)
    assert float(component(T_e).sed(nu)) == pytest.approx(expected, rel=1e-13)
    assert float(component().sed(30.0)) == 1.0
    index = np.log(float(component().sed(33.0))) / np.log(1.1)
    assert -2.16 < index < -2.10


def test_emission_measure():
    """0.05468 T_e^-3/2 nu^-2 EM g_ff T_e, and the same temperature at another frequency."""
    EM, T_e = 50.0, 6000.0
    at_30 = float(amplitude_from_emission_measure(EM, T_e, 30.0))
    assert at_30 == pytest.approx(
        1e6 * T_e * 0.05468 * T_e**-1.5 / 900 * EM * gaunt(30.0, T_e), rel=1e-13
    )
    at_70 = float(amplitude_from_emission_measure(EM, T_e, 70.0))
    assert at_70 == pytest.approx(at_30 * float(component(T_e).sed(70.0)), rel=1e-12)


def test_jit_and_gradients():
    sky, bands = Sky({"ff": component()}), [Bandpass.top_hat(44.0, 10.0)]
    seen = observe(sky, bands)
    np.testing.assert_allclose(jax.jit(observe)(sky, bands), seen, rtol=1e-13)
    assert float(jnp.abs(seen[:, 1:]).max()) == 0

    def moved(x):
        return observe(set_parameters(sky, {"ff.T_e": 7000 * x[0], "ff.nu_ref": 30 * x[1]}), bands)

    check_grads(moved, (jnp.ones(2),), order=1, modes=["fwd", "rev"], rtol=1e-6)


def test_maps_of_Q_and_U_are_refused():
    raises(
        ValueError,
        "not polarized: it takes part in I, or I, Q, U only",
        FreeFree,
        jnp.ones((2, 12)),
    )
    raises(ValueError, "Q and U must be zero", FreeFree, jnp.ones((3, 12)))


def test_simulate_scales_an_intensity(folder, monkeypatch):
    (folder / "s.toml").write_text(experiment("free_free"))
    assert jaxsky(monkeypatch, "simulate", "s.toml", "--out", "sims") == 0
    (path,) = (folder / "sims").rglob("*.fits")
    found = np.asarray(read_maps(path).maps)
    template = np.asarray(read_maps(folder / "intensity.fits").maps)[0]
    smooth = healpy.smoothing(template, fwhm=np.radians(np.sqrt(1200**2 - 900**2) / 60), iter=10)
    law = float(component(8000.0).sed(70.0))
    # Written in single precision; healpy leaks a little from beyond the map's multipoles.
    np.testing.assert_allclose(found[0], law * smooth, rtol=0, atol=1e-3 * np.std(found[0]))
    assert np.abs(found[1:]).max() == 0


@pytest.mark.parametrize(("law", "sentence"), cases("free_free/laws_that_cannot_be"))
def test_laws_that_cannot_be(folder, law, sentence, mistake):
    text = experiment("own_law", ("steep_law:Steep", law), ('"x.slope"', '"x.nu_ref"'))
    (folder / "f.toml").write_text(text)
    assert sentence in mistake("fit", "f.toml", "--out", "fit")


@pytest.mark.parametrize("reference", ["a reference", "none"])
def test_a_class_of_ones_own_is_fitted(folder, monkeypatch, reference):
    text = experiment("own_law")
    if reference == "none":
        law = MODULE.replace("    nu_ref: object = reference(30.0, within=(1.0, 1e3))\n", "")
        (folder / "bare_law.py").write_text(law.replace("self.nu_ref", "30.0"))
        text = text.replace("steep_law", "bare_law")
        (folder / "f.toml").write_text(text)
        assert jaxsky(monkeypatch, "fit", "f.toml", "--out", "fit") == 2  # nu_ref that it has not
        text = text.replace("nu_ref = 30.0\n", "")
    (folder / "f.toml").write_text(text)
    assert jaxsky(monkeypatch, "fit", "f.toml", "--out", "fit") == 0
    found = json.loads((folder / "fit" / "result.json").read_text())["results"]["full"]["QU"]
    value = found["gradient"]["best_fit"]["x.slope"]
    sigma = found["gradient"]["covariance"][0][0] ** 0.5
    assert abs(value - 2.5) < 4 * sigma < 0.1


def test_a_law_has_one_class():
    with pytest.raises(ValueError, match=re.escape("'dust' is that of jaxsky.components.laws:")):

        class Another(Component, law="dust"):
            """Takes the name of jaxsky's."""


def test_separate_refuses_what_has_no_polarization():
    from fits.separated_data import separation_data

    settings = Experiment.model_validate(
        {
            "common": {"nside": NSIDE},
            "sky": {"embedded": {"nside": NSIDE}, "ff": {"law": "free_free"}},
            "bands": [{"instrument": "litebird"}],
            "free": {"dust.beta_dust": {"start": 1.5}},
        }
    )
    raises(SettingsError, r"sky\.ff: FreeFree is not polarized", separation_data, settings)
