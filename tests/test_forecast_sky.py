"""Forecasts from maps: foreground spectra outside a mask, and the command on files."""

import json

import healpy
import jax.numpy as jnp
import numpy as np
import pytest

from commands import experiment, jaxsky
from fits.commands.forecast import forecast, forecast_warnings
from fits.commands.run import DEFAULTS
from fits.fisher import BandLaw, equal_r, fit_law, foreground_laws
from fits.pseudo_cl import band_powers, bin_edges, masked_spectra, sky_fraction
from fits.regions import apodize
from fits.tensor_ratio import covariance_terms
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe_band
from jaxsky.harmonics import alm_ell, gaussian_beam, power_spectrum, synthesis
from jaxsky.io import write_maps
from jaxsky.observation import load_instrument
from jaxsky.settings import load
from refusals import cases

NSIDE, LMAX = 32, 64
#: D_l at l = 80 and slope of C_l, of EE and BB [uK_RJ^2].
LAWS = {"dust": ((4.0, -2.4), (2.0, -2.6)), "synchrotron": ((30.0, -2.7), (10.0, -2.9))}
RHO, FWHM = 0.6, {"dust": 60.0, "synchrotron": 120.0}


def to_D(C: np.ndarray) -> np.ndarray:
    """D_l = l (l + 1) C_l / 2 pi."""
    ell = np.arange(len(C))
    return ell * (ell + 1) / (2 * np.pi) * C


def law(amplitude: float, slope: float) -> np.ndarray:
    """C_l of a power law."""
    ell = np.arange(LMAX + 1)
    C = amplitude * 2 * np.pi / (80 * 81) * (np.maximum(ell, 1) / 80) ** slope
    return np.where(ell < 2, 0.0, C)


def coefficients() -> dict[str, np.ndarray]:
    """E and B of dust and synchrotron, correlated, whose own spectra are exactly the laws."""
    rng, ell = np.random.default_rng(3), alm_ell(LMAX)
    white = []
    for _ in range(2):
        alm = np.where(ell > 1, rng.normal(size=(2, ell.size)), 0.0)
        for other in white:  # multipole by multipole, orthogonal
            overlap = np.asarray(power_spectrum(jnp.asarray(alm), jnp.asarray(other)))
            alm = alm - overlap[:, ell] * other
        power = np.asarray(power_spectrum(jnp.asarray(alm)))
        white.append(alm / np.sqrt(np.where(power > 0, power, 1.0))[:, ell])
    dust, rest = white
    mixed = {"dust": dust, "synchrotron": RHO * dust + np.sqrt(1 - RHO**2) * rest}
    return {
        name: np.stack([np.sqrt(law(*of))[ell] for of in LAWS[name]]) * alm
        for name, alm in mixed.items()
    }


@pytest.fixture(scope="module")
def sky() -> Sky:
    """Both components with a beam of 60 arcmin."""
    window = np.asarray(gaussian_beam(60.0, LMAX))[alm_ell(LMAX)]
    maps = {n: synthesis(jnp.asarray(a * window), NSIDE) for n, a in coefficients().items()}
    return Sky({"dust": Dust(maps["dust"]), "synchrotron": Synchrotron(maps["synchrotron"])})


def spectra(mask: np.ndarray, fwhm: float = 60.0):
    window = np.asarray(gaussian_beam(fwhm, LMAX))
    return masked_spectra(mask, bin_edges(2, 61, 6), lmax=LMAX, window=window)


def expected(band: Bandpass) -> np.ndarray:
    """C_l of EE and BB of the sum of both components [uK_CMB^2]."""
    one = jnp.ones((2, 1))
    seen = [
        float(observe_band(Sky({"a": c}), band)[0, 0] * band.conversion("uK_RJ", "uK_CMB"))
        for c in (Dust(one), Synchrotron(one))
    ]
    found = []
    for dust, synchrotron in zip(LAWS["dust"], LAWS["synchrotron"], strict=True):
        roots = seen[0] * np.sqrt(law(*dust)), seen[1] * np.sqrt(law(*synchrotron))
        found.append(roots[0] ** 2 + roots[1] ** 2 + 2 * RHO * roots[0] * roots[1])
    return np.stack(found)


