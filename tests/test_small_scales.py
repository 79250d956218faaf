"""Small scales: power laws, spectra of the result, what its parameters do, derivatives."""

import builtins

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky import harmonics as h
from jaxsky.galaxy import embedded_sky
from jaxsky.io import read_maps
from jaxsky.small_scales import (
    SmallScales,
    continue_templates,
    extrapolate,
    fit_power_law,
    modulation,
)
from refusals import cases, raises

KEY = jax.random.key(0)
#: Slopes and joins of the synthetic template, its beam [arcmin] and its resolution.
SLOPES, RANGES, OWN, NSIDE = (-2.4, -2.0), ((5, 30), (5, 20)), 200.0, 32


def small_scales(**how):
    """The small scales of the synthetic template."""
    return SmallScales(*RANGES, **{"modulation_fwhm": 1200.0} | how)


SMALL = small_scales()
FILES = {
    "dust": "dust_d1_353GHz_n64.fits",
    "synchrotron": "synch_s1_30GHz_n64.fits",
    "ame": "ame_a2_30GHz_n64.fits",
}
REAL = {
    "dust": SmallScales((20, 100), (20, 100)),
    "synchrotron": SmallScales((10, 100), (4, 40)),
    "ame": SmallScales((20, 100), (20, 100)),
}


def continued(maps, how=SMALL, own=OWN, nside=64, key=KEY):
    """Coefficients of a template with small scales."""
    return continue_templates(key, [maps], [own], [how], nside).alms[0]


def add_small_scales(maps, fwhm, how=SMALL, own=OWN, nside=NSIDE):
    """A template with small scales, at a beam that may be finer than its own."""
    alm = continued(maps, how, own, nside)
    return h.synthesis(alm * h.expand(h.gaussian_beam(fwhm, h.lmax_of(alm))), nside)


def laws(lmax):
    """The power laws of the synthetic template, E and B."""
    ell = np.arange(lmax + 1)
    return np.maximum(ell, 1) ** np.array(SLOPES)[:, None] * [[1.0], [0.5]] * (ell > 1)


@pytest.fixture(scope="module")
def coefficients():
    """Of a template whose spectra are power laws at every multipole, not only on average."""
    white = jax.random.normal(jax.random.key(5), (2, (2 * NSIDE + 1) ** 2))
    return white * h.expand(jnp.sqrt(laws(2 * NSIDE) / h.power_spectrum(white)))


@pytest.fixture(scope="module")
def template(coefficients):
    """Q, U of that template, with its beam."""
    return h.synthesis(coefficients * h.expand(h.gaussian_beam(OWN, 2 * NSIDE)), NSIDE)


def real(data_dir, name):
    return read_maps(data_dir / "templates" / FILES[name]).maps[1:]


def edges(join, lmax):
    """Bins of Delta l / l = 0.2 from the first multipole beyond the join."""
    ends = [join + 1]
    while ends[-1] * 1.2 < lmax:
        ends.append(max(ends[-1] + 1, round(ends[-1] * 1.2)))
    return np.array(ends)


def binned(spectrum, ends):
    """Power between the ends: (2l+1) C_l, added up."""
    spectrum = np.asarray(spectrum)
    weighted = (2 * np.arange(spectrum.shape[-1]) + 1) * spectrum
    return np.add.reduceat(weighted[..., : ends[-1]], ends[:-1], axis=-1)


def many(maps, own, small, nside, count):
    """Results with several keys, shape (key, field, alm), and the spectra that they follow.

    Also the number of multipoles that are repaired.
    """

    def one(key):
        done = continue_templates(key, maps, own, small, nside)
        return jnp.concatenate(done.alms), (done.parts, done.repaired)

    # What does not depend on the key is computed once.
    alms, others = jax.jit(jax.vmap(one, out_axes=(0, None)))(jax.random.split(KEY, count))
    return alms, *others


