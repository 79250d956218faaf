"""The spectral-index fit on the observed sky; skipped where the data are not to be had."""

import json
from pathlib import Path

import pytest

from commands import jaxsky
from fits.common import common_maps
from fits.inputs import inputs_of
from fits.regions import region_masks
from fits.spectral_index import fit_regions
from jaxsky.settings import Experiment, load

EXAMPLE = Path(__file__).parents[1] / "examples" / "wmap7_vw.toml"


@pytest.fixture
def wmap(data_dir, monkeypatch):
    monkeypatch.setenv("JAXSKY_DATA", str(data_dir))
    return load(EXAMPLE)


@pytest.mark.slow
def test_wmap_from_the_command_line(wmap, tmp_path, monkeypatch):
    assert jaxsky(monkeypatch, "fit", EXAMPLE, "--out", tmp_path) == 0
    results = json.loads((tmp_path / "result.json").read_text())["results"]
    assert set(results) == {"strip", "full"}
    for region in results.values():
        assert set(region) == {"Q", "U", "QU"}
        for methods in region.values():
            gradient, grid = methods["gradient"]["best_fit"], methods["grid"]["best_fit"]
            assert gradient == pytest.approx(grid, abs=0.02)
        # The indices of the real sky, which the templates' makers find to be 1.5 and 3.0.
        best = region["QU"]["gradient"]["best_fit"]
        assert 1.2 < best["dust.beta_dust"] < 1.8
        assert 2.7 < best["synchrotron.beta_syn"] < 3.9
    for picture in ("grid.png", "marginals.png", "posterior.png"):
        assert (tmp_path / picture).stat().st_size > 10_000


def test_published_noise_is_recovered_from_the_maps(wmap):
    """About 5.5 uK_CMB a pixel in V and 8.6 in W at high latitude, large scales included."""
    inputs = inputs_of(wmap)
    sigma = common_maps(inputs, 32, 0.0).sigma[:, :, 0]
    for (name, expected), row in zip({"V": 5.5, "W": 8.6}.items(), sigma, strict=True):
        factor = float(inputs.bands[name].bandpass.conversion("uK_CMB", "uK_RJ"))
        assert float(row[0]) / factor == pytest.approx(expected, rel=0.06)


@pytest.mark.slow
def test_a_map_of_the_dust_index_shifts_as_a_whole(wmap):
    """The per-pixel path on real index maps: a fitted offset to a map of beta_dust."""
    raw = wmap.model_dump()
    maps = "templates/pysm2_d1_QU353GHz_betad_Td_n64.fits"
    raw["sky"]["dust"]["parameters"] = {
        "beta_dust": {"file": maps, "fields": ["BETA_D"], "unit": ""}
    }
    raw["free"] = {
        "dust.beta_dust.offset": {"start": 0.0, "uniform": [-1.0, 1.0]},
        "synchrotron.beta_syn": {"start": 3.0, "uniform": [1.0, 6.0]},
    }
    raw["fit"] |= {"methods": ["gradient"], "stokes": ["QU"], "regions": ["strip"]}
    settings = Experiment.model_validate(raw)
    inputs = inputs_of(settings)
    (fit,) = fit_regions(settings, common_maps(inputs, 32, 0.0), region_masks(settings, ["strip"]))
    (constant,) = fit_regions(
        wmap.model_copy(update={"fit": settings.fit}),
        common_maps(inputs_of(wmap), 32, 0.0),
        region_masks(settings, ["strip"]),
    )
    by_map, by_number = fit.results["gradient"], constant.results["gradient"]
    # The index map's mean over the strip, weighted by the dust, is 1.52 ... 1.56.
    shifted = 1.54 + by_map.best_fit["dust.beta_dust.offset"]
    assert shifted == pytest.approx(by_number.best_fit["dust.beta_dust"], abs=0.05)
    assert by_map.sigma["dust.beta_dust.offset"] == pytest.approx(
        by_number.sigma["dust.beta_dust"], rel=0.1
    )
