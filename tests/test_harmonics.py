"""Transforms against healpy, transposes, gradients; beams, packing and resolution."""

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxsky import Dust, ducc
from jaxsky import harmonics as h

NSIDE, LMAX = 32, 64
ROWS = pytest.mark.parametrize(
    "rows", [slice(0, 1), slice(1, 3), slice(0, 3)], ids=["I", "QU", "IQU"]
)


def drawn(lmax, stokes=3, seed=4):
    """Packed coefficients of a falling spectrum; E and B have none at l < 2."""
    ell = h.alm_ell(lmax)
    white = np.random.default_rng(seed).normal(size=(stokes, ell.size))
    spins = np.array([0, 2, 2])[3 - stokes :, None]
    return jnp.asarray(white / (ell + 1.0) * (ell >= spins))


@pytest.fixture(scope="module")
def alm():
    """healpy's coefficients (I, E, B) of a map with a falling spectrum."""
    return h.alm_to_healpy(drawn(LMAX).at[0, h.alm_ell(LMAX) < 2].set(0), LMAX)


def rms(x):
    return float(jnp.sqrt(jnp.mean(x**2)))


@ROWS
def test_synthesis_and_analysis_against_healpy(alm, rows):
    maps = healpy.alm2map(alm, NSIDE, lmax=LMAX)[rows]
    packed = jnp.asarray(h.alm_from_healpy(alm[rows], LMAX))
    np.testing.assert_allclose(h.synthesis(packed, NSIDE), maps, atol=1e-10 * maps.std())
    back = np.asarray(h.analysis(jnp.asarray(maps), LMAX))
    # Ring weights and three Jacobi steps; band-limited to 2 nside.
    np.testing.assert_allclose(back, packed, atol=1e-4 * float(packed.std()))
    # healpy's own error with iter=3 is as large.
    reference = h.alm_from_healpy(healpy.map2alm(healpy.alm2map(alm, NSIDE), LMAX, iter=3), LMAX)
    assert np.abs(back - packed).max() < 2 * np.abs(reference[rows] - packed).max()


@ROWS
def test_analysis_is_that_of_healpy(rows):
    """With its ring weights, in as many steps."""
    alm = drawn(LMAX)[rows]
    maps = np.asarray(h.synthesis(alm, NSIDE))
    full = np.concatenate([np.zeros((3 - len(maps), maps.shape[-1])), maps])
    for iterations in (0, 2):
        options = {"lmax": LMAX, "iter": iterations, "use_weights": True}
        if len(maps) == 1:
            expected = healpy.map2alm(maps[0], **options)[None]
        else:
            expected = healpy.map2alm(full, **options)[-len(maps) :]
        np.testing.assert_allclose(
            h.analysis(jnp.asarray(maps), LMAX, iterations),
            h.alm_from_healpy(expected, LMAX),
            atol=1e-10 * float(alm.std()),
        )


@pytest.mark.parametrize("lmax", [3 * NSIDE // 2, 2 * NSIDE])
@pytest.mark.parametrize("stokes", [1, 2])
def test_analysis_inverts_the_synthesis(lmax, stokes):
    alm = drawn(lmax, stokes)
    back = h.analysis(h.synthesis(alm, NSIDE), lmax)
    assert rms(back - alm) < 1e-6 * rms(alm)


def test_packing_is_inverse_and_keeps_the_norm(alm):
    packed = h.alm_from_healpy(alm, LMAX)
    np.testing.assert_allclose(h.alm_to_healpy(packed, LMAX), alm, atol=1e-15)
    ell = h.alm_ell(LMAX)
    power = [np.sum(packed[0][ell == degree] ** 2) / (2 * degree + 1) for degree in range(LMAX + 1)]
    np.testing.assert_allclose(power, healpy.alm2cl(alm[0]), rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda alm, packed: h.alm_from_healpy(packed, LMAX),
            "complex .* but is real",
        ),
        (lambda alm, packed: h.alm_from_healpy(alm, LMAX + 1), "coefficients at lmax"),
        (lambda alm, packed: h.alm_to_healpy(alm, LMAX), "is complex; .*alm_from_healpy"),
        (lambda alm, packed: h.alm_to_healpy(packed, LMAX - 1), "coefficients at lmax"),
        (lambda alm, packed: h.synthesis(alm, NSIDE), "is complex; .*alm_from_healpy"),
        (lambda alm, packed: h.synthesis(packed[:, 1:], NSIDE), "a square number, not"),
        (lambda alm, packed: Dust(alm), "must be real, but is complex. .*alm2map"),
    ],
)
def test_coefficients_of_another_packing_are_refused(alm, call, words):
    with pytest.raises((TypeError, ValueError), match=words):
        call(alm[1:], jnp.asarray(h.alm_from_healpy(alm[1:], LMAX)))


