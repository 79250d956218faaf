"""Spherical harmonics of HEALPix maps: synthesis, analysis, smoothing, resolution.

The transforms are those of ducc0, called through jaxbind, so they can be jitted and differentiated
and have exact transposes; healpy supplies the bookkeeping (ring weights, sizes). Coefficients are
packed as real numbers (`transforms`). Q and U are one spin-2 field with coefficients E and B:
smoothing them as two scalars would be wrong by several percent.
"""

from jaxsky.harmonics.resolution import (
    Preparation,
    average_pixels,
    beam_ratio,
    children,
    gaussian_beam,
    low_multipoles,
    needed_lmax,
    pixel_window,
    resample,
    shortened,
    smooth,
)
from jaxsky.harmonics.transforms import (
    adjoint_synthesis,
    alm_ell,
    alm_from_healpy,
    alm_to_healpy,
    analysis,
    degrees,
    expand,
    lmax_of,
    map_variance,
    power_spectrum,
    resize,
    synthesis,
)
