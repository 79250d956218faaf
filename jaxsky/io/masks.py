"""Masks: 1 = used, RING, Galactic."""

import zipfile
from pathlib import Path

import healpy
import numpy as np
from jaxtyping import Bool

from jaxsky.io.columns import default_fields
from jaxsky.io.files import UnfitError, check_file, in_file
from jaxsky.io.tables import equals, in_ring, open_table, spelled


def _read_npz(path: Path, field: str | int | None, ordering: str | None) -> np.ndarray:
    """The values of a mask in an archive, in RING order."""
    order = spelled("ordering", ordering or "RING")
    check_file(path)
    try:
        with np.load(path) as archive:
            known = list(archive)
            name = known[0] if field is None and len(known) == 1 else field
            if name not in known:
                what = "give `field`, of several" if field is None else f"no mask {field!r}"
                raise UnfitError(f"{what}; it has {', '.join(known)}.")
            found = np.squeeze(archive[name])
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UnfitError(f"not a readable .npz archive ({error}).") from error
    if found.dtype.kind not in "biuf" or found.ndim != 1:
        raise UnfitError(f"{name} is no mask, but has type {found.dtype} and shape {found.shape}.")
    if not healpy.isnpixok(found.size):
        raise UnfitError(f"not a HEALPix mask, {found.size} is not 12 nside^2 pixels.")
    values = found.astype(np.float64)
    values[~np.isfinite(values) | equals(values, healpy.UNSEEN, 1e-5)] = np.nan
    return in_ring(values, order)


def _in_galactic(mask: np.ndarray, coordinates: str) -> np.ndarray:
    """The mask at the pixel centers of the Galactic frame."""
    nside = healpy.npix2nside(mask.size)
    directions = healpy.pix2ang(nside, np.arange(mask.size))
    return mask[healpy.ang2pix(nside, *healpy.Rotator(coord=["G", coordinates])(*directions))]


def read_mask(
    path: str | Path,
    *,
    field: str | int | None = None,
    hdu: int | str = 1,
    nside: int | None = None,
    ordering: str | None = None,
) -> Bool[np.ndarray, " pix"]:
    """A mask from a FITS file or an .npz archive.

    Pixels without a value are not used: those that a partial map does not list, UNSEEN, NaN,
    BAD_DATA and TNULL of the header.

    Parameters
    ----------
    path : FITS file or .npz archive
    field : column of the table or array of the archive, for example "GAL040"; may be left out
        where there is only one, or an I column (the WMAP masks)
    hdu : number or name of the FITS table
    nside : resolution that is expected
    ordering : "RING" or "NESTED" where the header does not say; an archive is RING unless it is
        given. A FITS mask without coordinates is taken to be Galactic.

    Returns
    -------
    True in used pixels; RING, Galactic, shape (pix,).

    Raises
    ------
    InputError
        If the file has no such mask, or it has values other than 0 and 1 (read an apodized mask
        with `read_maps`), the wrong nside, or leaves no pixel.
    """
    path = Path(path)
    frame, others = "G", []
    with in_file(path):
        if path.suffix == ".npz":
            values = _read_npz(path, field, ordering)
        else:
            with open_table(path, hdu) as table:
                column = default_fields(table, "field")[0] if field is None else table.index(field)
                order = table.state("ordering", ordering)
                frame = table.state("coordinates", None, "G")
                values = table.values(column, order, logical=True)
                others = [name for name in table.names if name != table.names[column]]
        found = healpy.npix2nside(values.size)
        if nside not in (None, found):
            raise UnfitError(f"nside is {found}, but {nside} is expected.")
        odd = values[np.isfinite(values) & (values != 0) & (values != 1)]
        if odd.size:
            listed = ", ".join(f"{value:.6g}" for value in np.unique(odd)[:3])
            raise UnfitError(
                f"a mask has values 0 and 1, but {odd.size} of {values.size} pixels have others, "
                f"such as {listed}."
            )
        mask = values == 1
        if not mask.any():
            hint = f"; give `field` out of {', '.join(others)}" if field is None and others else ""
            raise UnfitError(f"the mask leaves no pixel{hint}.")
    return mask if frame == "G" else _in_galactic(mask, frame)


def degrade_mask(
    mask: Bool[np.ndarray, " pix"], nside: int, threshold: float = 0.5
) -> Bool[np.ndarray, " pix"]:
    """A mask in RING order at lower resolution: pixels of which at least a fraction is used."""
    found = healpy.npix2nside(np.size(mask))
    if not healpy.isnsideok(found, nest=True):
        raise ValueError(f"Argument `mask` must have nside 1, 2, 4, ..., but has nside {found}.")
    if not healpy.isnsideok(nside, nest=True) or nside > found:
        raise ValueError(
            f"Argument `nside` must be a power of 2 up to that of the mask, {found}, not {nside}."
        )
    if not 0 < threshold <= 1:
        raise ValueError(f"Argument `threshold` must be within (0, 1], but is {threshold}.")
    # The means of 0 and 1 over powers of 4 are exact, so a threshold of 1 keeps full pixels.
    return healpy.ud_grade(np.asarray(mask, dtype=float), nside) >= threshold