@pytest.mark.parametrize("lmax", [0, 1, 5, 301, 1535])
def test_expand_puts_a_function_of_l_in_the_order_of_the_coefficients(lmax):
    assert h.lmax_of(h.expand(jnp.ones(lmax + 1))) == lmax
    np.testing.assert_array_equal(h.expand(jnp.arange(lmax + 1)), h.alm_ell(lmax))


@pytest.mark.parametrize("lmax", [0, 3, 40, LMAX, LMAX + 7])
def test_resize_against_healpy(alm, lmax):
    expected = np.stack([healpy.resize_alm(row, LMAX, LMAX, lmax, lmax) for row in alm])
    resized = h.resize(jnp.asarray(h.alm_from_healpy(alm, LMAX)), lmax)
    np.testing.assert_array_equal(resized, h.alm_from_healpy(expected, lmax))


def test_spectra_against_healpy(alm):
    packed = jnp.asarray(h.alm_from_healpy(alm, LMAX))
    auto = np.stack([healpy.alm2cl(row) for row in alm])
    np.testing.assert_allclose(h.power_spectrum(packed), auto, rtol=1e-12, atol=1e-18)
    cross = np.stack([healpy.alm2cl(alm[i], alm[i - 1]) for i in range(3)])
    crossed = h.power_spectrum(packed, packed[jnp.array([2, 0, 1])])
    np.testing.assert_allclose(crossed, cross, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(h.power_spectrum(packed[1]), auto[1], rtol=1e-12, atol=1e-18)


def assert_transpose(function, x, seed=0):
    """The transpose of a linear function has the same inner products."""
    y = function(x)
    other = jnp.asarray(np.random.default_rng(seed).normal(size=y.shape))
    (back,) = jax.linear_transpose(function, x)(other)
    assert float(jnp.vdot(y, other)) == pytest.approx(float(jnp.vdot(x, back)), rel=1e-10)


@ROWS
def test_transposes(rows):
    alm = drawn(LMAX)[rows]
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(len(alm), 12 * NSIDE**2)))
    assert_transpose(lambda a: h.synthesis(a, NSIDE), alm)
    assert_transpose(lambda m: h.adjoint_synthesis(m, LMAX), maps)
    assert_transpose(lambda m: h.analysis(m, LMAX), maps)
    assert_transpose(lambda m: h.resample(m, h.gaussian_beam(300.0, 40), 16), maps)
    np.testing.assert_allclose(
        h.adjoint_synthesis(maps, LMAX),
        jax.linear_transpose(lambda a: h.synthesis(a, NSIDE), alm)(maps)[0],
        atol=1e-12,
    )


@ROWS
def test_rings_in_groups_are_those_of_the_sphere(rows, monkeypatch):
    """As maps are transformed that would take too much memory at once."""
    alm = drawn(LMAX)[rows]
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(len(alm), 12 * NSIDE**2)))

    def results():
        ducc._groups.cache_clear()
        yield h.synthesis(alm, NSIDE)
        yield h.adjoint_synthesis(maps, LMAX)
        yield h.analysis(maps, LMAX, 2)
        yield jax.linear_transpose(lambda m: h.analysis(m, LMAX, 2), maps)(alm)[0]

    whole = list(map(np.asarray, results()))
    monkeypatch.setattr(ducc, "GROUP", 1 << 15)
    for found, expected in zip(results(), whole, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())
    assert len(ducc._groups(NSIDE, LMAX, 0, 16, False)) > 3
    ducc._groups.cache_clear()


