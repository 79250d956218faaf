"""Laws that are tables, and the SZ effect, from experiment files."""

import json
from pathlib import Path

import healpy
import numpy as np
import pytest

import systems
from commands import experiment, jaxsky
from jaxsky import smooth
from jaxsky.components import HensleyDraine, SpinningDust, ThermalSZ
from jaxsky.io import read_maps, write_maps

NSIDE = 8
SPINNING = 'parameters = { nu_peak = 33.35, nu_table = 30.0, emissivity = { file = "spdust.txt" } }'
GRAINS = 'parameters = { log_U = 0.1, emissivity = { file = "grains.txt" } }'
FREE_FREE = "parameters = { T_e = 8000.0 }"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Smooth maps, and tables as text, in the current folder."""
    rng = np.random.default_rng(4)
    steep = healpy.gauss_beam(np.radians(15.0), 16) / (1 + np.arange(17))
    alm = [
        healpy.almxfl(rng.normal(size=(healpy.Alm.getsize(16), 2)) @ [50, 50j], steep)
        for _ in range(3)
    ]
    maps = np.array(healpy.alm2map(alm, NSIDE, lmax=16))
    write_maps(tmp_path / "intensity.fits", maps, names=["I", "Q", "U"], unit="uK_RJ")
    write_maps(tmp_path / "qu.fits", maps[1:], names=["Q", "U"], unit="uK_RJ")
    peak = 33 + 2 * maps[0] / np.std(maps[0])
    write_maps(tmp_path / "peak.fits", peak, names="NU", unit="GHz")
    np.savetxt(tmp_path / "spdust.txt", systems.emissivity(), header="nu [GHz]  j_nu")
    np.savetxt(tmp_path / "grains.txt", systems.grains())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def simulated(monkeypatch, law, parameters, *changes):
    """The map that is simulated at 70 GHz."""
    text = experiment("free_free", ('"free_free"', f'"{law}"'), (FREE_FREE, parameters), *changes)
    Path("s.toml").write_text(text)
    assert jaxsky(monkeypatch, "simulate", "s.toml", "--out", "sims") == 0
    (path,) = Path("sims").rglob("*.fits")
    return np.asarray(read_maps(path).maps)


def smoothed(maps):
    """Maps with a beam of 20 degrees in place of 15."""
    return np.asarray(smooth(maps, np.sqrt(1200**2 - 900**2)))


@pytest.mark.parametrize(
    ("law", "parameters", "expected"),
    [
        ("spinning_dust", SPINNING,
         SpinningDust(np.ones((3, 1)), systems.emissivity(), 33.35, nu_table=30.0, nu_ref=30.0)),
        ("hd17", GRAINS, HensleyDraine(np.ones((3, 1)), systems.grains(), 0.1, nu_ref=30.0)),
        ("sz", "parameters = { T_cmb = 2.7 }",
         ThermalSZ(np.array([[1.0], [0.0], [0.0]]), T_cmb=2.7, nu_ref=30.0)),
    ],
)  # fmt: skip
def test_laws_are_simulated(monkeypatch, law, parameters, expected):
    file = '"intensity.fits"'
    changes = [(file, f'{file}\nfields = ["I"]')] if law == "sz" else []
    found = simulated(monkeypatch, law, parameters, *changes)
    template = np.asarray(read_maps("intensity.fits").maps)
    template[1:] *= law != "sz"
    seen = float(expected.sed(70.0)) * smoothed(template)
    # Written in single precision.
    np.testing.assert_allclose(found, seen, rtol=0, atol=1e-5 * np.std(seen[0]))


def test_a_map_and_a_table_in_one_law(monkeypatch):
    parameters = SPINNING.replace("33.35", '{ file = "peak.fits" }')
    found = simulated(monkeypatch, "spinning_dust", parameters)
    (peak,) = np.asarray(read_maps("peak.fits").maps)
    template = np.asarray(read_maps("intensity.fits").maps)
    law = SpinningDust(template, systems.emissivity(), peak, nu_table=30.0, nu_ref=30.0)
    expected = smoothed(template * np.asarray(law.sed(70.0)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-2 * np.std(expected[0]))


def test_the_peak_of_a_table_is_fitted(folder, monkeypatch):
    maps = np.asarray(read_maps("qu.fits").maps)
    law = SpinningDust(np.ones((2, 1)), systems.emissivity(), 36.0, nu_table=30.0, nu_ref=30.0)
    seen = maps * float(law.sed(70.0)) + 0.02 * np.random.default_rng(6).normal(size=maps.shape)
    write_maps("seen.fits", seen, names=["Q", "U"], unit="uK_RJ")
    text = experiment(
        "own_law",
        ('"steep_law:Steep"', f'"spinning_dust"\n{SPINNING}'),
        ('"x.slope" = { start = 2.0, uniform = [1.0, 4.0] }',
         '"x.nu_peak" = { start = 33.0, uniform = [20.0, 60.0] }'),
    )  # fmt: skip
    (folder / "f.toml").write_text(text)
    assert jaxsky(monkeypatch, "fit", "f.toml", "--out", "fit") == 0
    found = json.loads((folder / "fit" / "result.json").read_text())["results"]["full"]["QU"]
    value = found["gradient"]["best_fit"]["x.nu_peak"]
    sigma = found["gradient"]["covariance"][0][0] ** 0.5
    assert abs(value - 36.0) < 4 * sigma < 1


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (', emissivity = { file = "spdust.txt" }', "",
         "sky.x: Argument `emissivity` is missing: a table of frequencies [GHz] and emissivities."),
        ('{ file = "spdust.txt" }', "2.0",
         "sky.x: Argument `emissivity` must be a table (row, 2) of frequencies"),
        ('{ file = "spdust.txt" }', '{ file = "spdust.txt", unit = "GHz" }',
         "sky.x.parameters.emissivity.unit: is of maps, but this is a table of numbers."),
        ('{ file = "spdust.txt" }', '{ file = ["spdust.txt", "grains.txt"] }',
         "sky.x.parameters.emissivity.file: must be one file, not spdust.txt, grains.txt."),
        ("spdust.txt", "grains.txt", "sky.x: Argument `emissivity` must be a table (row, 2) of"),
        ("spdust.txt", "peak.fits", "peak.fits: neither a FITS file nor a text table"),
        ("spdust.txt", "nowhere.txt", "nowhere.txt"),
    ],
)  # fmt: skip
def test_tables_that_cannot_be_used(folder, mistake, old, new, sentence):
    text = experiment(
        "free_free", ('"free_free"', '"spinning_dust"'), (FREE_FREE, SPINNING), (old, new)
    )
    (folder / "s.toml").write_text(text)
    assert sentence in mistake("simulate", "s.toml", "--out", "sims")
