"""Priors on parameters, and the map from unbounded numbers to their range."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsky.checks import Numeric
from jaxsky.settings import Experiment

#: A value this close to the edge of a uniform prior, in units of its width, is at the edge.
EDGE = 1e-4


class Prior(eqx.Module):
    """Base class: a log-density up to a constant, and its share of a sum of squares."""

    def log_density(self, value: Numeric) -> Array:
        """Log-density up to a constant; -inf outside the range."""
        raise TypeError(f"{type(self).__name__} must define `log_density`.")


class Uniform(Prior):
    """Constant density in low <= value <= high.

    Raises
    ------
    ValueError
        If low is not below high.

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
    """Gaussian density with a mean and a standard deviation.

    Raises
    ------
    ValueError
        If the mean is not finite, or sigma not positive.

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


def log_prior(params: Mapping[str, Numeric], priors: Mapping[str, Prior]) -> Float[Array, ""]:
    """Sum of the log-densities of the parameters that have a prior."""
    return sum((p.log_density(params[name]) for name, p in priors.items()), jnp.zeros(()))


def priors_of(settings: Experiment, command: str) -> dict[str, Prior]:
    """Priors of the free parameters of a command that have one."""
    priors: dict[str, Prior] = {}
    for name, one in settings.free_in(command).items():
        if one.uniform:
            priors[name] = Uniform(*one.uniform)
        elif one.gaussian:
            priors[name] = Gaussian(*one.gaussian)
    return priors


def check_priors(priors: Mapping[str, Prior] | None, free: Iterable[str]) -> dict[str, Prior]:
    """The priors, once each is known to belong to a free parameter."""
    free = list(free)
    for name in priors or {}:
        if name not in free:
            raise KeyError(
                f"There is a prior for {name!r}, which is not free; free are {', '.join(free)}."
            )
    return dict(priors or {})


def prior_residuals(
    params: Mapping[str, Numeric], priors: Mapping[str, Prior]
) -> Float[Array, " gaussian"]:
    """(value - mean)/sigma of the Gaussian priors: their sum of squares is -2 log_prior."""
    rows = []
    for name, p in priors.items():
        if isinstance(p, Gaussian):
            rows.append(jnp.ravel((params[name] - p.mean) / p.sigma))
        elif not isinstance(p, Uniform):
            raise TypeError(
                f"Least squares takes uniform and Gaussian priors, not the {type(p).__name__} of "
                f"{name!r}."
            )
    return jnp.concatenate(rows) if rows else jnp.zeros(0)


def bounds(name: str, priors: Mapping[str, Prior]) -> tuple[float, float]:
    """Range of a parameter; infinite without a uniform prior."""
    prior = priors.get(name)
    return (prior.low, prior.high) if isinstance(prior, Uniform) else (-np.inf, np.inf)


def at_edge(value: Numeric, low: Numeric, high: Numeric) -> Bool[np.ndarray, "*shape"]:
    """Whether values lie at an edge of their range; never if that is infinite."""
    low, high = np.asarray(low), np.asarray(high)
    width = np.where(np.isfinite(low) & np.isfinite(high), high - low, 0.0)
    value = np.asarray(value)
    return np.minimum(np.abs(value - low), np.abs(value - high)) < EDGE * width


def from_unbounded(
    params: Mapping[str, Numeric], priors: Mapping[str, Prior]
) -> dict[str, Numeric]:
    """Parameters within their uniform priors from unbounded ones, low + (high-low)(1+sin u)/2.

    As in MINUIT: smooth, and flat at the edge, so that an optimum at the edge is a minimum in u.
    """
    result = dict(params)
    for name, p in priors.items():
        if isinstance(p, Uniform) and name in result:
            result[name] = p.low + (p.high - p.low) * (1 + jnp.sin(result[name])) / 2
    return result


def to_unbounded(params: Mapping[str, Numeric], priors: Mapping[str, Prior]) -> dict[str, Numeric]:
    """The inverse of `from_unbounded`."""
    result = dict(params)
    for name, p in priors.items():
        if isinstance(p, Uniform) and name in result:
            value = np.asarray(result[name])
            outside = ~((p.low < value) & (value < p.high))
            if outside.any():
                raise ValueError(
                    f"Start value {value[outside].flat[0]:g} of {name!r} is not inside its uniform "
                    f"prior {p.low:g} ... {p.high:g}."
                )
            result[name] = np.arcsin(2 * (value - p.low) / (p.high - p.low) - 1)
    return result
