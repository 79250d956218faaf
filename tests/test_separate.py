"""Separation from settings: pulls of laws and r, a wrong law, both domains, bad settings."""

import dataclasses
import functools
from concurrent.futures import ThreadPoolExecutor

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fits import cleaning as module
from fits.cleaning import Response, separate_data
from fits.commands import separate as command
from fits.commands.run import DEFAULTS
from fits.commands.separate import separation_warnings
from fits.optimize import best_fit
from fits.posterior import priors_of
from fits.pseudo_cl import band_powers
from fits.results import widened
from fits.separated_data import separation_data
from fits.tensor_ratio import fit_tensors
from jaxsky.cmb import camb_spectra, realisation
from jaxsky.harmonics import expand, gaussian_beam, lmax_of, power_spectrum, synthesis
from jaxsky.io import InputError
from jaxsky.programs import Progress
from jaxsky.settings import Experiment, SettingsError, load
from refusals import cases, raises

NSIDE, FWHM = 16, 360.0
CHANNELS = ["40", "68", "100", "140", "195", "280", "402"]
FREE = {
    "dust.beta_dust": {"start": 1.6, "uniform": [0.5, 2.5]},
    "dust.T_dust": {"start": 19.0, "gaussian": [21.0, 2.0]},
    "synchrotron.beta_syn": {"start": 3.0},
}
SKY = {"embedded": {"nside": NSIDE}}


def settings(**changes):
    tables = {
        "title": "small",
        "seed": 2,
        "sky": SKY,
        "bands": [{"instrument": "litebird", "channels": CHANNELS}],
        "common": {"nside": NSIDE, "fwhm": FWHM},
        "free": FREE,
        "separate": {"region": "outside", "nsims": 20, "width": 4, "apodization": 20.0},
    }
    for name, value in changes.items():
        both = name in ("common", "separate")
        tables[name] = tables[name] | value if both else value
    return Experiment.model_validate(tables)


@functools.cache
def separated(domain: str = "pixel", nsims: int = 20, sampler: str = "none", region="outside"):
    spec = {"domain": domain, "nsims": nsims, "sampler": sampler, "region": region}
    how = settings(separate=spec)
    given = separation_data(how)
    return how, given, separate_data(how, given)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("domain", "region", "r"),
    [
        ("pixel", "outside", 0.0),
        ("pixel", "outside", 0.01),
        ("harmonic", "outside", 0.01),
        ("harmonic", "full", 0.01),
    ],
)
def test_pulls_of_laws_and_r(domain, region, r):
    """Outside a mask: smoothed noise and multipoles are correlated, and E leaks into B."""
    count = 300
    how, given, found = separated(domain, 600, region=region)
    in_pixels = not given.exact
    lmax = 2 * NSIDE if in_pixels else lmax_of(given.observed)
    spectra = jnp.asarray(camb_spectra(lmax, r))
    beams = [FWHM] if in_pixels else given.fwhms
    windows = jnp.stack([expand(gaussian_beam(fwhm, lmax)) for fwhm in beams])

    @jax.jit
    def cmb(key):
        alm = realisation(key, spectra) * windows[:, None]
        return synthesis(alm[0], NSIDE) if in_pixels else alm

    model = found.tensors.model
    # The error at the truth: those at estimates grow with them where few modes decide.
    sigma = 1 / np.sqrt(model.tensors @ np.linalg.solve(model.covariance(r), model.tensors))
    pulls, ratios = [], []
    for key in jax.random.split(jax.random.key(78), count):
        noise = given.noise_realisation(jax.random.fold_in(key, 1))
        data = given.foregrounds + np.asarray(cmb(key)) + noise
        if in_pixels:
            data = np.where(given.used, data, 0.0)
        like = given.likelihood(data)
        # A prior's mean is measured, too.
        prior = priors_of(how, "separate")
        mean = 21.0 + 2.0 * float(jax.random.normal(jax.random.fold_in(key, 2)))
        prior["dust.T_dust"] = type(prior["dust.T_dust"])(mean, 2.0)
        fit = best_fit(like, found.fit.best_fit, priors=prior)
        pulls.append([(fit.best_fit[n] - given.truth[n]) / found.sigma[n] for n in fit.free])
        _, maps = given.components(like, fit.best_fit, data, covariance=False)
        powers = band_powers(found.spectra, maps[found.found.components.index("cmb")])[1]
        ratios.append(fit_tensors(model, powers))
    every = np.column_stack([pulls, [(ratio.r - r) / sigma for ratio in ratios]])
    print(f"r = {r}: sigma {sigma:.2g}, mean {every.mean(axis=0)}, scatter {every.std(axis=0)}")
    # Of N standard normal values the mean scatters by 1 / sqrt(N), the deviation by 1 / sqrt(2 N).
    assert np.all(np.abs(every.mean(axis=0)) < 3 / np.sqrt(count))
    assert np.all(np.abs(every.std(axis=0) - 1) < 3 / np.sqrt(2 * count))
    # 95 % of the posteriors hold the truth, where it is not at their edge; 300 skies: +- 1.3 %.
    assert 0.9 < np.mean([ratio.upper_95 > r for ratio in ratios]) < 0.995 or r == 0
    # Low multipoles have few modes: their powers are not Gaussian, so only roughly uniform.
    assert 0.4 < np.mean([ratio.probability for ratio in ratios]) < 0.65
    # The likelihood alone takes pixels as independent, which smoothed noise is not.
    assert (
        domain == "harmonic"
        or min(found.sigma[n] / found.fit.sigma[n] for n in found.fit.free) > 1.5
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("domain", "region"), [("pixel", "outside"), ("harmonic", "outside"), ("harmonic", "full")]
)
def test_both_domains_find_the_sky(domain, region):
    _, given, found = separated(domain, region=region)
    for name in found.fit.free:
        assert abs(found.fit.best_fit[name] - given.truth[name]) < 4 * found.sigma[name]
    assert abs(found.tensors.r - given.truth["r"]) < 4 * found.tensors.sigma
    assert found.tensors.probability > 1e-3
    assert abs(found.tensors.shift(found.left)) < 0.5 * found.tensors.sigma
    assert np.nanmin(found.found.degradation("cmb")) > 1
    # What is left of the data is noise, less what the amplitudes have taken up.
    noise = given.noise_realisation(jax.random.key(0))
    if domain == "pixel":
        share = np.nanstd(found.residuals, axis=(1, 2)) / noise.std(axis=(1, 2))
        assert np.all((share > 0.2) & (share < 1.05))
    amplitude = found.found.amplitude if given.exact else found.maps
    shown = given.emission(found.like, found.fit.best_fit, amplitude)
    rest = given.observed - shown
    rest = rest if given.exact else np.where(given.used, rest, 0.0)
    np.testing.assert_array_less(rest.std(axis=(1, 2)), 1.2 * noise.std(axis=(1, 2)))


