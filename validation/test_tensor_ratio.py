"""Skies with gravitational waves, separated: r comes back."""

import jax
import numpy as np

from fits.cleaning import separate
from fits.optimize import best_fit
from fits.priors import priors_of
from fits.pseudo_cl import band_powers
from fits.separated_data import separation_data
from fits.tensor_ratio import fit_tensors
from jaxsky.cmb import camb_spectra, realisation
from jaxsky.harmonics import expand, gaussian_beam, synthesis
from jaxsky.settings import Experiment

NSIDE, FWHM, R, SKIES = 32, 180.0, 0.01, 100
SETTINGS = {
    "title": "gravitational waves",
    "seed": 5,
    "sky": {"embedded": {"nside": NSIDE}},
    "bands": [
        {
            "instrument": "litebird",
            "channels": ["40", "68", "100", "140", "195", "280", "402"],
        }
    ],
    "common": {"nside": NSIDE, "fwhm": FWHM},
    "free": {
        "dust.beta_dust": {"start": 1.6, "uniform": [0.5, 2.5]},
        "synchrotron.beta_syn": {"start": 3.0},
    },
    "separate": {"region": "outside", "nsims": 50, "width": 5, "apodization": 20.0},
}


def test_r_comes_back():
    how = Experiment.model_validate(SETTINGS)
    given = separation_data(how)
    found = separate(how, given)
    lmax = 2 * NSIDE
    spectra, window = camb_spectra(lmax, R), expand(gaussian_beam(FWHM, lmax))

    @jax.jit
    def cmb(key):
        return synthesis(realisation(key, spectra) * window, NSIDE)

    model = found.tensors.model
    # The error at the truth: those at estimates grow with them where few modes decide.
    sigma = 1 / np.sqrt(model.tensors @ np.linalg.solve(model.covariance(R), model.tensors))
    assert sigma < R
    pulls = []
    for key in jax.random.split(jax.random.key(91), SKIES):
        noise = given.noise_realisation(jax.random.fold_in(key, 1))
        data = np.where(given.used, given.foregrounds + np.asarray(cmb(key)) + noise, 0.0)
        like = given.likelihood(data)
        fit = best_fit(like, found.fit.best_fit, priors=priors_of(how, "separate"))
        maps = given.components(like, fit.best_fit, data, covariance=False).amplitude
        powers = band_powers(found.spectra, maps[found.components.index("cmb")])[1]
        pulls.append((fit_tensors(model, powers).r - R) / sigma)
    print(
        f"r = {R}: sigma {sigma:.2g}, mean pull {np.mean(pulls):+.3f}, scatter {np.std(pulls):.3f}"
    )
    # The mean of 100 is known to 0.1, their scatter to 7 %. 50 simulations measure the errors of
    # powers to 10 %, and outside a mask the variance of tensors at low l is an approximation.
    assert abs(np.mean(pulls)) < 0.3
    assert 0.75 < np.std(pulls) < 1.45
