"""Maps on disk: the same answers as in memory, and scratch files that are gone afterwards."""

import errno
import os
import pickle

import healpy
import jax.numpy as jnp
import numpy as np
import pytest

from fits import cleaning
from fits.cleaning import separate_data
from fits.common import prepared_maps
from fits.inputs import inputs_of
from fits.posterior import chi2
from fits.separated_data import separation_data
from fits.spectral_index import fit_regions
from fits.template_likelihood import likelihood
from jaxsky import Bandpass, observe
from jaxsky.galaxy import embedded_sky
from jaxsky.io import stacks, write_maps
from jaxsky.settings import Experiment

NSIDE = 16
BANDS = ["40", "78", "100", "140", "280", "402"]
FREE = {"dust.beta_dust": {"start": 1.6}, "synchrotron.beta_syn": {"start": 3.0}}


@pytest.fixture
def on_disk(monkeypatch, tmp_path):
    """All maps are large; their scratch files are in a folder, which is returned."""
    monkeypatch.setattr(stacks, "LIMIT", 0)
    monkeypatch.setattr(stacks, "PIECE", 1000)
    folder = tmp_path / "scratch"
    folder.mkdir()
    with stacks.scratch(folder):
        yield folder


def test_an_array_on_disk_is_read_like_one_in_memory(on_disk):
    values = np.random.default_rng(0).standard_normal((3, 2, 5000))
    kept = stacks.stored(values)
    twice = stacks.computed(values.shape, lambda pixels, kept=kept: 2 * kept[..., pixels])
    assert [path.suffix for path in on_disk.iterdir()] == [".maps"]
    # For workers, which share the file.
    again, twice_again = pickle.loads(pickle.dumps((kept, twice)))
    np.testing.assert_array_equal(twice_again, 2 * values)
    some = np.array([7, 4999, -1, 7])
    for index in (
        ...,
        1,
        -1,
        (2, 1),
        (0, slice(None)),
        (..., slice(3, 900)),
        (..., some),
        (slice(None), 1, slice(990, 2500)),
        (slice(None), 0, some),
    ):
        np.testing.assert_array_equal(kept[index], values[index])
        np.testing.assert_array_equal(again[index], values[index])
        np.testing.assert_array_equal(twice[index], 2 * values[index])
    np.testing.assert_array_equal(jnp.asarray(kept) + 0, values)
    np.testing.assert_array_equal(np.asarray(twice), 2 * values)
    assert (kept.shape, kept.ndim, kept.size, len(twice)) == (values.shape, 3, values.size, 3)
    kept[:, 1, 10:20] = 5.0
    assert (again[:, 1, 10:20] == 5.0).all()
    assert (again[:, 1, 9] == values[:, 1, 9]).all()
    kept[2], kept[1, 0] = values[0], 7.0
    np.testing.assert_array_equal(again[2], values[0])
    assert (again[1, 0] == 7.0).all()
    assert (again[1, 1, 20:] == values[1, 1, 20:]).all()
    with pytest.raises(IndexError):
        kept[3]
    del kept, twice, again, twice_again
    assert not any(on_disk.iterdir())


def test_scratch_files_are_gone_after_an_error_and_a_full_disk_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(stacks, "LIMIT", 0)
    held = []
    with pytest.raises(KeyError), stacks.scratch(tmp_path):
        raise KeyError(held.append(stacks.stored(np.ones((2, 100)))))
    assert not any(tmp_path.iterdir())
    assert held[0][1, 3] == 1.0  # whoever still has it can read it

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    words = r"has no room for 0\.4 GB of maps that do not fit into memory \(No space left"
    with stacks.scratch(tmp_path), pytest.raises(OSError, match=words):
        stacks.empty((2, 12 * 128**2 * 128))
    assert not any(tmp_path.iterdir())


def files(folder, uneven: bool, whole: bool = False):
    """Maps of a small sky with white noise in files, with a hit count of each band, or without."""
    made = Experiment.model_validate(
        {
            "seed": 2,
            "sky": {"embedded": {"nside": NSIDE}},
            "bands": [{"instrument": "litebird", "channels": BANDS}],
            "simulate": {"nside": NSIDE},
            "common": {"nside": NSIDE},
        }
    )
    bands, npix = [], 12 * NSIDE**2
    z = healpy.pix2vec(NSIDE, np.arange(npix))[2]
    used = np.abs(z) < (2 if whole else 0.98)
    for i, (name, band) in enumerate(inputs_of(made, templates=False).bands.items()):
        maps = np.asarray(band.maps)
        hits = 1 + 0.3 * np.cos((i + 2) * z)
        columns = [*maps, hits]
        units = ["uK_RJ", "uK_RJ", ""]
        write_maps(
            folder / f"{name}.fits", columns, names=["Q", "U", "HITS"], unit=units, mask=used
        )
        level = float(band.noise)
        pixel = level / healpy.nside2resol(NSIDE, arcmin=True)
        noise = {"hits": {"fields": ["HITS"], "sigma0": pixel}} if uneven else {"level": level}
        center = {"center": float(band.bandpass.nu.mean()), "width": 0.0}
        table = {"name": name, "file": str(folder / f"{name}.fits"), "fields": ["Q", "U"]}
        bands.append(table | {"bandpass": center, "fwhm": 0.0, "noise": noise})
    return bands


