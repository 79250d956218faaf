"""Parts of the sky by name: latitudes, or masks in files."""

from collections.abc import Iterable
from pathlib import Path

import healpy
import numpy as np
from jaxtyping import Bool

from fits.settings import Settings
from jaxsky.inputs import mask_at
from jaxsky.io import InputError, read_mask
from jaxsky.lookup import find_file
from jaxsky.settings import SettingsError

__all__ = ["known_regions", "region_masks"]


#: Names of masks become parts of file names.
LONGEST = 200


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
        found = read_mask(path, key=mask.key, ordering=mask.ordering)
        common = mask_at(found, analysis.nside, "analysis.mask")
    regions = {}
    for name in analysis.regions:
        label = name if name in known_regions() else _label(name)
        if name == "strip":
            region = np.abs(latitude) <= analysis.latitude
        elif name == "outside":
            region = np.abs(latitude) > analysis.latitude
        elif name == "full":
            region = np.ones(npix, bool)
        else:
            found = read_mask(_mask_file(folder, name))
            region = mask_at(found, analysis.nside, f"analysis.regions: {name}")
        if label in regions:
            raise SettingsError(f"analysis.regions: two regions are called {label!r}.")
        regions[label] = np.asarray(region & common)
    return regions


def _label(file: str) -> str:
    """The name of a region in results, and in the names of their files: that of its mask."""
    label = Path(file).stem
    if label in known_regions():
        raise SettingsError(
            f"analysis.regions: the file {file} is called as a region of latitudes; rename it."
        )
    if (length := len(label.encode())) > LONGEST:
        raise SettingsError(
            f"analysis.regions: a mask's name has at most {LONGEST} bytes, not {length}: {file}."
        )
    return label


def _mask_file(folder: Path, name: str) -> Path:
    try:
        return find_file(folder, name)
    except InputError as error:
        raise SettingsError(
            f"analysis.regions: {name!r} is neither {', '.join(known_regions())} nor a file that "
            f"can be read: {error}"
        ) from None
