"""Gaussian priors on the amplitudes of components, independent between pixels.

With a covariance S of the amplitudes s, the estimate s = (M^T N^-1 M + S^-1)^-1 M^T N^-1 d is drawn
towards zero where the data say little. A prior is the same as one more band for each component that
has one: it shows that component alone, with unit response, has seen nothing, and its noise is S.
So chi^2 includes s^T S^-1 s, covariances those of the posterior, and all derivatives follow.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.compress import Noise, as_noise, bare
from jaxsky import Sky
from jaxsky.checks import Numeric
from jaxsky.io.stacks import Stack
from jaxsky.mesh import spread


class AmplitudePrior(eqx.Module):
    """Priors of some components: their names, and S in the place of the noise of a band each."""

    names: tuple[str, ...] = eqx.field(static=True)
    covariance: Noise

    def rows(self, components: Sequence[str]) -> Float[Array, "prior component"]:
        """Return the rows of the mixing matrix."""
        return jnp.asarray([[float(own == name) for own in components] for name in self.names])

    def joined(self, data: Numeric, noise: Noise) -> tuple[np.ndarray, Noise]:
        """Return data and noise of the bands, followed by those of the priors."""
        if isinstance(data, Stack) or spread(data):
            raise ValueError("Priors of amplitudes need maps that are in memory, on one device.")
        array = np.asarray(data)
        bands, stokes, npix = array.shape
        shape = bands + len(self.names), stokes, npix
        unseen = np.zeros((len(self.names), stokes, npix))
        return np.concatenate([array, unseen]), _joined(noise, self.covariance, shape)


def _joined(noise: Noise, prior: Noise, shape: tuple[int, int, int]) -> Noise:
    """Return the noise of bands and priors; where all bands are masked, priors are, too."""
    both, simple = (
        (noise, prior),
        all(n.separable and n.pixel_sigma is None for n in (noise, prior)),
    )
    if simple:
        return Noise(np.concatenate([np.asarray(one.sigma) for one in both]))
    masked = ~(np.asarray(noise.weights(slice(None))) > 0).any(axis=(0, 1))
    counts = len(noise.weights(slice(1))), len(prior.weights(slice(1)))
    if all(one.covariance is None for one in both):
        parts = [_sigma(one, (n, *shape[1:])) for one, n in zip(both, counts, strict=True)]
        return as_noise(np.where(masked, np.inf, np.concatenate(parts)), shape)
    parts = [_covariance(one, n, shape[-1]) for one, n in zip(both, counts, strict=True)]
    joined = np.concatenate(parts)
    for s in range(2):
        joined[:, s, s] = np.where(masked, np.inf, joined[:, s, s])
    return as_noise(joined, shape)


def _sigma(noise: Noise, shape: tuple[int, ...]) -> np.ndarray:
    factor = 1.0 if noise.pixel_sigma is None else np.asarray(noise.pixel_sigma)
    return np.broadcast_to(np.asarray(noise.sigma) * factor, shape)


def _covariance(noise: Noise, bands: int, npix: int) -> np.ndarray:
    if noise.covariance is not None:
        return np.asarray(noise.covariance)
    covariance = np.zeros((bands, 2, 2, npix))
    covariance[:, [0, 1], [0, 1]] = _sigma(noise, (bands, 2, npix)) ** 2
    return covariance


def amplitude_prior(
    prior: Mapping[str, Numeric], components: Sky, shape: tuple[int, int]
) -> AmplitudePrior | None:
    """Return the priors of components by name, after checking them; None if there are none.

    Parameters
    ----------
    prior : by name of the component, the standard deviation of its amplitude: a number, or a value
        for each Stokes parameter (stokes,), or maps (stokes, pix); or its covariance of Q and U
        (2, 2, pix). All in the unit of the amplitude, with mean 0.
    components : all components
    shape : (stokes, pix) of the data

    Raises
    ------
    KeyError : for a component that there is not
    TypeError, ValueError : for shapes that do not match, values that are not positive, and priors
        of I, Q, U next to a component that is not polarized
    """
    found: list[Any] = []
    for name, value in prior.items():
        if name not in components:
            known = ", ".join(components)
            raise KeyError(f"There is a prior for {name!r}; components are {known}.")
        array = bare(f"prior of {name}", value)
        array = np.broadcast_to(array, shape[:1]) if array.ndim == 0 else array
        try:
            found.append(as_noise(array[None], (1, *shape)))
        except ValueError as error:
            raise ValueError(f"The prior of {name!r} cannot be used: {error}") from None
    if not found:
        return None
    alone = [name for name in components if not components[name].polarized]
    if alone and shape[0] == 3:
        raise ValueError(
            f"Argument `prior` is of amplitudes of I, Q, U, but {alone[0]!r} is not polarized; "
            "leave one of them out, or separate I and Q, U one after the other."
        )
    joined = found[0]
    for count, more in enumerate(found[1:], start=2):
        joined = _joined(joined, more, (count, *shape))
    return AmplitudePrior(tuple(prior), joined)
