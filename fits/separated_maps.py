"""Maps of components for given spectral parameters, with their errors and chi^2."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, ArrayLike, Float

from fits import systems
from fits.compress import PIECE, Noise, as_noise, bare, pixel_rows
from fits.distributed import ALL, look
from fits.mixing import spectral_names
from fits.multipoles import check_alm, multipoles_of
from fits.optimize import best_fit
from fits.profile_likelihood import SpectralLikelihood, matrices_at, spectral_likelihood
from fits.results import FitResult
from jaxsky import Bandpass, Component, Sky, get_parameters
from jaxsky.checks import Numeric, as_array, check_finite, check_names, check_nside, check_shape
from jaxsky.components import component_class
from jaxsky.harmonics import beam_ratio, expand, lmax_of, resize, synthesis
from jaxsky.io.stacks import Maps, computed, empty, ranges
from jaxsky.mesh import along, at_once, in_place, maps_of, module_of, over_pixels, spread
from jaxsky.observation import Instrument


class ComponentMaps(NamedTuple):
    """Maps of the components; NaN in masked pixels. Those of distributed data are distributed.

    `amplitude` are generalised least-squares estimates, uK at the reference frequency of each law,
    CMB in uK_CMB; of components without polarization exactly 0 in Q and U, without error.
    `covariance` is that of the components in each pixel for each Stokes parameter, `alone` the
    variance of each without the others; both have one pixel if they are the same in all, and are
    None if not requested. `chi2` is the weighted sum of squared residuals over bands and Stokes
    parameters, `dof` their number minus that of amplitudes, and `probability` that of exceeding
    chi2, with the spectral parameters taken as known.
    """

    components: tuple[str, ...]
    amplitude: Float[np.ndarray, "component stokes pix"]
    covariance: Float[np.ndarray, "component component stokes #pix"] | None
    alone: Float[np.ndarray, "component stokes #pix"] | None
    chi2: Float[np.ndarray, " pix"]
    dof: Float[np.ndarray, " pix"]
    probability: Float[np.ndarray, " pix"]

    def map(self, name: str) -> Float[np.ndarray, "stokes pix"]:
        """Return the amplitude of a component: a map, or coefficients."""
        return self.amplitude[self.components.index(name)]

    def sigma(self, name: str) -> Float[np.ndarray, "stokes ..."]:
        """Return the standard deviation of the amplitude of a component."""
        if self.covariance is None:
            raise ValueError("The covariance of the maps was not asked for.")
        return module_of(self.covariance).sqrt(self.covariance[(self.components.index(name),) * 2])

    def sigmas(self, pixels: slice) -> list[np.ndarray]:
        """Return the standard deviations of all amplitudes in some pixels."""
        assert self.covariance is not None  # of maps with errors
        block = self.covariance[..., pixels if self.covariance.shape[-1] > 1 else slice(1)]
        return [np.sqrt(block[i, i]) for i in range(len(block))]

    def degradation(self, name: str) -> Float[np.ndarray, "stokes ..."]:
        """Return the noise of a component over that without other components; at least 1."""
        sigma = self.sigma(name)
        assert self.alone is not None  # made with the covariance
        return sigma / module_of(sigma).sqrt(self.alone[self.components.index(name)])

    def mean_degradation(self, name: str) -> float:
        """Return the mean of `degradation` over the pixels that are not masked."""
        assert self.alone is not None  # made with the covariance
        i, total = self.components.index(name), np.zeros(2)
        for part in ranges(self.alone.shape[-1]):
            alone = self.alone[..., part][i]
            ratio = self.sigmas(part)[i] / np.sqrt(np.where(alone > 0, alone, np.nan))
            total += np.nansum(ratio), np.isfinite(ratio).sum()
        return float(total[0] / total[1])


def _solved(matrix, pixels, errors):
    """Return amplitudes and chi^2, with one matrix for all pixels or one per pixel.

    With `errors` also the covariance of the amplitudes, and the variance of each alone.
    """

    def separated(m, p):
        solved, rest, weighted = systems.fitted(m, p)
        found = solved, jnp.sum(rest * weighted, axis=(0, 1))
        if not errors:
            return found
        single = [systems.inverse_gram(column[:, None], p)[:, 0, 0] for column in m.T]
        return *found, systems.inverse_gram(m, p), jnp.stack(single, axis=1)

    if len(matrix) == 1:
        return separated(matrix[0], pixels)
    wide = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], len(matrix))), pixels)
    apart = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0)[..., None], wide)
    results = jax.vmap(separated)(matrix, apart)
    return jax.tree.map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), results)


def _own(of_pixel: Array | None, matrix: Array) -> Array:
    """Return the matrix (1, row, unknown) of all pixels, or that of each, from those of cells."""
    return matrix if of_pixel is None else matrix[jnp.maximum(of_pixel, 0)]


@partial(jax.jit, static_argnames=("layouts", "errors"))
def _separated(of_pixel, known, data, noise, used, layouts, errors):
    """Return the fields of `ComponentMaps` from `amplitude` to `dof` in some pixels.

    `known` are the matrices of all cells, for each of `layouts`; `used` is None for all pixels.
    """
    stokes, npix = data.shape[1:]
    both = list(zip(layouts, known, strict=True))
    most = max(m.shape[-1] // (1 + each.joint) for each, m in both)
    amplitude, alone = jnp.zeros((2, most, stokes, npix))
    blocks, square = jnp.zeros((most, *alone.shape)), jnp.zeros(npix)
    for layout, matrix in both:
        at = layout.own(np.arange(most))  # other components are exactly zero
        pixels = pixel_rows(data, noise, layout, ALL, used)
        solved, squares, *variances = _solved(_own(of_pixel, matrix), pixels, errors)
        amplitude = amplitude.at[at[:, None], np.array(layout.stokes)].set(layout.maps(solved))
        square = square + squares
        for k, s in enumerate(layout.stokes if errors else ()):
            group, first = (0, k * len(at)) if layout.joint else (k, 0)
            cut = slice(first, first + len(at))
            blocks = blocks.at[at[:, None], at, s].set(variances[0][group, cut, cut])
            alone = alone.at[at, s].set(variances[1][group, cut])
    seen = jnp.broadcast_to(noise.weights(ALL) > 0, data.shape)
    count = seen.sum(axis=(0, 1)) - 1.0 * sum(m.shape[-1] * len(each.groups) for each, m in both)
    found = amplitude, *((blocks, alone) if errors else (None, None)), square, count
    return found if used is None else jax.tree.map(lambda x: jnp.where(used, x, jnp.nan), found)


@partial(jax.jit, static_argnames=("layouts", "errors"))
@over_pixels((maps_of(3), maps_of(4), maps_of(3), *[maps_of(1)] * 3))
def _over_devices(of_pixel, known, data, noise, *, layouts, errors):
    """Return the fields of `ComponentMaps` but the first, for distributed pixels."""
    npix = data.shape[-1]
    size = min(at_once(PIECE), npix)

    def some(start):
        own = jnp.minimum(start + np.arange(size), npix - 1)
        used = (noise.weights(own) > 0).any(axis=(0, 1))
        cells = None if of_pixel is None else of_pixel[own]
        maps, kept = data[..., own], noise.at(own)
        *found, square, count = _separated(cells, known, maps, kept, used, layouts, errors)
        exceeding = jax.scipy.special.gammaincc(jnp.maximum(count, 1) / 2, square / 2)
        probability = jnp.where(count > 0, exceeding, 0.0 * count)  # NaN where not used
        return *found, square, count, probability

    def joined(x):
        return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)[..., :npix]

    return jax.tree.map(joined, jax.lax.map(some, jnp.arange(0, npix, size)))


def component_maps(
    like: SpectralLikelihood,
    params: Mapping[str, Numeric],
    data: Numeric,
    noise: Noise | Numeric,
    *,
    covariance: bool = True,
) -> ComponentMaps:
    """Return maps of the components, pixel by pixel, for known spectral parameters.

    Parameters
    ----------
    like : from `spectral_likelihood`, for its laws, bands and regions
    params : spectral parameters, such as `FitResult.best_fit`
    data, noise : as for `spectral_likelihood`
    covariance : whether to compute the covariance of the amplitudes

    Raises
    ------
    KeyError, TypeError, ValueError : for unknown parameters, and what `spectral_likelihood` refuses
    """
    data, noise = in_place(data, noise)
    data, wanted = bare("data", data), (len(like.mixing.names), len(like.stokes))
    good = data.ndim == 3 and data.shape[:2] == wanted
    check_shape("data", data, good, f"have shape (band, stokes, pix) = {(*wanted, 'pix')}")
    noise, known = along(data, as_noise(noise, data.shape)), matrices_at(like, params)
    if like.prior is not None:
        data, noise = like.prior.joined(data, noise)
    names, (bands, stokes, npix) = tuple(like.mixing.sky), data.shape
    uniform = noise.separable and noise.pixel_sigma is None and like.of_pixel is None
    each, cells = covariance and not uniform, like.of_pixel
    if spread(data):
        cells = along(data, cells)
        how = {"layouts": like.layout, "errors": each}
        found = ComponentMaps(names, *_over_devices(cells, known, data, noise, **how))
    else:
        looked, size = look(data, noise, len(names)), len(names)
        whole = looked.number == npix
        rows = [(size,), *([(size, size), (size,)] if each else [])]
        maps = [empty((*own, stokes, npix)) for own in rows]
        maps += [empty((npix,), copies=3) for _ in range(3)]
        for part in ranges(npix, PIECE):
            own = None if cells is None else np.asarray(cells)[part]
            given = data[..., part], noise.at(part), None if whole else looked.used[part]
            *pieces, square, count = _separated(own, known, *given, like.layout, each)
            pieces = [piece for piece in pieces if piece is not None]
            pieces += [square, count, scipy.special.chdtrc(count, square)]
            for values, piece in zip(maps, pieces, strict=True):
                values[..., part] = piece
        found = ComponentMaps(names, maps[0], *(maps[1:3] if each else (None, None)), *maps[-3:])
    if not (covariance and uniform):
        return found
    one = np.zeros((bands, stokes, 1)), Noise(np.asarray(noise.sigma)), None
    _, blocks, alone, *_ = map(np.asarray, _separated(None, known, *one, like.layout, True))
    return found._replace(covariance=blocks, alone=alone)


def emission_maps(like: SpectralLikelihood, params: Mapping[str, Numeric], amplitude: Maps) -> Maps:
    """Return the emission in the bands, in the unit of the data, from maps or coefficients."""
    bands = len(like.mixing.names)
    shape = (bands, *amplitude.shape[1:])
    known, of_pixel = matrices_at(like, params), like.of_pixel

    def emission(part):
        maps = amplitude[..., part]
        result = np.empty((*shape[:2], maps.shape[-1]))
        for layout, matrix in zip(like.layout, known, strict=True):
            rows = layout.rows(layout.own(maps))
            own = np.asarray(_own(None if of_pixel is None else of_pixel[part], matrix))
            one, sums = len(own) == 1, "ru,kup->krp"
            model = np.einsum(*(sums, own[0]) if one else ("p" + sums, own), rows, optimize=one)
            result[:, list(layout.stokes)] = layout.maps(model)[:bands]
        return result

    return computed(shape, emission)


class HarmonicMaps(ComponentMaps):
    """Component maps as packed coefficients of E, B or I, E, B, without any beam.

    `covariance` [uK^2 sr], the noise spectra, `chi2`, also summed over m, `dof` and `probability`
    are per multipole instead of pixel. At l < lmin, coefficients are zero and the others NaN.
    """

    __slots__ = ()

    def noise(self, name: str) -> Float[np.ndarray, "stokes ell"]:
        """Return the spectrum N_l of the noise of a component [uK^2 sr]."""
        return self.sigma(name) ** 2

    def maps(self, nside: int, beam: ArrayLike) -> Float[np.ndarray, "component stokes pix"]:
        """Return maps of the components; their noise has the spectra `covariance` times b_l^2.

        Multipoles above 2 nside are cut; the beam is a full width at half maximum [arcmin], or a
        table b_l from l = 0.
        """
        check_nside("nside", nside)
        check_finite("beam", as_array("beam", beam))
        lmax = min(lmax_of(self.amplitude), 2 * nside)
        window = expand(beam_ratio(beam, 0.0, lmax))
        return synthesised((resize(alm, lmax) * window for alm in self.amplitude), nside)


def synthesised(alms: Iterable[Numeric], nside: int) -> Float[np.ndarray, "row stokes pix"]:
    """Return maps of packed coefficients, synthesised one by one."""
    return np.stack([np.asarray(synthesis(jnp.asarray(alm), nside)) for alm in alms])


def harmonic_component_maps(
    like: SpectralLikelihood,
    params: Mapping[str, Numeric],
    alm: Numeric,
    noise: Numeric,
    *,
    beams: Numeric,
    lmin: int = 2,
    lmax: int | None = None,
    covariance: bool = True,
) -> HarmonicMaps:
    """Return coefficients of the components for known spectral parameters.

    s_lm = (A^T W A)^-1 A^T W d, with d = d_lm / b_l and W = b_l^2 / N_l: the linear combination of
    bands with the smallest noise at each multipole that has unit response to the component and
    none to the others, each band contributing where it has the resolution.

    Parameters
    ----------
    like : from `harmonic_likelihood`, or `spectral_likelihood` without regions
    params : spectral parameters, such as `FitResult.best_fit`
    alm, noise, beams, lmin, lmax : as for `harmonic_likelihood`, for any multipoles
    covariance : whether to compute the covariance of the amplitudes
    """
    if len(like.index) != 1:
        raise ValueError(
            f"Argument `like` has regions, {len(like.index)} in all, but in the harmonic domain "
            "parameters are the same on all of the sky."
        )
    names, alm = tuple(like.mixing.sky), check_alm(alm, len(like.mixing.names))
    if alm.shape[1] != len(like.stokes):
        raise ValueError(
            f"Argument `alm` must have {len(like.stokes)} rows a band like the data of "
            f"`like`, but has {alm.shape[1]}."
        )
    multipoles = multipoles_of(alm, noise, beams, len(names), lmin, lmax)
    ell = multipoles.ell
    with np.errstate(divide="ignore"):  # infinite where a band is left out
        sigma = 1 / np.sqrt(multipoles.weights)
    of_alm = Noise(sigma[..., ell])
    found = component_maps(like, params, multipoles.alm, of_alm, covariance=False)
    of_noise = found
    if covariance:
        of_noise = component_maps(like, params, np.zeros(sigma.shape), Noise(sigma))
    used = np.arange(ell.max() + 1) >= lmin
    square, count = (
        np.where(used, np.bincount(ell, np.nan_to_num(each)), np.nan)
        for each in (found.chi2, found.dof)
    )
    probability = np.where(count > 0, scipy.special.chdtrc(count, square), np.nan)
    return HarmonicMaps(
        components=names,
        amplitude=np.where(ell >= lmin, found.amplitude, 0.0),
        covariance=of_noise.covariance,
        alone=of_noise.alone,
        chi2=square,
        dof=count,
        probability=probability,
    )


class Separated(NamedTuple):
    """Result of `separate`: the fit of the laws, and maps of the components [uK]."""

    fit: FitResult
    maps: ComponentMaps


def separate(
    components: Sequence[str] | Mapping[str, Component],
    instrument: Instrument | Mapping[str, Bandpass] | Sequence[Bandpass],
    data: Numeric,
    free: Sequence[str] | Mapping[str, Numeric] | None = None,
    *,
    noise: Noise | Numeric | None = None,
    unit: str = "uK_CMB",
    prior: Mapping[str, Numeric] | None = None,
) -> Separated:
    """Fit the laws of components to maps in bands, and separate the components.

    Parameters
    ----------
    components : names of laws ("cmb", "dust", "synchrotron"), or components by name, of which only
        the laws count, not the amplitudes
    instrument : an instrument, or its bands by name or as a list
    data : observed maps, shape (band, stokes, pix) with Stokes Q, U or I, Q, U
    free : names of the free parameters, which start at the values of the components, or start
        values by name; by default the spectral indices, all names that begin with "beta"
    noise : standard deviations or covariances in the unit of the data (`fits.as_noise`); by default
        the white noise of the instrument
    unit : unit of the data, "uK_RJ", "uK_CMB" or the like
    prior : standard deviations or covariances of amplitudes by component, as for
        `spectral_likelihood`; for moments see `fits.separate_moments`

    Raises
    ------
    TypeError, ValueError : for a string in place of a list of names, unknown laws, bands without
        noise, and what `spectral_likelihood` refuses
    """
    data = bare("data", data)
    check_names("free", free)
    sky = sky_of(components, data.shape[1] if data.ndim == 3 else 2)
    if free is None:
        free = [name for name in spectral_names(sky) if name.split(".")[1].startswith("beta")]
    start = free if isinstance(free, Mapping) else get_parameters(sky, free)
    noise = white_noise(instrument, data, unit) if noise is None else noise
    bands = instrument.bands() if isinstance(instrument, Instrument) else instrument
    like = spectral_likelihood(sky, bands, data, noise, start, unit=unit, prior=prior)
    fit = best_fit(like)
    return Separated(fit, component_maps(like, fit.best_fit, data, noise))


def sky_of(components: Sequence[str] | Mapping[str, Component], stokes: int) -> Sky:
    """Return a sky of components, or of the laws named, without emission."""
    check_names("components", components)
    if not isinstance(components, Mapping):
        nothing = jnp.zeros((stokes, 1))
        components = {law: component_class(law)(nothing) for law in components}
    return Sky(components)


def white_noise(instrument: object, data: np.ndarray, unit: str) -> np.ndarray:
    """Return the standard deviations (band, stokes) of an instrument in the pixels of data."""
    if not isinstance(instrument, Instrument):
        raise ValueError("Argument `noise` is missing: the bands do not say what they have.")
    good = data.ndim == 3 and healpy.isnpixok(data.shape[-1])
    check_shape("data", data, good, "have shape (band, stokes, pix) with 12 nside^2 pixels")
    pixel = healpy.nside2resol(healpy.npix2nside(data.shape[-1]), arcmin=True)
    factors = [[band.conversion("uK_RJ", unit)] for band in instrument.bands().values()]
    levels = [jnp.broadcast_to(jnp.asarray(c.noise), data.shape[1]) for c in instrument.values()]
    return np.array(levels) * np.array(factors) / pixel
