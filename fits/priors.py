"""Priors on parameters."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsky.checks import Numeric
from jaxsky.settings import Experiment


class Prior(eqx.Module):
    """Base class of priors on a parameter."""

    def log_density(self, value: Numeric) -> Array:
        """Return the log-density up to a constant; -inf outside the range."""
        raise TypeError(f"{type(self).__name__} must define `log_density`.")


class Uniform(Prior):
    """Constant density in low <= value <= high; ValueError if low is not below high.

    Examples
    --------
    >>> float(Uniform(1.0, 2.0).log_density(1.5))
    0.0
    """

    low: float
    high: float

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = float(low), float(high)
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise ValueError(f"A uniform prior needs finite low < high, not {low} and {high}.")

    def log_density(self, value):
        return jnp.where((value >= self.low) & (value <= self.high), 0.0, -jnp.inf)


class Gaussian(Prior):
    """Gaussian density; ValueError if the mean is not finite, or sigma not positive.

    Examples
    --------
    >>> float(Gaussian(1.0, 0.5).log_density(2.0))
    -2.0
    """

    mean: float
    sigma: float

    def __init__(self, mean: float, sigma: float) -> None:
        self.mean, self.sigma = float(mean), float(sigma)
        if not (np.isfinite([self.mean, self.sigma]).all() and self.sigma > 0):
            raise ValueError(
                f"A Gaussian prior needs a finite mean and positive sigma, not {mean} and {sigma}."
            )

    def log_density(self, value):
        return -0.5 * ((value - self.mean) / self.sigma) ** 2


def priors_of(settings: Experiment, command: str) -> dict[str, Prior]:
    """Return the priors of the free parameters of a command."""
    priors: dict[str, Prior] = {}
    for name, one in settings.free_in(command).items():
        if one.uniform:
            priors[name] = Uniform(*one.uniform)
        elif one.gaussian:
            priors[name] = Gaussian(*one.gaussian)
    return priors


def check_priors(priors: Mapping[str, Prior] | None, free: Iterable[str]) -> dict[str, Prior]:
    """Return the priors, after checking that each belongs to a free parameter."""
    priors, free = dict(priors or {}), list(free)
    for name in priors:
        if name not in free:
            raise KeyError(
                f"There is a prior for {name!r}, which is not free; free are {', '.join(free)}."
            )
    return priors
