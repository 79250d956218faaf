"""The CMB: spectra from CAMB, and Gaussian fields, whose spectra may have to be repaired."""

import camb
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky import cmb
from jaxsky.cmb import gaussian_fields, repair
from jaxsky.harmonics import alm_ell
from refusals import cases, raises

LMAX = 64


def test_spectra_and_realisation():
    spectra = cmb.camb_spectra(LMAX, r=0.1)
    TT, _, BB, _ = spectra
    assert spectra.shape == (4, LMAX + 1)
    # D_l of TT at l = 10 is about 850 uK^2; r = 0.1 lifts BB over that of lensing.
    assert 700 < 110 / (2 * np.pi) * TT[10] < 1000
    assert BB[10] > 3 * cmb.camb_spectra(LMAX)[2][10]
    keys = jax.random.split(jax.random.key(0), 300)
    alms = jax.vmap(lambda k: cmb.realisation(k, jnp.asarray(spectra), "IQU"))(keys)
    ell = alm_ell(LMAX)
    for degree in (2, 30, 64):
        modes = np.asarray(alms[:, :, ell == degree]).swapaxes(0, 1).reshape(3, -1)
        measured = modes @ modes.T / modes.shape[1]
        tt, ee, bb, te = spectra[:, degree]
        expected = np.array([[tt, te, 0], [te, ee, 0], [0, 0, bb]])
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(
            measured / scale, expected / scale, atol=6 / modes.shape[1] ** 0.5
        )


def test_polarization_alone_is_that_of_a_realisation_with_intensity():
    spectra = jnp.asarray(cmb.camb_spectra(LMAX))
    key = jax.random.key(1)
    both = cmb.realisation(key, spectra, "IQU")
    np.testing.assert_array_equal(cmb.realisation(key, spectra), both[1:])


def test_tensors_are_what_r_adds():
    tensors, scalars = cmb.tensor_spectra(LMAX), cmb.camb_spectra(LMAX)
    assert tensors.shape == (4, LMAX + 1)
    assert not tensors[:, :2].any()
    for r in (1e-3, 0.1):
        np.testing.assert_array_equal(cmb.camb_spectra(LMAX, r), scalars + r * tensors)


@pytest.mark.slow
def test_tensors_are_those_of_cambs_r():
    """With the scalars in the same run, and r and the tilt as they are written in CAMB."""
    changes = {"r": 0.1, "nt": 0.0, "WantTensors": True, "lSampleBoost": 2}
    direct = camb.set_params(**cmb.PLANCK_2018, **changes, lmax=600)
    both = camb.get_results(direct).get_tensor_cls(300, CMB_unit="muK", raw_cl=True).T
    added = cmb.camb_spectra(300, r=0.1) - cmb.camb_spectra(300)
    np.testing.assert_allclose(added[1:3, 2:], both[1:3, 2:], rtol=0.02)
    ells = [64, 300]
    changed = cmb.tensor_spectra(300, **cmb.PLANCK_2018, nt=-0.5)[2, ells]
    tilted = changed / cmb.tensor_spectra(300)[2, ells]
    # l = 64 is about k = 0.0046 / Mpc or more, where a tilt about 0.05 / Mpc is a factor of 3.3.
    assert 1 < tilted[1] < tilted[0] < 3.3


def test_a_multipole_has_one_value():
    many = cmb.camb_spectra(2000, r=0.05)
    for lmax in (2, LMAX, 601, 1500, 1501):
        few = cmb.camb_spectra(lmax, r=0.05)
        assert few.shape == (4, lmax + 1)
        np.testing.assert_array_equal(few, many[:, : lmax + 1])
    few[:] = 0  # what one caller does with it is not what another gets
    np.testing.assert_array_equal(cmb.camb_spectra(2000, r=0.05), many)


def test_lensing_does_not_end_with_a_piece():
    """The first piece of scalars against the next one, which is made to higher multipoles."""
    first, longer = cmb.camb_spectra(1500), cmb._scalars(3000, **cmb.PLANCK_2018)[:, :1501]
    np.testing.assert_allclose(first[:3, 2:], longer[:3, 2:], rtol=1e-3)