def assert_follows(alms, part, small, template, last, first=(0, 0)):
    """Mean spectra over realisations follow the law beyond the joins, the template below them.

    Returns the ratios of the bins above and below the join, each to its law.
    """
    spectra = h.power_spectrum(alms)
    lmax = h.lmax_of(alms)
    steps = []
    for i, join in enumerate((small.EE[1], small.BB[1])):
        ends = edges(join, last)
        ratio = binned(spectra[:, i], ends).mean(axis=0) / binned(part.target[i], ends)
        beyond = ends[:-1] >= first[i]
        # The injected field is multiplied by a modulation, of which the few brightest parts of
        # the plane count: the sky fraction <m^2>^2/<m^4> is 0.04 to 0.1, and a bin near the
        # join has tens of modes. One realisation scatters by 2 to 11 % there, the mean less by
        # the root of their number.
        np.testing.assert_allclose(ratio[beyond], 1, atol=0.1)
        below = np.array([round(join / 1.2), join + 1])
        steps.append(
            ratio[0] / (binned(spectra[:, i], below).mean() / binned(part.target[i], below)[0])
        )
        low = np.array([2, *edges(2, join / 2)])
        cross = h.power_spectrum(alms[0, i], h.resize(template[i], lmax))
        norm = binned(spectra[0, i], low) * binned(h.power_spectrum(template[i]), low)
        assert np.all(binned(cross, low) > 0.99 * np.sqrt(norm))
    return steps


def test_power_law_against_numpy():
    ell = np.arange(101)
    scatter = np.exp(0.3 * np.random.default_rng(1).normal(size=101))
    spectrum = 7 * np.maximum(ell, 1) ** -2.3 * scatter
    law = fit_power_law(jnp.asarray(spectrum), 10, 90)
    x, y = np.log(ell[10:91] / 90), np.log(spectrum[10:91])
    (slope, constant), covariance = np.polyfit(x, y, 1, cov=True)
    assert float(law.slope) == pytest.approx(slope, rel=1e-12)
    assert float(law.log_amplitude) == pytest.approx(constant, rel=1e-12)
    np.testing.assert_allclose(law.covariance, covariance[::-1, ::-1], rtol=1e-10)
    curve = law(200)
    assert curve.shape == (201,)
    assert np.all(curve[:2] == 0)
    expected = np.exp(constant) * (np.arange(2, 201) / 90) ** slope
    np.testing.assert_allclose(curve[2:], expected, rtol=1e-12)


def test_power_law_is_that_of_the_template(template):
    law = extrapolate(h.analysis(template, 2 * NSIDE), OWN, SMALL, 64).laws
    for i in range(2):
        # The analysis is good to 1e-6.
        assert float(law[i].slope) == pytest.approx(SLOPES[i], abs=1e-5)
        joined = laws(64)[i, RANGES[i][1]]
        assert float(jnp.exp(law[i].log_amplitude)) == pytest.approx(joined, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "slopes", "errors"),
    [
        ("dust", (-3.38, -2.91), (0.061, 0.046)),
        ("synchrotron", (-2.91, -2.32), (0.032, 0.052)),
        ("ame", (-2.78, -2.07), (0.034, 0.037)),
    ],
)
def test_slopes_of_the_real_sky(data_dir, name, slopes, errors):
    alm = h.analysis(jnp.asarray(real(data_dir, name)), 128)
    laws = extrapolate(alm, 0.0, REAL[name], 128).laws
    np.testing.assert_allclose([law.slope for law in laws], slopes, atol=0.01)
    np.testing.assert_allclose([law.covariance[1, 1] ** 0.5 for law in laws], errors, atol=0.001)


def test_what_is_injected_is_the_law_less_the_template(coefficients, template):
    part = extrapolate(h.analysis(template, 2 * NSIDE), OWN, SMALL, 100)
    law = laws(100)
    beam = np.asarray(h.gaussian_beam(OWN, 2 * NSIDE))
    np.testing.assert_allclose(part.target, law, rtol=1e-4)
    for i, (_, join) in enumerate(RANGES):
        assert np.all(part.injected[i, : join + 1] == 0)
        # Beyond the join the template keeps its beam.
        kept = (beam / beam[join])[join + 1 :] ** 2
        between = law[i, join + 1 : 2 * NSIDE + 1] * (1 - kept)
        np.testing.assert_allclose(part.injected[i, join + 1 : 2 * NSIDE + 1], between, rtol=1e-3)
        np.testing.assert_allclose(part.injected[i, 2 * NSIDE + 1 :], law[i, 2 * NSIDE + 1 :], 1e-4)
        transfer = np.where(np.arange(2 * NSIDE + 1) <= join, 1 / beam, 1 / beam[join])
        np.testing.assert_allclose(part.transfer[i], transfer, rtol=1e-5)


