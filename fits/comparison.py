"""Compare observed maps with the model of foregrounds, CMB and noise: the paper's section 4.

In pixels: the slope of the observed maps against the model, with the error from noise and CMB.
Simulations of these show how far from the model maps may be by chance. Full-sky spectra EE and BB
are compared in the same way with those of the complete model.
"""

import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Bool, Float

from fits.common import CommonMaps
from fits.kept import fingerprint, kept_realisations
from fits.patches import EDGES
from fits.pseudo_cl import (
    LMIN,
    bin_centers,
    bin_edges,
    cosmic_error,
    hotelling,
    polarization_alms,
)
from fits.results import probability
from jaxsky.arrays import STOKES
from jaxsky.harmonics import power_spectrum
from jaxsky.programs import QUIET
from jaxsky.settings import Experiment, SettingsError

#: What is compared of maps of some Stokes parameters.
COMPARED = {"I": ("I",), "QU": ("Q", "U", "QU"), "IQU": ("I", "Q", "U", "QU")}
#: Fewest pixels for a slope and a correlation.
LEAST_PIXELS = 10


def _counted(maps: Array) -> Float[np.ndarray, "choice stokes"]:
    """Return the weight of each Stokes parameter of maps (..., stokes, pix) in what is compared."""
    stokes = STOKES[maps.shape[-2]]
    return np.array([[float(s in choice) for s in stokes] for choice in COMPARED[stokes]])


class ComparisonRealisations(NamedTuple):
    """Statistics of each realisation, for comparison with those of the data.

    `chi2` of noise and CMB, and the sum of their squares [uK_RJ^2], for each entry of `COMPARED`;
    C_l of TT, EE and BB [uK_RJ^2], as far as seen, `spectra` of foregrounds, CMB and noise
    together, and those of noise alone.
    """

    chi2: Float[np.ndarray, "sim band region choice"]
    squares: Float[np.ndarray, "sim band region choice"]
    spectra: Float[np.ndarray, "sim band stokes ell"]
    noise: Float[np.ndarray, "sim band stokes ell"]


class Scatter(NamedTuple):
    """Observed against modelled pixels of a band, in one region.

    `slope` is that of the observed maps on the model through the origin, weighted by 1/sigma^2;
    its `error` allows for noise and CMB, and their correlations between pixels. `correlation` is
    Pearson's; `rms` is that of observed - model, and `expected` that of noise and CMB [uK_RJ].
    `chi2` takes the sigma of the noise, and `pte` is the probability that noise and CMB alone give
    a larger one: from n simulations, and so never below `floor`, 1 / (n + 1).
    """

    pixels: int
    slope: float
    error: float
    correlation: float
    rms: float
    expected: float
    chi2: float
    pte: float
    floor: float

    @property
    def pte_text(self) -> str:
        """The probability as text, an upper limit where no realisation exceeds the maps."""
        if self.pte > self.floor:
            return probability(self.pte)
        return f"<{probability(self.floor)}"

    @property
    def slope_pte(self) -> float:
        """Probability of a slope at least as far from 1, in either direction."""
        return float(2 * scipy.stats.norm.sf(abs(self.slope - 1) / self.error))


