"""What noise in the data does to fitted spectral parameters, to first order."""

from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Array, Float

from fits.priors import Gaussian, Prior
from fits.separation.algebra import Factor
from fits.separation.likelihood import SpectralLikelihood
from fits.separation.problem import Problem, value_and_gradient
from jaxsky.types import Numeric

__all__ = ["Response"]


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
        like: SpectralLikelihood,
        params: Mapping[str, Numeric],
        priors: Mapping[str, Prior] | None = None,
    ) -> None:
        self._problem = problem = Problem(like, priors or {})
        self.theta = np.array(like.flat(like.check(params)))
        self._keep = np.flatnonzero(problem.present & ~problem.edges(self.theta))
        curvature = problem.curvature(self.theta, problem.exact(self.theta), self._keep)
        self._factor = Factor(curvature)
        if not self._factor.positive:
            raise ValueError("The best fit is no maximum of the posterior.")

    def moved(self, like: SpectralLikelihood, key: Array) -> Float[np.ndarray, " par"]:
        """The best fit to other data, within the bounds of uniform priors.

        The means of Gaussian priors are drawn anew, too, since they were measured like the data.

        Parameters
        ----------
        like : likelihood of data that are the best fit and noise
        key : of jax.random, for the priors
        """
        gradient = np.array(value_and_gradient(like, self.theta)[1])
        draws = np.asarray(jax.random.normal(key, gradient.shape))
        for prior, where in self._problem.priors:
            assert isinstance(prior, Gaussian)  # the only one that is not a bound
            gradient += np.where(where, draws / prior.sigma, 0.0)
        theta = self.theta.copy()
        theta[self._keep] -= self._factor.solve(gradient[self._keep])
        return np.clip(theta, self._problem.low, self._problem.high)