def test_noise_of_masked_multipoles_has_its_spectrum():
    """Against the mean over 20 draws, in bins of multipoles; its errors are about 5 %."""
    given = separation_data(settings(separate={"domain": "harmonic"}))
    draws = [
        given.alm(given.noise_realisation(key)) for key in jax.random.split(jax.random.key(3), 20)
    ]
    power = np.mean([power_spectrum(jnp.asarray(draw)) for draw in draws], axis=0)
    for part in (slice(8, 16), slice(16, 24), slice(24, 33)):
        ratio = power[..., part].mean(axis=-1) / given.spectra[..., part].mean(axis=-1)
        assert np.all(np.abs(ratio - 1) < 0.3)
        assert abs(ratio.mean() - 1) < 0.1


def test_multipoles_of_a_masked_sky_lose_nothing_of_the_cmb():
    """A sky of CMB alone comes out of the separation as it is, up to the edge of the mask."""
    given = separation_data(settings(separate={"domain": "harmonic"}))
    alm = realisation(jax.random.key(1), jnp.asarray(camb_spectra(2 * NSIDE, 0.01)))
    cmb = np.asarray(synthesis(alm * expand(gaussian_beam(FWHM, 2 * NSIDE)), NSIDE))
    data = np.where(given.used, np.broadcast_to(cmb, given.observed.shape), 0.0)
    like = given.likelihood(data)
    found, maps = given.components(like, given.start, data, covariance=False)
    for name, one in zip(found.components, maps, strict=True):
        expected = cmb[:, given.used] if name == "cmb" else 0.0
        np.testing.assert_allclose(one[:, given.used], expected, atol=1e-6 * cmb.std())


@pytest.mark.slow
def test_errors_of_multipoles_are_those_of_simulations():
    """There the likelihood is exact; 60 simulations measure to 9 %."""
    _, _, found = separated("harmonic", 60, region="full")
    for i, name in enumerate(found.fit.free):
        assert found.simulated.theta[:, i].std() == pytest.approx(found.fit.sigma[name], rel=0.3)


