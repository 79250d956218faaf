"""Regions of the sky by name, apodized masks, and regions of constant parameters.

Regions are maps of labels 0, 1, ..., one map per parameter; cells are their intersections.
"""

import operator
from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax
import numpy as np
import scipy.cluster.vq
from jaxtyping import Bool, Float, Int

from jaxsky.checks import Numeric, check_nside, check_seed
from jaxsky.inputs import one_column, read
from jaxsky.io import degrade_mask, read_mask
from jaxsky.mesh import along, module_of
from jaxsky.settings import (
    Experiment,
    MapFile,
    MapKeys,
    RegionsTable,
    SettingsError,
    at_key,
    find_file,
    parse_region,
)

COMPARISONS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def absolute_latitude(nside: int) -> Float[np.ndarray, " pix"]:
    """Return |b| of all pixels (RING) [deg]."""
    return np.abs(healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)[1])


def region_masks(settings: Experiment, names: Sequence[str]) -> dict[str, Bool[np.ndarray, " pix"]]:
    """Return the pixels of some regions at the common nside; see `region_mask`."""
    return {name: region_mask(settings, name, settings.common.nside) for name in names}


def region_mask(
    settings: Experiment, name: str, nside: int, *, coarser: bool = False
) -> Bool[np.ndarray, " pix"]:
    """Return the pixels of a region inside the common mask; `coarser` allows coarser masks."""
    region, inside = settings.regions[name], np.ones(healpy.nside2npix(nside), bool)
    masks = {"common.mask": settings.common.mask}
    if isinstance(region, MapFile):
        masks[f"regions.{name}"] = region
    elif (said := parse_region(region)) is not None:
        inside = COMPARISONS[said[0]](absolute_latitude(nside), said[1])
    for where, mask in masks.items():
        if mask is None:
            continue
        path = find_file(Path(settings.data_dir), mask.files[0])
        assert not isinstance(mask.hdu, list)  # the settings ensure this
        field = mask.fields[0] if mask.fields else None
        found = read_mask(path, field=field, hdu=mask.hdu or 1, ordering=mask.ordering)
        if coarser and found.size < inside.size:
            found = healpy.ud_grade(found.astype(float), nside) > 0
        with at_key(where):
            inside = inside & degrade_mask(found, nside)
    return np.asarray(inside)


def common_holes(maps: Sequence[Bool[np.ndarray, " pix"]]) -> dict[int, np.ndarray]:
    """Return the pixels that all maps have, at each nside of the maps; empty without holes.

    Smoothing spreads the surroundings of a hole into it, and the hole into its surroundings, so
    all maps, templates and data, get the same holes.
    """
    holed = [used for used in maps if not used.all()]

    def kept(nside: int) -> np.ndarray:
        each = (healpy.ud_grade(used.astype(float), nside) > 0.999 for used in holed)
        return reduce(np.logical_and, each)

    return {n: kept(n) for n in {healpy.npix2nside(used.size) for used in maps} if holed}


def region_title(settings: Experiment, name: str) -> str:
    """Return a region's name, and the latitudes it is made of if it says them: for titles."""
    region = settings.regions[name]
    said = None if isinstance(region, MapFile) else parse_region(region)
    return f"{name}: {region} deg" if said else name


def region_words(settings: Experiment, name: str) -> str:
    """Return words for a region, to follow "in" in a sentence."""
    region = settings.regions[name]
    if isinstance(region, MapFile):
        return f"the mask {name}"
    return "the full sky" if parse_region(region) is None else f"{region} deg"


def apodize(used: Bool[np.ndarray, " pix"], width: float) -> Float[np.ndarray, " pix"]:
    """Return a mask that rises from 0 at its edge to 1 with two continuous derivatives.

    With x^2 = (1 - cos d) / (1 - cos w) of the distance d to the edge and the width w, the weight
    is x - sin(2 pi x) / 2 pi, the C2 of Grain, Tristram & Stompor (2009).

    Parameters
    ----------
    used : True in used pixels, RING; TypeError if it is not of bool
    width : distance over which the mask rises [deg]; 0 leaves it unchanged
    """
    if used.dtype != bool:
        raise TypeError(f"Argument `used` must be a mask of bool, but is of {used.dtype}.")
    if not width or used.all():
        return used.astype(float)
    distance = healpy.dist2holes(~used)  # 0 where not used
    x = np.minimum(np.sin(distance / 2) / np.sin(np.radians(width) / 2), 1.0)
    return np.where(distance > np.radians(width), 1.0, x - np.sin(2 * np.pi * x) / (2 * np.pi))


