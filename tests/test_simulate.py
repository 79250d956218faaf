"""Simulated observations: against direct constructions, PySM 3 with healpy, and statistics."""

import functools

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pysm3 import utils
from pysm3.models import dust as pysm_dust
from pysm3.models import power_law as pysm_power_law

from jaxsky import CMB, Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky import harmonics as h
from jaxsky.noise import stream
from jaxsky.observation import Observation, ObservedBand, Source
from jaxsky.simulation import harmonic_sources, observe_bands, plan_terms, simulate
from jaxsky.small_scales import SmallScales
from refusals import raises

NSIDE = 8
NPIX, LMAX = 12 * NSIDE**2, 2 * NSIDE
OWN = 900.0
KEY = jax.random.key(5)
BANDS = {
    "30": Bandpass.top_hat(30.0, 6.0, samples=5),
    "143": Bandpass.top_hat(143.0, 30.0, samples=5),
}
#: Falling spectra of the CMB [uK_CMB^2]; TE below what TT and EE allow.
ELL = np.arange(LMAX + 1)
SPECTRA = np.where(
    ELL > 1, np.array([[1e3], [20.0], [5.0], [50.0]]) / np.maximum(ELL, 1) ** 1.5, 0.0
)


def field(seed, stokes, lmax, fwhm=0.0, nside=NSIDE):
    """A map without multipoles beyond lmax."""
    ell = h.alm_ell(lmax)
    alm = np.random.default_rng(seed).normal(size=(stokes, ell.size)) / (1 + ell)
    window = h.expand(h.gaussian_beam(fwhm, lmax))
    return h.synthesis(jnp.asarray(np.where(ell > 1, alm, 0)) * window, nside)


def template(seed, stokes=2, nside=NSIDE):
    return 100 * field(seed, stokes, 12, OWN, nside)


TEMPLATES = {"dust": template(1), "synchrotron": template(2)}
#: Templates times powers of this have next to nothing beyond LMAX.
BETA = 1.54 + 0.1 * field(3, 1, 3)[0]
SMALL = SmallScales((4, 10), (3, 8), modulation_fwhm=1500.0)


def sources(beta=BETA, small=None, follow=None, templates=TEMPLATES):
    return {
        "dust": Source(Dust(templates["dust"], beta), OWN, small),
        "synchrotron": Source(Synchrotron(templates["synchrotron"], 3.1), OWN, small, follow),
    }


def observation(
    target=None, noise=None, beam=1200.0, bands=BANDS, stokes="QU", precision="double", **options
):
    channels = {n: ObservedBand(b, beam, target, noise, **options) for n, b in bands.items()}
    return Observation(channels, NSIDE, stokes, finest=1000.0, precision=precision)


def observed(key, there, how, cmb=None, terms=None):
    """Maps of all components by band and name."""
    prepared = harmonic_sources(key, there, how, terms)
    return dict(observe_bands(key, prepared, how, cmb, components=True))


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def same(one, other):
    """Equal to the last bit."""
    np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


def test_simulation_is_observe_then_smooth():
    there = sources()
    seen = observe(Sky({n: s.component for n, s in there.items()}), list(BANDS.values()))
    for got, maps in zip(simulate(KEY, there, observation()), seen, strict=True):
        wanted = h.smooth(maps, 1200.0, OWN, LMAX)
        # 1e-7 of the law as a sum of terms, and of the quadrature of the transforms.
        assert rms(got - wanted) < 1e-6 * rms(wanted)


def test_constant_laws_are_exact():
    there, how = sources(beta=1.54), observation()
    laws = {
        name: [float(observe(Sky({"c": s.component}), [b])[0, 0, 0] / s.component.amplitude[0, 0])
               for b in BANDS.values()]
        for name, s in there.items()
    }  # fmt: skip
    ratio = np.asarray(h.expand(h.gaussian_beam(np.sqrt(1200.0**2 - OWN**2), LMAX)))
    alms = {n: np.asarray(h.analysis(m, LMAX)) for n, m in TEMPLATES.items()}
    for i, maps in enumerate(simulate(KEY, there, how)):
        alm = sum(laws[name][i] * alms[name] for name in there)
        wanted = h.synthesis(jnp.asarray(alm * ratio), NSIDE)
        # Linear in the template: nothing but rounding.
        assert rms(maps - wanted) < 1e-10 * rms(wanted)


