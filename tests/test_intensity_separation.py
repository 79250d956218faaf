"""Separations of I, Q, U with components that have no polarization."""

import healpy
import jax.numpy as jnp
import numpy as np
import pytest

import fits
from fits.multipoles import harmonic_likelihood
from fits.posterior import chi2
from fits.profile_likelihood import spectral_likelihood
from fits.separated_data import modelled_laws
from fits.separated_maps import component_maps, emission_maps, harmonic_component_maps
from jaxsky import CMB, Bandpass, Dust, FreeFree, Sky, load_instrument, observe
from jaxsky.settings import load
from settings_fuzz import written
from systems import random_maps
from test_intensity import TRUTH, experiment, found_by

BANDS = {
    str(nu): Bandpass.top_hat(nu, 0.2 * nu) for nu in (20.0, 30.0, 44.0, 70.0, 100.0, 220.0, 353.0)
}
START = {"dust.beta_dust": 1.55}


def laws(stokes):
    """The laws that I, or Q and U, or all three have."""
    one = jnp.ones((len(stokes), 1))
    found = {"cmb": CMB(one), "dust": Dust(one)}
    if "I" in stokes:
        found["free_free"] = FreeFree(one.at[1:].set(0.0))
    return found


def observed(npix, seed=0):
    """Maps of a CMB, dust, and free-free emission in I alone, with noise."""
    maps = [100 * np.asarray(random_maps(seed + i, 3, npix)) for i in range(3)]
    sky = Sky(
        {
            "cmb": CMB(maps[0]),
            "dust": Dust(maps[1]),
            "free_free": FreeFree(maps[2] * [[1], [0], [0]]),
        }
    )
    clean = np.asarray(observe(sky, list(BANDS.values())))
    noise = np.random.default_rng(seed).normal(size=clean.shape)
    return clean + 0.5 * noise, maps


def noises(kind, npix):
    """Standard deviations, separable or different in each band and pixel."""
    sigma = 0.5 * np.ones((len(BANDS), 3, npix))
    if kind == "pixels":
        sigma *= np.random.default_rng(5).uniform(0.5, 2.0, sigma.shape)
    return sigma


@pytest.mark.parametrize("kind", ["alike", "pixels"])
@pytest.mark.parametrize("angle", [False, True])
def test_it_is_a_separation_of_I_and_one_of_Q_and_U(kind, angle):
    """The likelihood of both together, and the maps of each; what is not there is exactly zero."""
    data, _ = observed(192)
    sigma = noises(kind, 192)
    start = START | ({"angle.353.0": 0.1} if angle else {})
    whole = spectral_likelihood(laws("IQU"), BANDS, data, sigma, start)
    of_I = spectral_likelihood(laws("I"), BANDS, data[:, :1], sigma[:, :1], START)
    of_QU = spectral_likelihood(laws("QU"), BANDS, data[:, 1:], sigma[:, 1:], start)
    assert whole.values == of_I.values + of_QU.values
    for value in (1.5, 1.62):
        params = START | {"dust.beta_dust": value} | ({"angle.353.0": 0.3} if angle else {})
        own = {"dust.beta_dust": value}
        total = float(chi2(of_I, own)) + float(chi2(of_QU, params))
        assert float(chi2(whole, params)) == pytest.approx(total, rel=1e-10)
    found = component_maps(whole, params, data, sigma)
    alone = component_maps(of_I, own, data[:, :1], sigma[:, :1])
    QU = component_maps(of_QU, params, data[:, 1:], sigma[:, 1:])
    for name in ("cmb", "dust"):
        np.testing.assert_allclose(found.map(name)[:1], alone.map(name), rtol=1e-9)
        np.testing.assert_allclose(found.map(name)[1:], QU.map(name), rtol=1e-9)
        np.testing.assert_allclose(found.sigma(name)[:1], alone.sigma(name), rtol=1e-9)
        np.testing.assert_allclose(found.sigma(name)[1:], QU.sigma(name), rtol=1e-9)
        assert found.mean_degradation(name) > 1
    np.testing.assert_allclose(found.map("free_free")[0], alone.map("free_free")[0], rtol=1e-9)
    for rest in (
        found.map("free_free")[1:],
        found.sigma("free_free")[1:],
        found.covariance[2, :, 1:],
    ):
        np.testing.assert_array_equal(rest, 0.0)
    assert found.mean_degradation("free_free") == pytest.approx(alone.mean_degradation("free_free"))
    np.testing.assert_allclose(found.chi2, alone.chi2 + QU.chi2, rtol=1e-8)
    np.testing.assert_array_equal(found.dof, alone.dof + QU.dof)
    emission = emission_maps(whole, params, found.amplitude)
    np.testing.assert_allclose(
        emission[:, :1, :], emission_maps(of_I, own, alone.amplitude)[..., :], rtol=1e-9
    )
    np.testing.assert_allclose(
        emission[:, 1:, :], emission_maps(of_QU, params, QU.amplitude)[..., :], rtol=1e-9
    )


