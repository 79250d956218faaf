"""What a fit of spectral parameters returns."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fits.results import FitError


class SpectralFit(NamedTuple):
    """Spectral parameters, numbers or arrays with a value for each region.

    Attributes
    ----------
    free : names of the free parameters, in the order of `labels`
    best_fit : most probable values; NaN for regions without a pixel
    sigma : standard deviations of the estimates, likewise; NaN where they were not determined
    labels : name and region of each row of the covariance ("dust.beta_dust[3]")
    covariance : of the estimates, shape (par, par): H^-1 S H^-1, with H the curvature of
        -log posterior and S the covariance of its gradient; None for too many parameters. Where
        signals are well above the noise of each pixel, it is the inverse of H.
    hessian, fisher : H, and S, which is the Fisher matrix of the fitted amplitudes, both with the
        curvature of the priors; None for too many parameters
    chi2 : -2 ln L at the best fit, priors left out
    dof : number of data less that of amplitudes and parameters
    converged, message : whether the numbers can be relied on, and in words
    details : "solver" by name, its "steps", and "distance" to the optimum that remained, in
        standard deviations
    """

    free: tuple[str, ...]
    best_fit: dict[str, Any]
    sigma: dict[str, Any]
    labels: tuple[str, ...]
    covariance: Float[np.ndarray, "par par"] | None
    hessian: Float[np.ndarray, "par par"] | None
    fisher: Float[np.ndarray, "par par"] | None
    chi2: float
    dof: int
    converged: bool
    message: str
    details: dict[str, Any]

    def correlation(self, first: str, second: str) -> float:
        """Correlation coefficient of two entries of `labels`."""
        if self.covariance is None:
            raise ValueError("The covariance of so many parameters was not computed.")
        i, j = self.labels.index(first), self.labels.index(second)
        scale = np.sqrt(self.covariance[i, i] * self.covariance[j, j])
        return float(self.covariance[i, j] / scale)

    def checked(self, throw: bool) -> "SpectralFit":
        """Itself, if it converged or need not have."""
        if throw and not self.converged:
            raise FitError(self.message, self)  # type: ignore[arg-type]
        return self
