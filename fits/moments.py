"""Priors of moments, from the scatter of spectral parameters: empirical Bayes.

Where the parameters of a component with amplitudes a = (Q, U) deviate by delta from those of its
law, its moment has the amplitudes a delta: the same delta in Q and U. With a scatter sigma of
delta, the covariance of these in a pixel is sigma^2 <a a^T>. The amplitude a is known well from a
separation without moments, and <a a^T> is a a^T plus the covariance of its errors. What is unknown
is one number for each moment, the scatter, which the data determine by their marginal likelihood

    -2 ln P(d) = min_s chi^2(s) + ln det (M^T N^-1 M + S^-1) + ln det S + const,

with chi^2 that includes s^T S^-1 s.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from fits import systems
from fits.compress import Noise, as_noise, bare, pixel_rows
from fits.mixing import named_bands
from fits.profile_likelihood import matrices_at, spectral_likelihood
from fits.separated_maps import Separated, separate, sky_of, white_noise
from fits.systems import Pixels
from jaxsky import Bandpass, Component, Moment, Sky, get_parameters, set_parameters
from jaxsky.checks import Numeric, check_shape
from jaxsky.observation import Instrument

#: Start of the scatter of each parameter, as a share of its value.
SHARE = 0.05
#: The scatter is looked for within this factor of the start.
RANGE = 1e3


class MomentPrior(NamedTuple):
    """Result of `moment_prior`, by name of the moment.

    `scatter` is that of the parameter (for higher moments, of the product of deviations in the
    amplitude), and `covariance` that of Q and U in each pixel, for `separate` and
    `spectral_likelihood`. `base` is the separation without moments.
    """

    scatter: dict[str, float]
    covariance: dict[str, Float[np.ndarray, "2 2 pix"]]
    base: Separated


def moment_prior(
    components: Mapping[str, Component],
    instrument: Instrument | Mapping[str, Bandpass] | Sequence[Bandpass],
    data: Numeric,
    free: Sequence[str] | Mapping[str, Numeric] | None = None,
    *,
    noise: Noise | Numeric | None = None,
    unit: str = "uK_CMB",
    scatter: Mapping[str, float] | None = None,
) -> MomentPrior:
    """Return the Gaussian prior of the moments among components, with the scatter that fits best.

    Parameters
    ----------
    components : components by name, among them moments (`jaxsky.moments`)
    instrument, data, free, noise, unit : as for `separate`, with Stokes Q and U
    scatter : known ones by name of the moment; the others are estimated

    Raises
    ------
    KeyError : for a scatter of something else than a moment
    TypeError, ValueError : without moments, for Stokes parameters that are not Q and U, and for
        what `separate` refuses
    """
    data, known = bare("data", data), dict(scatter or {})
    sky = sky_of(components, 2)
    names = [name for name, one in sky.components.items() if isinstance(one, Moment)]
    if not names:
        raise ValueError("Argument `components` has no moments; `jaxsky.moments` makes them.")
    for name in known:
        if name not in names:
            moments = ", ".join(names)
            raise KeyError(f"There is a scatter for {name!r}; moments are {moments}.")
    check_shape("data", data, data.ndim == 3 and data.shape[1] == 2, "have Stokes Q and U")
    noise = white_noise(instrument, data, unit) if noise is None else noise
    noise = as_noise(noise, data.shape)
    bands = instrument.bands() if isinstance(instrument, Instrument) else named_bands(instrument)
    alone = {name: one for name, one in sky.given.items() if name not in names}
    base = separate(alone, bands, data, free, noise=noise, unit=unit)
    shape = {name: _squares(base, sky[name].of, data.shape[-1]) for name in names}
    start = {name: known.get(name) or _start(sky, sky[name]) for name in names}
    moving = [name for name in names if name not in known]
    if moving:
        at = set_parameters(sky, base.fit.best_fit)
        guess = {name: size**2 * shape[name] for name, size in start.items()}
        start |= _fitted(at, bands, data, noise, unit, guess, start, moving)
    return MomentPrior(start, {n: start[n] ** 2 * shape[n] for n in names}, base)


def _squares(base: Separated, name: str, npix: int) -> Float[np.ndarray, "2 2 pix"]:
    """Return <a a^T> of a component in each pixel; infinite where it is masked."""
    maps = np.asarray(base.maps.map(name))
    squares = maps[:, None] * maps
    errors = np.broadcast_to(np.asarray(base.maps.sigma(name)) ** 2, (2, npix))
    for s in range(2):
        squares[s, s] += errors[s]
    masked = ~np.isfinite(squares).all(axis=(0, 1))
    return np.where(masked, np.eye(2)[..., None] * np.inf, squares)


def _start(sky: Sky, moment: Moment) -> float:
    values = get_parameters(sky, [f"{moment.of}.{name}" for name in moment.parameters])
    return float(np.prod([SHARE * max(abs(float(np.mean(v))), 1.0) for v in values.values()]))


@partial(jax.jit, static_argnames=("moving", "count"))
@partial(jax.value_and_grad, argnums=0)
def _evidence(
    logs: Float[Array, " moving"],
    matrix: Float[Array, "row unknown"],
    pixels: Pixels,
    *,
    moving: tuple[int, ...],
    count: int,
) -> Float[Array, ""]:
    """Return -2 ln P(d) per pixel for logarithms of the scatter, over those in the weights.

    `moving` are the positions of these among `count` rows of each Stokes parameter.
    """
    factor = jnp.ones(count).at[np.array(moving)].set(jnp.exp(-2 * logs))[:, None]
    cross = None if pixels.cross is None else pixels.cross * factor
    scaled = Pixels(pixels.data, pixels.weights * jnp.tile(factor, (2, 1)), cross)
    npix = pixels.data.shape[-1]
    total = systems.least_chi2(matrix, scaled) + systems.log_determinant(matrix, scaled)
    return total / npix + 4 * jnp.sum(logs)


def _fitted(sky, bands, data, noise, unit, prior, start, moving) -> dict[str, float]:
    """Return the scatter of moments that makes the data most probable."""
    used = (np.broadcast_to(noise.weights(slice(None)), data.shape) > 0).any(axis=(0, 1))
    seen, noise = data[..., used], noise.at(used)
    prior = {name: covariance[..., used] for name, covariance in prior.items()}
    like = spectral_likelihood(sky, bands, seen, noise, {}, unit=unit, prior=prior)
    assert like.prior is not None
    (layout,), (matrix,) = like.layout, matrices_at(like, {})
    pixels = pixel_rows(*like.prior.joined(seen, noise), layout, slice(None), None)
    pixels = jax.tree.map(jnp.asarray, pixels)
    rows = (*bands, *like.prior.names)
    at = {"moving": tuple(map(rows.index, moving)), "count": len(rows)}

    def value(logs):
        found, slope = _evidence(jnp.asarray(logs), matrix[0], pixels, **at)
        return float(found), np.asarray(slope)

    limit = np.log(RANGE)
    found = scipy.optimize.minimize(
        value,
        np.zeros(len(moving)),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-limit, limit)] * len(moving),
        options={"ftol": 1e-12},
    )
    return {n: float(start[n] * np.exp(x)) for n, x in zip(moving, found.x, strict=True)}
