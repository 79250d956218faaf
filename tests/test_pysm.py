"""The drop-in for PySM's Sky against PySM itself, on made-up templates under the official names."""

import builtins
import subprocess
import sys

import astropy.units as u
import healpy
import jax
import numpy as np
import pysm3
import pytest
from astropy.config import set_temp_cache
from astropy.utils.data import import_file_to_cache

import jaxsky
from jaxsky import pysm
from jaxsky.io import InputError, MissingFileError
from jaxsky.pysm import units
from jaxsky.pysm.files import URL, find_template
from jaxsky.pysm.presets import preset_settings, pysm_presets
from pysm_files import NSIDE, PRESETS, save, uncompiled, write_drawn, write_others, write_templates
from refusals import cases, raises, refused

__all__ = ["uncompiled"]

#: What there is of each of PySM's presets.
DONE = ["d0", "d1", "d2", "d3", "d4", "d9", "d10", "d12"]
DONE += ["s0", "s1", "s2", "s3", "s4", "s5", "s7", "f1"]
DONE += ["d5", "d7", "d8", "a1", "a2", "c2", "c3", "c4", "co1", "co2", "co3", "dip1", "dip2"]
DONE += ["ksz1", "ksz2", "ksz3", "ksz5", "ksz6", "tsz1", "tsz2", "tsz3", "tsz4"]
DONE += ["cib1", "rg1", "rg3"]
#: Those that are not, which is said by name.
REFUSED = ["c1", "rg2"]
#: Another sky each time that they are made, or in each call.
DRAWN = ["d6", "d11", "s6"]
#: Frequencies and weights [GHz]; none is a reference frequency of I of dust, see below.
BANDS = {
    "one": (217.0, None),
    "top-hat": (np.linspace(85.0, 110.0, 5), None),
    "uneven": ([24.0, 25.0, 29.0, 30.5, 36.0], [0.3, 1.0, 2.5, 2.0, 0.0]),
    "few": ([100.0, 240.0], [1.0, 3.0]),  # with two lines of CO
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pysm")
    write_templates(folder, DONE)
    write_others(folder)
    write_drawn(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYSM_LOCAL_DATA", str(folder))
        yield folder


def band(name):
    nu, weights = BANDS[name]
    return nu * u.GHz, weights if weights is None else np.array(weights)


def agrees(ours, theirs):
    """Equal to 1e-9 of the largest value in each of I, Q, U, and in units."""
    assert str(ours.unit) == str(theirs.unit)
    assert ours.dtype == theirs.dtype
    scale = np.abs(theirs.value).max(axis=1, keepdims=True)
    scale[scale == 0] = 1  # of what is not polarized
    np.testing.assert_allclose(ours.value / scale, theirs.value / scale, rtol=1e-9, atol=1e-9)


def emission(sky, name, nu, weights):
    """PySM's; the sum of that at each frequency where it fails over bands.

    With the beam that maps have, PySM needs to be told that it is wanted.
    """
    if name == "rg3":
        return sky.get_emission(nu, weights, fwhm=5.1 * u.arcmin)
    if name not in ("d5", "d7", "d8") or nu.isscalar:
        return sky.get_emission(nu, weights)
    with pytest.raises(u.UnitsError):
        sky.get_emission(nu, weights)
    normalized = pysm3.utils.normalize_weights(nu.value, weights)
    maps = np.stack([sky.get_emission(one).value for one in nu])
    return np.trapezoid(normalized[:, None, None] * maps, nu.value, axis=0) << units.uK_RJ


@pytest.mark.parametrize("name", DONE)
@pytest.mark.usefixtures("uncompiled", "folder")
def test_presets_agree_with_pysm(name):
    ours, theirs = (
        module.Sky(NSIDE, preset_strings=[name], output_unit="uK_RJ") for module in (pysm, pysm3)
    )
    for own in BANDS:
        found, expected = ours.get_emission(*band(own)), emission(theirs, name, *band(own))
        if name.startswith("dip"):  # without rows
            found, expected = found[None], expected[None]
        agrees(found, expected)


def test_all_of_pysms_presets_are_there_or_refused_by_name():
    assert set(pysm_presets()) == {*DONE, *DRAWN}
    assert {*REFUSED, *DONE, *DRAWN} == set(PRESETS)
    assert len(PRESETS) == 46
    for name in REFUSED:
        with refused(rf"^Preset '{name}' is not in jaxsky: it ", ValueError):
            pysm.Sky(NSIDE, preset_strings=[name])
    raises(KeyError, "Unknown preset 'd99'; known are d0, d1", preset_settings, "d99")


@pytest.mark.usefixtures("folder")
def test_settings_of_presets_are_those_of_pysm():
    """But for the highest nside, which has no effect in either."""
    for name in [*DONE, *DRAWN]:
        theirs, ours = PRESETS[name], preset_settings(name)
        for part in [None] if "class" in theirs else theirs:
            own, found = (x if part is None else x[part] for x in (theirs, ours))
            for key, value in own.items():
                if key == "max_nside" or (key, value) == ("unit_mbb_temperature", "K"):
                    continue
                if key.startswith("freq_") and not value.endswith(".fits"):
                    frequencies = [u.Quantity(x).to_value(u.GHz) for x in (found[key], value)]
                    assert frequencies[0] == pytest.approx(frequencies[1], rel=1e-15)
                elif key == "map_layers":
                    assert found[key] == value
                else:
                    assert found[key] == value, (name, key)


@pytest.mark.usefixtures("uncompiled", "folder")
def test_decorrelated_dust():
    """With the same random numbers as PySM's, whose Sky fails over bands: the sum it stands for.

    It inverts an almost singular matrix twice: with two samples it is right to 1e-8, with five
    close ones to 30 %, so that the covariance is compared with its closed form.
    """
    skies = [module.Sky(NSIDE, preset_strings=["d6"]) for module in (pysm, pysm3)]
    body = pysm3.Sky(NSIDE, preset_strings=["d1"])
    for own, tolerance in (("one", 1e-9), ("few", 1e-8)):
        nu, weights = band(own)
        np.random.seed(3)  # noqa: NPY002 - PySM's
        found = skies[0].get_emission(nu, weights).value
        np.random.seed(3)  # noqa: NPY002
        if nu.isscalar:
            expected = skies[1].get_emission(nu).value
        else:
            normalized = pysm3.utils.normalize_weights(nu.value, weights)
            factors = []
            for nu_ref in (545, 353):
                root, mean = pysm3.models.dust.get_decorrelation_matrix(nu_ref * u.GHz, nu, 5.0)
                factors.append(mean[:, 0] + root @ np.random.randn(nu.size))  # noqa: NPY002
            maps = np.stack([body.get_emission(one).value for one in nu])
            maps *= np.stack(factors, axis=1)[:, [0, 1, 1], None] * normalized[:, None, None]
            expected = np.trapezoid(maps, nu.value, axis=0)
        np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
    raises(ValueError, "DecorrelatedModifiedBlackBody is no component", skies[0].sky)
    model = skies[0].components[0]
    draws = np.array([model._drawn(np.array([300.0, 353.0, 400.0]), 353.0) for _ in range(4000)])
    np.testing.assert_allclose(draws[:, 1], 1, atol=1e-6)
    logs = np.log(np.array([300.0, 400.0]) / 353.0) / 5.0
    closed = np.exp(-0.5 * (logs[0] - logs[1]) ** 2) - np.exp(-0.5 * (logs @ logs))
    assert np.cov(draws[:, [0, 2]].T)[0, 1] == pytest.approx(closed, rel=0.1)


@pytest.mark.parametrize("name", ["d11", "s6"])
@pytest.mark.usefixtures("uncompiled", "folder")
def test_small_scales_that_are_drawn(name):
    """With PySM's seeds its maps, with and without the plane; without seeds others each time."""
    settings = PRESETS[name] | {"seeds": [3, 4, 5] if name == "d11" else [3, 4]}
    bare = {key: value for key, value in settings.items() if not key.startswith("galplane")}
    bare |= {"synalm_lmax": 8}
    found = []
    for own in (settings, bare):
        ours, theirs = (module.Sky(NSIDE, component_config={"x": own}) for module in (pysm, pysm3))
        for nu, weights in map(band, BANDS):
            agrees(ours.get_emission(nu, weights), theirs.get_emission(nu, weights))
        found.append(ours.get_emission(150 * u.GHz).value)
    assert not np.allclose(*found, rtol=0.01)
    before = np.random.get_state()[1:3]  # noqa: NPY002
    again = [pysm.Sky(NSIDE, preset_strings=[name]).get_emission(150 * u.GHz) for _ in range(2)]
    after = np.random.get_state()[1:3]  # noqa: NPY002
    for own, left in zip(before, after, strict=True):  # the user's numbers go on as before
        np.testing.assert_array_equal(own, left)
    assert np.isfinite(again).all()
    assert not np.allclose(*again, rtol=1e-4)
    raises(ValueError, r"`seeds` must have . numbers, not \[1\]", pysm.Sky, NSIDE,
           component_config={"x": settings | {"seeds": [1]}})  # fmt: skip


@pytest.mark.parametrize("unit", ["K_CMB", "MJy/sr", "mK_RJ"])
@pytest.mark.usefixtures("uncompiled", "folder")
def test_skies_in_other_units(unit):
    """Two presets at once; conversions with 2.7255 K and flat spectra, of a weight 0 as PySM."""
    ours, theirs = (
        module.Sky(NSIDE, preset_strings=["d0", "s0"], output_unit=unit) for module in (pysm, pysm3)
    )
    for own in BANDS:
        agrees(ours.get_emission(*band(own)), theirs.get_emission(*band(own)))
        factors = [
            f(*band(own), u.Unit(ours.output_unit), units.unit_of("uK_RJ"))
            for f in (pysm.bandpass_unit_conversion, pysm3.bandpass_unit_conversion)
        ]
        assert factors[0].unit == factors[1].unit
        assert factors[0].value == pytest.approx(factors[1].value, rel=1e-11)


@pytest.mark.usefixtures("uncompiled", "folder")
def test_the_reference_frequency_of_I_is_no_special_case():
    """PySM leaves Q and U at 353 GHz where a sample is at 545 GHz; here they follow the law."""
    ours, theirs = (module.Sky(NSIDE, preset_strings=["d0"]) for module in (pysm, pysm3))
    at, near = ours.get_emission(545 * u.GHz).value, ours.get_emission(545.0001 * u.GHz).value
    np.testing.assert_allclose(at, near, rtol=1e-5)
    templates = ours.components[0].parts[0].component.amplitude
    np.testing.assert_allclose(at[0], templates[0], rtol=1e-12)
    found = theirs.get_emission(545 * u.GHz).value
    np.testing.assert_array_equal(found[1:], templates[1:])
    assert not np.allclose(at[1:], found[1:], rtol=0.01)


@pytest.mark.usefixtures("uncompiled", "folder")
def test_settings_in_pysms_format(tmp_path):
    """A dictionary, a file of TOML, one model or several parts; objects of both."""
    config = {"mine": PRESETS["d0"], "two": {"a": PRESETS["s0"], "b": PRESETS["f1"]}}
    theirs = pysm3.Sky(NSIDE, component_config=dict(config)).get_emission(*band("uneven"))
    ours = pysm.Sky(NSIDE, component_config=config)
    agrees(ours.get_emission(*band("uneven")), theirs)
    assert list(ours.sky()) == ["mine", "two_a", "two_b"]
    path = tmp_path / "config.toml"
    path.write_text("\n".join(f"{key} = {value!r}" for key, value in PRESETS["d0"].items()))
    one = pysm.Sky(NSIDE, component_config=str(path))
    assert len(one.components) == 1
    parts = [one.components[0], *pysm.get_pysm_emission("s0", NSIDE)]
    parts += [pysm3.sky.get_pysm_emission("f1", NSIDE)[0]]  # anything with PySM's interface
    by_place, *others = (
        module.PowerLaw(np.ones(192) * units.uK_RJ, 30 * u.GHz, -3.0, NSIDE, has_polarization=False)
        for module in (pysm, pysm3)
    )
    agrees(by_place.get_emission(*band("few")), others[0].get_emission(*band("few")))
    raises(TypeError, "takes map_I, .*, others by name", pysm.PowerLaw, 1, 2, 3, 4, 5)
    mixed = pysm.Sky(component_objects=parts)
    agrees(mixed.get_emission(*band("uneven")), theirs)
    raises(ValueError, "PowerLaw is no component of jaxsky", mixed.sky)


@pytest.mark.usefixtures("uncompiled", "folder")
def test_maps_between_frequencies(folder, tmp_path):
    """At a frequency between two maps and close to one, over many, and what is behind."""
    ours, theirs = (module.Sky(NSIDE, preset_strings=["cib1"]) for module in (pysm, pysm3))
    for nu in (95.0, 217.001, 17.0, 1080.0, np.linspace(17.0, 1080.0, 7)):
        agrees(ours.get_emission(nu * u.GHz), theirs.get_emission(nu * u.GHz))
    behind = ours.sky()
    assert list(behind)[:3] == ["cib1_0", "cib1_1", "cib1_10"]
    assert behind.shape == (3, 12 * NSIDE**2)
    seen = jaxsky.observe_band(behind, jaxsky.Bandpass.delta(95.0))
    np.testing.assert_allclose(seen, ours.get_emission(95.0 * u.GHz).value, rtol=1e-9)
    local = pysm.WebSkyCIB(NSIDE, local_folder=folder)
    np.testing.assert_array_equal(
        local.get_emission(95 * u.GHz), ours.components[0].get_emission(95 * u.GHz)
    )
    for outside in (16.0 * u.GHz, [1000.0, 1081.0] * u.GHz):
        with pytest.warns(UserWarning, match="has maps from 17 to 1080 GHz, so that it is zero"):
            assert not ours.get_emission(outside).value.any()
    # A folder of maps named by their frequencies, of I alone, with a closed form.
    for nu in (100, 200):
        save(tmp_path / f"{nu}.fits", np.full((1, 12 * NSIDE**2), nu / 100), float, "uK_RJ")
    own = pysm.InterpolatingComponent(tmp_path, "uK_RJ", NSIDE)
    found = own.get_emission(125 * u.GHz).value
    np.testing.assert_allclose(found[0], 1.25, rtol=1e-7)
    assert not found[1:].any()
    raises(InputError, "no folder with maps", pysm.InterpolatingComponent, "nowhere", "uK_RJ", 4)
    save(tmp_path / "many.fits", np.ones((1, 12)), float)
    raises(InputError, "named by its frequency", pysm.InterpolatingComponent, tmp_path, "K_RJ", 4)


@pytest.mark.usefixtures("uncompiled", "folder")
def test_beams_of_maps_between_frequencies():
    """That of the maps by default, and another one or other coordinates as PySM."""
    ours, theirs = (pysm.Sky(16, preset_strings=["rg3"]), pysm3.Sky(16, preset_strings=["rg3"]))
    ours, theirs = ours.components[0], theirs.components[0]
    assert ours.beam == 5.1 * u.arcmin
    nu = [90.0, 110.0] * u.GHz
    plain = ours.get_emission(nu)
    agrees(plain, theirs.get_emission(nu, fwhm=5.1 * u.arcmin))
    np.testing.assert_array_equal(ours.get_emission(nu, fwhm=5.1 * u.arcmin), plain)
    for options in ({"fwhm": 10 * u.deg}, {"fwhm": 10 * u.deg, "coord": ("G", "C")}):
        options |= {"lmax": 20, "output_nside": 8}
        agrees(ours.get_emission(nu, **options), theirs.get_emission(nu, **options))
    raises(ValueError, "Argument `lmax` is missing", ours.get_emission, nu, fwhm=1 * u.deg)


@pytest.mark.usefixtures("folder")
def test_the_sky_behind_it_has_gradients():
    sky = pysm.Sky(NSIDE, preset_strings=["d0", "s0", "s3"])
    behind = sky.sky()
    assert list(behind) == ["d0", "s0", "s3_I", "s3_QU"]
    assert behind.shape == (3, 12 * NSIDE**2)
    assert float(behind["d0"].nu_ref_I) == 545.0
    nu, weights = np.array([90.0, 100.0, 105.0]), np.array([1.0, 2.0, 1.0])
    own = jaxsky.Bandpass(nu, weights, "power")
    seen = jaxsky.observe_band(behind, own)
    np.testing.assert_allclose(seen, sky.get_emission(nu * u.GHz, weights).value, rtol=1e-9)

    @jax.jit
    def power(beta):
        moved = jaxsky.set_parameters(behind, {"d0.beta_dust": beta})
        return (jaxsky.observe_band(moved, own) ** 2).mean()

    step = 1e-5
    slope = (power(1.54 + step) - power(1.54 - step)) / (2 * step)
    assert float(jax.grad(power)(1.54)) == pytest.approx(float(slope), rel=1e-6)


@pytest.mark.parametrize("names", [["d1", "s1"], ["s3", "d0", "dip2"], ["a1", "co1", "cib1"]])
@pytest.mark.usefixtures("folder")
def test_many_bands_at_once(names):
    """As one by one: with maps of parameters, numbers, tables, lines, and few samples or many."""
    rng = np.random.default_rng(2)
    sky = pysm.Sky(NSIDE, preset_strings=names, output_unit="uK_CMB")
    centers = rng.uniform(100.0, 160.0, 9)
    nu = [center * np.linspace(0.85, 1.15, 5 + i % 2) * u.GHz for i, center in enumerate(centers)]
    nu += [100 * u.GHz]
    weights = [rng.uniform(0, 1, own.size) for own in nu]
    found = list(sky.get_emissions(nu, weights, at_once=4))
    assert len(found) == len(nu)
    for own, *one in zip(found, nu, weights, strict=True):
        agrees(own, sky.get_emission(*one))
    agrees(next(sky.get_emissions(nu[:1])), sky.get_emission(nu[0]))
    raises(ValueError, "an entry for each of the 10 bands, but has 1",
           lambda: next(sky.get_emissions(nu, [None])))  # fmt: skip


@pytest.mark.usefixtures("folder")
def test_the_dipole_with_others():
    """In I alone, in any order, and as an object of PySM; alone it has the shape of PySM's."""
    nu = 100 * u.GHz
    alone, dust = (pysm.Sky(NSIDE, preset_strings=[name]) for name in ("dip2", "d0"))
    dipole = alone.get_emission(nu)
    assert dipole.shape == (12 * NSIDE**2,)
    assert alone.components[0].get_emission(nu).shape == dipole.shape
    expected = dust.get_emission(nu)
    expected[0] += dipole
    theirs = pysm3.Sky(NSIDE, preset_strings=["dip2"]).components
    for sky in (
        pysm.Sky(NSIDE, preset_strings=["dip2", "d0"]),
        pysm.Sky(NSIDE, preset_strings=["d0", "dip2"]),
        pysm.Sky(component_objects=[*theirs, *dust.components]),
    ):
        agrees(sky.get_emission(nu), expected)


@pytest.mark.usefixtures("folder")
def test_maps_may_be_changed_in_place():
    """As PySM's; and nothing else sees the change."""
    sky = pysm.Sky(NSIDE, preset_strings=["d0"])
    first = sky.get_emission(100 * u.GHz)
    kept = first.copy()
    first *= 0
    first[0, 0] += 1 * first.unit
    np.testing.assert_array_equal(sky.get_emission(100 * u.GHz), kept)


def test_where_templates_are_looked_for(tmp_path, monkeypatch):
    name = "pysm_2/dust_t_new.fits"
    monkeypatch.delenv("PYSM_LOCAL_DATA", raising=False)
    with refused(
        rf"^{name}: no such file, nor in \$PYSM_LOCAL_DATA \(not set\).*fetch {URL}{name}"
    ):
        find_template(name)
    source = tmp_path / "made_up"
    source.write_text("template")
    with set_temp_cache(tmp_path):
        import_file_to_cache(f"{URL}{name}", source)
        assert find_template(name).read_text() == "template"
    monkeypatch.setenv("PYSM_LOCAL_DATA", str(tmp_path / "local"))
    path = tmp_path / "local" / name
    path.parent.mkdir(parents=True)
    path.write_text("local")
    assert find_template(name) == path
    assert find_template(path) == path
    raises(MissingFileError, "no such file", find_template, tmp_path / "nothing")
    with refused(rf"^{path}: no HEALPix map with columns"):
        pysm.Sky(NSIDE, preset_strings=["d0"])


@pytest.mark.parametrize("nside", [2, 8])
@pytest.mark.usefixtures("uncompiled", "folder")
def test_other_resolutions(nside):
    ours, theirs = (module.Sky(nside, preset_strings=["d0", "s5"]) for module in (pysm, pysm3))
    assert ours.components[1].templates_nside == theirs.components[1].templates_nside == 2048
    agrees(ours.get_emission(*band("one")), theirs.get_emission(*band("one")))


@pytest.mark.slow
def test_files_in_single_precision(tmp_path, monkeypatch):
    """Against PySM's compiled functions, which compute in double precision."""
    monkeypatch.setenv("PYSM_LOCAL_DATA", str(tmp_path))
    names = DONE[: DONE.index("d5")]
    write_templates(tmp_path, names, dtype=np.float32)
    for name in names:
        ours, theirs = (module.Sky(NSIDE, preset_strings=[name]) for module in (pysm, pysm3))
        for own in BANDS:
            agrees(ours.get_emission(*band(own)), theirs.get_emission(*band(own)))


#: Without structure beyond what an analysis without weights resolves.
ALM = np.random.default_rng(5).normal(size=(2, 3, healpy.Alm.getsize(12)))
MAPS = healpy.alm2map(ALM[0] + 1j * ALM[1], 16)


@pytest.mark.parametrize("options", [
    {"fwhm": 10 * u.deg},
    {"fwhm": 10 * u.deg, "output_nside": 32},
    {"fwhm": 15 * u.deg, "output_nside": 8},
    {"rot": "GC", "lmax": 12},
    {"beam_window": np.exp(-np.arange(41) / 10), "rot": "GE"},
    {"beam_window": np.exp(-np.arange(41) / 10) * np.ones((3, 1)), "map2alm_lsq_maxiter": 0},
])  # fmt: skip
def test_smoothing_as_pysm(options):
    options = dict(options)
    if "rot" in options:
        options["rot"] = pysm3.utils.spherical_harmonics.hp.Rotator(coord=options["rot"])
    ours, theirs = (
        module.apply_smoothing_and_coord_transform(MAPS * u.K, **options)
        for module in (pysm, pysm3)
    )
    assert ours.unit == theirs.unit == u.K
    np.testing.assert_allclose(ours.value, theirs.value, rtol=0, atol=1e-9)


def test_equivalencies_are_those_of_pysm():
    nu = np.array([30.0, 353.0]) * u.GHz
    values = np.array([1.0, 2.0])
    for source, target in (("uK_RJ", "uK_CMB"), ("uK_CMB", "MJy/sr"), ("MJy/sr", "uK_RJ")):
        source, target = units.unit_of(source), units.unit_of(target)
        ours, theirs = (
            (values * source).to_value(target, equivalencies=f(nu))
            for f in (units.cmb_equivalencies, pysm3.units.cmb_equivalencies)
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    assert units.GHz is u.GHz
    assert units.uK_CMB == pysm3.units.uK_CMB


def test_bad_input(monkeypatch):
    monkeypatch.delenv("PYSM_LOCAL_DATA", raising=False)
    errors = {"InputError": InputError}
    for arguments, error, words in cases("pysm/skies"):
        raises(errors.get(error) or getattr(builtins, error), words, pysm.Sky, **arguments)
    sky = pysm.Sky(NSIDE, preset_strings=["dip1"])
    for arguments, error, words in cases("pysm/emission"):
        raises(getattr(builtins, error), words, sky.get_emission, **arguments)
    raises(TypeError, "must be in GHz or a unit like it, but are in K", sky.get_emission, 1 * u.K)
    nu = [1.0, 2.0] * u.GHz
    raises(ValueError, "`nu` and `weights` must have one shape", sky.get_emission, nu, [1.0])
    raises(ValueError, "The sky has no component", pysm.Sky(NSIDE).get_emission, nu)
    other = pysm.Sky(2, preset_strings=["dip1"]).components
    raises(ValueError, "Entry 0 .* nside 2, the sky 4", pysm.Sky, 4, component_objects=other)
    for arguments, words in cases("pysm/smoothing"):
        raises(ValueError, words, pysm.apply_smoothing_and_coord_transform, MAPS, **arguments)


def test_pysm_is_not_needed():
    """Sky, units and a preset without files, where PySM and numba cannot be imported."""
    script = """
import sys
sys.modules["pysm3"] = sys.modules["numba"] = None
import jax
jax.config.update("jax_enable_x64", True)
from jaxsky import pysm
from jaxsky.pysm import units as u
sky = pysm.Sky(2, preset_strings=["dip1"], output_unit=u.uK_CMB)
print(sky.get_emission(100 * u.GHz).to_value(u.mK_CMB).max())
"""
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert float(found.stdout) == pytest.approx(3.3666, rel=0.05), found.stderr
