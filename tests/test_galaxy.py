"""The embedded sky: closed forms, symmetries, the seed, gradients, and the real sky."""

import builtins
import dataclasses

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky import observe_band
from jaxsky.bandpass import Bandpass
from jaxsky.galaxy import (
    DUST_RMS,
    STEPS,
    SYNCHROTRON_RMS,
    GalaxyModel,
    _turbulence,
    embedded_sky,
    line_of_sight,
    magnetic_field,
)
from jaxsky.harmonics import alm_ell, analysis
from jaxsky.inputs import default_galaxy
from refusals import cases, raises

NAMES = [field.name for field in dataclasses.fields(GalaxyModel)]


def lonlat(nside):
    """l in (-180, 180] and b of the pixels [deg]."""
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    return (lon + 180) % 360 - 180, lat


def low_multipoles(maps, lmax):
    ell = alm_ell(full := 3 * healpy.npix2nside(maps.shape[-1]) - 1)
    return np.array(analysis(jnp.asarray(maps), full))[:, ell <= lmax]


@pytest.fixture(scope="module")
def galaxy():
    return embedded_sky(64, seed=0)


@pytest.fixture(scope="module")
def fine_galaxy():
    return embedded_sky(128, seed=0)


def test_uniform_field_has_the_closed_form():
    # Very far from the centre the field is uniform, towards l = 90 - 27 degrees, and the densities
    # depend on z only: their integral is height / |sin b|.
    model = GalaxyModel(
        r_sun=1e7, psi1=0, chi0=0, turbulence=0, electron_radius=1e12, dust_radius=1e12
    )
    nside, height = 16, float(model.dust_height)
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    away = abs(np.cos(theta)) > 0.3
    dust, synchrotron = np.array(line_of_sight(model, nside, steps=400))[..., away]
    theta, phi = theta[away], phi[away]
    field = np.deg2rad(63.0)
    # Components of the field along theta_hat and phi_hat, and along the line of sight.
    south, east = np.cos(theta) * np.cos(phi - field), -np.sin(phi - field)
    along = np.sin(theta) * np.cos(phi - field)
    angle = np.arctan2(east, south) + np.pi / 2
    across = 1 - along**2
    depth = 1 / abs(np.cos(theta))
    np.testing.assert_allclose(synchrotron[0], depth * across, rtol=1e-4)
    polarized = np.array([np.cos(2 * angle), np.sin(2 * angle)]) * across
    np.testing.assert_allclose(synchrotron[1:], 0.75 * depth * polarized, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(dust[0], height * depth * (1 - 0.2 * (across - 2 / 3)), rtol=1e-4)
    np.testing.assert_allclose(dust[1:], 0.2 * height * depth * polarized, rtol=1e-4, atol=1e-6)


def test_toroidal_field_is_seen_alike_after_half_a_turn_about_the_direction_to_the_centre():
    maps = line_of_sight(GalaxyModel(psi0=0, psi1=0, chi0=0, turbulence=0), 16)
    theta, phi = healpy.pix2ang(16, np.arange(healpy.nside2npix(16)))
    turned = healpy.ang2pix(16, np.pi - theta, -phi)
    np.testing.assert_allclose(maps, maps[..., turned], atol=1e-9)
    lon, lat = lonlat(16)
    plane = (lat == 0) & (abs(lon) > 30)
    assert np.all(np.array(maps[:, 1])[:, plane] > 0)
    np.testing.assert_allclose(maps[:, 2][:, plane], 0, atol=1e-9)


def test_the_regular_field_is_mirrored_at_the_plane():
    maps = line_of_sight(GalaxyModel(turbulence=0), 16)
    theta, phi = healpy.pix2ang(16, np.arange(healpy.nside2npix(16)))
    mirror = healpy.ang2pix(16, np.pi - theta, phi)
    # Not towards the centre, around which the field is vertical.
    away = abs(lonlat(16)[0]) > 30
    mirrored = maps[..., mirror] * jnp.array([1, 1, -1])[:, None]
    np.testing.assert_allclose(maps[..., away], mirrored[..., away], atol=1e-9)


def test_field_direction_and_strength():
    here = np.array(magnetic_field(GalaxyModel(), -8.0, 0.0, 0.0))
    # An axis, so up to 180 degrees.
    assert np.rad2deg(np.arctan2(here[1], here[0])) % 180 == pytest.approx(63.0)
    assert here[2] == pytest.approx(0.0)
    above = np.array(magnetic_field(GalaxyModel(), -3.0, 4.0, 30.0))
    assert np.linalg.norm(above) == pytest.approx(1.0)
    assert above[2] == pytest.approx(np.sin(np.deg2rad(25)))


@pytest.mark.parametrize("turbulence", [0.0, 0.9])
def test_emission_of_the_plane_is_polarized_across_it(turbulence):
    maps = np.array(line_of_sight(GalaxyModel(turbulence=turbulence), 32, seed=0))
    lon, lat = lonlat(32)
    for centre in (0, 180):
        near = (abs(lat) < 3) & (abs((lon - centre + 180) % 360 - 180) < 15)
        Q, U = maps[:, 1:, near].mean(axis=-1).T
        assert np.all(Q > 0)
        assert np.all(abs(U) < Q)


@pytest.mark.slow
def test_maps_have_the_brightness_of_the_real_sky(galaxy, fine_galaxy):
    for maps, rms in ((galaxy.dust, DUST_RMS), (galaxy.synchrotron, SYNCHROTRON_RMS)):
        assert np.hypot(*np.std(maps[1:], axis=-1)) == pytest.approx(rms, rel=1e-12)
        assert np.all(maps[0] > np.hypot(*maps[1:]))
    for maps, rms in ((fine_galaxy.dust, DUST_RMS), (fine_galaxy.synchrotron, SYNCHROTRON_RMS)):
        assert np.hypot(*np.std(maps[1:], axis=-1)) == pytest.approx(rms, rel=0.03)


@pytest.mark.slow
def test_one_seed_is_one_sky_at_every_resolution(galaxy, fine_galaxy):
    coarse = embedded_sky(16, seed=0)
    for name in ("dust", "synchrotron"):
        reference = low_multipoles(getattr(fine_galaxy, name), 20)
        for other in (coarse, galaxy):
            low = low_multipoles(getattr(other, name), 20)
            error = np.linalg.norm(low - reference, axis=1) / np.linalg.norm(reference, axis=1)
            assert np.all(error < 0.02)


def turbulence(nside, slope=-2.4):
    """Cartesian turbulent field, without the projection on the lines of sight."""
    basis = jnp.broadcast_to(jnp.eye(3)[..., None], (3, 3, healpy.nside2npix(nside)))
    return _turbulence(jax.random.key(5), slope, basis)


@pytest.mark.slow
def test_turbulence_is_a_power_law_whose_multipoles_do_not_depend_on_the_resolution():
    coarse, fine = turbulence(16), turbulence(64)
    shells = len(coarse)
    for shell, axis in ((0, 0), (shells - 1, 2)):
        low = [low_multipoles(field[shell, axis][None], 30) for field in (coarse, fine)]
        # What is left is of the analysis, which converges slowly for maps up to 3 nside - 1.
        np.testing.assert_allclose(*low, atol=5e-3 * np.abs(low[0]).max())
    rows = np.array(fine).reshape(3 * shells, -1)
    spectra = np.array([healpy.anafast(row, lmax=191) for row in rows])
    ell = np.arange(192)
    assert np.all(spectra[:, :2] < 1e-8)
    slope = np.polyfit(np.log(ell[20:]), np.log(spectra.mean(axis=0)[20:]), 1)[0]
    assert slope == pytest.approx(-2.4, abs=0.1)
    assert np.mean(rows**2) * 3 == pytest.approx(1.0, rel=0.2)
    correlation = np.corrcoef(rows) - np.eye(len(rows))
    assert abs(correlation).max() < 0.8
    assert abs(correlation.mean()) < 0.05


def test_seeds_differ():
    first, second, again = (line_of_sight(GalaxyModel(), 16, seed) for seed in (1, 2, 1))
    np.testing.assert_array_equal(first, again)
    for i in range(2):
        for j in (1, 2):
            assert np.std(first[i, j] - second[i, j]) > 0.05 * np.std(first[i, j])


@pytest.mark.slow
def test_power_on_all_scales(galaxy):
    lat = lonlat(64)[1]
    mask = healpy.smoothing((abs(lat) > 30).astype(float), fwhm=np.deg2rad(5)).clip(0, 1)
    ell = np.arange(192)
    for maps in (galaxy.dust, galaxy.synchrotron):
        for spectrum in healpy.anafast(np.array(maps) * mask, lmax=191)[1:3]:
            for use in (slice(10, 70), slice(70, 192)):
                slope = np.polyfit(np.log(ell[use]), np.log(spectrum[use]), 1)[0]
                assert -3.0 < slope < -1.9


@pytest.mark.slow
def test_steps_have_converged():
    reference = line_of_sight(GalaxyModel(), 16, steps=500)
    scale = np.std(reference, axis=-1)
    errors = [
        np.std(line_of_sight(GalaxyModel(), 16, steps=steps) - reference, axis=-1) / scale
        for steps in (48, STEPS)
    ]
    assert np.all(errors[0] < 5e-2)
    assert np.all(errors[1] < 2e-3)


@pytest.mark.slow
def test_gradients_of_all_parameters():
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, healpy.nside2npix(4))))
    # Scaled so that dust and synchrotron count alike.
    maps = line_of_sight(GalaxyModel(), 4, 1, steps=24)
    weights = weights / jnp.std(maps, axis=-1, keepdims=True)

    @jax.jit
    def loss(model):
        return jnp.sum(weights * line_of_sight(model, 4, 1, steps=24))

    gradient = jax.grad(loss)(GalaxyModel())
    for name in NAMES:
        value = float(getattr(GalaxyModel(), name))
        h = 1e-5 * abs(value)
        numeric = loss(GalaxyModel(**{name: value + h})) - loss(GalaxyModel(**{name: value - h}))
        exact = float(getattr(gradient, name))
        assert exact == pytest.approx(float(numeric) / (2 * h), rel=1e-5, abs=1e-6)
        assert abs(exact) > 1e-4


