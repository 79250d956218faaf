"""Read the noise named in the settings: a level, or a covariance of each pixel where known."""

from pathlib import Path

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsky.arrays import stokes_rows
from jaxsky.bandpass import Bandpass
from jaxsky.checks import listed
from jaxsky.inputs import narrow, read
from jaxsky.io import unit_factor
from jaxsky.io.columns import stokes_of
from jaxsky.noise import (
    COVARIANCE_COLUMNS,
    check_covariance,
    covariance_from_columns,
    hits_covariance,
    rms_covariance,
    weights_covariance,
)
from jaxsky.settings import MapFile, NoiseTable, SeenKeys, SettingsError, at_key

#: Noise outside this range, relative to the rms of its map, is refused unless confirmed.
PLAUSIBLE = (1e-6, 10.0)


def read_noise(
    folder: Path,
    own: SeenKeys,
    at: Bandpass | float | None,
    nside: int,
    where: str,
    unit: str,
    stokes: str = "QU",
    *,
    maps: Float[Array, "stokes pix"] | None = None,
    used: Bool[np.ndarray, " pix"] | None = None,
) -> tuple[Array | float, Bool[np.ndarray, " pix"]]:
    """Return the noise in the table of a map, and where it is known (not in pixels without hits).

    The noise is a level [uK_RJ arcmin] if the settings give numbers, or one for each Stokes
    parameter where they differ, else the covariance of each pixel [uK_RJ^2], 0 where it is unknown.

    `at` is the frequency [GHz] or band of the map. Level, rms and sigma0 are in the map's `unit`
    unless the noise has its own; the map's `own` table may name a file with columns of noise. The
    noise is checked against the rms of `maps` [uK_RJ] in `used` pixels. `where` is the settings
    key.
    """
    noise = own.noise
    assert noise is not None  # callers have checked
    unit = noise.unit or unit
    found: Array | float
    with at_key(where):
        factor, pixel = unit_factor(unit, "uK_RJ", at), healpy.nside2resol(nside, arcmin=True)
        if isinstance(noise.rms, float):
            levels = [noise.rms * pixel]
        else:
            levels = [level for s in stokes if (level := noise.level_of(s)) is not None]
        if not levels:
            pixels, known = _covariance(folder, own, at, nside, stokes, where, factor)
            check_covariance("noise", pixels if known.all() else pixels[..., known])
            found = pixels if known.all() else jnp.where(known, pixels, 0.0)
        else:
            known = np.ones(healpy.nside2npix(nside), bool)
            alike = len(set(levels)) == 1
            found = float(levels[0] * factor) if alike else jnp.asarray(levels) * factor
    if maps is not None and not noise.plausible:
        inside = known if used is None else known & used
        _check_plausible(where, found, maps, inside, factor, unit)
    return found, known


def _check_plausible(where, noise, maps, inside, factor, unit):
    """Refuse noise of a Stokes parameter that is far from the rms of the map."""
    if not inside.any():
        return
    rms = np.sqrt(np.mean(np.square(np.asarray(maps)[:, inside], dtype=float)))
    low, high = (limit * rms for limit in PLAUSIBLE)
    if np.ndim(noise) > 1:
        variances = [
            np.mean(np.asarray(row[s])[inside], dtype=float) for s, row in enumerate(noise)
        ]
    else:
        pixel = healpy.nside2resol(healpy.npix2nside(inside.size), arcmin=True)
        variances = np.square(np.atleast_1d(noise) / pixel)
    for own in np.sqrt(variances):
        if rms and not low <= own <= high:
            raise SettingsError(
                f"{where}: the noise of a pixel is {own / factor:.3g} {unit} (rms), but the rms of "
                f"the map in the same pixels is {rms / factor:.3g} {unit}; noise is in the map's "
                'unit where it has none of its own. Write "plausible = true" if this is meant.'
            )


