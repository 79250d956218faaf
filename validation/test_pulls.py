"""Pulls of the spectral indices over skies that are simulated, and over files as official ones."""

import importlib.util
import sys
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from fits.commands.run import DEFAULTS
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.optimize import best_fit
from fits.posterior import priors_of
from fits.regions import region_masks
from fits.spectral_index import settled
from jaxsky.galaxy import EmbeddedSky, embedded_sky
from jaxsky.settings import Experiment, load
from jaxsky.workers import Processes, processors, realised

SKIES = 500
KINDS = [("exact", "Q"), ("exact", "U"), ("exact", "QU"), ("diagonal", "QU")]


@dataclass(frozen=True)
class Pulls:
    """(best fit - truth) / sigma of both indices in the sky of a seed, by likelihood and Stokes."""

    settings: Experiment
    galaxy: EmbeddedSky

    def __call__(self, seed: int) -> list[list[float]]:
        settings, start = self.settings, self.settings.start("fit")
        inputs = inputs_of(settings.model_copy(update={"seed": seed}), galaxy=self.galaxy)
        prepared, rows = common_maps(inputs, 16, 300.0), []
        for kind, stokes in KINDS:
            found = best_fit(prepared.likelihood(start, kind=kind, stokes=stokes), start)
            rows.append(
                [(found.best_fit[n] - inputs.truth[n]) / found.sigma[n] for n in found.free]
            )
        return rows


@pytest.fixture(scope="module")
def pulls(tmp_path_factory):
    """The pulls in all skies, by likelihood and Stokes."""
    values = ["common.nside=16", "common.fwhm=300.0", "sky.embedded.nside=32"]
    work = Pulls(load(DEFAULTS / "fit.toml", values), embedded_sky(32))
    with Processes(processors()) as executor:
        made = realised(work, range(SKIES), executor, tmp_path_factory.mktemp("pulls"))
        return dict(zip(KINDS, np.swapaxes(list(made), 0, 1), strict=True))


@pytest.mark.parametrize("stokes", ["Q", "U", "QU"])
def test_pulls_are_standard_normal(pulls, stokes):
    # Of N standard normal values the mean scatters by 1 / sqrt(N), the deviation by 1 / sqrt(2 N).
    exact = pulls["exact", stokes]
    print(f"{stokes}: means {exact.mean(axis=0).round(3)}, deviations {exact.std(axis=0).round(3)}")
    assert np.all(np.abs(exact.mean(axis=0)) < 3 / np.sqrt(SKIES))
    assert np.all(np.abs(exact.std(axis=0) - 1) < 3 / np.sqrt(2 * SKIES))


def test_the_diagonal_likelihood_misstates_its_errors(pulls):
    """Why it is only the named option: correlated noise and the CMB are left out of it."""
    assert pulls["diagonal", "QU"].std(axis=0).max() > 1.2


def test_skies_of_other_seeds_are_independent(pulls):
    for values in pulls["exact", "QU"].T:
        correlation = np.corrcoef(values[:-1], values[1:])[0, 1]
        assert abs(correlation) < 3 / np.sqrt(SKIES)


TRUTH = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.1}
#: Noise of the templates [uK_RJ arcmin], about that of Commander's.
LEVELS = {"dust": 34.0, "synchrotron": 200.0}
SEEDS = range(1, 51)


@pytest.fixture(scope="module")
def maker(data_dir):
    path = data_dir.parent / "official" / "make_files.py"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    spec = importlib.util.spec_from_file_location("make_files", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    whole = module.write

    def needed(path, *arguments, **more):
        if "BPassCorrected" in path.name or path.name.startswith("COM_"):
            whole(path, *arguments, **more)

    module.write = needed  # the maps with leakage and its corrections are not read
    return module


@pytest.fixture(scope="module")
def official(data_dir, tmp_path_factory):
    folder = tmp_path_factory.mktemp("official")
    (folder / "LFI_RIMO_R3.31.fits").symlink_to(data_dir / "bandpass" / "LFI_RIMO_R3.31.fits")
    path = folder / "planck_44_70.toml"
    path.write_text((DEFAULTS / "planck-44-70.toml").read_text())
    return load(path)


@pytest.mark.parametrize("noisy", [False, True], ids=["exact", "noisy"])
def test_pulls_over_fifty_skies(maker, official, monkeypatch, noisy):
    """Those of templates without noise, and with about that of Commander's."""
    settings = official
    folder, start, pulls = settings.data_dir, settings.start("fit"), []
    if noisy:
        components = settings.sky.components
        levels = {name: {"level": LEVELS[name]} for name in components}
        sky = {
            name: one.model_dump(exclude_unset=True) | {"noise": levels[name]}
            for name, one in components.items()
        }
        settings = settings.model_copy(update={"sky": type(settings.sky)(**sky)})
    priors = priors_of(settings, "fit")
    for seed in SEEDS:
        line = ["make_files.py", folder, "--nside", "128", "--seed", str(seed)]
        line += ["--template-noise", str(int(noisy))]
        monkeypatch.setattr(sys, "argv", line)
        maker.main()
        prepared = common_maps(inputs_of(settings), settings.common.nside, settings.common.fwhm)
        row = []
        for inside in region_masks(settings, settings.fit.regions).values():
            like = settled(partial(prepared.likelihood, region=inside), start, priors)
            fit = best_fit(like, start, priors=priors)
            row.append([(fit.best_fit[n] - truth) / fit.sigma[n] for n, truth in TRUTH.items()])
        pulls.append(row)
    means, deviations = np.mean(pulls, axis=0), np.std(pulls, axis=0, ddof=1)
    print(
        f"regions x indices: mean pulls {means.round(2)}, standard deviations {deviations.round(2)}"
    )
    assert np.all(np.abs(means) < 3 / np.sqrt(len(SEEDS)))
    assert np.all(np.abs(deviations - 1) < 3 / 10)
