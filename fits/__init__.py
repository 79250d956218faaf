"""Fitting tools for jaxsky skies ("fits" as in model fits, not FITS files)."""

import jaxsky.bare  # noqa: F401  (before all else: it guards what is imported after it)
