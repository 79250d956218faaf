"""What fits return, as values: numbers by parameter name, and how good they are."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsky.checks import Numeric

#: A chi^2 above so many times the degrees of freedom, taken as `FEW` if they are fewer, is that of
#: no fit. Real skies, with laws that vary, errors that are too small and bright planes, have
#: some ten for each; a few missing values read as data have hundreds and more.
ASTRONOMICAL, FEW = 100.0, 100
#: A parameter, or its error, that is so many times its start (1 if that is smaller) is lost.
LOST = 50.0


def misfit(chi2: float, dof: int, expected: float = 1.0) -> str | None:
    """What to say of a chi^2 that no statistics, but only wrong inputs explain; None if it is not.

    Parameters
    ----------
    chi2, dof : of a fit
    expected : chi2 per degree of freedom of the right model, if chi2 leaves out what is known
    """
    if chi2 <= ASTRONOMICAL * expected * max(dof, FEW):
        return None
    return (
        f"chi2 is {chi2:.3g} for {dof} degrees of freedom, so the model does not describe the "
        "data: look for missing values that are read as data, a wrong unit, or noise that is "
        "far too small."
    )


def astray(
    name: str,
    value: Float[np.ndarray, "*shape"],
    sigma: Float[np.ndarray, "*shape"],
    start: Float[np.ndarray, "*shape"],
) -> Bool[np.ndarray, "*shape"]:
    """Whether the data do not hold a parameter: it ran away, or its error is absurd.

    Parameters
    ----------
    name : offsets, which have units of maps, are never astray
    value, sigma, start : best fit, standard deviation, start
    """
    limit = np.inf if name.startswith("offset.") else LOST * np.maximum(np.abs(start), 1.0)
    return (np.abs(value) > limit) | (np.asarray(sigma) > limit)


def help_by_prior(names: tuple[str, ...]) -> str:
    """The end of a sentence on parameters that the data leave open."""
    return f"a Gaussian prior on {' or '.join(names)} (mean, standard deviation) would help"


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

    def judged(
        self, chi2: float, dof: int, start: Mapping[str, Numeric], expected: float = 1.0
    ) -> "FitResult":
        """Itself, not converged if parameters ran away, or chi^2 is that of no fit.

        Parameters
        ----------
        chi2, dof : of the data, or of what the likelihood compares
        start : start values by name
        expected : see `misfit`
        """
        failures = [] if self.converged else [self.message]
        sigma = np.sqrt(np.diagonal(self.covariance))
        for name, error in zip(self.free, sigma, strict=True):
            value, begun = self.best_fit[name], float(start[name])
            if self.converged and astray(name, np.array(value), error, np.array(begun)):
                failures.append(
                    f"The data do not constrain {name!r}: from {begun:g} it went to "
                    f"{value:.3g} +- {error:.2g}; {help_by_prior((name,))}."
                )
        if (wrong := misfit(chi2, dof, expected)) and wrong not in self.message:
            failures.insert(0, wrong)
        if not failures:
            return self
        return self._replace(converged=False, message=" ".join(failures))

    def checked(self, throw: bool) -> "FitResult":
        """Itself, if it converged or need not have."""
        if throw and not self.converged:
            raise FitError(self.message, self)
        return self
