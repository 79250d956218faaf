"""Templates: resampling against healpy, smoothed and steepened indices, correlations, files."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from fits import superpixels
from jaxsky import AME, Dust
from jaxsky.harmonics import analysis, beam_ratio, gaussian_beam, power_spectrum
from jaxsky.io import read_maps
from jaxsky.templates import HIGH, LOW, correlation, dust_index, polarization_template, steepening
from mapfiles import table, write
from refusals import raises


def coefficients(lmax, fwhm=0.0, rows=3, seed=0):
    """healpy's coefficients (I, E, B) of a sky with a falling spectrum, seen by a beam."""
    ell, m = healpy.Alm.getlm(lmax)
    rng = np.random.default_rng(seed)
    real, imaginary = rng.normal(size=(2, rows, ell.size))
    alm = (real + 1j * np.where(m > 0, imaginary, 0)) / (1 + ell) ** 1.2
    alm[:, ell < 2] = 0
    return np.stack([healpy.almxfl(row, np.asarray(gaussian_beam(fwhm, lmax))) for row in alm])


def polarization(alm, nside):
    """Q and U of coefficients I, E, B."""
    return np.array(healpy.alm2map_spin(list(alm[1:]), nside, 2, healpy.Alm.getlmax(alm[0].size)))


def spectrum(maps, lmax):
    return np.asarray(power_spectrum(analysis(jnp.asarray(maps), lmax)).sum(axis=0))


@pytest.mark.parametrize(
    ("nside_in", "nside", "lmax", "fwhm"), [(16, 32, 32, 500.0), (32, 16, 24, 400.0)]
)
def test_template_against_healpy(nside_in, nside, lmax, fwhm):
    alm = coefficients(lmax)
    maps = healpy.alm2map(alm, nside_in, lmax=lmax)
    # healpy: analysed until it converges, multiplied, synthesised.
    ratio = np.asarray(beam_ratio(fwhm, 400.0, lmax))
    found = healpy.map2alm(maps, lmax=lmax, iter=20, use_weights=True)
    expected = healpy.alm2map([healpy.almxfl(row, ratio) for row in found], nside, lmax=lmax)
    result = polarization_template(maps, 400.0, fwhm, nside)
    # Jacobi steps gain a factor of 20 each; four leave 4e-7 of the rms in the worst pixel.
    np.testing.assert_allclose(result, expected, atol=1e-6 * expected.std())


def test_multipoles_that_the_result_does_not_resolve_are_cut():
    alm = coefficients(64)
    kept = np.stack([healpy.resize_alm(row, 64, 64, 32, 32) for row in alm])
    result = polarization_template(polarization(alm, 32), 10.0, 10.0, 16)
    np.testing.assert_allclose(result, polarization(kept, 16), atol=1e-6)


def test_artefacts_of_pixels_are_gone():
    """The paper's 256 -> 512 and 40' -> 60', sixteen times coarser and upgraded further."""
    nside_in, nside, own, fwhm = 16, 64, 640.0, 960.0
    lmax = 3 * nside_in - 1
    alm = coefficients(lmax, own)
    maps = polarization(alm, nside_in)
    ratio = np.asarray(beam_ratio(fwhm, own, lmax))
    truth = polarization(np.stack([healpy.almxfl(row, ratio) for row in alm]), nside)
    # Upgraded pixel by pixel, as the paper does; then smoothed.
    upgraded = healpy.ud_grade(maps, nside)
    kernel = np.radians(np.sqrt(fwhm**2 - own**2) / 60)
    theirs = healpy.smoothing([0 * upgraded[0], *upgraded], fwhm=kernel, iter=5)[1:]
    ours = polarization_template(maps, own, fwhm, nside)
    unsmoothed = polarization_template(maps, own, own, nside)

    powers = [spectrum(m, 2 * nside) for m in (truth, ours, theirs, upgraded, unsmoothed)]
    true, our, their, stairs, flat = (power / powers[0][2:8].mean() for power in powers)
    large, beyond, grid = slice(2, 8), slice(2 * nside_in + 1, None), slice(4 * nside_in, None)
    # Large scales agree: ours with the truth, the paper's to the few percent of a map of steps.
    np.testing.assert_allclose(our[large], true[large], rtol=1e-5)
    np.testing.assert_allclose(their[large], true[large], rtol=0.1)
    # Steps repeat with the grid of the pixels. Only a beam keeps them small in the paper's way,
    # and between 2 and 3 nside they mix with the sky; here both are gone, beam or no beam.
    assert stairs[grid].max() > 1e-4
    assert their[beyond].max() > 1e-10
    # 1e-16 is the rounding of the analysis that measures it.
    assert our[beyond].max() < 1e-15
    assert flat[beyond].max() < 1e-15
    # Steps in Q and U do not turn with the meridians, which matters next to the poles.
    ours_off, theirs_off = (np.abs(m - truth).max() / truth.std() for m in (ours, theirs))
    assert theirs_off > 0.05
    # What is left is the sky between 2 and 3 nside, which the pixels do not resolve.
    assert ours_off < 1e-3


