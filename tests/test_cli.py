"""The command line: fit and separation on files, what they leave, one sentence for a mistake."""

import json

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from commands import experiment, jaxsky, said
from fits.commands.run import DEFAULTS
from fits.commands.separate import COMMAND
from jaxsky import CMB, Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.harmonics import alm_ell, gaussian_beam, resample, synthesis
from jaxsky.io import read_maps, write_maps
from jaxsky.settings import load
from mapfiles import table, write
from refusals import cases

NSIDE = 16
TRUTH = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}
NU = np.linspace(39.0, 49.0, 21)
#: Bandpass, beam [arcmin] and noise of a pixel [uK_CMB] of each band.
BANDS = {"44": (Bandpass(NU, np.hanning(23)[1:-1]), 200.0, 0.9)}
BANDS["70"] = (Bandpass.top_hat(70.0, 14.0), 150.0, 0.9)
for name in ("40", "100", "195", "280", "402"):
    BANDS[name] = (Bandpass.top_hat(float(name), 10.0), 90.0 if name == "40" else 80.0, 0.5)
NOISE = "{ covariance = ['QQ_COV', 'QU_COV', 'UU_COV'] }"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Templates, labels, and maps in the format of Planck's: K_CMB, NESTED, covariance columns."""
    folder, lmax = tmp_path_factory.mktemp("sky"), 2 * NSIDE
    rng, ell = np.random.default_rng(8), alm_ell(lmax)
    alms = [
        np.where(ell > 1, a * rng.normal(size=(2, ell.size)) / (1 + ell), 0) for a in (3, 300, 300)
    ]
    cmb, dust, synchrotron = (np.asarray(synthesis(jnp.asarray(a), NSIDE)) for a in alms)
    smoothed = synthesis(jnp.asarray(alms[1] * gaussian_beam(120.0, lmax)[ell]), NSIDE)
    names = ["Q_STOKES", "U_STOKES"]
    write_maps(folder / "dust.fits", np.asarray(smoothed), names=names, unit="uK_RJ")
    write_maps(folder / "synchrotron.fits", synchrotron, names=names, unit="uK_RJ")
    foregrounds = {"dust": Dust(dust, 1.6, 20.0), "synchrotron": Synchrotron(synchrotron, 3.0)}
    np.savetxt(folder / "44.txt", np.stack([NU, np.hanning(23)[1:-1]], axis=1))
    for name, (band, fwhm, sigma) in BANDS.items():
        # The fit expects the CMB of Planck's cosmology, which this is not.
        sky = Sky(foregrounds if name in ("44", "70") else foregrounds | {"cmb": CMB(cmb)})
        seen = resample(observe(sky, [band])[0], gaussian_beam(fwhm, lmax), NSIDE)
        maps = np.asarray(seen) / float(band.conversion("uK_CMB", "uK_RJ"))
        Q, U = 1e-6 * (maps + sigma * rng.normal(size=maps.shape))
        variance = np.full(Q.size, (1e-6 * sigma) ** 2)
        columns = {"Q_STOKES": Q, "U_STOKES": U, "HITS": np.ones(Q.size)}
        columns |= {"QQ_COV": variance, "QU_COV": 0 * variance, "UU_COV": variance}
        units = ["K_CMB"] * 2 + [""] + ["K_CMB^2"] * 3
        write(folder / f"{name}.fits", table(columns, units, form="D", ORDERING="NESTED"))
    halves = healpy.pix2ang(8, np.arange(768))[0] > np.pi / 2
    write_maps(folder / "labels.fits", 1.0 * halves, names="LABEL", unit="")
    write_maps(folder / "shares.fits", halves + 0.5, names="LABEL", unit="")
    return folder


def settings_in(folder, of, name, *changes):
    """An experiment with changes, in the folder."""
    path = folder / f"{name}.toml"
    path.write_text(experiment(of, *changes))
    return path


