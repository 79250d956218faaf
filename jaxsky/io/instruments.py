"""Read tables of an instrument's channels, as users and other codes write them."""

import dataclasses
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from astropy import units as u
from astropy.table import Table

from jaxsky.io.files import UnfitError, check_file, in_file
from jaxsky.io.quantities import is_ambiguous, unit_factor, unit_name
from jaxsky.public import takes_quantities

#: Names of columns in lower case by what they hold, those of FGBuster and of litebird_sim included.
COLUMNS = {
    "name": ("name", "channel", "band"),
    "center": ("center", "frequency", "nu", "center_frequency", "bandcenter_ghz"),
    "width": ("width", "bandwidth", "bandwidth_ghz"),
    "fwhm": ("fwhm", "beam", "fwhm_arcmin"),
    "noise": ("noise", "depth", "depth_p", "pol_sensitivity_channel_ukarcmin"),
    "noise_I": ("noise_i", "depth_i"),
    "sky_fraction": ("sky_fraction", "f_sky"),
}
KINDS = {word: kind for kind, words in COLUMNS.items() for word in words}
#: Columns of FGBuster and of litebird_sim that say nothing of bands, beams and noise of maps.
UNUSED = frozenset(
    (
        *("date", "detectors", "experiment", "instrument", "net_arr_i", "net_arr_p", "net_det"),
        *("note", "pixel_size", "reference", "status", "type"),
        *("alpha", "band_freqs_ghz", "band_weights", "detector_names", "detector_objs"),
        *("ellipticity", "fknee_mhz", "fmin_hz", "net_channel_ukrts", "net_detector_ukrts"),
        *("number_of_detectors", "pol_sensitivity_detector_ukarcmin", "psi_rad"),
        "sampling_rate_hz",
    )
)
#: Units of the columns that have one.
TARGETS = {"center": "GHz", "width": "GHz", "fwhm": "arcmin"}
#: A column's name with its unit, "fwhm [arcmin]".
_WITH_UNIT = re.compile(r"\s*(?P<name>.*?)\s*[\[(](?P<unit>.*)[\])]\s*")


@takes_quantities
def read_instrument(table: Any) -> dict[str, Any]:
    """Read the channels of an instrument from a table.

    The columns are, with the names in `COLUMNS`: center [GHz], width [GHz], FWHM of the beam
    [arcmin] and white noise of Q and of U [uK_CMB arcmin]; where they are there, that of I in the
    same unit, and the fraction of the sky. A band has no polarization if its noise of Q and of U is
    infinite, next to that of I. Without a width (or with 0) a band is monochromatic, without
    a name it is called by its frequency in GHz. Other units are converted: those of
    quantities, of a table's columns, and in brackets after a column's name; a noise in K is taken
    to be thermodynamic. As in FGBuster's tables, `bandwidth` next to `depth_p` is a fraction.

    Parameters
    ----------
    table : columns by name (a dictionary, a table of astropy or pandas), a list of rows
        (dictionaries, or channels of litebird_sim), or the name of a file: .csv, .ecsv, .json,
        .yaml, else TOML. A file or dictionary may have `title` and `sky_fraction`, and its rows in
        `bands`, which may also be bands of an experiment file.

    Returns
    -------
    dict
        "bands", a list of tables as in an experiment file with "name", "bandpass" (center and
        width), "fwhm", "noise" (level and unit; a list of that of I alone without polarization) and
        "noise_I"; "title" and "sky_fraction", which
        are None where they are not given

    Raises
    ------
    InputError
        One sentence with the column and the value: columns that are unknown, missing or double, of
        different lengths, or in a wrong unit; values that are no numbers, not finite, or negative;
        names that are used twice.
    """
    if isinstance(table, str | Path):
        path = Path(table)
        check_file(path)
        with in_file(path):
            found = _instrument(_load(path))
        return found | {"title": found["title"] or path.stem}
    with in_file("Argument `table`"):
        return _instrument(table)