def test_template_gradients():
    maps = jnp.asarray(polarization(coefficients(8), 4))

    def resampled(maps, own, fwhm):
        return polarization_template(maps, 1e3 * own, 1e3 * fwhm, 8)

    traced = jax.jit(resampled)
    check_grads(traced, (maps, 1.0, 1.5), order=1, rtol=1e-5)
    # Where the widths are known, what they leave is known as well and the rest is cut.
    np.testing.assert_allclose(traced(maps, 1.0, 1.5), resampled(maps, 1.0, 1.5), atol=1e-7)


def test_smoothed_index_of_a_dipole():
    theta = healpy.pix2ang(32, np.arange(12 * 32**2))[0]
    smoothed = dust_index(1.5 + np.cos(theta), 7.5, 1800.0, 16)
    theta = healpy.pix2ang(16, np.arange(12 * 16**2))[0]
    variance = (np.radians(1) / 60) ** 2 * (1800.0**2 - 7.5**2) / (8 * np.log(2))
    # Multipoles l = 0 and 1 of the Gaussian; the analysis is right to 1e-7.
    expected = 1.5 + np.exp(-variance) * np.cos(theta)
    np.testing.assert_allclose(smoothed, expected, atol=1e-6)


def noisy_index(nside, sigma):
    """An index that falls by 0.4 from plane to poles, with noise."""
    theta = healpy.pix2ang(nside, np.arange(12 * nside**2))[0]
    noise = np.random.default_rng(3).normal(scale=sigma, size=theta.size)
    return 1.3 + 0.4 * np.sin(theta) ** 2 + noise


def hole(nside, radius):
    """A mask without a disc [deg]."""
    mask = np.ones(12 * nside**2, bool)
    mask[healpy.query_disc(nside, healpy.ang2vec(0.8, 0.3), np.radians(radius))] = False
    return mask


@pytest.mark.slow
def test_masked_index_is_the_mean_under_the_beam():
    nside, fwhm = 32, 600.0
    beta, mask = noisy_index(nside, 0.1), hole(nside, 8.0)
    smoothed = dust_index(np.where(mask, beta, healpy.UNSEEN), 0.0, fwhm, 4, mask)
    # Sum over pixels with the kernel of the beam in real space.
    terms = (2 * np.arange(101) + 1) / (4 * np.pi) * np.asarray(gaussian_beam(fwhm, 100))
    centres, pixels = (np.array(healpy.pix2vec(n, np.arange(12 * n**2))) for n in (4, nside))
    kernel = np.polynomial.legendre.legval(np.clip(centres.T @ pixels, -1, 1), terms)
    expected = (kernel @ (beta * mask)) / (kernel @ mask)
    # Pixels have equal weights in the sum, but not in the analysis; without its denominator the
    # result would be off by 0.7 in the hole.
    np.testing.assert_allclose(smoothed, expected, atol=1e-3)
    constant = dust_index(np.where(mask, 1.53, np.nan), 0.0, fwhm, 4, mask)
    np.testing.assert_allclose(constant, 1.53, rtol=1e-12)
    full = dust_index(beta, 0.0, fwhm, 4, np.ones_like(mask))
    np.testing.assert_allclose(full, dust_index(beta, 0.0, fwhm, 4), rtol=1e-6)


def test_smoothed_index_gradients():
    beta, mask = noisy_index(4, 0.1), hole(4, 20.0)

    @jax.jit
    def smoothed(beta, own, fwhm):
        return dust_index(beta, 1e3 * own, 1e3 * fwhm, 2, mask)

    check_grads(smoothed, (jnp.asarray(beta), 1.0, 3.0), order=1, rtol=1e-5)


NU = np.geomspace(0.4, 40.0, 2001)


