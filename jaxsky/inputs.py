"""What settings name, read: maps, templates with their laws, bandpasses, noise."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxsky.bandpass import Bandpass
from jaxsky.components import AME, Component, Dust, Synchrotron
from jaxsky.io import Maps, degrade_mask, read_bandpass, read_maps, unit_factor
from jaxsky.io.columns import stokes as stokes_of
from jaxsky.lookup import find_file
from jaxsky.noise import (
    check_covariance,
    covariance_from_columns,
    hits_covariance,
    rms_covariance,
    weights_covariance,
)
from jaxsky.parameter_maps import parameter_map
from jaxsky.parameters import set_parameters
from jaxsky.settings import (
    BandpassSpec,
    Hits,
    MapFile,
    NoiseColumns,
    NoiseFile,
    SettingsError,
    TemplateFile,
)
from jaxsky.settings_keys import at_key
from jaxsky.sky import Sky

__all__ = [
    "LAWS",
    "Template",
    "check_stokes",
    "mask_at",
    "narrow",
    "read",
    "read_bandpass_spec",
    "read_noise",
    "read_parameter",
    "read_templates",
    "set_parameters_of",
    "uK_RJ_per",
]

#: Maps with at least so many pixels are kept in single precision, which is that of their files.
LARGE = 12 * 512**2
#: Noise outside of this range, relative to the rms of its map, is a mistake unless it is meant.
PLAUSIBLE = (1e-6, 10.0)

LAWS: dict[str, type[Component]] = {"dust": Dust, "synchrotron": Synchrotron, "ame": AME}


class Template(NamedTuple):
    """A component at the resolution of its map; `unit` is that of the map's file."""

    component: Component
    fwhm: float
    used: Bool[np.ndarray, " pix"]
    unit: str = "uK_RJ"


def read(
    folder: Path,
    spec: MapFile,
    *,
    stokes: str | Sequence[str] | None = None,
    zeros_are_data: bool = False,
) -> Maps:
    """The maps of a file; see `jaxsky.io.read_maps`.

    Parameters
    ----------
    folder : of the files
    spec : what the settings say
    stokes : Stokes parameters of the columns where the use of the file tells them, in place of
        those in the settings
    zeros_are_data : see `jaxsky.io.read_maps`
    """
    return read_maps(
        [find_file(folder, name) for name in spec.files],
        fields=spec.fields,
        hdu=spec.hdu,
        unit=spec.unit,
        ordering=spec.ordering,
        coordinates=spec.coordinates,
        polarization=spec.polarization,
        stokes=spec.stokes if stokes is None else stokes,
        missing=spec.missing,
        zeros_are_data=zeros_are_data,
    )


def read_parameter(
    folder: Path,
    spec: MapFile,
    name: str,
    nside: int,
    where: str,
    of: str = "that of the template",
) -> tuple[Float[np.ndarray, " pix"], Bool[np.ndarray, " pix"]]:
    """The map of a spectral parameter and where it is known; see `jaxsky.parameter_maps`.

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be.
    """
    found = read(folder, spec, stokes="", zeros_are_data=True)
    return parameter_map(found, name, nside, where, of=of, stated=spec.missing is not None)


def narrow(values: ArrayLike) -> Array:
    """Values as an array, of a large map in single precision."""
    values = np.asarray(values)
    large = values.ndim and values.shape[-1] >= LARGE
    return jnp.asarray(values, jnp.float32 if large else float)


def read_templates(
    folder: Path,
    specs: Mapping[str, TemplateFile],
    stokes: str = "QU",
    dtype: type[np.floating] = np.float64,
) -> dict[str, Template]:
    """Templates with their laws [uK_RJ], by name; those with angles of others come last.

    Parameters
    ----------
    folder : of the files
    specs : by name; their angles are those of each other (`jaxsky.settings.check_angles`)
    stokes : "QU" for the last two columns of each file, "IQU" for the last three
    dtype : of the templates; parameters that are maps are always in double precision

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be.
    """
    templates: dict[str, Template] = {}
    for name, spec in sorted(specs.items(), key=lambda item: item[1].angles is not None):
        templates[name] = _read_template(folder, name, spec, templates, stokes, dtype)
    return templates


