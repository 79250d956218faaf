"""A plugin of pytest that puts `jaxsky.pysm` in the place of PySM."""

import sys

import jax

from jaxsky import pysm
from jaxsky.pysm import cmb, units


def pytest_configure() -> None:
    """Replace PySM before tests are imported; only where this is loaded as a plugin."""
    jax.config.update("jax_enable_x64", True)
    pysm.models = pysm
    places = {"": pysm, ".units": units, ".models": pysm, ".models.dipole": cmb}
    sys.modules.update({f"pysm3{place}": module for place, module in places.items()})