@pytest.mark.parametrize("interval", [LOW, (0.6, 1.0)])
def test_steepening_of_a_broken_power_law(interval):
    T = 7e3 * np.where(NU < 5, (NU / 5) ** -2.7, (NU / 5) ** -2.83)
    assert float(steepening(NU, T, low=interval)) == pytest.approx(0.13, abs=1e-12)
    assert float(steepening(NU, T, low=(10.0, 20.0), high=HIGH)) == pytest.approx(0, abs=1e-12)
    assert float(steepening(NU, T, low=HIGH, high=interval)) == pytest.approx(-0.13, abs=1e-12)


def test_steepening_across_the_break():
    """An interval with its break inside has the mean index in ln nu; two samples make a law."""
    nu, T = np.array([0.1, 1.0, 100.0]), np.array([10.0**2.6, 1.0, 100.0**-3.1])
    inside = (2.6 * np.log(1 / 0.5) + 3.1 * np.log(2 / 1)) / np.log(2 / 0.5)
    result = float(steepening(nu, T, low=(0.5, 2.0)))
    assert result == pytest.approx(3.1 - inside, abs=1e-12)


def test_steepening_of_a_curved_spectrum():
    """For ln T = -b L + C L^2 in L = ln nu the index between two frequencies is b - C (L1 + L2)."""
    curvature, L = -0.06, np.log(NU)
    T = np.exp(-2.9 * L + curvature * L**2)
    expected = -curvature * (np.log(HIGH).sum() - np.log(LOW).sum())
    # The parabola is interpolated by chords with steps of 0.0023 in ln nu.
    assert float(steepening(NU, T)) == pytest.approx(expected, abs=1e-6)


def test_steepening_gradients():
    nu = jnp.geomspace(0.4, 40.0, 12)
    T = nu**-2.7 * (1 + nu / 5) ** -0.3
    ends = (jnp.array(LOW), jnp.array(HIGH))
    by_logarithm = jax.jit(lambda nu, log_T, *ends: steepening(nu, jnp.exp(log_T), *ends))
    # In ln T, since a finite step in T itself would make it negative.
    check_grads(by_logarithm, (nu, jnp.log(T), *ends), order=1, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(steepening)(nu, T, *ends), steepening(nu, T), rtol=1e-12)


def brute_force(x, y, blocks):
    """Correlation with one block left out after another."""
    names = np.unique(blocks)
    left = [np.corrcoef(x[blocks != b], y[blocks != b])[0, 1] for b in names]
    scatter = np.sum((left - np.mean(left)) ** 2) * (names.size - 1) / names.size
    return np.corrcoef(x, y)[0, 1], np.sqrt(scatter)


def test_correlation_against_brute_force():
    rng = np.random.default_rng(7)
    # A large mean: sums of squares about zero would lose its digits.
    x = 1e4 + rng.normal(size=768)
    y = 0.5 * x + rng.normal(size=768)
    strange = rng.choice([-3, 5, 100, 7], size=768)
    for blocks in (superpixels(8, 2), strange):
        expected = brute_force(x, y, blocks)
        np.testing.assert_allclose(correlation(x, y, blocks), expected, rtol=1e-8)
    np.testing.assert_allclose(correlation(x, y), brute_force(x, y, np.arange(768)), rtol=1e-8)


def test_error_of_the_correlation_is_that_of_gaussian_draws():
    rho, n = 0.7, 49152
    rng = np.random.default_rng(9)
    x = rng.normal(size=n)
    y = rho * x + np.sqrt(1 - rho**2) * rng.normal(size=n)
    r, error = map(float, correlation(x, y))
    # (1 - rho^2)/sqrt(n), Fisher's; the jackknife knows its own error to about 1/sqrt(n).
    assert error == pytest.approx((1 - rho**2) / np.sqrt(n), rel=0.03)
    assert abs(r - rho) < 4 * error
    # Independent pixels need no blocks: 768 of them give the same, known to 1/sqrt(2 * 768).
    assert float(correlation(x, y, superpixels(64, 8)).error) == pytest.approx(error, rel=0.1)