def superpixels(nside_map: int, nside: int) -> Int[np.ndarray, " pix"]:
    """Return labels of a map's pixels (RING): the coarser RING pixels that they lie in.

    ValueError if a resolution is not a power of 2, or the labels are finer than the map.

    Examples
    --------
    >>> np.bincount(superpixels(4, 1))
    array([16, 16, 16, 16, 16, 16, 16, 16, 16, 16, 16, 16])
    """
    check_nside("nside_map", nside_map)
    check_nside("nside", nside)
    if nside > nside_map:
        raise ValueError(
            f"Argument `nside` must be at most that of the map, {nside_map}, but is {nside}."
        )
    nested = healpy.ring2nest(nside_map, np.arange(healpy.nside2npix(nside_map)))
    return healpy.nest2ring(nside, nested // (nside_map // nside) ** 2)


def latitude_bands(nside_map: int, edges: Sequence[float]) -> Int[np.ndarray, " pix"]:
    """Return labels by |b|: 0 below the first edge [deg], 1 below the second, ...

    Examples
    --------
    >>> np.bincount(latitude_bands(1, [30.0]))
    array([4, 8])
    """
    limits = np.asarray(edges, float)
    if limits.ndim != 1 or not np.all(np.diff([0.0, *limits, 90.0]) > 0):
        raise ValueError(f"Argument `edges` must increase between 0 and 90, but is {edges}.")
    return np.digitize(absolute_latitude(nside_map), limits)


def clusters(
    maps: Numeric, count: int, *, seed: int = 0, iterations: int = 30
) -> Int[np.ndarray, " pix"]:
    """Return labels of pixels with similar values in some maps, by k-means.

    Parameters
    ----------
    maps : values to compare pixels by, shape (map, pix), each map scaled to its scatter; NaN or
        infinite where masked: such pixels get the label of the mean
    count : number of clusters; ValueError if there are fewer pixels, or different values
    seed, iterations : those of k-means; empty clusters are left out
    """
    check_seed("seed", seed)
    values = np.atleast_2d(np.asarray(maps, float))
    good = np.isfinite(values).all(axis=0)
    if values.ndim != 2 or not 1 <= count <= good.sum():
        raise ValueError(
            f"Argument `maps` must have shape (map, pix) with at least {count} usable pixels, "
            f"but has shape {values.shape}, {int(good.sum())} of them usable."
        )
    middle = values[:, good].mean(axis=1, keepdims=True)
    spread = values[:, good].std(axis=1, keepdims=True)
    points = np.where(good, (values - middle) / np.where(spread > 0, spread, 1), 0).T
    if (different := len(np.unique(points[good], axis=0))) < count:
        raise ValueError(
            f"Argument `maps` has {different} different values, too few for {count} clusters."
        )
    _, found = scipy.cluster.vq.kmeans2(
        points[good], count, iter=iterations, minit="++", seed=np.random.default_rng(seed)
    )
    centers = np.stack([points[good][found == k].mean(axis=0) for k in np.unique(found)])
    return scipy.cluster.vq.vq(points, centers)[0]


def _map(
    folder: Path, spec: MapKeys, nside: int, where: str, used: Bool[np.ndarray, " pix"]
) -> Float[np.ndarray, " pix"]:
    """Read a map of one column at the resolution of the separation; used pixels need values."""
    found = read(folder, spec, stokes="", zeros_are_data=True)
    values = one_column(found, nside, where, "common.nside")
    if empty := int(np.sum(used & ~np.asarray(found.mask))):
        raise SettingsError(f"{where}: {empty} of {used.sum()} used pixels have no value.")
    return values


def parameter_labels(settings: Experiment, used: Bool[np.ndarray, " pix"]) -> dict[str, np.ndarray]:
    """Return region labels of the free parameters of a separation that have regions."""
    labels = {}
    for name, parameter in settings.free_in("separate").items():
        if parameter.regions is None:
            continue
        with at_key(f"free.{name}.regions"):
            labels[name] = _regions(settings, parameter.regions, used, f"free.{name}.regions")
    return labels


def _regions(
    settings: Experiment, regions: RegionsTable, used: Bool[np.ndarray, " pix"], where: str
) -> np.ndarray:
    folder, nside = Path(settings.data_dir), settings.common.nside
    if regions.nside is not None:
        return superpixels(nside, regions.nside)
    if regions.latitudes is not None:
        return latitude_bands(nside, regions.latitudes)
    if regions.file is not None:
        values = _map(folder, regions, nside, where, used)
        if not np.array_equal(values[used], np.round(values[used])):
            raise SettingsError(f"{where}: labels must be whole numbers.")
        return np.where(used, values, 0).astype(int)
    assert regions.clusters is not None  # one of them is given
    # Without maps, pixels that lie close together form clusters.
    rows = [_map(folder, spec, nside, f"{where}.of", used) for spec in regions.of]
    maps = np.stack(rows) if rows else np.stack(healpy.pix2vec(nside, np.arange(used.size)))
    return clusters(np.where(used, maps, np.nan), regions.clusters, seed=settings.seed)


def check_labels(name: str, labels: object, used: Any) -> Any:
    """Return labels as integers of shape (pix,), 0 where a pixel is not used, in its place."""
    array: Any = along(used, labels if isinstance(labels, jax.Array) else np.asarray(labels))
    if array.dtype.kind not in "iu":
        raise TypeError(f"Labels of {name!r} must be integers, but are {array.dtype}.")
    if array.shape != used.shape:
        raise ValueError(
            f"Labels of {name!r} must have shape {used.shape} like a map, but have {array.shape}."
        )
    if bad := int(((array < 0) & used).sum()):
        raise ValueError(f"Labels of {name!r} are negative in {bad} pixels that are used.")
    return module_of(used).where(used, array, 0)


class Cells(NamedTuple):
    """Intersections of regions: sets of pixels in which all parameters are constant.

    `of_pixel` is the cell of each pixel, -1 where not used, and None if there is a single cell.
    `labels` are the regions of each parameter, by name, in each of `number` cells.
    """

    of_pixel: Int[np.ndarray, " pix"] | None
    labels: dict[str, Int[np.ndarray, " cell"]]
    number: int


def intersections(labels: Mapping[str, Int[np.ndarray, " pix"]], used: np.ndarray) -> Cells:
    """Return the intersections of the regions of several parameters, among used pixels."""
    if not labels:
        return Cells(None, {}, 1)
    cell = np.zeros(int(used.sum()), np.int64)
    for array in labels.values():
        key = cell * (int(array.max()) + 1) + array[used]
        _, first, cell = np.unique(key, return_index=True, return_inverse=True)
    where = np.flatnonzero(used)[first]
    of_pixel = np.full(used.shape, -1, np.int32)
    of_pixel[used] = cell
    found = {name: array[where] for name, array in labels.items()}
    return Cells(of_pixel if len(first) > 1 else None, found, len(first))
