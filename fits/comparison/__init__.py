"""Observed maps against the model: pixels, maps, spectra and patches; `jaxsky compare`."""

from fits.comparison.compare import Comparison, compare

__all__ = ["Comparison", "compare"]
