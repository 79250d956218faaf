"""Bringing maps to a common resolution: one linear operator a map, with its exact transpose."""

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
    resample,
    synthesis,
)

__all__ = ["Preparation", "prepare_component"]


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
        cls, nside_in: int, own_fwhm: float, nside: int, fwhm: float, lmax: int, what: str = "map"
    ) -> "Preparation":
        """Smooth from a beam of own_fwhm to one of fwhm [arcmin], by sqrt(fwhm^2 - own_fwhm^2).

        Raises
        ------
        ValueError
            If the target is finer than `what` is, in beam or pixels.
        """
        _check_nside(nside_in, nside, what)
        return cls(beam_ratio(fwhm, own_fwhm, lmax, what), nside_in, nside)

    @classmethod
    def averaging(cls, nside_in: int, nside: int, what: str = "map") -> "Preparation":
        """Average over pixels.

        Raises
        ------
        ValueError
            If the target has smaller pixels than `what` has.
        """
        _check_nside(nside_in, nside, what)
        return cls(None, nside_in, nside)

    def __call__(self, maps: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """The maps at the common resolution."""
        if self.window is not None:
            return resample(maps, self.window, self.nside)
        return average_pixels(maps, self.nside)

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

    def variance(self, variance: Float[Array, "stokes pix"]) -> Float[Array, "stokes pix"]:
        """Variance of prepared white noise, from that of each pixel before.

        The variance of a smoothed map is the map of variances smoothed by the square of the
        kernel. The square is formed exactly, on Gauss-Legendre nodes.
        """
        if self.window is None:
            return average_pixels(variance, self.nside) * (self.nside / self.nside_in) ** 2
        squared = _squared_window(np.asarray(self.window), 2 * self.nside_in)
        area = healpy.nside2pixarea(self.nside_in)
        rows = [resample(row[None], jnp.asarray(squared), self.nside)[0] for row in variance]
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
        if leaf.ndim == 2:
            return preparation(leaf if kept is None else leaf * kept)
        return preparation(leaf[None])[0] if leaf.ndim == 1 else leaf

    return jax.tree.map(prepare, component)
