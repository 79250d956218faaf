"""Models of PySM that interpolate between maps at many frequencies: extragalactic sources."""

import warnings
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Final

import healpy
import jax.numpy as jnp
import numpy as np
from astropy import units as u
from astropy.io import fits as pyfits

from jaxsky.bandpass import Bandpass
from jaxsky.checks import check_choice
from jaxsky.components import InterpolatedMap
from jaxsky.io.files import InputError
from jaxsky.io.quantities import unit_factor
from jaxsky.public import takes_quantities
from jaxsky.pysm.emission import Part, emission_of
from jaxsky.pysm.files import find_template, read_map
from jaxsky.pysm.models import LawModel
from jaxsky.pysm.smoothing import apply_smoothing_and_coord_transform
from jaxsky.pysm.units import T_CMB, bandpass, unit_of

#: Frequencies of the maps of WebSky [GHz].
WEBSKY: Final = (
    *(17.0, 18.7, 21.6, 24.5, 27.3, 30.0, 35.9, 41.7, 44.0, 47.4, 63.9, 67.8, 70.0, 73.7, 79.6),
    *(90.2, 100.0, 111.0, 129.0, 143.0, 153.0, 164.0, 189.0, 210.0, 217.0, 232.0, 256.0, 275.0),
    *(294.0, 306.0, 314.0, 340.0, 353.0, 375.0, 409.0, 467.0, 525.0, 545.0, 584.0, 643.0, 729.0),
    *(817.0, 857.0, 906.0, 994.0, 1080.0),
)


class InterpolatingComponent(LawModel):
    """Maps at several frequencies, linear between them: an `InterpolatedMap` for each of them.

    Antenna temperature is interpolated. Only the maps that a band needs are read, once, and are
    kept in single precision, as PySM keeps them. A single frequency within 1e-5 of that of a map
    gives this map, and a band that reaches beyond the first or the last one gives zero with a
    warning, as in PySM. The components of `Sky.sky` are all maps.

    Arguments are those of PySM: `path`, a folder of PySM's data with maps at `freqs` [GHz] (which
    are named "001.0.fits", "143.0.fits", ...) or, without these, a folder of the user with maps
    named by their frequency; `input_units` of the maps; `pre_applied_beam`, the width of the beam
    that maps of each nside have, and `pre_applied_beam_units`; `interpolation_kind` is "linear".
    """

    law = "interpolated"
    order: ClassVar[tuple[str, ...]] = (
        *("path", "input_units", "nside", "max_nside", "interpolation_kind"),
    )

    def _components(self, arguments: dict[str, Any]) -> Any:
        kind = arguments.pop("interpolation_kind", "linear")
        check_choice("interpolation_kind", kind, ("linear",))
        self.input_units = str(self._taken("input_units", arguments))
        self.pre_applied_beam = arguments.pop("pre_applied_beam", None)
        self.pre_applied_beam_units = arguments.pop("pre_applied_beam_units", None)
        self.maps = dict(sorted(self._files(arguments).items()))
        self.freqs = np.array([*self.maps])
        self._between: dict[float, Part] = {}
        self._alone: dict[float, Part] = {}
        self._no_more(arguments)
        return ()

    def _files(self, arguments: dict[str, Any]) -> dict[float, Any]:
        """Return the files of maps by their frequencies [GHz]."""
        path, freqs = str(self._taken("path", arguments)), arguments.pop("freqs", None)
        if freqs is not None:
            return {float(nu): f"{self._named(path)}/{nu:05.1f}.fits" for nu in freqs}
        try:
            found = {float(file.stem): file for file in Path(path).glob("*.fits")}
        except ValueError as error:
            raise InputError(f"{path}: a map is not named by its frequency ({error}).") from None
        if not found:
            raise InputError(f"{path}: no folder with maps named by their frequencies.")
        return found

    @cached_property
    def beam(self) -> u.Quantity:
        """Width of the beam that the maps have, 0 if they have none."""
        widths = self.pre_applied_beam
        if widths is None:
            return 0 * u.arcmin
        known = {str(nside): width for nside, width in widths.items()}
        for nside in (str(self.templates_nside), str(self.nside)):
            if nside in known:
                return known[nside] * u.Unit(self.pre_applied_beam_units)
        raise ValueError(f"Argument `pre_applied_beam` has no width for nside {self.nside}.")

    def _read(self, nu: float) -> np.ndarray:
        """Return the map at one of the frequencies [uK_RJ], shape (stokes, pix)."""
        path = find_template(self.maps[nu])
        columns = pyfits.getheader(path, 1).get("TFIELDS", 1)
        field: list[int] = [0, 1, 2] if columns >= 3 else [0]
        maps = np.atleast_2d(read_map(path, self.nside, self.input_units, field)[0])
        factor = unit_factor(self.input_units, "uK_RJ", nu, T_cmb=T_CMB)
        return maps if factor == 1 else maps * np.float64(factor)

    def _single(self, nu: float, at: float) -> Part:
        """Return the map at one of the frequencies as a component that is 1 at another one."""
        if at not in self._alone:
            self._alone[at] = Part(InterpolatedMap(jnp.asarray(self._read(nu), float), nu_ref=at))
        return self._alone[at]

    def _part(self, nu: float) -> Part:
        """Return the map at one of the frequencies as a component, to interpolate; read once."""
        if nu not in self._between:
            place = int(np.searchsorted(self.freqs, nu))
            below, above = ([None, *self.freqs, None][i] for i in (place, place + 2))
            maps = jnp.asarray(self._read(nu).astype(np.float32), float)
            self._between[nu] = Part(InterpolatedMap(maps, below, above, nu), str(place))
        return self._between[nu]

    @property
    def parts(self) -> tuple[Part, ...]:
        return tuple(self._part(float(nu)) for nu in self.freqs)

    @property
    def same_parts(self) -> bool:
        return False

    def parts_in(self, band: Bandpass) -> tuple[Part, ...]:
        nu = np.asarray(band.nu)
        near = self.freqs[np.isclose(self.freqs, nu[0])]
        if nu.size == 1 and near.size:
            return (self._single(float(near[0]), float(nu[0])),)
        if nu[0] < self.freqs[0] or nu[-1] > self.freqs[-1]:
            warnings.warn(
                f"{type(self).__name__} has maps from {self.freqs[0]:g} to {self.freqs[-1]:g} GHz, "
                f"so that it is zero in a band from {nu[0]:g} to {nu[-1]:g} GHz.",
                stacklevel=2,
            )
            return (Part(InterpolatedMap(jnp.zeros((1, 12 * self.nside**2)), nu_ref=nu[0])),)
        first = np.searchsorted(self.freqs, nu[0], "right") - 1
        last = np.searchsorted(self.freqs, nu[-1])
        return tuple(self._part(float(own)) for own in self.freqs[first : last + 1])

    @takes_quantities
    def get_emission(
        self,
        freqs: u.Quantity,
        weights: np.ndarray | None = None,
        fwhm: u.Quantity | None = None,
        output_nside: int | None = None,
        coord: tuple[str, str] | None = None,
        lmax: int | None = None,
    ) -> u.Quantity:
        """Return I, Q, U [uK_RJ] at a frequency or over a band, by default with the maps' own beam.

        Parameters
        ----------
        freqs, weights : as of any model
        fwhm : beam of the result, instead of that of the maps
        coord : rotation of coordinates, such as ("G", "C")
        lmax, output_nside : highest multipole of the transform, which smoothing and rotation need,
            and resolution of its result

        Raises
        ------
        ValueError
            If `lmax` is missing where it is needed.
        """
        band = bandpass(freqs, weights)
        maps = emission_of(self.parts_in(band), band, 1.0) << unit_of("uK_RJ")
        if fwhm in (None, self.beam) and coord is None:
            return maps
        if lmax is None:
            raise ValueError("Argument `lmax` is missing: it is needed to smooth or to rotate.")
        window = None
        if fwhm is not None:
            widths = [width.to_value(u.rad) for width in (fwhm, self.beam)]
            new, old = (healpy.gauss_beam(width, lmax, pol=True)[:, :3].T for width in widths)
            window = new / old
        rot = None if coord is None else healpy.Rotator(coord=coord)
        return apply_smoothing_and_coord_transform(
            maps, beam_window=window, rot=rot, lmax=lmax, output_nside=output_nside
        )