@pytest.mark.parametrize("small", [None, SMALL], ids=["templates", "small scales"])
def test_single_precision_is_double_precision_rounded(small):
    results = {}
    for precision in ("double", "single"):
        how = observation(precision=precision)
        results[precision] = simulate(KEY, sources(small=small), how)
        assert results[precision].dtype == how.dtype
    assert results["single"].dtype == np.float32
    assert rms(results["single"] - results["double"]) < 5e-7 * rms(results["double"])
    # Draws of CMB and noise are others: in single precision they are made in it.
    how = observation(noise=10.0, precision="single")
    assert simulate(KEY, {}, how, SPECTRA).dtype == np.float32
    per_pixel = observation(1300.0, noise=np.eye(2)[..., None] * np.ones(NPIX), precision="single")
    assert simulate(KEY, sources(1.54), per_pixel).dtype == np.float32


@pytest.mark.parametrize("pixels", [1.5, 3.0, 6.0])
def test_steps_of_the_analysis_are_enough_for_the_beam(pixels):
    """A template with all multipoles that its pixels have, at a beam of so many pixels."""
    nside = 64
    ell = h.alm_ell(2 * nside)
    alm = np.random.default_rng(0).normal(size=(2, ell.size)) / np.maximum(ell, 1) ** 1.2
    maps = h.synthesis(jnp.asarray(np.where(ell > 1, alm, 0)), nside)
    beam = pixels * healpy.nside2resol(nside, arcmin=True)
    channel = ObservedBand(Bandpass.delta(353.0), beam)
    found = simulate(
        KEY, {"dust": Source(Dust(maps))}, Observation({"353": channel}, nside, finest=beam)
    )[0]
    expected = h.synthesis(h.expand(h.gaussian_beam(beam, 2 * nside)) * alm, nside)
    # What is asked is 1e-7; a spectrum may be somewhat worse than the one of the rule.
    assert rms(found - expected) < 4e-7 * rms(expected)


def test_terms_agree_with_bands_one_by_one():
    """To the tolerance that they are chosen for, over more bands than there are terms."""
    there = {"dust": Source(Dust(TEMPLATES["dust"], BETA), OWN)}
    how = observation(
        bands={f"{nu}": Bandpass.delta(nu) for nu in (30.0, 60, 143, 353, 545, 700, 857)}
    )
    terms = plan_terms(there, how)
    assert 1 < len(terms["dust"].vectors) < 6
    summed = simulate(KEY, there, how, terms=terms)
    direct = simulate(KEY, there, how, terms={"dust": None})
    for one, other in zip(summed, direct, strict=True):
        assert rms(one - other) < 1e-7 * rms(other)
    # Asked for less, it is less.
    rough = simulate(KEY, there, how, terms=plan_terms(there, how, 1e-2))
    assert rms(rough[0] - direct[0]) > 1e-6 * rms(direct[0])


