"""Laws that are tables: spinning dust, against PySM's code on made-up tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pysm3
import pytest
from jax.test_util import check_grads
from pysm3.models.spdust import SpDust, SpDustPol

import systems
from jaxsky import Bandpass, Sky, get_parameters, observe, parameter_names, set_parameters
from jaxsky.components import SpinningDust
from refusals import cases, raises

NSIDE = 4
NPIX = 12 * NSIDE**2
RNG = np.random.default_rng(7)
NU = np.linspace(28.0, 44.0, 33)
WEIGHTS = 0.1 + np.hanning(NU.size)
EMISSIVITY = systems.emissivity()


def polarized_maps():
    """Maps of I with I P (cos, sin) of an angle, and P and the angle."""
    intensity, angle = RNG.uniform(10, 90, NPIX), RNG.uniform(-np.pi, np.pi, NPIX)
    return np.stack([intensity, *(0.02 * intensity * f(angle) for f in (np.cos, np.sin))]), angle


MAPS, ANGLE = polarized_maps()
PEAK = RNG.uniform(18.0, 45.0, NPIX)


def pysms(kind, peak):
    """PySM's model with our maps and table in place of files."""
    model = object.__new__(kind)
    model.nside, model.I_ref = NSIDE, MAPS[0] * pysm3.units.uK_RJ
    model.freq_ref_I = 22.8 * pysm3.units.GHz
    model.freq_peak = peak / 30.0 * pysm3.units.dimensionless_unscaled
    model.emissivity = EMISSIVITY.T.copy()
    model.pol_angle, model.pol_frac = ANGLE * pysm3.units.dimensionless_unscaled, 0.02
    return model


def spinning(peak, stokes=3, **more):
    return SpinningDust(MAPS[-stokes:], EMISSIVITY, peak, nu_table=30.0, **more)


@pytest.mark.parametrize("peak", [33.35, PEAK], ids=["number", "map"])
@pytest.mark.parametrize("kind", [SpDust, SpDustPol])
def test_spinning_dust_is_pysms(kind, peak):
    model = pysms(kind, np.broadcast_to(peak, NPIX).copy())
    sky = Sky({"ame": spinning(peak)})
    rows = slice(0, 3 if kind is SpDustPol else 1)
    for nu, weights in ((np.array([22.8]), None), (np.array([95.0]), None), (NU, WEIGHTS)):
        expected = model.get_emission(nu * pysm3.units.GHz, weights).value[rows]
        band = Bandpass(nu, np.ones(1) if weights is None else weights, "power")
        found = observe(sky, [band])[0][rows]
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_peak_lies_where_it_is_said():
    """Without nu_table the table's largest value comes to nu_peak."""
    one = SpinningDust(MAPS[:, :1], EMISSIVITY, 40.0)
    nu = np.geomspace(20.0, 80.0, 2001)
    brightness = nu**2 * np.asarray(one.sed(nu))
    # Rows of the table are 2 % apart.
    assert nu[brightness.argmax()] == pytest.approx(40.0, rel=0.012)
    at = EMISSIVITY[EMISSIVITY[:, 1].argmax(), 0]
    same = SpinningDust(MAPS[:, :1], EMISSIVITY, 40.0, nu_table=at)
    np.testing.assert_allclose(one.sed(nu), same.sed(nu), rtol=1e-14)
    assert float(one.sed(22.8)) == 1.0


def test_derivatives_of_spinning_dust_against_finite_differences():
    sky = Sky({"ame": spinning(PEAK, stokes=2)})
    names = [n for n in parameter_names(sky) if not n.endswith("amplitude")]
    assert names == ["ame.emissivity", "ame.nu_peak", "ame.nu_table", "ame.nu_ref"]
    start, bands = get_parameters(sky, names), [Bandpass(NU, WEIGHTS, "power")]
    lift = jnp.asarray(RNG.normal(size=(len(EMISSIVITY), 1, 1)))

    @jax.jit
    def seen(x):
        moved = {n: start[n] * (1 + x[i]) for i, n in enumerate(names[1:])}
        # Values of the table are moved each by its own.
        values = jnp.concatenate([jnp.zeros_like(lift), lift], axis=1)
        moved[names[0]] = start[names[0]] * (1 + x[3] * values)
        return observe(set_parameters(sky, moved), bands)

    # Steps that stay between two rows of the table in nearly all pixels and samples.
    modes, steps = ["fwd", "rev"], {"rtol": 1e-5, "atol": 1e-6, "eps": 1e-7}
    check_grads(seen, (jnp.zeros(4),), order=1, modes=modes, **steps)


@pytest.mark.parametrize(("change", "words"), cases("tabulated/bad_emissivities"))
def test_bad_emissivities_are_refused(change, words):
    raises((TypeError, ValueError), words, SpinningDust, np.ones((2, 12)), change)


def test_a_table_keeps_its_shape():
    sky = Sky({"ame": spinning(30.0)})
    assert f"emissivity  table of {len(EMISSIVITY)} x 2" in str(sky["ame"])
    doubled = set_parameters(sky, {"ame.emissivity": 2 * sky["ame"].emissivity})
    assert doubled["ame"].emissivity.shape == (*EMISSIVITY.shape, 1)
    with pytest.raises(ValueError, match=r"'ame.emissivity' must be shape \(300, 2, 1\), but has"):
        set_parameters(sky, {"ame.emissivity": EMISSIVITY})
