"""What noise does to a separation: errors of parameters, noise and residuals of BB.

Smoothed noise is correlated between pixels, which the spectral likelihood does not know. So its
errors are taken from simulations: foregrounds as they were found, with new noise. To first order
the parameters move by -H^-1 times the gradient of -ln L; the components are then separated with
those parameters, so that residual foregrounds appear with the noise that caused them.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.posterior import Likelihood, Posterior, value_and_gradient
from fits.priors import Gaussian, Prior
from fits.profile_likelihood import SpectralLikelihood
from fits.pseudo_cl import MaskedSpectra, band_powers, mean_spectrum
from fits.results import FitResult
from fits.separated_data import FullSkyData, PixelData
from fits.systems import Factor
from jaxsky.checks import Numeric
from jaxsky.cmb import realisation
from jaxsky.harmonics import expand, synthesis
from jaxsky.keys import stream


class Response:
    """-H^-1 of a fit, with H the curvature of -log posterior.

    `theta` is the best fit as a vector, with start values in regions without a pixel.
    """

    def __init__(
        self,
        like: Likelihood,
        params: Mapping[str, Numeric],
        priors: Mapping[str, Prior] | None = None,
    ) -> None:
        self._posterior = posterior = Posterior(like, priors)
        self.theta = np.array(like.flat(like.check(params)))
        self._keep = np.flatnonzero(posterior.present & ~posterior.edges(self.theta))
        hessian = posterior.derivatives(self.theta).hessian
        self._factor = Factor(posterior.curvature(self.theta, hessian, self._keep))
        if not self._factor.positive:
            raise ValueError("The best fit is no maximum of the posterior.")

    def moved(self, like: Likelihood, key: Array) -> Float[np.ndarray, " par"]:
        """The best fit to the data of `like`, within the bounds of uniform priors.

        The means of Gaussian priors are drawn anew, too, since they were measured like the data.
        """
        gradient = np.array(value_and_gradient(like, self.theta)[1])
        draws = np.asarray(jax.random.normal(key, gradient.shape))
        for prior, where in self._posterior.priors:
            assert isinstance(prior, Gaussian)  # the only one that is not a bound
            gradient += np.where(where, draws / prior.sigma, 0.0)
        theta = self.theta.copy()
        theta[self._keep] -= self._factor.solve(gradient[self._keep])
        return np.clip(theta, self._posterior.low, self._posterior.high)


def widened(
    samples: FitResult,
    center: Float[np.ndarray, " par"],
    hessian: Float[np.ndarray, "par par"],
    errors: Float[np.ndarray, "sim par"],
) -> FitResult:
    """Samples of a posterior whose likelihood has wrong errors, stretched to the right ones.

    About the best fit by S L^-1, with L L^T = H^-1 and S S^T the covariance of the estimates: the
    open-faced sandwich of Shaby (2014, J. Comput. Graph. Stat. 23, 853). With too few simulations
    for the covariance, each parameter by the ratio of its standard deviations. `center` is the best
    fit in the order of the samples, with the `hessian` of -log posterior there.
    """
    inverse = np.linalg.inv(hessian)
    if len(errors) > 4 * len(center):
        wanted = np.atleast_2d(np.cov(errors.T))
        turn = np.linalg.cholesky(wanted) @ np.linalg.inv(np.linalg.cholesky(inverse))
    else:
        turn = np.diag(errors.std(axis=0, ddof=1) / np.sqrt(np.diagonal(inverse)))
    return samples.with_chain(center + (samples.details["chain"] - center) @ turn.T)


class SimulatedNoise(NamedTuple):
    """Of each simulation, the parameters less the best fit, and band powers D_b of BB [uK_CMB^2].

    Those are of the noise in the cleaned CMB, the foregrounds that are left with these parameters,
    both together, the sum with a CMB without tensors, and that CMB without its B modes: E that
    pixels and mask turn into B. `spectrum` is C_l of noise and foregrounds in the masked map.
    """

    theta: Float[np.ndarray, "sim par"]
    noise: Float[np.ndarray, "sim bin"]
    residual: Float[np.ndarray, "sim bin"]
    both: Float[np.ndarray, "sim bin"]
    total: Float[np.ndarray, "sim bin"]
    leaked: Float[np.ndarray, "sim bin"]
    spectrum: Float[np.ndarray, "sim ell"]


class Realisation(NamedTuple):
    """What a realisation is made of: simulated noise on top of the foregrounds that were found.

    `response` is what noise does to the best fit, `emission` the foregrounds in the bands, `window`
    the beam of the maps, and `lensed` C_l of a CMB without tensors up to its end [uK_CMB^2].
    """

    data: PixelData | FullSkyData
    like: SpectralLikelihood
    best: Mapping[str, Array]
    response: Response
    emission: Float[np.ndarray, "band stokes _"]
    spectra: MaskedSpectra
    window: Float[np.ndarray, " ell"]
    lensed: Float[np.ndarray, "4 ell"]

    def cleaned(self, params: Mapping[str, Array], data: np.ndarray) -> np.ndarray:
        """The map of the CMB with these parameters."""
        found = self.data.components(self.like, params, data, covariance=False)
        maps = self.data.maps(found, self.like, params, data)
        return maps[found.components.index("cmb")]

    def of(self, key: Array) -> Sequence[Array | np.ndarray]:
        """What `SimulatedNoise` holds of one realisation."""
        noise = self.data.noise_realisation(key)
        observed = self.emission + noise
        moved = self.response.moved(self.data.likelihood(observed), stream(key, "priors"))
        alone = self.cleaned(self.best, noise)
        both = self.cleaned(self.like.named(jnp.asarray(moved)), observed)
        nside = healpy.npix2nside(both.shape[-1])
        alm = realisation(stream(key, "cmb"), self.lensed) * expand(jnp.asarray(self.window))
        sky, E = synthesis(alm, nside), synthesis(alm.at[1].set(0.0), nside)
        every = (alone, both - alone, both, both + sky, E)
        powers = [band_powers(self.spectra, jnp.asarray(maps))[1] for maps in every]
        spectrum = mean_spectrum(self.spectra.mask, both, self.spectra.lmax)
        return [moved - self.response.theta, *powers, spectrum]
