"""Parts of the sky by name: latitudes, or masks in files."""

from collections.abc import Iterable
from pathlib import Path

import healpy
import numpy as np
from jaxtyping import Bool

from fits.settings import Settings
from jaxsky.io import InputError, degrade_mask, read_mask
from jaxsky.lookup import find_file
from jaxsky.settings import SettingsError

__all__ = ["known_regions", "region_masks"]


def known_regions() -> Iterable[str]:
    """Names of regions that are not files."""
    return ("strip", "outside", "full")


def region_masks(settings: Settings) -> dict[str, Bool[np.ndarray, " pix"]]:
    """Pixels of each region at the common nside.

    Raises
    ------
    SettingsError, jaxsky.io.InputError
        For a region that is neither known nor a readable mask.
    """
    analysis, folder = settings.analysis, Path(settings.data_dir)
    npix = healpy.nside2npix(analysis.nside)
    latitude = healpy.pix2ang(analysis.nside, np.arange(npix), lonlat=True)[1]
    common = np.ones(npix, bool)
    if analysis.mask is not None:
        mask = analysis.mask
        path = find_file(folder, mask.file)
        common = degrade_mask(read_mask(path, key=mask.key, ordering=mask.ordering), analysis.nside)
    regions = {}
    for name in analysis.regions:
        if name == "strip":
            region = np.abs(latitude) <= analysis.latitude
        elif name == "outside":
            region = np.abs(latitude) > analysis.latitude
        elif name == "full":
            region = np.ones(npix, bool)
        else:
            region = degrade_mask(read_mask(_mask_file(folder, name)), analysis.nside)
        label = name if name in known_regions() else Path(name).stem
        if label in regions:
            raise SettingsError(f"analysis.regions: two regions are called {label!r}.")
        regions[label] = np.asarray(region & common)
    return regions


def _mask_file(folder: Path, name: str) -> Path:
    try:
        return find_file(folder, name)
    except InputError as error:
        raise SettingsError(
            f"analysis.regions: {name!r} is neither {', '.join(known_regions())} nor a file that "
            f"can be read: {error}"
        ) from None