def test_vmap_is_a_loop():
    alms = jnp.stack([drawn(16, seed=seed) for seed in range(3)])
    maps = jax.vmap(lambda a: h.synthesis(a, 8))(alms)
    np.testing.assert_allclose(maps, jnp.stack([h.synthesis(a, 8) for a in alms]), atol=1e-12)
    back = jax.vmap(lambda m: h.analysis(m, 16))(maps)
    np.testing.assert_allclose(back, jnp.stack([h.analysis(m, 16) for m in maps]), atol=1e-12)


def test_gradients_of_transforms():
    alm = drawn(16)
    for function, x in (
        (lambda a: h.synthesis(a, 8), alm),
        (lambda m: h.analysis(m, 16), h.synthesis(alm, 8)),
        (lambda a: h.power_spectrum(h.resize(a, 20)), alm),
    ):
        check_grads(jax.jit(function), (x,), order=1)


def test_gradients_in_maps_and_beams():
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(2, healpy.nside2npix(8))))

    def smoothed(fwhm, own, m):
        return h.smooth(m, 100 * fwhm, 100 * own, lmax=16)

    check_grads(smoothed, (jnp.asarray(6.0), jnp.asarray(3.0), maps), order=1, rtol=1e-5)
    # At equal widths the square root of their difference has no derivative; the window has one.
    slope = jax.grad(lambda fwhm: h.beam_ratio(fwhm, 300.0, 16).sum())(300.0)
    step = (h.beam_ratio(300.1, 300.0, 16) - 1).sum() / 0.1
    # One-sided, as the target may not be finer; the error is half the second derivative's.
    assert float(slope) == pytest.approx(float(step), rel=1e-3)


def test_gradients_in_beams_and_tables():
    table = h.gaussian_beam(200.0, 30) * (1 - 0.01 * jnp.sin(jnp.arange(31)) ** 2)
    for arguments in [(jnp.asarray(6.0), table), (table**3, jnp.asarray(1.0)), (table**3, table)]:
        check_grads(
            lambda over, under: h.beam_ratio(
                over if over.ndim else 100 * over, under if under.ndim else 100 * under, 16
            ),
            arguments,
            order=1,
            rtol=1e-5,
        )


def test_smoothing_against_healpy(alm):
    maps = healpy.alm2map(alm, NSIDE, lmax=LMAX)
    fwhm = 300.0
    ours = h.resample(jnp.asarray(maps), h.gaussian_beam(fwhm, LMAX), NSIDE)
    theirs = healpy.smoothing(maps, fwhm=np.radians(fwhm / 60), lmax=LMAX, iter=10)
    # healpy's polarized beam is larger by exp(2 sigma^2), here 1.0027.
    ratio = np.exp(2 * (np.radians(fwhm / 60) / np.sqrt(8 * np.log(2))) ** 2)
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-4 * theirs[0].std())
    np.testing.assert_allclose(ours[1:] * ratio, theirs[1:], atol=1e-4 * theirs[1:].std())


def test_smoothing_is_better_than_healpys():
    alm = drawn(LMAX)
    fwhm = np.radians(2.0)
    exact = h.synthesis(alm * h.expand(h.gaussian_beam(120.0, LMAX)), NSIDE)
    maps = h.synthesis(alm, NSIDE)
    ours = h.smooth(maps, 120.0, lmax=LMAX)
    theirs = healpy.smoothing(np.asarray(maps), fwhm=fwhm, lmax=LMAX, iter=3)
    theirs[1:] /= np.exp(2 * (fwhm / np.sqrt(8 * np.log(2))) ** 2)
    for rows in (slice(0, 1), slice(1, 3)):
        error = rms(ours[rows] - exact[rows])
        assert error < 1e-6 * rms(exact[rows])
        assert error < rms(theirs[rows] - exact[rows])


