"""Made-up templates under the names of PySM's own, in its folders: nothing of the official data."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pysm3
import pytest
from astropy.io import fits as pyfits
from pysm3 import models, utils

NSIDE = 4
#: Ranges of the maps of parameters, by PySM's names; one each, so that programs are compiled once.
RANGES = {
    "map_mbb_index": (1.5, 1.6),
    "map_mbb_temperature": (19.0, 21.0),
    "map_pl_index": (-3.1, -2.9),
    "spectral_curvature": (-0.06, -0.04),
    "freq_peak": (15.0, 35.0),
}
#: Units in the headers; PySM's settings have their own for the older files.
UNITS = {"map_mbb_temperature": "K", "map_layers": "MJy/sr", "map_I": "uK_RJ"}
COMPILED = ("interpolating", "dust", "dust_layers", "power_law", "spdust", "websky")
CARBON_MONOXIDE = {"HFI_CompMap_CO-Type1": "_R2.00_ring", "mcmoleCO_HGL": ""}
PRESETS = pysm3.sky.PRESET_MODELS


def _models(settings: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The models of a preset, one or several."""
    yield from [settings] if "class" in settings else settings.values()


def write_templates(folder: Path, names: list[str], nside: int = NSIDE, dtype: Any = float) -> None:
    """Write each file that presets name, or that their classes do, with values of its own."""
    for own in (model for name in names for model in _models(PRESETS[name])):
        for key, file in own.items():
            if isinstance(file, str) and file.endswith(".fits"):
                for layer in range(1, 1 + own.get("num_layers", 1)):
                    path = folder / file.format(nside=2048, layer=layer)
                    _write(path, key, own, nside, dtype)


def write_others(folder: Path, nside: int = NSIDE, dtype: Any = float) -> None:
    """Write the files that are named in PySM's code."""
    rng, npix = np.random.default_rng(7), healpy.nside2npix(nside)
    columns = {f"co/{name}_512{end}.fits": 3 for name, end in CARBON_MONOXIDE.items()}
    columns |= {"co/psimap_dust90_512.fits": 1, "co/gmap_dust90_512.fits": 1}
    websky = "websky/0.4/cmb/map_{}_{}lensed_alm_seed1_nside512.fits"
    columns |= {websky.format(row, un): 1 for row in "IQU" for un in ("", "un")}
    for name, number in columns.items():
        maps = rng.uniform(0.1, 1.0, (number, npix)) * 1e-6
        save(folder / name, maps, dtype, "K_CMB")
    for model in ("cib1", "rg1"):
        kind = "cib" if model == "cib1" else "radio"
        for nu in pysm3.Sky(1, preset_strings=[model]).components[0].freqs:
            name = f"websky/0.4/{kind}/{kind}_{nu:06.1f}.fits"
            save(folder / name, rng.uniform(0.1, 1.0, (1, npix)), dtype, "MJy/sr")
    for nu in PRESETS["rg3"]["freqs"]:
        name = PRESETS["rg3"]["path"].format(nside=2048)
        save(folder / f"{name}/{nu:05.1f}.fits", rng.uniform(1, 2, (3, npix)), dtype, "uK_RJ")
    # Temperature, its error, index and its error are columns 3, 5, 6 and 8.
    middle = np.array([0, 0, 0, 20.0, 0, 0.5, 1.55, 0, 0.05])[:, None]
    commander = middle * rng.uniform(0.9, 1.1, (9, npix))
    save(folder / "pysm_2/COM_CompMap_dust-commander_0256_R2.00.fits", commander, dtype)
    nu = np.geomspace(0.05, 3000.0, 300)
    emissivity = np.exp(-(np.log(nu / 30) ** 2))
    np.savetxt(folder / "pysm_2/emissivity.txt", np.stack([nu, emissivity], axis=1))
    wavelengths = np.geomspace(50.0, 4e4, 60)[:, None]
    for number, name in enumerate(("sil_fe00_2.0", "sil_fe05_2.0", "car_1.0")):
        log_U = np.arange(-3, 5.01, 0.1)[None]
        T = (19 + number) * 10 ** (log_U / (5.5 + 0.1 * number))
        x = 14388 / (wavelengths * T)
        table = 1e-25 * wavelengths ** -(5.5 + 0.1 * number) / np.expm1(x)
        rows = np.concatenate([wavelengths, x[:, :2], table, 0.1 * table ** (1.01)], axis=1)
        np.savetxt(folder / f"pysm_2/{name}.dat", rows, fmt="%.17e")


