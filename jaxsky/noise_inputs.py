"""The noise that settings state, read: a level or a covariance of each pixel, where it is known."""

from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxsky.bandpass import Bandpass
from jaxsky.checks import as_array, check_finite, check_shape, is_concrete
from jaxsky.inputs import narrow, read
from jaxsky.io import Maps, unit_factor
from jaxsky.io.columns import stokes_of
from jaxsky.noise import cholesky
from jaxsky.settings import (
    ColumnKeys,
    MapFile,
    MapKeys,
    NoiseColumns,
    NoiseTable,
    SettingsError,
    at_key,
)

#: Noise outside of this range, relative to the rms of its map, is a mistake unless it is meant.
PLAUSIBLE = (1e-6, 10.0)
#: Pixels that are checked at once.
_PIECE = 1 << 20
#: Columns of a covariance by their number, in the order of Planck's maps.
_COLUMNS = {3: ("QQ", "QU", "UU"), 6: ("II", "IQ", "IU", "QQ", "QU", "UU")}


def read_noise(
    folder: Path,
    noise: NoiseTable,
    at: Bandpass | float | None,
    nside: int,
    where: str,
    unit: str,
    stokes: str = "QU",
    *,
    own: MapKeys | None = None,
    maps: Float[Array, "stokes pix"] | None = None,
    used: Bool[np.ndarray, " pix"] | None = None,
) -> tuple[Array | float, Bool[np.ndarray, " pix"]]:
    """Noise of a map, and where it is known (not without hits).

    It is a level [uK_RJ arcmin] where the settings give a number, else the covariance of each pixel
    [uK_RJ^2], 0 where it is not known.

    The map that has the noise is `at` a frequency [GHz] or in a band. Its `unit` is that of level,
    rms and sigma0 unless the noise has its own; `own` is its file, in which columns may be; against
    the rms of its `maps` [uK_RJ] in `used` pixels the noise is checked. `where` is the key.
    """
    unit = noise.unit or unit
    found: Array | float
    with at_key(where):
        pixel = healpy.nside2resol(nside, arcmin=True)
        level = noise.rms * pixel if isinstance(noise.rms, float) else noise.level
        if level is None:
            pixels, known = _covariance(folder, noise, at, nside, stokes, where, unit, own)
            check_covariance("noise", pixels if known.all() else pixels[..., known])
            found = pixels if known.all() else jnp.where(known, pixels, 0.0)
        else:
            found = float(level * unit_factor(unit, "uK_RJ", at))
            known = np.ones(healpy.nside2npix(nside), bool)
    if maps is not None and not noise.plausible:
        factor = float(unit_factor(unit, "uK_RJ", at))
        inside = known if used is None else known & used
        _check_plausible(where, found, maps, inside, factor, unit)
    return found, known


def _check_plausible(where, noise, maps, inside, factor, unit):
    """Refuse noise of a Stokes parameter that is far from the rms of the map."""
    if not inside.any():
        return
    rms = np.sqrt(np.mean(np.square(np.asarray(maps)[:, inside], dtype=float)))
    low, high = (limit * rms for limit in PLAUSIBLE)
    if np.ndim(noise):
        variances = [
            np.mean(np.asarray(row[s])[inside], dtype=float) for s, row in enumerate(noise)
        ]
    else:
        variances = [(noise / healpy.nside2resol(healpy.npix2nside(inside.size), arcmin=True)) ** 2]
    for own in np.sqrt(variances):
        if rms and not low <= own <= high:
            raise SettingsError(
                f"{where}: the noise of a pixel is {own / factor:.3g} {unit} (rms), but the rms of "
                f"the map in the same pixels is {rms / factor:.3g} {unit}; noise is in the map's "
                'unit where it has none of its own. Write "plausible = true" if this is meant.'
            )