class WebSkyCIB(InterpolatingComponent):
    """The cosmic infrared background of WebSky: maps at 46 frequencies from 17 to 1080 GHz.

    Arguments: `websky_version`, `input_units`, `apply_SPT_correction` (whether maps are scaled to
    the power that the South Pole Telescope finds), `local_folder` with the folder of WebSky.
    """

    folder: ClassVar[str] = "cib"
    corrected: ClassVar[bool] = True
    order: ClassVar = (
        *("nside", "websky_version", "input_units", "max_nside", "interpolation_kind"),
        *("apply_SPT_correction", "local_folder"),
    )
    defaults: ClassVar[Mapping[str, str]] = {"input_units": "MJy / sr"}

    def _components(self, arguments):
        self.apply_SPT_correction = arguments.pop("apply_SPT_correction", self.corrected)
        return super()._components(dict(self.defaults) | arguments)

    def _files(self, arguments):
        version, local = arguments.pop("websky_version", "0.4"), arguments.pop("local_folder", None)
        path = f"websky/{version}/{self.folder}/{self.folder}_"
        path = path if local is None else f"{local}/{path}"
        return {nu: f"{path}{nu:06.1f}.fits" for nu in WEBSKY}

    def _read(self, nu):
        maps = super()._read(nu)
        # PySM's fit to the ratio of powers: 1.84 at low frequencies, 1 at high ones.
        power = 1 + (1.84 - 1) / (1 + np.exp((nu - 227) / 75))
        return maps * maps.dtype.type(np.sqrt(power)) if self.apply_SPT_correction else maps


class WebSkyRadioGalaxies(WebSkyCIB):
    """The radio galaxies of WebSky, at the same frequencies; arguments as of `WebSkyCIB`."""

    folder = "radio"
    corrected = False
    defaults: ClassVar[Mapping[str, str]] = {"input_units": "Jy / sr"}
