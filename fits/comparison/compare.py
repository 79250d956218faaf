"""The comparison of the paper's section 4, from prepared maps to numbers."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from fits.common import CommonMaps
from fits.comparison.pixels import Scatter, compare_pixels
from fits.comparison.simulations import simulate
from fits.comparison.spectra import LMIN, BandSpectra, compare_spectra
from fits.patches import EDGES
from fits.pseudo_cl import bin_edges
from fits.record import fingerprint
from jaxsky.progress import QUIET
from jaxsky.settings import Experiment, SettingsError

#: A slope and a correlation take a few pixels.
LEAST_PIXELS = 10


class Comparison(NamedTuple):
    """Observed maps, the model, and how they compare.

    Parameters
    ----------
    prepared : templates and maps at the common resolution
    model : foregrounds of each band [uK_RJ]
    regions : pixels of each region that are used
    scatters : by band, region and Stokes parameter
    spectra : by band; none if pixels are missing
    """

    prepared: CommonMaps
    model: Float[Array, "band stokes pix"]
    regions: dict[str, Bool[np.ndarray, " pix"]]
    scatters: list[Scatter]
    spectra: list[BandSpectra]

    def scatter(self, band: str, region: str, stokes: str) -> Scatter:
        """One of the scatters."""
        wanted = (band, region, stokes)
        return next(s for s in self.scatters if (s.band, s.region, s.stokes) == wanted)


def check_comparison(
    settings: Experiment, prepared: CommonMaps, regions: Mapping[str, Bool[np.ndarray, " pix"]]
) -> None:
    """Refuse at once what `compare` and `compare_patches` would find out late."""
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
    bins = len(bin_edges(LMIN, how.lmax, how.width)) - 1
    if bins > how.nsims / 2:
        raise SettingsError(
            f"compare.width: {how.width} makes {bins} bins up to l = {how.lmax}, and these take "
            f"twice as many realisations; compare.nsims is {how.nsims}."
        )
    if how.patches is None:
        return
    others = tuple(f"band {band!r}" for band in prepared.bands if band != how.patches)
    sources = {what: n for what, n in prepared.sources.items() if not what.endswith(others)}
    coarsest = min(sources, key=sources.__getitem__)
    if how.patches_nside > sources[coarsest]:
        raise SettingsError(
            f"compare.patches_nside: {how.patches_nside} is finer than that of {coarsest}, "
            f"{sources[coarsest]}."
        )
    if 2 * how.patches_nside < EDGES[-1] - 1:
        raise SettingsError(
            f"compare.patches_nside: {how.patches_nside} resolves l = {2 * how.patches_nside}, "
            f"and the patches take {EDGES[-1] - 1}."
        )


def compare(
    settings: Experiment,
    prepared: CommonMaps,
    regions: Mapping[str, Bool[np.ndarray, " pix"]],
    simulations: Path | None = None,
    report: Callable[[int, int], None] = QUIET.advance,
) -> Comparison:
    """Compare the maps with the model of foregrounds, CMB and noise.

    Parameters
    ----------
    settings : how; the parameters of the model are those of the prepared sky
    prepared : templates and maps at the common resolution
    regions : pixels of each region
    simulations : file that keeps realisations; those that it has are not made again
    report : called with the number of realisations done, and that of all

    Raises
    ------
    SettingsError, jaxsky.io.InputError
        For a region without pixels, multipoles that the maps do not have, or a file of
        realisations of other data.
    """
    check_comparison(settings, prepared, regions)
    how = settings.compare
    used = {name: inside & prepared.used for name, inside in regions.items()}
    model = prepared.model()
    simulated = simulate(
        prepared,
        model,
        used,
        how.lmax,
        how.nsims,
        settings.seed,
        simulations,
        f"{fingerprint((prepared, used))} {settings.seed} {how.lmax}",
        report,
    )
    scatters = compare_pixels(prepared, model, used, simulated)
    spectra = []
    if prepared.used.all():
        spectra = compare_spectra(prepared, model, simulated, how.width)
    return Comparison(prepared, model, used, scatters, spectra)
