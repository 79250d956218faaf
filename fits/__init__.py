"""Fitting tools for jaxsky skies ("fits" as in model fits, not FITS files)."""

import jaxsky.bare
