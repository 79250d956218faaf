"""Forecasts: foregrounds against primordial B modes, and errors from the Fisher matrix."""

from fits.forecast.b_modes import BandLaw, equal_r, fit_law, foreground_powers
from fits.forecast.fisher import Errors, Model, covariance, fiducial, fisher_errors, unit_sky
from fits.forecast.forecast import Forecast, forecast

__all__ = [
    "BandLaw",
    "Errors",
    "Forecast",
    "Model",
    "covariance",
    "equal_r",
    "fiducial",
    "fisher_errors",
    "fit_law",
    "forecast",
    "foreground_powers",
    "unit_sky",
]
