"""jaxsky: a JAX-differentiable model of the polarized microwave sky.

Users import everything they need from here (`__all__`). Each name is loaded on first use, so that
`import jaxsky` is quick.
"""

from typing import TYPE_CHECKING

from jaxsky.public import exported  # before all else

if TYPE_CHECKING:
    from jaxsky.bandpass import Bandpass
    from jaxsky.cmb import camb_spectra
    from jaxsky.components import (
        AME,
        CMB,
        Component,
        Dust,
        FreeFree,
        Synchrotron,
        moments,
    )
    from jaxsky.galaxy import embedded_sky
    from jaxsky.harmonics import smooth
    from jaxsky.io import read_bandpass, read_beam, read_maps, read_mask, read_spectra, write_maps
    from jaxsky.observation import Instrument, Observation, ObservedBand, Source, load_instrument
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

__all__, __getattr__, __dir__ = exported(__name__)