def test_a_template_above_the_law_is_brought_down_to_it(coefficients):
    ell = jnp.arange(2 * NSIDE + 1)
    noisy = coefficients * h.expand(jnp.where(ell > 40, 3.0, 1.0))
    part = extrapolate(noisy, 0.0, SMALL, 100)
    np.testing.assert_allclose(part.transfer[:, 41:], 1 / 3, rtol=1e-12)
    assert np.all(part.injected[:, 41:65] == 0)
    np.testing.assert_allclose(part.injected[:, 65:], laws(100)[:, 65:], rtol=1e-10)


@pytest.mark.slow
def test_final_spectra_of_a_power_law(coefficients, template):
    # All modes count here, so 20 realisations have the law within 2 %: the spectra of single
    # bins and their step at the join.
    alms, (part,), _ = many([template], [OWN], [SMALL], 64, 20)
    steps = assert_follows(alms, part, SMALL, coefficients, 128)
    np.testing.assert_allclose(steps, 1, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dust", "synchrotron"])
def test_final_spectra_of_the_real_sky(data_dir, name):
    maps, small = jnp.asarray(real(data_dir, name)), REAL[name]
    alms, (part,), _ = many([maps], [0.0], [small], 256, 8)
    steps = assert_follows(alms, part, small, h.analysis(maps, 128), 0.95 * 512)
    # The sky itself scatters about its law, in the bin below the join by about 10 %.
    np.testing.assert_allclose(steps, 1, atol=0.2)


@pytest.mark.slow
def test_final_spectra_of_the_embedded_sky():
    # With fewer steps along the line of sight than usual, for speed; slopes are the same in 0.06.
    maps = h.smooth(embedded_sky(512, steps=12).synchrotron[1:], 60.0)
    known, small = 600, SmallScales((10, 120), (4, 40))
    original = h.analysis(maps, known) / h.expand(h.gaussian_beam(60.0, known))
    # Many realisations of the multipoles near the joins, one of all.
    near, (part,), _ = many([maps], [60.0], [small], 128, 12)
    steps = assert_follows(near, part, small, original, 0.95 * 256)
    # Just below its join E of this template is 1.35 times its own law, which is not quite one.
    np.testing.assert_allclose(steps, [0.75, 1.1], atol=0.1)
    alms, (part,), _ = many([maps], [60.0], [small], 512, 1)
    assert_follows(alms, part, small, original, 0.95 * 1024, first=(200, 200))


def test_amplitude_is_that_of_what_is_added(template):
    def alms(amplitude):
        return continued(template, small_scales(amplitude=amplitude))

    none, once = alms(0.0), alms(1.0)
    np.testing.assert_allclose(alms(2.5), none + 2.5 * (once - none), atol=1e-12)
    assert np.all(none[:, h.alm_ell(128) > 2 * NSIDE] == 0)
    fainter = h.power_spectrum(alms(0.5))[:, 70:] / h.power_spectrum(once)[:, 70:]
    np.testing.assert_allclose(fainter, 0.25, rtol=1e-10)


@pytest.mark.parametrize("tilt", [-0.6, 0.4])
def test_tilt_turns_about_the_join(template, tilt):
    tilted, plain = (
        h.power_spectrum(continued(template, small_scales(tilt=t))) for t in (tilt, 0.0)
    )
    ratio = tilted / plain
    for i, (_, join) in enumerate(RANGES):
        np.testing.assert_allclose(ratio[i, 2 : join // 2], 1, rtol=1e-9)
        # With one key the scatter is common; the modulation mixes neighbouring multipoles.
        expected = (np.arange(80, 120) / join) ** tilt
        np.testing.assert_allclose(ratio[i, 80:120], expected, rtol=0.1)


def test_slopes_may_be_given(template):
    def alms(**how):
        return continued(template, small_scales(**how))

    # The template's own slopes, and those with a tilt; the analysis is good to 1e-6.
    np.testing.assert_allclose(alms(slope=SLOPES), alms(), atol=1e-5)
    tilted = alms(slope=(SLOPES[0] - 0.3, SLOPES[1] - 0.3))
    np.testing.assert_allclose(tilted, alms(tilt=-0.3), atol=1e-5)
    np.testing.assert_array_equal(alms(slope=-2.2), alms(slope=(-2.2, -2.2)))


def test_another_key_gives_other_small_scales(template):
    first, second = (continued(template, key=jax.random.key(seed)) for seed in range(2))
    ell = h.alm_ell(128)
    np.testing.assert_allclose(first[:, ell < 10], second[:, ell < 10], atol=1e-12)
    for a, b in zip(first, second, strict=True):
        a, b = a[ell > 70], b[ell > 70]
        # 11,600 modes: 1 % of sampling error.
        assert abs(np.vdot(a, b)) < 0.05 * np.sqrt(np.vdot(a, a) * np.vdot(b, b))
        assert float(np.vdot(a, a) / np.vdot(b, b)) == pytest.approx(1, abs=0.1)


def test_the_spectrum_has_the_window_of_the_final_beam(template):
    maps = [add_small_scales(template, fwhm, nside=64) for fwhm in (60.0, 100.0)]
    fine, coarse = (h.power_spectrum(h.analysis(m, 128)) for m in maps)
    window = h.gaussian_beam(80.0, 128)[2:] ** 2  # 100^2 = 60^2 + 80^2
    np.testing.assert_allclose(coarse[:, 2:] / fine[:, 2:], [window, window], rtol=1e-4)


def test_the_beam_of_the_template_is_taken_out(coefficients, template):
    bare = h.synthesis(coefficients, NSIDE)
    low = h.alm_ell(128) < 10
    expected = coefficients[:, h.alm_ell(2 * NSIDE) < 10][:, : low.sum()]
    for maps, own in [(template, OWN), (bare, 0.0)]:
        np.testing.assert_allclose(continued(maps, own=own)[:, low], expected, atol=1e-6)


def test_modulation():
    npix = 12 * NSIDE**2
    # Intensity 5 everywhere, whatever the angle.
    angle = np.random.default_rng(0).uniform(size=npix)
    uniform = 5 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    np.testing.assert_allclose(modulation(uniform, 180.0, 16), 1, rtol=1e-6)
    # A smooth intensity is left alone by a narrow beam.
    intensity = h.synthesis(jnp.zeros((1, 9)).at[0, :2].set(jnp.array([10.0, 3.0])), NSIDE)[0]
    gain = modulation(intensity * uniform / 5, 180.0, NSIDE)
    np.testing.assert_allclose(gain, intensity / intensity.mean(), rtol=2e-3)
    wide = modulation(intensity * uniform / 5, 3600.0, NSIDE)
    assert float(wide.std()) < 0.9 * float(gain.std())
    # Pixels without emission have a derivative.
    slope = jax.grad(lambda m: modulation(m, 180.0, 16).std())(uniform.at[:, 3].set(0))
    assert bool(jnp.isfinite(slope).all())


@pytest.mark.parametrize("name", FILES)
def test_modulation_of_the_real_sky_is_positive(data_dir, name):
    gain = modulation(jnp.asarray(real(data_dir, name)), 180.0, 128)
    assert float(gain.min()) > 0
    # The mean over pixels is that over the sphere within the quadrature.
    assert float(gain.mean()) == pytest.approx(1, abs=1e-4)
    assert float(gain.max()) > 5


@pytest.fixture(scope="module")
def result(template):
    """The map as a function of slope, tilt, amplitude, own and target beam, modulation."""

    @jax.jit
    def function(slope, tilt, amplitude, own, fwhm, smoothing, factor=1.0):
        how = SmallScales(*RANGES, slope, tilt, amplitude, smoothing)
        maps = template * jnp.stack([factor**2 * jnp.ones(12 * NSIDE**2), jnp.ones(12 * NSIDE**2)])
        return add_small_scales(maps, fwhm, how, own)

    return function


AT = (-2.3, 0.1, 1.2, OWN, 150.0, 1200.0, 1.1)
NAMES = ["slope", "tilt", "amplitude", "own", "fwhm", "modulation_fwhm", "maps"]


@pytest.mark.slow
def test_inside_jit(result, template):
    eager = add_small_scales(template, 150.0, SmallScales(*RANGES, -2.3, 0.1, 1.2, 1200.0))
    # Inside jit the last multipoles of the own beam and of the modulation are not cut.
    np.testing.assert_allclose(result(*AT[:-1]), eager, atol=1e-6)


@pytest.fixture(scope="module")
def tangent(result):
    """The derivative of the map along a change of its arguments."""
    return jax.jit(lambda change: jax.jvp(result, AT, change)[1])


def change(i):
    """A change of one argument only."""
    return tuple(1.0 if j == i else 0.0 for j in range(len(AT)))


@pytest.mark.parametrize("i", range(len(AT)), ids=NAMES)
def test_derivatives(result, tangent, i):
    def function(value):
        return result(*AT[:i], value, *AT[i + 1 :])

    h = 1e-4 * max(abs(AT[i]), 1.0)
    slope = tangent(change(i))
    difference = (function(AT[i] + h) - function(AT[i] - h)) / (2 * h)
    largest = float(jnp.abs(difference).max())
    assert largest * abs(AT[i]) > 1e-4
    np.testing.assert_allclose(slope, difference, atol=1e-5 * largest)


@pytest.mark.slow
def test_derivatives_backwards(result, tangent):
    weights = jax.random.normal(KEY, (2, 12 * NSIDE**2))
    back = jax.grad(lambda args: jnp.vdot(weights, result(*args)))(AT)
    for i, slope in enumerate(back):
        forward = float(jnp.vdot(weights, tangent(change(i))))
        assert float(slope) == pytest.approx(forward, rel=1e-6)


def test_wide_beams_have_derivatives_when_traced():
    # The square of the window of 20 degrees at l = 64 is 1e-236, its derivatives divide by more.
    alm = jax.random.normal(KEY, (2, 65**2)) * h.expand(h.gaussian_beam(1200.0, 64))
    small = SmallScales((4, 10), (4, 10))

    def total(own):
        part = extrapolate(alm, own, small, 64)
        return jnp.sum(part.injected) + jnp.sum(alm * h.expand(part.transfer))

    at = jnp.asarray(1200.0)
    difference = (total(at + 0.01) - total(at - 0.01)) / 0.02
    assert float(jax.jit(jax.grad(total))(at)) == pytest.approx(float(difference), rel=1e-5)


@pytest.fixture(scope="module")
def pair(data_dir):
    """Dust and AME at nside 128 from the real maps at 64, six keys; and the templates."""
    maps = [jnp.asarray(real(data_dir, name)) for name in ("dust", "ame")]
    found = many(maps, [0.0, 0.0], [REAL["dust"], REAL["ame"]], 128, 6)
    return *found, jnp.concatenate([h.analysis(m, 128) for m in maps])


def coefficients_of(alms, weight):
    products = np.asarray((alms * weight) @ alms.T)
    scale = np.sqrt(np.diag(products))
    return products / np.outer(scale, scale)


@pytest.mark.slow
def test_dust_and_ame_stay_as_correlated_as_they_are(pair):
    alms, parts, _, templates = pair
    ell = h.alm_ell(128)
    given = coefficients_of(templates, (ell >= 20) & (ell <= 100))
    # The maps' correlations: E of dust with E of AME and B with B, little else.
    assert given[0, 2] > 0.6
    assert given[1, 3] > 0.35
    # Beyond the template all is injected. Multipoles weigh alike when divided by the laws.
    ell = h.alm_ell(256)
    target = jnp.concatenate([part.target for part in parts])
    white = alms / jnp.where(target > 0, jnp.sqrt(target), 1.0)[:, ell]
    inside = (ell > 140) & (ell < 245)
    measured = np.array([coefficients_of(each, inside) for each in white])
    # 40,000 modes over a sky fraction of about 0.04: 2.5 % a realisation.
    np.testing.assert_allclose(measured.mean(axis=0), given, atol=0.04)
    assert float(measured.std(axis=0).max()) < 0.05


@pytest.mark.slow
def test_the_spectra_of_a_pair_are_those_of_each_alone(pair):
    alms, parts, _, templates = pair
    for i, part in enumerate(parts):
        fields = slice(2 * i, 2 * i + 2)
        assert_follows(alms[:, fields], part, REAL["dust"], templates[fields], 0.95 * 256)


@pytest.mark.slow
def test_repaired_multipoles_are_counted(pair):
    _, parts, repaired, templates = pair
    templates, ell = np.asarray(templates), h.alm_ell(128)
    rho = coefficients_of(templates, (ell >= 20) & (ell <= 100))
    target, transfer = (
        np.concatenate([np.asarray(getattr(part, name))[:, :129] for part in parts])
        for name in ("target", "transfer")
    )
    bad = 0
    for degree in range(101, 129):
        stay = templates[:, ell == degree] * transfer[:, degree, None]
        kept, law = stay @ stay.T / (2 * degree + 1), target[:, degree]
        wanted = np.where(np.eye(4, dtype=bool), np.diag(law), rho * np.sqrt(np.outer(law, law)))
        known = np.diag(kept) / law
        mixing = (1 - np.sqrt(np.minimum(known, 1)))[:, None] * known * wanted / law
        np.fill_diagonal(mixing, 1)
        matrix = wanted - mixing @ kept @ mixing.T
        there = np.diag(matrix) > 1e-12 * law
        bad += np.linalg.eigvalsh(matrix[there][:, there])[0] < 0 if there.any() else 0
    # Close to the template's end little is missing, and its differences know no bounds.
    assert 0 < bad < 29
    assert int(repaired) == bad


@pytest.mark.slow
def test_derivatives_of_a_pair(coefficients, template):
    # A second template that is much like the first; many multipoles are repaired.
    other = 0.3 * coefficients + 0.2 * coefficients[::-1]
    second = h.synthesis(other * h.expand(h.gaussian_beam(OWN, 2 * NSIDE)), NSIDE)

    @jax.jit
    def function(tilt):
        small = SmallScales((5, 30), (5, 30), tilt=tilt, modulation_fwhm=1200.0)
        done = continue_templates(KEY, [template, second], [OWN, OWN], [small, small], NSIDE)
        return jnp.concatenate(done.alms), done.repaired

    (_, repaired), (slope, _) = jax.jvp(function, (0.1,), (1.0,))
    assert int(repaired) > 0
    difference = (function(0.1 + 1e-4)[0] - function(0.1 - 1e-4)[0]) / 2e-4
    np.testing.assert_allclose(slope, difference, atol=1e-4 * float(jnp.abs(slope).max()))


@pytest.mark.parametrize(("argument", "error", "message"), cases("small_scales/nonsense"))
def test_refuses_nonsense(argument, error, message):
    given = {"EE": (5, 30), "BB": (5, 20)} | argument
    raises(getattr(builtins, error), message, SmallScales, **given)


def test_refuses_ranges_that_cannot_be_fitted(template):
    message = (
        "A power law cannot be fitted from l = 5 to 65 to a spectrum that ends at 64; "
        "it needs four multipoles from l = 2 on."
    )
    how = SmallScales(EE=(5, 65), BB=(5, 20))
    raises(ValueError, message, continued, template, how, 0.0, NSIDE)


def test_refuses_templates_without_power_or_of_the_wrong_shape(template):
    words = "`spectrum` must be positive, but its smallest value is"
    raises(ValueError, words, continued, 0 * template, own=0.0)
    for maps in (template[:1], template[0], jnp.ones((3, 12 * NSIDE**2))):
        raises(ValueError, r"shape \(2, pix\), Q and U, not of shape \(", continued, maps, own=0.0)


@pytest.mark.slow
def test_a_coarse_template_is_correlated_with_what_is_known_of_a_finer_one(data_dir):
    # Dust is known up to l = 128, AME at 3 degrees up to l = 50: there it follows the dust's own
    # coefficients, beyond both it is drawn with them.
    dust, ame = (jnp.asarray(real(data_dir, name)) for name in ("dust", "ame"))
    small = [REAL["dust"], SmallScales((20, 50), (20, 50))]
    ranges = {"both known": slice(20, 51), "dust known": slice(60, 120), "none": slice(140, 250)}
    found = {name: [] for name in ranges}
    for seed in range(6):
        maps = [dust, h.smooth(ame, 180.0)]
        one, other = continue_templates(jax.random.key(seed), maps, [0.0, 180.0], small, 128).alms
        cross, auto = h.power_spectrum(one, other), h.power_spectrum(one) * h.power_spectrum(other)
        rho = np.asarray(cross / jnp.sqrt(auto))
        for name, part in ranges.items():
            found[name].append(rho[:, part].mean(axis=1))
    means = {name: np.mean(values, axis=0) for name, values in found.items()}
    # Coefficients at l = 20 to 50 weigh by power what this mean weighs by l; and few realisations
    # of a field that is bright on 5 % of the sky scatter by 0.03.
    for name in ("dust known", "none"):
        np.testing.assert_allclose(means[name], means["both known"], atol=0.1)
