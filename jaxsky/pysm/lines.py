"""Lines of carbon monoxide, which a band sees by its weight at their frequencies."""

from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from jaxsky.components import LineEmission
from jaxsky.io.quantities import unit_factor
from jaxsky.pysm.files import read_map
from jaxsky.pysm.models import LawModel
from jaxsky.pysm.units import T_CMB

#: Rest frequencies [GHz], in the order of the columns of the maps.
LINES: Final = {"10": 115.271, "21": 230.538, "32": 345.796}


class COLines(LawModel):
    """Lines of CO from Planck's maps, polarized along the dust or not: a `LineEmission` each.

    Arguments are those of PySM: `lines` of "10", "21", "32", `has_polarization`,
    `polarization_fraction`, and `include_high_galactic_latitude_clouds`, which adds clouds of a
    simulation from a file. A band that holds a line sees it, so a single frequency sees none.
    """

    law = "line"

    def _components(self, arguments: dict[str, Any]) -> Any:
        lines = arguments.pop("lines", [*LINES])
        polarized = arguments.pop("has_polarization", True)
        fraction = arguments.pop("polarization_fraction", 0.001)
        clouds = arguments.pop("include_high_galactic_latitude_clouds", False)
        self._no_more(arguments)
        columns = [[*LINES].index(line) for line in lines]
        maps = self._read("HFI_CompMap_CO-Type1_{}_R2.00_ring", columns)
        if clouds:
            maps = maps + self._read("mcmoleCO_HGL_{}", columns)
        rows = np.ones((1, maps.shape[-1]))
        if polarized:
            angle, depolarization = (
                self._read(f"{name}_dust90_{{}}", [0])[0] for name in ("psimap", "gmap")
            )
            along = np.stack([np.cos(2 * angle), np.sin(2 * angle)])
            rows = np.concatenate([rows, fraction * depolarization * along])
        for line, one in zip(lines, maps, strict=True):
            factor = unit_factor("K_CMB", "uK_RJ", LINES[line], T_cmb=T_CMB)
            yield line, LineEmission(jnp.asarray(factor * one * rows), LINES[line])

    def _read(self, name: str, columns: list[int]) -> np.ndarray:
        """Read columns of a file in K_CMB, shape (column, pix), of nside 512 or 2048."""
        path = f"co/{name.format(512 if self.nside <= 512 else 2048)}.fits"
        return np.atleast_2d(read_map(path, self.nside, "K_CMB", columns)[0]).astype(np.float64)