def _read_template(
    folder: Path,
    name: str,
    spec: TemplateFile,
    others: dict[str, Template],
    stokes: str,
    dtype: type[np.floating],
) -> Template:
    found = read(folder, spec)
    check_stokes(f"templates.{name}", found, "I" if spec.angles else stokes)
    factor = uK_RJ_per(found.unit, spec.nu_ref, f"templates.{name}")
    maps = jnp.asarray((found.maps * factor).astype(dtype))
    used = np.asarray(found.mask)
    parameters: dict[str, Any] = {"nu_ref": spec.nu_ref}
    for key, value in spec.parameters.items():
        if isinstance(value, MapFile):
            place = f"templates.{name}.parameters.{key}"
            column, known = read_parameter(folder, value, key, found.nside, place)
            parameters[key], used = jnp.asarray(column), used & known
        else:
            parameters[key] = tuple(value) if isinstance(value, list) else value
    with at_key(f"templates.{name}"):
        if spec.angles:
            if len(maps) != 1:
                raise ValueError(f"fields must name one intensity map, not {len(maps)} maps")
            component: Component = AME.from_dust_angles(
                maps[0], others[spec.angles].component.amplitude, **parameters
            )
        else:
            component = LAWS[spec.law](maps[-len(stokes) :], **parameters)
    return Template(component, spec.fwhm, used, found.unit)


def set_parameters_of(
    templates: Mapping[str, Template], fixed: Mapping[str, float]
) -> dict[str, Template]:
    """Templates with some of their parameters set, by dotted name.

    Raises
    ------
    SettingsError, KeyError
        For a template or a parameter that does not exist.
    """
    by_template: dict[str, dict[str, float]] = {}
    for name, value in fixed.items():
        by_template.setdefault(name.split(".")[0], {})[name] = value
    changed = dict(templates)
    for name, values in by_template.items():
        if name not in templates:
            raise SettingsError(
                f"fixed: there is no template {name!r}; templates are {', '.join(templates)}."
            )
        component = set_parameters(Sky({name: templates[name].component}), values)[name]
        changed[name] = templates[name]._replace(component=component)
    return changed


def mask_at(mask: Bool[np.ndarray, " pix"], nside: int, where: str) -> Bool[np.ndarray, " pix"]:
    """A mask at the resolution at which it is used; see `jaxsky.io.degrade_mask`.

    Raises
    ------
    SettingsError
        If it is coarser, or has an nside that is no power of two; `where` is its key.
    """
    with at_key(where):
        return np.asarray(degrade_mask(mask, nside))


def uK_RJ_per(unit: str, at: Bandpass | float, where: str) -> float:
    """What a map is multiplied by to be in uK_RJ, at a frequency [GHz] or over a band.

    Raises
    ------
    SettingsError
        If the unit is none of a brightness; `where` is the table of the map in the settings.
    """
    with at_key(f"{where}.unit"):
        return float(unit_factor(unit, "uK_RJ", at))


def check_stokes(where: str, found: Maps, wanted: str) -> None:
    """Refuse other Stokes parameters than wanted, Q and U of all three aside, or another number."""
    listed = " and ".join(filter(None, (", ".join(wanted[:-1]), wanted[-1])))
    names, expected = ", ".join(found.names), "IQU" if len(found.names) == 3 else wanted
    if len(found.names) != len(expected) or not expected.endswith(wanted):
        raise SettingsError(f"{where}: fields must name {listed}, not {names}.")
    if any(s not in (None, w) for s, w in zip(found.stokes, expected, strict=True)):
        raise SettingsError(f"{where}.fields: {names} are not {listed} by their names.")


