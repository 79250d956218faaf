"""The catalogue of public data products (`products.toml`), and checks of downloaded files."""

import json
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pooch
from rich.filesize import decimal

from jaxsky.io import InputError, read_spectra
from jaxsky.io.files import UnfitError, is_fits, locked
from jaxsky.io.quantities import unit_name
from jaxsky.io.tables import HealpixTable, is_cut, open_fits, open_table
from jaxsky.public import packaged


class Product(NamedTuple):
    """A file of an archive; None stands for what is unknown or does not apply.

    `addresses` are in order of preference; `size` is in bytes, `about` in MB where only that is
    known; `hash` is "sha256:..." or "md5:..."; `columns` must be in the first table; `lmax` is the
    last multipole of a table of spectra.
    """

    name: str
    group: str
    title: str
    what: str
    addresses: tuple[str, ...]
    size: int | None = None
    about: float | None = None
    hash: str | None = None
    nside: int | None = None
    unit: str | None = None
    columns: tuple[str, ...] = ()
    lmax: int | None = None


class ProductSet(NamedTuple):
    """Names of files that belong together because one analysis needs them all."""

    title: str
    files: tuple[str, ...]


@cache
def product_sets() -> dict[str, ProductSet]:
    """Return all sets by name."""
    sets = packaged("products.toml")["sets"].items()
    return {name: ProductSet(entry["title"], tuple(entry["files"])) for name, entry in sets}


@cache
def catalogue() -> dict[str, Product]:
    """Return all products by file name."""
    found, table = {}, packaged("products.toml")
    for group, common in table["groups"].items():
        for name, entry in common["files"].items():
            said = common | entry | {"name": name, "group": group}
            del said["files"]
            addresses = tuple(table["sources"][source] + name for source in said.pop("sources"))
            columns = tuple(said.pop("columns", ()))
            found[name] = Product(**said, addresses=addresses, columns=columns)
    return found


def find(words: Sequence[str] = ()) -> list[Product]:
    """Find products by name, group, part of either, or set; without words, return all."""
    products = list(catalogue().values())
    if not words:
        return products
    found: dict[str, Product] = {}
    for word in words:
        members = product_sets()[word].files if word in product_sets() else ()
        exact = [p for p in products if word in (p.name, p.group) or p.name in members]
        part = word.lower()
        these = exact or [p for p in products if part in p.name.lower() or part in p.group]
        if not these:
            groups = ", ".join(dict.fromkeys(p.group for p in products))
            raise ValueError(
                f"There is no product {word!r}; give the name of a file, a part of one, a "
                f"group: {groups}; or a set: {', '.join(product_sets())}."
            )
        found |= {p.name: p for p in these}
    return list(found.values())


def in_words(size: float) -> str:
    """Format a number of bytes with a unit."""
    return decimal(int(size), precision=int(size >= 1e9))


def total_size(products: Sequence[Product]) -> str:
    """Return the total size of products in words, "about" unless each is known exactly."""
    sizes = [p.size if p.size or p.about is None else 1e6 * p.about for p in products]
    known = sum(size for size in sizes if size is not None)
    size = in_words(known)
    if None in sizes:
        return f"more than {size}" if known else "of unknown size"
    return size if all(p.size is not None for p in products) else f"about {size}"


#: File with the hashes that downloads had, for products without a hash in the catalogue.
CHECKSUMS = "checksums.json"
_HASH = re.compile(r"(sha256|md5):[0-9a-f]+")
_MOVE = "move it away to go on without the hashes in it."


class DownloadError(ValueError):
    """A file that could not be downloaded; one sentence."""


def checksums(folder: Path) -> dict[str, str]:
    """Return the recorded hashes by name; raise InputError if the record is damaged."""
    path = folder / CHECKSUMS
    try:
        known = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {_MOVE}") from None
    if not isinstance(known, dict) or not all(_HASH.fullmatch(str(h)) for h in known.values()):
        raise InputError(f"{path}: is damaged, it holds other things than hashes; {_MOVE}")
    return known


def recorded(product: Product, folder: Path) -> Product:
    """Return a product with its recorded hash; if that is not the catalogue's, of any size."""
    known = checksums(folder).get(product.name, product.hash)
    return product._replace(hash=known, size=product.size if known == product.hash else None)


def _hash_like(other: str, path: Path) -> str:
    """Return the hash of a file, by the algorithm of another hash."""
    algorithm = other.partition(":")[0]
    return f"{algorithm}:{pooch.file_hash(str(path), alg=algorithm)}"


def remember(product: Product, folder: Path, path: Path) -> None:
    """Record the hash of a product's downloaded file."""
    found = _hash_like(product.hash or "sha256:", path)
    with locked(folder / f".{CHECKSUMS}.lock"):
        known = checksums(folder) | {product.name: found}
        new = folder / f".{CHECKSUMS}.new"
        new.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n")
        os.replace(new, folder / CHECKSUMS)


def verify(product: Product, folder: Path) -> str:
    """Check a product's file in a folder; return in words what was checked."""
    path = folder / product.name
    if not path.is_file():
        raise InputError(f"{path}: is not there; fetch it with `jaxsky data fetch`.")
    return ", ".join(check_product(recorded(product, folder), path))


def check_product(product: Product, path: Path, hint: str = "") -> list[str]:
    """Check that a file is complete and as the catalogue says; return what was checked.

    Only the headers and ends of FITS tables are read, unless there is a hash to check. `hint` is
    advice for a different size or hash.
    """
    structure, size = _check_structure(product, path), path.stat().st_size
    if product.size not in (None, size):
        raise InputError(f"{path}: has {size} bytes, but should have {product.size}{hint}.")
    if product.hash is None:
        return structure
    if (found := _hash_like(product.hash, path)) != product.hash:
        raise InputError(f"{path}: has the hash {found}, but should have {product.hash}{hint}.")
    return ["hash", *structure]


def _check_structure(product: Product, path: Path) -> list[str]:
    with path.open("rb") as file:
        start = file.read(512)
    shown = " ".join(start[:60].decode("ascii", "replace").split())
    if not start:
        raise InputError(f"{path}: is empty.")
    if product.name.endswith(".fits"):
        if not is_fits(path):
            raise InputError(f"{path}: is no FITS file, it begins with {shown!r}.")
        with open_fits(path) as hdus:
            if is_cut(path, hdus):
                raise UnfitError("not a FITS file, or a truncated one.")
        if product.nside is None:
            return ["complete"]
        with open_table(path, 1) as table:
            _check_maps(table, product)
        return ["columns", "complete"]
    if start.lstrip().startswith(b"<"):
        raise InputError(f"{path}: is no table, it begins with {shown!r}.")
    if product.lmax is not None:
        read_spectra(path, product.lmax)
        if not path.read_bytes().endswith(b"\n"):
            raise InputError(f"{path}: ends in the middle of a line.")
    return ["complete"]


def _check_maps(table: HealpixTable, product: Product) -> None:
    if table.nside != product.nside:
        raise UnfitError(f"nside is {table.nside}, but {product.nside} is expected.")
    for name in product.columns:
        text = table.unit(table.index(name))
        # Hits and covariances have other units.
        other = name.upper() in ("N_OBS", "HITS") or name.endswith("_COV")
        if product.unit is None or other or text is None:
            continue
        with suppress(ValueError):
            text = unit_name(text)
        if text not in (product.unit, product.unit.replace("_CMB", "").replace("_RJ", "")):
            raise UnfitError(f"column {name} is in {text}, but {product.unit} is expected.")
