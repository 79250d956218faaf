"""Official data products: what there is, where, and in which format; download and checks."""

from jaxsky.archive.download import fetch
from jaxsky.archive.products import (
    DownloadError,
    Product,
    ProductSet,
    catalogue,
    find,
    product_sets,
    total_size,
    verify,
)
from jaxsky.io.folders import cache_folder