class BandSpectra(NamedTuple):
    """EE and BB of one band; C_l in uK_RJ^2 at all multipoles, D_l in bins.

    `uncorrected`, with its bins and probability, is from the map before leakage was subtracted,
    or None. `complete` is the model's foregrounds plus one realisation of CMB and noise, `noise`
    the mean over realisations, the paper's N_l, and `error` its Delta C_l, sqrt(2 / (2l+1))
    (C_l^CMB + N_l). `mean` and `std` are those of realisations of the complete model; `chi2` and
    `pte` compare the observed bins with these realisations (`hotelling`), for EE and BB.
    """

    band: str
    observed: Float[np.ndarray, "stokes ell"]
    uncorrected: Float[np.ndarray, "stokes ell"] | None
    foregrounds: Float[np.ndarray, "stokes ell"]
    complete: Float[np.ndarray, "stokes ell"]
    noise: Float[np.ndarray, "stokes ell"]
    cmb: Float[np.ndarray, "stokes ell"]
    error: Float[np.ndarray, "stokes ell"]
    edges: tuple[int, ...]
    binned: Float[np.ndarray, "stokes bin"]
    binned_uncorrected: Float[np.ndarray, "stokes bin"] | None
    mean: Float[np.ndarray, "stokes bin"]
    std: Float[np.ndarray, "stokes bin"]
    chi2: Float[np.ndarray, " stokes"]
    pte: Float[np.ndarray, " stokes"]
    pte_uncorrected: Float[np.ndarray, " stokes"] | None

    @property
    def centers(self) -> Float[np.ndarray, " bin"]:
        """Middle multipole of each bin."""
        return bin_centers(self.edges)

    @property
    def chi2_bins(self) -> Float[np.ndarray, "stokes bin"]:
        """((observed - mean) / std)^2 in each bin."""
        return ((self.binned - self.mean) / self.std) ** 2

    @property
    def largest_error(self) -> Float[np.ndarray, " stokes"]:
        """Largest of the paper's errors as a fraction of the observed spectrum."""
        return (self.error[:, LMIN:] / self.observed[:, LMIN:]).max(axis=-1)


#: By band, region and Stokes parameters: "Q", "U", "QU" or "I".
Scatters: TypeAlias = dict[tuple[str, str, str], Scatter]


class Comparison(NamedTuple):
    """Observed maps, the model of foregrounds in each band [uK_RJ], and how they compare.

    `regions` are the used pixels of each region; `spectra` is empty if pixels are missing.
    """

    prepared: CommonMaps
    model: Float[Array, "band stokes pix"]
    regions: dict[str, Bool[np.ndarray, " pix"]]
    scatters: Scatters
    spectra: list[BandSpectra]

    @property
    def stokes(self) -> str:
        """Stokes parameters of the maps."""
        return self.prepared.fluctuations.stokes


def check_comparison(
    settings: Experiment, prepared: CommonMaps, regions: Mapping[str, Bool[np.ndarray, " pix"]]
) -> None:
    """Check settings of `compare` and `compare_patches` before the long computation."""
    how = settings.compare
    for name, inside in regions.items():
        if (inside & prepared.used).sum() < LEAST_PIXELS:
            raise SettingsError(
                f"compare.regions: region {name!r} leaves fewer than {LEAST_PIXELS} pixels."
            )
    if how.lmax > (limit := 2 * settings.common.nside):
        raise SettingsError(
            f"compare.lmax: multipoles reach to 2 nside, {limit}, but {how.lmax} is asked for."
        )
    bins = len(bin_edges(how.lmin, how.lmax, how.width)) - 1
    if bins > how.nsims / 2:
        raise SettingsError(
            f"compare.width: {how.width} makes {bins} bins up to l = {how.lmax}, and these take "
            f"twice as many realisations; compare.nsims is {how.nsims}."
        )
    if how.patches is None:
        return
    others = tuple(f"band {band!r}" for band in prepared.bands if band != how.patches)
    sources = {what: n for what, n in prepared.sources.items() if not what.endswith(others)}
    coarsest, nside = min(sources.items(), key=lambda pair: pair[1])
    if 2 * nside < EDGES[-1] - 1:
        raise SettingsError(
            f"compare.patches: nside {nside} of {coarsest} resolves l = {2 * nside}, and the "
            f"patches take {EDGES[-1] - 1}."
        )


