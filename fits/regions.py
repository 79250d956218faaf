"""Parts of the sky by name: latitudes, or masks in files; and masks with smooth edges."""

import operator
from collections.abc import Sequence
from pathlib import Path

import healpy
import numpy as np
from jaxtyping import Bool, Float

from jaxsky.inputs import mask_at
from jaxsky.io import degrade_mask, read_mask
from jaxsky.settings import Experiment, MaskFile, find_file, parse_region

COMPARISONS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def region_masks(settings: Experiment, names: Sequence[str]) -> dict[str, Bool[np.ndarray, " pix"]]:
    """Pixels of some regions at the common nside; see `region_mask`."""
    return {name: region_mask(settings, name, settings.common.nside) for name in names}


def region_mask(
    settings: Experiment, name: str, nside: int, *, coarser: bool = False
) -> Bool[np.ndarray, " pix"]:
    """Pixels of a region that the common mask leaves.

    Parameters
    ----------
    settings : of the experiment, with its regions
    name : of one of them
    nside : resolution
    coarser : take a coarser mask for all pixels inside of its own, instead of refusing it
    """
    region, inside = settings.regions[name], np.ones(healpy.nside2npix(nside), bool)
    masks = {"common.mask": settings.common.mask}
    if isinstance(region, MaskFile):
        masks[f"regions.{name}"] = region
    elif (said := parse_region(region)) is not None:
        latitude = healpy.pix2ang(nside, np.arange(inside.size), lonlat=True)[1]
        inside = COMPARISONS[said[0]](np.abs(latitude), said[1])
    for where, mask in masks.items():
        if mask is None:
            continue
        path = find_file(Path(settings.data_dir), mask.file)
        found = read_mask(path, key=mask.key, ordering=mask.ordering)
        if coarser and found.size < inside.size:
            found = healpy.ud_grade(found.astype(float), nside) > 0
        inside = inside & (degrade_mask(found, nside) if coarser else mask_at(found, nside, where))
    return np.asarray(inside)


def region_words(settings: Experiment, name: str) -> str:
    """What a region is, after the word "in" of a sentence."""
    region = settings.regions[name]
    if isinstance(region, MaskFile):
        return f"the mask {name}"
    return "the full sky" if parse_region(region) is None else f"{region} deg"


def apodize(used: Bool[np.ndarray, " pix"], width: float) -> Float[np.ndarray, " pix"]:
    """A mask that rises from 0 at its edge to 1 with two continuous derivatives.

    With x^2 = (1 - cos d) / (1 - cos w) of the distance d to the edge and the width w, the weight
    is x - sin(2 pi x) / 2 pi, the C2 of Grain, Tristram & Stompor (2009).

    Parameters
    ----------
    used : True in used pixels, RING
    width : over which the mask rises [deg]; 0 leaves it as it is
    """
    if not width or used.all():
        return used.astype(float)
    distance = healpy.dist2holes(~used)  # 0 where not used
    x = np.minimum(np.sin(distance / 2) / np.sin(np.radians(width) / 2), 1.0)
    return np.where(distance > np.radians(width), 1.0, x - np.sin(2 * np.pi * x) / (2 * np.pi))
