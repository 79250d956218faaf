"""jaxsky: a JAX-differentiable model of the polarized microwave sky.

What users need is imported from here (`__all__`); each name when it is first asked for, so that
`import jaxsky` is quick.
"""

import importlib
from typing import TYPE_CHECKING

import jaxsky.bare

if TYPE_CHECKING:
    from jaxsky.archive import fetch
    from jaxsky.bandpass import Bandpass
    from jaxsky.cmb import camb_spectra
    from jaxsky.components import AME, CMB, Component, Dust, FreeFree, Synchrotron
    from jaxsky.galaxy import embedded_sky
    from jaxsky.harmonics import smooth
    from jaxsky.instrument import load_instrument
    from jaxsky.io import (
        from_quantity,
        read_bandpass,
        read_beam,
        read_maps,
        read_mask,
        read_spectra,
        unit_factor,
        write_maps,
    )
    from jaxsky.observation import Observation, ObservedBand, Source
    from jaxsky.simulation import simulate
    from jaxsky.sky import (
        Sky,
        get_parameters,
        observe,
        observe_band,
        observe_components,
        parameter_names,
        set_parameters,
    )
    from jaxsky.small_scales import SmallScales
    from jaxsky.templates import preset

__version__ = "0.1.0"

_NAMES = {
    "archive": "fetch",
    "bandpass": "Bandpass",
    "cmb": "camb_spectra",
    "components": "AME CMB Component Dust FreeFree Synchrotron",
    "galaxy": "embedded_sky",
    "harmonics": "smooth",
    "instrument": "load_instrument",
    "io": "from_quantity read_bandpass read_beam read_maps read_mask read_spectra unit_factor "
    "write_maps",
    "observation": "Observation ObservedBand Source",
    "simulation": "simulate",
    "sky": "Sky get_parameters observe observe_band observe_components parameter_names "
    "set_parameters",
    "small_scales": "SmallScales",
    "templates": "preset",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"jaxsky.{_MODULES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
