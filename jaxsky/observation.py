"""What is observed, and how: components with their beams, bands with theirs, pixels."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxsky.bandpass import Bandpass
from jaxsky.components import Component
from jaxsky.small_scales import SmallScales

#: Types of numbers by the name of their precision.
DTYPES: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}


class Source(eqx.Module):
    """A component of the sky at the resolution of its template.

    Parameters
    ----------
    component : template and law; Q, U, or I, Q, U
    fwhm : own beam of the template [arcmin]
    small_scales : how the template is continued below its beam; None leaves it as it is
    correlated_with : name of a source whose small scales are drawn together with these
    """

    component: Component
    fwhm: Float[Array, ""] | float = 0.0
    small_scales: SmallScales | None = None
    correlated_with: str | None = eqx.field(static=True, default=None)


class ObservedBand(eqx.Module):
    """How a band is observed.

    Parameters
    ----------
    band : the bandpass
    beam : FWHM of a Gaussian [arcmin], or a table b_l
    target : beam to which the observed map is smoothed; None leaves it as observed
    noise : uniform level [uK_RJ arcmin], covariance of each pixel [uK_RJ^2], shape
        (stokes, stokes, pix), or None
    diagonal : noise with the diagonal of the Cholesky factor only (`noise.draw`)
    """

    band: Bandpass
    beam: Float[Array, ""] | Float[Array, " ell"] | float
    target: Float[Array, ""] | float | None = None
    noise: Float[Array, ""] | Float[Array, "stokes stokes pix"] | float | None = None
    diagonal: bool = eqx.field(static=True, default=False)


class Observation(eqx.Module):
    """An experiment: channels by name, and the pixels of the maps.

    Parameters
    ----------
    channels : by name, in order
    nside : resolution of the maps
    stokes : "QU" or "IQU"
    finest : beam to which small scales are made [arcmin], at most the finest one observed
    lmax : largest multipole of the sky in the maps, by default 2 nside
    precision : "double" or "single", in which the maps are computed; single takes half the memory
        and rounds to 1e-7 of the rms of a map

    Raises
    ------
    ValueError
        If there is no channel, or `stokes` or `precision` is neither.
    """

    channels: dict[str, ObservedBand]
    nside: int = eqx.field(static=True)
    stokes: str = eqx.field(static=True, default="QU")
    finest: Float[Array, ""] | float = 0.0
    names: tuple[str, ...] = eqx.field(static=True, default=())
    lmax: int = eqx.field(static=True, default=0)
    precision: str = eqx.field(static=True, default="double")

    def __init__(
        self,
        channels: Mapping[str, ObservedBand],
        nside: int,
        stokes: str = "QU",
        finest: Float[Array, ""] | float = 0.0,
        lmax: int | None = None,
        precision: str = "double",
    ) -> None:
        self.channels, self.nside, self.stokes = dict(channels), nside, stokes
        self.finest, self.precision = finest, precision
        self.lmax = 2 * nside if lmax is None else lmax
        # JAX sorts dictionaries when it takes them apart.
        self.names = tuple(channels)
        if not self.channels:
            raise ValueError("Argument `channels` must have at least one channel.")
        if stokes not in ("QU", "IQU"):
            raise ValueError(f"Argument `stokes` must be 'QU' or 'IQU', not {stokes!r}.")
        if precision not in DTYPES:
            raise ValueError(
                f"Argument `precision` must be 'double' or 'single', not {precision!r}."
            )

    @property
    def dtype(self) -> type[np.floating]:
        """Type of the numbers in maps and coefficients."""
        return DTYPES[self.precision]

    @property
    def bands(self) -> tuple[Bandpass, ...]:
        """The bandpasses in order."""
        return tuple(self.channels[name].band for name in self.names)
