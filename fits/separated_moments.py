"""Separation with moments, whose prior the data determine: empirical Bayes.

Where the parameters of a component with amplitudes a = (Q, U) deviate by delta from those of its
law, its moment (`jaxsky.moments`) has the amplitudes a delta: the same delta in Q and U. With a
scatter sigma of delta, their covariance in a pixel is S = sigma^2 <a a^T>. The amplitude a is known
well from a separation without moments, and <a a^T> is a a^T plus the covariance of its errors. What
is unknown is one number for each moment, the scatter, and the parameters of the laws about which
they expand. The data determine both by their probability with all amplitudes integrated over,

    -2 ln P(d) = min_s chi^2(s) + ln det (M^T N^-1 M + S^-1) + ln det S - ln det M_0^T N^-1 M_0,

with chi^2 that includes s^T S^-1 s, and M_0 the components without a prior: the last term makes
it independent of the frequency at which their amplitudes are given.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from fits.compress import Noise, as_noise, bare, pixel_rows
from fits.mixing import named_bands
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.separated_maps import (
    ComponentMaps,
    Separated,
    component_maps,
    separate,
    sky_of,
    white_noise,
)
from fits.systems import Pixels
from jaxsky import Bandpass, Component, Sky, get_parameters
from jaxsky.checks import Numeric, check_shape
from jaxsky.components import Moment
from jaxsky.io.stacks import ranges
from jaxsky.observation import Instrument

#: Scale of parameters and start of their scatter, as a share of values above 1.
SHARE = 0.05
#: The scatter is looked for within this factor of its start.
RANGE = 1e3
#: Step of finite differences of the gradient, in scales of parameters.
STEP = 1e-3
#: Pixels integrated over at once, few enough for the cache.
AT_ONCE = 512


class MomentSeparation(NamedTuple):
    """Result of `separate_moments`.

    `params` are the parameters of the laws by name, and `scatter` that of each moment by its name:
    of a parameter, or for higher moments of the product of deviations in the amplitude. `sigma` are
    the standard deviations of the former, and of the logarithms of the latter. `maps` are the
    components with their errors, and `prior` the covariances (2, 2, pix) of the moments, as
    for `spectral_likelihood`. `base` is the separation without moments.
    """

    params: dict[str, float]
    scatter: dict[str, float]
    sigma: dict[str, float]
    maps: ComponentMaps
    prior: dict[str, Float[np.ndarray, "2 2 pix"]]
    base: Separated


def separate_moments(
    components: Mapping[str, Component],
    instrument: Instrument | Mapping[str, Bandpass] | Sequence[Bandpass],
    data: Numeric,
    free: Sequence[str] | Mapping[str, Numeric] | None = None,
    *,
    noise: Noise | Numeric | None = None,
    unit: str = "uK_CMB",
    scatter: Mapping[str, float] | None = None,
) -> MomentSeparation:
    """Separate components and their moments, whose scatter is fitted with the laws.

    Parameters
    ----------
    components : components by name, among them moments (`jaxsky.moments`)
    instrument, data, free, noise, unit : as for `fits.separate`, with Stokes Q and U
    scatter : known ones by name of the moment; the others are estimated

    Raises
    ------
    KeyError : for a scatter of something else than a moment
    TypeError, ValueError : without moments, for Stokes parameters that are not Q and U, and for
        what `separate` refuses
    """
    data, known = bare("data", data), dict(scatter or {})
    sky = sky_of(components, 2)
    moments = {name: one for name, one in sky.given.items() if isinstance(one, Moment)}
    names = list(moments)
    _check(names, known, data)
    noise = white_noise(instrument, data, unit) if noise is None else noise
    noise = as_noise(noise, data.shape)
    bands = instrument.bands() if isinstance(instrument, Instrument) else named_bands(instrument)
    alone = {name: one for name, one in sky.given.items() if name not in names}
    base = separate(alone, bands, data, free, noise=noise, unit=unit)
    start = {name: known.get(name) or _start(sky, moments[name]) for name in names}

    def prior_of(scatter):
        return {name: moment_prior(base.maps, moments[name].of, scatter[name]) for name in names}

    prior = prior_of(start)
    like = spectral_likelihood(sky, bands, data, noise, base.fit.best_fit, unit=unit, prior=prior)
    moving = [name for name in names if name not in known]
    params, logs, sigma = _fitted(like, data, noise, moving)
    start |= {name: float(start[name] * np.exp(x)) for name, x in logs.items()}
    prior = prior_of(start)
    like = spectral_likelihood(sky, bands, data, noise, params, unit=unit, prior=prior)
    maps = component_maps(like, params, data, noise)
    return MomentSeparation(params, start, sigma, maps, prior, base)


def _check(names: Sequence[str], known: Mapping[str, float], data: np.ndarray) -> None:
    if not names:
        raise ValueError("Argument `components` has no moments; `jaxsky.moments` makes them.")
    for name, value in known.items():
        if name not in names:
            raise KeyError(f"There is a scatter for {name!r}; moments are {', '.join(names)}.")
        if not value > 0:
            raise ValueError(f"The scatter of {name!r} must be positive, but is {value:g}.")
    good = data.ndim == 3 and data.shape[1] == 2
    check_shape("data", data, good, "have shape (band, stokes, pix) with Stokes Q, U")


def moment_prior(maps: ComponentMaps, name: str, scatter: float) -> Float[np.ndarray, "2 2 pix"]:
    """Return the covariance of Q and U of a moment, the prior of its amplitudes.

    It is scatter^2 (a a^T + C) in each pixel, infinite where masked, from maps of Q and U of the
    component `name` with their errors: amplitudes a and the variances C.
    """
    amplitude = np.asarray(maps.map(name))
    good = len(amplitude) == 2
    check_shape("maps", np.asarray(maps.amplitude), good, "have Stokes Q, U")
    squares = amplitude[:, None] * amplitude
    errors = np.broadcast_to(np.asarray(maps.sigma(name)) ** 2, amplitude.shape)
    masked = ~np.isfinite(squares).all(axis=(0, 1))
    for s in range(2):
        squares[s, s] = np.where(masked, np.inf, squares[s, s] + errors[s])
    squares[0, 1] = squares[1, 0] = np.where(masked, 0.0, squares[0, 1])
    return scatter**2 * squares


def _scale(value: Numeric) -> float:
    return SHARE * max(abs(float(np.mean(value))), 1.0)


def _start(sky: Sky, moment: Moment) -> float:
    """Return the start of the scatter of a moment."""
    values = get_parameters(sky, [f"{moment.of}.{own}" for own in moment.parameters])
    return float(np.prod([_scale(values[f"{moment.of}.{own}"]) for own in moment.parameters]))


class _Integral(NamedTuple):
    """chi^2 and ln det of the matrix of amplitudes, summed over pixels, and derivatives.

    `slope` is the derivative of both together in the mixing matrix, and the sum of `rows` over some
    rows that in the logarithm of a common factor of their weights, for rows that have no covariance
    with others.
    """

    chi2: float
    determinant: float
    slope: Float[np.ndarray, "row unknown"]
    rows: Float[np.ndarray, " row"]


def _integral(matrix: Float[np.ndarray, "row unknown"], pixels: Pixels) -> _Integral:
    """Integrate over the amplitudes of all pixels, some at a time; without data chi^2 is 0.

    With G = M^T W M, r the residuals and s the amplitudes, d chi^2 = -2 r^T W dM s and
    d ln det G = 2 tr G^-1 M^T W dM.
    """
    half = len(matrix) // 2
    swapped = np.concatenate([matrix[half:], matrix[:half]])
    total: list[Any] = [0.0, 0.0, np.zeros(matrix.shape), np.zeros(len(matrix))]
    for part in ranges(pixels.data.shape[-1], AT_ONCE):
        data = np.asarray(pixels.data[0][:, part]).T
        weights = np.asarray(pixels.weights[0][:, part]).T
        weighted = weights[..., None] * matrix
        if pixels.cross is not None:
            cross = np.tile(np.asarray(pixels.cross[0][:, part]).T, 2)
            weighted += cross[..., None] * swapped
        inverse = np.linalg.inv(gram := matrix.T @ weighted)
        solved = weighted @ inverse
        amplitudes = np.einsum("pru,pr->pu", solved, data)
        rest = data - amplitudes @ matrix.T
        # W r, with W M s taken from W M.
        pulled = weights * data - np.einsum("pru,pu->pr", weighted, amplitudes)
        if pixels.cross is not None:
            pulled += cross * np.roll(data, half, axis=1)
        squares = (rest * pulled).sum(axis=0)
        total[0] += squares.sum()
        total[1] += np.linalg.slogdet(gram)[1].sum()
        total[2] += 2 * (solved.sum(axis=0) - pulled.T @ amplitudes)
        total[3] += squares + (solved.sum(axis=0) * matrix).sum(axis=1)
    return _Integral(*total)


@jax.jit
def _matrix(theta: Float[Array, " par"], like: SpectralLikelihood) -> tuple[Array, Array]:
    """Return the mixing matrix, and its derivative in each parameter."""

    def one(values):
        return like.matrices(values[like.index])[0][0]

    return one(theta), jnp.moveaxis(jax.jacfwd(one)(theta), -1, 0)


def _fitted(
    like: SpectralLikelihood, data: np.ndarray, noise: Noise, moving: Sequence[str]
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """Return the parameters, and logarithms of factors on the scatter of moments, that fit best.

    The third are their standard deviations.
    """
    assert like.prior is not None
    rows, names = (*like.mixing.names, *like.prior.names), tuple(like.mixing.sky)
    apart = np.flatnonzero([name not in like.prior.names for name in names] * 2)
    used = (np.broadcast_to(noise.weights(slice(None)), data.shape) > 0).any(axis=(0, 1))
    (layout,) = like.layout
    pixels = pixel_rows(*like.prior.joined(data, noise), layout, np.flatnonzero(used), None)
    number, at = int(used.sum()), [rows.index(name) for name in moving]
    weight = np.broadcast_to(pixels.weights, pixels.data.shape)
    bare_like, theta = like.without_data(), np.asarray(like.flat({}))
    scale = np.array([_scale(value) for value in theta])

    def value(x):
        """Return -2 ln P(d) per pixel, and its gradient."""
        matrix, moved = map(np.asarray, _matrix(theta + scale * x[: theta.size], bare_like))
        factor = np.ones(len(rows))
        factor[at] = np.exp(-2 * x[theta.size :])
        weights: Any = weight * np.tile(factor, 2)[:, None]
        cross = None if pixels.cross is None else pixels.cross * factor[:, None]
        scaled = Pixels(pixels.data, weights, cross)
        unseen = scaled._replace(data=0.0 * pixels.data)
        whole, fewer = _integral(matrix, scaled), _integral(matrix[:, apart], unseen)
        slope = whole.slope
        slope[:, apart] -= fewer.slope
        first = scale * np.einsum("ru,iru->i", slope, moved)
        second = 4 * number - 2 * whole.rows.reshape(2, -1).sum(axis=0)[at]
        total = whole.chi2 + whole.determinant - fewer.determinant
        return (total + 4 * number * x[theta.size :].sum()) / number, np.append(
            first, second
        ) / number

    limits = [(None, None)] * theta.size + [(-np.log(RANGE), np.log(RANGE))] * len(moving)
    start = np.zeros(len(limits))
    found = scipy.optimize.minimize(
        value, start, jac=True, method="L-BFGS-B", bounds=limits, options={"ftol": 1e-9}
    )
    steps = STEP * np.eye(start.size)
    slopes = [(value(found.x + step)[1] - value(found.x - step)[1]) / (2 * STEP) for step in steps]
    curvature = number / 2 * np.array(slopes).reshape(start.size, start.size)
    sigma = np.sqrt(np.diagonal(np.linalg.inv((curvature + curvature.T) / 2)))
    best = theta + scale * found.x[: theta.size]
    params = {name: float(v) for name, v in like.named(jnp.asarray(best)).items()}
    errors = np.concatenate([scale, np.ones(len(moving))]) * sigma
    sigmas = dict(zip((*like.free, *moving), map(float, errors), strict=True))
    return params, dict(zip(moving, map(float, found.x[theta.size :]), strict=True)), sigmas
