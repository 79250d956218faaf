"""A plugin of pytest that puts `jaxsky.pysm` in the place of PySM."""

import sys

import jax

from jaxsky import pysm
from jaxsky.pysm import cmb, units

jax.config.update("jax_enable_x64", True)
pysm.models = pysm
PLACES = {"": pysm, ".units": units, ".models": pysm, ".models.dipole": cmb}
sys.modules.update({f"pysm3{place}": module for place, module in PLACES.items()})