def _covariance(folder, noise, at, nside, stokes, where, unit, own):
    """See `read_noise`; with any values where the covariance is not known."""
    n, npix = len(stokes), 12 * nside**2
    kind = next(
        k for k in ("rms", "covariance", "hits", "weights") if getattr(noise, k) is not None
    )
    spec, where = getattr(noise, kind), f"{where}.{kind}"
    if noise.unit and spec.unit is None and kind in ("rms", "covariance"):
        squared = "^2" if kind == "covariance" else ""
        spec = spec.model_copy(update={"unit": noise.unit + squared})
    found = _read_columns(folder, _file(spec, own, kind, where), kind, where)
    if found.nside != nside:
        raise SettingsError(f"{where}: nside is {found.nside}, but that of the map is {nside}.")
    given, known = found.unit, np.asarray(found.mask)
    maps = narrow(found.maps)
    del found  # as large as all else
    if kind == "rms":
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
    sigma0 = jnp.array(spec.sigma0, maps.dtype)[-n:] * float(unit_factor(unit, "uK_RJ", at))
    sigma0 = jnp.broadcast_to(sigma0, (n,))
    if kind == "weights":
        if n != 2:
            raise SettingsError(f"{where}: weights are those of Q and U, not of {stokes}.")
        known = known & np.asarray(maps[0] * maps[2] > 0)
        nothing = jnp.array([1.0, 0.0, 1.0], maps.dtype)[:, None]
        return weights_covariance(sigma0, jnp.where(known, maps, nothing)), known
    known = known & np.asarray(maps[0] != 0)
    return hits_covariance(sigma0, jnp.where(known, maps[0], 1.0), n), known


def _read_columns(folder: Path, spec: MapFile, kind: str, where: str) -> Maps:
    """Columns about the noise, with the Stokes parameters that their place in the settings says."""
    tables = max(len(spec.files), len(spec.hdu) if isinstance(spec.hdu, list) else 1)
    fields = spec.fields or []
    number = max(tables, len(fields))
    if kind == "rms" and not fields and tables == 1:
        number = len(read(folder, spec).names)
    six = ("II", "IQ", "IU", "QQ", "QU", "UU")
    pairs: dict[str, dict[int, tuple[str, ...]]] = {
        "rms": {2: ("QQ", "UU"), 3: ("II", "QQ", "UU")},
        "covariance": {3: six[3:], 6: six},
        "weights": {3: six[3:]},
    }
    wanted = pairs.get(kind, {}).get(number, ())
    said = [stokes_of(name) if isinstance(name, str) else None for name in fields]
    if any(s is not None and w not in (s, s * 2) for s, w in zip(said, wanted, strict=False)):
        listed = ", ".join(w[0] if kind == "rms" else w for w in wanted)
        raise SettingsError(
            f"{where}.fields: {', '.join(map(str, fields))} are not {listed} by their names."
        )
    return read(folder, spec, stokes=wanted or "")


def _file(spec: NoiseColumns, own: MapKeys | None, kind: str, where: str) -> MapFile:
    """The columns to read; those without a file are in that of the map."""
    said = spec.model_dump(exclude={"sigma0"}, exclude_none=True)
    if kind in ("hits", "weights"):
        said.setdefault("unit", "")  # a number, whatever the header calls it
    if spec.file is None:
        if own is None:
            raise SettingsError(f"{where}: file is missing.")
        if len(own.files) > 1 or (isinstance(own.hdu, list) and spec.hdu is None):
            raise SettingsError(f"{where}: the map has several files or HDUs; give file and hdu.")
        taken = set(ColumnKeys.model_fields) - {"fields", "unit", "missing"}
        said = own.model_dump(include=taken, exclude_none=True) | said
    return MapFile(**said)


def _check_number(where: str, number: int, stokes: str) -> None:
    """Refuse other numbers than one for all, one for each, or one for I, too."""
    if number not in (1, len(stokes), 3):
        raise SettingsError(f"{where}: one or {len(stokes)} are needed, not {number}.")


def rms_covariance(rms: Float[Array, "stokes pix"]) -> Float[Array, "stokes stokes pix"]:
    """Covariance of each pixel from maps of the rms, without correlations."""
    rms = as_array("rms", rms)
    check_shape("rms", rms, rms.ndim == 2, "have shape (stokes, pix)")
    check_finite("rms", rms)
    if is_concrete(rms) and (bad := int(jnp.sum(rms < 0))):
        raise ValueError(f"Argument `rms` has {bad} of {rms.size} values that are negative.")
    return _diagonal(rms**2)


def hits_covariance(
    sigma0: ArrayLike, hits: Float[Array, " pix"], stokes: int = 2
) -> Float[Array, "stokes stokes pix"]:
    """Covariance of each pixel from the number of observations, sigma_0^2 / hits.

    The noise of one observation, sigma_0, is a number or one for each Stokes parameter; those of
    WMAP's polarization differ a little from those of its intensity.
    """
    sigma0, hits = _each(sigma0, stokes), as_array("hits", hits)
    check_shape("hits", hits, hits.ndim == 1, "have shape (pix,)")
    check_finite("hits", hits)
    if is_concrete(hits) and (bad := int(jnp.sum(hits <= 0))):
        raise ValueError(f"Argument `hits` is not positive in {bad} of {hits.size} pixels.")
    return _diagonal(sigma0[:, None] ** 2 / hits)