BANDS = {"45": Bandpass.top_hat(45.0, 11.0), "315": Bandpass.top_hat(315.0, 79.0)}


def test_powers_of_a_known_sky(sky):
    full = spectra(np.ones(12 * NSIDE**2))
    latitude = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2), lonlat=True)[1]
    cut = spectra(apodize(np.abs(latitude) > 20, 6.0))
    window = np.asarray(gaussian_beam(60.0, LMAX)) ** 2
    for band in BANDS.values():
        C, maps = expected(band), observe_band(sky, band) * band.conversion("uK_RJ", "uK_CMB")
        found, found_cut = band_powers(full, maps), band_powers(cut, maps)
        D = np.einsum("ibjl,jl->ib", full.windows, C)
        np.testing.assert_allclose(found, D, rtol=2e-3)
        # On part of the sky, within the scatter of its modes.
        D = np.einsum("ibjl,jl->ib", cut.windows, C)
        covariance = 2 * covariance_terms(cut, (C * window)[None])[0, 0].reshape(D.size, D.size)
        off = (found_cut - D).ravel()
        chi2 = off @ np.linalg.solve(covariance, off)
        assert 0.1 * D.size < chi2 < 1.6 * D.size
    # The law of the last comes back: bins are steep at the lowest multipoles, so not from these.
    BB = fit_law(full, found[1], (14, 61), "BB")
    steepest, shallow = LAWS["dust"][1], expected(BANDS["315"])[1]
    assert BB.slope == pytest.approx(steepest[1], abs=0.05)
    at_30 = BB.amplitude * (30 / 80) ** (BB.slope + 2)
    assert at_30 == pytest.approx(to_D(shallow)[30], rel=0.03)
    laws = foreground_laws(sky, full, ("EE", "BB"), (14, 61))
    for field in ("EE", "BB"):
        assert laws[f"{field}.dust.synchrotron.correlation"] == pytest.approx(RHO, rel=1e-3)


def test_laws_in_closed_form():
    full = spectra(np.ones(12 * NSIDE**2))
    D = 3.0 * (full.centers / 80) ** -0.4
    assert fit_law(full, D, (2, 61), "D") == pytest.approx((3.0, -2.4), rel=1e-10)
    # Each bin as it has modes: a wrong value counts more at high multipoles.
    for at, least, most in ((0, 0.0, 0.06), (-1, 0.06, 1.0)):
        wrong = D.copy()
        wrong[at] *= 1.5
        assert least < abs(fit_law(full, wrong, (2, 61), "D").slope + 2.4) < most
    with pytest.raises(
        ValueError, match=r"The law of D takes three bins, but 1 of those from l = 2 to 61"
    ):
        fit_law(full, D, (14, 24), "D")
    with pytest.raises(ValueError, match=r"takes positive band powers, but at l = 4.5 that is -1"):
        fit_law(full, np.where(full.centers < 5, -1.0, D), (2, 61), "D")


def test_equal_r_of_primordial_modes():
    full = spectra(np.ones(12 * NSIDE**2))
    ell = np.arange(101)
    tensors = np.zeros((4, 101))
    tensors[1], tensors[2] = 1 / (ell + 9.0) ** 2, 1 / (ell + 5.0) ** 2
    D = np.einsum("ibjl,jl->ib", full.windows, 0.03 * tensors[1:3, : LMAX + 1])
    at_80 = BandLaw(0.07 * 80 * 81 / (2 * np.pi) / 85**2, -2.4)
    found = equal_r(full, D, at_80, tensors)
    assert found == pytest.approx({"l = 80": 0.07, "reionisation": 0.03}, rel=1e-10)
    late = masked_spectra(np.ones(12 * NSIDE**2), bin_edges(20, 60, 6), lmax=LMAX)
    assert list(equal_r(late, D, at_80, tensors)) == ["l = 80"]