@pytest.mark.slow
def test_what_a_cosmology_does_not_say_is_that_of_planck():
    known = cmb.camb_spectra(60)
    np.testing.assert_array_equal(cmb.camb_spectra(60, H0=cmb.PLANCK_2018["H0"]), known)
    # Primordial power is linear in As, and what lensing adds to it is small.
    brighter = cmb.camb_spectra(60, As=2 * cmb.PLANCK_2018["As"])
    np.testing.assert_allclose(brighter[1, 2:], 2 * known[1, 2:], rtol=0.1)
    # An angle in place of H0 is not one beside it.
    assert np.isfinite(cmb.camb_spectra(60, cosmomc_theta=0.0104)).all()


@pytest.mark.parametrize(("cosmology", "words"), cases("cmb/cosmologies_that_are_none"))
def test_cosmologies_that_are_none_are_refused(cosmology, words):
    for spectra in (cmb.camb_spectra, cmb.tensor_spectra):
        raises(ValueError, words, spectra, 10, **cmb.PLANCK_2018 | cosmology)


def test_refuses_nonsense():
    for r in (-1, np.nan, np.inf):
        raises(ValueError, f"`r` must be a number from 0 on, but is {r}", cmb.camb_spectra, 10, r=r)
    raises(ValueError, "`lmax` must not be negative, but is -2", cmb.tensor_spectra, -2)
    with pytest.raises(ValueError, match="`stokes` must be one of I, QU, IQU, not 'Q'"):
        cmb.realisation(jax.random.key(0), jnp.ones((4, 5)), "Q")


