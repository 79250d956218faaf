"""Read bandpasses from Planck instrument models (RIMO, FITS), IPAC tables and plain text."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits as pyfits
from jaxtyping import Float

from jaxsky.bandpass import CONVENTIONS, Bandpass
from jaxsky.checks import check_choice
from jaxsky.io.curves import TextTable, read_text
from jaxsky.io.files import UnfitError, in_file, is_fits
from jaxsky.io.tables import index_of, open_fits, select_hdu

#: astropy's name of a unit -> how files spell it; wavenumbers and wavelengths are converted.
_UNITS = {
    **{f"{prefix}Hz": re.compile(f"{prefix}hz", re.I) for prefix in ("", "k", "M", "G", "T")},
    "1/cm": re.compile(r"1/cm|cm(\^|\*\*)?[({]?-1[)}]?", re.I),
    "um": re.compile(r"microns?|micrometers?|[u\u00b5\u03bc]m", re.I),
    "mm": re.compile("mm"),
}
_UNIT = re.compile(
    rf"(?<![a-z0-9])(?:{'|'.join(f'(?:{x.pattern})' for x in _UNITS.values())})(?![a-z0-9^*/-])",
    re.I,
)
#: Words that may precede "/GHz"; otherwise it may be the unit of weights, per GHz.
_FREQUENCY = re.compile(r"(nu|\u03bd|f|freq\w*|wavenumbers?|wavelengths?|lambda)\s*/$", re.I)
_WAVES = re.compile(r"wave(number|length)|lambda|\u03bb", re.I)
#: Allowed middle of a band [GHz], where the file states no unit and where it does.
_BARE, _STATED = (1.0, 3000.0), (0.01, 30000.0)


def _known(text: str) -> str:
    """Return astropy's spelling of a unit, as files often ignore case; unknown ones unchanged."""
    word = text.strip()
    return next((name for name, spelling in _UNITS.items() if spelling.fullmatch(word)), word)


def _units(line: str) -> list[str]:
    """Return the units that a line of a header states; "30 GHz" is a name, not a unit."""
    found: dict[str, None] = {}  # a set that keeps its order
    for match in _UNIT.finditer(line):
        before = line[: match.start()].rstrip(" ([")
        of_weights = before.endswith("/") and not _FREQUENCY.search(before)
        if not (before[-1:].isdigit() or of_weights or before.lower().endswith("per")):
            found[_known(match[0])] = None
    return list(found)


def _frequency_unit(table: TextTable, column: int, given: str | None) -> str | None:
    """Return the unit of the frequencies in a column, from the header or the argument `unit`.

    The line directly above the rows must agree with the argument, which overrides lines further
    up. Outside IPAC tables a length is accepted only if the header mentions wavelengths.
    """
    if table.bars:
        cells = "".join(table.bars[2:3]).split("|")[1:]
        last = [_known(cell) for cell in cells[column : column + 1] if cell.strip()]
    else:
        last = _units("".join(table.header[-1:]))
    if given is not None:
        if len(last) == 1 and _known(given) != last[0]:
            raise UnfitError(f"argument `unit` is {given!r}, but the file says {last[0]!r}.")
        return given
    words = " ".join([*table.bars[:1], *table.header])
    stated = last if len(last) == 1 or table.bars else _units(words)
    if len(stated) > 1:
        raise UnfitError(f"the header names the units {', '.join(stated)}; give `unit`.")
    clear = table.bars or _WAVES.search(words)
    if stated and stated[0] in ("um", "mm") and not clear:
        raise UnfitError(f"what is in {stated[0]} is not said; give `unit`.")
    if clear and not stated:
        raise UnfitError("the unit of the frequencies is missing; give `unit`.")
    return stated[0] if stated else None


def _to_GHz(samples: Float[np.ndarray, "2 sample"], unit: str) -> Float[np.ndarray, "2 sample"]:
    """Convert frequencies, wavenumbers or wavelengths to GHz, in order, with their weights."""
    known = _known(unit)
    if known not in _UNITS:
        raise UnfitError(f"the frequencies' unit is {unit!r}, not one of {', '.join(_UNITS)}.")
    with np.errstate(divide="ignore"):
        nu = u.Quantity(samples[0], known).to_value(u.GHz, equivalencies=u.spectral())
    falls = u.Unit(known).physical_type == "length"
    return np.array([nu, samples[1]])[:, :: -1 if falls else 1]


#: Frequencies [GHz], weights and their convention, "" if it is unknown.
Curve = tuple[np.ndarray, np.ndarray, str]

#: Unit of a RIMO's WAVENUMBER -> convention. For LFI the column contains frequencies, and the
#: weights act on antenna temperature; those of HFI act on power.
_RIMO = {"GHz": "RJ", "1/cm": "power"}
#: Names of columns that do not contain frequencies.
_NO_FREQUENCY = re.compile(
    r"index|idx|i|n|no\.?|number|row|sample|channel|id|weights?|w|t|trans\w*|response|bandpass",
    re.I,
)
#: Weights below this fraction of the largest count as zero.
_NO_WEIGHT = 1e-6
#: A table with more columns than this is something else, or transposed.
_WIDEST = 8


