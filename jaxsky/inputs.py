"""Read what the settings name: templates with their laws and parameters, bandpasses and beams."""

import dataclasses
import hashlib
import inspect
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxsky import galaxy as model_galaxy
from jaxsky.arrays import stokes_rows
from jaxsky.bandpass import Bandpass
from jaxsky.checks import listed
from jaxsky.components import AME, Component, check_law, component_class, parameter_declaration
from jaxsky.galaxy import EmbeddedSky, GalaxyModel, embedded_sky
from jaxsky.io import Maps, read_bandpass, read_beam, read_maps, unit_factor
from jaxsky.io.columns import sentinels
from jaxsky.io.curves import read_text
from jaxsky.io.files import kept
from jaxsky.io.stacks import stored
from jaxsky.settings import (
    BandTable,
    ComponentTable,
    Experiment,
    MapFile,
    MapKeys,
    SettingsError,
    at_key,
    check_signs,
    find_file,
)
from jaxsky.sky import Sky, set_parameters


def parameter_map(
    found: Maps,
    name: str,
    nside: int,
    where: str,
    *,
    of: str = "that of the template",
    stated: bool = False,
) -> tuple[Float[np.ndarray, " pix"], Bool[np.ndarray, " pix"]]:
    """Return the map of a spectral parameter in its unit, median-filled, and where it is known.

    `of` says whose nside it must have; if missing values were `stated`, zeros count as data.
    """
    values, used = one_column(found, nside, where, of), np.asarray(found.mask)
    declared = parameter_declaration(name)
    unit = declared.get("unit", "")
    try:
        values = values * unit_factor(found.unit, unit)
    except ValueError:
        raise SettingsError(
            f"{where}: {name} is {f'in {unit}' if unit else 'a pure number'}, but column "
            f"{found.names[0]} is in {found.unit or 'no unit'}."
        ) from None
    known = values[used]
    if marks := [] if stated or declared.get("zero", True) else sentinels(known, zero=True):
        raise SettingsError(
            f"{where}: column {found.names[0]} is {marks[0][0]:g} in {marks[0][1]} pixels, far "
            "from its other values; give `missing`, the numbers that mark pixels without a value, "
            "or `missing = []` if all are data."
        )
    middle = np.median(known)
    with at_key(where):
        check_signs({name: float(middle)})
    return np.where(used, values, middle), used


def one_column(found: Maps, nside: int, where: str, of: str) -> Float[np.ndarray, " pix"]:
    """Return the only column that was read, after checking its resolution."""
    if len(found.maps) != 1:
        raise SettingsError(f"{where}: fields must name one column, not {', '.join(found.names)}.")
    if found.nside != nside:
        raise SettingsError(f"{where}: nside is {found.nside}, but {of} is {nside}.")
    return np.asarray(found.maps[0])


#: Maps with at least this many pixels are kept in single precision, as in their files.
LARGE = 12 * 512**2
#: Largest nside at which the embedded model is cached: 38 MB of maps.
KEPT_NSIDE = 256


class Template(NamedTuple):
    """A component at the resolution of its map, where it is known, and the unit in the file."""

    component: Component
    fwhm: float
    used: Bool[np.ndarray, " pix"]
    unit: str = "uK_RJ"


def of_many(tree: Any, number: int) -> Any:
    """Return templates or maps with their rows of pixels on disk if so many would be large."""
    return jax.tree.map(lambda leaf: stored(leaf, number) if np.ndim(leaf) > 1 else leaf, tree)


def read(
    folder: Path,
    spec: MapKeys,
    *,
    stokes: str | Sequence[str] | None = None,
    zeros_are_data: bool = False,
) -> Maps:
    """Read the maps of a table of settings; `stokes` overrides its Stokes parameters."""
    options = spec.model_dump(include={*MapKeys.model_fields} - {"file"}, exclude_none=True)
    if stokes is not None:
        options["stokes"] = stokes
    paths = [find_file(folder, name) for name in spec.files]
    return read_maps(paths, zeros_are_data=zeros_are_data, **options)


def read_parameters(
    folder: Path,
    name: str,
    spec: ComponentTable,
    nside: int,
    of: str = "that of the template",
    stokes: str = "QU",
) -> tuple[dict[str, Any], Bool[np.ndarray, " pix"]]:
    """Read the parameters of a component's law: numbers, maps, tables; and where maps are known."""
    parameters: dict[str, Any] = {}
    if spec.nu_ref is not None:
        parameters["nu_ref"] = spec.reference(stokes[-1])
        if spec.reference(stokes[0]) != parameters["nu_ref"]:
            parameters["nu_ref_I"] = spec.reference(stokes[0])
    used = np.ones(healpy.nside2npix(nside), bool)
    for key, value in spec.parameters.items():
        if not isinstance(value, MapFile):
            parameters[key] = tuple(value) if isinstance(value, list) else value
    for key, value in spec.maps.items():
        place, stated = f"sky.{name}.parameters.{key}", value.missing is not None
        found = read(folder, value, stokes="", zeros_are_data=True)
        column, known = parameter_map(found, key, nside, place, of=of, stated=stated)
        parameters[key], used = jnp.asarray(column), used & known
    for key, value in spec.tables.items():
        parameters[key] = read_table(folder, value, f"sky.{name}.parameters.{key}")
    return parameters, used


