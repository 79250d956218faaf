"""What fits return, as values: numbers by parameter name, and how good they are."""

from typing import Any, NamedTuple

import numpy as np

__all__ = ["FitError", "FitResult"]


class FitError(RuntimeError):
    """A fit that did not reach what its numbers need; carries the result as `.result`."""

    def __init__(self, message: str, result: "FitResult") -> None:
        super().__init__(message)
        self.result = result


class FitResult(NamedTuple):
    """Parameters of a fit by one method.

    Attributes
    ----------
    method : "gradient", "grid", "mcmc" or "nuts"
    free : names of the free parameters, in the order of the covariance
    best_fit : most probable values
    interval_68 : (low, high) of the central 68.27 % of each marginal distribution
    covariance : of the parameters, shape (par, par)
    chi2 : smallest value of -2 log L, priors left out; for the exact likelihood that of the
        template amplitudes
    converged, message : whether the numbers can be relied on, and in words
    details : what only this method has
    """

    method: str
    free: tuple[str, ...]
    best_fit: dict[str, float]
    interval_68: dict[str, tuple[float, float]]
    covariance: np.ndarray
    chi2: float
    converged: bool
    message: str
    details: dict[str, Any]

    def sigma(self, name: str) -> float:
        """Standard deviation of a parameter."""
        i = self.free.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def checked(self, throw: bool) -> "FitResult":
        """Itself, if it converged or need not have.

        Raises
        ------
        FitError
            If it did not converge and `throw` is true.
        """
        if throw and not self.converged:
            raise FitError(self.message, self)
        return self
