"""Checks of files in the cache: size, hash, and the format that the catalogue says."""

from pathlib import Path

from astropy.io import fits as pyfits

from jaxsky.archive.download import file_hash, known_hash
from jaxsky.archive.products import Product
from jaxsky.io import InputError
from jaxsky.io.quantities import unit_name
from jaxsky.io.tables import HealpixTable, open_fits

__all__ = ["verify"]


def verify(product: Product, folder: Path) -> str:
    """What was checked of a product's file, in words.

    Parameters
    ----------
    product : from the catalogue
    folder : where the file is

    Raises
    ------
    InputError
        If the file is missing, has another size or hash, is cut, or is not what the catalogue
        says: its columns, units and resolution.
    """
    path = folder / product.name
    if not path.is_file():
        raise InputError(f"{path}: is not there; fetch it with `jaxsky data fetch`.")
    size, known = path.stat().st_size, known_hash(product, folder)
    # The hash of a file that was accepted as it came stands in for the catalogue's size.
    if product.size not in (None, size) and known == product.hash:
        raise InputError(f"{path}: has {size} bytes, but should have {product.size}.")
    if known is not None and (found := file_hash(path, known)) != known:
        raise InputError(f"{path}: has the hash {found}, but should have {known}; fetch it anew.")
    checked = ["hash"] if known else []
    if path.suffix == ".fits":
        with open_fits(path) as hdus:
            _check_whole(hdus)
            if product.nside is not None:
                _check_maps(HealpixTable(path, hdus, 1), product)
                checked.append("columns")
        checked.append("complete")
    return ", ".join(checked) or "there"


def _check_whole(hdus: pyfits.HDUList) -> None:
    """Read the last byte of each table, at which astropy notices a cut."""
    for hdu in hdus[1:]:
        if isinstance(hdu, pyfits.BinTableHDU) and len(hdu.columns):
            hdu.data[-1:]


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