def test_against_pysm_and_healpy():
    there, how = sources(), observation()
    dust, synchrotron = (np.array([np.zeros(NPIX), *TEMPLATES[n]]) for n in TEMPLATES)
    ratio = np.asarray(h.gaussian_beam(np.sqrt(1200.0**2 - OWN**2), LMAX))
    T_dust = float(there["dust"].component.T_dust)
    for maps, band in zip(simulate(KEY, there, how), BANDS.values(), strict=True):
        # PySM's weights are on power; a constant response to antenna temperature is 1/nu^2 there.
        nu = np.asarray(band.nu)
        weights = utils.normalize_weights(nu, nu**-2.0)
        emission = pysm_dust.get_emission_numba.py_func(
            nu, weights, *dust, 353.0, 353.0, np.asarray(BETA), T_dust
        ) + pysm_power_law.get_emission_numba_IQU.py_func(
            nu, weights, *synchrotron, 30.0, 30.0, -3.1
        )
        alm = healpy.map2alm(emission, lmax=LMAX, iter=10, use_weights=True)[1:]
        alm = [healpy.almxfl(row, ratio) for row in alm]
        expected = np.array(healpy.alm2map_spin(alm, NSIDE, 2, LMAX))
        # healpy's ten Jacobi steps go on where three end, which shows in what templates times
        # their law have close to LMAX.
        assert rms(maps - expected) < 1e-5 * rms(expected)


def test_components_add_up_and_are_what_is_seen_alone():
    there, how = sources(small=SMALL), observation(noise=300.0)
    seen = observed(KEY, there, how, SPECTRA)
    total = simulate(KEY, there, how, SPECTRA)
    for (name, maps), whole in zip(seen.items(), total, strict=True):
        assert set(maps) == {"dust", "synchrotron", "cmb", "noise", "total"}
        parts = sum(m for n, m in maps.items() if n != "total")
        np.testing.assert_allclose(parts, maps["total"], atol=1e-10 * rms(whole))
        np.testing.assert_allclose(whole, maps["total"], atol=1e-10 * rms(whole))
        assert list(seen).index(name) == list(BANDS).index(name)
    quiet = observation()
    alone = {
        "noise": observed(KEY, {}, how),
        "cmb": observed(KEY, {}, quiet, SPECTRA),
        "dust": observed(KEY, {"dust": there["dust"]}, quiet),
        "synchrotron": observed(KEY, {"synchrotron": there["synchrotron"]}, quiet),
    }
    for component, result in alone.items():
        for name, maps in result.items():
            assert set(maps) == {component, "total"}
            # Jacobi steps of the terms of dust depend on what it is next to: see below.
            error = rms(maps["total"] - seen[name][component])
            assert error <= (1e-5 if component == "dust" else 0) * rms(maps["total"])
    raises(ValueError, "Nothing is left to be observed in band '30'", simulate, KEY, {}, quiet)


def test_linear_in_the_templates():
    doubled = {n: 2 * m for n, m in TEMPLATES.items()}
    one, two = (simulate(KEY, sources(templates=t), observation()) for t in (TEMPLATES, doubled))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-9, atol=1e-12)


# The random streams.


def test_a_stream_does_not_depend_on_the_others():
    there, how = sources(small=SMALL), observation(noise=300.0)
    reference = observed(KEY, there, how, SPECTRA)
    fewer = observed(KEY, {"synchrotron": there["synchrotron"]}, how)
    for name in BANDS:
        same(fewer[name]["noise"], reference[name]["noise"])
        same(fewer[name]["synchrotron"], reference[name]["synchrotron"])
    channels = dict(reversed(how.channels.items()))
    channels["353"] = ObservedBand(Bandpass.delta(353.0), 1200.0, None, 300.0)
    more = Observation(channels, NSIDE, finest=1000.0)
    assert more.names == ("143", "30", "353")
    longer = observed(KEY, there, more, SPECTRA)
    assert list(longer) == ["143", "30", "353"]
    for name in BANDS:
        for part in ("noise", "cmb", "synchrotron"):
            same(longer[name][part], reference[name][part])
        # The terms of dust's law are others with another band, and get other Jacobi steps,
        # which matter where small scales times the law reach beyond LMAX.
        error = rms(longer[name]["dust"] - reference[name]["dust"])
        assert error < 1e-5 * rms(reference[name]["dust"])
    prepared = harmonic_sources(KEY, there, how)
    only = dict(observe_bands(KEY, prepared, how, SPECTRA, names=["143"]))
    assert list(only) == ["143"]
    np.testing.assert_allclose(only["143"]["total"], reference["143"]["total"], rtol=1e-9)


