"""Forecasts: foregrounds against primordial B modes, and errors from the Fisher matrix."""

from fits.forecast.b_modes import BandLaw, equal_r, fit_law, foreground_powers
from fits.forecast.fisher import Errors, Model, covariance, fiducial, fisher_errors, unit_sky
from fits.forecast.forecast import Forecast, forecast
from fits.forecast.settings import DEFAULT, EXAMPLE, ForecastSettings, load_forecast

__all__ = [
    "DEFAULT",
    "EXAMPLE",
    "BandLaw",
    "Errors",
    "Forecast",
    "ForecastSettings",
    "Model",
    "covariance",
    "equal_r",
    "fiducial",
    "fisher_errors",
    "fit_law",
    "forecast",
    "foreground_powers",
    "load_forecast",
    "unit_sky",
]