def read_table(folder: Path, spec: MapFile, where: str) -> Float[np.ndarray, "row column"]:
    """Read the numbers that a law interpolates from the text file that is named at a key."""
    if others := spec.changed(set(MapFile.model_fields) - {"file"}):
        raise SettingsError(f"{where}.{others[0]}: is of maps, but this is a table of numbers.")
    if len(spec.files) > 1:
        raise SettingsError(f"{where}.file: must be one file, not {spec.label}.")
    return read_text(find_file(folder, spec.files[0])).numbers()


def narrow(values: ArrayLike) -> Array:
    """Return values as an array, in single precision if they are a large map."""
    values = np.asarray(values)
    large = values.ndim and values.shape[-1] >= LARGE
    return jnp.asarray(values, jnp.float32 if large else float)


def read_sky(
    settings: Experiment,
    stokes: str = "QU",
    dtype: type[np.floating] = np.float64,
    *,
    names: Collection[str] | None = None,
    galaxy: EmbeddedSky | None = None,
    number: int = 0,
) -> tuple[dict[str, Template], str]:
    """Read the components named `names` (default: all) as templates [uK_RJ], in order.

    Also returns a sentence that describes them. Maps from files are in precision `dtype`;
    parameters that are maps are always in double precision. `galaxy` is the embedded model, if it
    has been made already. With a `number`, maps lie on disk that would be large if there were so
    many.
    """
    tables, folder = settings.sky.components, Path(settings.data_dir)
    wanted = [name for name in tables if names is None or name in names]
    for name in wanted:
        if name not in settings.sky.templates:
            raise SettingsError(f"sky.{name}: file is missing; here a component has a map.")
    # Components that take the polarization angles of others come after them.
    others = [angles for name in wanted if (angles := tables[name].angles)]
    order = list(dict.fromkeys((*others, *wanted)))
    description = (settings.title or "Templates from files.") if wanted else "No foregrounds."
    known: dict[str, Template] = {}
    if own := [name for name in order if tables[name].file is None]:
        galaxy = galaxy or embedded_galaxy(settings)
        description, maps = galaxy.description, galaxy.sky(stokes)
        known = {name: _embedded(folder, name, tables[name], maps[name]) for name in own}
    for name in order:
        spec = tables[name]
        if spec.file is not None:
            known[name] = _read_template(folder, name, spec, known, stokes, dtype)
        known[name] = of_many(known[name], number)
    found = {name: known[name] for name in wanted}
    with at_key("fixed"):
        return set_parameters_of(found, settings.fixed, tables), description


def embedded_galaxy(settings: Experiment) -> EmbeddedSky:
    """Make the embedded model of the Galaxy that the settings describe."""
    embedded = settings.sky.embedded
    assert embedded is not None  # callers have checked
    numbers = embedded.model_extra or {}
    with at_key("sky.embedded"):
        model = GalaxyModel(**numbers)
    if numbers or embedded.seed or embedded.nside > KEPT_NSIDE:
        return embedded_sky(embedded.nside, embedded.seed, model)
    return default_galaxy(embedded.nside)


def default_galaxy(nside: int) -> EmbeddedSky:
    """Return the embedded model with default parameters, made once and kept in the cache."""

    def computed() -> np.ndarray:
        made = embedded_sky(nside)
        return np.stack([made.dust, made.synchrotron])

    source = hashlib.sha256(Path(model_galaxy.__file__).read_bytes()).hexdigest()
    mark = (version("jaxsky"), version("jax"), source, nside, str(jnp.result_type(float)))
    dust, synchrotron = kept("galaxy", mark, (2, 3, healpy.nside2npix(nside)), computed)
    return EmbeddedSky(jnp.asarray(dust), jnp.asarray(synchrotron), 0)


def _embedded(folder: Path, name: str, spec: ComponentTable, component: Component) -> Template:
    """Return a component of the embedded model, with parameters from the settings."""
    nside = healpy.npix2nside(component.template.shape[-1])
    parameters, used = read_parameters(folder, name, spec, nside)
    if parameters:
        with at_key(f"sky.{name}"):
            component = dataclasses.replace(component, **parameters)
    return Template(component, 0.0, used)


