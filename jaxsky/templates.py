"""Make templates from published maps as in the paper, and components with published laws.

The paper's synchrotron is Commander's Q and U at 30 GHz, taken from 40 arcmin at nside 256 to
1 degree at nside 512; its dust is Commander's at 353 GHz, unchanged at 10 arcmin. Its dust index is
the map at 7.5 arcmin, smoothed to 3 degrees to reduce noise; its synchrotron index the map of
Giardino et al. (2002) at 10 degrees and radio frequencies, steepened like the GALPROP spectrum from
there to 20-30 GHz. `AME.from_dust_angles` makes AME polarized along the dust, and `correlation`
compares the two as the paper does.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxsky.checks import (
    Numeric,
    as_array,
    check_finite,
    check_nside,
    check_positive,
    check_shape,
    is_concrete,
)
from jaxsky.components import Component, component_class
from jaxsky.harmonics import beam_ratio, resample, shortened
from jaxsky.public import packaged

#: First and last frequency of an interval [GHz].
Interval: TypeAlias = tuple[ArrayLike, ArrayLike] | Float[Array, "2"]
#: Intervals of the paper's steepening [GHz]: that of Giardino's map, and that of the sky model.
LOW, HIGH = (0.49, 2.12), (20.0, 30.0)
#: Jacobi steps per analysis, more than elsewhere as templates are made once. Each gains a factor
#: of 20; with these a band-limited map is right to 4e-7 of its rms in every pixel.
ITERATIONS = 4
#: Where a smoothed mask is below this, used pixels are too far away: one FWHM into a hole.
LEAST_WEIGHT = 0.01
#: Variance without a block that counts as zero, in rounding errors of that of all pixels.
ROUNDINGS = 1e3


def _healpix(name: str, values: ArrayLike, rows: tuple[int, ...] = ()) -> tuple[Array, int]:
    """Check a map, or several in an allowed number of rows, and return it with its nside."""
    array = as_array(name, values)
    npix = array.shape[-1] if array.ndim else 0
    nside = math.isqrt(npix // 12)
    valid = nside > 1 and 12 * nside**2 == npix and healpy.isnsideok(nside, nest=True)
    good = valid and (array.ndim == 2 and len(array) in rows if rows else array.ndim == 1)
    form = f"({' or '.join(map(str, rows))}, pix)" if rows else "(pix,)"
    pixels = "12 nside^2 pixels, nside 2, 4, 8, ..."
    check_shape(name, array, good, f"have shape {form} with {pixels}")
    return array, nside


def polarization_template(
    maps: ArrayLike, own_fwhm: Numeric, fwhm: Numeric, nside: int
) -> Float[Array, "stokes pix"]:
    """Change the resolution of Q, U or I, Q, U without pixel artefacts.

    The paper upgrades its synchrotron from nside 256 to 512 pixel by pixel and then smooths it from
    `own_fwhm`, 40 arcmin, to `fwhm`, 60. Here both are one transform, up to 2 nside of the coarser
    resolution. Differentiable in the maps, shape (stokes, pix), and the widths [arcmin].
    """
    maps, nside_in = _healpix("maps", maps, rows=(2, 3))
    check_finite("maps", maps)
    check_nside("nside", nside)
    window = beam_ratio(fwhm, own_fwhm, 2 * min(nside_in, nside), "the template")
    return resample(maps, shortened(window), nside, ITERATIONS)


def dust_index(
    beta: ArrayLike,
    own_fwhm: Numeric,
    fwhm: Numeric,
    nside: int,
    mask: Bool[np.ndarray, " pix"] | None = None,
) -> Float[Array, " pix"]:
    """Smooth a noisy map of spectral indices, as the paper does beta_dust from 7.5' to 3 degrees.

    With a mask, True in used pixels, the result is their mean under the beam, smooth(mask beta) /
    smooth(mask). It is sampled at the new pixel centres, not band-limited to what the new pixels
    resolve. Widths are in arcmin.
    """
    beta, nside_in = _healpix("beta", beta)
    check_nside("nside", nside)
    if mask is not None:
        good = np.shape(mask) == beta.shape
        check_shape("mask", np.asarray(mask), good, f"have shape {beta.shape} like `beta`")
        beta = jnp.where(mask, beta, 0.0)
    check_finite("beta", beta)

    window = shortened(beam_ratio(fwhm, own_fwhm, 2 * nside_in, "the map of indices"))
    smoothed = resample(beta[None], window, nside, ITERATIONS)[0]
    if mask is None:
        return smoothed
    weight = resample(jnp.asarray(mask, beta.dtype)[None], window, nside, ITERATIONS)[0]
    if is_concrete(weight) and (empty := int(jnp.sum(weight < LEAST_WEIGHT))):
        raise ValueError(
            f"Argument `mask` leaves {empty} of {weight.size} pixels of the result without "
            f"used pixels within a beam of {float(fwhm):g} arcmin."
        )
    return smoothed / weight


def steepening(
    nu: ArrayLike, temperature: ArrayLike, low: Interval = LOW, high: Interval = HIGH
) -> Float[Array, ""]:
    """Return how much steeper a spectrum T ~ nu^-beta is in one frequency interval than in another.

    beta = -ln(T_2/T_1) / ln(nu_2/nu_1) between the ends of each interval, with ln T interpolated
    against ln nu; the result is beta of `high` minus beta of `low`. The paper finds 0.13 for
    GALPROP's synchrotron. Frequencies in GHz, strictly increasing; differentiable in all arguments.
    """
    nu, temperature = as_array("nu", nu), as_array("temperature", temperature)
    if nu.ndim != 1 or nu.shape != temperature.shape or nu.size < 2:
        raise ValueError(
            "Arguments `nu` and `temperature` must have one shape (sample,), two samples or more, "
            f"but have shapes {nu.shape} and {temperature.shape}."
        )
    check_positive("nu", nu)
    check_positive("temperature", temperature)
    if is_concrete(nu) and not bool(jnp.all(jnp.diff(nu) > 0)):
        raise ValueError("Argument `nu` must increase strictly from sample to sample.")

    def index(name: str, interval: Interval) -> Array:
        ends = as_array(name, interval)
        check_shape(name, ends, ends.shape == (2,), "be two frequencies [GHz]")
        if is_concrete(ends) and not 0 < ends[0] < ends[1]:
            raise ValueError(
                f"Argument `{name}` must be two increasing frequencies [GHz], "
                f"but is {ends[0]:g}, {ends[1]:g}."
            )
        if is_concrete(nu) and is_concrete(ends) and not nu[0] <= ends[0] < ends[1] <= nu[-1]:
            raise ValueError(
                f"Argument `{name}` reaches from {ends[0]:g} to {ends[1]:g} GHz, "
                f"but the spectrum only from {nu[0]:g} to {nu[-1]:g} GHz."
            )
        ends = jnp.log(ends)
        first, last = jnp.interp(ends, jnp.log(nu), jnp.log(temperature))
        return -(last - first) / (ends[1] - ends[0])

    return index("high", high) - index("low", low)


class Correlation(NamedTuple):
    """Pearson's correlation coefficient and its jackknife error."""

    r: Float[Array, ""]
    error: Float[Array, ""]


