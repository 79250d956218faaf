"""Observed maps against the model: pixels, maps, spectra and patches; `jaxsky compare`."""

from fits.comparison.compare import Comparison, check_comparison, compare
from fits.comparison.patches import PatchComparison, compare_patches