def test_smoothing_starts_at_the_beam_of_the_map():
    maps = h.synthesis(drawn(LMAX) * h.expand(h.gaussian_beam(200.0, LMAX)), NSIDE)
    # The largest error of the analysis, near the poles.
    np.testing.assert_allclose(h.smooth(maps, 200.0, 200.0), maps, atol=1e-5)
    twice = h.smooth(h.smooth(maps, 300.0, 200.0), 500.0, 300.0)
    np.testing.assert_allclose(h.smooth(maps, 500.0, 200.0), twice, atol=1e-5)


def test_windows_of_beams():
    ell = np.arange(101)
    # healpy's window of the same beam, in temperature.
    np.testing.assert_allclose(
        h.gaussian_beam(90.0, 100), healpy.gauss_beam(np.radians(1.5), 100), rtol=1e-12
    )
    ratio = h.beam_ratio(50.0, 30.0, 100)
    np.testing.assert_allclose(ratio, h.gaussian_beam(40.0, 100), rtol=1e-12)
    # A Gaussian as a table is the Gaussian, on either side.
    wide, narrow = h.gaussian_beam(50.0, 100), h.gaussian_beam(30.0, 120)
    for target, own in [(wide, 30.0), (50.0, narrow), (wide, narrow)]:
        np.testing.assert_allclose(h.beam_ratio(target, own, 100), ratio, rtol=1e-12)
    # What a beam has erased does not come back.
    table = np.where(ell < 50, 0.5, 0.0)
    assert np.all(h.beam_ratio(table, table, 100) == (ell < 50))


def test_the_last_multipole_that_is_needed():
    window = h.gaussian_beam(400.0, 500)
    last = h.needed_lmax(window)
    assert window[last] > 1e-12 >= window[last + 1]
    assert h.needed_lmax(h.gaussian_beam(0.0, 500)) == 500
    assert h.needed_lmax(np.zeros(5)) == 0


def test_window_of_a_pixel_is_that_of_averaging():
    # From samples to means over 16 x 16 of them; pixels differ in shape, so within 1 %.
    fine = h.synthesis(drawn(2 * NSIDE, 1), 16 * NSIDE)
    low = 3 * NSIDE // 2
    means = h.analysis(h.average_pixels(fine, NSIDE), 2 * NSIDE)
    factor = h.power_spectrum(means, drawn(2 * NSIDE, 1)) / h.power_spectrum(drawn(2 * NSIDE, 1))
    smoothed = np.convolve(factor[0], np.ones(5) / 5, "same")
    np.testing.assert_allclose(smoothed[8:low:8], h.pixel_window(NSIDE, low)[8:low:8], rtol=0.01)
    assert h.pixel_window(NSIDE, low)[low - 1] < 0.92


def test_degrading_by_coefficients_keeps_what_fits(alm):
    maps = jnp.asarray(healpy.alm2map(alm, NSIDE, lmax=LMAX))
    low = h.resample(maps, jnp.ones(17), 8)
    kept = np.stack([healpy.resize_alm(a, LMAX, LMAX, 16, 16) for a in alm])
    # Multipoles 17 ... 64 that are cut leak in by 1e-3, the error of the quadrature.
    expected = healpy.alm2map(kept, 8, lmax=16)
    np.testing.assert_allclose(low, expected, atol=2e-3 * float(maps.std()))


def test_low_multipoles_are_free_of_those_above():
    alm = drawn(LMAX)
    maps = h.synthesis(alm, NSIDE)
    kept = h.low_multipoles(maps, 24)
    assert rms(kept - h.resize(alm, 24)) < 1e-6 * rms(alm)
    # An analysis that ends there has what lies above in it.
    assert rms(h.analysis(maps, 24) - h.resize(alm, 24)) > 100 * rms(kept - h.resize(alm, 24))
    # Above 2 nside a map has nothing to be trusted.
    assert np.all(h.low_multipoles(maps, 80)[:, h.alm_ell(80) > LMAX] == 0)


