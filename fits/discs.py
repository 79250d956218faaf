"""The paper's small patches of the sky: discs at high latitude, and the field of BICEP2."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import healpy
import numpy as np
from jaxtyping import Float

from fits.pseudo_cl import MaskedSpectra, masked_spectra
from jaxsky.harmonics import gaussian_beam, smooth

#: Radius of the paper's discs: 400 square degrees.
RADIUS = 11.3
#: FWHM of the Gaussian with which masks are smoothed [deg].
APODIZATION = 2.0
#: The field of BICEP2 and Keck: right ascension within +-50 deg, declination -65 to -50 deg.
BICEP2 = (50.0, -65.0, -50.0)
#: The paper's multipoles, 40 to 100, in four bins.
EDGES = (40, 55, 70, 85, 101)
#: Matrices of coupling that agree to this belong to the same mask, turned.
SAME = 2e-3


def disc_centers(nside: int = 4, latitude: float = 45.0) -> Float[np.ndarray, "2 disc"]:
    """Galactic longitude and latitude [deg] of pixels at |b| above a latitude.

    The paper has 48 discs there, and names the pixels of nside 8; 48 are those of nside 4, while
    nside 8 has 224.
    """
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    return np.stack([lon, lat])[:, np.abs(lat) > latitude]


def _smoothed_disc(radius: float, fwhm: float, angle: np.ndarray) -> np.ndarray:
    """A disc of ones smoothed by a Gaussian, at angles from its middle [deg]; closed form."""
    lmax = int(np.ceil(6.0 / np.radians(fwhm) * np.sqrt(8 * np.log(2))))
    ell = np.arange(lmax + 2)
    legendre = np.polynomial.legendre.legvander(np.array([np.cos(np.radians(radius))]), lmax + 2)[0]
    # 2 pi int P_l over the disc, times (2l+1)/4 pi of the sum over harmonics
    coefs = np.empty(lmax + 2)
    coefs[0] = (1 - legendre[1]) / 2
    coefs[1:] = (legendre[ell[1:] - 1] - legendre[ell[1:] + 1]) / 2
    window = np.asarray(gaussian_beam(60 * fwhm, lmax + 1))
    return np.polynomial.legendre.legval(np.cos(np.radians(angle)), coefs * window)


def disc_mask(
    nside: int, lon: float, lat: float, radius: float = RADIUS, fwhm: float = APODIZATION
) -> Float[np.ndarray, " pix"]:
    """A disc about Galactic coordinates, smoothed by a Gaussian, all in degrees.

    What that leaves below 1e-5 is zero.
    """
    if not (np.isfinite(lon) and -90 <= lat <= 90):
        raise ValueError(
            f"Arguments `lon` and `lat` must be a direction in degrees, not {lon} and {lat}."
        )
    if not 0 < fwhm <= radius <= 180:
        raise ValueError(
            f"Argument `fwhm`, {fwhm:g} deg, must be positive and not wider than the disc's "
            f"`radius`, {radius:g} deg."
        )
    middle = healpy.ang2vec(lon, lat, lonlat=True)
    reach = radius + 2 * fwhm
    near = healpy.query_disc(nside, middle, np.radians(reach))
    directions = np.stack(healpy.pix2vec(nside, near))
    across = np.linalg.norm(np.cross(middle, directions, axisb=0), axis=-1)
    angle = np.degrees(np.arctan2(across, middle @ directions))
    grid = np.linspace(0, reach, 4000)
    profile = _smoothed_disc(radius, fwhm, grid)
    profile = np.where(profile > 1e-5, np.minimum(profile, 1.0), 0.0)
    mask = np.zeros(healpy.nside2npix(nside))
    mask[near] = np.interp(angle, grid, profile)
    return mask


def bicep2_mask(nside: int, fwhm: float = APODIZATION) -> Float[np.ndarray, " pix"]:
    """The field of BICEP2 and Keck, smoothed as the discs are."""
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    ra, dec = healpy.Rotator(coord=["G", "C"])(lon, lat, lonlat=True)
    half, south, north = BICEP2
    inside = (np.abs((ra + 180) % 360 - 180) < half) & (dec > south) & (dec < north)
    mask = np.asarray(smooth(inside[None].astype(float), 60 * fwhm))[0]
    return np.where(mask > 1e-3, np.minimum(mask, 1.0), 0.0)


def paper_patches(nside: int) -> dict[str, Float[np.ndarray, " pix"]]:
    """The paper's 48 discs at |b| > 45 deg, and the field of BICEP2, by name."""
    discs = {
        f"l {lon:.0f}, b {lat:.0f}": disc_mask(nside, lon, lat) for lon, lat in disc_centers().T
    }
    return discs | {"BICEP2": bicep2_mask(nside)}


class PreparedPatches(NamedTuple):
    """Patches with all that does not depend on the maps; from `prepare_patches`.

    `shapes` is the first patch with the same mask but for its place, and `window` is b_l of the
    maps.
    """

    names: tuple[str, ...]
    spectra: tuple[MaskedSpectra, ...]
    shapes: tuple[int, ...]
    window: Float[np.ndarray, " ell"]


def prepare_patches(
    patches: Mapping[str, Float[np.ndarray, " pix"]],
    window: Float[np.ndarray, " ell"],
    *,
    edges: Sequence[int] = EDGES,
    lmax: int | None = None,
    pure: bool = False,
) -> PreparedPatches:
    """Patches with all that does not depend on the maps, for any number of them.

    Parameters
    ----------
    patches : weight of each pixel by the name of the patch, for example `paper_patches(nside)`
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
    spectra: list[MaskedSpectra] = []
    shapes: list[int] = []
    if not patches:
        raise ValueError("Argument `patches` has no patch in it.")
    for i, (name, mask) in enumerate(patches.items()):
        try:
            one = masked_spectra(mask, edges, lmax=lmax, window=window, pure=pure)
        except ValueError as error:
            raise ValueError(f"Patch {name}: {error}") from error
        close = SAME * np.abs(one.mixing).max()
        same = (j for j in set(shapes) if np.allclose(spectra[j].mixing, one.mixing, 0, close))
        shapes.append(next(same, i))
        spectra.append(one)
    window = np.asarray(window, float)[: spectra[0].lmax + 1]
    return PreparedPatches(tuple(patches), tuple(spectra), tuple(shapes), window)
