"""Fitting tools for jaxsky skies ("fits" as in model fits, not FITS files).

Public names (`__all__`) are imported from here, each when it is first used.
"""

from typing import TYPE_CHECKING

from jaxsky.public import exported  # before all else

if TYPE_CHECKING:
    from fits.commands.forecast import forecast
    from fits.comparison import compare
    from fits.compress import as_noise
    from fits.grid import grid_fit
    from fits.multipoles import harmonic_coefficients, harmonic_likelihood
    from fits.optimize import Newton, best_fit
    from fits.plots import plot_sed
    from fits.posterior import Gaussian, Uniform, chi2
    from fits.profile_likelihood import spectral_likelihood
    from fits.pseudo_cl import band_powers, bin_edges, masked_spectra
    from fits.regions import apodize, superpixels
    from fits.results import FitError, FitResult
    from fits.sampling import sample
    from fits.separated_maps import component_maps, harmonic_component_maps, separate
    from fits.separated_moments import separate_moments
    from fits.template_likelihood import likelihood
    from fits.tensor_ratio import fit_tensors, power_model

__all__, __getattr__, __dir__ = exported(__name__)