@pytest.mark.slow
def test_noise_of_multipoles_has_its_spectrum():
    """That of pixels, and what is correlated between them; 20 draws of 2 x 65 modes: 2.8 %."""
    _, given, _ = separated("harmonic", region="full")
    ell = np.arange(2 * NSIDE + 1)
    rest = np.where(ell > 1, 3 * given.spectra[:, 0], 0.0)
    for correlated in (0 * rest, rest):
        pairs = zip(given.noises.items(), jnp.asarray(correlated), strict=True)
        noises = {name: noise._replace(correlated=row) for (name, noise), row in pairs}
        changed = dataclasses.replace(given, noises=noises)
        draws = [changed.noise_realisation(key) for key in jax.random.split(jax.random.key(3), 20)]
        power = np.mean([power_spectrum(jnp.asarray(draw)) for draw in draws], axis=0)
        expected = given.spectra + correlated[:, None]
        np.testing.assert_allclose(
            power[..., 8:].mean(axis=-1), expected[..., 8:].mean(axis=-1), rtol=0.05
        )


@pytest.mark.slow
def test_a_law_that_is_wrong_shows_in_r():
    """Synchrotron with a curvature that the fit does not know."""
    how = settings(
        truth={"synchrotron.curvature": -0.5},
        regions={"wide": "|b| > 10"},
        separate={"sampler": "none", "region": "wide"},
    )
    found = separate_data(how, separation_data(how))
    _, _, right = separated()
    assert abs(found.tensors.shift(found.left)) > 10 * abs(right.tensors.shift(right.left))
    assert found.left.sum() > 10 * right.left.sum()
    said = " ".join(separation_warnings(found, how))
    assert "the laws do not describe the maps" in said


@pytest.mark.slow
def test_regions_have_values_of_their_own():
    regions = {"dust.beta_dust": {"latitudes": [40.0]}, "synchrotron.beta_syn": {"clusters": 3}}
    free = {name: value | {"regions": regions.get(name)} for name, value in FREE.items()}
    how = settings(free=free, regions={"wide": "|b| > 15"}, separate={"region": "wide"})
    given = separation_data(how)
    found = separate_data(how, given)
    assert np.shape(found.fit.best_fit["dust.beta_dust"]) == (2,)
    assert np.shape(found.sigma["synchrotron.beta_syn"]) == (3,)
    assert found.chain.labels == found.fit.labels
    for name in found.fit.free:
        off = np.abs(np.asarray(found.fit.best_fit[name]) - given.truth[name])
        assert np.all(off < 4.5 * np.asarray(found.sigma[name]))
    shown = found.of_pixel("dust.beta_dust", found.fit.best_fit)
    latitude = np.abs(healpy.pix2ang(NSIDE, np.arange(shown.size), lonlat=True)[1])
    assert np.isnan(shown[latitude < 15]).all()
    assert set(shown[latitude > 45]) == {found.fit.best_fit["dust.beta_dust"][1]}


@pytest.mark.slow
def test_the_response_is_that_of_a_new_fit():
    """To first order in the noise; Gaussian priors draw their mean anew."""
    how, given, found = separated()
    priors = priors_of(how, "separate")
    response = Response(found.like, found.fit.best_fit, {})
    amplitude = np.array(found.found.amplitude)
    data = given.emission(found.like, found.fit.best_fit, amplitude)
    noise = 0.1 * given.noise_realisation(jax.random.key(8))
    like = given.likelihood(data + noise)
    moved = response.moved(like, jax.random.key(0))
    again = best_fit(like, found.fit.best_fit)
    change = like.flat(again.best_fit) - response.theta
    np.testing.assert_allclose(moved - response.theta, change, rtol=0.05, atol=1e-6)
    silent = given.likelihood(data)
    with_priors = Response(found.like, found.fit.best_fit, priors)
    steps = [with_priors.moved(silent, k) for k in jax.random.split(jax.random.key(1), 300)]
    scatter = np.cov((np.array(steps) - with_priors.theta).T)
    # H^-1 P H^-1, with P the inverse variance of the prior's mean.
    at = found.fit.labels.index("dust.T_dust")
    inverse = np.linalg.inv(found.fit.details["hessian"])
    expected = inverse[at, at] / 2.0
    assert np.sqrt(scatter[at, at]) == pytest.approx(expected, rel=0.15)


