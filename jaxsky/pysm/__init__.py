"""A drop-in for `pysm3.Sky`: PySM's presets, settings and units on jaxsky's laws, with gradients.

`Sky(nside, preset_strings=["d1", "s1"]).get_emission(100 * u.GHz)` gives what PySM gives, from
templates that the user has, and `.sky()` the `jaxsky.Sky` behind it. PySM itself is not needed.
"""

from jaxsky.pysm.cmb import CMBDipole, CMBMap, SimpleSZ, WebSkyCMB
from jaxsky.pysm.decorrelated import DecorrelatedModifiedBlackBody
from jaxsky.pysm.interpolated import InterpolatingComponent, WebSkyCIB, WebSkyRadioGalaxies
from jaxsky.pysm.lines import COLines
from jaxsky.pysm.models import (
    CurvedPowerLaw,
    Model,
    ModifiedBlackBody,
    ModifiedBlackBodyLayers,
    PowerLaw,
)
from jaxsky.pysm.realisations import ModifiedBlackBodyRealization, PowerLawRealization
from jaxsky.pysm.sky import Sky, get_pysm_emission
from jaxsky.pysm.smoothing import apply_smoothing_and_coord_transform
from jaxsky.pysm.tabulated import HensleyDraine2017, SpDust, SpDustPol
from jaxsky.pysm.units import bandpass_unit_conversion
