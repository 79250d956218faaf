"""Bringing maps to a common resolution: one linear operator a map, with its exact transpose."""

from collections.abc import Sequence

import ducc0
import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsky.components import Component
from jaxsky.harmonics import (
    analysis,
    average_pixels,
    beam_ratio,
    expand,
    low_multipoles,
    resample,
    synthesis,
)

#: Up to this fraction of nside the quadrature of an analysis is good without steps or margin: what
#: a multipole adds to another, up to three times as high, is some 1e-6 of it at nside 128, and the
#: less, the finer the pixels are. Variances, whose spectra are steep, take a larger fraction.
FINE, FINE_VARIANCE = 0.25, 0.375


class Preparation(eqx.Module):
    """Smooth to a common beam and degrade to a common nside, or average pixels only.

    Parameters
    ----------
    window : factor for each multipole; None averages pixels and leaves the beam as it is
    nside_in, nside : resolution of the maps, and of the result
    """

    window: Float[Array, " ell"] | None
    nside_in: int = eqx.field(static=True)
    nside: int = eqx.field(static=True)

    @classmethod
    def smoothing(
        cls,
        nside_in: int,
        own: float | Array,
        nside: int,
        fwhm: float,
        lmax: int,
        what: str = "map",
    ) -> "Preparation":
        """Smooth from an own beam to one of fwhm [arcmin], by sqrt(fwhm^2 - own^2).

        `own` is the FWHM of a Gaussian [arcmin], or a table b_l.
        """
        _check_nside(nside_in, nside, what)
        return cls(beam_ratio(fwhm, own, lmax, what), nside_in, nside)

    @classmethod
    def averaging(cls, nside_in: int, nside: int, what: str = "map") -> "Preparation":
        """Average over pixels."""
        _check_nside(nside_in, nside, what)
        return cls(None, nside_in, nside)

    def __call__(self, maps: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """The maps at the common resolution."""
        if self.window is None:
            return average_pixels(maps, self.nside)
        lmax = self.window.size - 1
        if lmax <= FINE * self.nside_in:
            alm = analysis(maps, lmax, 0)
        else:
            alm = low_multipoles(maps, lmax)
        return synthesis(alm * expand(self.window), self.nside)

    @eqx.filter_jit
    def of_noise(self, maps: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """White noise at the common resolution, in a tenth of the time that other maps take.

        Without refinement and multipoles beyond those that are kept: its mean spectrum is the
        same to 1e-4, and it is not the same realisation.
        """
        if self.window is None:
            return average_pixels(maps, self.nside)
        alm = analysis(maps, self.window.size - 1, 0)
        return synthesis(alm * expand(self.window), self.nside)

    @eqx.filter_jit
    def transpose(self, maps: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """The transposed operator, from the common resolution to that of the maps."""
        shape = (len(maps), healpy.nside2npix(self.nside_in))
        return jax.linear_transpose(self, jax.ShapeDtypeStruct(shape, maps.dtype))(maps)[0]

    def variance(self, variance: Sequence[Float[Array, " pix"]]) -> Float[Array, "stokes pix"]:
        """Variance of prepared white noise, from that of each pixel before.

        The variance of a smoothed map is the map of variances smoothed by the square of the
        kernel. The square is formed exactly, on Gauss-Legendre nodes.
        """
        if self.window is None:
            mean = average_pixels(jnp.asarray(variance, float), self.nside)
            return mean * (self.nside / self.nside_in) ** 2
        squared = jnp.asarray(_squared_window(np.asarray(self.window), 2 * self.nside_in))
        area = healpy.nside2pixarea(self.nside_in)
        rows = []
        for row in variance:  # one by one: a row may be as large as all else
            values = jnp.asarray(row[None], float)
            if squared.size - 1 <= FINE_VARIANCE * self.nside_in:
                alm = analysis(values, squared.size - 1, 0)
                smoothed = synthesis(alm * expand(squared), self.nside)
            else:
                smoothed = resample(values, squared, self.nside)
            rows.append(smoothed[0].block_until_ready())
        return area * jnp.stack(rows)


def _check_nside(nside_in: int, nside: int, what: str) -> None:
    if nside > nside_in:
        raise ValueError(f"The common nside {nside} is larger than that of {what}, {nside_in}.")


def _squared_window(window: np.ndarray, highest: int) -> np.ndarray:
    """Window of the square of the kernel that has the given window."""
    lmax = min(2 * (len(window) - 1), highest)
    order = 2 * len(window) + lmax
    x = np.cos(ducc0.misc.GL_thetas(order))
    weights = ducc0.misc.GL_weights(order, 1) / (2 * np.pi)
    ell = np.arange(len(window))
    kernel = np.polynomial.legendre.legval(x, (2 * ell + 1) / (4 * np.pi) * window)
    return 2 * np.pi * (weights * kernel**2) @ np.polynomial.legendre.legvander(x, lmax)


def prepare_component(
    component: Component, preparation: Preparation, kept: Bool[np.ndarray, " pix"] | None = None
) -> Component:
    """A component with its amplitude, and parameters that are maps, at the common resolution.

    Parameters
    ----------
    component, preparation : what is prepared, and how
    kept : pixels of the amplitude that are not set to zero; default all
    """

    def prepare(leaf):
        if leaf.ndim not in (1, 2):
            return leaf
        values = jnp.atleast_2d(jnp.asarray(leaf, float))
        if leaf.ndim == 2:
            values = values if kept is None else values * kept
        prepared = preparation(values).block_until_ready()
        return prepared if leaf.ndim == 2 else prepared[0]

    return jax.tree.map(prepare, component)
