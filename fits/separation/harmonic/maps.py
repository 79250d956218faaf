"""Maps of the components from coefficients, for given spectral parameters."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import ArrayLike, Float

from fits import amplitudes
from fits.compress import Layout
from fits.multipoles import check_alm, compressed, multipoles_of, positions
from fits.profile_likelihood import SpectralLikelihood
from jaxsky.checks import Numeric, as_array, check_finite
from jaxsky.harmonics import beam_ratio, expand, lmax_of, resize, synthesis


class HarmonicMaps(NamedTuple):
    """Coefficients of the components, without any beam.

    Attributes
    ----------
    components : their names
    amplitude : generalised least-squares estimates, packed coefficients of E, B or I, E, B, uK at
        the reference frequency of each law; CMB in uK_CMB. Zero where l < lmin.
    covariance : of the components, for each Stokes parameter and multipole [uK^2 sr]: their noise
        spectra. NaN where l < lmin, as are the others.
    chi2, dof : sum over bands, Stokes parameters and m of the weighted residuals squared, and
        their number less that of amplitudes
    probability : to exceed chi2, the spectral parameters taken as known
    """

    components: tuple[str, ...]
    amplitude: Float[np.ndarray, "component stokes alm"]
    covariance: Float[np.ndarray, "component component stokes ell"]
    chi2: Float[np.ndarray, " ell"]
    dof: Float[np.ndarray, " ell"]
    probability: Float[np.ndarray, " ell"]

    def alm(self, name: str) -> Float[np.ndarray, "stokes alm"]:
        """Coefficients of a component."""
        return self.amplitude[self.components.index(name)]

    def noise(self, name: str) -> Float[np.ndarray, "stokes ell"]:
        """Spectrum N_l of the noise of a component [uK^2 sr]."""
        i = self.components.index(name)
        return self.covariance[i, i]

    def maps(self, nside: int, beam: ArrayLike) -> Float[np.ndarray, "component stokes pix"]:
        """Maps of the components; their noise has the spectra `covariance` times b_l^2.

        Parameters
        ----------
        nside : resolution; multipoles above 2 nside are cut
        beam : of the maps: full width at half maximum [arcmin], or a table b_l from l = 0
        """
        if not healpy.isnsideok(nside, nest=True):
            raise ValueError(f"Argument `nside` must be a power of 2, but is {nside}.")
        check_finite("beam", as_array("beam", beam))
        lmax = min(lmax_of(self.amplitude), 2 * nside)
        window = expand(beam_ratio(beam, 0.0, lmax))
        maps = [synthesis(resize(alm, lmax) * window, nside) for alm in self.amplitude]
        return np.stack([np.asarray(each) for each in maps])


@jax.jit
def _filters(like, params, parts):
    """For each of `layout`: what takes rows to amplitudes, their covariance, and chi^2."""

    def of(matrix, pixels):
        groups, rows = pixels.data.shape[1:3]
        unit = jnp.broadcast_to(jnp.eye(rows), (groups, rows, rows))

        def each(here):
            filters = amplitudes.solve(matrix, here._replace(data=unit))
            covariance = amplitudes.inverse_gram(matrix, here)[..., 0]
            return filters, covariance, amplitudes.chi2(matrix, here)

        return jax.vmap(each)(pixels)

    matrices = like.matrices(like.flat(params)[like.index])
    return [of(matrix[0], pixels) for matrix, pixels in zip(matrices, parts, strict=True)]


def _blocks(
    layout: Layout, covariance: Float[np.ndarray, "ell group unknown unknown"], size: int
) -> Float[np.ndarray, "component component stokes ell"]:
    """Covariance of the components for each Stokes parameter."""
    blocks = []
    for k in range(len(layout.stokes)):
        # A single matrix where all Stokes parameters have the same noise, or are one system.
        group, first = (0, k * size) if layout.joint else (min(k, covariance.shape[1] - 1), 0)
        rows = slice(first, first + size)
        blocks.append(np.moveaxis(covariance[:, group, rows, rows], 0, -1))
    return np.stack(blocks, axis=2)


def harmonic_component_maps(
    like: SpectralLikelihood,
    params: Mapping[str, Numeric],
    alm: Numeric,
    noise: Numeric,
    *,
    beams: Numeric,
    lmin: int = 2,
    lmax: int | None = None,
) -> HarmonicMaps:
    """Coefficients of the components for spectral parameters that are known.

    s_lm = (A^T W A)^-1 A^T W d, with d = d_lm / b_l and W = b_l^2 / N_l: the linear combination of
    bands with the smallest noise at each multipole that has unit response to the component and
    none to the others, each band contributing where it has the resolution.

    Parameters
    ----------
    like : for its laws and bands: from `harmonic_likelihood`, or `spectral_likelihood` without
        regions
    params : spectral parameters, such as `SpectralFit.best_fit`
    alm, noise, beams, lmin, lmax : as for `harmonic_likelihood`; the multipoles need not be those
        that were fitted
    """
    if len(like.index) != 1:
        raise ValueError(
            f"Argument `like` has regions, {len(like.index)} in all, but in the harmonic domain "
            "parameters are the same on all of the sky."
        )
    names, alm = tuple(like.sky), check_alm(alm, len(like.bands.names))
    if alm.shape[1] != len(like.bands.stokes):
        raise ValueError(
            f"Argument `alm` must have {len(like.bands.stokes)} rows a band like the data of "
            f"`like`, but has {alm.shape[1]}."
        )
    multipoles = multipoles_of(alm.shape, noise, beams, len(names), lmin, lmax)
    stokes, lmax = alm.shape[1], multipoles.lmax
    parts = [compressed(alm, multipoles, layout) for layout in like.layout]
    # Without data, so that one program serves all likelihoods with these laws.
    laws = dataclasses.replace(like, pixels=(), block_cell=None, of_pixel=None, values=0)
    found = _filters(laws, like.check(params) if like.start else {}, parts)

    amplitude = np.zeros((len(names), stokes, (lmax + 1) ** 2))
    blocks = np.full((len(names), len(names), stokes, lmax + 1), np.nan)
    square, count = np.full(lmax + 1, np.nan), np.full(lmax + 1, np.nan)
    square[lmin:], count[lmin:] = 0.0, multipoles.dof(len(names))
    for layout, (filters, covariance, chi2) in zip(like.layout, found, strict=True):
        own = np.array(layout.stokes)
        square[lmin:] += chi2
        blocks[:, :, own, lmin:] = _blocks(layout, np.asarray(covariance), len(names))
        each = zip(multipoles.ell, np.asarray(filters), multipoles.coefficients(alm), strict=True)
        for ell, matrix, values in each:
            solved = layout.maps(matrix @ layout.rows(values))
            amplitude[:, own[:, None], positions(ell, lmax)] = solved
    probability = np.where(count > 0, scipy.special.chdtrc(count, square), np.nan)
    return HarmonicMaps(names, amplitude, blocks, square, count, probability)
