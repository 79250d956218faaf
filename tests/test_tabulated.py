"""Laws that are tables: spinning dust and grains, against PySM's code on made-up tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pysm3
import pytest
from jax.test_util import check_grads
from pysm3.models import spdust
from pysm3.models.hd2017 import HensleyDraine2017

import systems
from jaxsky import Bandpass, Sky, get_parameters, observe, parameter_names, set_parameters
from jaxsky.components import HensleyDraine, SpinningDust
from jaxsky.interpolation import choose_nodes
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


@pytest.fixture
def interpreted(monkeypatch):
    """PySM's functions without numba, which takes longer to compile them."""
    for module in (spdust, pysm3.utils):
        for name, function in list(vars(module).items()):
            if hasattr(function, "py_func"):
                monkeypatch.setattr(module, name, function.py_func)


def spinning(peak, stokes=3, **more):
    return SpinningDust(MAPS[-stokes:], EMISSIVITY, peak, nu_table=30.0, **more)


@pytest.mark.parametrize("peak", [33.35, PEAK], ids=["number", "map"])
@pytest.mark.parametrize("kind", [spdust.SpDust, spdust.SpDustPol])
def test_spinning_dust_is_pysms(kind, peak, interpreted):
    model = pysms(kind, np.broadcast_to(peak, NPIX).copy())
    sky = Sky({"ame": spinning(peak)})
    rows = slice(0, 3 if kind is spdust.SpDustPol else 1)
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


def test_laws_with_kinks_are_summed_directly():
    """A few nodes may seem to do by chance, as the last coefficient happens to be small."""
    bands = (Bandpass(NU, WEIGHTS, "power"),)
    assert choose_nodes(spinning(PEAK), bands, 1e-10) is None
    assert choose_nodes(HensleyDraine(MAPS, systems.grains(), LOG_U), bands, 1e-10) is None


def test_a_table_keeps_its_shape():
    sky = Sky({"ame": spinning(30.0)})
    assert f"emissivity  table of {len(EMISSIVITY)} x 2" in str(sky["ame"])
    doubled = set_parameters(sky, {"ame.emissivity": 2 * sky["ame"].emissivity})
    assert doubled["ame"].emissivity.shape == (*EMISSIVITY.shape, 1)
    with pytest.raises(ValueError, match=r"'ame.emissivity' must be shape \(300, 2, 1\), but has"):
        set_parameters(sky, {"ame.emissivity": EMISSIVITY})


# Hensley & Draine (2017).

U = np.arange(-3.0, 5.01, 0.1)
WAVELENGTHS = np.geomspace(90.0, 31000.0, 160)
FREQUENCIES = 299792.458 / WAVELENGTHS
SHARES = {"sil_fe00": 1 - 0.44, "sil_fe05": 0.44, "car_1.0": 0.9}


def grains(beta, T):
    """nu I_nu of grains, (wavelength, field), in equilibrium with the field."""
    x = np.outer(0.0479924307 * FREQUENCIES, 1 / (T * 10 ** (U / (4 + beta))))
    return 1e-26 * (FREQUENCIES[:, None] / 353) ** (4 + beta) / np.expm1(x)


#: nu I_nu of intensity and polarization for each kind of grain.
GRAINS = {
    name: (grains(beta, T), 0.1 * grains(beta + 0.1, T - 1))
    for name, beta, T in (
        ("sil_fe00", 1.6, 18.0), ("sil_fe05", 1.5, 20.0), ("car_1.0", 1.7, 17.0)
    )
}  # fmt: skip
LOG_U = RNG.normal(0.1, 0.4, NPIX)


def mixed(which):
    """The table of the mixture: I_nu by frequency and field, with margins."""
    total = sum(share * GRAINS[name][which] for name, share in SHARES.items())
    intensity = total / FREQUENCIES[:, None]
    rows = np.concatenate([FREQUENCIES[:, None], intensity], axis=1)[::-1]
    return np.concatenate([[[0.0, *U]], rows])


