"""Simulated noise and CMB: how far from the model the maps may be by chance."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.common import CommonMaps
from fits.realisations import realisations
from jaxsky.checks import check_seed
from jaxsky.harmonics import analysis, lmax_of, power_spectrum
from jaxsky.progress import QUIET


class Simulated(NamedTuple):
    """Of each realisation, what is compared with the data.

    Parameters
    ----------
    chi2 : of the residual maps, for Q, U and both
    squares : sum of their squares [uK_RJ^2]
    spectra : C_l of EE and BB of the complete model: foregrounds, CMB, noise [uK_RJ^2]
    noise : C_l of the noise alone
    """

    chi2: Float[np.ndarray, "sim band region 3"]
    squares: Float[np.ndarray, "sim band region 3"]
    spectra: Float[np.ndarray, "sim band 2 ell"]
    noise: Float[np.ndarray, "sim band 2 ell"]


@jax.jit
def sums_of_squares(
    maps: Float[Array, "band stokes pix"], regions: Bool[Array, "region pix"]
) -> Float[Array, "band region 3"]:
    """Sum over the pixels of each region of the squares of Q, of U and of both."""
    single = jnp.einsum("bsp,rp->brs", maps**2, regions.astype(maps.dtype))
    return jnp.concatenate([single, single.sum(axis=-1, keepdims=True)], axis=-1)


def full_sky_spectra(
    maps: Float[Array, "band stokes pix"], lmax: int
) -> Float[Array, "band 2 ell"]:
    """C_l of EE and BB of each band, up to lmax.

    At 1.5 nside good to 1e-3, where maps hold multipoles up to 3 nside that pixels confuse.
    """
    return power_spectrum(_alms(maps, lmax))


def _alms(maps: Float[Array, "band stokes pix"], lmax: int) -> Float[Array, "band 2 alm"]:
    return jnp.stack([analysis(band, lmax) for band in maps])


def _realisation(
    prepared: CommonMaps,
    foregrounds: Float[Array, "band 2 alm"],
    regions: Bool[Array, "region pix"],
    key: Array,
) -> tuple[Array, ...]:
    lmax = lmax_of(foregrounds)
    noise = prepared.fluctuations.noise_realisation(key)
    cmb = prepared.fluctuations.cmb_realisation(key)
    noise_alms = _alms(noise, lmax)
    spectra = power_spectrum(foregrounds + noise_alms + _alms(cmb, lmax))
    chi2 = sums_of_squares((noise + cmb) / prepared.sigma, regions)
    squares = sums_of_squares(noise + cmb, regions)
    return chi2, squares, spectra, power_spectrum(noise_alms)


def simulate(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    lmax: int,
    nsims: int,
    seed: int,
    path: Path | None = None,
    mark: str = "",
    report: Callable[[int, int], None] = QUIET.advance,
) -> Simulated:
    """Realisations of noise and CMB on top of the model's foregrounds.

    Parameters
    ----------
    prepared : templates and maps at the common resolution
    model : foregrounds of each band [uK_RJ]
    regions : pixels of each region
    lmax : largest multipole of the spectra
    nsims, seed : number of realisations; each depends on the seed and its own number only
    path : file that keeps what is done; what it holds already is not made again
    mark : of data and settings; a file with another one is refused
    report : called with the number of realisations done, and that of all

    Raises
    ------
    jaxsky.io.InputError
        If the file is damaged, or holds realisations of other data or settings.
    """
    check_seed("seed", seed)
    foregrounds = _alms(model, lmax)
    inside = jnp.asarray(np.stack(list(regions.values())))

    def make(key):
        return _realisation(prepared, foregrounds, inside, key)

    return Simulated(*realisations(make, Simulated._fields, nsims, seed, path, mark, report))