def correlation(x: ArrayLike, y: ArrayLike, blocks: ArrayLike | None = None) -> Correlation:
    """Return Pearson's correlation of two maps, with its error from a jackknife over blocks.

    Leaving out one of B blocks at a time gives the error [(B - 1)/B sum_b (r_b - mean r)^2]^(1/2).
    Differentiable in the maps, shape (pix,). `blocks` labels the block of each pixel; by default
    each pixel is its own. That treats neighbours as independent, which they are not on a smooth
    sky: blocks wider than its structures (`fits.superpixels`) give the realistic, larger error.
    """
    x, y = as_array("x", x), as_array("y", y)
    labels = np.arange(x.size) if blocks is None else np.asarray(blocks)
    if x.ndim != 1 or not x.shape == y.shape == labels.shape:
        raise ValueError(
            "Arguments `x`, `y` and `blocks` must have one shape (pix,), "
            f"but have shapes {x.shape}, {y.shape} and {labels.shape}."
        )
    check_finite("x", x)
    check_finite("y", y)
    names, labels = np.unique(labels, return_inverse=True)
    if names.size < 2:
        raise ValueError(f"A jackknife needs at least two blocks, but has {names.size}.")
    r, error, least = _jackknife(x, y, labels, names.size)
    if is_concrete(least) and not bool(least > ROUNDINGS * jnp.finfo(least.dtype).eps):
        raise ValueError("Arguments `x` and `y` must vary, also without any one of the blocks.")
    return Correlation(r, error)


