"""Simulated noise through the whole separation: errors of parameters, noise and residuals of BB.

Smoothed noise is correlated between pixels, which the spectral likelihood does not know. So its
errors are taken from simulations: foregrounds as they were found, with new noise. To first order
the parameters move by -H^-1 times the gradient of -ln L; the components are then separated with
those parameters, so that residual foregrounds appear with the noise that caused them.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.profile_likelihood import SpectralLikelihood
from fits.pseudo_cl import MaskedSpectra, band_powers
from fits.response import Response
from fits.separate.domains import Domain
from jaxsky.cmb import realisation
from jaxsky.harmonics import analysis, expand, power_spectrum, synthesis
from jaxsky.keys import stream


class Simulated(NamedTuple):
    """Of each simulation; band powers are D_b of BB [uK_CMB^2].

    Parameters
    ----------
    theta : parameters, less the best fit
    noise : band powers of the noise in the cleaned CMB
    residual : those of the foregrounds that are left with these parameters
    both : those of the sum
    total : those of the sum and a CMB without tensors
    leaked : those of that CMB without its B modes: E that pixels and mask turn into B
    spectrum : C_l of the sum in the masked map, over the mean square of the mask
    """

    theta: Float[np.ndarray, "sim par"]
    noise: Float[np.ndarray, "sim bin"]
    residual: Float[np.ndarray, "sim bin"]
    both: Float[np.ndarray, "sim bin"]
    total: Float[np.ndarray, "sim bin"]
    leaked: Float[np.ndarray, "sim bin"]
    spectrum: Float[np.ndarray, "sim ell"]


@partial(jax.jit, static_argnames="lmax")
def _mean_spectrum(mask, maps, lmax):
    """C_l of a masked map, the mean of EE and BB."""
    power = power_spectrum(analysis(mask * jnp.where(mask > 0, maps, 0.0), lmax, 0))
    return power.mean(axis=0) / jnp.mean(mask**2)


class Realisation(NamedTuple):
    """What a realisation is made of: simulated noise on top of the foregrounds that were found.

    Parameters
    ----------
    domain : how maps are separated
    like, best, response : the likelihood, the best fit by name, and what noise does to it
    emission : foregrounds in the bands, as they were found
    row : position of the CMB among the components
    spectra, window : how BB is taken, and the beam of the maps
    lensed : spectra of a CMB without tensors, up to the end of the window [uK_CMB^2]
    """

    domain: Domain
    like: SpectralLikelihood
    best: Mapping[str, Array]
    response: Response
    emission: Float[np.ndarray, "band stokes _"]
    row: int
    spectra: MaskedSpectra
    window: Float[np.ndarray, " ell"]
    lensed: Float[np.ndarray, "4 ell"]

    def cleaned(self, params: Mapping[str, Array], data: np.ndarray) -> np.ndarray:
        """The map of the CMB with these parameters."""
        found = self.domain.components(self.like, params, data, covariance=False)
        return self.domain.maps(found)[self.row]

    def of(self, key: Array) -> Sequence[Array | np.ndarray]:
        """What `Simulated` holds of one realisation."""
        noise = self.domain.noise_realisation(key)
        observed = self.emission + noise
        moved = self.response.moved(self.domain.likelihood(observed), stream(key, "priors"))
        alone = self.cleaned(self.best, noise)
        both = self.cleaned(self.like.named(jnp.asarray(moved)), observed)
        nside = healpy.npix2nside(both.shape[-1])
        alm = realisation(stream(key, "cmb"), self.lensed) * expand(jnp.asarray(self.window))
        sky, E = synthesis(alm, nside), synthesis(alm.at[1].set(0.0), nside)
        every = (alone, both - alone, both, both + sky, E)
        powers = [band_powers(self.spectra, jnp.asarray(maps))[1] for maps in every]
        spectrum = _mean_spectrum(self.spectra.mask, both, self.spectra.lmax)
        return [moved - self.response.theta, *powers, spectrum]