#: Multipoles of coefficients of large scales and of maps that modulate, and of spectra.
LARGE, SMALL = 6, 16
#: Means of what is drawn, by the end of the name: map of index, of temperature, and of amplitudes.
MEANS = {"mbb_index": 1.55, "mbb_temperature": 20.0, "pl_index": 0.05}


def write_drawn(folder: Path) -> None:
    """Write coefficients, spectra and maps of the models whose small scales are drawn."""
    rng = np.random.default_rng(11)
    for own in (PRESETS["d11"], PRESETS["s6"]):
        for key, file in own.items():
            if not str(file).endswith(".fits.gz"):
                continue
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            rows = 3 if key in ("largescale_alm", "small_scale_cl") else 1
            unit = "uK_RJ" if rows == 3 else "K" if key.endswith("temperature") else ""
            if "_alm" in key:
                alm = 0.05 * rng.normal(size=(2, rows, healpy.Alm.getsize(LARGE)))
                alm = alm[0] + 1j * alm[1]
                alm[:, : LARGE + 1] = alm[:, : LARGE + 1].real  # m = 0
                alm[0, 0] = MEANS.get(key.partition("alm_")[2], 1.0) * np.sqrt(4 * np.pi)
                healpy.write_alm(path, list(alm) if rows > 1 else alm[0], overwrite=True)
            elif "_cl" in key:
                unit = f"{unit}2" if unit else ""
                cl = 1e-4 / np.arange(1, SMALL + 2) * np.array([1, 0.5, 0.4, 0.2])[:, None]
                healpy.write_cl(path, cl if rows > 1 else cl[0], overwrite=True)
            elif key == "galplane_fix":
                unit = "uK_RJ"
                plane = rng.uniform(0.1, 1.0, (4, healpy.nside2npix(NSIDE)))
                healpy.write_map(path, plane, dtype=float, overwrite=True)
            else:
                maps = rng.uniform(0.9, 1.1, (2, healpy.nside2npix(NSIDE))) * [[1.5], [20.0]]
                healpy.write_map(path, maps, dtype=float, overwrite=True)
            pyfits.setval(path, "TUNIT1", value=unit, ext=1)
            if key == "galplane_fix_beta_Td":
                pyfits.setval(path, "TUNIT2", value="K", ext=1)


def save(path: Path, maps: Any, dtype: Any, unit: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    healpy.write_map(path, maps, dtype=dtype, column_units=unit, overwrite=True)


def _write(path: Path, key: str, own: Mapping[str, Any], nside: int, dtype: Any) -> None:
    rng = np.random.default_rng(sum(path.name.encode()))
    low, high = RANGES.get(key, (1.0, 5.0))
    maps = rng.uniform(low, high, healpy.nside2npix(nside))
    maps[:2] = low, high
    alone = key not in ("map_I", "map_IQU", "map_layers") or "map_Q" in own
    alone |= own["class"].startswith("SpDust")
    if not alone and own.get("has_polarization", True):
        maps = np.stack([maps, *rng.normal(size=(2, maps.size))])
    save(path, maps * (1e-6 if key == "template_name" else 1), dtype, UNITS.get(key, ""))


@pytest.fixture(scope="module")
def uncompiled() -> Iterator[None]:
    """PySM's functions as they are before numba compiles them, which takes seconds each.

    Without numba they compute in the precision of the files.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module in (utils, *(getattr(models, name) for name in COMPILED)):
            for name, value in list(vars(module).items()):
                if hasattr(value, "py_func"):
                    patch.setattr(module, name, value.py_func)
        yield
