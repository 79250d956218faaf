"""Pixel by pixel: the slope of the observed maps against the model, with an honest error."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Bool, Float

from fits.common import CommonMaps
from fits.comparison.simulations import Simulated, sums_of_squares
from fits.record import probability

STOKES = ("Q", "U", "QU")


class Scatter(NamedTuple):
    """Observed against modelled pixels of a band, in one region.

    Parameters
    ----------
    band, region, stokes : which pixels
    pixels : how many, of Q and U together for both
    slope, error : of the observed maps on the model, weighted by 1/sigma^2, through the origin;
        the error is that of noise and CMB together, correlated as they are between pixels
    correlation : Pearson's coefficient
    rms, expected : rms of observed - model, and that of noise and CMB [uK_RJ]
    chi2 : sum of (observed - model)^2 / sigma^2, sigma that of the noise
    pte : probability that noise and CMB alone give a larger chi2, from simulations; never below
        `floor`, one in their number
    """

    band: str
    region: str
    stokes: str
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
        """The probability in words, an upper limit where no realisation exceeds the maps."""
        if self.pte > self.floor:
            return probability(self.pte)
        return f"<{probability(self.floor)}"

    @property
    def slope_pte(self) -> float:
        """Probability of a slope as far from 1 in either direction."""
        return float(2 * scipy.stats.norm.sf(abs(self.slope - 1) / self.error))


def _slopes(
    prepared: CommonMaps, model: Float[Array, "band stokes pix"], inside: Bool[Array, "region pix"]
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes and their errors, shape (band, region, 3).

    m^T W d / m^T W m, whose error follows from the covariance C of what the maps d hold besides
    the model m: m^T W C W m / (m^T W m)^2.
    """
    weighted = jnp.where(jnp.isfinite(prepared.sigma), model / prepared.sigma**2, 0.0)
    # A row for each region and Stokes parameter, zero in the other one.
    rows = jnp.einsum("bsp,rp,st->brtsp", weighted, inside.astype(model.dtype), jnp.eye(2))
    bands, regions = rows.shape[:2]
    flat = rows.reshape(bands, 2 * regions, 2, -1)
    total = prepared.fluctuations.covariance(flat).reshape(bands, regions, 2, bands, regions, 2)
    own = jnp.einsum("brsbrt->brst", total)
    norm = jnp.einsum("brtsp,bsp->brt", rows, model)
    product = jnp.einsum("brtsp,bsp->brt", rows, prepared.data)
    slopes = jnp.concatenate([product / norm, (product.sum(-1) / norm.sum(-1))[..., None]], axis=-1)
    variance = jnp.einsum("brss->brs", own) / norm**2
    both = own.sum(axis=(-2, -1)) / norm.sum(axis=-1) ** 2
    return np.asarray(slopes), np.sqrt(np.concatenate([variance, both[..., None]], axis=-1))


def compare_pixels(
    prepared: CommonMaps,
    model: Float[Array, "band stokes pix"],
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    simulated: Simulated,
) -> list[Scatter]:
    """The observed maps against the model, in each region, for Q, U and both.

    Parameters
    ----------
    prepared : templates and maps at the common resolution
    model : foregrounds of each band [uK_RJ]
    regions : pixels of each region that are used
    simulated : realisations of noise and CMB, with the same regions
    """
    inside = jnp.asarray(np.stack(list(regions.values())))
    slopes, errors = _slopes(prepared, model, inside)
    residual = prepared.data - model
    found = np.asarray(sums_of_squares(residual / prepared.sigma, inside))
    exceeding = (simulated.chi2 >= found).sum(axis=0)
    pte = (1 + exceeding) / (1 + len(simulated.chi2))
    squares = simulated.squares.mean(axis=0)
    rows = []
    for b, band in enumerate(prepared.bands):
        for r, (region, pixels) in enumerate(regions.items()):
            observed, modelled = (np.asarray(m[b])[:, pixels] for m in (prepared.data, model))
            for s, stokes in enumerate(STOKES):
                pick = slice(None) if stokes == "QU" else slice(s, s + 1)
                x, y = modelled[pick].ravel(), observed[pick].ravel()
                rows.append(
                    Scatter(
                        band,
                        region,
                        stokes,
                        x.size,
                        float(slopes[b, r, s]),
                        float(errors[b, r, s]),
                        float(np.corrcoef(x, y)[0, 1]),
                        float(np.sqrt(np.mean((y - x) ** 2))),
                        math.sqrt(float(squares[b, r, s]) / x.size),
                        float(found[b, r, s]),
                        float(pte[b, r, s]),
                        1 / (1 + len(simulated.chi2)),
                    )
                )
    return rows