def weights_covariance(
    sigma0: ArrayLike, weights: Float[Array, "3 pix"]
) -> Float[Array, "2 2 pix"]:
    """Covariance of Q and U in each pixel from weights QQ, QU, UU: sigma_0^2 times their inverse.

    WMAP's maps have such weights, which like numbers of observations grow with time (Jarosik et
    al. 2011). A pixel whose weights have no inverse gets no finite covariance.
    """
    sigma0, weights = _each(sigma0, 2), as_array("weights", weights)
    check_shape("weights", weights, weights.shape[:-1] == (3,), "have shape (3, pix)")
    QQ, QU, UU = weights
    inverse = jnp.stack([jnp.stack([UU, -QU]), jnp.stack([-QU, QQ])]) / (QQ * UU - QU**2)
    return jnp.outer(sigma0, sigma0)[..., None] * inverse


def _each(sigma0: ArrayLike, stokes: int) -> Float[Array, " stokes"]:
    """The noise of one observation in each Stokes parameter."""
    sigma0 = as_array("sigma0", sigma0)
    good = sigma0.shape in ((), (stokes,))
    check_shape("sigma0", sigma0, good, f"be a number or have shape ({stokes},)")
    check_finite("sigma0", sigma0)
    return jnp.broadcast_to(sigma0, (stokes,))


def _diagonal(variance: Float[Array, "stokes pix"]) -> Float[Array, "stokes stokes pix"]:
    return jnp.eye(len(variance), dtype=variance.dtype)[..., None] * variance


def covariance_from_columns(
    columns: Float[Array, "column pix"], names: Sequence[str] | None = None
) -> Float[Array, "stokes stokes pix"]:
    """Covariance of each pixel from its three elements for Q, U, or six for I, Q, U.

    Their names are "QQ_COV" or "QQ" and so on, I or T; by default they come in the order of
    Planck's maps, QQ, QU, UU or II, IQ, IU, QQ, QU, UU.
    """
    columns = as_array("columns", columns)
    good = columns.ndim == 2 and len(columns) in _COLUMNS
    check_shape("columns", columns, good, "have shape (3, pix) or (6, pix)")
    expected = _COLUMNS[len(columns)]
    given = list(expected if names is None else names)
    pairs = ["".join(sorted(name[:2].upper().replace("T", "I"))) for name in given]
    if sorted(pairs) != sorted(expected):
        raise ValueError(
            f"Argument `names` must be {', '.join(expected)} in any order, "
            f"but is {', '.join(given)}."
        )
    rows = dict(zip(pairs, columns, strict=True))
    stokes = "QU" if len(columns) == 3 else "IQU"
    return jnp.stack([jnp.stack([rows[min(a + b, b + a)] for b in stokes]) for a in stokes])


@jax.jit
def _number_indefinite(covariance: Float[Array, "stokes stokes pix"]) -> Int[Array, ""]:
    """The number of pixels whose covariance is not positive definite."""
    # A root of a negative number is NaN, and NaN is not positive; each pixel is read once.
    pivots = [row[s] for s, row in enumerate(cholesky(covariance.astype(float)))]
    return jnp.sum(~reduce(jnp.logical_and, [(p > 0) & jnp.isfinite(p) for p in pivots]))


def check_covariance(name: str, covariance: Float[Array, "stokes stokes pix"]) -> None:
    """Raise ValueError if the covariance of a pixel is not positive definite; says of how many.

    Only the lower triangle is looked at, as in `draw`. Traced arrays pass.
    """
    good = covariance.ndim == 3 and covariance.shape[0] == covariance.shape[1]
    check_shape(name, covariance, good, "have shape (stokes, stokes, pix)")
    if not is_concrete(covariance):
        return
    npix = covariance.shape[-1]
    pieces = (covariance[..., start : start + _PIECE] for start in range(0, npix, _PIECE))
    if bad := sum(int(_number_indefinite(piece)) for piece in pieces):
        raise ValueError(f"Argument `{name}` is not positive definite in {bad} of {npix} pixels.")
