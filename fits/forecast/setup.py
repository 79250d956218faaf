"""What the settings of a forecast name, brought together at one resolution."""

from pathlib import Path
from typing import NamedTuple

import healpy
import numpy as np
from jaxtyping import Bool, Float

from fits.forecast.settings import ForecastSettings, Mask
from fits.preparation import Preparation, prepare_component
from jaxsky import Sky
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import gaussian_beam
from jaxsky.inputs import Template, read_templates, set_parameters_of
from jaxsky.instrument import Channel, Instrument, load_instrument
from jaxsky.io import degrade_mask, read_mask
from jaxsky.lookup import find_file
from jaxsky.settings import SettingsError
from jaxsky.settings_keys import at_key

__all__ = ["Setup", "apodize", "build"]

#: Spectra are corrected for beams down to this window.
LEAST_WINDOW = 0.05


class Setup(NamedTuple):
    """What is forecast.

    Parameters
    ----------
    sky : foregrounds, with one beam and one nside
    fwhm : their beam [arcmin]
    mask : weight of each pixel, 0 to 1
    instrument : all channels
    shown : names of those of which spectra are taken
    description : what the foregrounds are
    """

    sky: Sky
    fwhm: float
    mask: Float[np.ndarray, " pix"]
    instrument: Instrument
    shown: tuple[str, ...]
    description: str


def build(settings: ForecastSettings) -> Setup:
    """Read what the settings name, and check that it can work.

    Raises
    ------
    jaxsky.io.InputError, SettingsError, KeyError, ValueError
        For files that are not what they should be, names that do not exist, multipoles that
        templates do not resolve, and a mask that leaves nothing.
    """
    instrument = _instrument(settings)
    shown = settings.spectra.bands or _few(instrument.names)
    with at_key("spectra.bands"):
        instrument.select(shown)
    templates, description = _templates(settings)
    fwhm = max(template.fwhm for template in templates.values())
    nside = min(healpy.npix2nside(template.used.size) for template in templates.values())
    _check_resolution(settings.spectra.lmax, nside, fwhm)
    used = _used(settings, nside)
    for template in templates.values():
        used &= degrade_mask(template.used, nside, 1.0)
    sky = Sky({name: _prepared(template, nside, fwhm) for name, template in templates.items()})
    mask = apodize(used, settings.mask.apodization)
    if not mask.any():
        raise SettingsError("mask: leaves no pixel.")
    return Setup(sky, fwhm, mask, instrument, tuple(shown), description)


def apodize(used: Bool[np.ndarray, " pix"], width: float) -> Float[np.ndarray, " pix"]:
    """A mask that rises from 0 at its edge to 1 with two continuous derivatives.

    With x^2 = (1 - cos d) / (1 - cos w) of the distance d to the edge and the width w, the weight
    is x - sin(2 pi x) / 2 pi, the C2 of Grain, Tristram & Stompor (2009).

    Parameters
    ----------
    used : True in used pixels, RING
    width : over which the mask rises [deg]; 0 leaves it as it is
    """
    if not width or used.all():
        return used.astype(float)
    distance = healpy.dist2holes(~used)  # 0 where not used
    x = np.minimum(np.sin(distance / 2) / np.sin(np.radians(width) / 2), 1.0)
    return np.where(distance > np.radians(width), 1.0, x - np.sin(2 * np.pi * x) / (2 * np.pi))


def _instrument(settings: ForecastSettings) -> Instrument:
    main = settings.experiment
    if main.instrument is not None:
        with at_key("experiment.instrument"):
            instrument = load_instrument(main.instrument)
        with at_key("experiment.channels"):
            return instrument if main.channels is None else instrument.select(main.channels)
    channels = []
    for i, band in enumerate(settings.bands):
        with at_key(f"bands.{i}"):
            channels.append(Channel(**band.model_dump()))
    return Instrument(settings.title or "bands of the settings", channels)


def _few(names: tuple[str, ...], most: int = 5) -> list[str]:
    """The names, or a few of them that are evenly spread."""
    at = np.linspace(0, len(names) - 1, min(most, len(names)))
    return [names[i] for i in at.round().astype(int)]


def _templates(settings: ForecastSettings) -> tuple[dict[str, Template], str]:
    if settings.embedded is None:
        templates = read_templates(Path(settings.data_dir), settings.templates)
        description = settings.title or "Templates from files."
    else:
        galaxy = embedded_sky(settings.embedded.nside, settings.embedded.seed)
        sky = galaxy.sky()
        used = np.ones(sky.shape[1], bool)
        templates = {name: Template(sky[name], 0.0, used) for name in sky}
        description = galaxy.description
    with at_key("fixed"):
        return set_parameters_of(templates, settings.fixed), description


def _check_resolution(lmax: int, nside: int, fwhm: float) -> None:
    if lmax > 2 * nside - 1:
        raise SettingsError(
            f"spectra.lmax: {lmax} is beyond what templates of nside {nside} resolve, "
            f"{2 * nside - 1}."
        )
    if (window := float(gaussian_beam(fwhm, lmax)[lmax])) < LEAST_WINDOW:
        raise SettingsError(
            f"spectra.lmax: the templates' beam of {fwhm:g} arcmin leaves {window:.2g} of the "
            f"amplitude at l = {lmax}; a correction takes {LEAST_WINDOW:g}."
        )


def _used(settings: ForecastSettings, nside: int) -> Bool[np.ndarray, " pix"]:
    mask: Mask = settings.mask
    if mask.file is None:
        assert mask.latitude is not None  # one of the two is given
        npix = healpy.nside2npix(nside)
        latitude = healpy.pix2ang(nside, np.arange(npix), lonlat=True)[1]
        return np.abs(latitude) > mask.latitude if mask.latitude else np.ones(npix, bool)
    path = find_file(Path(settings.data_dir), mask.file)
    found = read_mask(path, key=mask.key, ordering=mask.ordering)
    # A coarser mask holds for all pixels inside of its own.
    whole = found if found.size >= 12 * nside**2 else healpy.ud_grade(found.astype(float), nside)
    return degrade_mask(np.asarray(whole) > 0, nside)


def _prepared(template: Template, nside: int, fwhm: float):
    own = healpy.npix2nside(template.used.size)
    if own == nside and template.fwhm == fwhm:
        return template.component
    operator = Preparation.smoothing(own, template.fwhm, nside, fwhm, 2 * nside)
    return prepare_component(template.component, operator, template.used)
