"""Official data products: what there is, where, and in which format; download and checks."""

from jaxsky.archive.cache import DownloadError
from jaxsky.archive.checking import verify
from jaxsky.archive.download import fetch
from jaxsky.archive.products import Product, ProductSet, catalogue, find, product_sets, total_size
from jaxsky.io.folders import cache_folder
