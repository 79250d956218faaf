"""What the settings of a forecast name, brought together at one resolution."""

from typing import NamedTuple

import healpy
import numpy as np
from jaxtyping import Float

from fits.preparation import Preparation, prepare_component
from fits.regions import apodize, region_mask
from jaxsky import Sky
from jaxsky.experiment import map_nside, read_channel
from jaxsky.harmonics import gaussian_beam
from jaxsky.inputs import Template, read_sky
from jaxsky.io import degrade_mask
from jaxsky.observation import ObservedBand
from jaxsky.settings import Experiment, SettingsError

#: Spectra are corrected for beams down to this window.
LEAST_WINDOW = 0.05


class Setup(NamedTuple):
    """What is forecast.

    Parameters
    ----------
    sky : foregrounds, with one beam and one nside
    fwhm : their beam [arcmin]
    mask : weight of each pixel, 0 to 1
    bands : all bands
    shown : names of those of which spectra are taken
    description : what the foregrounds are
    """

    sky: Sky
    fwhm: float
    mask: Float[np.ndarray, " pix"]
    bands: dict[str, ObservedBand]
    shown: tuple[str, ...]
    description: str


def build(settings: Experiment) -> Setup:
    """Read what the settings name, and check that it can work."""
    spec = settings.forecast
    if not settings.cmb.include:
        raise SettingsError("cmb.include: is false, but a forecast has a CMB.")
    if settings.cmb.spectra is not None:
        raise SettingsError("cmb.spectra: a forecast changes r, which takes spectra of CAMB.")
    templates, description = read_sky(settings, names=settings.modelled())
    if not templates:
        raise SettingsError("sky: has no components; a forecast takes some.")
    if not settings.bands:
        raise SettingsError("bands: there are none.")
    pixels = map_nside(settings, templates)
    bands = {str(one.name): read_channel(settings, one, pixels) for one in settings.bands}
    for name, band in bands.items():
        if band.noise is None:
            raise SettingsError(f"bands.{name}.noise: is missing.")
    shown = spec.bands or _few(tuple(bands))
    for name in shown:
        if name not in bands:
            raise SettingsError(f"forecast.bands: {name!r} is none of {', '.join(bands)}.")
    fwhm = max(template.fwhm for template in templates.values())
    nside = min(healpy.npix2nside(template.used.size) for template in templates.values())
    _check_resolution(spec.lmax, nside, fwhm)
    used = region_mask(settings, spec.region, nside, coarser=True)
    for template in templates.values():
        used &= degrade_mask(template.used, nside, 1.0)
    sky = Sky({name: _prepared(template, nside, fwhm) for name, template in templates.items()})
    mask = apodize(used, spec.apodization)
    if not mask.any():
        raise SettingsError("forecast.region: leaves no pixel.")
    return Setup(sky, fwhm, mask, bands, tuple(shown), description)


def _few(names: tuple[str, ...], most: int = 5) -> list[str]:
    """The names, or a few of them that are evenly spread."""
    at = np.linspace(0, len(names) - 1, min(most, len(names)))
    return [names[i] for i in at.round().astype(int)]


def _check_resolution(lmax: int, nside: int, fwhm: float) -> None:
    if lmax > 2 * nside - 1:
        raise SettingsError(
            f"forecast.lmax: {lmax} is beyond what templates of nside {nside} resolve, "
            f"{2 * nside - 1}."
        )
    if (window := float(gaussian_beam(fwhm, lmax)[lmax])) < LEAST_WINDOW:
        raise SettingsError(
            f"forecast.lmax: the templates' beam of {fwhm:g} arcmin leaves {window:.2g} of the "
            f"amplitude at l = {lmax}; a correction takes {LEAST_WINDOW:g}."
        )


def _prepared(template: Template, nside: int, fwhm: float):
    own = healpy.npix2nside(template.used.size)
    if own == nside and template.fwhm == fwhm:
        return template.component
    operator = Preparation.smoothing(own, template.fwhm, nside, fwhm, 2 * nside)
    return prepare_component(template.component, operator, template.used)
