"""The sky of PySM: presets, models from its settings, and emission in its units."""

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u

import jaxsky.sky
from jaxsky.bandpass import Bandpass
from jaxsky.components import Component
from jaxsky.io.files import InputError, check_file
from jaxsky.public import takes_quantities
from jaxsky.pysm.detectors import emission_in_bands
from jaxsky.pysm.emission import Part, emission_of, iqu
from jaxsky.pysm.models import MODELS, Model
from jaxsky.pysm.presets import preset_settings
from jaxsky.pysm.units import bandpass, bandpass_unit_conversion, unit_of


class Sky(Model):
    """A drop-in for `pysm3.Sky` with the laws of jaxsky.

    Maps are in double precision as PySM's, which JAX has to be told:
    `jax.config.update("jax_enable_x64", True)`. Templates come from the user's own files, see
    `jaxsky.pysm.files`; nothing is downloaded. Where a sample lies exactly at the reference
    frequency of I of a modified black body, PySM leaves Q and U as they are at their own; here
    they follow the law.

    Parameters
    ----------
    nside : resolution of the maps; that of `component_objects` if it is not given
    max_nside : for information
    preset_strings : list of presets of PySM, such as ["d1", "s1"]
    component_config : models in the format of PySM's presets, a dictionary or a TOML file
    component_objects : list of models of `jaxsky.pysm`, or anything with PySM's `get_emission`
    output_unit : a unit of brightness, or its name
    map_dist : must be None

    Raises
    ------
    TypeError, ValueError
        For settings that are not as said above, and presets that jaxsky does not have.
    InputError
        If a template is missing or no such map.

    Attributes
    ----------
    components : list of models; those of several components are a `Sky` in turn
    """

    @takes_quantities
    def __init__(
        self,
        nside: int | None = None,
        max_nside: int | None = None,
        preset_strings: list[str] | None = None,
        component_config: Mapping[str, Any] | str | Path | None = None,
        component_objects: list[Any] | None = None,
        output_unit: str | u.UnitBase = "uK_RJ",
        map_dist: None = None,
    ) -> None:
        self.components: list[Any] = [*(component_objects or [])]
        if nside is None and not self.components:
            raise TypeError("Argument `nside` is missing.")
        nside = self.components[0].nside if nside is None else nside
        for i, model in enumerate(self.components):
            if model.nside != nside:
                raise ValueError(
                    f"Entry {i} of `component_objects` has nside {model.nside}, the sky {nside}."
                )
        super().__init__(nside, max_nside, map_dist=map_dist)
        self.output_unit = unit_of(output_unit)
        if preset_strings is not None and not isinstance(preset_strings, list):
            raise TypeError(f"Argument `preset_strings` must be a list, not {preset_strings!r}.")
        settings = dict(_config(component_config))
        settings |= {name: preset_settings(name) for name in preset_strings or []}
        self.components += _models(settings, self.nside)

    def add_component(self, component: Any) -> None:
        """Add a model, with PySM's `get_emission`."""
        self.components.append(component)

    @property
    def parts(self) -> tuple[Part, ...]:
        return tuple(part for model in self._models() for part in model.parts)

    def parts_in(self, band: Bandpass) -> tuple[Part, ...]:
        return tuple(part for model in self._models() for part in model.parts_in(band))

    @property
    def is_component(self) -> bool:
        return any(True for _ in self._models())

    def _models(self) -> Iterator[Model]:
        """Yield the models that are components of jaxsky."""
        yield from (one for one in self.components if getattr(one, "is_component", False))

    @takes_quantities
    def get_emission(self, freq: u.Quantity, weights: np.ndarray | None = None) -> u.Quantity:
        """Return I, Q, U at a frequency, or over a band, in the output unit, shape (3, pix).

        A sky of dipoles alone is of I alone, (pix,), as in PySM.

        Parameters
        ----------
        freq : frequency, or the frequencies of a band, in GHz or another unit
        weights : response to unit power (Jy/sr) at each, shape (sample,), by default a top-hat

        Raises
        ------
        TypeError, ValueError
            For a frequency without a unit, and bands that `jaxsky.Bandpass` refuses.
        """
        factor = bandpass_unit_conversion(freq, weights, self.output_unit, unit_of("uK_RJ")).value
        band, total = bandpass(freq, weights), None
        if parts := self.parts_in(band):
            total = emission_of(parts, band, factor) << self.output_unit
        for model in self._others():
            own = _as_IQU(model.get_emission(freq, weights).value) * factor << self.output_unit
            total = own if total is None else total + own
        if total is None:
            raise ValueError("The sky has no component.")
        return total[0] if self.only_I else total

    @takes_quantities
    def get_emissions(
        self,
        freqs: Sequence[u.Quantity],
        weights: Sequence[np.ndarray | None] | None = None,
        at_once: int = 16,
    ) -> Iterator[u.Quantity]:
        """Yield what `get_emission` returns in each of many bands, such as those of all detectors.

        Each costs a few multiplications per pixel, however many samples it has. PySM has no such
        function.

        Parameters
        ----------
        freqs : frequencies of each band
        weights : response of each at these, see `get_emission`
        at_once : number of bands whose maps are computed at once; memory grows with it

        Raises
        ------
        TypeError, ValueError
            As for `get_emission`, and where the numbers of frequencies and of weights differ.
        """
        given = [None] * len(freqs) if weights is None else weights
        if len(given) != len(freqs):
            raise ValueError(
                f"Argument `weights` must have an entry for each of the {len(freqs)} bands, but "
                f"has {len(given)}."
            )
        if not self.components:
            raise ValueError("The sky has no component.")
        pairs = list(zip(freqs, given, strict=True))
        to, unit = self.output_unit, unit_of("uK_RJ")
        factors = np.array([bandpass_unit_conversion(*own, to, unit).value for own in pairs])
        models = [*self._flat()]
        many = [one for one in models if isinstance(one, Model) and one.same_parts]
        parts = [part for model in many for part in model.parts]
        bands = [bandpass(*own) for own in pairs]
        others = [one for one in models if one not in many]
        found = emission_in_bands(parts, bands, factors, at_once)
        for own, factor, maps in zip(pairs, factors, found, strict=True):
            total = maps
            for model in others:
                total = total + _as_IQU(model.get_emission(*own).value) * factor
            yield (total[0] if self.only_I else total) << to

    def _flat(self) -> Iterator[Any]:
        """Yield the models, those of skies among them one by one."""
        for model in self.components:
            yield from model._flat() if isinstance(model, Sky) else (model,)

    @property
    def only_I(self) -> bool:
        return bool(self.components) and all(
            getattr(model, "only_I", False) for model in self.components
        )

    def _others(self) -> Iterator[Any]:
        """Yield the models that are no components of jaxsky."""
        for model in self.components:
            if isinstance(model, Sky):
                yield from model._others()
            elif not getattr(model, "is_component", False):
                yield model

    def sky(self) -> jaxsky.sky.Sky:
        """Return the components as a `jaxsky.Sky` of I, Q, U [uK_RJ], to be differentiated.

        Names are those of the presets or settings, or of the classes of objects, with that of a
        part after "_" where there are several ("d4_comp1", "d12_3", "s3_I"). ValueError if there
        is a model that is not of jaxsky.
        """
        for model in self._others():
            raise ValueError(f"{type(model).__name__} is no component of jaxsky.")
        return jaxsky.sky.Sky(dict(self._named_components()))

    def _named_components(self) -> Iterator[tuple[str, Component]]:
        names = [model.name or type(model).__name__ for model in self.components]
        for i, (name, model) in enumerate(zip(names, self.components, strict=True)):
            name = f"{name}_{i + 1}" if names.count(name) > 1 else name
            if isinstance(model, Sky):
                yield from ((f"{name}_{own}", one) for own, one in model._named_components())
                continue
            for part in model.parts:
                one = part.component
                if len(one.amplitude) < 3:
                    one = dataclasses.replace(one, amplitude=iqu(one.amplitude))
                yield f"{name}_{part.name}" if part.name else name, one


