"""The spectral-index fit on the observed sky; skipped where the data are not to be had."""

import json
from pathlib import Path

import pytest

from commands import jaxsky
from fits.common import common_maps
from fits.inputs import inputs_of
from jaxsky.settings import load

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
