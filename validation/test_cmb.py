"""Spectra of the CMB against CAMB at an accuracy that commands cannot wait for."""

import camb
import numpy as np

from jaxsky.cmb import PLANCK_2018, camb_spectra, tensor_spectra

#: Finer steps in time, wavenumber and multipole than any of CAMB's defaults.
HIGHEST = {"AccuracyBoost": 2, "lSampleBoost": 2, "lAccuracyBoost": 2}


def worst(found, expected, first, end):
    ells = slice(first, end)
    return np.max(np.abs(found[1:3, ells] / expected[1:3, ells] - 1), axis=1)


def test_lensed_scalars():
    params = camb.set_params(**PLANCK_2018, **HIGHEST, lmax=4000, lens_potential_accuracy=8)
    results = camb.get_results(params)
    expected = results.get_lensed_scalar_cls(2500, CMB_unit="muK", raw_cl=True).T
    for lmax in (100, 300, 1500, 2500):
        EE, BB = worst(camb_spectra(lmax), expected, 2, lmax + 1)
        assert BB < 0.003
        assert EE < 0.003


def test_tensors():
    params = camb.set_params(
        **PLANCK_2018,
        **HIGHEST,
        r=1.0,
        nt=0.0,
        WantTensors=True,
        WantScalars=False,
        lmax=3200,
        max_l_tensor=3200,
        max_eta_k_tensor=15000,
    )
    expected = camb.get_results(params).get_tensor_cls(2000, CMB_unit="muK", raw_cl=True).T
    found = tensor_spectra(2000)
    # From l = 1500 on, steps in wavenumber move even CAMB's finest run by some per cent.
    for first, end, close in ((2, 1000, 0.007), (1000, 1500, 0.02), (1500, 2001, 0.12)):
        assert np.all(worst(found, expected, first, end) < close)
    r = 0.01
    added = camb_spectra(2000, r) - camb_spectra(2000)
    assert np.all(worst(added, r * expected, 2, 400) < 0.007)
    assert tensor_spectra(6001)[2, 2:].min() > 0