def test_apodization():
    latitude = np.abs(healpy.pix2ang(64, np.arange(12 * 64**2), lonlat=True)[1])
    used = latitude > 20
    mask = apodize(used, 10.0)
    assert not mask[~used].any()
    assert (mask[latitude > 31.0] == 1).all()
    assert ((mask[used] > 0) & (mask[used] <= 1)).all()
    # Half way: x = 1/2 but for the sphere's curvature; the edge is known to a pixel.
    middle = mask[np.abs(latitude - 25) < 0.3]
    np.testing.assert_allclose(middle, 0.5, atol=0.2)
    d = np.radians(latitude[used] - 20)
    x = np.minimum(np.sqrt((1 - np.cos(d)) / (1 - np.cos(np.radians(10)))), 1)
    np.testing.assert_allclose(mask[used], x - np.sin(2 * np.pi * x) / (2 * np.pi), atol=0.2)
    np.testing.assert_array_equal(apodize(used, 0.0), used)
    np.testing.assert_array_equal(apodize(np.ones(48, bool), 10.0), 1)
    assert sky_fraction(used.astype(float)) == pytest.approx(used.mean())
    assert sky_fraction(0.3 * used) == pytest.approx(used.mean())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Templates with different beams, and masks at other resolutions."""
    folder = tmp_path_factory.mktemp("sky")
    for name, alm in coefficients().items():
        beam = np.asarray(gaussian_beam(FWHM[name], LMAX))[alm_ell(LMAX)]
        maps = np.asarray(synthesis(jnp.asarray(alm * beam), NSIDE))
        write_maps(folder / f"{name}.fits", maps, names=["Q_STOKES", "U_STOKES"], unit="uK_RJ")
    fine = np.abs(healpy.pix2ang(64, np.arange(12 * 64**2), lonlat=True)[1]) > 25
    coarse = np.arange(12 * 16**2) < 6 * 16**2
    np.savez(folder / "masks.npz", half=fine, coarse=coarse, few=np.arange(48) == 0, odd=2 * coarse)
    return folder


def written(folder, name, old="", new=""):
    path = folder / f"{name}.toml"
    path.write_text(experiment("forecast", (old, new)))
    return path


@pytest.mark.slow
def test_command_on_files(folder, tmp_path, monkeypatch, capsys, mistake):
    path, out = written(folder, "whole"), tmp_path / "out"
    assert jaxsky(monkeypatch, "forecast", path, "--out", out) == 0
    printed = capsys.readouterr()
    assert "synchrotron.beta_syn" in printed.out
    assert "forecast.json" in printed.err
    names = ["bb.png", "fisher.png", "forecast.json", "index.html", "log.json", "log.txt"]
    assert sorted(p.name for p in out.iterdir()) == names
    for picture in out.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    result = json.loads((out / "forecast.json").read_text())
    assert 0.45 < result["sky_fraction"] < 0.58
    assert list(result["foregrounds"]) == ["40", "100", "300"]
    # The template's own beams are out of the spectra: these are the laws of the sky.
    for field, row in (("EE", 0), ("BB", 1)):
        C = expected(Bandpass.top_hat(300.0, 80.0))[row]
        bins = zip(result["bins"]["first"], result["bins"]["last"], strict=True)
        D = np.array([np.mean(to_D(C)[a : b + 1]) for a, b in bins])
        ratio = np.array(result["foregrounds"]["300"][field]) / D
        assert np.average(ratio, weights=np.arange(ratio.size)) == pytest.approx(1, abs=0.12)
    values = result["parameters"]
    assert values["BB.dust.amplitude"] == pytest.approx(LAWS["dust"][1][0], rel=0.3)
    assert values["BB.dust.synchrotron.correlation"] == pytest.approx(RHO, abs=0.1)
    assert values["dust.T_dust"] == 20.0
    fisher, sigma_r = result["fisher"], result["sigma_r"]
    assert fisher["free"][:3] == ["r", "dust.beta_dust", "synchrotron.beta_syn"]
    pairs = [("amplitude", "dust"), ("amplitude", "synchrotron"), ("slope", "dust")]
    pairs += [("slope", "synchrotron"), ("correlation", "dust.synchrotron")]
    assert fisher["free"][3:] == [f"BB.{name}.{kind}" for kind, name in pairs]
    np.testing.assert_allclose(
        np.sqrt(np.diag(fisher["covariance"])), list(fisher["sigma"].values())
    )
    assert 0 < sigma_r["no_foregrounds"] < sigma_r["all_else_known"]
    assert sigma_r["all_else_known"] < sigma_r["foregrounds_free"] == fisher["sigma"]["r"]
    before = (out / "forecast.json").read_bytes()
    assert "holds results already; replace them with --overwrite" in mistake(
        "forecast", path, "--out", out
    )
    other = written(folder, "other", "fisher_lmax = 80", 'fisher_lmax = 80\nspectra = ["EE", "BB"]')
    assert jaxsky(monkeypatch, "forecast", other, "--out", out, "--overwrite") == 0
    free = json.loads((out / "forecast.json").read_text())["fisher"]["free"]
    assert free[3:] == [f"{field}.{name}.{kind}" for field in ("EE", "BB") for kind, name in pairs]
    assert (out / "forecast.json").read_bytes() != before


def test_laws_that_vary_and_coarse_masks(folder):
    beta = 1.5 + 0.1 * np.cos(healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))[0])
    write_maps(folder / "beta.fits", beta[None], names=["BETA"], unit="")
    path = written(folder, "maps", "nu_ref = 353.0", 'nu_ref = 353.0\n'
                   'parameters = { beta_dust = { file = "beta.fits" } }')  # fmt: skip
    path.write_text(path.read_text().replace('"half"', '"coarse"'))
    found = forecast(load(path))
    # The northern half has the larger index.
    assert 1.53 < found.errors.fiducial["dust.beta_dust"] < 1.57
    assert 0.4 < sky_fraction(found.inputs.mask) < 0.5
    assert any(
        "Laws of dust vary over the sky" in sentence for sentence in forecast_warnings(found)
    )


def test_priors_are_in_the_table_free(folder):
    """Also those of what only a forecast has, which frees it."""
    own = "r = {}\nA_lens = { gaussian = [1.0, 0.05] }"
    slope = '"BB.dust.slope" = { gaussian = [-2.6, 0.01] }'
    path = written(folder, "priors", "[free]", f"[free]\n{own}\n{slope}")
    path.write_text(path.read_text().replace("[forecast]", '[forecast]\nfree = ["amplitude"]'))
    errors = forecast(load(path)).errors
    assert errors.priors == {"dust.beta_dust": 0.5, "A_lens": 0.05, "BB.dust.slope": 0.01}
    assert errors.sigma["A_lens"] < 0.05
    assert 0 < errors.sigma["BB.dust.slope"] < 0.01
    assert errors.sigma["r"] > 0


def test_settings_that_come_along():
    default = load(DEFAULTS / "forecast.toml")
    assert [band.name for band in default.bands] == list(load_instrument("core"))
    assert default.forecast.bands == ["45", "105", "315"]
    assert default.forecast.free == ["r", "amplitude", "slope", "correlation"]
    assert list(default.free_in("forecast")) == [
        "dust.beta_dust", "dust.T_dust", "synchrotron.beta_syn", "synchrotron.curvature",
    ]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "words"), cases("forecast_sky/mistakes"))
def test_mistakes_are_one_sentence(folder, tmp_path, old, new, words, mistake):
    path, out = written(folder, "mistake", old, new), tmp_path / "out"
    assert words in mistake("forecast", path, "--out", out)
    assert not out.exists()


def test_bands_and_a_sky_are_needed(folder, tmp_path, mistake):
    path, out = written(folder, "needed"), tmp_path / "out"
    assert "bands: there are none" in mistake("forecast", path, "--out", out, "--set", "bands=[]")
    path.write_text('[[bands]]\ninstrument = "core"')
    assert "sky: has no components" in mistake("forecast", path, "--out", out)