def _load(path: Path) -> Any:
    """Return what a file holds, by the ending of its name."""
    ending = path.suffix.lower()
    try:
        if ending in (".csv", ".ecsv"):
            return Table.read(path, format=f"ascii{ending}")
        text = path.read_text()
        if ending == ".json":
            return json.loads(text)
        return yaml.safe_load(text) if ending in (".yaml", ".yml") else tomllib.loads(text)
    except (OSError, ValueError, TypeError, RecursionError, yaml.YAMLError) as error:
        kind = ending[1:].upper() if ending in (".csv", ".ecsv", ".json", ".yaml") else "TOML"
        reason = " ".join(str(error).split()).rstrip(".")
        raise UnfitError(f"is no {kind} file with a table of bands ({reason}).") from None


def _instrument(table: Any) -> dict[str, Any]:
    """Return title, fraction of the sky and bands of a table in memory."""
    table, about = _heading(table)
    title, fraction = about.get("title"), about.get("sky_fraction", about.get("f_sky"))
    if about.get("bands") and _are_of_experiment(table):
        return _checked(title, fraction, [dict(row) for row in table])
    found = _numbers_of(_named(_columns(table)))
    if fraction is None and len(set(found.get("sky_fraction", ()))) == 1:
        fraction = found["sky_fraction"][0]
    return _checked(title, fraction, _bands(found))


def _heading(table: Any) -> tuple[Any, dict[str, Any]]:
    """Return columns or rows without what is said of all, and that; "bands" if these held rows."""
    if not isinstance(table, Mapping):
        return table, {}
    columns, meta = dict(table), table.get("meta")
    about = dict(meta) if isinstance(meta, Mapping) else {}
    columns.pop("meta", None)
    for key in ("title", "sky_fraction", "f_sky"):
        if key in columns and _is_one(columns[key]):
            about[key] = columns.pop(key)
    return columns.get("bands", columns), about | {"bands": "bands" in columns}


def _are_of_experiment(rows: Any) -> bool:
    """Return whether rows are bands of an experiment file, which have no frequency of their own."""
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        return False
    kinds = [{KINDS.get(_split(key)[0].lower()) for key in row} for row in rows]
    return not rows or any("center" not in row for row in kinds)


def _checked(title: Any, fraction: Any, bands: list[dict[str, Any]]) -> dict[str, Any]:
    """Return an instrument, after checking that its bands have names, all different."""
    names = [str(band.get("name", "")) for band in bands]
    if not bands or "" in names:
        raise UnfitError(f"band {names.index('') + 1}: no name." if bands else "there are none.")
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UnfitError(f"{names.count(twice)} of bands {', '.join(names)} are called {twice}.")
    if fraction is not None:
        fraction = _number("sky_fraction", "sky_fraction", 1, fraction, None)
    return {"title": title and str(title), "sky_fraction": fraction, "bands": bands}


def _columns(table: Any) -> dict[str, Any]:
    """Return the columns of a table by name."""
    if isinstance(table, Mapping):
        return {str(key): column for key, column in table.items()}
    names = getattr(table, "colnames", getattr(table, "columns", None))
    if names is not None:
        return {str(name): table[name] for name in names}
    if not isinstance(table, Sequence) or isinstance(table, str | bytes) or not len(table):
        what = "a list without rows" if isinstance(table, Sequence) else type(table).__name__
        raise UnfitError(
            f"must be columns by name, a list of rows or the name of a file, but is {what}."
        )
    rows = [_row(i, row) for i, row in enumerate(table, 1)]
    for i, row in enumerate(rows, 1):
        if apart := set(row) ^ set(rows[0]):
            raise UnfitError(f"rows 1 and {i} differ in {', '.join(sorted(map(str, apart)))}.")
    return {str(key): [row[key] for row in rows] for key in rows[0]}


