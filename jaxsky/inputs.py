"""What settings name, read: maps, templates with their laws, bandpasses."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxsky.bandpass import Bandpass
from jaxsky.components import AME, Component, Dust, Synchrotron
from jaxsky.io import Maps, read_bandpass, read_maps
from jaxsky.io.tables import stokes
from jaxsky.settings import BandpassSpec, MapFile, SettingsError, TemplateFile
from jaxsky.units import conversion

__all__ = ["LAWS", "Template", "check_stokes", "read", "read_bandpass_spec", "read_templates"]

LAWS: dict[str, type[Component]] = {"dust": Dust, "synchrotron": Synchrotron, "ame": AME}


class Template(NamedTuple):
    """A component at the resolution of its map."""

    component: Component
    fwhm: float
    used: Bool[np.ndarray, " pix"]


def read(folder: Path, spec: MapFile) -> Maps:
    """The maps of a file; see `jaxsky.io.read_maps`."""
    return read_maps(
        folder / spec.file,
        fields=spec.fields,
        hdu=spec.hdu,
        unit=spec.unit,
        ordering=spec.ordering,
        coordinates=spec.coordinates,
        polarization=spec.polarization,
    )


def read_templates(folder: Path, specs: Mapping[str, TemplateFile]) -> dict[str, Template]:
    """Templates with their laws, Q and U [uK_RJ], by name.

    Raises
    ------
    jaxsky.io.InputError, SettingsError
        For files that cannot be read as what they should be.
    """
    templates: dict[str, Template] = {}
    for name, spec in sorted(specs.items(), key=lambda item: item[1].law == "ame"):
        templates[name] = _read_template(folder, name, spec, templates)
    return templates


def _read_template(
    folder: Path, name: str, spec: TemplateFile, others: dict[str, Template]
) -> Template:
    found = read(folder, spec)
    check_stokes(f"templates.{name}", found.names, "I" if spec.angles else "QU")
    maps = jnp.asarray(found.maps) * conversion(found.unit, "uK_RJ", spec.nu_ref)
    used = np.asarray(found.mask)
    parameters: dict[str, Any] = {"nu_ref": spec.nu_ref}
    for key, value in spec.parameters.items():
        if isinstance(value, MapFile):
            column = read(folder, value)
            parameters[key], used = jnp.asarray(column.maps)[0], used & np.asarray(column.mask)
        else:
            parameters[key] = tuple(value) if isinstance(value, list) else value
    try:
        if spec.angles:
            if len(maps) != 1:
                raise ValueError(f"fields must name one intensity map, not {len(maps)} maps")
            component: Component = AME.from_dust_angles(
                maps[0], others[spec.angles].component.amplitude, **parameters
            )
        else:
            component = LAWS[spec.law](maps[-2:], **parameters)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"templates.{name}: {error}") from None
    return Template(component, spec.fwhm, used)


def check_stokes(where: str, names: Sequence[str], wanted: str) -> None:
    """Refuse columns whose names say that they are other Stokes parameters than is wanted."""
    said = [stokes(name) for name in names[-len(wanted) :]]
    if any(s and s != w for s, w in zip(said, wanted, strict=False)):
        raise SettingsError(
            f"{where}.fields: {', '.join(names)} are not {' and '.join(wanted)} by their names."
        )


def read_bandpass_spec(folder: Path, spec: BandpassSpec) -> Bandpass:
    """The bandpass of a file, or a top-hat."""
    if spec.file is not None:
        return read_bandpass(
            folder / spec.file, spec.band, detectors=spec.detectors, convention=spec.convention
        )
    assert spec.center is not None  # one of file and center is given
    if not spec.width:
        return Bandpass.delta(spec.center)
    return Bandpass.top_hat(spec.center, spec.width, spec.convention or "RJ")