@pytest.mark.slow
def test_spectra_are_kept_from_one_process_to_the_next(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXSKY_CACHE", str(tmp_path))

    def fresh(**cosmology):
        """As in another process."""
        cmb._scalars.cache_clear()
        return cmb.camb_spectra(20, **cosmology)

    first = fresh()
    (kept,) = (tmp_path / "spectra").iterdir()
    computed, compute = [], camb.get_results
    monkeypatch.setattr(camb, "get_results", lambda p: (computed.append(p), compute(p))[1])
    np.testing.assert_array_equal(fresh(), first)
    assert not computed
    kept.write_bytes(kept.read_bytes()[:500])  # damaged
    np.testing.assert_allclose(fresh(), first, rtol=1e-9)
    assert len(computed) == 1
    other = fresh(H0=70.0, ombh2=0.022, omch2=0.12, tau=0.05, As=2.1e-9, ns=0.96)
    assert np.abs(other[:, 2:] / first[:, 2:] - 1).max() > 1e-3
    assert len(list((tmp_path / "spectra").iterdir())) == 2
    monkeypatch.setenv("JAXSKY_CACHE", str(kept / "no" / "folder"))
    np.testing.assert_allclose(fresh(), first, rtol=1e-9)
    cmb._scalars.cache_clear()


DUST_LMAX = 40
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def spectra():
    """Spectra of dust E, B and AME E, B like those of the sky, zero below l = 2."""
    correlations = np.array(
        [[1, -0.1, 0.7, 0], [-0.1, 1, 0.05, 0.5], [0.7, 0.05, 1, -0.15], [0, 0.5, -0.15, 1]]
    )
    ell = np.arange(DUST_LMAX + 1)
    slopes = np.array([-2.4, -2.2, -2.8, -2.0])[:, None]
    root = np.sqrt([[4.0], [2.0], [0.1], [0.05]]) * np.maximum(ell, 1) ** (slopes / 2) * (ell > 1)
    return jnp.asarray(correlations[..., None] * root[:, None] * root)


def mixed(level, coefficient):
    """Three fields: none, no power in one, uncorrelated, valid, impossible, twice impossible."""
    ones, zero = jnp.ones(()), jnp.zeros(())
    c = coefficient

    def matrix(a, b, d):
        return jnp.array([[1, a, b], [a, 1, d], [b, d, 1]])

    blocks = [
        matrix(zero, zero, zero) * 0,
        matrix(c, zero, zero).at[2].set(0),
        matrix(zero, zero, zero),
        matrix(0.5 * c, 0.2 * ones, -0.3 * c),
        matrix(c, c, -0.8 * ones),
        matrix(-1.5 * c, -1.6 * c, -1.7 * ones),
    ]
    scale = jnp.array([1.0, 3.0, 1e-4]) * level
    return jnp.stack(blocks, axis=-1) * scale[:, None, None] * scale[:, None]


def test_a_single_field_is_white_noise_times_the_root_of_its_spectrum():
    spectrum = jnp.arange(5.0)
    white = jax.random.normal(KEY, (1, 25))
    expected = white * np.sqrt(spectrum)[alm_ell(4)]
    np.testing.assert_allclose(gaussian_fields(KEY, spectrum[None, None]), expected, rtol=1e-14)


def test_what_is_fine_is_left_as_it_is(spectra):
    mended, count = repair(spectra)
    assert int(count) == 0
    np.testing.assert_allclose(mended, spectra, rtol=1e-14)


def test_two_fields_that_are_too_correlated_become_proportional():
    # The closest coefficient to 1.3 is 1; the auto-spectra 4 and 9 stay, so the cross is 6.
    bad = jnp.array([[4.0, -7.8], [-7.8, 9.0]])[..., None]
    mended, count = repair(bad)
    assert int(count) == 1
    # Eigenvalues are kept above 1e-10, so the coefficient is 1 within that.
    np.testing.assert_allclose(mended[..., 0], [[4, -6], [-6, 9]], rtol=1e-9)
    E, B = gaussian_fields(KEY, mended)
    np.testing.assert_allclose(B, -1.5 * E, atol=1e-4 * float(jnp.abs(E).max()))


def test_impossible_correlations_are_counted_and_mended():
    given = mixed(1.0, 0.9)
    mended, count = repair(given)
    assert int(count) == 2
    np.testing.assert_allclose(mended[..., :4], given[..., :4], rtol=1e-14, atol=0)
    power = np.einsum("iil->li", mended)
    np.testing.assert_allclose(power, np.einsum("iil->li", given), rtol=1e-13)
    for ell in (4, 5):
        scale = np.sqrt(power[ell])
        correlations = np.asarray(mended[..., ell]) / np.outer(scale, scale)
        least = np.linalg.eigvalsh(correlations)[0]
        assert 0 < least < 1e-9
        assert abs(correlations).max() < 1 + 1e-9
        # Clipping the eigenvalues and scaling the diagonal back, written out.
        original = np.asarray(given[..., ell]) / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(original)
        assert values[0] < -0.1
        clipped = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        norm = np.sqrt(np.diag(clipped))
        np.testing.assert_allclose(correlations, clipped / np.outer(norm, norm), atol=1e-9)


def test_without_power_there_are_no_correlations():
    given = mixed(1.0, 0.9).at[0, 2, 1].set(5.0).at[2, 0, 1].set(5.0)
    mended, count = repair(given)
    assert int(count) == 2  # those of before; nothing had to be mended here
    assert np.all(mended[..., 0] == 0)
    assert np.all(mended[2, :, 1] == 0)
    fields = gaussian_fields(KEY, mended)
    assert bool(jnp.isfinite(fields).all())
    assert np.all(fields[:, alm_ell(5) == 0] == 0)
    assert np.all(fields[2, alm_ell(5) == 1] == 0)


@pytest.mark.parametrize("argument", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_derivatives_of_fields(argument):
    # Through multipoles without power, without correlations and with repaired ones.
    at = [jnp.asarray(1.3), jnp.asarray(0.9)]

    def fields(value):
        values = [*at[:argument], value, *at[argument + 1 :]]
        return gaussian_fields(KEY, repair(mixed(*values))[0])

    moved, h = jax.jit(lambda value: jax.jvp(fields, (value,), (jnp.ones(()),))), 1e-4
    value, tangent = moved(at[argument])
    difference = (moved(at[argument] + h)[0] - moved(at[argument] - h)[0]) / (2 * h)
    # Of repaired fields the roots of eigenvalues 1e-10 carry rounding of 1e-11 / h.
    scale = np.abs(value).max(axis=1, keepdims=True)
    np.testing.assert_allclose(tangent / scale, difference / scale, atol=1e-6)
    assert float(np.abs(tangent[2] / scale[2]).max()) > 0.1
    weights = jax.random.normal(jax.random.key(3), tangent.shape)
    pulled = jax.jit(jax.grad(lambda value: jnp.vdot(weights, fields(value))))(at[argument])
    assert float(pulled) == pytest.approx(float(jnp.vdot(weights, tangent)), rel=1e-9)


def test_derivatives_in_every_spectrum_are_finite():
    given = mixed(1.0, 0.9)
    slopes = jax.grad(lambda s: jnp.sum(gaussian_fields(KEY, repair(s)[0]) ** 2))(given)
    assert bool(jnp.isfinite(slopes).all())
    assert np.all(slopes[..., 0] == 0)
    assert float(slopes[0, 0, 2]) > 0