def _read_template(
    folder: Path,
    name: str,
    spec: ComponentTable,
    others: dict[str, Template],
    stokes: str,
    dtype: type[np.floating],
) -> Template:
    assert spec.law is not None  # the settings ensure this
    found = read(folder, spec)
    law = component_class(spec.law)
    if not law.polarized and stokes == "QU":
        raise SettingsError(
            f"sky.{name}: {law.__name__} is not polarized, and these are maps of Q and U; leave it "
            'out of common.components, or choose "I" or "IQU" as common.stokes, or simulate.stokes '
            "for simulations."
        )
    own_stokes = "I" if spec.angles or not law.polarized else stokes
    rows = check_stokes(f"sky.{name}", found, own_stokes)
    parameters, known = read_parameters(folder, name, spec, found.nside, stokes=own_stokes)
    with at_key(f"sky.{name}.unit"):
        at = [spec.reference(s) for s in own_stokes]
        factors = amplitude_factors(law, found.unit, at, parameters)
    own = found.maps[rows]  # as large as everything else
    maps = jnp.asarray(np.multiply(own, factors, out=own), dtype)
    used = np.asarray(found.mask) & known
    with at_key(f"sky.{name}"):
        if spec.angles and stokes != "I":
            component: Component = AME.from_dust_angles(
                maps[0], jnp.asarray(others[spec.angles].component.amplitude), **parameters
            )
        else:
            if not law.polarized:
                maps = jnp.pad(maps, ((0, len(stokes) - 1), (0, 0)))
            component = law(maps, **parameters)
        if ":" in component.law:  # a class of the user's
            check_law(component)
    return Template(component, spec.fwhm or 0.0, used, found.unit)


def amplitude_factors(
    law: type[Component],
    unit: str,
    nu_ref: Sequence[float | None],
    parameters: Mapping[str, Any],
) -> Float[np.ndarray, "stokes _"]:
    """Return what turns maps in a unit into amplitudes of a law; a map if a parameter is one.

    `nu_ref` are the reference frequencies of the maps [GHz]; what is not among `parameters` of the
    law has its default. Raises ValueError for a unit that the law does not take.
    """
    given = {f.name: parameters.get(f.name, f.default) for f in dataclasses.fields(law)}
    for own, make in law.amplitude_from.items():
        try:
            one = unit_factor(unit, own)
        except ValueError:
            continue  # another unit
        wanted = {name: given[name] for name in [*inspect.signature(make).parameters][1:]}
        rows = [make(one, **wanted | {"nu_ref": nu}) for nu in nu_ref]
        return np.stack([np.atleast_1d(np.asarray(row)) for row in rows])
    return np.array([[float(unit_factor(unit, law.unit, nu))] for nu in nu_ref])


def set_parameters_of(
    templates: Mapping[str, Template], fixed: Mapping[str, float], components: Collection[str] = ()
) -> dict[str, Template]:
    """Return templates with some of their parameters set, by dotted name.

    Parameters of known `components` that have no template here are ignored.
    """
    for name in (key.split(".")[0] for key in fixed):
        if name not in templates and name not in components:
            raise ValueError(
                f"there is no component {name!r}; components are {', '.join(templates)}"
            )
    changed = dict(templates)
    for name, template in templates.items():
        if values := {k: v for k, v in fixed.items() if k.split(".")[0] == name}:
            new = set_parameters(Sky({name: template.component}), values)[name]
            changed[name] = template._replace(component=new)
    return changed


def uK_RJ_per(unit: str, at: Bandpass | float | None, where: str) -> float:
    """Return the factor from a unit to uK_RJ, at a frequency [GHz] or over a band."""
    with at_key(f"{where}.unit"):
        return float(unit_factor(unit, "uK_RJ", at))


def check_stokes(where: str, found: Maps, wanted: str) -> slice:
    """Return the rows of the Stokes parameters wanted, of these alone or of I, Q, U.

    Refuses other columns.
    """
    names, expected = ", ".join(found.names), "IQU" if len(found.names) == 3 else wanted
    if len(found.names) != len(expected):
        raise SettingsError(f"{where}: fields must name {listed(wanted)}, not {names}.")
    if any(s not in (None, w) for s, w in zip(found.stokes, expected, strict=True)):
        raise SettingsError(f"{where}.fields: {names} are not {listed(wanted)} by their names.")
    return stokes_rows(wanted, expected)


def bandpass_of(folder: Path, spec: BandTable) -> Bandpass:
    """Return the bandpass of a band: read from a file, a top-hat, or a single frequency."""
    where, given = f"bands.{spec.name}.bandpass", spec.bandpass
    if given is None:
        raise SettingsError(f"{where}: is missing.")
    with at_key(where):
        if given.center is None:
            options = given.model_dump(exclude={"file", "center", "width"})
            return read_bandpass(find_file(folder, given.files[0]), **options)
        if not given.width:
            return Bandpass.delta(given.center)
        return Bandpass.top_hat(given.center, given.width, given.convention or "RJ", spec.samples)


def beam_of(folder: Path, spec: BandTable, lmax: int) -> Float[Array, " ell"] | float | None:
    """Return the FWHM [arcmin] of a band, or the window of its beam; None if neither is given."""
    if spec.beam is None:
        return spec.fwhm
    with at_key(f"bands.{spec.name}.beam"):
        return jnp.asarray(read_beam(find_file(folder, spec.beam), lmax))