def experiment(folder, uneven):
    bands = files(folder, uneven)
    return Experiment.model_validate(
        {
            "seed": 2,
            "sky": {"embedded": {"nside": NSIDE}},
            "bands": bands,
            "common": {"nside": NSIDE, "fwhm": 480.0},
            "free": FREE,
            "separate": {
                "region": "outside",
                "nsims": 20,
                "width": 4,
                "apodization": 20.0,
                "sampler": "none",
            },
            "fit": {"stokes": ["QU"], "methods": ["gradient"], "regions": ["full"]},
        }
    )


def separated(settings):
    found = separate_data(settings, separation_data(settings))
    numbers = {
        "best_fit": list(found.fit.best_fit.values()),
        "sigma": list(found.sigma.values()),
        "chi2": found.fit.chi2,
        "r": [found.tensors.r, found.tensors.sigma],
        "degradation": found.found.mean_degradation("cmb"),
        "powers": found.tensors.powers,
        "maps": found.maps,
        "errors": found.found.sigma("dust"),
        "probability": found.found.probability,
        "residuals": found.residuals,
        **found.simulated._asdict(),
    }
    return {name: np.asarray(value) for name, value in numbers.items()}, found


def assert_close(found, expected):
    for name, value in expected.items():
        scale = np.nanmax(np.abs(value))
        np.testing.assert_allclose(found[name], value, 1e-10, 1e-10 * scale, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("uneven", [False, True])
def test_separation_from_disk_is_that_in_memory(request, tmp_path, monkeypatch, uneven):
    settings = experiment(tmp_path, uneven)
    expected, _ = separated(settings)
    on_disk = request.getfixturevalue("on_disk")
    # As workers do: the maps of what they are sent are in the same files.
    plain = cleaning.kept_realisations
    monkeypatch.setattr(
        cleaning,
        "kept_realisations",
        lambda make, *rest: plain(pickle.loads(pickle.dumps(make)), *rest),
    )
    numbers, found = separated(settings)
    assert isinstance(found.data.observed, stacks.Stack)
    assert (found.like.source is not None) == uneven
    assert_close(numbers, expected)
    del numbers, found
    assert not any(on_disk.iterdir())


DUST = {"law": "dust", "nu_ref": 353.0, "file": "dust.fits", "noise": {"level": 34.0}}
NOISE = {"embedded": {"nside": NSIDE}, "dust": DUST | {"fields": ["Q", "U"]}}
VARYING = {"parameters": {"beta_dust": {"file": "dust.fits", "fields": ["BETA"]}}}
BAND_PARAMETERS = {"offset.402.Q": {"start": 0.0}, "angle.140": {"start": 0.0}}


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("uneven", "changes"),
    [
        (False, {}),
        (True, {"sky": NOISE}),
        slow(False, {"sky": NOISE, "fit": {"likelihood": "diagonal"}}),
        slow(True, {"free": FREE | BAND_PARAMETERS}),
        slow(
            True,
            {
                "sky": {"embedded": {"nside": NSIDE}, "dust": NOISE["dust"] | VARYING},
                "free": {"synchrotron.beta_syn": {"start": 3.0}},
            },
        ),
    ],
    ids=["uniform", "noise of a template", "diagonal", "parameters of bands", "a map of values"],
)
def test_fit_from_disk_is_that_in_memory(request, tmp_path, uneven, changes):
    tables = experiment(tmp_path, uneven).model_dump(mode="json", exclude_unset=True)
    tables["fit"] |= changes.pop("fit", {})
    tables["data_dir"] = str(tmp_path)
    settings = Experiment.model_validate(tables | changes)
    dust = embedded_sky(NSIDE).sky("QU")["dust"].amplitude
    columns = [*dust, 1.6 + 0.05 * np.cos(np.arange(12 * NSIDE**2))]
    units = ["uK_RJ", "uK_RJ", ""]
    write_maps(tmp_path / "dust.fits", columns, names=["Q", "U", "BETA"], unit=units)

    def fitted():
        inputs = inputs_of(settings)
        prepared = prepared_maps(settings, inputs)
        everywhere = {"full": np.ones(12 * NSIDE**2, bool)}
        (one,) = fit_regions(settings, prepared, everywhere)
        result = one.results["gradient"]
        sums = one.chi2["gradient"], result.chi2, *one.noise_shares.values()
        values = list(result.best_fit.values()), list(result.sigma.values()), sums
        return dict(enumerate(map(np.asarray, values))), inputs, prepared

    expected, *_ = fitted()
    request.getfixturevalue("on_disk")
    numbers, inputs, prepared = fitted()
    assert isinstance(prepared.data, stacks.Stack)
    for sky in (inputs.templates["dust"].component, prepared.sky["dust"]):
        assert isinstance(sky.amplitude, stacks.Stack)
    assert_close(numbers, expected)


def test_a_likelihood_takes_maps_on_disk_with_any_standard_deviation(on_disk):
    sky, bands = embedded_sky(NSIDE).sky("QU"), [Bandpass.delta(nu) for nu in (40.0, 140.0, 402.0)]
    data = np.array(observe(sky, bands))
    start = {"dust.beta_dust": 1.55, "synchrotron.beta_syn": 3.05}
    for sigma in (0.5, np.full((3, 1, 1), 0.5), np.full(data.shape, 0.5)):
        expected = chi2(likelihood(sky, bands, data, sigma, start), start)
        for given in (stacks.stored(data), data):
            own = stacks.stored(sigma) if np.shape(sigma) == data.shape else sigma
            found = chi2(likelihood(sky, bands, given, own, start), start)
            np.testing.assert_allclose(found, expected, rtol=1e-10)
    with pytest.raises(ValueError, match="`sigma` has"):
        likelihood(sky, bands, stacks.stored(data), -0.5, start)
