"""Observed maps against the model: pixels, maps, spectra and patches; `jaxsky compare`."""

from fits.comparison.compare import Comparison, compare
from fits.comparison.patches import PatchComparison, compare_patches

__all__ = ["Comparison", "PatchComparison", "compare", "compare_patches"]
