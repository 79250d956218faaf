"""Made-up templates under the names of PySM's own, in its folders: nothing of the official data."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pysm3
import pytest
from pysm3 import models, utils

NSIDE = 4
#: Ranges of the maps of parameters, by PySM's names; one each, so that programs are compiled once.
RANGES = {
    "map_mbb_index": (1.5, 1.6),
    "map_mbb_temperature": (19.0, 21.0),
    "map_pl_index": (-3.1, -2.9),
    "spectral_curvature": (-0.06, -0.04),
}
#: Units in the headers; PySM's settings have their own for the older files.
UNITS = {"map_mbb_temperature": "K", "map_layers": "MJy/sr", "map_I": "uK_RJ"}
PRESETS = pysm3.sky.PRESET_MODELS


def _models(settings: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The models of a preset, one or several."""
    yield from [settings] if "class" in settings else settings.values()


def write_templates(folder: Path, names: list[str], nside: int = NSIDE, dtype: Any = float) -> None:
    """Write each file that presets name, with values of its own."""
    for own in (model for name in names for model in _models(PRESETS[name])):
        for key, file in own.items():
            if isinstance(file, str) and file.endswith(".fits"):
                for layer in range(1, 1 + own.get("num_layers", 1)):
                    path = folder / file.format(nside=2048, layer=layer)
                    _write(path, key, own, nside, dtype)


def _write(path: Path, key: str, own: Mapping[str, Any], nside: int, dtype: Any) -> None:
    rng = np.random.default_rng(sum(path.name.encode()))
    low, high = RANGES.get(key, (1.0, 5.0))
    maps = rng.uniform(low, high, healpy.nside2npix(nside))
    maps[:2] = low, high
    alone = key not in ("map_I", "map_layers") or "map_Q" in own
    if not alone and own.get("has_polarization", True):
        maps = np.stack([maps, *rng.normal(size=(2, maps.size))])
    path.parent.mkdir(parents=True, exist_ok=True)
    unit = UNITS.get(key, "")
    healpy.write_map(path, maps, dtype=dtype, column_units=unit, overwrite=True)


@pytest.fixture(scope="module")
def uncompiled() -> Iterator[None]:
    """PySM's functions as they are before numba compiles them, which takes seconds each.

    Without numba they compute in the precision of the files.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module in (utils, models.dust, models.dust_layers, models.power_law):
            for name, value in list(vars(module).items()):
                if hasattr(value, "py_func"):
                    patch.setattr(module, name, value.py_func)
        yield
