"""Checks of files in the cache: size, hash, and the format that the catalogue says."""

from pathlib import Path

from astropy.io import fits as pyfits

from jaxsky.archive.cache import file_hash, known_hash
from jaxsky.archive.products import Product
from jaxsky.io import InputError, read_spectra
from jaxsky.io.quantities import unit_name
from jaxsky.io.tables import HealpixTable, open_fits


def verify(product: Product, folder: Path) -> str:
    """Check a product's file; returns in words what was checked.

    Parameters
    ----------
    product : from the catalogue
    folder : where the file is
    """
    path = folder / product.name
    if not path.is_file():
        raise InputError(f"{path}: is not there; fetch it with `jaxsky data fetch`.")
    check_size(product, folder)
    known = known_hash(product, folder)
    if known is not None and (found := file_hash(path, known)) != known:
        raise InputError(f"{path}: has the hash {found}, but should have {known}; fetch it anew.")
    return ", ".join([*(["hash"] if known else []), *check_structure(product, path)])


def check_size(product: Product, folder: Path) -> None:
    """Raise InputError if a product's file has another size than the catalogue says."""
    path = folder / product.name
    size = path.stat().st_size
    # The hash of a file that was accepted as it came stands in for the catalogue's size.
    if product.size not in (None, size) and known_hash(product, folder) == product.hash:
        raise InputError(f"{path}: has {size} bytes, but should have {product.size}.")


def check_structure(product: Product, path: Path) -> list[str]:
    """Check that a file is complete and what the catalogue says; returns what was checked.

    Reads headers and ends of tables only, whatever the size.
    """
    with path.open("rb") as file:
        start = file.read(512)
    shown = " ".join(start[:60].decode("ascii", "replace").split())
    if not start:
        raise InputError(f"{path}: is empty.")
    if product.name.endswith(".fits"):
        if not start.startswith((b"SIMPLE", b"\x1f\x8b")):
            raise InputError(f"{path}: is no FITS file, it begins with {shown!r}.")
        with open_fits(path) as hdus:
            _check_whole(hdus)
            if product.nside is not None:
                _check_maps(HealpixTable(path, hdus, 1), product)
        return ["complete"] if product.nside is None else ["columns", "complete"]
    if start.lstrip().startswith(b"<"):
        raise InputError(f"{path}: is no table, it begins with {shown!r}.")
    if product.lmax is not None:
        _check_text(path, product.lmax)
    return ["complete"]


def _check_text(path: Path, lmax: int) -> None:
    read_spectra(path, lmax)
    with path.open("rb") as file:
        file.seek(-1, 2)
        if file.read() != b"\n":
            raise InputError(f"{path}: ends in the middle of a line.")


def _check_whole(hdus: pyfits.HDUList) -> None:
    """Read the last byte of each table or image, at which astropy notices a cut."""
    for hdu in hdus:
        if isinstance(hdu, pyfits.BinTableHDU):
            if len(hdu.columns):
                hdu.data[-1:]
        elif hdu.is_image and hdu.shape:
            hdu.section[-1:]


def _check_maps(table: HealpixTable, product: Product) -> None:
    if table.nside != product.nside:
        raise InputError(f"{table.where}: nside is {table.nside}, but {product.nside} is expected.")
    for name in product.columns:
        index = table.index(name)
        # Hits and covariances have units of their own.
        if product.unit is None or name.upper() in ("N_OBS", "HITS") or name.endswith("_COV"):
            continue
        text = table.unit(index)
        if text is None:
            continue
        try:
            unit = unit_name(text)
        except ValueError:
            unit = text
        if unit not in (product.unit, product.unit.replace("_CMB", "").replace("_RJ", "")):
            raise InputError(
                f"{table.where}: column {name} is in {text}, but {product.unit} is expected."
            )
