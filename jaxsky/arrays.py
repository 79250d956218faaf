"""Names of the arrays that the package passes on, by what they hold.

Maps are in HEALPix RING order. Coefficients are packed, see `jaxsky.harmonics`.
"""

from typing import Final, TypeAlias

from jaxtyping import Array, Float

#: Stokes parameters of maps by the number of their rows.
STOKES: Final = {1: "I", 2: "QU", 3: "IQU"}


def stokes_rows(wanted: str, given: str = "IQU") -> slice:
    """Return the rows of some Stokes parameters, one of `STOKES`, in maps of those `given`."""
    start = given.index(wanted)
    return slice(start, start + len(wanted))


#: A number that may be differentiated.
Scalar: TypeAlias = Float[Array, ""]
#: One map, and maps of I, or Q, U, or I, Q, U.
Map: TypeAlias = Float[Array, " pix"]
StokesMaps: TypeAlias = Float[Array, "stokes pix"]
#: Maps of several bands.
BandMaps: TypeAlias = Float[Array, "band stokes pix"]
#: Coefficients of I, or E, B, or I, E, B.
Alm: TypeAlias = Float[Array, "stokes alm"]
#: C_l and b_l for l = 0, 1, ...
Spectrum: TypeAlias = Float[Array, " ell"]
Window: TypeAlias = Float[Array, " ell"]
#: Covariance of the Stokes parameters of each pixel.
Covariance: TypeAlias = Float[Array, "stokes stokes pix"]
#: The beam of a map: full width at half maximum of a Gaussian [arcmin], or its window.
Beam: TypeAlias = Scalar | Window | float
