"""Noise and CMB in maps at a common resolution: realisations, and covariances of products.

There the noise of a band is a linear operator applied to white noise, and the CMB is synthesised
from independent coefficients, one set for all bands. The inner products of rows with the data
therefore have a covariance that follows exactly from a few transposed transforms of the rows; no
simulation, no matrix over pixels.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from jaxsky import job
from jaxsky.arrays import Alm, stokes_rows
from jaxsky.checks import Numeric
from jaxsky.cmb import field_spectra, realisation
from jaxsky.harmonics import (
    Preparation,
    adjoint_synthesis,
    average_pixels,
    expand,
    map_variance,
    shortened,
    synthesis,
)
from jaxsky.io.stacks import Maps, empty, is_large, loaded, ranges
from jaxsky.job import filled
from jaxsky.noise import cholesky, draw, pixel_covariance, stream, white_alm

#: Pixels whose products are summed at once; few enough to stay in cache.
CHUNK = 1 << 16


class MapNoise(NamedTuple):
    """Noise of a map, with the preparation for the common resolution.

    `noise` is that of its own pixels, a level [uK_RJ arcmin] or the covariance of the Stokes
    parameters in each [uK_RJ^2]; `correlated` C_l of noise that is correlated between pixels, the
    same for I, E and B, or one for each, in the prepared map [uK_RJ^2], None where there is none.
    """

    preparation: Preparation
    noise: Numeric
    correlated: Float[Array, "*stokes ell"] | None
    stokes: str = "QU"

    def _spectra(self) -> Float[np.ndarray, "stokes ell"]:
        """Return `correlated` of each Stokes parameter; polarization has no modes at l < 2."""
        given = np.asarray(self.correlated)
        spectra = np.array(np.broadcast_to(given, (len(self.stokes), given.shape[-1])))
        if "QU" in self.stokes:
            spectra[-2:, :2] = 0.0
        return spectra

    def covariance(
        self, rows: Iterable[Float[Array, "stokes pix"]], count: int
    ) -> Float[np.ndarray, "row row"]:
        """Return the covariance of the inner products of so many rows with the prepared noise.

        Rows at the resolution of the noise are stored in its precision.
        """
        block, modes, before = np.zeros((count, count)), None, None
        if self.correlated is not None:
            root = np.sqrt(self._spectra())
            modes = empty((count, len(root) * root.shape[-1] ** 2))
        covariance = self._pixels()
        npix = covariance.shape[-1]
        if np.ndim(self.noise) or self.noise:
            before = empty((count, len(self.stokes), npix), covariance.dtype)
        for own, row in enumerate(rows):
            if before is not None:
                before[own] = np.asarray(self.preparation.transpose(loaded(row)))
            if modes is not None:
                modes[own] = np.asarray(_modes(row, root))
        if before is not None:
            for cut in ranges(npix, CHUNK):
                maps = before[..., cut].astype(float)
                pixels = np.ascontiguousarray(covariance[..., cut], float)
                seen = np.einsum("stp,jtp->jsp", pixels, maps)
                block += maps.reshape(count, -1) @ seen.reshape(count, -1).T
            block = (block + block.T) / 2
        return block if modes is None else block + _products(modes)

    def _pixels(self) -> Any:
        """Return the covariance of each pixel before the preparation."""
        return pixel_covariance(self.noise, self.preparation.nside_in, len(self.stokes))

    def alm(self, key: Array, name: str) -> Alm:
        """Return coefficients of a realisation of smoothed noise; the map's name is in its key."""
        window = self.preparation.window
        assert window is not None  # there is a common beam
        own, lmax = stream(key, "noise", name), window.size - 1
        white = white_alm(own, self.noise, lmax, len(self.stokes)) * expand(window)
        return white if self.correlated is None else white + self._correlated_alm(key, name)

    def _correlated_alm(self, key: Array, name: str) -> Alm:
        spectra = jnp.asarray(self._spectra())
        shape = len(spectra), spectra.shape[-1] ** 2
        white = jax.random.normal(stream(key, "correlated", name), shape)
        return white * expand(jnp.sqrt(spectra))

    def realisation(self, key: Array, name: str) -> Float[Array, "stokes pix"]:
        """Return noise at the common resolution [uK_RJ], with random numbers by name."""
        nside = self.preparation.nside
        if self.preparation.window is not None:
            return synthesis(self.alm(key, name), nside)
        pixels = jnp.asarray(self._pixels(), float)
        total = average_pixels(draw(stream(key, "noise", name), pixels), nside)
        if self.correlated is None:
            return total
        return total + synthesis(self._correlated_alm(key, name), nside)

    def variance(self) -> Float[np.ndarray, "stokes pix"]:
        """Return the variance in each prepared pixel [uK_RJ^2]; see `Fluctuations.sigma`."""
        if np.ndim(self.noise):
            pixels: Any = self.noise
            each = [pixels[s, s] for s in range(len(self.stokes))]
            total = np.asarray(self.preparation.variance(each))
        else:
            shape = (len(self.stokes), healpy.nside2npix(self.preparation.nside))
            total = np.broadcast_to(self.preparation.uniform_variance(float(self.noise)), shape)
        if self.correlated is None:
            return total
        return total + np.array([[map_variance(s)] for s in np.atleast_2d(self.correlated)])