def _row(number: int, row: Any) -> Mapping[str, Any]:
    """Return a row by name of column; of a channel of litebird_sim what is of use here."""
    if isinstance(row, Mapping):
        return row
    if dataclasses.is_dataclass(row):
        names = {field.name for field in dataclasses.fields(row)} - {"band"}
        return {name: getattr(row, name) for name in names if name in KINDS}
    raise UnfitError(f"row {number} must be a dictionary, but is {type(row).__name__}.")


class _Column(NamedTuple):
    """A column of a known kind: its name as it was written, values, and unit or None."""

    label: str
    values: list[Any]
    unit: str | None


def _split(key: Any) -> tuple[str, str | None]:
    """Return the name of a column, and the unit in brackets after it or None."""
    match = _WITH_UNIT.fullmatch(str(key))
    return (match["name"], match["unit"]) if match else (str(key).strip(), None)


def _is_one(column: Any) -> bool:
    """Return whether what stands for a column is a single value."""
    return not isinstance(column, list | tuple) and np.ndim(column) == 0


def _named(columns: Mapping[str, Any]) -> dict[str, _Column]:
    """Return the columns by what they hold."""
    found: dict[str, _Column] = {}
    for key, column in columns.items():
        label, unit = _split(key)
        kind = KINDS.get(label.lower())
        if kind is None:
            if label.lower() in UNUSED:
                continue
            known = ", ".join(words[0] for words in COLUMNS.values())
            raise UnfitError(f"unknown column {label!r}; known are {known} and others of these.")
        if kind in found:
            raise UnfitError(f"{label} and {found[kind].label} are both columns of the {kind}.")
        unit = str(own) if (own := getattr(column, "unit", None)) is not None else unit
        values = [column] if _is_one(column) else list(column)
        found[kind] = _Column(label, values, unit)
    for kind in ("center", "fwhm", "noise"):
        if kind not in found:
            raise UnfitError(f"no column of the {kind}, which may be {', '.join(COLUMNS[kind])}.")
    sizes = {column.label: len(column.values) for column in found.values()}
    if len(set(sizes.values())) > 1:
        said = ", ".join(f"{label} {size}" for label, size in sizes.items())
        raise UnfitError(f"columns differ in length: {said}.")
    return found


def _numbers_of(columns: Mapping[str, _Column]) -> dict[str, list[Any]]:
    """Return the values of the columns in the package's units; names as text."""
    found: dict[str, list[Any]] = {}
    for kind, (label, values, unit) in columns.items():
        rows = enumerate(values, 1)
        if kind == "name":
            found[kind] = [_text(label, i, value) for i, value in rows]
        elif kind.startswith("noise"):
            of_I = kind == "noise" and "noise_I" in columns
            found[kind] = [_depth(label, i, value, unit, of_I) for i, value in rows]
        else:
            found[kind] = [_number(kind, label, i, value, unit) for i, value in rows]
    width = columns.get("width")
    if width is None:
        return found
    fgbuster = (width.label.lower(), columns["noise"].label.lower()) == ("bandwidth", "depth_p")
    if fgbuster and width.unit is None and not any(hasattr(v, "unit") for v in width.values):
        found["width"] = _of_fractions(found["width"], found["center"])
    for i, (center, gap) in enumerate(zip(found["center"], found["width"], strict=True), 1):
        if gap >= 2 * center:
            raise UnfitError(f"row {i}: a width of {gap:g} GHz about {center:g} GHz.")
    return found


def _of_fractions(widths: list[float], centers: list[float]) -> list[float]:
    """Return widths [GHz], of fractions of the center."""
    if max(widths) >= 1:
        raise UnfitError(
            f"bandwidth is {max(widths):g}, but next to depth_p it is a fraction of the "
            "frequency; call it width if it is in GHz."
        )
    return [width * center for width, center in zip(widths, centers, strict=True)]


