"""The CMB: spectra from CAMB and Gaussian realisations of them."""

import camb
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsky import cmb
from jaxsky.harmonics import alm_ell

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


def test_what_a_cosmology_does_not_say_is_that_of_planck():
    known = cmb.camb_spectra(60)
    np.testing.assert_array_equal(cmb.camb_spectra(60, H0=cmb.PLANCK_2018["H0"]), known)
    # Primordial power is linear in As, and what lensing adds to it is small.
    brighter = cmb.camb_spectra(60, As=2 * cmb.PLANCK_2018["As"])
    np.testing.assert_allclose(brighter[1, 2:], 2 * known[1, 2:], rtol=0.1)
    # An angle in place of H0 is not one beside it.
    assert np.isfinite(cmb.camb_spectra(60, cosmomc_theta=0.0104)).all()


@pytest.mark.parametrize(
    ("cosmology", "words"),
    [
        ({"H0": -70.0}, "'H0' of the cosmology is -70.0, which is negative"),
        ({"H0": np.nan}, "'H0' of the cosmology is nan"),
        ({"H0": 0.5}, "CAMB does not take the cosmology: H0 is the value in km/s/Mpc"),
        ({"omega": 0.3}, "CAMB does not take the cosmology: Unrecognized parameter: omega"),
        ({"max_l_tensor": 100}, "'max_l_tensor' is no parameter of the cosmology"),
        ({"WantTensors": 1.0}, "'WantTensors' is no parameter of the cosmology"),
    ],
)
def test_cosmologies_that_are_none_are_refused(cosmology, words):
    for spectra in (cmb.camb_spectra, cmb.tensor_spectra):
        with pytest.raises(ValueError, match=words):
            spectra(10, **(cmb.PLANCK_2018 | cosmology))


def test_refuses_nonsense():
    for r in (-1, np.nan, np.inf):
        with pytest.raises(ValueError, match=f"`r` must be a number from 0 on, but is {r}"):
            cmb.camb_spectra(10, r=r)
    with pytest.raises(ValueError, match="`lmax` must not be negative, but is -2"):
        cmb.tensor_spectra(-2)
    with pytest.raises(ValueError, match="`stokes` must be 'QU' or 'IQU', not 'Q'"):
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
