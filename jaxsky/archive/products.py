"""What the archives hold, from `products.toml`."""

import tomllib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple


class Product(NamedTuple):
    """A file of an archive.

    Parameters
    ----------
    name : of the file
    group, title, what : its group, what that is, and what this one is
    addresses : where it can be had, best first
    size : in bytes, None where it is not known exactly
    about : in MB, where only that is known
    hash : "sha256:..." or "md5:...", None where none is known
    nside : resolution, None if it holds no maps
    unit : of the maps, as `jaxsky.units` has it; None if there is none
    columns : that the first table has, at least
    lmax : last multipole of a table of spectra, None for other files
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
    """Files that belong together, by their names: what one analysis takes."""

    name: str
    title: str
    files: tuple[str, ...]


def _product(
    name: str, entry: dict[str, Any], group: str, common: dict[str, Any], sources: dict[str, str]
) -> Product:
    said = {k: v for k, v in common.items() if k != "files"} | entry
    addresses = tuple(sources[source] + name for source in said.pop("sources"))
    columns = tuple(said.pop("columns", ()))
    return Product(name=name, group=group, addresses=addresses, columns=columns, **said)


def _table() -> dict[str, Any]:
    return tomllib.loads((files("jaxsky.archive") / "products.toml").read_text())


@cache
def product_sets() -> dict[str, ProductSet]:
    """All sets by name.

    Examples
    --------
    >>> len(product_sets()["planck-44-70"].files)
    5
    """
    return {
        name: ProductSet(name, entry["title"], tuple(entry["files"]))
        for name, entry in _table()["sets"].items()
    }


@cache
def catalogue() -> dict[str, Product]:
    """All products by the name of their file.

    Examples
    --------
    >>> catalogue()["wmap_band_iqumap_r9_9yr_K_v5.fits"].unit
    'mK_CMB'
    """
    table = _table()
    return {
        name: _product(name, entry, group, common, table["sources"])
        for group, common in table["groups"].items()
        for name, entry in common["files"].items()
    }


def find(words: Sequence[str] = ()) -> list[Product]:
    """Products by name, group, or a part of either, or by the name of a set; all without any."""
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
    """A number of bytes with its unit.

    Examples
    --------
    >>> in_words(771840), in_words(1.8e9)
    ('772 kB', '1.8 GB')
    """
    if size >= 1e9:
        return f"{size / 1e9:.1f} GB"
    return f"{size / 1e6:.0f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


def total_size(products: Sequence[Product]) -> str:
    """The size of products together, in words; "about" unless that of each is known exactly.

    Examples
    --------
    >>> total_size(find(["wmap9"])), total_size(find(["planck-44-70"]))
    ('503 MB', 'about 1.8 GB')
    """
    sizes = [p.size if p.size or p.about is None else 1e6 * p.about for p in products]
    known = sum(size for size in sizes if size is not None)
    size = in_words(known)
    if None in sizes:
        return f"more than {size}" if known else "of unknown size"
    return size if all(p.size is not None for p in products) else f"about {size}"