def _covariance(folder, own, at, nside, stokes, where, factor):
    """Return a covariance as in `read_noise`, with arbitrary values where it is not known."""
    n, (kind,) = len(stokes), own.noise.changed(own.noise.KINDS)

    def rows(number: int) -> slice:
        """Return those of the Stokes parameters among one for all, one each, or I, Q, U."""
        return stokes_rows(stokes) if number == 3 else slice(number)

    spec, where = getattr(own.noise, kind), f"{where}.{kind}"
    found = _read_columns(folder, own, spec, kind, where)
    if found.nside != nside:
        raise SettingsError(f"{where}: nside is {found.nside}, but that of the map is {nside}.")
    given, known = found.unit, np.asarray(found.mask)
    maps = narrow(found.maps)
    del found  # as large as everything else
    if kind == "rms":
        _check_number(f"{where}.fields", len(maps), stokes)
        rms = maps[rows(len(maps))] * unit_factor(given, "uK_RJ", at)
        return rms_covariance(jnp.broadcast_to(rms, (n, rms.shape[-1]))), known
    if kind == "covariance":
        needed = COVARIANCE_COLUMNS[n * (n + 1) // 2]
        if len(maps) not in (len(needed), 6):
            raise SettingsError(f"{where}: {listed(stokes)} need columns {', '.join(needed)}.")
        found = covariance_from_columns(maps * unit_factor(given, "uK_RJ^2", at))
        return found[rows(len(found)), rows(len(found))], known
    if given:
        raise SettingsError(f"{where}.unit: {kind} are pure numbers, but are said to be {given}.")
    _check_number(f"{where}.sigma0", len(spec.sigma0), stokes)
    sigma0 = jnp.array(spec.sigma0, maps.dtype)[rows(len(spec.sigma0))] * factor
    sigma0 = jnp.broadcast_to(sigma0, (n,))
    if kind == "weights":
        if n != 2:
            raise SettingsError(f"{where}: weights are those of Q and U, not of {stokes}.")
        known = known & np.asarray(maps[0] * maps[2] > 0)
        nothing = jnp.array([1.0, 0.0, 1.0], maps.dtype)[:, None]
        return weights_covariance(sigma0, jnp.where(known, maps, nothing)), known
    known = known & np.asarray(maps[0] != 0)
    return hits_covariance(sigma0, jnp.where(known, maps[0], 1.0), n), known


def _read_columns(folder, own, spec, kind, where):
    """Read the columns of a kind of noise, from the map's file if they have none of their own."""
    said = spec.model_dump(exclude={"sigma0"}, exclude_none=True)
    unit = own.noise.unit
    # Hits and weights are numbers, whatever the header calls them.
    implied = {"rms": unit, "covariance": unit and f"{unit}^2"}.get(kind, "")
    if implied is not None:
        said.setdefault("unit", implied)
    if spec.file is None:
        if own.file is None:
            raise SettingsError(f"{where}: file is missing.")
        if len(own.files) > 1 or (isinstance(own.hdu, list) and spec.hdu is None):
            raise SettingsError(f"{where}: the map has several files or HDUs; give file and hdu.")
        taken = {"file", "hdu", "ordering", "coordinates", "polarization"}
        said = own.model_dump(include=taken, exclude_none=True) | said
    columns = MapFile(**said)
    tables = max(len(columns.files), len(columns.hdu) if isinstance(columns.hdu, list) else 1)
    fields = columns.fields or []
    number = max(tables, len(fields))
    if kind == "rms" and not fields and tables == 1:
        number = len(read(folder, columns).names)
    wanted = NoiseTable.COLUMNS.get(kind, {}).get(number, ())
    named = [stokes_of(name) if isinstance(name, str) else None for name in fields]
    if any(s is not None and w not in (s, s * 2) for s, w in zip(named, wanted, strict=False)):
        expected = ", ".join(w[0] if kind == "rms" else w for w in wanted)
        raise SettingsError(
            f"{where}.fields: {', '.join(map(str, fields))} are not {expected} by their names."
        )
    return read(folder, columns, stokes=wanted or "")


def _check_number(where: str, number: int, stokes: str) -> None:
    """Refuse a number of values other than one, one per Stokes parameter, or three."""
    if number not in (1, len(stokes), 3):
        raise SettingsError(f"{where}: one or {len(stokes)} are needed, not {number}.")
