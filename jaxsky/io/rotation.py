"""Maps turned from Celestial or Ecliptic to Galactic coordinates."""

from collections.abc import Sequence

import healpy
import numpy as np
from jaxtyping import Bool, Float

from jaxsky.io.tables import InputError


def blocks(where: str, names: Sequence[str], kinds: Sequence[str | None]) -> list[list[int]]:
    """Rows that turn together when the coordinates change: (Q, U) pairs, and single scalars.

    Parameters
    ----------
    where : file, for the message
    names : of the columns
    kinds : their Stokes parameters, "" for other scalars
    """
    found: list[list[int]] = []
    row = 0
    while row < len(kinds):
        if list(kinds[row : row + 2]) == ["Q", "U"]:
            found.append([row, row + 1])
        elif kinds[row] in ("", "I"):
            found.append([row])
        else:
            raise InputError(
                f"{where}: column {names[row]} cannot be turned to Galactic "
                "coordinates; read Q followed by U, and no covariances."
            )
        row += len(found[-1])
    return found


def _turned(block: np.ndarray, rotator: healpy.Rotator) -> np.ndarray:
    """A scalar (1, pix) or Q and U (2, pix), turned in harmonic space."""
    nside = healpy.npix2nside(block.shape[-1])
    # Ring weights and eight iterations reach 1e-7 up to here; nothing does at 3 nside.
    lmax = 5 * nside // 2
    weights = nside > 1 and healpy.isnsideok(nside, nest=True)
    maps = block[0] if len(block) == 1 else [np.zeros_like(block[0]), *block]
    alm = healpy.map2alm(maps, lmax=lmax, iter=8, use_weights=weights)
    turned = healpy.alm2map(rotator.rotate_alm(alm), nside, lmax=lmax)
    return np.atleast_2d(turned)[-len(block) :]


def tangents(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Unit vectors to the south and the east, shape (2, 3, pix)."""
    south = [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)]
    return np.array([south, [-np.sin(phi), np.cos(phi), np.zeros_like(phi)]])


def _interpolated(block: np.ndarray, rotator: healpy.Rotator) -> np.ndarray:
    """A scalar (1, pix) or Q and U (2, pix), turned by interpolation between pixels.

    Q and U turn fast about the poles, so it is the tensor Q (ss - ee) + U (se + es) of the
    directions south and east that is interpolated, by its Cartesian components.
    """
    directions = healpy.pix2ang(healpy.npix2nside(block.shape[-1]), np.arange(block.shape[-1]))
    source = rotator.I(*directions)
    if len(block) == 1:
        return healpy.get_interp_val(block[0], *source)[None]
    s, e = tangents(*directions)
    tensor = block[0] * (s[:, None] * s - e[:, None] * e) + block[1] * (
        s[:, None] * e + e[:, None] * s
    )
    tensor = healpy.get_interp_val(tensor.reshape(9, -1), *source).reshape(3, 3, -1)
    s, e = np.einsum("ji,kjp->kip", rotator.mat, tangents(*directions))
    project = "ip,ijp,jp->p"
    ss, ee = np.einsum(project, s, tensor, s), np.einsum(project, e, tensor, e)
    return np.array([(ss - ee) / 2, np.einsum(project, s, tensor, e)])


def to_galactic(
    maps: Float[np.ndarray, "field pix"],
    mask: Bool[np.ndarray, " pix"],
    rows_together: Sequence[list[int]],
    coordinates: str,
) -> tuple[Float[np.ndarray, "field pix"], Bool[np.ndarray, " pix"]]:
    """Maps turned to Galactic coordinates, Q and U as the spin-2 field they are.

    Complete maps are turned in harmonic space, which is exact for a sky without structure above
    l = 2.5 nside and cuts what is above. A map with pixels missing has no spherical harmonics:
    it is interpolated between the four nearest pixels, and pixels next to missing ones are lost.
    """
    rotator = healpy.Rotator(coord=[coordinates, "G"])
    turn = _turned if mask.all() else _interpolated
    turned = np.zeros_like(maps)
    for rows in rows_together:
        turned[rows] = turn(maps[rows], rotator)
    if not mask.all():
        mask = _interpolated(mask[None].astype(float), rotator)[0] > 1 - 1e-9
        turned[:, ~mask] = 0
    return turned, mask
