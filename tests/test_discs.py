"""The paper's patches: where they are, how large, and how they fall off."""

import healpy
import numpy as np
import pytest

from fits.discs import BICEP2, bicep2_mask, disc_centers, disc_mask, paper_patches
from fits.tensor_ratio import ring_functions, zonal
from jaxsky.harmonics import alm_from_healpy, analysis, smooth, synthesis

SQUARE_DEGREES = 4 * np.pi * np.degrees(1) ** 2


def test_the_paper_has_48_discs():
    assert disc_centers().shape == (2, 48)
    assert disc_centers(8).shape == (2, 224)
    assert np.abs(disc_centers()[1]).min() > 45


def test_a_disc_is_the_smoothed_one():
    """In closed form, against smoothing the pixels of a disc, whose edge is ragged."""
    nside = 512
    mask = disc_mask(nside, 30.0, 50.0)
    sharp = np.zeros(mask.size)
    middle = healpy.ang2vec(30.0, 50.0, lonlat=True)
    sharp[healpy.query_disc(nside, middle, np.radians(11.3))] = 1
    smoothed = np.asarray(smooth(sharp[None], 120.0))[0]
    assert np.abs(mask - smoothed).max() < 0.01
    # Smoothing keeps the area: 400 square degrees.
    assert mask.mean() * SQUARE_DEGREES == pytest.approx(400, rel=2e-3)
    assert mask.max() == pytest.approx(1, abs=1e-6)
    assert mask.min() == 0


def test_a_disc_is_where_it_should_be():
    mask = disc_mask(64, 200.0, -60.0)
    directions = np.array(healpy.pix2vec(64, np.arange(mask.size)))
    lon, lat = healpy.vec2ang((directions * mask).sum(axis=1), lonlat=True)
    assert lon[0] == pytest.approx(200, abs=0.1)
    assert lat[0] == pytest.approx(-60, abs=0.1)


def test_the_field_of_bicep2():
    mask = bicep2_mask(64)
    half, south, north = BICEP2
    area = 2 * half * np.degrees(np.sin(np.radians(north)) - np.sin(np.radians(south)))
    assert area == pytest.approx(800, rel=0.02)  # as the paper says
    assert mask.mean() * SQUARE_DEGREES == pytest.approx(area, rel=0.02)
    patches = paper_patches(16)
    assert len(patches) == 49
    assert list(patches)[-1] == "BICEP2"
    # Its middle, at right ascension 0 and declination -57.5 deg.
    lon, lat = healpy.Rotator(coord=["C", "G"])(0.0, -57.5, lonlat=True)
    assert patches["BICEP2"][healpy.ang2pix(16, lon, lat, lonlat=True)] > 0.9


def test_harmonics_on_a_ring():
    nside, lmax = 16, 20
    orders = np.array([1, 3])
    theta, phi = healpy.pix2ang(nside, np.array([500, 900]))
    for spin in (0, 1, 2):
        functions = ring_functions(spin, lmax, theta, orders)
        for i, m in enumerate(orders):
            alm = np.zeros(healpy.Alm.getsize(lmax), complex)
            alm[healpy.Alm.getidx(lmax, 12, m)] = 1
            packed = np.stack([alm_from_healpy(alm, lmax), np.zeros((lmax + 1) ** 2)])
            maps = np.asarray(synthesis(packed[: 1 + (spin > 0)], nside, spin=spin or 2))
            # A real map has m and -m.
            found = 2 * np.real(functions[:, i, 12] * [[1], [1j]] * np.exp(1j * m * phi))
            np.testing.assert_allclose(found[: len(maps)], maps[:, [500, 900]], atol=1e-12)


def test_only_discs_are_symmetric():
    nside, lmax = 64, 64
    alm, bicep2 = (
        np.asarray(analysis(mask[None], lmax)[0])
        for mask in (disc_mask(nside, 200.0, -30.0, 15.0, 5.0), bicep2_mask(nside))
    )
    assert zonal(bicep2) is None
    # About its middle a disc is what it is about the pole.
    pole = np.asarray(analysis(disc_mask(nside, 0.0, 90.0, 15.0, 5.0)[None], lmax)[0])
    np.testing.assert_allclose(zonal(alm), pole[: lmax + 1], atol=1e-4)
    whole = np.asarray(analysis(np.ones((1, 12 * nside**2)), lmax)[0])
    np.testing.assert_allclose(
        zonal(whole), np.sqrt(4 * np.pi) * (np.arange(lmax + 1) == 0), atol=1e-6
    )


def test_refusals():
    for radius, fwhm in ((2.0, 3.0), (2.0, 0.0), (200.0, 2.0)):
        with pytest.raises(ValueError, match="must be positive and not wider than the disc's"):
            disc_mask(8, 0.0, 90.0, radius, fwhm)


@pytest.mark.parametrize(("lon", "lat"), [(np.nan, 60.0), (0.0, 95.0), (0.0, np.nan)])
def test_directions_that_are_none(lon, lat):
    with pytest.raises(ValueError, match="`lon` and `lat` must be a direction in degrees"):
        disc_mask(16, lon, lat)
