"""Power laws on small patches, observed against the model, with the noise of each patch."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fits.commands.compare import plot_patches, plot_template_patches
from fits.common import common_maps
from fits.discs import _patch_noise, compare_patches, paper_patches, template_patches
from fits.inputs import inputs_of
from fits.patches import fit_patches
from fits.pseudo_cl import band_powers, prepare_patches
from jaxsky.harmonics import gaussian_beam
from jaxsky.noise import pixel_covariance
from jaxsky.settings import Experiment

NSIDE = 64


@pytest.fixture(scope="module")
def settings():
    return Experiment.model_validate(
        {
            "sky": {"embedded": {"nside": NSIDE}},
            "bands": [{"instrument": "planck", "channels": ["353"]}],
            "compare": {"patches": "353", "patches_nside": NSIDE},
        }
    )


@pytest.fixture(scope="module")
def inputs(settings):
    return inputs_of(settings)


@pytest.fixture(scope="module")
def found(settings, inputs):
    return compare_patches(settings, inputs)


@pytest.mark.slow
def test_noise_is_that_of_each_patch(inputs):
    """Twice as much on one half of the sky."""
    band = inputs.bands["353"]
    north = healpy.pix2ang(NSIDE, np.arange(band.used.size), lonlat=True)[1] > 0
    uneven = band._replace(noise=pixel_covariance(band.noise, NSIDE) * jnp.where(north, 4.0, 1.0))
    prepared = common_maps(inputs._replace(bands={"353": uneven}), NSIDE, 60.0)
    some = dict(list(paper_patches(NSIDE).items())[:48:16])
    patches = prepare_patches(some, np.asarray(gaussian_beam(60.0, 128)))
    noise = _patch_noise(uneven, prepared, patches)
    keys = jax.random.split(jax.random.key(1), 40)
    maps = [prepared.fluctuations.noise_realisation(key)[0] for key in keys]
    for one, row in zip(patches.spectra, noise, strict=True):
        expected = np.einsum("ibjl,jklm,km->ib", one.inverse, one.mixing, row)
        powers = np.array([band_powers(one, m) for m in maps])
        error = powers.std(axis=0) / np.sqrt(len(maps))
        assert np.abs((powers.mean(axis=0) - expected) / error).max() < 4
    levels = noise[:, 0, 80]
    assert levels.max() / levels.min() == pytest.approx(4.0, rel=1e-6)


@pytest.mark.slow
def test_map_and_model_agree(found):
    """The same sky with noise of its own: amplitudes agree, and correlate."""
    assert found.band == "353"
    assert found.observed.A.shape == (49, 2)
    assert found.observed.names[-1] == "BICEP2"
    for index in (0, 1):
        variance = (found.observed.covariance + found.model.covariance)[:, index, 0, 0]
        pulls = (found.observed.A - found.model.A)[:, index] / np.sqrt(variance)
        # Both have the sky in common, so they agree better than their errors say.
        assert np.std(pulls) < 1.2
        assert abs(np.mean(pulls)) < 4 / 7
        ratio, error = found.ratio(index)
        assert abs(np.log(ratio)) < 4 * error / ratio
        difference, error = found.slope_difference(index)
        assert abs(difference) < 4 * error


@pytest.mark.slow
def test_a_template_alone(inputs, tmp_path):
    maps = inputs.templates["dust"].component.amplitude
    fit = template_patches(maps, 0.0)
    expected = fit_patches(maps, prepare_patches(paper_patches(NSIDE), np.ones(2 * NSIDE + 1)))
    np.testing.assert_allclose(fit.A, expected.A)
    plot_template_patches(tmp_path / "patches.png", fit, ["A", "alpha"], "dust")
    assert (tmp_path / "patches.png").stat().st_size > 10_000


@pytest.mark.slow
def test_picture(found, tmp_path):
    plot_patches(tmp_path / "patches.png", found, "small")
    assert (tmp_path / "patches.png").stat().st_size > 10_000


@pytest.mark.slow
def test_pixels_too_wide_for_the_multipoles(settings, inputs):
    how = settings.compare.model_copy(update={"patches_nside": 32})
    with pytest.raises(
        ValueError, match=r"Argument `lmax` must be between .* 100, and 2 nside, 64"
    ):
        compare_patches(settings.model_copy(update={"compare": how}), inputs)