def test_derivatives_are_those_of_finite_differences():
    data, _ = observed(48)
    start = START | {"free_free.T_e": 7000.0, "gain.353.0": 1.0}
    like = spectral_likelihood(laws("IQU"), BANDS, data, noises("pixels", 48), start)
    theta = like.flat({})

    def value(x):
        return like.total(x[like.cells()]) / 2

    found = like.derivatives(theta[like.cells()])
    for i, step in enumerate((1e-4, 1.0, 1e-5)):
        moved = [theta.at[i].add(s * step) for s in (1, -1)]
        difference = (value(moved[0]) - value(moved[1])) / (2 * step)
        assert float(found.gradient.sum(0)[i]) == pytest.approx(float(difference), rel=1e-5)
        slopes = [like.derivatives(m[like.cells()]).gradient.sum(0) for m in moved]
        np.testing.assert_allclose(
            found.hessian.sum(0)[i], (slopes[0] - slopes[1]) / (2 * step), rtol=1e-4
        )


def test_multipoles():
    """The likelihood in the harmonic domain, from the same two."""
    lmax, rng = 8, np.random.default_rng(1)
    alm = rng.normal(size=(len(BANDS), 3, (lmax + 1) ** 2))
    beams, noise = 60.0 * np.ones(len(BANDS)), rng.uniform(1.0, 2.0, (len(BANDS), 3))
    noise[:, 2] = noise[:, 1]
    given = {"beams": beams}
    whole = harmonic_likelihood(laws("IQU"), BANDS, alm, noise, START, **given)
    of_I = harmonic_likelihood(laws("I"), BANDS, alm[:, :1], noise[:, :1], START, **given)
    of_QU = harmonic_likelihood(laws("QU"), BANDS, alm[:, 1:], noise[:, 1:], START, **given)
    assert whole.values == of_I.values + of_QU.values
    total = float(chi2(of_I, START)) + float(chi2(of_QU, START))
    assert float(chi2(whole, START)) == pytest.approx(total, rel=1e-10)
    found = harmonic_component_maps(whole, START, alm, noise, **given)
    np.testing.assert_array_equal(found.map("free_free")[1:], 0.0)
    QU = harmonic_component_maps(of_QU, START, alm[:, 1:], noise[:, 1:], **given)
    np.testing.assert_allclose(found.map("cmb")[1:], QU.map("cmb"), rtol=1e-9, atol=1e-12)


def test_separate_finds_what_went_in():
    npix = healpy.nside2npix(8)
    instrument = load_instrument("planck", stokes="IQU")
    maps = [20 * np.asarray(random_maps(i, 3, npix)) for i in range(2)]
    ff = 20 * np.asarray(random_maps(7, 3, npix)) * [[1], [0], [0]]
    sky = Sky(
        {"cmb": CMB(maps[0]), "dust": Dust(maps[1], beta_dust=1.6), "free_free": FreeFree(ff)}
    )
    data = observe(sky, list(instrument.bands().values()))
    found = fits.separate(["cmb", "dust", "free_free"], instrument, data, unit="uK_RJ")
    assert found.fit.best_fit["dust.beta_dust"] == pytest.approx(1.6, abs=1e-8)
    np.testing.assert_allclose(found.maps.map("free_free"), ff, atol=1e-6)
    np.testing.assert_array_equal(found.maps.map("free_free")[1:], 0.0)
    np.testing.assert_allclose(found.maps.map("dust"), maps[1], atol=1e-6)
    with pytest.raises(ValueError, match="`prior` is of amplitudes of I, Q, U, but 'free_free' is"):
        fits.separate(["cmb", "dust", "free_free"], instrument, data, prior={"dust": 1.0})
    with pytest.raises(ValueError, match="None of the components is polarized"):
        fits.separate(["free_free"], instrument, data, {"free_free.T_e": 7000.0})


def test_the_reference_frequency_is_that_of_I(tmp_path):
    sky = {"dust": {"law": "dust"}, "ff": {"law": "free_free", "nu_ref": [30.0, 44.0]}}
    settings = experiment("IQU") | {"sky": sky, "free": {}}
    laws, _ = modelled_laws(load(written(tmp_path / "x.toml", settings)))
    assert float(laws["ff"].nu_ref) == 30.0


@pytest.mark.slow
@pytest.mark.parametrize("domain", ["pixel", "harmonic"])
def test_the_command(domain, tmp_path, monkeypatch):
    separate = {"domain": domain, "region": "full" if domain == "harmonic" else "outside"}
    separate |= {"nsims": 20, "sampler": "none", "lmax": 20, "width": 6}
    channels = ("30", "44", "70", "100", "143", "217", "353")
    settings = experiment("IQU", channels, separate=separate)
    settings["simulate"]["include"] = ["dust", "synchrotron", "cmb", "noise"]
    settings["sky"]["ff"] = {"law": "free_free"}
    path = written(tmp_path / "x.toml", settings)
    found = found_by(monkeypatch, "separate", path, tmp_path / "out")
    for name, truth in TRUTH.items():
        one = found["parameters"][name]
        assert abs(one["best_fit"] - truth) < 4 * one["sigma"]
    assert "r" in found
