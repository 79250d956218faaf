"""What noise in the data does to fitted spectral parameters, to first order."""

from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Array, Float

from fits.posterior import Likelihood, Posterior, value_and_gradient
from fits.priors import Gaussian, Prior
from fits.results import FitResult
from fits.systems import Factor
from jaxsky.checks import Numeric


class Response:
    """-H^-1 of a fit, with H the curvature of -log posterior.

    Parameters
    ----------
    like : the likelihood that was fitted
    params : the best fit
    priors : those of the fit

    Attributes
    ----------
    theta : the best fit as a vector; start values in regions without a pixel
    """

    def __init__(
        self,
        like: Likelihood,
        params: Mapping[str, Numeric],
        priors: Mapping[str, Prior] | None = None,
    ) -> None:
        self._posterior = posterior = Posterior(like, priors or {})
        self.theta = np.array(like.flat(like.check(params)))
        self._keep = np.flatnonzero(posterior.present & ~posterior.edges(self.theta))
        curvature = posterior.curvature(self.theta, posterior.exact(self.theta), self._keep)
        self._factor = Factor(curvature)
        if not self._factor.positive:
            raise ValueError("The best fit is no maximum of the posterior.")

    def moved(self, like: Likelihood, key: Array) -> Float[np.ndarray, " par"]:
        """The best fit to other data, within the bounds of uniform priors.

        The means of Gaussian priors are drawn anew, too, since they were measured like the data.

        Parameters
        ----------
        like : likelihood of data that are the best fit and noise
        key : of jax.random, for the priors
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
    for the covariance, each parameter by the ratio of its standard deviations.

    Parameters
    ----------
    samples : of chains
    center : the best fit, in their order
    hessian : curvature of -log posterior there
    errors : of estimates from simulations
    """
    inverse = np.linalg.inv(hessian)
    if len(errors) > 4 * len(center):
        wanted = np.atleast_2d(np.cov(errors.T))
        turn = np.linalg.cholesky(wanted) @ np.linalg.inv(np.linalg.cholesky(inverse))
    else:
        turn = np.diag(errors.std(axis=0, ddof=1) / np.sqrt(np.diagonal(inverse)))
    return samples.with_chain(center + (samples.details["chain"] - center) @ turn.T)
