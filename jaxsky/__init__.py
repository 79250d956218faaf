"""jaxsky: a JAX-differentiable model of the polarized microwave sky."""

import jaxsky.bare
from jaxsky.bandpass import Bandpass
from jaxsky.components import AME, CMB, Component, Dust, Synchrotron
from jaxsky.sky import (
    Sky,
    get_parameters,
    observe,
    observe_band,
    observe_components,
    parameter_names,
    set_parameters,
)

__version__ = "0.1.0"

__all__ = [
    "AME",
    "CMB",
    "Bandpass",
    "Component",
    "Dust",
    "Sky",
    "Synchrotron",
    "get_parameters",
    "observe",
    "observe_band",
    "observe_components",
    "parameter_names",
    "set_parameters",
]
