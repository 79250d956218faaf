"""Spherical harmonics of HEALPix maps: synthesis, analysis, rotation, smoothing, resolution.

The transforms are ducc0's through jaxbind, so they can be jitted and differentiated and their
transposes are exact; healpy supplies the bookkeeping (ring weights, sizes). Coefficients are packed
as real numbers (`packing`). Q and U are one spin-2 field with coefficients E and B. Smoothing Q and
U as two scalars would be wrong by several percent.
"""

from jaxsky.harmonics.packing import (
    alm_ell,
    alm_from_healpy,
    alm_to_healpy,
    degrees,
    expand,
    lmax_of,
    map_variance,
    power_spectrum,
    resize,
)
from jaxsky.harmonics.resolution import (
    Preparation,
    average_pixels,
    children,
    low_multipoles,
    resample,
    smooth,
)
from jaxsky.harmonics.transforms import adjoint_synthesis, analysis, rotate, synthesis
from jaxsky.harmonics.windows import (
    beam_ratio,
    gaussian_beam,
    needed_lmax,
    pixel_window,
    shortened,
)