def read_bandpass_spec(folder: Path, spec: BandpassSpec) -> Bandpass:
    """The bandpass of a file, or a top-hat."""
    if spec.file is not None:
        return read_bandpass(
            find_file(folder, spec.file),
            spec.band,
            detectors=spec.detectors,
            convention=spec.convention,
            unit=spec.unit,
            fields=spec.fields,
        )
    assert spec.center is not None  # one of file and center is given
    if not spec.width:
        return Bandpass.delta(spec.center)
    return Bandpass.top_hat(spec.center, spec.width, spec.convention or "RJ")


def read_noise(
    folder: Path,
    noise: NoiseFile,
    at: Bandpass | float,
    nside: int,
    stokes: str = "QU",
    *,
    where: str,
    unit: str,
    own: MapFile | None = None,
    maps: Float[Array, "stokes pix"] | None = None,
    used: Bool[np.ndarray, " pix"] | None = None,
) -> tuple[Float[Array, "stokes stokes pix"], Bool[np.ndarray, " pix"]]:
    """Covariance of each pixel [uK_RJ^2], and where it is known; 0 elsewhere.

    Parameters
    ----------
    folder : of the files
    noise : what the settings say; pixels without hits are not known
    at : bandpass of the map, or its frequency [GHz]
    nside : resolution of the map
    stokes : "QU" or "IQU"
    where : key of the noise in the settings, for the messages
    unit : unit of the map, and so of rms and sigma0
    own : the map that has the noise, if its columns are in the same file
    maps, used : the map that has the noise [uK_RJ] and its pixels, against whose rms it is checked

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be, another nside, noise that is not
        positive definite, and noise far from the rms of the map.
    """
    with at_key(where):
        covariance, known = _covariance(folder, noise, at, nside, stokes, where, unit, own)
        check_covariance("noise", covariance if known.all() else covariance[..., known])
    if maps is not None and not noise.plausible:
        factor = float(unit_factor(unit, "uK_RJ", at))
        inside = known if used is None else known & used
        _check_plausible(where, covariance, maps, inside, factor, unit)
    return covariance if known.all() else jnp.where(known, covariance, 0.0), known


def _check_plausible(where, covariance, maps, inside, factor, unit):
    """Refuse noise of a Stokes parameter that is far from the rms of the map."""
    if not inside.any():
        return
    rms = np.sqrt(np.mean(np.square(np.asarray(maps)[:, inside], dtype=float)))
    for s in range(len(covariance)):
        own = np.sqrt(np.mean(np.asarray(covariance[s, s])[inside], dtype=float))
        low, high = (limit * rms for limit in PLAUSIBLE)
        if rms and not low <= own <= high:
            raise SettingsError(
                f"{where}: the noise of a pixel is {own / factor:.3g} {unit} (rms), but the rms of "
                f"the map in the same pixels is {rms / factor:.3g} {unit}; noise is in the map's "
                'unit where it has none of its own. Write "plausible = true" if this is meant.'
            )