@partial(jax.jit, static_argnames="number")
def _jackknife(x: Array, y: Array, labels: Array, number: int) -> tuple[Array, Array, Array]:
    """Return correlation, its error, and the least relative variance left without a block."""
    # A constant map minus its first value is exactly zero; minus its mean it may not be.
    x, y = x - x[0], y - y[0]
    x, y = x - x.mean(), y - y.mean()
    terms = jnp.stack([jnp.ones_like(x), x, y, x * x, y * y, x * y], axis=-1)
    sums = jax.ops.segment_sum(terms, labels, number)

    def moments(sums):
        n, x, y, xx, yy, xy = jnp.moveaxis(sums, -1, 0)
        return xx - x**2 / n, yy - y**2 / n, xy - x * y / n

    def coefficient(xx, yy, xy):
        return xy / jnp.sqrt(xx * yy)

    total = sums.sum(axis=0)
    full, left = moments(total), moments(total - sums)
    without = coefficient(*left)
    error = jnp.sqrt((number - 1) * jnp.var(without))
    least = jnp.minimum((left[0] / full[0]).min(), (left[1] / full[1]).min())
    return coefficient(*full), error, least


def from_pysm_beta(beta: ArrayLike) -> Float[Array, "..."]:
    """Convert PySM's index, T ~ nu^beta, to beta_syn of this package, T ~ nu^-beta_syn."""
    return -as_array("beta", beta)


def preset(name: str, amplitude: ArrayLike, **maps: ArrayLike) -> Component:
    """Make a component with the law and the constants of a preset.

    Parameters
    ----------
    name : "baseline_dust" or "baseline_synchrotron" of the paper, or a preset of PySM that is one
        component, such as "d0", "d1", "s0", "s1" or "s3" (`presets.toml`)
    amplitude : template [uK_RJ] at the preset's reference frequency (353 GHz for dust, 23 GHz
        for PySM's synchrotron, 30 GHz for the paper's), shape (stokes, pix); PySM's I templates
        refer to other frequencies and have to be scaled first
    **maps : the parameters that are maps in this preset, shape (pix,) or numbers: `beta_dust`
        and `T_dust` [K] of d1, `beta_syn` of s1 and s3 (PySM's BETA_S has the other sign:
        `from_pysm_beta`)

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> dust = preset("d1", jnp.ones((2, 12)), beta_dust=jnp.full(12, 1.6), T_dust=20.0)
    >>> float(dust.nu_ref)
    353.0
    """
    presets = {key: own for key, own in packaged("presets.toml").items() if "law" in own}
    if name not in presets:
        raise KeyError(f"Unknown preset {name!r}; known are {', '.join(presets)}.")
    constants = dict(presets[name])
    constants.pop("files", None)
    component: Callable[..., Component] = component_class(constants.pop("law"))
    needed = constants.pop("maps", [])
    for key in needed:
        if key not in maps:
            raise TypeError(f"Preset {name!r} needs the map `{key}` as an argument.")
    for key in maps:
        if key not in needed:
            takes = ", ".join(f"`{k}`" for k in needed) or "no maps"
            raise TypeError(f"Preset {name!r} has no argument `{key}`; it takes {takes}.")
    if "pysm_beta" in constants:
        constants["beta_syn"] = from_pysm_beta(constants.pop("pysm_beta"))
    return component(amplitude, **constants, **maps)