@pytest.mark.slow
def test_widened_samples_have_the_errors_of_simulations():
    _, _, found = separated("pixel", 20, "nuts")
    chain = found.chain
    assert chain.converged
    at = [found.fit.labels.index(name) for name in chain.labels]
    sigma = np.sqrt(np.diagonal(chain.covariance))
    expected = found.simulated.theta[:, at].std(axis=0, ddof=1)
    np.testing.assert_allclose(sigma, expected, rtol=0.1)
    for name, s in zip(chain.labels, sigma, strict=True):
        low, high = chain.interval_68[name]
        assert high - low == pytest.approx(2 * s, rel=0.1)
    # With too few simulations for a covariance, each by itself.
    few = widened(chain, np.zeros(3), np.eye(3), found.simulated.theta[:8])
    assert few.covariance.shape == (3, 3)


def test_lensing_is_what_the_settings_say():
    """In the simulations that set errors as well as in the model."""
    _, given, whole = separated()
    how = settings(cmb={"A_lens": 0.25}, separate={"sampler": "none"})
    found = separate_data(how, given)
    one, other = whole.tensors.model, found.tensors.model
    leak = whole.spectra.windows[1, :, 0] @ camb_spectra(whole.spectra.lmax)[1]
    np.testing.assert_allclose(other.lensing - leak, (one.lensing - leak) / 4, rtol=1e-9)
    np.testing.assert_allclose(other.additive, one.additive, rtol=1e-9)
    scatter = found.simulated.total.std(axis=0, ddof=1)
    np.testing.assert_allclose(np.sqrt(np.diagonal(other.covariance(0.0))), scatter, rtol=1e-9)
    # In the first bin most is E that leaks.
    assert np.all(scatter[1:] < 0.9 * whole.simulated.total.std(axis=0, ddof=1)[1:])
    assert "A_lens = 0.25" in " ".join(separation_warnings(found, how))


def test_more_parameters_than_can_be_sampled_are_named(monkeypatch):
    monkeypatch.setattr(module, "SAMPLED", 2)
    monkeypatch.setattr(command, "SAMPLED", 2)
    _, given, _ = separated()
    how = settings()
    found = separate_data(how, given)
    assert found.chain is None
    assert "not sampled: 3 parameters are more than 2" in " ".join(separation_warnings(found, how))


def test_simulations_are_kept_and_gone_on_with(tmp_path):
    how, given, _ = separated()
    counts = []

    class Counted(Progress):
        def advance(self, done, of):
            counts.append(done)

    with ThreadPoolExecutor(2) as executor:
        again = separate_data(how, given, tmp_path, Counted(), executor)
    assert counts == list(range(21))
    counts.clear()
    more = how.model_copy(update={"separate": how.separate.model_copy(update={"nsims": 22})})
    found = separate_data(more, given, tmp_path, Counted())
    assert counts == [20, 21, 22]
    np.testing.assert_array_equal(found.simulated.total[:20], again.simulated.total)
    other = settings(cmb={"A_lens": 0.5}, separate={"sampler": "none"})
    with pytest.raises(InputError, match="holds realisations of other data or settings"):
        separate_data(other, given, tmp_path)


def test_the_settings_that_come_along_are_valid():
    default = load(DEFAULTS / "separate.toml")
    assert len(default.bands) == 15
    assert default.bands[0].name == "40"
    template = load(DEFAULTS / "experiment.toml")
    assert [band.name for band in template.bands] == CHANNELS
    assert template.start("separate")["dust.T_dust"] == 19.0


def beta(**changes):
    """A free index."""
    return {"free": {"dust.beta_dust": {"start": 1.5} | changes}}


@pytest.mark.parametrize(("changes", "words"), cases("separate/contradictions"))
def test_settings_that_contradict_themselves_are_refused(changes, words):
    raises(ValueError, words, settings, **changes)


@pytest.mark.parametrize(("changes", "words"), cases("separate/cannot_work"))
def test_settings_that_cannot_work_are_refused(changes, words):
    raises(SettingsError, words, separation_data, settings(**changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lmax": 40}, "separate.lmax: 40 is beyond what nside 16"),
        ({"lmin": 20, "width": 30}, "no bin of 30 multipoles fits"),
    ],
)
def test_spectra_that_cannot_be_taken_are_refused(changes, words):
    _, given, _ = separated()
    how = settings(separate=changes)
    raises(SettingsError, words, separate_data, how, given)
