"""What the settings of a separation name, brought into the domain in which it is separated."""

from pathlib import Path
from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.common import common_maps
from fits.fluctuations import uniform_level
from fits.inputs import Band, Inputs, inputs_of
from fits.mixing import NOMINAL
from fits.multipoles import harmonic_coefficients
from fits.noise import Noise, as_noise
from fits.regions import apodize, clusters, latitude_bands, region_mask, superpixels
from fits.separate.domains import Domain, HarmonicDomain, PixelDomain
from jaxsky import Component, Sky, set_parameters
from jaxsky.components import component_class
from jaxsky.harmonics import Preparation
from jaxsky.inputs import one_column, read, read_parameter
from jaxsky.settings import Experiment, MapFile, Regions, SettingsError, at_key

#: Noise that varies by less than this fraction from pixel to pixel is uniform: smoothed maps of
#: variances ring by 1e-7.
UNIFORM = 1e-6


class Setup(NamedTuple):
    """What is separated.

    Parameters
    ----------
    domain : how
    data : observed, as the domain takes it
    foregrounds : those of a simulation alone, likewise; None for real maps
    mask : weight of each pixel in spectra, 0 to 1, its edges smooth
    truth : parameters of a simulation that are numbers, "r" among them; None for real maps
    description : what the maps are
    """

    domain: Domain
    data: Float[np.ndarray, "band stokes _"]
    foregrounds: Float[np.ndarray, "band stokes _"] | None
    mask: Float[np.ndarray, " pix"]
    truth: dict[str, float] | None
    description: str


def build(settings: Experiment) -> Setup:
    """Read or simulate what the settings name, and check that it can work."""
    spec, common = settings.separate, settings.common
    if not settings.cmb.include:
        raise SettingsError("cmb.include: is false, but a separation has a CMB.")
    if not common.fwhm:
        raise SettingsError("common.fwhm: must be positive for a separation.")
    if not settings.free_in("separate"):
        raise SettingsError("free: name at least one parameter to fit.")
    if spec.domain == "harmonic":
        for name, parameter in settings.free_in("separate").items():
            if parameter.regions:
                raise SettingsError(
                    f"free.{name}: regions are those of pixels; the domain 'harmonic' takes one "
                    "value for the whole sky."
                )
    inside = region_mask(settings, spec.region, common.nside)
    if not inside.any():
        raise SettingsError("separate.region: leaves no pixel.")
    sky, known = _sky(settings)
    inside &= known
    if not inside.any():
        raise SettingsError("separate.region: leaves no pixel in which parameters are known.")
    inputs = inputs_of(settings, templates=False, foregrounds=True)
    foregrounds = None if inputs.foregrounds is None else list(inputs.foregrounds.values())
    if spec.domain == "pixel":
        domain, data, shown = _pixels(settings, sky, inputs, foregrounds, inside)
        used = domain.used
    else:
        domain, data, shown = _multipoles(settings, sky, inputs, foregrounds)
        used = inside
    mask = apodize(used, spec.apodization)
    if not mask.any():
        raise SettingsError("separate.region: leaves no pixel.")
    truth = inputs.truth
    if truth is not None:  # bands are simulated as they are described
        words = {name: name.split(".")[0] for name in settings.free_in("separate")}
        truth |= {name: NOMINAL[word] for name, word in words.items() if word in NOMINAL}
    return Setup(domain, data, shown, mask, truth, inputs.description)


def _sky(settings: Experiment) -> tuple[Sky, Bool[np.ndarray, " pix"]]:
    """The laws, on one pixel, or on all if parameters are maps; and where these are known."""
    folder, nside = Path(settings.data_dir), settings.common.nside
    laws = {name: settings.sky.components[name] for name in settings.modelled()}
    given = laws.values()
    maps = any(isinstance(value, MapFile) for c in given for value in c.parameters.values())
    amplitude = jnp.ones((2, 12 * nside**2 if maps else 1))
    components: dict[str, Component] = {"cmb": component_class("cmb")(amplitude)}
    known = np.ones(12 * nside**2, bool)
    for name, spec in laws.items():
        numbers: dict = {} if spec.nu_ref is None else {"nu_ref": spec.nu_ref}
        for key, value in spec.parameters.items():
            if isinstance(value, MapFile):
                place = f"sky.{name}.parameters.{key}"
                column, has = read_parameter(folder, value, key, nside, place, "common.nside")
                numbers[key], known = jnp.asarray(column), known & has
            else:
                numbers[key] = tuple(value) if isinstance(value, list) else value
        with at_key(f"sky.{name}"):
            assert spec.law is not None  # as the settings see to
            components[name] = component_class(spec.law)(amplitude, **numbers)
    fixed = {n: v for n, v in settings.fixed.items() if n.split(".")[0] not in _others(settings)}
    with at_key("fixed"):
        return set_parameters(Sky(components), fixed), known


def _others(settings: Experiment) -> set[str]:
    """Components that are not modelled."""
    return set(settings.sky.components) - set(settings.modelled())


def _map(
    folder: Path, spec: MapFile, nside: int, where: str, used: Bool[np.ndarray, " pix"]
) -> Float[np.ndarray, " pix"]:
    """A map of one column at the resolution of the separation, with values where it is used."""
    found = read(folder, spec, stokes="", zeros_are_data=True)
    values = one_column(found, nside, where, "common.nside")
    if empty := int(np.sum(used & ~np.asarray(found.mask))):
        raise SettingsError(f"{where}: {empty} of {used.sum()} used pixels have no value.")
    return values


