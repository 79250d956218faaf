"""Bandpasses in files: Planck RIMO (FITS), IPAC tables and plain text."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from astropy.io import fits as pyfits

from jaxsky.bandpass import CONVENTIONS, Bandpass
from jaxsky.constants import GHZ_PER_INVERSE_CM
from jaxsky.io.tables import InputError, open_fits, select_hdu

__all__ = ["read_bandpass"]

#: Frequencies [GHz] and weights of a table.
Samples: TypeAlias = tuple[np.ndarray, np.ndarray]

#: Unit of a RIMO's WAVENUMBER -> (factor to GHz, convention). The LFI column holds frequencies,
#: and its weights act on antenna temperature; those of HFI act on power.
_RIMO = {"GHz": (1.0, "RJ"), "1/cm": (GHZ_PER_INVERSE_CM, "power")}
_FREQUENCIES = {"Hz": 1e-9, "MHz": 1e-3, "GHz": 1.0, "THz": 1e3}
_COMMENTS = ("#", ";", "%", "!", "\\", "|", "//", "*")


def _checked(path: Path, nu: np.ndarray, weights: np.ndarray) -> Samples:
    """The samples at positive frequencies; raises InputError if they are no bandpass."""
    if bad := int(np.sum(~np.isfinite(nu) | ~np.isfinite(weights))):
        raise InputError(f"{path}: {bad} of {nu.size} samples of the bandpass are not finite.")
    nu, weights = nu[nu > 0], weights[nu > 0]
    if not nu.size:
        raise InputError(f"{path}: the bandpass has no sample at a positive frequency.")
    if np.any(steps := np.diff(nu) <= 0):
        at = int(np.argmax(steps))
        raise InputError(
            f"{path}: frequencies of a bandpass must increase, "
            f"but {nu[at + 1]:g} follows {nu[at]:g} GHz."
        )
    integral = np.trapezoid(weights, nu) if nu.size > 1 else weights[0]
    if not integral > 0:
        raise InputError(f"{path}: the integral of the bandpass is not positive.")
    return nu, weights


def _merged(nu: np.ndarray, weights: np.ndarray) -> Samples:
    """Neighbours that share a frequency, as single precision makes some do, as their mean."""
    first = np.concatenate([[True], np.diff(nu) != 0])
    starts = np.flatnonzero(first)
    counts = np.diff(np.append(starts, nu.size))
    return nu[starts], np.add.reduceat(weights, starts) / counts


def _rimo_samples(path: Path, hdus: pyfits.HDUList, name: str) -> tuple[Samples, str]:
    tables = [select_hdu(path, hdus, i) for i, h in enumerate(hdus) if h.name == name]
    for column in ("WAVENUMBER", "TRANSMISSION"):
        if column not in tables[0].columns.names:
            known = ", ".join(tables[0].columns.names)
            raise InputError(f"{path}, HDU {name!r}: no column {column!r}; it has {known}.")
    data = [
        [np.array(t.data.field(c), np.float64) for c in ("WAVENUMBER", "TRANSMISSION")]
        for t in tables
    ]
    if not all(np.array_equal(data[0], other) for other in data[1:]):
        raise InputError(f"{path}: {len(tables)} HDUs are named {name!r} and differ.")
    unit = str(tables[0].columns["WAVENUMBER"].unit)
    if unit not in _RIMO:
        raise InputError(
            f"{path}, HDU {name!r}: WAVENUMBER has the unit {unit!r}, not {' or '.join(_RIMO)}."
        )
    scale, convention = _RIMO[unit]
    samples = _merged(data[0][0] * scale, data[0][1])
    return _checked(path, *samples), convention


def _rimo_names(
    path: Path, names: Sequence[str], band: str | None, detectors: Sequence[str] | None
) -> list[str]:
    """Names of the HDUs of a band average, or of its detectors."""
    wanted = None if band is None else str(band).upper().lstrip("F0")
    averages, single = {}, {}
    for name in names:
        key, _, detector = name.upper().removeprefix("BANDPASS_").partition("-")
        key = key.lstrip("F0")
        if detector and wanted in (None, key):
            single[detector] = name
        elif not detector:
            averages[key] = name
    if detectors is not None:
        asked = [str(d).upper().removeprefix("LFI") for d in detectors]
        if not asked:
            raise InputError(f"{path}: argument `detectors` is empty.")
        for detector in asked:
            if detector not in single:
                where = "" if band is None else f" in band {band}"
                known = ", ".join(single) or "none"
                raise InputError(f"{path}: no detector {detector!r}{where}; it has {known}.")
        return [single[detector] for detector in asked]
    if wanted is None or wanted not in averages:
        problem = "give `band`" if wanted is None else f"no band {str(band)!r}"
        raise InputError(f"{path}: {problem}; it has {', '.join(averages)}.")
    return [averages[wanted]]


def _mean(tables: Sequence[Samples]) -> Samples:
    """Mean of several detectors, each normalised to unit integral, on all their frequencies."""
    if len(tables) == 1:
        return tables[0]
    grid = np.unique(np.concatenate([nu for nu, _ in tables]))
    curves = [np.interp(grid, nu, w / np.trapezoid(w, nu), left=0.0, right=0.0) for nu, w in tables]
    return grid, np.mean(curves, axis=0)


def _read_rimo(
    path: Path, band: str | None, detectors: Sequence[str] | None
) -> tuple[Samples, str]:
    with open_fits(path) as hdus:
        known = list(dict.fromkeys(h.name for h in hdus if h.name.startswith("BANDPASS_")))
        if not known:
            raise InputError(f"{path}: no HDU is named BANDPASS_...; not an instrument model.")
        found = [
            _rimo_samples(path, hdus, name) for name in _rimo_names(path, known, band, detectors)
        ]
    return _mean([samples for samples, _ in found]), found[0][1]


def _read_text(path: Path) -> tuple[Samples, str | None]:
    """The first two columns of a table; an IPAC table's header gives the frequency's unit."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: neither a FITS file nor a text table.") from None
    bars = [line for line in lines if line.startswith("|")]
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith(_COMMENTS):
            continue
        try:
            nu, weight = (float(cell) for cell in line.replace(",", " ").split()[:2])
        except ValueError:
            if not rows:  # names of the columns
                continue
            raise InputError(f"{path}, line {number}: not two numbers: {line.strip()!r}.") from None
        rows.append((nu, weight))
    if not rows:
        raise InputError(f"{path}: no line has two numbers, frequency [GHz] and weight.")
    samples = np.array(rows).T
    if not bars:
        return _checked(path, *samples), None
    unit = bars[2].split("|")[1].strip() if len(bars) > 2 else ""
    if unit not in _FREQUENCIES:
        raise InputError(
            f"{path}: the frequencies' unit is {unit!r}, not one of {', '.join(_FREQUENCIES)}."
        )
    return _checked(path, samples[0] * _FREQUENCIES[unit], samples[1]), "power"


