"""Simulated noise through the whole separation: errors of parameters, noise and residuals of BB.

Smoothed noise is correlated between pixels, which the spectral likelihood does not know. So its
errors are taken from simulations: foregrounds as they were found, with new noise. To first order
the parameters move by -H^-1 times the gradient of -ln L; the components are then separated with
those parameters, so that residual foregrounds appear with the noise that caused them.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.pseudo_cl import MaskedSpectra, band_powers
from fits.realisations import realisations
from fits.separate.setup import Setup
from fits.separation.likelihood import SpectralLikelihood
from fits.separation.response import Response
from jaxsky.cmb import realisation
from jaxsky.harmonics import analysis, expand, power_spectrum, synthesis
from jaxsky.streams import stream

__all__ = ["Simulated", "simulate"]


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


@jax.jit
def _mean_spectrum(mask, maps, like_ell):
    """C_l of a masked map, the mean of EE and BB."""
    maps = jnp.where(mask > 0, maps, 0.0)
    power = power_spectrum(analysis(mask * maps, like_ell.size - 1, 0))
    return power.mean(axis=0) / jnp.mean(mask**2)


def simulate(
    setup: Setup,
    like: SpectralLikelihood,
    best: Mapping[str, Array],
    response: Response,
    found,
    cmb: str,
    spectra: MaskedSpectra,
    window: Float[np.ndarray, " ell"],
    lensed: Float[np.ndarray, "4 ell"],
    nsims: int,
    seed: int,
    path: Path | None = None,
    mark: str = "",
    report: Callable[[int], None] = lambda done: None,
) -> Simulated:
    """Separate simulated noise on top of the foregrounds that were found.

    Parameters
    ----------
    setup : what was separated
    like, best, response, found : the likelihood, the best fit, what noise does to it, and the
        components with it
    cmb : name of the CMB among them
    spectra, window : how BB is taken, and the beam of the maps
    lensed : spectra of the CMB without tensors [uK_CMB^2]
    nsims, seed, path, mark, report : see `fits.realisations.realisations`
    """
    domain = setup.domain
    names = tuple(like.sky)
    row = names.index(cmb)
    amplitude = np.array(found.amplitude)
    amplitude[row] = 0.0
    emission = domain.emission(like, best, amplitude)
    nside = int(np.sqrt(setup.mask.size / 12))
    lmax = len(window) - 1
    ell = jnp.arange(spectra.lmax + 1)

    def cleaned(params, data):
        return domain.maps(domain.components(like, params, data, covariance=False))[row]

    def make(key):
        noise = domain.noise_realisation(key)
        moved = response.moved(domain.likelihood(emission + noise), stream(key, "priors"))
        alone = cleaned(best, noise)
        both = cleaned(like.named(jnp.asarray(moved)), emission + noise)
        alm = realisation(stream(key, "cmb"), jnp.asarray(lensed)[:, : lmax + 1])
        seen = alm * expand(jnp.asarray(window))
        sky, E = synthesis(seen, nside), synthesis(seen.at[1].set(0.0), nside)
        every = (alone, both - alone, both, both + sky, E)
        powers = [band_powers(spectra, maps)[1] for maps in every]
        spectrum = _mean_spectrum(spectra.mask, both, ell)
        return [moved - response.theta, *powers, spectrum]

    return Simulated(*realisations(make, Simulated._fields, nsims, seed, path, mark, report))
