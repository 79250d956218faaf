"""Dust and synchrotron of PySM whose small scales are drawn: models d11 and s6.

Templates and small scales are logarithms of the polarization tensor: i, q, u with
I = exp(i) cosh(p), (Q, U) = (q, u)/p exp(i) sinh(p) and p^2 = q^2 + u^2 (PySM's documentation).
Small scales are Gaussian, of given spectra, times a map that makes them larger where the emission
is bright. With the same seeds the numbers are PySM's own, as they are numpy's.
"""

from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import healpy
import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits

from jaxsky.components import Component, Dust, Synchrotron
from jaxsky.io.files import InputError
from jaxsky.io.quantities import unit_factor
from jaxsky.pysm.files import find_template, given_frequency, read_map
from jaxsky.pysm.models import ModifiedBlackBody, PowerLaw
from jaxsky.pysm.units import T_CMB

#: Spellings of the unit of spectra.
SQUARED = ("uK_RJ2", "uK_RJ**2", "uK_RJ^2", "uK_RJ^{2}")


def _unit(path: Any) -> str:
    return str(pyfits.getheader(path, 1).get("TUNIT1", ""))


class _Drawn:
    """What both models do: read coefficients and spectra, draw, modulate and add."""

    nside: int
    lmax: int

    def _alm(self, name: str, rows: bool = False, nu: float | None = None) -> np.ndarray:
        """Return the map of coefficients in a file; with a frequency in uK_RJ from its unit."""
        path = find_template(name)
        try:
            alm = np.asarray(healpy.read_alm(path, hdu=(1, 2, 3) if rows else 1), complex)
        except (OSError, ValueError, IndexError, KeyError, TypeError) as error:
            raise InputError(f"{path}: no harmonic coefficients ({error}).") from None
        factor = 1.0 if nu is None else unit_factor(_unit(path), "uK_RJ", nu, T_cmb=T_CMB)
        return np.asarray(healpy.alm2map(alm * factor, self.nside))

    def _small(self, name: str, seed: int | None, cut: int) -> np.ndarray:
        """Draw a map from the spectra of a file, with multipoles below `cut`."""
        path = find_template(name)
        try:
            cl = np.asarray(healpy.read_cl(path))
        except (OSError, ValueError, IndexError, KeyError, TypeError) as error:
            raise InputError(f"{path}: no power spectra ({error}).") from None
        if cl.ndim > 1 and _unit(path) not in SQUARED:
            raise InputError(f"{path}: spectra must be in uK_RJ^2, not {_unit(path)!r}.")
        before = np.random.get_state()  # noqa: NPY002 - healpy draws from it, seeded as PySM's
        try:
            np.random.seed(seed)  # noqa: NPY002
            alm = healpy.synalm(list(cl) if cl.ndim > 1 else cl, lmax=self.lmax, new=True)
        finally:
            np.random.set_state(before)  # noqa: NPY002 - the user's numbers go on as before
        rows = [healpy.almxfl(row, np.ones(cut)) for row in np.atleast_2d(alm)]
        return np.asarray(healpy.alm2map(rows if cl.ndim > 1 else rows[0], self.nside))

    def _fix(self, name: str | None, nu: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the mask of what is drawn and the I, Q, U [uK_RJ] of the plane, which is not."""
        if name is None:
            return None
        maps, stated = read_map(name, self.nside, None, [0, 1, 2, 3])
        factor = unit_factor(stated, "uK_RJ", nu, T_cmb=T_CMB)
        return maps[3], maps[:3] * (1 - maps[3]) * factor

    def _template(
        self, arguments: dict[str, Any], nu: float, seed: int | None, modulation: Any, cut: int
    ) -> np.ndarray:
        """Return I, Q, U [uK_RJ] before the Galactic plane is put in."""
        small = self._small(arguments.pop("small_scale_cl"), seed, cut)
        small[0] *= modulation
        small[1:] *= self._alm(arguments.pop("amplitude_modulation_pol_alm"))
        return _from_tensor(small + self._alm(arguments.pop("largescale_alm"), True, nu))


def _from_tensor(maps: np.ndarray) -> np.ndarray:
    """Return I, Q, U of the logarithm of the polarization tensor."""
    p = np.hypot(maps[1], maps[2])
    along = np.divide(np.sinh(p), p, out=np.ones_like(p), where=p > 0)
    return np.exp(maps[0]) * np.stack([np.cosh(p), maps[1] * along, maps[2] * along])


class ModifiedBlackBodyRealization(_Drawn, ModifiedBlackBody):
    """Thermal dust with small scales drawn in amplitude, index and temperature: `Dust`.

    Arguments are those of PySM, names of files: `largescale_alm`, `small_scale_cl` and the same
    with "_mbb_index" and "_mbb_temperature"; `amplitude_modulation_temp_alm` and `_pol_alm`;
    `galplane_fix` and `galplane_fix_beta_Td`, maps of the plane; and `freq_ref`, `seeds` (three
    numbers, without them another sky each time) and `synalm_lmax`.
    """

    order: ClassVar = ("largescale_alm", "freq_ref")

    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        nu = given_frequency("freq_ref", self._taken("freq_ref", arguments))
        seeds, self.lmax = _choices(arguments, self.nside, 3)
        cut = int(min(self.lmax, 2.5 * self.nside))
        modulation = self._alm(self._taken("amplitude_modulation_temp_alm", arguments))
        fix = self._fix(arguments.pop("galplane_fix", None), nu)
        plane = arguments.pop("galplane_fix_beta_Td", None)
        maps = self._template(_required(self, arguments), nu, seeds[0], modulation, cut)
        maps = maps if fix is None else maps * fix[0] + fix[1]
        found: dict[str, Any] = {}
        for column, (theirs, ours) in enumerate(self.words.items()):
            end, seed = theirs.removeprefix("map"), seeds[1 + column]
            own = self._small(self._taken(f"small_scale_cl{end}", arguments), seed, cut + 1)
            own = own * modulation + self._alm(self._taken(f"largescale_alm{end}", arguments))
            if fix is not None:
                if plane is None:
                    raise TypeError("With `galplane_fix`, `galplane_fix_beta_Td` is needed.")
                values, _ = read_map(plane, self.nside, "", column)
                own = own * fix[0] + values * (1 - fix[0])
            found[ours] = own
        self._no_more(arguments)
        # The factor of PySM's d9 to d11, which corrects for the colour of the band.
        yield "", Dust(jnp.asarray(0.911 * maps), **found, nu_ref=nu)


class PowerLawRealization(_Drawn, PowerLaw):
    """Synchrotron with small scales drawn in amplitude and index: `Synchrotron`.

    Arguments are those of PySM, names of files: `largescale_alm`, `small_scale_cl` and the same
    with "_pl_index", of which files have index + 3.1; `amplitude_modulation_temp_alm`, `_pol_alm`
    and, for the index, `_beta_alm`; `galplane_fix`; and `freq_ref`, `seeds` (two numbers, without
    them another sky each time) and `synalm_lmax`.
    """

    order: ClassVar = ("largescale_alm", "freq_ref")

    def _components(self, arguments: dict[str, Any]) -> Iterable[tuple[str, Component]]:
        nu = given_frequency("freq_ref", self._taken("freq_ref", arguments))
        seeds, self.lmax = _choices(arguments, self.nside, 2)
        cut = int(min(self.lmax, 2.5 * self.nside)) + 1
        modulation = self._alm(self._taken("amplitude_modulation_temp_alm", arguments))
        fix = self._fix(arguments.pop("galplane_fix", None), nu)
        maps = self._template(_required(self, arguments), nu, seeds[0], modulation, cut)
        maps = maps if fix is None else maps * fix[0] + fix[1]
        if (beta := arguments.pop("amplitude_modulation_beta_alm", None)) is not None:
            modulation = self._alm(beta)
        index = self._small(self._taken("small_scale_cl_pl_index", arguments), seeds[1], cut)
        index = index * modulation + self._alm(self._taken("largescale_alm_pl_index", arguments))
        self._no_more(arguments)
        yield "", Synchrotron(jnp.asarray(maps), beta_syn=3.1 - index, nu_ref=nu)


def _required(model: Any, arguments: dict[str, Any]) -> dict[str, Any]:
    """Take the files of the templates out of the arguments; TypeError if one is missing."""
    names = ("small_scale_cl", "amplitude_modulation_pol_alm", "largescale_alm")
    return {name: model._taken(name, arguments) for name in names}


def _choices(
    arguments: dict[str, Any], nside: int, number: int
) -> tuple[Sequence[int | None], int]:
    """Take seeds and the highest multipole that is drawn out of the arguments."""
    seeds, lmax = arguments.pop("seeds", None), arguments.pop("synalm_lmax", None)
    seeds = [None] * number if seeds is None else seeds
    if len(seeds) != number:
        raise ValueError(f"Argument `seeds` must have {number} numbers, not {seeds!r}.")
    return seeds, int(min(16384, 2.5 * nside)) if lmax is None else int(lmax)