def test_nothing_is_lost_where_the_beam_ends_before_the_pixels():
    """A beam that leaves a sixth of the multipoles; white noise is worst, and falls as 1/nside."""
    nside, fwhm, lmax = 64, 2880.0, 128
    short = h.Preparation.smoothing(nside, 0.0, nside, fwhm, lmax)
    whole = h.Preparation(h.gaussian_beam(fwhm, lmax), nside, nside)
    assert short.window.size < lmax / 6
    white = jnp.asarray(np.random.default_rng(2).normal(size=(2, 12 * nside**2)))
    assert rms(short(white) - whole(white)) < 3e-4 * rms(whole(white))
    sky = h.synthesis(drawn(lmax, 2), nside)
    assert rms(short(sky) - whole(sky)) < 1e-5 * rms(whole(sky))
    assert short.uniform_variance(1.0) == pytest.approx(whole.uniform_variance(1.0), rel=1e-12)
    assert not h.Preparation.smoothing(nside, 0.0, nside, 1e30, lmax)(white).any()
    variance = 1 + white**2
    np.testing.assert_allclose(short.variance(variance), whole.variance(variance), rtol=1e-4)


def test_averaging_pixels_is_healpys(alm):
    maps = healpy.alm2map(alm, NSIDE, lmax=LMAX)
    np.testing.assert_allclose(h.average_pixels(maps, 8), healpy.ud_grade(maps, 8), atol=1e-12)
    pixels = h.children(jnp.arange(healpy.nside2npix(NSIDE)), 8)
    theta, phi = healpy.pix2ang(NSIDE, np.asarray(pixels))
    np.testing.assert_array_equal(
        healpy.ang2pix(8, theta, phi), np.arange(healpy.nside2npix(8))[:, None] + 0 * pixels
    )


def test_single_precision():
    maps = jnp.asarray(np.random.default_rng(1).normal(size=(3, 768)), jnp.float32)
    assert h.resample(maps, h.gaussian_beam(jnp.float32(600.0), 16), 4).dtype == jnp.float32


BEAM = h.gaussian_beam(60.0, 100)
#: The tail of a measured table may be negative.
TAIL = BEAM.at[90].set(-1e-3)
ONES, FEW = jnp.ones((3, 48)), drawn(4)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: h.smooth(ONES[:1], 30.0, 60.0),
         r"target beam of 30 arcmin is finer than that of the map, 60 arcmin\."),
        (lambda: h.beam_ratio(30.0, 60.0, 10, what="the dust"),
         "finer than that of the dust, 60 arcmin"),
        (lambda: h.beam_ratio(30.0, BEAM, 80, what="the dust"),
         r"finer than that of the dust: at l = 80 their windows are .* and "),
        (lambda: h.beam_ratio(60.0, TAIL, 100),
         r"at l = 90 their windows are 0\.799 and -0\.001\."),
        (lambda: h.beam_ratio(90.0, BEAM[:51], 51, what="the dust"),
         "beam table of the dust ends at l = 50, not at 51"),
        (lambda: h.beam_ratio(BEAM[:51], 30.0, 51, what="the dust"),
         "beam table of the target ends at l = 50, not at 51"),
    ],
)  # fmt: skip
def test_refusals(call, words):
    with pytest.raises(ValueError, match=words):
        call()
    # By as much as tables scatter, a target may be finer.
    assert float(h.beam_ratio(TAIL[:80] * 1.005, TAIL, 79).max()) == pytest.approx(1.005)


def test_refuses_single_precision_of_the_program():
    alm = np.ones((1, 16))
    jax.config.update("jax_enable_x64", False)
    try:
        # Of sizes that no other test uses: the check is made once for each.
        with pytest.raises(RuntimeError, match="spherical harmonic transform needs double"):
            h.synthesis(jnp.asarray(alm), 1)
    finally:
        jax.config.update("jax_enable_x64", True)
