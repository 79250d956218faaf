"""The paper's patches: where they are, and power laws on them, over simulated skies."""

import functools
import re

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fits.discs import BICEP2, bicep2_mask, disc_centers, disc_mask, paper_patches
from fits.patches import (
    EDGES,
    BandCombinations,
    decorrelate,
    fit_patches,
    minimise,
    prepare_patches,
)
from fits.tensor_ratio import ring_functions, zonal
from jaxsky.cmb import gaussian_fields
from jaxsky.harmonics import alm_from_healpy, analysis, gaussian_beam, smooth, synthesis
from refusals import raises

NSIDE, LMAX = 64, 128
ELL = np.arange(LMAX + 1)
WINDOW = np.asarray(gaussian_beam(60.0, LMAX))
SLOPE = -2.42
TO_C = np.where(ELL > 1, 2 * np.pi / np.maximum(ELL * (ELL + 1), 1), 0.0)
#: C_l of EE and BB as seen, of dust, whose E is twice its B.
TRUTH = np.array([2.0, 1.0])
SEEN = TRUTH[:, None] * TO_C * (np.maximum(ELL, 2) / 80) ** (SLOPE + 2) * WINDOW**2
#: White noise with the power that BB has at l = 80.
NOISE = np.where(ELL > 1, SEEN[1, 80], 0.0)


@functools.cache
def patches(count=None):
    """Discs that do not overlap: independent, and all of one shape."""
    centers = disc_centers(2, 15.0).T[:count]
    discs = {f"{lon:.0f} {lat:.0f}": disc_mask(NSIDE, lon, lat) for lon, lat in centers}
    return prepare_patches(discs, WINDOW)


@jax.jit
def sky(key, EE, BB):
    zero = jnp.zeros_like(EE)
    spectra = jnp.stack([jnp.stack([EE, zero]), jnp.stack([zero, BB])])
    return synthesis(gaussian_fields(key, spectra), NSIDE)


def simulated(noise, count, cross=False, signal=1.0):
    """Fits to skies with noise, one after the other: A / true A, alpha, and their errors."""
    rows = []
    for key in jax.random.split(jax.random.key(1), count):
        one, *others = jax.random.split(key, 3)
        maps = sky(one, *(signal * jnp.asarray(SEEN)))
        maps, other = (maps + sky(k, *2 * [jnp.asarray(noise * NOISE)]) for k in others)
        given = {"other": other} if cross else {"noise": noise * NOISE}
        rows.append(fit_patches(maps, patches(), **given))
    A, alpha, covariance = (
        np.concatenate([getattr(row, name) for row in rows])
        for name in ("A", "alpha", "covariance")
    )
    A_error, alpha_error = np.sqrt([covariance[..., 0, 0], covariance[..., 1, 1]])
    return A / TRUTH, alpha, A_error / TRUTH, alpha_error, rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "cross"), [(0.0, False), (1.0, False), (1.0, True)], ids=["clean", "noisy", "cross"]
)
def test_amplitudes_and_slopes_are_true_on_average_with_the_right_errors(noise, cross):
    A, alpha, A_error, alpha_error, rows = simulated(noise, 7, cross)
    n = len(A)
    # Linear equations have a zero mean; their solution, a bias of second order in errors of 20 to
    # 40 %: with 2000 discs A is 1 to 2 % low.
    spread = A.std(axis=0)
    np.testing.assert_array_less(np.abs(A.mean(axis=0) - 1), 0.02 + 3 * spread / np.sqrt(n))
    bias = (alpha.mean(axis=0) - SLOPE) / alpha.std(axis=0)
    np.testing.assert_array_less(np.abs(bias), 0.1 + 3 / np.sqrt(n))
    # Standard deviations of 280 pulls are known to 4 %. An alpha that noise leaves open is held
    # by its prior, the error is that of the posterior.
    for pulls, lowest in (((A - 1) / A_error, 0.9), ((alpha - SLOPE) / alpha_error, 0.75)):
        np.testing.assert_array_less(pulls.std(axis=0), 1.2)
        np.testing.assert_array_less(lowest, pulls.std(axis=0))
    assert all(row.converged.all() for row in rows)
    # Fits are good, and no better than they should be.
    pte = np.concatenate([row.pte for row in rows])
    np.testing.assert_allclose(np.mean(pte < 0.5, axis=0), 0.5, atol=0.5 * 4 / np.sqrt(n))
    np.testing.assert_array_less(np.mean(pte < 0.01, axis=0), 0.05)


