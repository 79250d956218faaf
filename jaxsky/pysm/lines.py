"""Lines of carbon monoxide, which a band sees by its weight at their frequencies."""

from typing import Any, Final

import healpy
import numpy as np
from astropy import units as u

from jaxsky.io.quantities import unit_factor
from jaxsky.public import takes_quantities
from jaxsky.pysm.files import read_map
from jaxsky.pysm.models import MODELS, Model
from jaxsky.pysm.units import T_CMB, bandpass, unit_of

#: Rest frequencies [GHz], in the order of the columns of the maps.
LINES: Final = {"10": 115.271, "21": 230.538, "32": 345.796}


class COLines(Model):
    """Lines of CO from Planck's maps, polarized along the dust by a fraction, or not.

    Arguments are those of PySM: `lines` of "10", "21", "32", `has_polarization`,
    `polarization_fraction`, and `include_high_galactic_latitude_clouds`, which adds clouds of a
    simulation from a file. A line counts in bands that hold it, so a single frequency sees none. It
    is no `Component` of jaxsky, as a line has no antenna temperature at one frequency.
    """

    @takes_quantities
    def __init__(
        self,
        nside: int,
        max_nside: int | None = None,
        has_polarization: bool = True,
        lines: list[str] | None = None,
        include_high_galactic_latitude_clouds: bool = False,
        polarization_fraction: float = 0.001,
        run_mcmole3d: bool = False,
        map_dist: None = None,
        **unused: Any,
    ) -> None:
        super().__init__(nside, max_nside, map_dist=map_dist)
        if run_mcmole3d:
            raise ValueError("Argument `run_mcmole3d` must be False: its clouds come from a file.")
        self.lines = list(LINES) if lines is None else lines
        self.template_nside = 512 if self.nside <= 512 else 2048
        maps = self._read("HFI_CompMap_CO-Type1_{}_R2.00_ring")
        if include_high_galactic_latitude_clouds:
            maps = maps + self._read("mcmoleCO_HGL_{}")
        self.maps = dict(zip(self.lines, maps, strict=True))
        self.fractions = np.array([[1.0], [0.0], [0.0]])
        if has_polarization:
            angle, depolarization = (
                self._read(f"{name}_dust90_{{}}", [0])[0] for name in ("psimap", "gmap")
            )
            along = [np.cos(2 * angle), np.sin(2 * angle)]
            polarized = polarization_fraction * depolarization * along
            self.fractions = np.concatenate([np.ones((1, angle.size)), polarized])

    def _read(self, name: str, fields: list[int] | None = None) -> np.ndarray:
        """Read columns of a file, by default those of the lines, shape (field, pix)."""
        fields = [list(LINES).index(line) for line in self.lines] if fields is None else fields
        path = f"co/{name.format(self.template_nside)}.fits"
        return np.atleast_2d(read_map(path, self.nside, "K_CMB", fields)[0]).astype(np.float64)

    @takes_quantities
    def get_emission(self, freqs: u.Quantity, weights: np.ndarray | None = None) -> u.Quantity:
        """Return I, Q, U [uK_RJ] over a band with weights in power units; zero at one frequency."""
        band = bandpass(freqs, weights)
        nu, response = np.asarray(band.nu), np.asarray(band.weights * band.nu**2)
        density = response / np.trapezoid(response, nu) if nu.size > 1 else np.ones(1)
        total = np.zeros((3, healpy.nside2npix(self.nside)))
        for line, maps in self.maps.items():
            if nu[0] <= LINES[line] <= nu[-1]:
                factor = unit_factor("K_CMB", "uK_RJ", LINES[line], T_cmb=T_CMB)
                total += factor * np.interp(LINES[line], nu, density) * maps * self.fractions
        return total << unit_of("uK_RJ")


MODELS["COLines"] = COLines