def correlation(one, other):
    one, other = np.ravel(one), np.ravel(other)
    return float(one @ other / np.sqrt((one @ one) * (other @ other))), one.size**-0.5


def test_streams_are_independent():
    there, how = sources(beta=1.54, small=SMALL), observation(noise=300.0)
    first, second = (observed(k, there, how, SPECTRA) for k in jax.random.split(KEY))
    small = [harmonic_sources(k, there, how) for k in jax.random.split(KEY)]

    def injected(prepared, name):
        # Above the joins, whatever the templates have there is the same for both keys.
        return np.asarray(prepared[name].alms[0])[:, h.alm_ell(LMAX) > 12]

    fixed = [(injected(small[0], n) + injected(small[1], n)) / 2 for n in there]
    # Half the difference of two realisations is as random as each of them.
    random = [(injected(small[0], n) - injected(small[1], n)) / 2 for n in there]
    pairs = [
        (first["30"]["noise"], first["143"]["noise"]),
        (first["30"]["noise"], second["30"]["noise"]),
        (first["30"]["noise"][0], first["30"]["noise"][1]),
        tuple(random),
        (random[0][0], random[0][1]),
    ]
    for one, other in pairs:
        value, error = correlation(one, other)
        assert abs(value) < 4 * error
    assert all(rms(r) > 0.1 * rms(f) for r, f in zip(random, fixed, strict=True))
    # Of the CMB, coefficients are independent, not pixels.
    cmb = [h.analysis(maps["30"]["cmb"], LMAX) for maps in (first, second)]
    white = [np.asarray(a / jnp.sqrt(h.expand(jnp.asarray(SPECTRA[1:3])) + 1e-30)) for a in cmb]
    value, error = correlation(*(w[:, h.alm_ell(LMAX) > 1] for w in white))
    assert abs(value) < 4 * error


def test_streams_have_keys_of_their_own():
    names = ["", "30", "143", "dust", "cmb", "noise"]
    keys = [stream(KEY, kind, n) for kind in ("cmb", "noise", "small scales") for n in names]
    assert len({tuple(np.asarray(jax.random.key_data(k))) for k in keys}) == len(keys)


# Noise.


def test_uniform_noise_has_its_level_in_the_pixels():
    maps = simulate(KEY, {}, observation(noise=300.0))
    sigma = 300.0 / healpy.nside2resol(NSIDE, arcmin=True)
    for each in maps:
        # The variance of n normal numbers is known to sqrt(2/n).
        assert abs(np.mean(np.square(each)) / sigma**2 - 1) < 4 * np.sqrt(2 / each.size)


def test_uniform_noise_at_a_common_beam_has_its_spectrum():
    target, beam, level = 1100.0, 800.0, 300.0
    how = observation(target=target, noise=level, beam=beam, bands={"30": BANDS["30"]})
    maps = [simulate(jax.random.key(i), {}, how)[0] for i in range(12)]
    power = np.square(np.stack([h.analysis(m, LMAX) for m in maps]))
    window = np.asarray(h.gaussian_beam(target, LMAX) / h.gaussian_beam(beam, LMAX))
    expected = (level * np.radians(1 / 60) * window[h.alm_ell(LMAX)]) ** 2
    ell = h.alm_ell(LMAX)
    # Also at both ends, where a wrong window would show.
    for part in (ell > 1, (ell > 1) & (ell < 6), ell > 12):
        ratio = power[..., part] / expected[part]
        assert abs(ratio.mean() - 1) < 4 * np.sqrt(2 / ratio.size)


@functools.cache
def covariance():
    """A covariance of each pixel with correlations that differ, and very unequal noise."""
    rng = np.random.default_rng(7)
    roots = rng.normal(size=(NPIX, 2, 2)) * rng.uniform(0.3, 3, (NPIX, 1, 1))
    return jnp.asarray(np.einsum("pik,pjk->ijp", roots, roots) + 0.1 * np.eye(2)[..., None])


