"""What the settings of a separation name, brought into the domain in which it is separated."""

from pathlib import Path
from typing import NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits import settings as analysis_settings
from fits.covariance import uniform_level
from fits.forecast.setup import apodize
from fits.inputs import Band, Inputs, embedded_inputs, read_band
from fits.preparation import Preparation
from fits.resolution import prepare
from fits.separate.domains import Domain, HarmonicDomain, PixelDomain
from fits.separate.settings import Regions, SeparateSettings
from fits.separation.harmonic import harmonic_coefficients
from fits.separation.mixing import NOMINAL
from fits.separation.noise import Noise, as_noise
from fits.separation.regions import clusters, latitude_bands, superpixels
from jaxsky import Component, Sky, get_parameters, observe, parameter_names, set_parameters
from jaxsky.components import component_class
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import gaussian_beam, resample
from jaxsky.inputs import mask_at, read, read_parameter
from jaxsky.instrument import load_instrument
from jaxsky.io import read_mask
from jaxsky.lookup import find_file
from jaxsky.parameter_maps import one_column
from jaxsky.settings import MapFile, SettingsError
from jaxsky.settings_keys import at_key

__all__ = ["Setup", "build"]

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
    truth : values of the free parameters in a simulation, by name
    r : that of the simulation
    description : what the maps are
    """

    domain: Domain
    data: Float[np.ndarray, "band stokes _"]
    foregrounds: Float[np.ndarray, "band stokes _"] | None
    mask: Float[np.ndarray, " pix"]
    truth: dict[str, float] | None
    r: float | None
    description: str


def build(settings: SeparateSettings) -> Setup:
    """Read or simulate what the settings name, and check that it can work.

    Raises
    ------
    jaxsky.io.InputError, SettingsError, KeyError, ValueError
        For files that are not what they should be, names that do not exist, maps that are coarser
        than the common resolution, and a mask that leaves nothing.
    """
    main, folder = settings.separation, Path(settings.data_dir)
    inside = _inside(settings)
    sky, known = _sky(settings)
    inside &= known
    if not inside.any():
        raise SettingsError("separation.mask: leaves no pixel in which parameters are known.")
    if settings.embedded is not None:
        inputs, foregrounds = _observed(settings)
    else:
        bands = {spec.name: read_band(folder, spec) for spec in settings.bands}
        inputs, foregrounds = Inputs({}, bands, None, None, settings.title), None
    if main.domain == "pixel":
        domain, data, shown = _pixels(settings, sky, inputs, foregrounds, inside)
        used = domain.used
    else:
        domain, data, shown = _multipoles(settings, sky, inputs, foregrounds)
        used = inside
    mask = apodize(used, settings.tensors.apodization)
    if not mask.any():
        raise SettingsError("separation.mask: leaves no pixel.")
    truth = None if settings.embedded is None else inputs.truth
    r = None if settings.embedded is None else settings.embedded.r
    return Setup(domain, data, shown, mask, truth, r, inputs.description)


def _inside(settings: SeparateSettings) -> Bool[np.ndarray, " pix"]:
    """Pixels that the settings leave."""
    main = settings.separation
    latitude = healpy.pix2ang(main.nside, np.arange(12 * main.nside**2), lonlat=True)[1]
    inside = np.abs(latitude) > main.latitude if main.latitude else np.ones(latitude.size, bool)
    if main.mask is not None:
        path = find_file(Path(settings.data_dir), main.mask.file)
        found = read_mask(path, key=main.mask.key, ordering=main.mask.ordering)
        inside &= mask_at(found, main.nside, "separation.mask")
    if not inside.any():
        raise SettingsError("separation.mask: leaves no pixel.")
    return inside


def _sky(settings: SeparateSettings) -> tuple[Sky, Bool[np.ndarray, " pix"]]:
    """The laws, on one pixel, or on all if parameters are maps; and where these are known."""
    folder, nside = Path(settings.data_dir), settings.separation.nside
    given = settings.components.values()
    maps = any(isinstance(value, MapFile) for c in given for value in c.parameters.values())
    amplitude = jnp.ones((2, 12 * nside**2 if maps else 1))
    components: dict[str, Component] = {}
    known = np.ones(12 * nside**2, bool)
    for name, spec in settings.components.items():
        numbers: dict = {} if spec.nu_ref is None else {"nu_ref": spec.nu_ref}
        for key, value in spec.parameters.items():
            if isinstance(value, MapFile):
                place = f"components.{name}.parameters.{key}"
                column, has = read_parameter(folder, value, key, nside, place, "separation.nside")
                numbers[key], known = jnp.asarray(column), known & has
            else:
                numbers[key] = tuple(value) if isinstance(value, list) else value
        with at_key(f"components.{name}"):
            components[name] = component_class(spec.law)(amplitude, **numbers)
    return Sky(components), known


def _map(
    folder: Path, spec: MapFile, nside: int, where: str, used: Bool[np.ndarray, " pix"]
) -> Float[np.ndarray, " pix"]:
    """A map of one column at the resolution of the separation, with values where it is used."""
    found = read(folder, spec, stokes="", zeros_are_data=True)
    values = one_column(found, nside, where, "separation.nside")
    if empty := int(np.sum(used & ~np.asarray(found.mask))):
        raise SettingsError(f"{where}: {empty} of {used.sum()} used pixels have no value.")
    return values


def _labels(settings: SeparateSettings, used: Bool[np.ndarray, " pix"]) -> dict[str, np.ndarray]:
    """Regions of the free parameters that have them."""
    labels = {}
    for name, parameter in settings.free.items():
        if parameter.regions is None:
            continue
        with at_key(f"free.{name}.regions"):
            labels[name] = _regions(settings, parameter.regions, used, f"free.{name}.regions")
    return labels


def _regions(
    settings: SeparateSettings, regions: Regions, used: Bool[np.ndarray, " pix"], where: str
) -> np.ndarray:
    folder, nside = Path(settings.data_dir), settings.separation.nside
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
    return clusters(np.where(used, maps, np.nan), regions.clusters, seed=settings.separation.seed)


def _observed(settings: SeparateSettings) -> tuple[Inputs, list[Array]]:
    """The embedded sky in all bands, and its foregrounds alone [uK_RJ]."""
    embedded, main = settings.embedded, settings.separation
    assert embedded is not None  # as called
    with at_key("embedded.instrument"):
        instrument = load_instrument(embedded.instrument)
    if embedded.channels is not None:
        with at_key("embedded.channels"):
            instrument = instrument.select(embedded.channels)
    galaxy = embedded_sky(embedded.nside)
    with at_key("embedded.truth"):
        sky = set_parameters(galaxy.sky("QU"), embedded.truth)
    inputs = embedded_inputs(
        analysis_settings.Settings(
            embedded=analysis_settings.Embedded(
                channels={embedded.instrument: list(instrument.names)}, nside=embedded.nside
            ),
            analysis=analysis_settings.Analysis(seed=main.seed),
            fixed=embedded.truth,
            cmb=analysis_settings.CMBSettings(r=embedded.r),
        ),
        galaxy,
    )
    seen = observe(sky, [band.bandpass for band in inputs.bands.values()])
    foregrounds = [
        resample(maps, gaussian_beam(band.fwhm, 2 * embedded.nside), embedded.nside)
        for maps, band in zip(seen, inputs.bands.values(), strict=True)
    ]
    return inputs._replace(truth=_truth(settings, sky)), foregrounds


def _truth(settings: SeparateSettings, sky: Sky) -> dict[str, float]:
    """What the free parameters are in the simulated sky."""
    known = parameter_names(sky)
    laws = get_parameters(sky, [name for name in settings.free if name in known])
    bands = {n: NOMINAL[n.split(".")[0]] for n in settings.free if n.split(".")[0] in NOMINAL}
    return {name: float(value) for name, value in laws.items()} | bands


def _factors(settings: SeparateSettings, inputs: Inputs) -> Float[np.ndarray, " band"]:
    """Units of the data per uK_RJ."""
    unit = settings.separation.unit
    return np.array([float(b.bandpass.conversion("uK_RJ", unit)) for b in inputs.bands.values()])


def _pixels(settings, sky, inputs, foregrounds, inside):
    main = settings.separation
    with at_key("separation"):
        prepared = prepare(inputs, main.nside, main.fwhm)
    used = prepared.used & inside
    if not used.any():
        raise SettingsError("separation.mask: leaves no pixel.")
    factors = _factors(settings, inputs)
    sigma = np.asarray(prepared.sigma) * factors[:, None, None]
    domain = PixelDomain(
        sky,
        prepared.bands,
        settings.start(),
        _labels(settings, used),
        main.unit,
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
    main, factors = settings.separation, _factors(settings, inputs)
    for name, band in inputs.bands.items():
        if missing := int(np.sum(~np.asarray(band.used))):
            raise SettingsError(
                f"bands.{name}: {missing} pixels have no value; the domain 'harmonic' takes maps "
                "of the full sky."
            )
    lmax = 2 * min(main.nside, *(_nside(band) for band in inputs.bands.values()))
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
        settings.start(),
        main.unit,
        np.array([band.fwhm for band in inputs.bands.values()]),
        np.stack(spectra),
        covariance,
        tuple(map(uniform_level, covariance)),
        correlated,
        lmax,
        main.nside,
        main.fwhm,
    )
    data = coefficients([_less_leakage(band) for band in inputs.bands.values()])
    return domain, data, None if foregrounds is None else coefficients(foregrounds)


def _nside(band: Band) -> int:
    return healpy.npix2nside(band.maps.shape[-1])


def _less_leakage(band: Band) -> Array:
    if band.leakage is None:
        return band.maps
    raise SettingsError(
        "bands.leakage: has a beam of its own and is subtracted at a common resolution only; "
        "choose the domain 'pixel'."
    )
