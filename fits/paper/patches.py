"""Square patches of the sky, two beside each other; figures 13 and 14."""

from collections.abc import Mapping
from pathlib import Path

import healpy
import numpy as np
from jaxtyping import Float

from fits.plots import UNITS, draw_panels, draw_patch


def disc(
    values: Float[np.ndarray, " pix"], center: tuple[float, float], size: float
) -> Float[np.ndarray, " inside"]:
    """The pixels in a disc about (l, b), `size` wide, all in degrees."""
    nside, vector = healpy.npix2nside(values.size), healpy.ang2vec(*center, lonlat=True)
    return values[healpy.query_disc(nside, vector, np.radians(size / 2))]


def draw_patches(
    path: Path,
    panels: Mapping[str, tuple[Float[np.ndarray, " pix"], float, str]],
    center: tuple[float, float],
    size: float,
) -> None:
    """Four patches: title, map, limit of the colours and unit of each."""
    with draw_panels(path, "", (5.4, 4.4), 2, 2) as grid:
        for axes, (title, (values, limit, unit)) in zip(grid.flat, panels.items(), strict=True):
            draw_patch(axes, values, center, size, limit, UNITS[unit])
            axes.set_title(title)
            axes.label_outer()
