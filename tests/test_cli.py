"""The command line: the fit on files, what it leaves behind, and one sentence for a mistake."""

import json

import jax
import numpy as np
import pytest

from commands import jaxsky, one_sentence, said
from fits.commands.run import DEFAULTS
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.harmonics import alm_ell, gaussian_beam, resample, synthesis
from jaxsky.io import write_maps
from jaxsky.noise import draw, uniform_covariance
from jaxsky.settings import load
from mapfiles import table, write

NSIDE = 16
TRUTH = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}
SETTINGS = """
title = "A small sky"
[common]
nside = 8
fwhm = 600.0
[free]
"dust.beta_dust" = {{ start = 1.5, uniform = [0.5, 2.5] }}
"synchrotron.beta_syn" = {{ start = 3.1, uniform = [2.0, 4.5] }}
[sky.dust]
law = "dust"
file = "dust.fits"
nu_ref = 353.0
fwhm = 120.0
[sky.synchrotron]
law = "synchrotron"
file = "synchrotron.fits"
nu_ref = 30.0
[[bands]]
name = "44"
file = "44.fits"
fields = ["Q_STOKES", "U_STOKES"]
fwhm = 200.0
bandpass = {{ file = "44.txt", convention = "RJ" }}
noise = {noise}
[[bands]]
name = "70"
file = "70.fits"
fields = ["Q_STOKES", "U_STOKES"]
fwhm = 150.0
bandpass = {{ center = 70.0, width = 14.0 }}
noise = {noise}
[fit]
regions = ["full"]
nsteps = 2200
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Templates, and maps in the format of Planck's: K_CMB, NESTED, covariance columns."""
    folder = tmp_path_factory.mktemp("sky")
    lmax = 2 * NSIDE
    rng = np.random.default_rng(8)
    ell = alm_ell(lmax)
    alms = [
        np.where(ell > 1, 300 * rng.normal(size=(2, ell.size)) / (1 + ell), 0) for _ in range(2)
    ]
    dust, synchrotron = (np.asarray(synthesis(jax.numpy.asarray(a), NSIDE)) for a in alms)
    beam = np.asarray(gaussian_beam(120.0, lmax))[ell]
    smoothed = np.asarray(synthesis(jax.numpy.asarray(alms[0] * beam), NSIDE))
    names = ["Q_STOKES", "U_STOKES"]
    write_maps(folder / "dust.fits", smoothed, names=names, unit="uK_RJ")
    write_maps(folder / "synchrotron.fits", synchrotron, names=names, unit="uK_RJ")
    sky = Sky(
        {
            "dust": Dust(dust, TRUTH["dust.beta_dust"]),
            "synchrotron": Synchrotron(synchrotron, TRUTH["synchrotron.beta_syn"]),
        }
    )
    nu = np.linspace(39.0, 49.0, 21)
    np.savetxt(folder / "44.txt", np.stack([nu, np.hanning(23)[1:-1]], axis=1))
    bands = {
        "44": (Bandpass(nu, np.hanning(23)[1:-1]), 200.0),
        "70": (Bandpass.top_hat(70.0, 14.0), 150.0),
    }
    for i, (name, (band, fwhm)) in enumerate(bands.items()):
        seen = resample(observe(sky, [band])[0], gaussian_beam(fwhm, lmax), NSIDE)
        covariance = uniform_covariance(200.0, NSIDE)  # uK_CMB
        noise = np.asarray(draw(jax.random.key(i), covariance))
        maps = 1e-6 * (np.asarray(seen) / float(band.conversion("uK_CMB", "uK_RJ")) + noise)
        QQ, QU, UU = 1e-12 * np.asarray(covariance)[(0, 0, 1), (0, 1, 1)]
        columns = {
            "Q_STOKES": maps[0],
            "U_STOKES": maps[1],
            "HITS": np.ones(QQ.size),
            "QQ_COV": QQ,
            "QU_COV": QU,
            "UU_COV": UU,
        }
        units = ["K_CMB"] * 2 + [""] + ["K_CMB^2"] * 3
        nested = table(columns, units, form="D", ORDERING="NESTED")
        write(folder / f"{name}.fits", nested)
    return folder


def write_settings(
    folder, name, noise="{ covariance = ['QQ_COV', 'QU_COV', 'UU_COV'] }", **replace
):
    text = SETTINGS.format(noise=noise)
    for old, new in replace.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.mark.slow