class Fluctuations(eqx.Module):
    """Noise and CMB: what maps in several bands contain besides the model.

    Bands have `noises`, `cmb_windows` with the beam and pixel window of their prepared maps,
    `cmb_factors` in uK_RJ per uK_CMB, and `names`, from which the random numbers of each are
    derived. `cmb_spectra` are C_l [uK_CMB^2] of TT for I, of EE and BB for Q and U, or of TT, EE,
    BB and TE for all three; None without CMB.
    """

    noises: tuple[MapNoise, ...]
    cmb_spectra: Float[Array, "spectrum ell"] | None
    cmb_windows: Float[Array, "band ell"] | None
    cmb_factors: Float[Array, " band"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def stokes(self) -> str:
        """Stokes parameters of the maps."""
        return self.noises[0].stokes

    @property
    def nside(self) -> int:
        """Resolution of the prepared maps."""
        return self.noises[0].preparation.nside

    # Not one program: XLA would keep the maps of all rows and bands in memory at once.
    def covariance(
        self, rows: Float[Array, "band row stokes pix"]
    ) -> Float[np.ndarray, "bandrow bandrow"]:
        """Return the covariance of the inner products of rows with the fluctuations."""
        npix, noises = healpy.nside2npix(self.nside), self.noises  # without padding
        blocks = list[np.ndarray]()
        modes: Any = None
        if self.cmb_spectra is not None and self.cmb_windows is not None:
            # As far as the beams leave some.
            last = max(len(shortened(window)) for window in self.cmb_windows)
            roots = self._cmb_roots()[..., :last]
            modes = empty((*rows.shape[:2], len(self.stokes) * last**2))
        for start in range(0, len(noises), job.number()):
            # As many bands at a time as there are processes, which take turns.
            bands = range(len(noises))[start : start + job.number()]
            maps = {i: rows[i] for i in bands}

            def of_band(i: int, maps: dict[int, Any] = maps) -> tuple[np.ndarray, list[np.ndarray]]:
                own = (row[..., :npix] for row in maps[i])
                block = noises[i].covariance(own, len(maps[i]))
                if modes is None:
                    return block, []
                return block, [np.asarray(_modes(row[..., :npix], roots[i])) for row in maps[i]]

            for i, (block, projected) in zip(bands, job.by_turns(of_band, bands), strict=True):
                blocks.append(block)
                for row, each in enumerate(projected):
                    modes[i, row] = each
        total = scipy.linalg.block_diag(*blocks)
        return total if modes is None else total + _products(modes)

    # Not one program: there XLA would draw the normals anew for each row.
    def noise_realisation(self, key: Array) -> Maps:
        """Return noise of all bands at the common resolution [uK_RJ]."""
        shape = len(self.names), len(self.stokes), healpy.nside2npix(self.nside)
        named = zip(self.noises, self.names, strict=True)
        each = (noise.realisation(key, name) for noise, name in named)
        if not is_large(shape):
            return jnp.stack(list(each))
        found = empty(shape)
        for i, maps in enumerate(each):
            found[i] = np.asarray(maps)
        return found

    @eqx.filter_jit
    def cmb_realisation(self, key: Array) -> Float[Array, "band stokes pix"]:
        """Return the CMB in all bands at the common resolution [uK_RJ]; zero without CMB."""
        if self.cmb_spectra is None or self.cmb_windows is None:
            npix = healpy.nside2npix(self.nside)
            return jnp.zeros((len(self.names), len(self.stokes), npix))
        spectra = self.cmb_spectra
        if len(spectra) < 4:  # what is not seen does not matter
            whole = jnp.zeros((4, spectra.shape[-1]))
            spectra = whole.at[stokes_rows(self.stokes)].set(spectra)
        alm = realisation(stream(key, "cmb"), spectra, self.stokes)
        seen = self.cmb_factors[:, None] * self.cmb_windows
        return jnp.stack([synthesis(alm * expand(window), self.nside) for window in seen])

    def cmb_power(self) -> Float[np.ndarray, "band stokes ell"]:
        """Return mean spectra TT, EE and BB, as far as seen, of the CMB in each band [uK_RJ^2]."""
        if self.cmb_spectra is None or self.cmb_windows is None:
            return np.zeros((len(self.names), len(self.stokes), 1))
        seen = np.asarray(self.cmb_factors)[:, None] * np.asarray(self.cmb_windows)
        return seen[:, None] ** 2 * np.asarray(self.cmb_spectra)[: len(self.stokes)]

    def _cmb_roots(self) -> Float[np.ndarray, "band *stokes stokes ell"]:
        """Return square roots of the spectra of the CMB, of their matrix if T and E are both seen.

        They are the lower Cholesky factor of the matrix.
        """
        if self.stokes != "IQU" or self.cmb_spectra is None:
            return np.sqrt(self.cmb_power())
        seen = np.asarray(self.cmb_factors)[:, None] * np.asarray(self.cmb_windows)
        return seen[:, None, None] * np.asarray(cholesky(field_spectra(self.cmb_spectra)))

    def sigma(self) -> Maps:
        """Return the standard deviation of the noise in each prepared pixel [uK_RJ].

        NaN where it is unknown: next to steps of the noise by more than a factor of about 100,
        where the smoothed map of variances rings below zero.
        """
        shape = len(self.names), len(self.stokes), healpy.nside2npix(self.nside)
        uniform = not any(np.ndim(one.noise) for one in self.noises)
        size = 1 if uniform else shape[-1]

        def of_band(i: int) -> np.ndarray:
            total = self.noises[i].variance()[:, :size]
            return np.sqrt(np.where(total > 0, total, np.nan))

        found = filled((*shape[:2], size), of_band)
        return np.broadcast_to(found[...], shape) if uniform else found


def _products(modes: Maps) -> Float[np.ndarray, "row row"]:
    """Return the inner products of all rows, projected on modes."""
    number, size = int(np.prod(modes.shape[:-1])), modes.shape[-1]
    parts = (modes[..., part].reshape(number, -1) for part in ranges(size))
    return sum((part @ part.T for part in parts), np.zeros((number, number)))


@jax.jit
def _modes(
    row: Float[Array, "stokes pix"], root: Float[Array, "*stokes stokes ell"]
) -> Float[Array, " mode"]:
    """Project a row on independent modes of unit variance, given the root of their spectra."""
    alm = adjoint_synthesis(row, root.shape[-1] - 1)
    if root.ndim == 2:
        return (expand(root) * alm).ravel()
    size = len(root)
    modes = [sum(expand(root[i, j]) * alm[i] for i in range(j, size)) for j in range(size)]
    return jnp.concatenate(modes)