def _covariance(folder, noise, at, nside, stokes, where, unit, own):
    """See `read_noise`; with any values where the covariance is not known."""
    n, npix = len(stokes), 12 * nside**2
    if noise.rms is not None:
        rms = noise.rms * unit_factor(unit, "uK_RJ", at)
        return rms_covariance(narrow(np.full((n, npix), rms))), np.ones(npix, bool)
    kinds = ("map", "covariance", "hits", "weights")
    kind = next(k for k in kinds if getattr(noise, k) is not None)
    spec, where = getattr(noise, kind), f"{where}.{kind}"
    found = _read_columns(folder, _file(spec, own, where), kind, where)
    if found.nside != nside:
        raise SettingsError(f"{where}: nside is {found.nside}, but that of the map is {nside}.")
    given, known = found.unit, np.asarray(found.mask)
    maps = narrow(found.maps)
    del found  # as large as all else
    if kind == "map":
        _check_number(f"{where}.fields", len(maps), stokes)
        rms = maps[-n:] * float(unit_factor(given, "uK_RJ", at))
        return rms_covariance(jnp.broadcast_to(rms, (n, npix))), known
    if kind == "covariance":
        if len(maps) == 3 and n == 3:
            raise SettingsError(f"{where}: I, Q and U need six columns, II, IQ, IU, QQ, QU, UU.")
        columns = maps * float(unit_factor(given, "uK_RJ^2", at))
        return covariance_from_columns(columns)[-n:, -n:], known
    if given:
        raise SettingsError(f"{where}.unit: {kind} are pure numbers, but are said to be {given}.")
    _check_number(f"{where}.sigma0", len(spec.sigma0), stokes)
    factor = float(unit_factor(spec.sigma0_unit or unit, "uK_RJ", at))
    sigma0 = jnp.array(spec.sigma0, maps.dtype)[-n:] * factor
    if kind == "weights":
        if n != 2:
            raise SettingsError(f"{where}: weights are those of Q and U, not of {stokes}.")
        known = known & np.asarray(maps[0] * maps[2] > 0)
        nothing = jnp.array([1.0, 0.0, 1.0], maps.dtype)[:, None]
        weights = jnp.where(known, maps, nothing)
        return weights_covariance(jnp.broadcast_to(sigma0, (n,)), weights), known
    known = known & np.asarray(maps[0] != 0)
    hits = jnp.where(known, maps[0], 1.0)
    return hits_covariance(jnp.broadcast_to(sigma0, (n,)), hits, n), known


def _read_columns(folder: Path, spec: MapFile, kind: str, where: str) -> Maps:
    """Columns about the noise, with the Stokes parameters that their place in the settings says."""
    tables = max(len(spec.files), len(spec.hdu) if isinstance(spec.hdu, list) else 1)
    number = max(tables, len(spec.fields or []))
    if kind == "map" and spec.fields is None and tables == 1:
        number = len(read(folder, spec).names)
    pairs: dict[str, dict[int, tuple[str, ...]]] = {
        "map": {1: (), 2: ("QQ", "UU"), 3: ("II", "QQ", "UU")},
        "covariance": {3: ("QQ", "QU", "UU"), 6: ("II", "IQ", "IU", "QQ", "QU", "UU")},
        "weights": {3: ("QQ", "QU", "UU")},
    }
    wanted = pairs.get(kind, {}).get(number, ())
    fields = spec.fields or []
    said = [stokes_of(name) if isinstance(name, str) else None for name in fields]
    if any(s is not None and w not in (s, s * 2) for s, w in zip(said, wanted, strict=False)):
        listed = ", ".join(w[0] if kind == "map" else w for w in wanted)
        raise SettingsError(
            f"{where}.fields: {', '.join(map(str, fields))} are not {listed} by their names."
        )
    return read(folder, spec, stokes=wanted or "")


def _file(spec: MapFile | NoiseColumns, own: MapFile | None, where: str) -> MapFile:
    """The columns to read; those without a file are in that of the map."""
    said = spec.model_dump(include=set(MapFile.model_fields), exclude_none=True)
    if isinstance(spec, Hits):
        said.setdefault("unit", "")  # a number, whatever the header calls it
    if "file" not in said:
        if own is None:
            raise SettingsError(f"{where}: file is missing.")
        if len(own.files) > 1 or (isinstance(own.hdu, list) and "hdu" not in said):
            raise SettingsError(f"{where}: the map has several files or HDUs; give file and hdu.")
        taken = set(MapFile.model_fields) - {"fields", "unit", "stokes", "missing"}
        said = own.model_dump(include=taken, exclude_none=True) | said
    return MapFile(**said)


def _check_number(where: str, number: int, stokes: str) -> None:
    """Refuse other numbers than one for all, one for each, or one for I, too."""
    if number not in (1, len(stokes), 3):
        raise SettingsError(f"{where}: one or {len(stokes)} are needed, not {number}.")