def test_fit_on_files_in_plancks_format(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert jaxsky(monkeypatch, "fit", write_settings(folder, "full"), "--out", out) == 0
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


def test_options_replace_settings_and_results_are_kept(folder, tmp_path, monkeypatch, capsys):
    path, out = write_settings(folder, "options"), tmp_path / "out"
    options = ["--out", out]
    for value in ('fit.stokes=["QU"]', 'fit.regions=["strip"]', "seed=5", "common.nside=4"):
        options += ["--set", value]
    assert jaxsky(monkeypatch, "fit", path, *options) == 0
    before = (out / "result.json").read_bytes()
    parts = {"description", "warnings", "likelihood", "truth", "results"}
    assert set(json.loads(before)) == parts
    assert set(json.loads(before)["results"]) == {"strip"}
    assert set(json.loads(before)["results"]["strip"]) == {"QU"}
    capsys.readouterr()
    assert jaxsky(monkeypatch, "fit", path, *options) == 2
    assert "holds results already; go on with --resume" in one_sentence(capsys)
    assert (out / "result.json").read_bytes() == before
    # Another seed is another chain: it is not gone on with.
    other = [*options, "--set", "seed=6"]
    assert jaxsky(monkeypatch, "fit", path, *other, "--resume") == 2
    assert "holds a chain of other data or settings" in one_sentence(capsys)
    assert jaxsky(monkeypatch, "fit", path, *options, "--resume") == 0
    again = json.loads((out / "result.json").read_text())
    assert again["results"] == json.loads(before)["results"]


@pytest.mark.parametrize("noise", ["{ rms = 9e-7 }", "{ estimate_above = 0 }"])
def test_noise_can_be_given_in_other_ways(folder, tmp_path, monkeypatch, noise):
    few = 'methods = ["gradient"]\nstokes = ["QU"]'
    path = write_settings(folder, "noise", noise, **{'regions = ["full"]': few})
    assert jaxsky(monkeypatch, "fit", path, "--out", tmp_path / "o") == 0
    result = json.loads((tmp_path / "o" / "result.json").read_text())
    fit = result["results"]["full"]["QU"]["gradient"]
    for name, value in TRUTH.items():
        assert fit["best_fit"][name] == pytest.approx(value, abs=0.2)
    assert not (tmp_path / "o" / "grid.png").exists()


def test_paths_with_variables(folder, tmp_path, monkeypatch):
    path = write_settings(
        tmp_path, "elsewhere", **{'title = "A small sky"': 'data_dir = "${SKY_MAPS:-/nowhere}"'}
    )
    assert load(path).data_dir == "/nowhere"
    monkeypatch.setenv("SKY_MAPS", str(folder))
    assert load(path).data_dir == str(folder.resolve())
    plain = path.read_text().replace("${SKY_MAPS:-/nowhere}", "$SKY_NOTHING")
    path.write_text(plain)
    with pytest.raises(ValueError, match=r"data_dir: the environment variable SKY_NOTHING is not"):
        load(path)


@pytest.mark.parametrize("name", [path.stem for path in DEFAULTS.glob("*.toml")])
def test_init_writes_an_experiment_that_is_valid(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert jaxsky(monkeypatch, "init", name) == 0
    assert f"{name}.toml" in said(capsys)
    settings = load(tmp_path / f"{name}.toml")
    given = load(DEFAULTS / f"{name}.toml").model_copy(update={"data_dir": str(tmp_path)})
    assert settings == given


def test_init_leaves_files_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mine = tmp_path / "mine.toml"
    assert jaxsky(monkeypatch, "init", "planck-44-70", "--out", mine) == 0
    assert [band.name for band in load(mine).bands] == ["44", "70"]
    assert jaxsky(monkeypatch, "init") == 0  # the template
    assert load(tmp_path / "experiment.toml").title == "LiteBIRD"
    for path, arguments in ((mine, ["--out", mine]), (tmp_path / "experiment.toml", [])):
        path.write_text("mine")
        capsys.readouterr()
        assert jaxsky(monkeypatch, "init", *arguments) == 2
        assert f"{path.name}: exists already" in one_sentence(capsys)
        assert path.read_text() == "mine"
    assert jaxsky(monkeypatch, "init", "planck", "--out", tmp_path / "other.toml") == 2
    printed = one_sentence(capsys)
    assert "no experiment 'planck'; there are" in printed
    assert all(path.stem in printed for path in DEFAULTS.glob("*.toml"))
    for out, words in (("none/x.toml", "No such file or directory"), (".", "exists already")):
        assert jaxsky(monkeypatch, "init", "--out", out) == 2
        assert f"{out}: {words}" in one_sentence(capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.toml", "experiment.toml"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("nside = 8", "nside = ", "is not valid TOML"),
        ('["full"]', '["fool"]', "fit.regions: 'fool' is none of strip, outside, full"),
        ('["full"]', '["full"]\nstokes = ["I"]', "fit.stokes.0: input should be 'Q'"),
        ("uniform = [0.5, 2.5]", "uniform = [2.5, 0.5]", "free.dust.beta_dust"),
        ('"dust.beta_dust" =', '"dust.beta" =', "Unknown parameter 'dust.beta'"),
        ("[fit]", '[fixed]\n"dust.beta_dust" = 1.5\n[fit]', "cannot be both free and fixed"),
        ("nsteps = 2200", "nwalkers = 2", "fit.nwalkers"),
        ("rms = 1e-6", "rms = 0.0", "bands.0.noise: must be greater than 0"),
        ("1e-6 }", "1e-6, correlated = true }", "correlated goes with estimate_above only"),
    ],
)
def test_mistakes_are_one_sentence(folder, tmp_path, monkeypatch, capsys, old, new, words):
    path, out = write_settings(folder, "wrong", "{ rms = 1e-6 }", **{old: new}), tmp_path / "out"
    assert jaxsky(monkeypatch, "fit", path, "--out", out) == 2
    assert words in one_sentence(capsys)
    assert not list(out.glob("*")) if out.exists() else True