def test_noise_of_each_pixel():
    C = np.asarray(covariance())
    maps = np.asarray(simulate(KEY, {}, observation(noise=covariance())))
    diagonal = np.asarray(simulate(KEY, {}, observation(noise=covariance(), diagonal=True)))
    error = 4 * np.sqrt(2 / NPIX)
    for one, other in zip(maps, diagonal, strict=True):
        # Q is the same in both; U has only what Q does not tell.
        same(one[0], other[0])
        rest = C[1, 1] - C[0, 1] ** 2 / C[0, 0]
        for values, variance in ((one[0], C[0, 0]), (one[1], C[1, 1]), (other[1], rest)):
            assert abs(np.mean(values**2 / variance) - 1) < error
        products = one[0] * one[1] / np.sqrt(C[0, 0] * C[1, 1])
        rho = C[0, 1] / np.sqrt(C[0, 0] * C[1, 1])
        assert abs(np.mean(products - rho)) < 4 * np.sqrt(np.mean(1 + rho**2) / NPIX)


@pytest.mark.slow
def test_noise_of_each_pixel_is_smoothed():
    """The sum of squares of smoothed noise, against the covariance as a dense matrix."""
    target, beam, count = 1100.0, 800.0, 8
    how = observation(target=target, noise=covariance(), beam=beam, bands={"30": BANDS["30"]})
    size = np.mean([rms(simulate(jax.random.key(i), {}, how)) ** 2 for i in range(count)])
    rows = jax.lax.map(
        lambda row: h.smooth(row.reshape(2, NPIX), target, beam, LMAX).ravel(),
        jnp.eye(2 * NPIX),
        batch_size=64,
    )
    S, C = np.asarray(rows).T, np.asarray(covariance())
    CST = np.einsum("ijp,rjp->ipr", C, S.reshape(-1, 2, NPIX)).reshape(2 * NPIX, -1)
    dense = S @ CST
    expected = np.trace(dense) / len(dense)
    error = np.sqrt(2 * np.sum(dense**2) / count) / len(dense)
    assert abs(size - expected) < 4 * error
    assert error < 0.1 * expected


# The CMB.


def test_cmb_has_its_spectra_in_each_band():
    target = 1100.0
    how = observation(target=target, beam=800.0)
    maps = [simulate(jax.random.key(i), {}, how, SPECTRA) for i in range(12)]
    for band, factor in zip(maps[0], FACTORS, strict=True):  # one sky in all bands
        np.testing.assert_allclose(band / factor, maps[0][0] / FACTORS[0], rtol=1e-9)
    alms = np.stack([h.analysis(m[0] / FACTORS[0], LMAX) for m in maps])
    ell = h.alm_ell(LMAX)
    window = np.asarray(h.gaussian_beam(target, LMAX))
    for row, spectrum in ((0, SPECTRA[1]), (1, SPECTRA[2])):
        ratio = alms[:, row, ell > 1] ** 2 / (spectrum * window**2)[ell[ell > 1]]
        assert abs(ratio.mean() - 1) < 4 * np.sqrt(2 / ratio.size)
        assert abs(ratio[:, ell[ell > 1] > 12].mean() - 1) < 4 * np.sqrt(2 / ratio.size) * 2
    value, error = correlation(alms[:, 0, ell > 1], alms[:, 1, ell > 1])
    assert abs(value) < 4 * 2 * error  # few modes have most of the power


FACTORS = [float(b.conversion("uK_CMB", "uK_RJ")) for b in BANDS.values()]


def test_cmb_as_a_component_is_seen_as_the_cmb():
    """A template in uK_CMB with the CMB's law, against the realisation through the bands."""
    how = observation(target=1100.0, beam=800.0)
    sky = simulate(KEY, {}, how, SPECTRA)
    mine = {"mine": Source(CMB(sky[0] / FACTORS[0]), 1100.0)}
    # What Jacobi steps leave of a map with multipoles up to 2 nside.
    assert rms(simulate(KEY, mine, how) - sky) < 1e-5 * rms(sky)


