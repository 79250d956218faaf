"""Ranges of pixels of files are those of the whole maps."""

import healpy
import numpy as np
import pytest

from jaxsky.io import InputError, read_maps
from jaxsky.mesh import distribute
from mapfiles import NSIDE, save
from refusals import raises

NPIX = healpy.nside2npix(NSIDE)
RANGES = [slice(0, NPIX), slice(0, 1), slice(100, 333), slice(NPIX - 5, NPIX)]


def values(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=NPIX)


def with_holes() -> np.ndarray:
    found = values()
    found[[3, 200, 300]] = [np.nan, healpy.UNSEEN, np.inf]
    return found


def as_rows(maps: np.ndarray) -> np.ndarray:
    return maps.reshape(-1, 16)


LISTED = np.random.default_rng(4).permutation(NPIX)[: NPIX // 2]
FILES = {
    "RING": ({"Q": with_holes(), "U": values(1)}, {}),
    "NESTED": ({"Q": with_holes(), "U": values(1)}, {"ORDERING": "NESTED"}),
    "rows of several pixels": (
        {"Q": as_rows(with_holes()), "U": as_rows(values(1))},
        {"formats": dict.fromkeys("QU", "16E"), "ORDERING": "NESTED"},
    ),
    "IAU": ({"Q": values(), "U": values(1)}, {"POLCCONV": "IAU"}),
    "listed": (
        {"PIXEL": LISTED, "Q": values()[LISTED], "U": values(1)[LISTED]},
        {"formats": {"PIXEL": "J"}, "INDXSCHM": "EXPLICIT", "ORDERING": "NESTED"},
    ),
    "integers": (
        {"Q": np.arange(NPIX) * 7 % 31, "U": np.arange(NPIX)},
        {"formats": dict.fromkeys("QU", "J"), "TNULL1": 5, "TSCAL2": 0.5, "TZERO2": 3.0},
    ),
    "a value that is marked": ({"Q": with_holes(), "U": values(1)}, {"BAD_DATA": values()[7]}),
}


@pytest.mark.parametrize("kind", FILES)
def test_a_range_is_that_of_the_whole_map(kind, tmp_path):
    columns, header = FILES[kind]
    path = save(tmp_path / "map.fits", columns, units="uK_CMB", **header)
    options = {"fields": ["Q", "U"], "missing": []}
    whole = read_maps(path, **options)
    expected = whole.filled()
    assert whole.mask.sum() > 0

    def read(part):
        found = read_maps(path, pixels=part, **options)
        assert (found.nside, found.unit) == (whole.nside, whole.unit)
        return found.filled()

    for part in RANGES:
        np.testing.assert_array_equal(read(part), expected[:, part])
    converted = read_maps(path, pixels=RANGES[2], **options).to("uK_RJ", at=100.0).filled()
    np.testing.assert_allclose(converted, expected[:, RANGES[2]] * 0.7769, rtol=1e-3)
    maps = distribute(read, shape=(2, NPIX))
    np.testing.assert_array_equal(maps, expected)


@pytest.mark.parametrize(
    ("header", "pixels", "words"),
    [
        ({"COORDSYS": "C"}, slice(0, 10), "coordinates C, and a range of pixels cannot be rotated"),
        ({}, slice(0, NPIX + 1), f"argument `pixels` must be a range from 0 to {NPIX}, not slice"),
        ({}, slice(5, 5), "argument `pixels` must be a range"),
        ({"ORDERING": None}, slice(0, 10), "the header has no ORDERING; give `ordering`"),
        ({"COORDSYS": None}, slice(0, 10), "the header has no COORDSYS; give `coordinates`"),
    ],
)
def test_what_has_no_ranges_is_refused(header, pixels, words, tmp_path):
    path = save(tmp_path / "map.fits", {"Q": values(), "U": values(1)}, units="uK_CMB", **header)
    raises(InputError, words, read_maps, path, pixels=pixels)
