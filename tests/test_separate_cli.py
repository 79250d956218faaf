"""`jaxsky separate`: files in, files out, and one sentence for a mistake."""

import json

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from commands import jaxsky, one_sentence, said
from fits.commands.separate import COMMAND
from jaxsky import CMB, Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.harmonics import alm_ell, gaussian_beam, resample, synthesis
from jaxsky.io import read_maps, write_maps

NSIDE = 16
BANDS = {"40": 90.0, "100": 80.0, "195": 80.0, "280": 80.0, "402": 80.0}
SIGMA = 0.5
SETTINGS = """
title = "A small sky"
[common]
nside = 8
fwhm = 600.0
[sky]
dust = { law = "dust", nu_ref = 353.0, parameters = { T_dust = 20.0 } }
synchrotron = { law = "synchrotron", nu_ref = 30.0 }
[free]
"dust.beta_dust" = { start = 1.5, gaussian = [1.6, 0.3], regions = REGIONS }
"synchrotron.beta_syn" = { start = 3.1, uniform = [2.0, 4.5] }
[separate]
nsims = 20
sampler = "emcee"
nsteps = 1500
width = 4
"""
BAND = """
[[bands]]
name = "{name}"
file = "{name}.fits"
fields = ["Q_STOKES", "U_STOKES"]
fwhm = {fwhm}
bandpass = {{ center = {name}, width = 10.0 }}
noise = NOISE
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Observed bands, in K_CMB with columns of covariance, and a map of labels."""
    folder = tmp_path_factory.mktemp("sky")
    rng, ell = np.random.default_rng(4), alm_ell(2 * NSIDE)
    alms = [
        np.where(ell > 1, a * rng.normal(size=(2, ell.size)) / (1 + ell), 0) for a in (3, 300, 300)
    ]
    cmb, dust, synchrotron = (np.asarray(synthesis(jnp.asarray(a), NSIDE)) for a in alms)
    sky = {
        "cmb": CMB(cmb),
        "dust": Dust(dust, 1.6, 20.0),
        "synchrotron": Synchrotron(synchrotron, 3.0),
    }
    for name, fwhm in BANDS.items():
        band = Bandpass.top_hat(float(name), 10.0)
        seen = resample(observe(Sky(sky), [band])[0], gaussian_beam(fwhm, 2 * NSIDE), NSIDE)
        maps = np.asarray(seen) / float(band.conversion("uK_CMB", "uK_RJ"))
        maps = 1e-6 * (maps + SIGMA * rng.normal(size=maps.shape))
        variance = np.full(maps.shape[1], (SIGMA * 1e-6) ** 2)
        columns = [*maps, variance, 0 * variance, variance]
        write_maps(
            folder / f"{name}.fits",
            np.stack(columns),
            names=["Q_STOKES", "U_STOKES", "QQ_COV", "QU_COV", "UU_COV"],
            unit=["K_CMB", "K_CMB", "K_CMB^2", "K_CMB^2", "K_CMB^2"],
        )
    halves = healpy.pix2ang(8, np.arange(768))[0] > np.pi / 2
    write_maps(folder / "labels.fits", 1.0 * halves, names="LABEL", unit="")
    write_maps(folder / "shares.fits", halves + 0.5, names="LABEL", unit="")
    return folder


def settings(folder, name, regions="{ file = 'labels.fits' }", noise=None, **replace):
    noise = noise or "{ covariance = ['QQ_COV', 'QU_COV', 'UU_COV'] }"
    bands = "".join(BAND.format(name=band, fwhm=fwhm) for band, fwhm in BANDS.items())
    text = (SETTINGS + bands).replace("REGIONS", regions).replace("NOISE", noise)
    for old, new in replace.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.mark.slow
def test_maps_of_ones_own(folder, tmp_path, monkeypatch, capsys):
    path, out = settings(folder, "own"), tmp_path / "out"
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
    assert jaxsky(monkeypatch, "separate", path, "--out", out) == 2
    assert "holds results already; go on with --resume" in one_sentence(capsys)
    assert jaxsky(monkeypatch, "separate", path, "--out", out, "--resume") == 0
    again = json.loads((out / "result.json").read_text())
    assert again == json.loads(before)
    assert jaxsky(monkeypatch, "separate", path, "--out", out, "--resume", "--set", "seed=8") == 2
    assert "holds realisations of other data or settings" in said(capsys)


@pytest.mark.slow
@pytest.mark.parametrize("region", ["full", "outside"])
def test_multipoles_of_files(folder, tmp_path, monkeypatch, region):
    path = settings(folder, "harmonic", regions="REGIONS", **{", regions = REGIONS": ""})
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


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"domain": "wave"}, ""),
        ({"'labels.fits'": "'shares.fits'"}, "labels must be whole numbers"),
        ({"'labels.fits'": "'40.fits', fields = ['Q_STOKES', 'U_STOKES']"}, "must name one column"),
        ({"'labels.fits'": "'40.fits', fields = ['QQ_COV']"}, "nside is 16, but common.nside"),
        ({'beta_syn"': 'beta"'}, "Unknown parameter 'synchrotron.beta'"),
        (
            {"uniform = [2.0, 4.5]": "uniform = [3.05, 4.5]"},
            "of its uniform prior",
        ),
        ({"start = 3.1, uniform = [2.0, 4.5]": "start = nan"}, "finite number"),
    ],
)
def test_mistakes_are_one_sentence(folder, tmp_path, monkeypatch, capsys, changes, words):
    options = []
    if "domain" in changes:
        options, changes = ["--set", f"separate.domain={changes['domain']}"], {}
        words = "separate.domain: input should be 'pixel' or 'harmonic'"
    path, out = settings(folder, "wrong", **changes), tmp_path / "out"
    assert jaxsky(monkeypatch, "separate", path, "--out", out, *options) == 2
    assert words in one_sentence(capsys)
    assert not (out / "result.json").exists()


@pytest.mark.slow
def test_noise_that_varies(folder, tmp_path, monkeypatch):
    """Weights of pixels of their own; the likelihood goes through all of them."""
    variance = SIGMA**2 * np.linspace(0.5, 2.0, 12 * NSIDE**2)
    write_maps(folder / "rms.fits", 1e-6 * np.sqrt(variance), names="RMS", unit="K_CMB")
    path = settings(
        folder,
        "varying",
        noise="{ rms = { file = 'rms.fits', fields = ['RMS'] } }",
        **{'sampler = "emcee"': 'sampler = "none"'},
    )
    out = tmp_path / "out"
    assert jaxsky(monkeypatch, "separate", path, "--out", out) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["converged"]
    assert jax.config.read("jax_enable_x64")