@pytest.mark.slow
def test_another_slope_is_found():
    """The prior does not make the answer, and neither does the slope that errors are taken for."""
    steeper = TO_C * (np.maximum(ELL, 40) / 80) ** (-4.5 + 2) * WINDOW**2
    found = [
        fit_patches(sky(key, *2 * [jnp.asarray(steeper)]), patches())
        for key in jax.random.split(jax.random.key(2), 4)
    ]
    alpha = np.concatenate([one.alpha for one in found])
    # Errors of 1 and a prior of 3 around -2.4 leave 0.9 of the difference.
    expected = -4.5 + 2.1 * 0.1
    np.testing.assert_allclose(alpha.mean(axis=0), expected, atol=0.35)


@pytest.mark.slow
def test_noise_alone_is_no_detection():
    A, _, A_error, alpha_error, rows = simulated(1.0, 4, signal=0.0)
    for name in ("A", "alpha", "covariance", "chi2", "pte", "powers", "errors"):
        assert all(np.isfinite(getattr(row, name)).all() for row in rows)
    assert np.mean([row.detected for row in rows]) < 0.1
    assert np.abs(A.mean(axis=0) / A.std(axis=0)).max() < 4 / np.sqrt(len(A))
    assert np.mean(np.abs(A) < 2 * A_error) > 0.85
    # All there is is the prior.
    assert np.median(alpha_error) > 2
    np.testing.assert_array_less(alpha_error, 3.0001)


