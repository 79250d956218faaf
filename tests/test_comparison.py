"""Observed maps against the model: slopes, spectra, patches; their errors are confirmed."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from commands import jaxsky
from fits.commands.compare import comparison_warnings, plot_patches, plot_template_patches
from fits.common import common_maps
from fits.comparison import compare, compare_pixels, compare_spectra, simulated_fluctuations
from fits.discs import (
    PatchComparison,
    _patch_noise,
    compare_patches,
    paper_patches,
    template_patches,
)
from fits.inputs import inputs_of
from fits.patches import PatchFits, fit_patches, prepare_patches
from fits.pseudo_cl import band_powers, cosmic_error, hotelling, polarization_alms
from fits.regions import region_masks
from jaxsky.harmonics import expand, gaussian_beam, power_spectrum, synthesis
from jaxsky.io import InputError
from jaxsky.noise import draw, pixel_covariance, uniform_covariance, white_alm
from jaxsky.settings import Experiment, SettingsError, load
from refusals import cases, raises
from settings_fuzz import written
from systems import small_experiment

EXAMPLE = Path(__file__).parents[1] / "examples" / "wmap7_vw.toml"
COMPARE = {"regions": ["strip", "outside"], "nsims": 30, "lmax": 25, "width": 8}
BANDS = [
    {"instrument": "planck", "name": "44"},
    {"instrument": "planck", "name": "70", "leakage": 0.2},
    {"instrument": "wmap", "name": "K"},
]
SETTINGS = small_experiment(
    (),
    nside=32,
    seed=3,
    bands=BANDS,
    common={"nside": 16, "fwhm": 300.0},
    compare=COMPARE,
)


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return load(written(tmp_path_factory.mktemp("compare") / "compare.toml", SETTINGS))


@pytest.fixture(scope="module")
def prepared(settings):
    return common_maps(inputs_of(settings), settings.common.nside, settings.common.fwhm)


@pytest.fixture(scope="module")
def model(prepared):
    return prepared.model()


@pytest.fixture(scope="module")
def regions(settings):
    return region_masks(settings, settings.compare.regions)


@pytest.fixture(scope="module")
def simulated(prepared, model, regions):
    return simulated_fluctuations(prepared, model, regions, 25, 150, 0)


@pytest.fixture(scope="module")
def few(prepared, model, regions):
    return simulated_fluctuations(prepared, model, regions, 25, 40, 0)


@pytest.fixture(scope="module")
def realised(prepared):
    """Noise and CMB of 150 realisations."""
    fluctuations = prepared.fluctuations
    keys = [jax.random.fold_in(jax.random.key(0), i) for i in range(150)]
    return [fluctuations.noise_realisation(k) + fluctuations.cmb_realisation(k) for k in keys]


@pytest.mark.slow
def test_realisations_have_the_covariance(prepared, realised):
    """Of any inner products; that of three bands is 3 x 3, with the CMB in all of them."""
    rng = np.random.default_rng(1)
    rows = jnp.asarray(rng.normal(size=(3, 1, 2, prepared.used.size)))
    rows = rows.at[:].set(rows[0])  # alike, so that the CMB correlates the bands
    expected = np.asarray(prepared.fluctuations.covariance(rows))
    products = np.array([jnp.einsum("brsp,bsp->br", rows, maps).ravel() for maps in realised])
    found = products.T @ products / len(products)
    root = np.sqrt(np.diag(expected))
    # One standard error of an element is (1 + rho^2)^(1/2) / sqrt(150) of the roots: 4 of them.
    assert np.abs((found - expected) / np.outer(root, root)).max() < 4 * np.sqrt(2 / 150)
    assert expected[0, 1] > 0.05 * root[0] * root[1]


@pytest.mark.slow
def test_noise_is_prepared_as_maps_are(prepared):
    """White noise keeps its spectrum without the refinement of the analysis."""
    op, unit = prepared.fluctuations.noises[0].preparation, uniform_covariance(1.0, 32)
    powers = []
    for key in jax.random.split(jax.random.key(5), 8):
        fast = white_alm(key, unit, op.window.size - 1) * expand(op.window)
        maps = jnp.stack([op(draw(key, unit)), synthesis(fast, op.nside)])
        powers.append(power_spectrum(polarization_alms(maps, 25)))
    exact, fast = np.mean(powers, axis=0)[..., 2:]
    np.testing.assert_allclose(fast, exact, rtol=5e-3)
    np.testing.assert_allclose(fast.sum(axis=-1), exact.sum(axis=-1), rtol=1e-3)


@pytest.mark.slow
def test_slopes_are_those_of_the_maps_and_their_errors_are_honest(
    prepared, model, regions, simulated, realised
):
    exact = prepared._replace(data=1.25 * model)
    scatters = compare_pixels(exact, model, regions, simulated).values()
    assert [s.slope for s in scatters] == pytest.approx([1.25] * 18)
    pulls = []
    for maps in realised:
        found = compare_pixels(prepared._replace(data=model + maps), model, regions, simulated)
        pulls.append([(s.slope - 1) / s.error for s in found.values()])
    # 150 realisations: the mean is good to 0.08, the standard deviation to 6 %; four of each.
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.33
    assert np.abs(np.std(pulls, axis=0) - 1).max() < 0.24


@pytest.mark.slow
def test_probabilities_of_pixels_are_ranks(prepared, model, regions, simulated, realised):
    found = [
        compare_pixels(prepared._replace(data=model + maps), model, regions, simulated)
        for maps in realised[:40]
    ]
    tests = [[s.pte for s in scatters.values()] for scatters in found]
    # The same realisations: a rank among them, each one in 151.
    ranks = np.array(tests) * 151
    np.testing.assert_allclose(ranks, np.round(ranks), atol=1e-9)
    # Uniform: 40 ranks have a mean of 0.5 to 0.046.
    assert np.abs(np.mean(tests, axis=0) - 0.5).max() < 4 * 0.046


def test_numbers_of_a_scatter(prepared, model, regions, few):
    scatter = compare_pixels(prepared, model, regions, few)["44", "strip", "QU"]
    inside = regions["strip"]
    x, y = np.asarray(model[0])[:, inside].ravel(), np.asarray(prepared.data[0])[:, inside].ravel()
    assert scatter.pixels == x.size
    assert scatter.correlation == pytest.approx(np.corrcoef(x, y)[0, 1])
    assert scatter.rms == pytest.approx(np.sqrt(np.mean((y - x) ** 2)))
    assert scatter.expected == pytest.approx(scatter.rms, rel=0.1)
    sigma = np.asarray(prepared.sigma[0])[:, inside].ravel()
    assert scatter.chi2 == pytest.approx(np.sum(((y - x) / sigma) ** 2))
    assert scatter.slope_pte == pytest.approx(
        scipy.stats.chi2.sf(((scatter.slope - 1) / scatter.error) ** 2, 1)
    )
    # A rank among the simulations, of which none is as far off as three times the model.
    triple = compare_pixels(prepared._replace(data=3 * model), model, regions, few)
    assert triple["44", "strip", "Q"].pte == pytest.approx(1 / 41)


def test_the_paper_s_error_and_the_chance_correlation():
    """The scatter of spectra of a Gaussian field, alone and on top of a signal that is fixed."""
    lmax = 12
    rng = np.random.default_rng(2)
    ell = np.concatenate([np.arange(lmax + 1), np.repeat(*_counted(lmax))])
    fixed = rng.normal(size=ell.size) * 2.0
    power = np.where(np.arange(lmax + 1) > 1, 1.0 / (1 + np.arange(lmax + 1.0)), 0.0)
    white = rng.normal(size=(4000, ell.size)) * np.sqrt(power)[ell]

    def spectrum(alm):
        return np.array([np.bincount(ell, a**2) for a in alm]) / (2 * np.arange(lmax + 1) + 1)

    signal = spectrum(fixed[None])[0]
    for sky, own in ((white, 0.0), (white + fixed, signal)):
        expected = np.asarray(cosmic_error(jnp.asarray(power), jnp.asarray(own)))[2:]
        # 4000 draws know a standard deviation to some 1.5 %.
        np.testing.assert_allclose(spectrum(sky).std(axis=0)[2:], expected, rtol=0.07)


def _counted(lmax):
    m = np.arange(1, lmax + 1)
    degrees = np.concatenate([np.arange(k, lmax + 1) for k in m])
    return degrees, np.full(degrees.size, 2)


def test_hotelling_is_exact():
    rng = np.random.default_rng(3)
    mixing = rng.normal(size=(4, 4))
    tests = np.array(
        [
            hotelling(mixing @ rng.normal(size=4), rng.normal(size=(15, 4)) @ mixing.T)[1]
            for _ in range(600)
        ]
    )
    # Probabilities are uniform: Kolmogorov-Smirnov.
    assert scipy.stats.kstest(tests, "uniform").pvalue > 1e-3
    many = rng.normal(size=(200_000, 4))
    chi2, probability = hotelling(np.array([1.0, -2.0, 0.5, 1.0]), many)
    assert chi2 == pytest.approx(6.25, rel=0.02)
    assert probability == pytest.approx(scipy.stats.chi2.sf(6.25, 4), rel=0.03)
    with pytest.raises(ValueError, match="4 bins need more than 4 simulations, but there are 4"):
        hotelling(np.zeros(4), rng.normal(size=(4, 4)))


def test_spectra_are_healpys(prepared, model, few):
    found = compare_spectra(prepared, model, few, 8)
    zero = np.zeros(prepared.used.size)
    for spectra, maps in zip(found, prepared.data, strict=True):
        cls = healpy.anafast([zero, *np.asarray(maps)], lmax=40, iter=10)[1:3, :26]
        # The maps hold multipoles up to 47, beyond what pixels of nside 16 tell apart.
        np.testing.assert_allclose(spectra.observed[:, 2:], cls[:, 2:], rtol=1e-2)
        assert spectra.edges == (2, 10, 18, 26)
        D = np.arange(26) * np.arange(1, 27) / (2 * np.pi) * spectra.observed
        np.testing.assert_allclose(spectra.binned[:, 0], D[:, 2:10].mean(axis=1))
        np.testing.assert_array_equal(spectra.centers, [5.5, 13.5, 21.5])
        assert spectra.chi2_bins.shape == (2, 3)
        # The paper's error is that of noise and CMB, which are also what is simulated.
        total = spectra.noise + spectra.cmb
        np.testing.assert_allclose(
            spectra.error[:, 2:], (np.sqrt(2 / (2 * np.arange(26) + 1)) * total)[:, 2:]
        )
        assert (spectra.largest_error > 0).all()
        assert (spectra.pte > 1e-3).all()
    assert [s.uncorrected is not None for s in found] == [False, True, False]
    # 20 % of the intensity leaked; it is seen, and gone with the correction.
    assert found[1].pte_uncorrected.max() < 1e-3
    later = compare_spectra(prepared, model, few, 8, 10)
    assert later[0].edges == (10, 18, 26)
    np.testing.assert_array_equal(later[0].binned, found[0].binned[:, 1:])


def test_spectra_do_not_depend_on_the_common_nside(settings, prepared):
    fine = common_maps(inputs_of(settings), 32, settings.common.fwhm)
    found, finer = (power_spectrum(polarization_alms(m.data, 25)) for m in (prepared, fine))
    np.testing.assert_allclose(found[..., 2:], finer[..., 2:], rtol=1e-2)


def test_missing_pixels_leave_spectra_out(settings, prepared, regions):
    used = prepared.used.copy()
    used[:3] = False
    holes = prepared._replace(used=used)
    found = compare(settings, holes, regions)
    assert not found.spectra
    assert "3 of 3072 pixels have no value" in comparison_warnings(found, settings)[0]
    assert found.scatters["K", "outside", "Q"].pixels == int(regions["outside"].sum()) - 3


def test_realisations_are_kept(prepared, model, regions, tmp_path):
    path, counts = tmp_path / "sims.npz", []

    def count(done, of):
        counts.append(done)

    first = simulated_fluctuations(prepared, model, regions, 20, 2, 0, path, "a")
    kept, executor = (path, "a", count), ThreadPoolExecutor(2)
    more = simulated_fluctuations(prepared, model, regions, 20, 3, 0, *kept, executor)
    assert counts == [2, 3]
    np.testing.assert_array_equal(more.chi2[:2], first.chi2)
    fresh = simulated_fluctuations(prepared, model, regions, 20, 3, 0)
    np.testing.assert_allclose(more.spectra, fresh.spectra, rtol=1e-12)

    def stop(done, of):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulated_fluctuations(prepared, model, regions, 20, 9, 0, path, "a", stop)
    simulated_fluctuations(prepared, model, regions, 20, 5, 0, path, "a", count)
    assert counts == [2, 3, 4, 5]
    with pytest.raises(InputError, match="holds realisations of other data or settings"):
        simulated_fluctuations(prepared, model, regions, 20, 3, 0, path, "b")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"sims.npz: is damaged .* start again with --overwrite"):
        simulated_fluctuations(prepared, model, regions, 20, 3, 0, path, "a")


def test_what_cannot_be_compared_is_refused(settings, prepared, regions):
    with pytest.raises(SettingsError, match="region 'nothing' leaves fewer than 10 pixels"):
        compare(settings, prepared, {"nothing": np.zeros(3072, bool)})
    # Of the other bands it does not matter.
    coarse = prepared._replace(sources=prepared.sources | {"band '44'": 16})
    for update, maps, words in cases("comparison/updates"):
        how = settings.compare.model_copy(update=update)
        given = {"fine": prepared, "coarse": coarse}[maps]
        with pytest.raises(SettingsError, match=words):
            compare(settings.model_copy(update={"compare": how}), given, regions)
    for change, words in cases("comparison/changes"):
        raises(ValueError, words, Experiment.model_validate, settings.model_dump() | change)


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch, capsys):
    written(tmp_path / "a.toml", SETTINGS)
    out = tmp_path / "out"
    assert jaxsky(monkeypatch, "compare", tmp_path / "a.toml", "--out", out) == 0
    pictures = {"scatter_strip", "scatter_outside", "maps_Q", "maps_U", "spectra", "leakage"}
    assert {p.stem for p in out.glob("*.png")} == pictures
    numbers = json.loads((out / "comparison.json").read_text())
    assert set(numbers["pixels"]["44"]["strip"]) == {"Q", "U", "QU"}
    assert 0.8 < numbers["pixels"]["K"]["strip"]["QU"]["slope"] < 1.2
    assert len(numbers["spectra"]["70"]["chi2_bins"][1]) == 3
    assert "Model of the Galaxy (not data)" in capsys.readouterr().err
    assert jaxsky(monkeypatch, "compare", tmp_path / "a.toml", "--out", out) == 2
    assert "holds results already" in capsys.readouterr().err
    again = ["compare", tmp_path / "a.toml", "--out", out, "--resume"]
    assert jaxsky(monkeypatch, *again, "--set", "seed=9") == 2
    assert "holds results of other settings (seed)" in capsys.readouterr().err.replace("\n", " ")
    # What cannot work removes nothing; what works leaves nothing of the old.
    written(tmp_path / "bad.toml", SETTINGS | {"compare": COMPARE | {"lmax": 33}})
    assert jaxsky(monkeypatch, "compare", tmp_path / "bad.toml", "--out", out, "--overwrite") == 2
    assert (out / "comparison.json").exists()
    clean = [{k: v for k, v in band.items() if k != "leakage"} for band in BANDS]
    tight = {"compare": COMPARE | {"regions": ["outside"]}, "bands": clean}
    written(tmp_path / "b.toml", SETTINGS | tight)
    assert jaxsky(monkeypatch, "compare", tmp_path / "b.toml", "--out", out, "--overwrite") == 0
    assert {p.stem for p in out.glob("*.png")} == pictures - {"scatter_strip", "leakage"}


def test_a_model_that_is_wrong_is_pointed_out(settings, prepared, regions):
    bright = prepared._replace(data=1.5 * prepared.data)
    found = compare(settings, bright, regions)
    sentences = " ".join(comparison_warnings(found, settings))
    assert "44, strip: the slope is 1.5" in sentences
    assert "more than in any of 30 realisations of noise and CMB" in sentences
    assert found.scatters["K", "strip", "QU"].pte_text == "<0.03"


def test_maps_that_are_too_near_the_model_are_pointed_out(settings, prepared, model, regions):
    found = compare(settings, prepared._replace(data=model), regions)
    assert found.scatters["K", "strip", "QU"].pte == 1.0
    sentences = " ".join(comparison_warnings(found, settings))
    assert "K, strip: the maps differ from the model by less than in any of 30" in sentences


@pytest.mark.slow
def test_wmap_on_the_real_sky(data_dir, monkeypatch):
    """V and W against the real templates: slopes of 1 within errors, at low latitude and above."""
    monkeypatch.setenv("JAXSKY_DATA", str(data_dir))
    settings = load(EXAMPLE, ["compare.nsims=30"])
    regions = region_masks(settings, ["strip", "outside"])
    found = compare(settings, common_maps(inputs_of(settings), 32, 0.0), regions)
    for scatter in found.scatters.values():
        assert abs(scatter.slope - 1) < 3 * scatter.error
        assert scatter.rms == pytest.approx(scatter.expected, rel=0.15)
    assert found.scatters["V", "strip", "QU"].correlation > 0.5


FINE = 64


@pytest.fixture(scope="module")
def of_patches():
    return Experiment.model_validate(
        {
            "sky": {"embedded": {"nside": FINE}},
            "bands": [{"instrument": "planck", "channels": ["353"]}],
            "compare": {"patches": "353"},
        }
    )


@pytest.fixture(scope="module")
def observed(of_patches):
    return inputs_of(of_patches)


@pytest.fixture(scope="module")
def found(of_patches, observed):
    return compare_patches(of_patches, observed)


@pytest.mark.slow
def test_noise_is_that_of_each_patch(observed):
    """Twice as much on one half of the sky."""
    band = observed.bands["353"]
    north = healpy.pix2ang(FINE, np.arange(band.used.size), lonlat=True)[1] > 0
    uneven = band._replace(noise=pixel_covariance(band.noise, FINE) * jnp.where(north, 4.0, 1.0))
    prepared = common_maps(observed._replace(bands={"353": uneven}), FINE, 60.0)
    some = dict(list(paper_patches(FINE).items())[:48:16])
    patches = prepare_patches(some, np.asarray(gaussian_beam(60.0, 128)))
    noise = _patch_noise(uneven, prepared, patches)
    keys = jax.random.split(jax.random.key(1), 40)
    maps = [prepared.fluctuations.noise_realisation(key)[0] for key in keys]
    for one, row in zip(patches.spectra, noise, strict=True):
        expected = np.einsum("ibjl,jklm,km->ib", one.inverse, one.mixing, row)
        powers = np.array([band_powers(one, m) for m in maps])
        error = powers.std(axis=0) / np.sqrt(len(maps))
        assert np.abs((powers.mean(axis=0) - expected) / error).max() < 4
    levels = noise[:, 0, 80]
    assert levels.max() / levels.min() == pytest.approx(4.0, rel=1e-6)


@pytest.mark.slow
def test_map_and_model_agree(found, tmp_path):
    """The same sky with noise of its own: amplitudes agree, and correlate."""
    assert found.band == "353"
    assert found.observed.A.shape == (49, 2)
    assert found.observed.names[-1] == "BICEP2"
    for index in (0, 1):
        variance = (found.observed.covariance + found.model.covariance)[:, index, 0, 0]
        pulls = (found.observed.A - found.model.A)[:, index] / np.sqrt(variance)
        # Both have the sky in common, so they agree better than their errors say.
        assert np.std(pulls) < 1.2
        assert abs(np.mean(pulls)) < 4 / 7
        ratio, error = found.ratio(index)
        assert abs(np.log(ratio)) < 4 * error / ratio
        difference, error = found.slope_difference(index)
        assert abs(difference) < 4 * error
    plot_patches(tmp_path / "patches.png", found, "small")
    assert (tmp_path / "patches.png").stat().st_size > 10_000


def test_patches_that_are_not_detected_are_not_drawn(tmp_path):
    """Of one map drawn twice: none is detected, or one in EE alone."""
    shape, none = (3, 2), np.zeros((3, 2), bool)
    covariance = np.broadcast_to(0.01 * np.eye(2), (*shape, 2, 2))
    numbers = np.ones(shape), np.full(shape, -2.4), covariance, np.ones(shape), np.ones(shape)
    powers = np.ones((*shape, 4)), np.ones((*shape, 4)), np.arange(4.0)
    fit = PatchFits(("a", "b", "c"), *numbers, none, ~none, *powers)
    path = tmp_path / "patches.png"
    assert not plot_patches(path, PatchComparison("353", fit, fit, np.eye(3)), "none")
    assert not path.exists()
    one = fit._replace(detected=np.array([[True, False], *2 * [[False, False]]]))
    assert plot_patches(path, PatchComparison("353", one, one, np.eye(3)), "one")


@pytest.mark.slow
def test_a_template_alone(observed, tmp_path):
    maps = observed.templates["dust"].component.amplitude
    fit = template_patches(maps, 0.0)
    expected = fit_patches(maps, prepare_patches(paper_patches(FINE), np.ones(2 * FINE + 1)))
    np.testing.assert_allclose(fit.A, expected.A)
    plot_template_patches(tmp_path / "patches.png", fit, ["A", "alpha"], "dust")
    assert (tmp_path / "patches.png").stat().st_size > 10_000
