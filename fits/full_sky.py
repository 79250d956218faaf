"""Full-sky spectra EE and BB, observed and of the complete model, with their errors."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float

from fits.common import CommonMaps
from fits.pseudo_cl import bin_centers, bin_edges
from jaxsky.checks import Numeric
from jaxsky.harmonics import analysis, power_spectrum

#: Polarization has no multipoles below.
LMIN = 2
FIELDS = ("EE", "BB")


class BandSpectra(NamedTuple):
    """EE and BB of one band; C_l in uK_RJ^2 at all multipoles, D_l in bins.

    `uncorrected` is the observed map's before leakage was subtracted, or None, and so with its bins
    and probability. `complete` is the model's foregrounds and one realisation of CMB and noise,
    `noise` the mean of realisations, the paper's N_l, and `error` its Delta C_l, sqrt(2 / (2l+1))
    (C_l^CMB + N_l). `mean` and `std` are those of realisations of the complete model, among which
    chi2 and its probability are those of the observed bins (`hotelling`), for EE and BB.
    """

    band: str
    observed: Float[np.ndarray, "2 ell"]
    uncorrected: Float[np.ndarray, "2 ell"] | None
    foregrounds: Float[np.ndarray, "2 ell"]
    complete: Float[np.ndarray, "2 ell"]
    noise: Float[np.ndarray, "2 ell"]
    cmb: Float[np.ndarray, "2 ell"]
    error: Float[np.ndarray, "2 ell"]
    edges: tuple[int, ...]
    binned: Float[np.ndarray, "2 bin"]
    binned_uncorrected: Float[np.ndarray, "2 bin"] | None
    mean: Float[np.ndarray, "2 bin"]
    std: Float[np.ndarray, "2 bin"]
    chi2: Float[np.ndarray, " 2"]
    pte: Float[np.ndarray, " 2"]
    pte_uncorrected: Float[np.ndarray, " 2"] | None

    @property
    def centers(self) -> Float[np.ndarray, " bin"]:
        """Middle multipole of each bin."""
        return bin_centers(self.edges)

    @property
    def chi2_bins(self) -> Float[np.ndarray, "2 bin"]:
        """((observed - mean) / std)^2 in each bin."""
        return ((self.binned - self.mean) / self.std) ** 2

    @property
    def largest_error(self) -> Float[np.ndarray, " 2"]:
        """Largest of the paper's errors as a fraction of the observed spectrum."""
        return (self.error[:, LMIN:] / self.observed[:, LMIN:]).max(axis=-1)


def polarization_alms(
    maps: Float[Array, "band stokes pix"], lmax: int
) -> Float[Array, "band 2 alm"]:
    """Coefficients of E and B of each band."""
    return jnp.stack([analysis(band, lmax) for band in maps])


def full_sky_spectra(
    maps: Float[Array, "band stokes pix"], lmax: int
) -> Float[Array, "band 2 ell"]:
    """C_l of EE and BB of each band, up to lmax.

    At 1.5 nside good to 1e-3, where maps hold multipoles up to 3 nside that pixels confuse.
    """
    return power_spectrum(polarization_alms(maps, lmax))


def cosmic_error(power: Float[Array, "... ell"], signal: Numeric = 0.0) -> Float[Array, "... ell"]:
    """Standard deviation of the full-sky spectrum of a random field, the paper's eq. 9.

    sqrt(2 / (2l+1)) C_l; where the field is added to a signal that does not vary, the chance
    correlation of both, which the paper leaves out, adds to it: sqrt(2 / (2l+1) C_l (C_l + 2 F_l)).
    """
    ell = jnp.arange(power.shape[-1])
    return jnp.sqrt(2 / (2 * ell + 1) * power * (power + 2 * signal))


def hotelling(
    observed: Float[np.ndarray, " bin"], simulated: Float[np.ndarray, "sim bin"]
) -> tuple[float, float]:
    """chi^2 of a measurement among simulations, and the probability to exceed it.

    Mean and covariance are those of the simulations, and so are uncertain; Hotelling's T^2, with
    its F distribution, is exact for Gaussian simulations in any number.
    """
    n, p = simulated.shape
    if n <= p:
        raise ValueError(f"{p} bins need more than {p} simulations, but there are {n}.")
    difference = observed - simulated.mean(axis=0)
    covariance = np.atleast_2d(np.cov(simulated, rowvar=False))
    chi2 = float(difference @ np.linalg.solve(covariance, difference))
    ratio = n / (n + 1) * (n - p) / (p * (n - 1)) * chi2
    return chi2, float(scipy.stats.f.sf(ratio, p, n - p))


def _binned(spectra: Float[np.ndarray, "... ell"], edges: tuple[int, ...]) -> np.ndarray:
    """Mean D_l = l (l+1) C_l / 2 pi of each bin."""
    ell = np.arange(spectra.shape[-1])
    scaled = ell * (ell + 1) / (2 * np.pi) * spectra
    means = [scaled[..., a:b].mean(axis=-1) for a, b in itertools.pairwise(edges)]
    return np.stack(means, axis=-1)


def compare_spectra(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    simulated: Float[np.ndarray, "sim band 2 ell"],
    noises: Float[np.ndarray, "sim band 2 ell"],
    width: int,
) -> list[BandSpectra]:
    """Spectra of the observed maps against those of the complete model.

    They are those of the full sky, which the paper takes: no mode of E shows as B there.
    `simulated` are spectra of realisations of the complete model, `noises` of the noise alone, and
    `width` counts the multipoles in a bin.
    """
    if missing := int(np.sum(~prepared.used)):
        raise ValueError(
            f"Spectra of the full sky need all pixels, but {missing} of {prepared.used.size} have "
            "no value."
        )
    lmax = simulated.shape[-1] - 1
    edges = bin_edges(LMIN, lmax, width)
    observed = np.asarray(full_sky_spectra(prepared.data, lmax))
    foregrounds = np.asarray(full_sky_spectra(model, lmax))
    noise = noises.mean(axis=0)
    cmb = np.zeros_like(noise)
    theory = prepared.fluctuations.cmb_power()[..., : lmax + 1]
    cmb[..., : theory.shape[-1]] = theory
    error = np.asarray(cosmic_error(jnp.asarray(cmb + noise)))
    results = []
    for b, band in enumerate(prepared.bands):
        sims = _binned(simulated[:, b], edges)
        before = binned_before = pte_before = None
        if band in prepared.leakage:
            maps = prepared.data[b] + prepared.leakage[band]
            before = np.asarray(full_sky_spectra(maps[None], lmax))[0]
            binned_before = _binned(before, edges)
            _, pte_before = _tested(binned_before, sims)
        binned = _binned(observed[b], edges)
        chi2, pte = _tested(binned, sims)
        results.append(
            BandSpectra(
                band,
                observed[b],
                before,
                foregrounds[b],
                simulated[0, b],
                noise[b],
                cmb[b],
                error[b],
                edges,
                binned,
                binned_before,
                sims.mean(axis=0),
                sims.std(axis=0, ddof=1),
                chi2,
                pte,
                pte_before,
            )
        )
    return results


def _tested(
    binned: Float[np.ndarray, "2 bin"], simulated: Float[np.ndarray, "sim 2 bin"]
) -> Float[np.ndarray, "2 2"]:
    """chi^2 of EE and BB among simulations, and the probabilities to exceed them."""
    return np.array([hotelling(binned[i], simulated[:, i]) for i in (0, 1)]).T