def test_blocks_find_the_error_of_a_smooth_sky():
    """Unrelated skies correlate by chance, by [sum (2l+1) C^2]^(1/2) / sum (2l+1) C."""
    nside, lmax, fwhm = 32, 64, 300.0
    blocks = superpixels(nside, 2)
    flat = (1 + healpy.Alm.getlm(lmax)[0]) ** 1.2
    pixelwise, by_blocks = [], []
    for seed in range(8):
        alm = coefficients(lmax, fwhm, rows=2, seed=seed) * flat
        x, y = (healpy.alm2map(row, nside) for row in alm)
        pixelwise.append(float(correlation(x, y).error))
        by_blocks.append(float(correlation(x, y, blocks).error))
    modes = 2 * np.arange(2, lmax + 1) + 1
    power = np.asarray(gaussian_beam(fwhm, lmax))[2:] ** 2
    scatter = np.sqrt(np.sum(modes * power**2)) / np.sum(modes * power)
    assert np.mean(pixelwise) < 0.4 * scatter
    # Blocks of 29 degrees share structures of 7 degrees at their edges, which makes their error
    # 6 % too small; 8 pairs of 48 know it to 3 %.
    assert np.mean(by_blocks) == pytest.approx(scatter, rel=0.15)


def test_correlation_gradients():
    x, y = np.random.default_rng(1).normal(size=(2, 48))
    blocks = superpixels(2, 1)
    check_grads(jax.jit(lambda x, y: correlation(x, y, blocks)), (x, y), order=1, rtol=1e-5)


def test_ame_and_dust_of_the_real_sky(data_dir):
    """The paper finds 0.71 +- 0.01 (Q) and 0.73 +- 0.01 (U) at 1 degree with Commander's maps."""
    dust, ame = (
        read_maps(data_dir / "templates" / f"{name}_n64.fits").maps
        for name in ("dust_d1_353GHz", "ame_a2_30GHz")
    )
    # The AME is made from the dust as the paper makes it; PySM's own has the same angles and 2 %.
    made = AME.from_dust_angles(ame[0], dust[1:], 0.02).template
    np.testing.assert_allclose(made, ame[1:], atol=1e-3 * ame[1:].std())
    smooth = [polarization_template(maps, 0.0, 60.0, 64) for maps in (dust[1:], made)]
    blocks = superpixels(64, 8)
    for x, y in zip(*smooth, strict=True):
        r, error = correlation(x, y)
        # Other maps of the same emission, from another separation and with other small scales.
        assert 0.6 < float(r) < 0.8
        assert 0.004 < float(error) < 0.012
        # The bright plane is a few structures of many pixels.
        assert float(correlation(x, y, blocks).error) > 2 * float(error)


def save(path, columns, unit, **header):
    """A table in NESTED order as the Planck archive has it."""
    keys = {"COORDSYS": "GALACTIC", "ORDERING": "NESTED", "BAD_DATA": np.float32(healpy.UNSEEN)}
    return write(path, table(columns, [unit] * len(columns), "COMP-MAP", **keys | header))


def test_dust_with_its_index_from_commander(tmp_path):
    alm = coefficients(64, 300.0)
    Q, U = polarization(alm, 32)
    maps = save(
        tmp_path / "COM_CompMap_DustPol-commander_1024_R2.00.fits",
        {"Q_ML_FULL": Q, "U_ML_FULL": U},
        "uK_RJ",
    )
    beta, mask = noisy_index(32, 0.5), hole(32, 5.0)
    columns = {"I_ML_FULL": np.ones_like(beta), "BETA_ML_FULL": np.where(mask, beta, healpy.UNSEEN)}
    indices = save(tmp_path / "COM_CompMap_ThermalDust-commander_2048_R2.00.fits", columns, "NA")
    read = read_maps(indices, fields="BETA_ML_FULL", unit="")
    np.testing.assert_array_equal(read.mask, mask)
    index = dust_index(read.maps[0], 7.5, 900.0, 16, read.mask)
    dust = Dust(polarization_template(read_maps(maps).maps, 300.0, 300.0, 16), index)
    kept = np.stack([healpy.resize_alm(row, 64, 64, 32, 32) for row in alm])
    np.testing.assert_allclose(dust.amplitude, polarization(kept, 16), atol=1e-6)
    # The area 4 pi sigma^2 of a beam of 15 degrees holds 150 pixels, so a noise of 0.5 becomes
    # 0.04; the beam changes the index itself by up to 0.01.
    theta = healpy.pix2ang(16, np.arange(12 * 16**2))[0]
    rest = index - (1.3 + 0.4 * np.sin(theta) ** 2)
    assert float(jnp.std(rest)) < 0.05
    assert float(jnp.abs(rest).max()) < 0.2


MAPS, INDEX, T = np.ones((2, 192)), np.ones(192), NU**-3.0