def _text(label: str, row: int, value: Any) -> str:
    """Return a name; numbers as one writes them."""
    whole = isinstance(value, float | np.floating) and math.isfinite(value)
    text = f"{value:g}" if whole else str(value).strip()
    if value is None or text in ("", "nan", "--"):
        raise UnfitError(f"column {label}, row {row}: no name.")
    return text


def _number(kind: str, label: str, row: int, value: Any, unit: str | None) -> float:
    """Return a value in the unit of its kind, after checking its sign and range."""
    own = getattr(value, "unit", None)
    unit = unit if own is None else str(own)
    number = _bare(label, row, value)
    if unit is not None:
        try:
            number *= unit_factor(unit, TARGETS.get(kind, ""))
        except ValueError as error:
            raise UnfitError(f"column {label}: {error}") from None
    positive = kind not in ("width", "fwhm")
    if number < 0 or (positive and number == 0) or (kind == "sky_fraction" and number > 1):
        span = {"sky_fraction": "above 0, at most 1"}.get(kind, "positive" if positive else "")
        must = f"be {span}" if span else "not be negative"
        raise UnfitError(f"column {label}, row {row}: must {must}, but is {number:g}.")
    return number


def _bare(label: str, row: int, value: Any, infinite: bool = False) -> float:
    """Return a finite number, or one that is `infinite` if it may be."""
    try:
        number = math.nan if np.ma.is_masked(value) else float(getattr(value, "value", value))
    except (TypeError, ValueError):
        raise UnfitError(f"column {label}, row {row}: {value!r} is no number.") from None
    if not math.isfinite(number) and not (infinite and number == math.inf):
        raise UnfitError(f"column {label}, row {row}: is {number:g}, no finite number.")
    return number


def _depth(
    label: str, row: int, value: Any, unit: str | None, infinite: bool = False
) -> tuple[float, str]:
    """Return a depth and its unit, "uK_CMB" or "uK_RJ", times arcmin; it may be `infinite`."""
    own = getattr(value, "unit", None)
    unit = unit if own is None else str(own)
    level = _bare(label, row, value, infinite)
    if level <= 0:
        raise UnfitError(f"column {label}, row {row}: must be positive, but is {level:g}.")
    if unit is None:
        return level, "uK_CMB"
    words = [word for word in re.split(r"[\s*.]+", unit) if word]
    angles = [word for word in words if _is_angle(word)]
    rest = [word for word in words if not _is_angle(word)]
    try:
        (angle,), (temperature,) = angles, map(unit_name, rest)
        temperature += "_CMB" if is_ambiguous(temperature) else ""
        target = "uK" + temperature[temperature.index("_") :]
        return level * unit_factor(angle, "arcmin") * unit_factor(temperature, target), target
    except ValueError:
        raise UnfitError(
            f"column {label}: {unit!r} is no temperature times an angle, as in 'uK_CMB arcmin'."
        ) from None


def _is_angle(word: str) -> bool:
    try:
        return bool(u.Unit(word).is_equivalent(u.arcmin))
    except ValueError:
        return False


def _bands(found: Mapping[str, list[Any]]) -> list[dict[str, Any]]:
    """Return the bands as tables of an experiment file."""
    centers = found["center"]
    names = found.get("name", [f"{center:.0f}" for center in centers])
    widths = found.get("width", [0.0] * len(centers))
    bands = []
    for i, (name, center, width) in enumerate(zip(names, centers, widths, strict=True)):
        level, unit = found["noise"][i]
        band = {
            "name": name,
            "bandpass": {"center": center, "width": width},
            "fwhm": found["fwhm"][i],
            "noise": {"level": level, "unit": unit},
        }
        if "noise_I" in found:
            band["noise_I"], other = found["noise_I"][i]
            if other != unit:
                raise UnfitError(f"band {name!r} has noise in {unit}, but noise of I in {other}.")
            if level == math.inf:
                band["noise"]["level"] = [band.pop("noise_I")]
        bands.append(band)
    return bands