def _labels(settings: Experiment, used: Bool[np.ndarray, " pix"]) -> dict[str, np.ndarray]:
    """Regions of the free parameters that have them."""
    labels = {}
    for name, parameter in settings.free_in("separate").items():
        if parameter.regions is None:
            continue
        with at_key(f"free.{name}.regions"):
            labels[name] = _regions(settings, parameter.regions, used, f"free.{name}.regions")
    return labels


def _regions(
    settings: Experiment, regions: Regions, used: Bool[np.ndarray, " pix"], where: str
) -> np.ndarray:
    folder, nside = Path(settings.data_dir), settings.common.nside
    if regions.nside is not None:
        return superpixels(nside, regions.nside)
    if regions.latitudes is not None:
        return latitude_bands(nside, regions.latitudes)
    if regions.file is not None:
        values = _map(folder, regions.file, nside, f"{where}.file", used)
        if not np.array_equal(values[used], np.round(values[used])):
            raise SettingsError(f"{where}.file: labels must be whole numbers.")
        return np.where(used, values, 0).astype(int)
    assert regions.clusters is not None  # one of them is given
    # Without maps, pixels are alike that lie close together.
    rows = [_map(folder, spec, nside, f"{where}.of", used) for spec in regions.of]
    maps = np.stack(rows) if rows else np.stack(healpy.pix2vec(nside, np.arange(used.size)))
    return clusters(np.where(used, maps, np.nan), regions.clusters, seed=settings.seed)


def _factors(settings: Experiment, inputs: Inputs) -> Float[np.ndarray, " band"]:
    """Units of the data per uK_RJ."""
    unit = settings.separate.unit
    return np.array([float(b.bandpass.conversion("uK_RJ", unit)) for b in inputs.bands.values()])


def _pixels(settings, sky, inputs, foregrounds, inside):
    common = settings.common
    with at_key("common"):
        prepared = common_maps(inputs, common.nside, common.fwhm)
    used = prepared.used & inside
    if not used.any():
        raise SettingsError("separate.region: leaves no pixel.")
    factors = _factors(settings, inputs)
    sigma = np.asarray(prepared.sigma) * factors[:, None, None]
    domain = PixelDomain(
        sky,
        prepared.bands,
        settings.start("separate"),
        _labels(settings, used),
        settings.separate.unit,
        _noise(sigma, used),
        used,
        prepared.fluctuations,
        factors,
    )

    def scaled(maps):
        return np.where(used, np.asarray(maps) * factors[:, None, None], 0.0)

    shown = None
    if foregrounds is not None:
        operators: tuple[Preparation, ...] = prepared.fluctuations.preparations
        pairs = zip(operators, foregrounds, strict=True)
        shown = scaled(jnp.stack([operator(maps) for operator, maps in pairs]))
    return domain, scaled(prepared.data), shown


def _noise(sigma: Float[np.ndarray, "band stokes pix"], used: np.ndarray) -> Noise:
    """Noise of the pixels that are used; separable if it is uniform but for rounding."""
    values = sigma[..., used]
    middle = values.mean(axis=-1)
    if np.all(np.abs(values / middle[..., None] - 1) < UNIFORM):
        mask = np.where(used, 1.0, np.inf)
        return as_noise(middle, sigma.shape, mask)
    return as_noise(np.where(used, sigma, np.inf), sigma.shape)


def _multipoles(settings, sky, inputs, foregrounds):
    common, factors = settings.common, _factors(settings, inputs)
    for name, band in inputs.bands.items():
        if missing := int(np.sum(~np.asarray(band.used))):
            raise SettingsError(
                f"bands.{name}: {missing} pixels have no value; the domain 'harmonic' takes maps "
                "of the full sky."
            )
    lmax = 2 * min(common.nside, *(_nside(band) for band in inputs.bands.values()))
    covariance = tuple(
        jnp.asarray(band.noise) * f**2
        for band, f in zip(inputs.bands.values(), factors, strict=True)
    )
    correlated = np.zeros((len(covariance), lmax + 1))
    spectra = []
    for rest, band, matrix, factor in zip(
        correlated, inputs.bands.values(), covariance, factors, strict=True
    ):
        if band.correlated is not None:
            rest[:] = band.correlated[: lmax + 1] * factor**2
        white = float(jnp.diagonal(matrix).mean()) * healpy.nside2pixarea(_nside(band))
        spectra.append(np.broadcast_to(white + rest, (2, lmax + 1)))

    def coefficients(maps):
        scaled = [np.asarray(m) * f for m, f in zip(maps, factors, strict=True)]
        return harmonic_coefficients(scaled, lmax)

    domain = HarmonicDomain(
        sky,
        {name: band.bandpass for name, band in inputs.bands.items()},
        settings.start("separate"),
        settings.separate.unit,
        _fwhms(inputs),
        np.stack(spectra),
        covariance,
        tuple(map(uniform_level, covariance)),
        correlated,
        lmax,
        common.nside,
        common.fwhm,
    )
    data = coefficients([_less_leakage(band) for band in inputs.bands.values()])
    return domain, data, None if foregrounds is None else coefficients(foregrounds)


def _fwhms(inputs: Inputs) -> Float[np.ndarray, " band"]:
    for name, band in inputs.bands.items():
        if np.ndim(band.beam):
            raise SettingsError(
                f"bands.{name}.beam: is a table; the domain 'harmonic' takes Gaussian beams, fwhm."
            )
    return np.array([float(band.beam) for band in inputs.bands.values()])


def _nside(band: Band) -> int:
    return healpy.npix2nside(band.maps.shape[-1])


def _less_leakage(band: Band) -> Array:
    if band.leakage is None:
        return band.maps
    raise SettingsError(
        "bands.leakage: has a beam of its own and is subtracted at a common resolution only; "
        "choose the domain 'pixel'."
    )