@pytest.fixture(params=[0.2, LOG_U], ids=["number", "map"])
def hensley_draine(request, monkeypatch):
    """PySM's model, made by its own code from our maps and tables, and the field."""
    rng = np.random.default_rng(3)
    maps = {name: rng.normal(size=NPIX) for name in "IQU"}

    def read_txt(self, name):
        (parts,) = (both for grain, both in GRAINS.items() if grain in name)
        nothing = np.zeros((len(WAVELENGTHS), 2))
        return np.concatenate([WAVELENGTHS[:, None], nothing, *parts], axis=1)

    monkeypatch.setattr(HensleyDraine2017, "read_txt", read_txt)
    monkeypatch.setattr(
        HensleyDraine2017, "read_map", lambda self, name, unit: maps[name] * pysm3.units.Unit(unit)
    )
    files = {f"map_{name}": name for name in "IQU"} | {f"unit_{name}": "uK_RJ" for name in "IQU"}
    references = {"freq_ref_I": "545 GHz", "freq_ref_P": "353 GHz"}
    composition = {"f_fe": SHARES["sil_fe05"], "f_car": SHARES["car_1.0"]}
    options = {"nside": NSIDE, "rnd_uval": False, "uval": request.param}
    model = HensleyDraine2017(**files, **references, **composition, **options)
    return model, np.stack([maps[name] for name in "IQU"]), request.param


def test_hensley_and_draine_is_pysms(hensley_draine):
    model, maps, log_U = hensley_draine
    intensity = HensleyDraine(maps * [[1], [0], [0]], mixed(0), log_U, nu_ref=545.0)
    polarized = HensleyDraine(maps * [[0], [1], [1]], mixed(1), log_U, nu_ref=353.0)
    sky = Sky({"intensity": intensity, "polarized": polarized})
    wide = np.linspace(8.0, 13.0, 11)  # across the frequency where the table ends
    bands = [(np.array([nu]), np.ones(1)) for nu in (6.0, 30.0, 353.0, 857.0)]
    for nu, weights in (*bands, (NU, WEIGHTS), (wide, np.ones(11))):
        # PySM 3.4.6 stops at units where this model is averaged over a band.
        seen = np.stack([model.get_emission(one * pysm3.units.GHz).value for one in nu])
        expected = seen[0]
        if len(nu) > 1:
            normalized = pysm3.normalize_weights(nu, weights)
            expected = np.trapezoid(normalized[:, None, None] * seen, nu, axis=0)
        band = Bandpass(nu, weights, "power")
        np.testing.assert_allclose(observe(sky, [band])[0], expected, rtol=1e-9)


def test_a_power_of_frequency_and_field_is_itself():
    """I_nu ~ U (1 + nu_0/nu): the splines of it are exact, in wavelength and in log U."""
    nu, u = np.geomspace(10.0, 900.0, 20), np.linspace(-1, 1, 7)
    intensity = np.outer(1 + 50 / nu, 2 + u**3)
    made = np.concatenate([[[0.0, *u]], np.concatenate([nu[:, None], intensity], axis=1)])
    law = HensleyDraine(np.ones((2, 12)), made, 0.35, nu_ref=353.0)
    for at in (11.0, 95.0, 857.0):
        expected = (353 / at) ** 2 * (1 + 50 / at) / (1 + 50 / 353)
        assert float(law.sed(at)) == pytest.approx(expected, rel=1e-12)


def test_derivatives_of_hensley_and_draine_against_finite_differences():
    sky = Sky({"dust": HensleyDraine(MAPS[1:, :12], systems.grains(), LOG_U[:12])})
    table, bands = sky["dust"].emissivity, [Bandpass(NU, WEIGHTS, "power")]
    lift = RNG.normal(size=table.shape)
    lift[0], lift[:, 0] = 0, 0  # frequencies and fields stay

    @jax.jit
    def seen(x):
        given = {"log_U": LOG_U[:12] + x[0], "nu_ref": 353 * (1 + x[1]), "emissivity": table}
        given["emissivity"] = table * (1 + x[2] * lift)
        moved = set_parameters(sky, {f"dust.{name}": value for name, value in given.items()})
        return 1e3 * observe(moved, bands)

    check_grads(seen, (jnp.zeros(3),), order=1, modes=["rev"], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("change", "words"), cases("tabulated/bad_tables_of_fields"))
def test_bad_tables_of_fields_are_refused(change, words):
    raises((TypeError, ValueError), words, HensleyDraine, np.ones((2, 12)), change)