@pytest.mark.parametrize("name", ["cmb", "noise", "total"])
def test_names_of_other_maps_are_taken(name):
    with pytest.raises(ValueError, match=f"component cannot be called '{name}', as another map is"):
        simulate(KEY, {name: Source(Synchrotron(template(3)), OWN)}, observation(target=1200.0))


def test_intensity():
    """I, Q, U: a component against healpy, the correlation of T with E, noise in three rows."""
    maps = template(3, 3)
    how = observation(target=1200.0, beam=800.0, stokes="IQU", bands={"30": BANDS["30"]})
    seen = simulate(KEY, {"s": Source(Synchrotron(maps, 3.1), OWN)}, how)[0]
    law = float(observe(Sky({"s": Synchrotron(maps, 3.1)}), [BANDS["30"]])[0, 0, 0] / maps[0, 0])
    ratio = np.asarray(h.gaussian_beam(np.sqrt(1200.0**2 - OWN**2), LMAX))
    alm = healpy.map2alm(np.asarray(maps), lmax=LMAX, iter=10, use_weights=True)
    expected = healpy.alm2map([healpy.almxfl(row, ratio) for row in alm], NSIDE, lmax=LMAX)
    # Two Jacobi steps leave 1e-6 of a map that has multipoles up to LMAX only.
    assert rms(seen - law * expected) < 1e-5 * rms(seen)

    cmb = [h.analysis(simulate(jax.random.key(i), {}, how, SPECTRA)[0], LMAX) for i in range(8)]
    window = np.asarray(h.gaussian_beam(1200.0, LMAX)) * FACTORS[0]
    cross = np.mean([np.asarray(h.power_spectrum(a[0], a[1])) for a in cmb], axis=0) / window**2
    TT, EE, _, TE = SPECTRA[:, 2:]
    variance = (TE**2 + TT * EE) / (2 * ELL[2:] + 1) / len(cmb)
    chi2 = np.sum((cross[2:] - TE) ** 2 / variance)
    assert abs(chi2 - TE.size) < 4 * np.sqrt(2 * TE.size)
    assert np.sum(TE**2 / variance) > 100  # a spectrum without correlation would be noticed

    white = observation(noise=300.0, stokes="IQU", bands={"30": BANDS["30"]})
    noise = np.asarray(simulate(KEY, {}, white)[0])
    sigma = 300.0 / healpy.nside2resol(NSIDE, arcmin=True)
    np.testing.assert_allclose(noise.std(axis=1) / sigma, 1, atol=4 / np.sqrt(2 * NPIX))


# Beams.


def test_beams_as_tables():
    there, bands = sources(beta=1.54), {"30": BANDS["30"]}
    table = h.gaussian_beam(1200.0, 20)
    for target in (None, 1300.0):
        number, by_table = (
            simulate(KEY, there, observation(target, 300.0, beam, bands), SPECTRA)
            for beam in (1200.0, table)
        )
        np.testing.assert_allclose(by_table, number, atol=1e-9 * rms(number))
    flat = jnp.where(jnp.arange(LMAX + 1) < 8, h.gaussian_beam(OWN, LMAX), 0.0)
    cut = simulate(KEY, there, observation(beam=flat, bands=bands))[0]
    own = observe(Sky({n: s.component for n, s in there.items()}), [BANDS["30"]])[0]
    low = jnp.where(h.alm_ell(LMAX) < 8, h.analysis(own, LMAX), 0.0)
    np.testing.assert_allclose(cut, h.synthesis(low, NSIDE), atol=1e-9 * rms(own))


# Derivatives.


NUMBERS = {
    "beta_dust": 1.54,
    "T_dust": 20.0,
    "beta_syn": 3.1,
    "slope": -2.5,
    "tilt": 0.1,
    "amplitude": 1.2,
    "own": 700.0,
    "center": 143.0,
    "beam": 1250.0,
    "target": 1300.0,
    "noise": 10.0,
}


