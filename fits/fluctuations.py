"""What maps hold besides the model: noise and CMB, and the covariance of what is made of them.

At a common resolution the noise of a band is a linear operator applied to white noise, and the
CMB is synthesised from independent coefficients, one set for all bands. The inner products of
rows with the data therefore have a covariance that follows exactly from a few transposed
transforms of the rows; no simulation, no matrix over pixels.
"""

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.checks import Numeric
from jaxsky.cmb import realisation
from jaxsky.harmonics import (
    Preparation,
    adjoint_synthesis,
    alm_ell,
    average_pixels,
    expand,
    map_variance,
    synthesis,
)
from jaxsky.noise import draw, pixel_covariance, stream, white_alm

#: Pixels whose products are added up at once; few enough to stay in cache.
CHUNK = 1 << 16


class Fluctuations(eqx.Module):
    """Noise and CMB of Q, U maps in several bands.

    Parameters
    ----------
    preparations : operator with which each band was brought to the common resolution
    noise : for each band, before that, a level [uK_RJ arcmin] or the covariance of Q and U in each
        pixel [uK_RJ^2]
    correlated : for each band, C_l of noise that is correlated between pixels, the same for E and
        B, in the prepared maps [uK_RJ^2], shape (ell,); None where there is none
    cmb_spectra : C_l of EE and BB [uK_CMB^2], shape (2, ell); None without CMB
    cmb_windows : beam and pixel window of the prepared maps of each band, shape (band, ell)
    cmb_factors : uK_RJ per uK_CMB in each band, shape (band,)
    names : of the bands; the random numbers of each come from its name
    """

    preparations: tuple[Preparation, ...]
    noise: tuple[Numeric, ...]
    correlated: tuple[Float[Array, " ell"] | None, ...]
    cmb_spectra: Float[Array, "stokes ell"] | None
    cmb_windows: Float[Array, "band ell"] | None
    cmb_factors: Float[Array, " band"]
    names: tuple[str, ...] = eqx.field(static=True)

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
        for name, preparation, noise, spectrum in zip(
            self.names, self.preparations, self.noise, self.correlated, strict=True
        ):
            nside = preparation.nside
            if preparation.window is None:
                pixels = jnp.asarray(pixel_covariance(noise, preparation.nside_in), float)
                total = average_pixels(draw(stream(key, "noise", name), pixels), nside)
                if spectrum is not None:
                    total = total + synthesis(_correlated_alm(key, name, spectrum), nside)
            else:
                alm = noise_alm(key, name, noise, spectrum, preparation.window)
                total = synthesis(alm, nside)
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
        variances = []
        for preparation, noise, spectrum in zip(
            self.preparations, self.noise, self.correlated, strict=True
        ):
            if jnp.ndim(noise):
                pixels = jnp.asarray(noise)
                variance = np.asarray(preparation.variance([pixels[s, s] for s in range(2)]))
            else:
                shape = (2, healpy.nside2npix(preparation.nside))
                variance = np.full(shape, preparation.uniform_variance(float(noise)))
            if spectrum is not None:
                variance = variance + map_variance(spectrum)
            variances.append(variance)
        total = np.stack(variances)
        return jnp.asarray(np.sqrt(np.where(total > 0, total, np.nan)))


def noise_alm(
    key: Array,
    name: str,
    noise: Numeric,
    spectrum: Float[Array, " ell"] | None,
    window: Float[Array, " ell"],
) -> Float[Array, "2 alm"]:
    """Coefficients E and B of a realisation of the noise of a band, by its name.

    White noise of either kind (`jaxsky.noise`) times a window, and noise that is correlated
    between pixels, in whose spectrum the window is already.
    """
    alm = white_alm(stream(key, "noise", name), noise, window.size - 1) * expand(window)
    return alm if spectrum is None else alm + _correlated_alm(key, name, spectrum)


def _correlated_alm(key: Array, name: str, spectrum: Float[Array, " ell"]) -> Float[Array, "2 alm"]:
    white = jax.random.normal(stream(key, "correlated", name), (2, spectrum.size**2))
    return white * expand(jnp.sqrt(spectrum))


def _products(
    preparation: Preparation,
    noise: Numeric,
    rows: Float[Array, "row stokes pix"],
) -> Float[np.ndarray, "row row"]:
    """Covariance of the inner products of rows with the prepared noise of a band.

    The rows at the resolution of the noise are kept in its precision.
    """
    if not np.ndim(noise) and not noise:
        return np.zeros((len(rows), len(rows)))
    noise = pixel_covariance(noise, preparation.nside_in)
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