def _checked(nu: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples at positive frequencies [GHz]; refuse what is not a bandpass."""
    if bad := int(np.sum(~np.isfinite(nu) | ~np.isfinite(weights))):
        raise UnfitError(f"{bad} of {nu.size} samples of the bandpass are not finite.")
    low = nu <= 0
    if low.all():
        raise UnfitError("the bandpass has no sample at a positive frequency.")
    largest = np.abs(weights[low]).max(initial=0.0)
    if largest > _NO_WEIGHT * np.abs(weights).max():
        raise UnfitError(f"{low.sum()} samples at nu <= 0 have weights up to {largest:g}.")
    nu, weights = nu[~low], weights[~low]
    if np.any(steps := np.diff(nu) <= 0):
        at = int(np.argmax(steps))
        raise UnfitError(f"frequencies must increase, but {nu[at + 1]:g} follows {nu[at]:g} GHz.")
    integral = np.trapezoid(weights, nu) if nu.size > 1 else weights[0]
    if not integral > 0:
        raise UnfitError("the integral of the bandpass is not positive.")
    return nu, weights


def _rimo_samples(hdus: pyfits.HDUList, name: str) -> Curve:
    tables = [select_hdu(hdus, i) for i, h in enumerate(hdus) if h.name == name]
    names = tables[0].columns.names
    for column in ("WAVENUMBER", "TRANSMISSION"):
        if column not in names:
            raise UnfitError(f"HDU {name!r}: no column {column!r}; it has {', '.join(names)}.")
    data = [np.array([t.data["WAVENUMBER"], t.data["TRANSMISSION"]], np.float64) for t in tables]
    if not all(np.array_equal(data[0], other) for other in data[1:]):
        raise UnfitError(f"{len(tables)} HDUs are named {name!r} and differ.")
    unit = str(tables[0].columns["WAVENUMBER"].unit)
    if unit not in _RIMO:
        known = " or ".join(_RIMO)
        raise UnfitError(f"HDU {name!r}: WAVENUMBER has the unit {unit!r}, not {known}.")
    nu, weights = _to_GHz(data[0], unit)
    # Neighbours that share a frequency, as happens in single precision, are averaged.
    starts = np.flatnonzero(np.concatenate([[True], np.diff(nu) != 0]))
    counts = np.diff(np.append(starts, nu.size))
    return *_checked(nu[starts], np.add.reduceat(weights, starts) / counts), _RIMO[unit]


def _rimo_names(
    names: Sequence[str], band: str | None, detectors: Sequence[str] | None
) -> list[str]:
    """Return the names of the HDUs of a band average, or of its detectors."""
    wanted = None if band is None else band.upper().lstrip("F0")
    averages, single = {}, {}
    for name in names:
        key, _, detector = name.upper().removeprefix("BANDPASS_").partition("-")
        if not detector:
            averages[key.lstrip("F0")] = name
        elif wanted in (None, key.lstrip("F0")):
            single[detector] = name
    if detectors is None:
        if wanted not in averages:
            asked = "give `band`" if wanted is None else f"no band {band!r}"
            raise UnfitError(f"{asked}; it has {', '.join(averages)}.")
        return [averages[wanted]]
    asked_for = [str(d).upper().removeprefix("LFI") for d in detectors]
    if not asked_for:
        raise UnfitError("argument `detectors` is empty.")
    if missing := [detector for detector in asked_for if detector not in single]:
        where = "" if band is None else f" in band {band}"
        known = ", ".join(single) or "none"
        raise UnfitError(f"no detector {missing[0]!r}{where}; it has {known}.")
    return [single[detector] for detector in asked_for]


def _read_rimo(path: Path, band: str | None, detectors: Sequence[str] | None) -> Curve:
    with open_fits(path) as hdus:
        known = list(dict.fromkeys(h.name for h in hdus if h.name.startswith("BANDPASS_")))
        if not known:
            raise UnfitError("no HDU is named BANDPASS_...; not an instrument model.")
        found = [_rimo_samples(hdus, name) for name in _rimo_names(known, band, detectors)]
    if len(found) == 1:
        return found[0]
    # The mean of several detectors, each normalised to unit integral, on all their frequencies.
    grid = np.unique(np.concatenate([nu for nu, *_ in found]))
    unit = [(nu, weights / np.trapezoid(weights, nu)) for nu, weights, _ in found]
    curves = [np.interp(grid, nu, weights, left=0.0, right=0.0) for nu, weights in unit]
    return grid, np.mean(curves, axis=0), found[0][2]


def _columns(table: TextTable, fields: Sequence[int | str] | None) -> list[int]:
    """Return the numbers of the columns of frequency and weight."""
    width = table.width
    names = next((words for words in table.headings() if len(words) == width), [])
    if fields is None:
        shown = f" ({' '.join(names)})" if names else ""
        if width > _WIDEST:
            raise UnfitError(f"{width} columns{shown}; give `fields`, of frequency and weight.")
        first = [row.cells[0] for row in table.rows]
        counted = first in ([str(i + start) for i in range(len(first))] for start in (0, 1))
        if (counted and width > 2) or (names and _NO_FREQUENCY.fullmatch(names[0])):
            said = f"the first of {width} columns{shown} may not be the frequency"
            raise UnfitError(f"{said}; give `fields`, the columns of frequency and weight.")
        return [0, 1]
    if isinstance(fields, str) or len(fields) != 2:
        raise UnfitError(f"argument `fields` must name two columns, not {fields!r}.")
    columns = [index_of(field, names or [""] * width) for field in fields]
    if columns[0] == columns[1]:
        raise UnfitError(f"argument `fields` names column {fields[0]!r} twice.")
    return columns


def _read_text(path: Path, fields: Sequence[int | str] | None, given: str | None) -> Curve:
    table = read_text(path)
    columns = _columns(table, fields)
    samples = table.numbers(columns).T
    unit = _frequency_unit(table, columns[0], given)
    nu, weights = _checked(*_to_GHz(samples, unit or "GHz"))
    center = float(np.average(nu, weights=np.abs(weights)))
    low, high = _BARE if unit is None else _STATED
    if not low <= center <= high:
        asked = "" if unit else "; give `unit`, such as MHz or THz, or GHz if it is right"
        middle = f"in {unit or 'GHz'}, the middle of the band is at {center:g} GHz"
        raise UnfitError(f"{middle}, outside of {low:g} to {high:g} GHz{asked}.")
    return nu, weights, "power" if table.bars else ""


def read_bandpass(
    path: str | Path,
    band: str | int | None = None,
    *,
    detectors: Sequence[str] | None = None,
    convention: str | None = None,
    unit: str | None = None,
    fields: Sequence[int | str] | None = None,
    trim: float = 0.0,
) -> Bandpass:
    r"""Read the bandpass of a band, or the mean of some detectors, from a file.

    * Planck instrument models (RIMO, FITS): `band` is "30" or "044" for LFI, in convention "RJ";
      "100", "353" for HFI, in convention "power". "PSB353" is the average of the polarization-
      sensitive bolometers only, which is right for maps of Q and U. `detectors=("24M", "24S")`
      averages single detectors instead, each normalised to unit integral. Samples that HFI flags
      as interpolated over CO lines are used like the others.
    * IPAC tables (WMAP), with the unit of frequency from their header: convention "power".
    * Text with two columns, frequency and weight, separated by blanks, commas or semicolons
      (`jaxsky.io.curves.read_text`). The unit is the one stated in the header ("nu [MHz]",
      "nu_GHz"), else GHz, provided that the middle of the band is then between 1 and 3000 GHz.
      Such a file does not state its convention, so it has to be given.

    Samples without weight at nu <= 0 are dropped. What remains uncertain is an InputError.

    Parameters
    ----------
    path : FITS, IPAC or text file
    band : band of a RIMO
    detectors : detectors of a RIMO
    convention : "RJ", "power" or "CMB" (`Bandpass`), to override that of the format
    unit : unit of the frequencies of a text file that does not state it: "Hz", "kHz", "MHz",
        "GHz", "THz", wavenumbers "1/cm", wavelengths "um" or "mm"
    fields : columns of frequency and weight of a text file that has more than these, by number
        from 0 or by name
    trim : cut both ends of the band up to where the weight exceeds this fraction of the largest.
        HFI tables have 12 000 to 17 000 samples up to 18 THz; 1e-6 leaves 360 to 5 400 and
        changes the factors from K_CMB to MJy/sr by less than 5e-6 (1e-4: by up to 8e-4).
    """
    path = Path(path)
    if convention is not None:
        check_choice("convention", convention, CONVENTIONS)
    if unit is not None and not isinstance(unit, str):
        raise TypeError(f"Argument `unit` must be the name of a unit, not {unit!r}.")
    if not 0 <= trim < 1:
        raise ValueError(f"Argument `trim` must be within [0, 1), but is {trim}.")
    with in_file(path):
        if is_fits(path):
            for name, argument in {"unit": unit, "fields": fields}.items():
                if argument is not None:
                    raise UnfitError(f"argument `{name}` is for text files, this is FITS.")
            nu, weights, found = _read_rimo(path, None if band is None else str(band), detectors)
        elif band is not None or detectors is not None:
            raise UnfitError("a text table has one band; leave out `band` and `detectors`.")
        else:
            nu, weights, found = _read_text(path, fields, unit)
        if not (convention := convention or found):
            known = ", ".join(CONVENTIONS)
            raise UnfitError(f"the file does not say it; give `convention`, one of {known}.")
    if trim:
        inside = np.flatnonzero(weights > trim * weights.max())
        nu, weights = (x[inside[0] : inside[-1] + 1] for x in (nu, weights))
    return Bandpass(nu, weights, convention)
