"""What the archives hold, from `products.toml`."""

import tomllib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

__all__ = ["Product", "catalogue", "find"]


class Product(NamedTuple):
    """A file of an archive.

    Parameters
    ----------
    name : of the file
    group, title, what : its group, what that is, and what this one is
    addresses : where it can be had, best first
    size : in bytes, None where it is not known exactly
    hash : "sha256:..." or "md5:...", None where none is known
    nside : resolution, None if it holds no maps
    unit : of the maps, as `jaxsky.units` has it; None if there is none
    columns : that the first table has, at least
    """

    name: str
    group: str
    title: str
    what: str
    addresses: tuple[str, ...]
    size: int | None = None
    hash: str | None = None
    nside: int | None = None
    unit: str | None = None
    columns: tuple[str, ...] = ()


def _product(
    name: str, entry: dict[str, Any], group: str, common: dict[str, Any], sources: dict[str, str]
) -> Product:
    said = {k: v for k, v in common.items() if k != "files"} | entry
    addresses = tuple(sources[source] + name for source in said.pop("sources"))
    columns = tuple(said.pop("columns", ()))
    return Product(name=name, group=group, addresses=addresses, columns=columns, **said)


@cache
def catalogue() -> dict[str, Product]:
    """All products by the name of their file.

    Examples
    --------
    >>> catalogue()["wmap_band_iqumap_r9_9yr_K_v5.fits"].unit
    'mK_CMB'
    """
    table = tomllib.loads((files("jaxsky.archive") / "products.toml").read_text())
    return {
        name: _product(name, entry, group, common, table["sources"])
        for group, common in table["groups"].items()
        for name, entry in common["files"].items()
    }


def find(words: Sequence[str] = ()) -> list[Product]:
    """Products by name, group, or a part of either; all without any.

    Raises
    ------
    ValueError
        If nothing is found for a word.
    """
    products = list(catalogue().values())
    if not words:
        return products
    found: dict[str, Product] = {}
    for word in words:
        exact = [p for p in products if word in (p.name, p.group)]
        part = word.lower()
        these = exact or [p for p in products if part in p.name.lower() or part in p.group]
        if not these:
            groups = ", ".join(dict.fromkeys(p.group for p in products))
            raise ValueError(
                f"There is no product {word!r}; give the name of a file, a part of one, or a "
                f"group: {groups}."
            )
        found |= {p.name: p for p in these}
    return list(found.values())
