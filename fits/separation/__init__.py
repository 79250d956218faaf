"""Component separation with parametric laws: spectra first, then maps of the components."""

from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.separation.fit import fisher, fit_spectra, hessian
from fits.separation.harmonic import (
    HarmonicMaps,
    harmonic_coefficients,
    harmonic_component_maps,
    harmonic_likelihood,
    white_spectrum,
)
from fits.separation.maps import (
    ComponentMaps,
    component_maps,
    noise_degradation,
    residual_maps,
)
from fits.separation.noise import Noise, as_noise
from fits.separation.regions import clusters, latitude_bands, superpixels
from fits.separation.results import SpectralFit
from fits.separation.sample import sample_spectra
