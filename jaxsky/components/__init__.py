"""Components of the sky, one class each: template maps times a spectral law.

The fields of a component are its parameters. Each spectral parameter is a number or a map of shape
(pix,). The law is written once, for one frequency, in `sed`; everything else (band averages,
gradients, parameter names, keys of settings, symbols in figures) follows from the fields. All
modules in this folder are imported automatically, so a new one needs no registration.
"""

import importlib
import pkgutil

from jaxsky.components.base import (
    Component,
    check_law,
    check_value,
    component_class,
    declared,
    parameter,
    parameter_declaration,
    reference,
    table,
    template,
)
from jaxsky.components.interpolated import InterpolatedMap, interpolated_maps
from jaxsky.components.laws import (
    AME,
    CMB,
    Dust,
    FreeFree,
    KinematicQuadrupole,
    LineEmission,
    Synchrotron,
    ThermalSZ,
    amplitude_from_compton,
    amplitude_from_emission_measure,
    amplitude_from_line_intensity,
)
from jaxsky.components.tabulated import HensleyDraine, SpinningDust

for _module in pkgutil.iter_modules(__path__):
    _found = importlib.import_module(f"{__name__}.{_module.name}")
    for _name, _value in vars(_found).items():
        if _name[0] != "_" and getattr(_value, "__module__", "") == _found.__name__:
            globals()[_name] = _value