def parametrised(p):
    """A dust index that is a map, a synchrotron index that is a number."""
    small = SmallScales((4, 10), (3, 8), p["slope"], p["tilt"], p["amplitude"], 1500.0)
    dust = Dust(TEMPLATES["dust"], BETA + (p["beta_dust"] - 1.54), p["T_dust"])
    synchrotron = Synchrotron(TEMPLATES["synchrotron"], p["beta_syn"])
    there = {"dust": Source(dust, p["own"], small), "synchrotron": Source(synchrotron, OWN)}
    moved = Bandpass.top_hat(p["center"], 30.0, samples=5)
    channels = {
        "143": ObservedBand(moved, p["beam"], None, p["noise"]),
        "30": ObservedBand(BANDS["30"], 1000.0, p["target"], 2 * p["noise"]),
    }
    return there, Observation(channels, NSIDE, finest=900.0)


@pytest.mark.slow
def test_the_procedure_is_a_differentiable_function():
    """With a fixed key, each number of the whole procedure against finite differences."""
    theta = jnp.array(list(NUMBERS.values()))
    terms = plan_terms(*parametrised(NUMBERS)) | {"dust": None}

    def maps(theta):
        there, how = parametrised(dict(zip(NUMBERS, theta, strict=True)))
        return simulate(KEY, there, how, SPECTRA, terms=terms)

    traced = jax.jit(maps)
    eager = maps(theta)
    np.testing.assert_allclose(traced(theta), eager, atol=1e-10 * rms(eager))
    pull = jax.jit(lambda theta, weight: jax.vjp(maps, theta)[1](weight)[0])
    weights = jax.random.normal(jax.random.key(0), (3, *eager.shape))
    exact = jnp.stack([pull(theta, weight) for weight in weights])
    for i, (name, value) in enumerate(NUMBERS.items()):
        step = jnp.zeros(theta.size).at[i].set(1e-4 * value)
        difference = (traced(theta + step) - traced(theta - step)) / (2e-4 * value)
        projected = weights.reshape(3, -1) @ difference.ravel()
        # The third derivative times the step squared, 1e-8, and rounding over the step, 1e-10.
        size = float(jnp.linalg.norm(difference))
        assert size > 0, name
        np.testing.assert_allclose(exact[:, i], projected, atol=1e-6 * size, err_msg=name)


def test_maps_of_parameters_of_another_resolution_are_brought_to_that_of_the_maps():
    theta = healpy.pix2ang(NSIDE, np.arange(NPIX))[0]
    fine = healpy.pix2ang(2 * NSIDE, np.arange(4 * NPIX))[0]
    sky = [
        {"d": Source(Dust(template(1, nside=n), 1.5 + 0.1 * jnp.cos(colatitude)), OWN)}
        for n, colatitude in ((2 * NSIDE, fine), (NSIDE, theta))
    ]
    one, other = (simulate(KEY, each, observation())[0] for each in sky)
    # What Jacobi steps leave of maps at nside 8 and 16.
    assert rms(one - other) < 1e-6 * rms(other)


# Refusals.


def test_refusals():
    how = observation()
    three = {"s": Source(Synchrotron(template(3, 3), 3.1), OWN)}
    finer, call = observation(target=1100.0, noise=1.0), functools.partial(simulate, KEY)
    raises(ValueError, "'s' has 3 Stokes parameters, but QU are observed", call, three, how)
    raises(ValueError, "finer than that of the channel, 1200 arcmin", call, {}, finer)
    raises(ValueError, "end at l = 10, but nside 8 needs 16", call, {}, how, SPECTRA[:, :11])
    raises(ValueError, "at least one channel", Observation, {}, NSIDE)
    raises(ValueError, "one of I, QU, IQU, not 'Q'", Observation, how.channels, NSIDE, "Q")
