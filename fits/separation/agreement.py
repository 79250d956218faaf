"""Whether chains agree, and how many independent samples they are worth."""

import numpy as np
import scipy.fft
import scipy.special
import scipy.stats
from jaxtyping import Float


def _normal(values: np.ndarray) -> np.ndarray:
    """Values (step, chain, par) as quantiles of the normal distribution, by their ranks."""
    ranks = scipy.stats.rankdata(values.reshape(-1, values.shape[-1]), axis=0)
    return scipy.special.ndtri((ranks - 0.375) / (len(ranks) + 0.25)).reshape(values.shape)


def _rhat(values: np.ndarray) -> np.ndarray:
    """Square root of the variance of all chains over that within them."""
    steps = len(values)
    within = values.var(axis=0, ddof=1).mean(axis=0)
    between = values.mean(axis=0).var(axis=0, ddof=1)
    return np.sqrt((steps - 1) / steps + between / within)


def _effective(values: np.ndarray) -> np.ndarray:
    """Number of samples over the sum of autocorrelations, as far as neighbours are positive."""
    steps, chains, _ = values.shape
    size = scipy.fft.next_fast_len(2 * steps)
    power = np.abs(scipy.fft.rfft(values - values.mean(axis=0), size, axis=0)) ** 2
    covariance = scipy.fft.irfft(power, size, axis=0)[:steps].mean(axis=1) / steps
    within = covariance[0] * steps / (steps - 1)
    correlation = 1 - (within - covariance) / (
        covariance[0] + values.mean(axis=0).var(axis=0, ddof=1)
    )
    correlation[0] = 1
    pairs = correlation[: steps - steps % 2].reshape(-1, 2, values.shape[-1]).sum(axis=1)
    positive = np.logical_and.accumulate(pairs > 0, axis=0)
    pairs = np.minimum.accumulate(np.where(positive, pairs, 0), axis=0)
    # Steps that alternate about the mean are worth more than independent ones; to a limit.
    time = np.maximum(2 * pairs.sum(axis=0) - 1, 1 / np.log10(steps * chains))
    return steps * chains / time


def agreement(
    chain: Float[np.ndarray, "step chain par"],
) -> tuple[Float[np.ndarray, " par"], Float[np.ndarray, " par"]]:
    """R-hat and effective number of samples of each parameter; NaN if it never moves.

    Both are those of halves of the chains, and the worse of two: of ranks, and of ranks of
    distances from the median, which say how well widths are known (Vehtari et al. 2021, Bayesian
    Analysis 16, 667).

    Examples
    --------
    >>> chain = np.random.default_rng(0).normal(size=(1000, 4, 1))
    >>> rhat, effective = agreement(chain)
    >>> bool(rhat[0] < 1.01), bool(3000 < effective[0] < 5000)
    (True, True)
    """
    steps = len(chain) // 2
    halves = np.concatenate([chain[:steps], chain[-steps:]], axis=1)
    places, distances = _normal(halves), _normal(np.abs(halves - np.median(halves, axis=(0, 1))))
    with np.errstate(divide="ignore", invalid="ignore"):
        rhat = np.maximum(_rhat(places), _rhat(distances))
        effective = np.minimum(_effective(places), _effective(distances))
    return rhat, np.where(np.isfinite(rhat), effective, np.nan)
