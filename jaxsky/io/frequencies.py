"""Units of frequencies in text tables: what a header states, and whether it can be right."""

import re
from pathlib import Path

import numpy as np
from astropy import units as u
from jaxtyping import Float

from jaxsky.io.tables import InputError
from jaxsky.io.text import TextTable

#: astropy's name of a unit -> how it is spelt; wavenumbers and wavelengths are converted.
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
#: What may stand before "/GHz"; weights per GHz are no statement about frequencies.
_FREQUENCY = re.compile(r"(nu|\u03bd|f|freq\w*|wavenumbers?|wavelengths?|lambda)\s*/$", re.I)
_WAVES = re.compile(r"wave(number|length)|lambda|\u03bb", re.I)
#: Middle of a band [GHz]: where no unit is stated, and where one is.
_BARE, _STATED = (1.0, 3000.0), (0.01, 30000.0)


def _known(text: str) -> str:
    """astropy's spelling of a unit, whose case files do not respect; as it is if there is none."""
    word = text.strip()
    return next((name for name, spelling in _UNITS.items() if spelling.fullmatch(word)), word)


def _units(line: str) -> list[str]:
    """Units that a line of a header states; "30 GHz" is a name."""
    found: dict[str, None] = {}  # a set that keeps its order
    for match in _UNIT.finditer(line):
        before = line[: match.start()].rstrip(" ([")
        of_weights = before.endswith("/") and not _FREQUENCY.search(before)
        if not (before[-1:].isdigit() or of_weights or before.lower().endswith("per")):
            found[_known(match[0])] = None
    return list(found)


def frequency_unit(path: Path, table: TextTable, column: int, given: str | None) -> str | None:
    """The unit of the frequencies in a column, by the header or the argument `unit`.

    Of a text table the line above the rows counts first; what is said above that is overruled by
    the argument. Lengths are units of wavelengths only where these are spoken of.
    """
    last = _units(table.header[-1]) if table.header else []
    if table.bars:
        cells = table.bars[2].split("|")[1:] if len(table.bars) > 2 else []
        cell = cells[column].strip() if column < len(cells) else ""
        last = [_known(cell)] if cell else []
    if given is not None:
        if len(last) == 1 and _known(given) != last[0]:
            raise InputError(
                f"{path}: argument `unit` is {given!r}, but the file says {last[0]!r}."
            )
        return given
    words = " ".join([*table.bars[:1], *table.header])
    stated = last if len(last) == 1 or table.bars else _units(words)
    if len(stated) > 1:
        raise InputError(f"{path}: the header names the units {', '.join(stated)}; give `unit`.")
    waves = _WAVES.search(words)
    if stated and stated[0] in ("um", "mm") and not (waves or table.bars):
        raise InputError(f"{path}: what is in {stated[0]} is not said; give `unit`.")
    if not stated and (waves or table.bars):
        raise InputError(f"{path}: the unit of the frequencies is missing; give `unit`.")
    return stated[0] if stated else None


def to_GHz(
    path: Path, samples: Float[np.ndarray, "2 sample"], unit: str
) -> Float[np.ndarray, "2 sample"]:
    """Frequencies, wavenumbers or wavelengths with their weights, as frequencies in GHz."""
    known = _known(unit)
    if known not in _UNITS:
        raise InputError(
            f"{path}: the frequencies' unit is {unit!r}, not one of {', '.join(_UNITS)}."
        )
    with np.errstate(divide="ignore"):
        nu = u.Quantity(samples[0], known).to_value(u.GHz, equivalencies=u.spectral())
    falls = u.Unit(known).physical_type == "length"
    return np.array([nu, samples[1]])[:, :: -1 if falls else 1]


def check_plausible(path: Path, center: float, unit: str | None) -> None:
    """Raise InputError if the middle of a band [GHz] shows that its unit is another one."""
    low, high = _BARE if unit is None else _STATED
    if not low <= center <= high:
        asked = "" if unit else "; give `unit`, such as MHz or THz, or GHz if it is right"
        raise InputError(
            f"{path}: in {unit or 'GHz'}, the middle of the band is at {center:g} GHz, outside of "
            f"{low:g} to {high:g} GHz{asked}."
        )
