"""Forecasts: foregrounds against primordial B modes, and errors from the Fisher matrix."""

from fits.forecast.b_modes import BandLaw, equal_r, fit_law, foreground_powers
from fits.forecast.fisher import Errors, Model, covariance, fiducial, fisher_errors, unit_sky
from fits.forecast.forecast import Forecast, forecast
