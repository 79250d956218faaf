"""What maps hold besides the model: noise and CMB, and the covariance of what is made of them.

At a common resolution the noise of a band is a linear operator applied to white noise, and the
CMB is synthesised from independent coefficients, one set for all bands. The inner products of
rows with the data therefore have a covariance that follows exactly from a few transposed
transforms of the rows; no simulation, no matrix over pixels.
"""

from typing import Any

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.cmb import realisation
from jaxsky.harmonics import Preparation, adjoint_synthesis, alm_ell, expand, synthesis
from jaxsky.keys import stream
from jaxsky.noise import draw, uniform_alm

#: Pixels whose products are added up at once; few enough to stay in cache.
CHUNK = 1 << 16


class Fluctuations(eqx.Module):
    """Noise and CMB of Q, U maps in several bands.

    Parameters
    ----------
    preparations : operator with which each band was brought to the common resolution
    noise : for each band, covariance of Q and U in each pixel before that [uK_RJ^2]
    correlated : for each band, C_l of noise that is correlated between pixels, the same for E and
        B, in the prepared maps [uK_RJ^2], shape (ell,); None where there is none
    cmb_spectra : C_l of EE and BB [uK_CMB^2], shape (2, ell); None without CMB
    cmb_windows : beam and pixel window of the prepared maps of each band, shape (band, ell)
    cmb_factors : uK_RJ per uK_CMB in each band, shape (band,)
    names : of the bands; the random numbers of each come from its name
    levels : of the noise of each band [uK_RJ arcmin] where it is uniform, else None
    """

    preparations: tuple[Preparation, ...]
    noise: tuple[Float[Array, "stokes stokes pix"], ...]
    correlated: tuple[Float[Array, " ell"] | None, ...]
    cmb_spectra: Float[Array, "stokes ell"] | None
    cmb_windows: Float[Array, "band ell"] | None
    cmb_factors: Float[Array, " band"]
    names: tuple[str, ...] = eqx.field(static=True)
    levels: tuple[float | None, ...]

    # Not one program: XLA would hold the maps of all rows and bands at once.
    def covariance(
        self, rows: Float[Array, "band row stokes pix"]
    ) -> Float[np.ndarray, "bandrow bandrow"]:
        """Covariance of the inner products of rows with the fluctuations of each band."""
        bands, count = rows.shape[:2]
        total = np.zeros((bands, count, bands, count))
        for b, (preparation, noise) in enumerate(zip(self.preparations, self.noise, strict=True)):
            block = _products(preparation, noise, rows[b])
            if (spectrum := self.correlated[b]) is not None:
                modes = np.asarray(_modes(rows[b], np.stack([spectrum] * 2)))
                block = block + modes @ modes.T
            total[b, :, b, :] += block
        square = total.reshape(bands * count, bands * count)
        if self.cmb_spectra is not None and self.cmb_windows is not None:
            modes = np.concatenate(
                [
                    np.asarray(factor)
                    * _modes(band, np.asarray(self.cmb_spectra) * np.asarray(window) ** 2)
                    for factor, window, band in zip(
                        self.cmb_factors, self.cmb_windows, rows, strict=True
                    )
                ]
            )
            square = square + modes @ modes.T
        return square

    # Not one program: in that XLA draws the normals anew for each row.
    def noise_realisation(self, key: Array) -> Float[Array, "band stokes pix"]:
        """Noise of all bands at the common resolution [uK_RJ]."""
        maps = []
        for b, (name, preparation) in enumerate(zip(self.names, self.preparations, strict=True)):
            white = stream(key, "noise", name)
            if (level := self.levels[b]) is not None and preparation.window is not None:
                # Uniform noise has independent multipoles: no pixels finer than the result's.
                alm = uniform_alm(white, level, preparation.window.size - 1)
                total = synthesis(alm * expand(preparation.window), preparation.nside)
            else:
                drawn = draw(white, jnp.asarray(self.noise[b], float))
                total = preparation.of_noise(drawn)
            if (spectrum := self.correlated[b]) is not None:
                modes = jax.random.normal(stream(key, "correlated", name), (2, spectrum.size**2))
                total = total + synthesis(modes * expand(jnp.sqrt(spectrum)), preparation.nside)
            maps.append(total)
        return jnp.stack(maps)

    @eqx.filter_jit
    def cmb_realisation(self, key: Array) -> Float[Array, "band stokes pix"]:
        """The CMB in all bands at the common resolution [uK_RJ]; zero without CMB."""
        nside = self.preparations[0].nside
        if self.cmb_spectra is None or self.cmb_windows is None:
            return jnp.zeros((len(self.preparations), 2, healpy.nside2npix(nside)))
        EE, BB = self.cmb_spectra
        zero = jnp.zeros_like(EE)
        alm = realisation(stream(key, "cmb"), jnp.stack([zero, EE, BB, zero]))
        seen = self.cmb_factors[:, None] * self.cmb_windows
        return jnp.stack([synthesis(alm * expand(window), nside) for window in seen])

    def cmb_power(self) -> Float[np.ndarray, "band 2 ell"]:
        """Mean spectra EE and BB of the CMB in the maps of each band [uK_RJ^2]."""
        if self.cmb_spectra is None or self.cmb_windows is None:
            return np.zeros((len(self.preparations), 2, 1))
        seen = np.asarray(self.cmb_factors)[:, None] * np.asarray(self.cmb_windows)
        return seen[:, None] ** 2 * np.asarray(self.cmb_spectra)

    def sigma(self) -> Float[Array, "band stokes pix"]:
        """Standard deviation of the noise in each pixel of the prepared maps [uK_RJ].

        NaN where it cannot be had: next to steps of the noise by more than a factor of some
        hundred, where the smoothed map of variances rings below zero.
        """
        variances: list[Any] = []
        for preparation, noise, spectrum in zip(
            self.preparations, self.noise, self.correlated, strict=True
        ):
            variance = preparation.variance([noise[s, s] for s in range(len(noise))])
            if spectrum is not None:
                modes = 2 * np.arange(spectrum.size) + 1
                variance = np.asarray(variance) + np.sum(modes * np.asarray(spectrum)) / (4 * np.pi)
            variances.append(variance)
        total = np.stack(variances)
        return jnp.asarray(np.sqrt(np.where(total > 0, total, np.nan)))