def compare(
    settings: Experiment,
    prepared: CommonMaps,
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    simulations: Path | None = None,
    report: Callable[[int, int], None] = QUIET.advance,
    executor: Executor | None = None,
) -> Comparison:
    """Compare the maps with the model of foregrounds, CMB and noise.

    Parameters
    ----------
    settings : the experiment; the parameters of the model are those of the prepared sky
    prepared : templates and maps at the common resolution
    regions : pixels of each region
    simulations : file of realisations; those that it contains are not made again
    report : called with the number of realisations done, and of all
    executor : makes the realisations, by default this process; see `kept_realisations`

    Raises
    ------
    SettingsError, jaxsky.io.InputError : for a region without pixels, multipoles that the maps do
        not have, or a file of realisations of other data
    """
    check_comparison(settings, prepared, regions)
    how = settings.compare
    used = {name: inside & prepared.used for name, inside in regions.items()}
    model = prepared.model()
    simulated = simulated_fluctuations(
        prepared,
        model,
        used,
        how.lmax,
        how.nsims,
        settings.seed,
        simulations,
        f"{fingerprint((prepared, used))} {settings.seed} {how.lmax}",
        report,
        executor,
    )
    scatters = compare_pixels(prepared, model, used, simulated)
    spectra = compare_spectra(prepared, model, simulated, how.width, how.lmin)
    return Comparison(prepared, model, used, scatters, spectra)


def _statistics(fluctuations, foregrounds, sigma, inside, lmax, key):
    """Return a realisation's `ComparisonRealisations`, on E and B of the foregrounds."""
    noise = jnp.asarray(fluctuations.noise_realisation(key))
    cmb = fluctuations.cmb_realisation(key)
    noise_alms = polarization_alms(noise, lmax)
    alms = foregrounds + noise_alms + polarization_alms(cmb, lmax)
    chi2 = _sums_of_squares((noise + cmb) / sigma, inside)
    squares = _sums_of_squares(noise + cmb, inside)
    return chi2, squares, power_spectrum(alms), power_spectrum(noise_alms)


def simulated_fluctuations(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    lmax: int,
    *kept: Any,
) -> ComparisonRealisations:
    """Simulate noise and CMB on top of the foregrounds; `kept` is for `kept_realisations`."""
    foregrounds = polarization_alms(model, lmax)
    inside = jnp.asarray(np.stack(list(regions.values())))
    given = prepared.fluctuations, foregrounds, prepared.sigma, inside, lmax
    return kept_realisations(partial(_statistics, *given), ComparisonRealisations, *kept)


@jax.jit
def _sums_of_squares(
    maps: Float[Array, "band stokes pix"], regions: Bool[Array, "region pix"]
) -> Float[Array, "band region choice"]:
    """Return the sums over the pixels of each region of the squares of Q, U and both, or of I."""
    return jnp.einsum("bsp,rp,ts->brt", maps**2, regions.astype(maps.dtype), _counted(maps))