@pytest.mark.slow
def test_gradients_with_the_normalisation():
    def maps(scale):
        model = GalaxyModel(chi0=25.0 * scale, dust_height=0.2 * scale, slope=-2.4 * scale)
        galaxy = embedded_sky(8, 0, model, steps=24)
        return jnp.stack([galaxy.dust, galaxy.synchrotron])

    _, exact = jax.jvp(maps, (1.0,), (1.0,))
    numeric = (maps(1 + 1e-5) - maps(1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=1e-6 * float(abs(exact).max()))


def test_sky_has_the_baseline_of_the_paper(galaxy):
    sky = galaxy.sky()
    assert sky.shape == (2, 49152)
    assert galaxy.sky("IQU").shape == (3, 49152)
    np.testing.assert_array_equal(sky["dust"].amplitude, galaxy.dust[1:])
    assert float(sky["dust"].beta_dust) == 1.53
    assert float(sky["dust"].T_dust) == 21.0
    assert float(sky["synchrotron"].beta_syn) == 3.10
    assert (galaxy.nu_dust, galaxy.nu_synchrotron) == (353.0, 30.0)
    assert galaxy.nside == 64
    assert "not data" in galaxy.description
    assert "seed 0" in galaxy.description
    only = observe_band(sky, Bandpass.delta(30.0)) - galaxy.synchrotron[1:]
    assert np.std(only) < 0.05 * np.std(galaxy.synchrotron[1:])


@pytest.mark.parametrize(("make", "given", "error", "words"), cases("galaxy/bad_input"))
def test_bad_input_is_named(make, given, error, words):
    with pytest.raises(getattr(builtins, error), match=words):
        {"sky": embedded_sky, "model": GalaxyModel}[make](**given)


def test_unknown_stokes_are_named(galaxy):
    raises(ValueError, "`stokes` must be one of I, QU, IQU, not 'EB'", galaxy.sky, "EB")


@pytest.mark.parametrize(
    ("name", "file", "least_Q", "least_U"),
    [("dust", "dust_d1_353GHz_n64", 0.4, 0.1), ("synchrotron", "synch_s1_30GHz_n64", 0.7, 0.4)],
)
def test_resembles_the_real_sky(data_dir, galaxy, name, file, least_Q, least_U):
    real = healpy.read_map(data_dir / "templates" / f"{file}.fits", field=(0, 1, 2))
    rms = {"dust": DUST_RMS, "synchrotron": SYNCHROTRON_RMS}[name]
    assert np.hypot(*real[1:].std(axis=-1)) == pytest.approx(rms, rel=0.005)
    maps = [
        healpy.smoothing(np.array(m, float), fwhm=np.deg2rad(3))
        for m in (real, getattr(galaxy, name))
    ]
    correlate = lambda i, use: np.corrcoef(maps[0][i, use], maps[1][i, use])[0, 1]  # noqa: E731
    lat = lonlat(64)[1]
    assert correlate(1, slice(None)) > least_Q
    # U of the dust is decided by a few bright pixels of the plane, where the turbulence is.
    assert correlate(2, abs(lat) > 20) > least_U
    assert correlate(1, abs(lat) > 20) > 0.3


@pytest.mark.slow
def test_the_default_model_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXSKY_CACHE", str(tmp_path))
    made, expected = default_galaxy(16), embedded_sky(16)
    assert made.description == expected.description
    (kept,) = (tmp_path / "galaxy").iterdir()
    monkeypatch.setattr("jaxsky.inputs.embedded_sky", None)  # is not called again
    for galaxy in (made, default_galaxy(16)):
        np.testing.assert_array_equal(galaxy.dust, expected.dust)
        np.testing.assert_array_equal(galaxy.synchrotron, expected.synchrotron)
    monkeypatch.undo()
    monkeypatch.setenv("JAXSKY_CACHE", str(tmp_path))
    kept.write_bytes(kept.read_bytes()[:500])  # damaged
    np.testing.assert_array_equal(default_galaxy(16).dust, expected.dust)
    assert kept.stat().st_size > 500