def uniform_level(covariance: Float[Array, "stokes stokes pix"]) -> float | None:
    """The level [u arcmin] of which `jaxsky.noise.uniform_covariance` makes this, if there is one.

    None for noise that varies, is correlated, or differs between Stokes parameters.
    """
    values = np.asarray(covariance)
    variance = values[0, 0, 0]
    for s, t in np.ndindex(values.shape[:2]):
        if not np.all(values[s, t] == (variance if s == t else 0.0)):
            return None
    nside = healpy.npix2nside(values.shape[-1])
    return float(np.sqrt(variance) * healpy.nside2resol(nside, arcmin=True))


def _products(
    preparation: Preparation,
    noise: Float[Array, "stokes stokes pix"],
    rows: Float[Array, "row stokes pix"],
) -> Float[np.ndarray, "row row"]:
    """Covariance of the inner products of rows with the prepared noise of a band.

    The rows at the resolution of the noise are kept in its precision.
    """
    before = [
        np.asarray(preparation.transpose(row).astype(noise.dtype).block_until_ready())
        for row in rows
    ]
    count, npix, covariance = len(rows), noise.shape[-1], np.asarray(noise)
    block = np.zeros((count, count))
    for start in range(0, npix, CHUNK):
        cut = slice(start, start + CHUNK)
        maps = np.array([row[:, cut] for row in before], dtype=float)
        seen = np.einsum("stp,jtp->jsp", covariance[..., cut].astype(float), maps)
        block += maps.reshape(count, -1) @ seen.reshape(count, -1).T
    return (block + block.T) / 2


@jax.jit
def _modes(
    rows: Float[Array, "row stokes pix"], spectra: Float[Array, "stokes ell"]
) -> Float[Array, "row mode"]:
    """Rows as seen by independent modes of unit variance that have the spectra of E and B."""
    lmax = spectra.shape[-1] - 1
    root = jnp.sqrt(spectra)[:, alm_ell(lmax)]
    return jnp.stack([(root * adjoint_synthesis(row, lmax)).ravel() for row in rows])