def _slopes(
    prepared: CommonMaps, model: Float[Array, "band stokes pix"], inside: Bool[Array, "region pix"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes and their errors, shape (band, region, choice).

    The slope of the maps d on the model m is m^T W d / m^T W m; with C the covariance of noise and
    CMB in the maps, its variance is m^T W C W m / (m^T W m)^2.
    """
    weighted = jnp.where(jnp.isfinite(prepared.sigma), model / prepared.sigma**2, 0.0)
    # One row per region for each choice of Stokes parameters.
    rows = jnp.einsum("bsp,rp,ts->brtsp", weighted, inside.astype(model.dtype), _counted(model))
    shape = rows.shape[:3]
    total = prepared.fluctuations.covariance(rows.reshape(shape[0], -1, *rows.shape[3:]))
    variance = np.einsum("brtbrt->brt", total.reshape(*shape, *shape))
    norm, product = (np.einsum("brtsp,bsp->brt", rows, maps) for maps in (model, prepared.data))
    return product / norm, np.sqrt(variance) / norm


def compare_pixels(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    simulated: ComparisonRealisations,
) -> Scatters:
    """Compare the observed maps with the model in each region, for Q, U and both, and for I."""
    inside = jnp.asarray(np.stack(list(regions.values())))
    slopes, errors = _slopes(prepared, model, inside)
    residual = prepared.data - model
    found = np.asarray(_sums_of_squares(residual / prepared.sigma, inside))
    floor = 1 / (1 + len(simulated.chi2))
    pte = floor * (1 + (simulated.chi2 >= found).sum(axis=0))
    squares = simulated.squares.mean(axis=0)
    letters = prepared.fluctuations.stokes
    names = itertools.product(prepared.bands, regions, COMPARED[letters])
    scatters = {}
    for name, at in zip(names, np.ndindex(slopes.shape), strict=True):
        _, region, stokes = name
        both = (np.asarray(maps[at[0]])[:, regions[region]] for maps in (model, prepared.data))
        x, y = (maps[[letters.index(s) for s in stokes]].ravel() for maps in both)
        scatters[name] = Scatter(
            pixels=x.size,
            slope=float(slopes[at]),
            error=float(errors[at]),
            correlation=float(np.corrcoef(x, y)[0, 1]),
            rms=float(np.sqrt(np.mean((y - x) ** 2))),
            expected=float(np.sqrt(squares[at] / x.size)),
            chi2=float(found[at]),
            pte=float(pte[at]),
            floor=floor,
        )
    return scatters


def compare_spectra(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    simulated: ComparisonRealisations,
    width: int,
    lmin: int = LMIN,
) -> list[BandSpectra]:
    """Compare spectra of the observed maps with those of the complete model.

    They are of the full sky, as in the paper: no E modes leak into B there. If pixels are missing,
    there are none. The first bin begins at `lmin`, and each has `width` multipoles.
    """
    if not prepared.used.all():
        return []
    lmax = simulated.spectra.shape[-1] - 1
    edges = bin_edges(lmin, lmax, width)
    observed = np.asarray(power_spectrum(polarization_alms(prepared.data, lmax)))
    foregrounds = np.asarray(power_spectrum(polarization_alms(model, lmax)))
    noise = simulated.noise.mean(axis=0)
    cmb = np.zeros_like(noise)
    theory = prepared.fluctuations.cmb_power()[..., : lmax + 1]
    cmb[..., : theory.shape[-1]] = theory
    error = np.asarray(cosmic_error(jnp.asarray(cmb + noise)))
    results = []
    for b, band in enumerate(prepared.bands):
        sims = _binned(simulated.spectra[:, b], edges)
        before = binned_before = pte_before = None
        if band in prepared.leakage:
            maps = prepared.data[b] + prepared.leakage[band]
            before = np.asarray(power_spectrum(polarization_alms(maps[None], lmax)))[0]
            binned_before = _binned(before, edges)
            _, pte_before = _tested(binned_before, sims)
        binned = _binned(observed[b], edges)
        chi2, pte = _tested(binned, sims)
        results.append(
            BandSpectra(
                band=band,
                observed=observed[b],
                uncorrected=before,
                foregrounds=foregrounds[b],
                complete=simulated.spectra[0, b],
                noise=noise[b],
                cmb=cmb[b],
                error=error[b],
                edges=edges,
                binned=binned,
                binned_uncorrected=binned_before,
                mean=sims.mean(axis=0),
                std=sims.std(axis=0, ddof=1),
                chi2=chi2,
                pte=pte,
                pte_uncorrected=pte_before,
            )
        )
    return results


def _binned(spectra: Float[np.ndarray, "... ell"], edges: tuple[int, ...]) -> np.ndarray:
    """Return the mean D_l = l (l+1) C_l / 2 pi of each bin."""
    ell = np.arange(spectra.shape[-1])
    scaled = ell * (ell + 1) / (2 * np.pi) * spectra
    means = [scaled[..., a:b].mean(axis=-1) for a, b in itertools.pairwise(edges)]
    return np.stack(means, axis=-1)


def _tested(
    binned: Float[np.ndarray, "stokes bin"], simulated: Float[np.ndarray, "sim stokes bin"]
) -> Float[np.ndarray, "2 stokes"]:
    """Return chi^2 of each spectrum against simulations, and the probabilities to exceed them."""
    return np.array([hotelling(binned[i], simulated[:, i]) for i in range(len(binned))]).T