@pytest.mark.slow
def test_fit_on_files_in_plancks_format(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert jaxsky(monkeypatch, "fit", settings_in(folder, "fit", "full"), "--out", out) == 0
    printed = capsys.readouterr()
    assert "beta_dust" in printed.out
    assert "result.json" in printed.err
    assert sorted(p.name for p in out.iterdir()) == [
        "chain_full_Q.npz", "chain_full_QU.npz", "chain_full_U.npz", "grid.png", "index.html",
        "log.json", "log.txt", "marginals.png", "posterior.png", "result.json",
    ]  # fmt: skip
    for picture in out.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    result = json.loads((out / "result.json").read_text())
    assert set(result["results"]["full"]) == {"Q", "U", "QU"}
    for methods in result["results"]["full"].values():
        assert set(methods) == {"grid", "gradient", "mcmc"}
        for numbers in methods.values():
            assert {"best_fit", "interval_68", "covariance", "chi2", "dof", "free"} <= set(numbers)
            assert numbers["converged"]
            for i, name in enumerate(numbers["free"]):
                low, high = numbers["interval_68"][name]
                assert low < numbers["best_fit"][name] < high
                sigma = numbers["covariance"][i][i] ** 0.5
                assert abs(numbers["best_fit"][name] - TRUTH[name]) < 4 * sigma
    log = json.loads((out / "log.json").read_text())
    assert {"jax", "jaxsky", "healpy"} <= set(log["versions"])
    assert log["settings"]["common"]["nside"] == 8


def test_options_replace_settings_and_results_are_kept(folder, tmp_path, monkeypatch, mistake):
    path, out = settings_in(folder, "fit", "options"), tmp_path / "out"
    options = ["--out", out]
    fewer = 'fit.stokes=["QU"]', 'fit.regions=["strip"]', 'fit.methods=["mcmc"]', "fit.nsteps=300"
    for value in (*fewer, "seed=5", "common.nside=4"):
        options += ["--set", value]
    assert jaxsky(monkeypatch, "fit", path, *options) == 0
    before = (out / "result.json").read_bytes()
    parts = {"description", "warnings", "likelihood", "truth", "results"}
    assert set(json.loads(before)) == parts
    assert set(json.loads(before)["results"]) == {"strip"}
    assert set(json.loads(before)["results"]["strip"]) == {"QU"}
    assert "holds results already; go on with --resume" in mistake("fit", path, *options)
    assert (out / "result.json").read_bytes() == before
    # Results of other settings are not gone on with.
    for value, key in (("seed=6", "seed"), ('fit.methods=["gradient"]', "fit.methods")):
        said = mistake("fit", path, *options, "--set", value, "--resume")
        assert f"holds results of other settings ({key})" in said
    log = out / "log.json"
    log.write_text("{")
    assert "log.json: is damaged; start again" in mistake("fit", path, *options, "--resume")
    # Of a run that was stopped, the chain knows.
    log.unlink()
    other = [*options, "--set", "seed=6"]
    assert "holds a chain of other data or settings" in mistake("fit", path, *other, "--resume")
    assert jaxsky(monkeypatch, "fit", path, *options, "--resume") == 0
    again = json.loads((out / "result.json").read_text())
    assert again["results"] == json.loads(before)["results"]
    # But a chain may be longer.
    longer = ["--set", "fit.nsteps=400", "--set", 'title="longer"']
    assert jaxsky(monkeypatch, "fit", path, *options, *longer, "--resume") == 0


@pytest.mark.parametrize("noise", ["{ rms = 9e-7 }", "{ estimate_above = 0 }"])
def test_noise_can_be_given_in_other_ways(folder, tmp_path, monkeypatch, noise):
    few = 'methods = ["gradient"]\nstokes = ["QU"]'
    path = settings_in(folder, "fit", "noise", *2 * [(NOISE, noise)], ('regions = ["full"]', few))
    assert jaxsky(monkeypatch, "fit", path, "--out", tmp_path / "o") == 0
    result = json.loads((tmp_path / "o" / "result.json").read_text())
    fit = result["results"]["full"]["QU"]["gradient"]
    for name, value in TRUTH.items():
        assert fit["best_fit"][name] == pytest.approx(value, abs=0.2)
    assert not (tmp_path / "o" / "grid.png").exists()


@pytest.mark.parametrize("name", [path.stem for path in DEFAULTS.glob("*.toml")])
def test_init_writes_an_experiment_that_is_valid(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert jaxsky(monkeypatch, "init", name) == 0
    assert f"{name}.toml" in said(capsys)
    settings = load(tmp_path / f"{name}.toml")
    given = load(DEFAULTS / f"{name}.toml").model_copy(update={"data_dir": str(tmp_path)})
    assert settings == given


def test_init_leaves_files_alone(tmp_path, monkeypatch, capsys, mistake):
    monkeypatch.chdir(tmp_path)
    mine = tmp_path / "mine.toml"
    assert jaxsky(monkeypatch, "init", "planck-44-70", "--out", mine) == 0
    assert [band.name for band in load(mine).bands] == ["44", "70"]
    assert jaxsky(monkeypatch, "init") == 0  # the template
    assert load(tmp_path / "experiment.toml").title == "LiteBIRD"
    for path, arguments in ((mine, ["--out", mine]), (tmp_path / "experiment.toml", [])):
        path.write_text("mine")
        assert f"{path.name}: exists already" in mistake("init", *arguments)
        assert path.read_text() == "mine"
    printed = mistake("init", "planck", "--out", tmp_path / "other.toml")
    assert "no experiment 'planck'; there are" in printed
    assert all(path.stem in printed for path in DEFAULTS.glob("*.toml"))
    for out, words in (("none/x.toml", "No such file or directory"), (".", "exists already")):
        assert f"{out}: {words}" in mistake("init", "--out", out)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.toml", "experiment.toml"}


@pytest.mark.parametrize(("old", "new", "words"), cases("cli/mistakes"))
def test_mistakes_in_a_fit_are_one_sentence(folder, tmp_path, old, new, words, mistake):
    noise = 2 * [(NOISE, "{ rms = 1e-6 }")]
    path, out = settings_in(folder, "fit", "wrong", *noise, (old, new)), tmp_path / "out"
    assert words in mistake("fit", path, "--out", out)
    assert not list(out.glob("*")) if out.exists() else True


@pytest.mark.slow
def test_maps_of_ones_own(folder, tmp_path, monkeypatch, capsys, mistake):
    path, out = settings_in(folder, "separate", "own"), tmp_path / "out"
    assert jaxsky(monkeypatch, "separate", path, "--out", out) == 0
    printed = capsys.readouterr()
    assert "dust.beta_dust, median of 2 regions" in printed.out
    names = {p.name for p in out.iterdir()}
    assert names == {*COMMAND.results, "index.html", "log.json", "log.txt"}
    for picture in out.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    result = json.loads((out / "result.json").read_text())
    beta = result["parameters"]["dust.beta_dust"]
    assert np.all(np.abs(np.array(beta["best_fit"]) - 1.6) < 5 * np.array(beta["sigma"]))
    syn = result["parameters"]["synchrotron.beta_syn"]
    assert abs(syn["best_fit"] - 3.0) < 5 * syn["sigma"]
    assert syn["truth"] is None
    assert result["r"]["shift_by_foregrounds_left"] is None
    assert result["posterior"]["sampler"] == "mcmc"
    assert set(result["posterior"]["interval_68"]) == set(result["labels"])
    assert len(result["BB"]["cleaned"]) == len(result["BB"]["first"])
    assert result["simulations"] == 20
    maps = read_maps(out / "components.fits", fields=["DUST_Q", "DUST_U"])
    assert maps.unit == "uK_RJ"
    assert maps.nside == 8
    labels = read_maps(out / "parameters.fits", fields=["DUST.BETA_DUST"]).maps[0]
    np.testing.assert_allclose(np.unique(labels), np.sort(beta["best_fit"]), rtol=1e-6)
    assert read_maps(out / "residuals.fits", fields=["40_Q", "402_U"]).maps.shape == (2, 768)
    # Results are kept, gone on with, and replaced.
    before = (out / "result.json").read_bytes()
    assert "holds results already; go on with --resume" in mistake("separate", path, "--out", out)
    assert jaxsky(monkeypatch, "separate", path, "--out", out, "--resume") == 0
    again = json.loads((out / "result.json").read_text())
    assert again == json.loads(before)
    assert jaxsky(monkeypatch, "separate", path, "--out", out, "--resume", "--set", "seed=8") == 2
    assert "holds results of other settings (seed)" in said(capsys)


@pytest.mark.slow
@pytest.mark.parametrize("region", ["full", "outside"])
def test_multipoles_of_files(folder, tmp_path, monkeypatch, region):
    path = settings_in(folder, "separate", "harmonic", (", regions = { file = 'labels.fits' }", ""))
    out = tmp_path / "out"
    options = ["--set", "separate.domain=harmonic", "--set", f"separate.region={region}"]
    assert jaxsky(monkeypatch, "separate", path, "--out", out, *options) == 0
    result = json.loads((out / "result.json").read_text())
    for name, truth in {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}.items():
        found = result["parameters"][name]
        assert abs(found["best_fit"] - truth) < 5 * found["sigma"]
    assert not (out / "parameters.png").exists()
    names = {p.name for p in out.iterdir()}
    assert names == {*COMMAND.results, "index.html", "log.json", "log.txt"} - {
        "parameters.fits",
        "parameters.png",
    }


@pytest.mark.parametrize(("changes", "words"), cases("cli/mistakes_in_a_separation"))
def test_mistakes_in_a_separation_are_one_sentence(folder, tmp_path, changes, words, mistake):
    path, out = settings_in(folder, "separate", "wrong", *changes.items()), tmp_path / "out"
    assert words in mistake("separate", path, "--out", out)
    assert not (out / "result.json").exists()


@pytest.mark.slow
def test_noise_that_varies(folder, tmp_path, monkeypatch):
    """Weights of pixels of their own; the likelihood goes through all of them."""
    variance = 0.25 * np.linspace(0.5, 2.0, 12 * NSIDE**2)
    write_maps(folder / "rms.fits", 1e-6 * np.sqrt(variance), names="RMS", unit="K_CMB")
    changes = 5 * [(NOISE, "{ rms = { file = 'rms.fits', fields = ['RMS'] } }")]
    path = settings_in(
        folder, "separate", "varying", *changes, ('sampler = "emcee"', 'sampler = "none"')
    )
    out = tmp_path / "out"
    assert jaxsky(monkeypatch, "separate", path, "--out", out) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["converged"]
    assert jax.config.read("jax_enable_x64")