@pytest.mark.slow
def test_units_do_not_matter():
    maps = sky(jax.random.key(3), *jnp.asarray(SEEN + NOISE))
    one = fit_patches(maps, patches(4), noise=NOISE)
    other = fit_patches(1e-6 * maps, patches(4), noise=1e-12 * NOISE)
    np.testing.assert_allclose(1e12 * other.A, one.A, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(other.alpha, one.alpha, atol=1e-4)
    np.testing.assert_allclose(1e24 * other.covariance[..., 0, 0], one.covariance[..., 0, 0], 1e-5)


@pytest.mark.slow
def test_noise_may_be_a_level_or_a_spectrum():
    level = 30.0
    maps = sky(jax.random.key(4), *jnp.asarray(SEEN))
    white = np.full(LMAX + 1, np.radians(level / 60) ** 2)
    one = fit_patches(maps, patches(), noise=level)
    for shape in ((LMAX + 1,), (2, LMAX + 1), (len(patches().names), 2, LMAX + 1)):
        other = fit_patches(maps, patches(), noise=np.broadcast_to(white, shape))
        np.testing.assert_allclose(other.A, one.A, rtol=1e-10)
    none = fit_patches(maps, patches())
    assert np.all(none.powers > one.powers)
    # That of one patch is its own matter.
    rows = np.zeros((len(patches().names), 2, LMAX + 1))
    rows[1] = white
    other = fit_patches(maps, patches(), noise=rows)
    np.testing.assert_allclose(other.powers[1], one.powers[1])
    np.testing.assert_allclose(other.powers[2], none.powers[2])


def test_a_single_clean_band_of_chi2_is_its_own_amplitude():
    """For independent bands without noise the amplitude is the mean over the modes."""
    nu, data = np.array([[4.0, 10.0, 30.0]]), np.array([[0.7, 1.3, 1.1]])
    laws = np.zeros((1, 3, LMAX + 1))
    laws[0, :, 80] = 1.0  # no slope in it
    bands = BandCombinations(data, nu, 0 * nu, 1e-3 + 0 * nu, laws)
    A, alpha, *_, good = minimise(
        jax.tree.map(jnp.asarray, bands), jnp.array([-2.4, 3.0]), (40, 100)
    )
    assert bool(good[0])
    assert float(A[0]) == pytest.approx(np.sum(nu * data) / np.sum(nu), rel=1e-5)
    assert float(alpha[0]) == pytest.approx(-2.4)


def test_decorrelated_bands():
    rng = np.random.default_rng(0)
    expected = np.array([1.0, 2.0, 3.0])
    root = np.eye(3) + 0.2 * rng.random((3, 3))
    covariance = root @ root.T
    turn = decorrelate(covariance, expected)
    np.testing.assert_allclose(turn @ expected, expected)
    turned = turn @ covariance @ turn.T
    np.testing.assert_allclose(turned, np.diag(np.diag(turned)), atol=1e-12)
    # Strong correlations of unequal bands: a combination would measure the negative.
    covariance = np.array([[1.0, 0.95], [0.95, 1.0]])
    np.testing.assert_array_equal(decorrelate(covariance, np.array([1.0, 0.1])), np.eye(2))


@pytest.mark.slow
def test_patches_of_one_shape_share_their_covariance():
    north, south = disc_mask(NSIDE, 10.0, 60.0), disc_mask(NSIDE, 200.0, -50.0)
    masks = {"north": north, "south": south, "field": bicep2_mask(NSIDE)}
    found = prepare_patches(masks, WINDOW)
    assert found.shapes == (0, 0, 2)
    assert set(patches(4).shapes) == {0}
    fits = fit_patches(sky(jax.random.key(5), *jnp.asarray(SEEN)), found)
    # Twice the area: smaller errors.
    error = np.sqrt(fits.covariance[..., 0, 0]) / fits.A
    assert np.all(error[2] < 0.9 * error[0])


def test_refusals():
    mask = disc_mask(NSIDE, 0.0, 90.0)
    disc, small = {"north": mask}, {"dot": disc_mask(NSIDE, 0.0, 90.0, 2.0, 1.0)}
    for given, window, edges, words in (
        (small, WINDOW, EDGES, "Patch dot: The mask leaves too few pixels"),
        (disc, WINDOW[:100], EDGES, "Patch north: Argument `window` ends at l = 99, not at 128"),
        (disc, WINDOW, (40, 70, 101), "`edges` must give three bins at least"),
        (disc, WINDOW, (40, 60, 50, 101), "Patch north: Argument `edges` must increase from 2"),
        (disc, WINDOW, (40, 90, 120, 150), "`lmax` must be between the end of the bins, 149"),
        ({}, WINDOW, EDGES, "Argument `patches` has no patch in it"),
    ):
        raises(ValueError, re.escape(words), prepare_patches, given, window, edges=edges)
    prepared = prepare_patches(disc, WINDOW)
    maps = np.asarray(sky(jax.random.key(6), *jnp.asarray(SEEN)))
    hole = np.where(mask == 1, healpy.UNSEEN, maps)
    for given, options, words in (
        (maps[:1], {}, "Argument `maps` must have shape (2, 49152), but has shape (1, 49152)"),
        (hole, {}, "Patch north: Argument `maps` has 120 of 98304 values that are"),
        (
            maps,
            {"other": np.where(mask > 0, np.nan, maps)},
            "Argument `other` has 1680 of 98304 values",
        ),
        (maps, {"noise": -1.0}, "Argument `noise` has values that are negative or not finite"),
        (maps, {"noise": np.ones(100)}, "reach l = 128, but has shape (100,)"),
        (maps, {"noise": np.ones((3, 2, 200))}, "Argument `noise` must be a level or have shape"),
        (maps, {"slope": (-2.4, 0.0)}, "Argument `slope` must be a mean and a positive width"),
        (0 * maps, {}, "The patch north has neither signal nor noise"),
    ):
        raises(ValueError, re.escape(words), fit_patches, given, prepared, **options)
    # What is not used may hold anything.
    outside = np.where(mask > 0, maps, np.nan)
    np.testing.assert_array_equal(
        fit_patches(outside, prepared, other=outside).A, fit_patches(maps, prepared, other=maps).A
    )


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


def test_discs_that_are_none():
    for radius, fwhm in ((2.0, 3.0), (2.0, 0.0), (200.0, 2.0)):
        with pytest.raises(ValueError, match="must be positive and not wider than the disc's"):
            disc_mask(8, 0.0, 90.0, radius, fwhm)


@pytest.mark.parametrize(("lon", "lat"), [(np.nan, 60.0), (0.0, 95.0), (0.0, np.nan)])
def test_directions_that_are_none(lon, lat):
    with pytest.raises(ValueError, match="`lon` and `lat` must be a direction in degrees"):
        disc_mask(16, lon, lat)
