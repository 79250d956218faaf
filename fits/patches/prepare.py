"""Patches with all that does not depend on the maps."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fits.discs import Patch
from fits.pseudo_cl import MaskedSpectra, masked_spectra

#: The paper's multipoles, 40 to 100, in four bins.
EDGES = (40, 55, 70, 85, 101)
#: Matrices of coupling that agree to this belong to the same mask, turned.
SAME = 2e-3


class PreparedPatches(NamedTuple):
    """Patches with all that does not depend on the maps; from `prepare_patches`.

    Attributes
    ----------
    names : for tables and pictures
    lon, lat : Galactic coordinates of the middles [deg]
    spectra : how spectra are taken on each
    shapes : the first patch with the same mask but for its place
    window : window b_l of the maps
    """

    names: tuple[str, ...]
    lon: Float[np.ndarray, " patch"]
    lat: Float[np.ndarray, " patch"]
    spectra: tuple[MaskedSpectra, ...]
    shapes: tuple[int, ...]
    window: Float[np.ndarray, " ell"]


def prepare_patches(
    patches: Iterable[Patch],
    window: Float[np.ndarray, " ell"],
    *,
    edges: Sequence[int] = EDGES,
    lmax: int | None = None,
    pure: bool = False,
) -> PreparedPatches:
    """Patches with all that does not depend on the maps, for any number of them.

    Parameters
    ----------
    patches : for example `fits.discs.paper_patches(nside)`
    window : window b_l of the maps (beam and pixels)
    edges : first multipole of each bin, and the one after the last; three bins at least
    lmax : see `masked_spectra`
    pure : purify B, which makes its errors on the paper's discs 20 to 40 % smaller; of patches
        that are no discs the errors that are returned for B are then up to a third too small

    Raises
    ------
    ValueError
        For fewer than three bins, no patches, and what `masked_spectra` refuses, with the patch.
    """
    if len(edges) < 4:
        raise ValueError(
            f"Argument `edges` must give three bins at least, for two parameters, not {edges}."
        )
    patches = tuple(patches)
    spectra: list[MaskedSpectra] = []
    shapes: list[int] = []
    if not patches:
        raise ValueError("Argument `patches` has no patch in it.")
    for i, patch in enumerate(patches):
        try:
            one = masked_spectra(patch.mask, edges, lmax=lmax, window=window, pure=pure)
        except ValueError as error:
            raise ValueError(f"Patch {patch.name}: {error}") from error
        close = SAME * np.abs(one.mixing).max()
        same = (j for j in set(shapes) if np.allclose(spectra[j].mixing, one.mixing, 0, close))
        shapes.append(next(same, i))
        spectra.append(one)
    lon, lat = np.array([[patch.lon, patch.lat] for patch in patches]).T
    names = tuple(patch.name for patch in patches)
    window = np.asarray(window, float)[: spectra[0].lmax + 1]
    return PreparedPatches(names, lon, lat, tuple(spectra), tuple(shapes), window)