def read_bandpass(
    path: str | Path,
    band: str | int | None = None,
    *,
    detectors: Sequence[str] | None = None,
    convention: str | None = None,
    trim: float = 0.0,
) -> Bandpass:
    r"""The bandpass of a band or of some detectors, from a file.

    * Planck instrument models (RIMO, FITS): `band` is "30" or "044" for LFI, in convention "RJ";
      "100", "353" for HFI, "power". "PSB353" is the average of the polarization-sensitive
      bolometers only, the one for maps of Q and U. `detectors=("24M", "24S")` averages single
      detectors instead, each normalised to unit integral. Samples that HFI flags as interpolated
      over CO lines are used like the others.
    * IPAC tables (WMAP), with the frequency's unit from their header: convention "power".
    * Text with two columns, frequency [GHz] and weight, separated by blanks or commas; comments
      start with # ; % ! \ | // or *. Such a file does not say its convention, so it has to be
      given.

    Samples at nu <= 0 are dropped.

    Parameters
    ----------
    path : FITS, IPAC or text file
    band : band of a RIMO
    detectors : detectors of a RIMO
    convention : "RJ", "power" or "CMB" (`Bandpass`), where the format's is not right
    trim : cut both ends of the band up to where the weight exceeds this fraction of the largest.
        HFI tables have 12 000 to 17 000 samples up to 18 THz; 1e-6 leaves 360 to 5 400 and
        changes the factors from K_CMB to MJy/sr by less than 5e-6 (1e-4: by up to 8e-4).

    Raises
    ------
    InputError
        If the file is missing or damaged; band or detector is not found; frequencies do not
        increase, values are not finite, or the integral is not positive; the convention is
        missing.
    ValueError
        If `convention` or `trim` is no valid value.
    """
    path = Path(path)
    if convention is not None and convention not in CONVENTIONS:
        known = ", ".join(CONVENTIONS)
        raise ValueError(f"Argument `convention` must be one of {known}, not {convention!r}.")
    if not 0 <= trim < 1:
        raise ValueError(f"Argument `trim` must be within [0, 1), but is {trim}.")
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    with path.open("rb") as stream:
        start = stream.read(6)
    found: str | None
    if start == b"SIMPLE" or start.startswith(b"\x1f\x8b"):
        (nu, weights), found = _read_rimo(path, None if band is None else str(band), detectors)
    elif band is not None or detectors is not None:
        raise InputError(f"{path}: a text table has one band; leave out `band` and `detectors`.")
    else:
        (nu, weights), found = _read_text(path)
    if (convention := convention or found) is None:
        known = ", ".join(CONVENTIONS)
        raise InputError(f"{path}: the file does not say it; give `convention`, one of {known}.")
    if trim:
        inside = np.flatnonzero(weights > trim * weights.max())
        nu, weights = (x[inside[0] : inside[-1] + 1] for x in (nu, weights))
    return Bandpass(nu, weights, convention)