def _as_IQU(maps: np.ndarray) -> np.ndarray:
    """Return maps as I, Q, U where they are a map of I alone."""
    return np.stack([maps, 0 * maps, 0 * maps]) if maps.ndim == 1 else maps


def _config(given: Mapping[str, Any] | str | Path | None) -> Mapping[str, Any]:
    """Return models as a dictionary, read from a file where one is named."""
    if given is None or isinstance(given, Mapping):
        return given or {}
    check_file(Path(given))
    try:
        return tomllib.loads(Path(given).read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{given}: no TOML file ({error}).") from None


def _models(settings: Mapping[str, Any], nside: int) -> Iterator[Any]:
    """Make the models of settings in PySM's format."""
    if "class" in settings:
        settings = {"": settings}
    for name, own in settings.items():
        if not isinstance(own, Mapping):
            raise TypeError(f"Settings of {name!r} must be a table with a class, not {own!r}.")
        if "class" in own:
            model = _model(name, own, nside)
        else:
            model = Sky(nside, component_objects=[*_models(own, nside)])
        model.name = name
        yield model


def _model(name: str, own: Mapping[str, Any], nside: int) -> Model:
    """Make one model of the class that its settings name."""
    arguments = {key: value for key, value in own.items() if key != "class"}
    kind = MODELS.get(own["class"])
    if kind is None:
        known = ", ".join(sorted(MODELS))
        raise ValueError(f"Model {name!r}: there is no class {own['class']!r}; known are {known}.")
    try:
        return kind(nside=nside, **arguments)
    except (TypeError, ValueError) as error:
        error.add_note(f"in the settings of {name!r}")
        raise


def get_pysm_emission(preset_string: str, nside: int) -> list[Any]:
    """Return the models of one preset, as PySM's function."""
    return [*_models({preset_string: preset_settings(preset_string)}, nside)]