@pytest.mark.parametrize("shape", [(192,), (1, 192), (4, 192), (2, 100), (2, 108), (2, 12), ()])
def test_refused_shapes_of_maps(shape):
    message = r"`maps` must have shape \(2 or 3, pix\) with 12 nside\^2 pixels, nside 2, 4, 8"
    raises(ValueError, message, polarization_template, np.ones(shape), 1.0, 2.0, 8)


def test_holes_wider_than_the_beam_are_refused():
    mask = hole(32, 20.0)
    beta = np.ones(mask.size)
    with pytest.raises(ValueError, match=r"leaves \d+ of 768 pixels .* beam of 600 arcmin"):
        dust_index(beta, 0.0, 600.0, 8, mask)
    # The count: pixels further than a FWHM (here 10 degrees) inside the edge.
    raises(ValueError, "leaves 768 of 768", dust_index, beta, 0.0, 600.0, 8, np.zeros_like(mask))
    assert np.isfinite(dust_index(beta, 0.0, 3000.0, 8, mask)).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((NU[:5], T), r"one shape \(sample,\).* shapes \(5,\) and \(2001,\)"),
        ((NU[:1], T[:1]), "two samples or more"),
        ((NU[::-1], T), "`nu` must increase strictly"),
        ((-NU[::-1], T), "`nu` must be positive, but its smallest value is -40"),
        ((NU, T - T[5]), "`temperature` must be positive"),
        ((NU, T * np.nan), "`temperature` has 2001 of 2001 values that are not finite"),
        ((NU, T, (0.3, 2.0)), "`low` reaches from 0.3 to 2 GHz, but the spectrum only from 0.4"),
        ((NU, T, LOW, (20, 44)), "`high` reaches from 20 to 44 GHz, .* from 0.4 to 40 GHz"),
        ((NU, T, (2.0, 1.0)), "`low` must be two increasing frequencies .*, but is 2, 1"),
        ((NU, T, LOW, (0.0, 1.0)), "`high` must be two increasing frequencies .*, but is 0, 1"),
        ((NU, T, 3.0), r"`low` must be two frequencies .*, but has shape \(\)"),
    ],
)
def test_refused_spectra(arguments, message):
    raises(ValueError, message, steepening, *arguments)


HOLES = MAPS.copy()
HOLES[1, :3] = [np.nan, np.inf, healpy.UNSEEN]
USED, X = np.arange(192) > 1, np.arange(6.0)
NO_POWER = "`nside` must be a power of 2, but is 12"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: polarization_template(MAPS, 61.0, 60.0, 8),
         "60 arcmin is finer than that of the template, 61 arcmin"),
        (lambda: dust_index(INDEX, 40.0, 30.0, 8),
         "30 arcmin is finer than that of the map of indices, 40"),
        (lambda: polarization_template(MAPS, 1.0, 2.0, 12), NO_POWER),
        (lambda: dust_index(INDEX, 1.0, 2.0, 12), NO_POWER),
        (lambda: polarization_template(HOLES, 1.0, 2.0, 8),
         "`maps` has 3 of 384 values that are not finite"),
        (lambda: dust_index(MAPS, 1.0, 2.0, 8),
         r"`beta` must have shape \(pix,\).*has shape \(2, 192\)"),
        (lambda: dust_index(HOLES[1], 1.0, 2.0, 8), "`beta` has 3 of 192 values"),
        (lambda: dust_index(HOLES[1], 1.0, 2.0, 8, USED), "`beta` has 1 of 192 values"),
        (lambda: dust_index(INDEX, 1.0, 2.0, 8, USED[:48]),
         r"`mask` must have shape \(192,\) like `beta`, but has"),
        (lambda: correlation(X, X[1:]), r"one shape \(pix,\).*\(6,\), \(5,\) and \(6,\)"),
        (lambda: correlation(X, X, np.arange(5)), r"\(6,\), \(6,\) and \(5,\)"),
        (lambda: correlation(X, np.where(X == 2, np.nan, X)), "`y` has 1 of 6 values that are not"),
        (lambda: correlation(X, X, np.zeros(6)), "at least two blocks, but has 1"),
        (lambda: correlation(X, 0 * X + 0.1), "`x` and `y` must vary, also without any one"),
        (lambda: correlation(X, 1.0 * (X == 0)), "`x` and `y` must vary, also without any one"),
    ],
)  # fmt: skip
def test_refusals(call, words):
    raises(ValueError, words, call)
