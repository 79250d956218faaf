"""Official data products: what there is, where, and in which format; download and checks."""

from jaxsky.archive.checking import verify
from jaxsky.archive.download import DownloadError, cache_folder, fetch
from jaxsky.archive.products import Product, catalogue, find

__all__ = [
    "DownloadError",
    "Product",
    "cache_folder",
    "catalogue",
    "fetch",
    "find",
    "verify",
]
