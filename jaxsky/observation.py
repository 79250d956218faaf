"""The inputs of a simulation: components, bands with beams and noise, pixels, and instruments."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsky.arrays import STOKES, Beam, Covariance, Scalar
from jaxsky.bandpass import Bandpass
from jaxsky.checks import (
    Printed,
    check_choice,
    check_names,
    check_not_negative,
    check_nside,
    check_type,
    shown,
)
from jaxsky.components import Component
from jaxsky.public import packaged, takes_quantities
from jaxsky.small_scales import SmallScales

#: Floating-point types by the name of their precision.
DTYPES: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}


class Source(eqx.Module):
    """A component of the sky at the resolution of its template.

    Parameters
    ----------
    component : template and law; I, or Q, U, or I, Q, U
    fwhm : beam of the template [arcmin]
    small_scales : how the template is continued to small scales; None leaves it unchanged
    correlated_with : name of a source with which the small scales are correlated
    """

    component: Component
    fwhm: Scalar | float = 0.0
    small_scales: SmallScales | None = None
    correlated_with: str | None = eqx.field(static=True, default=None)


class ObservedBand(Printed, eqx.Module):
    """How a band is observed.

    Parameters
    ----------
    band : the bandpass
    beam : FWHM of a Gaussian [arcmin], or a table b_l
    target : beam to which the observed map is smoothed [arcmin]; None leaves it as observed
    noise : uniform level [uK_RJ arcmin], or levels (stokes,); covariance of each pixel [uK_RJ^2],
        shape (stokes, stokes, pix); or None
    diagonal : draw noise with the diagonal of the Cholesky factor only (`noise.draw`)

    Raises
    ------
    ValueError
        If a beam, the target or the level of the noise is negative or not finite.
    """

    band: Bandpass
    beam: Beam
    target: Scalar | float | None = None
    noise: Scalar | Covariance | float | None = None
    diagonal: bool = eqx.field(static=True, default=False)

    def __post_init__(self) -> None:
        for name in ("beam", "target", "noise"):
            if (value := getattr(self, name)) is not None:
                check_not_negative(name, value)

    def summary(self):
        beam, noise = self.beam, "none" if self.noise is None else "a covariance"
        if self.noise is not None and jnp.ndim(self.noise) < 2:
            levels = jnp.unique(jnp.atleast_1d(self.noise))
            noise = ", ".join(shown(level, "uK_RJ arcmin") for level in levels)
        rows = [
            ("center", shown(self.band.center, "GHz")),
            ("width", shown(self.band.nu[-1] - self.band.nu[0], "GHz")),
            ("beam", "a table b_l" if jnp.ndim(beam) else shown(beam, "arcmin")),
            ("noise", noise),
        ]
        return "Observed band", rows

    @property
    def map_beam(self) -> Beam:
        """Beam of the observed map: the target if there is one, else the band's own."""
        return self.beam if self.target is None else self.target


class Observation(eqx.Module):
    """An experiment: channels by name, and the pixels of the maps.

    Parameters
    ----------
    channels : by name, in order
    nside : resolution of the maps, a power of 2
    stokes : "QU", "I" or "IQU"
    finest : beam to which small scales are made [arcmin], at most the finest one observed
    lmax : largest multipole of the sky in the maps, by default 2 nside
    precision : "double" or "single", in which the maps are computed; single takes half the memory
        and rounds to 1e-7 of a map's rms

    Raises
    ------
    ValueError
        If there is no channel, `nside` is no power of 2, or `stokes` or `precision` is unknown.
    """

    channels: dict[str, ObservedBand]
    nside: int = eqx.field(static=True)
    stokes: str = eqx.field(static=True, default="QU")
    finest: Scalar | float = 0.0
    lmax: int = eqx.field(static=True, default=None)
    precision: str = eqx.field(static=True, default="double")
    names: tuple[str, ...] = eqx.field(static=True, init=False)

    def __post_init__(self) -> None:
        check_nside("nside", self.nside)
        # JAX sorts dictionaries when it flattens them, so `names` keeps the order.
        self.channels, self.names = dict(self.channels), tuple(self.channels)
        if self.lmax is None:
            self.lmax = 2 * self.nside
        if not self.channels:
            raise ValueError("Argument `channels` must have at least one channel.")
        check_choice("stokes", self.stokes, STOKES.values())
        check_choice("precision", self.precision, DTYPES)

    @property
    def dtype(self) -> type[np.floating]:
        """Floating-point type of maps and coefficients."""
        return DTYPES[self.precision]

    @property
    def bands(self) -> tuple[Bandpass, ...]:
        """The bandpasses in order."""
        return tuple(self.channels[name].band for name in self.names)


def check_sources(sources: Mapping[str, Source], observation: Observation) -> None:
    """Raise TypeError or ValueError unless the components can be observed together."""
    check_type("Argument `sources`", sources, Mapping, "a dictionary of Source")
    for name, source in sources.items():
        check_type(f"Component {name!r}", source, Source, "a Source")
        rows, wanted = len(source.component.template), observation.stokes
        if rows != len(wanted):
            raise ValueError(
                f"Component {name!r} has {rows} Stokes parameters, but {wanted} are observed."
            )
        if source.small_scales is not None and rows != 2:
            raise ValueError(
                f"Component {name!r} has small scales, which are added to Q and U only; observe "
                "stokes 'QU'."
            )
        leader = source.correlated_with
        if leader is not None and (
            leader not in sources
            or leader == name
            or sources[leader].small_scales is None
            or sources[leader].correlated_with is not None
            or source.small_scales is None
        ):
            raise ValueError(
                f"The small scales of {name!r} are to be correlated with those of {leader!r}: "
                "both need to be components with small scales, and the second one must not be "
                "correlated with yet another."
            )


class Instrument(Printed, dict[str, ObservedBand]):
    """The channels of an instrument by name, which print as a table.

    A channel is found by its name, or, where that is a whole number, by the number.

    Parameters
    ----------
    title : name of the instrument
    channels : by name, in order
    noise_I : uniform level of the noise of I [uK_RJ arcmin] of the channels where it is known and
        not that of the channel itself, `ObservedBand.noise`, which is of Q and U by default
    sky_fraction : of the survey, or None
    """

    def __init__(
        self,
        title: str,
        channels: Mapping[str, ObservedBand],
        *,
        noise_I: Mapping[str, Scalar | float] | None = None,
        sky_fraction: float | None = None,
    ) -> None:
        super().__init__(channels)
        self.title, self.noise_I, self.sky_fraction = title, dict(noise_I or {}), sky_fraction

    def __missing__(self, name: object) -> ObservedBand:
        if isinstance(name, int | np.integer) and str(name) in self:
            return self[str(name)]
        raise KeyError(f"{self.title} has no channel {name!r}; it has {', '.join(self)}.")

    @classmethod
    @takes_quantities
    def from_table(
        cls,
        table: Any,
        title: str | None = None,
        *,
        stokes: str = "QU",
        target: Array | float | None = None,
        samples: int = 51,
    ) -> "Instrument":
        """Return the instrument that a table describes, as `load_instrument` does.

        Parameters
        ----------
        table : columns by name, rows, or the name of a file; `jaxsky.io.instruments` says which
            columns, among them those of FGBuster and of litebird_sim
        title : by default that of the table, or the name of its file
        stokes, target, samples : see `load_instrument`

        Raises
        ------
        InputError, TypeError, ValueError
            One sentence with the column and the value that cannot be used.

        Examples
        --------
        >>> table = {"frequency": [30.0, 150.0], "width": [9.0, 40.0], "fwhm": [70.0, 15.0]}
        >>> mine = Instrument.from_table(table | {"depth_p": [20.0, 3.0]}, "Mine")
        >>> list(mine), f"{mine[150].band.center:.1f}"
        (['30', '150'], '150.0')
        """
        from jaxsky.io.instruments import read_instrument  # astropy, which takes its time

        check_choice("stokes", stokes, STOKES.values())
        found = read_instrument(table)
        for band in found["bands"]:
            _check_simple(band)
        about = found | {"title": title or found["title"] or "from a table"}
        return _built(about, found["bands"], stokes, target, samples)

    def bands(self) -> OrderedDict[str, Bandpass]:
        """Return the bandpasses by name; JAX keeps the order of this kind of dictionary."""
        return OrderedDict((name, channel.band) for name, channel in self.items())

    def summary(self):
        table = [dict(channel.summary()[1]) for channel in self.values()]
        rows = [(name, *row.values()) for name, row in zip(self, table, strict=True)]
        head: tuple[str, ...] = ("channel", *table[0])
        if self.noise_I:
            levels = {name: shown(level, "uK_RJ arcmin") for name, level in self.noise_I.items()}
            head = (*head, "noise of I")
            rows = [(*row, levels.get(row[0], "unknown")) for row in rows]
        part = self.sky_fraction
        sky = "" if part in (None, 1) else f", {100 * part:.3g} % of the sky"
        return f"Instrument {self.title}{sky}", [head, *rows]


def load_instrument(
    name: str,
    channels: Sequence[str] | None = None,
    *,
    stokes: str = "QU",
    target: Array | float | None = None,
    samples: int = 51,
) -> Instrument:
    """Return the channels of an instrument by name, as `Observation` takes them.

    Each has a top-hat band, a Gaussian beam and white noise [uK_RJ arcmin]. The numbers are from
    `instruments.toml`, which gives the source of each. For an instrument of one's own see
    `Instrument.from_table`.

    Parameters
    ----------
    name : "planck", "wmap", "core", "litebird", "litebird-arrays" (its 22 arrays), "so-sat",
        "so-sat-goal", "so-lat", "so-lat-goal" (Simons Observatory), "pico", "cmb-s4-sat",
        "cmb-s4-lat", "bicep-keck", "advact", "spt-3g" or "s-pass"
    channels : names of the channels wanted, in this order; by default all that observe `stokes`
    stokes : what is observed, "QU", "I" or "IQU", of which the noise is; that of I is taken to be
        that of Q and U where it was not published. Planck's 545 and 857 GHz observe I alone.
    target : common beam of the maps [arcmin]; None keeps the beam of each
    samples : number of samples per band; see `Bandpass.top_hat`

    Raises
    ------
    KeyError
        If a name is unknown; the message lists the known ones.
    TypeError, ValueError
        If `channels` is a string or names one without polarization where that is wanted, `stokes`
        is unknown, or the target negative or not finite.

    Examples
    --------
    >>> planck = load_instrument("planck", ["353", "30"])
    >>> list(planck), f"{planck['353'].band.center:.1f}"
    (['353', '30'], '361.3')
    """
    presets = packaged("instruments.toml")
    if name not in presets:
        raise KeyError(f"Unknown instrument {name!r}; known are {', '.join(presets)}.")
    check_names("channels", channels)
    check_choice("stokes", stokes, STOKES.values())
    preset = presets[name]
    tables = _chosen(name, preset["bands"], channels)
    for table in tables if channels is not None and stokes != "I" else ():
        if _levels(table)[1] is None:
            raise ValueError(
                f"{name}: channel {table['name']!r} has no polarization; choose stokes 'I', or "
                "leave it out."
            )
    return _built(preset, tables, stokes, target, samples)


def _built(
    about: Mapping[str, Any],
    tables: Sequence[Mapping[str, Any]],
    stokes: str,
    target: Array | float | None,
    samples: int,
) -> Instrument:
    """Return an instrument with those of the bands that observe some Stokes parameters.

    The bands are tables as in `instruments.toml`.
    """
    found, intensity = {}, {}
    for table in tables:
        name, (of_I, of_P) = str(table["name"]), _levels(table)
        if of_P is None and stokes != "I":
            continue
        band = _bandpass(samples, **table["bandpass"])
        factor = band.conversion(table["noise"].get("unit", "uK_CMB"), "uK_RJ")
        beam, level = jnp.asarray(table["fwhm"]), of_P
        if stokes == "QU" and of_I is not None:
            intensity[name] = of_I * factor
        elif of_I is not None:
            level = of_I if stokes == "I" else jnp.array([of_I, of_P, of_P])
        found[name] = ObservedBand(band, beam, target, level * factor)
    if not found:
        raise ValueError(f"{about['title']}: no channel has polarization; choose stokes 'I'.")
    sky = about.get("sky_fraction")
    return Instrument(about["title"], found, noise_I=intensity, sky_fraction=sky)


def _levels(table: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the levels of noise of I and of Q and U of a band in its unit, None if not known."""
    level = table["noise"]["level"]
    if isinstance(level, list | tuple):
        return level[0], level[1] if len(level) > 1 else None
    return table.get("noise_I"), level


def _check_simple(band: Mapping[str, Any]) -> None:
    """Raise ValueError unless a band says its top-hat, Gaussian beam and level of noise itself."""
    keys = {key: set(band[key]) for key in ("bandpass", "noise") if isinstance(band.get(key), dict)}
    good = set(band) - {"noise_I"} == {"name", "bandpass", "fwhm", "noise"} and len(keys) == 2
    if not good or keys["bandpass"] != {"center", "width"} or keys["noise"] - {"unit"} != {"level"}:
        raise ValueError(
            f"Band {band['name']!r} must have bandpass = {{ center, width }}, fwhm and noise = "
            "{ level, unit }, and nothing else; other bands are for experiment files."
        )


def _bandpass(samples: int, center: float, width: float = 0.0) -> Bandpass:
    return Bandpass.top_hat(center, width, samples=samples) if width else Bandpass.delta(center)


def _chosen(
    name: str, bands: Sequence[dict[str, Any]], channels: Sequence[str] | None
) -> list[dict[str, Any]]:
    """Return the tables of some bands of an instrument, by default of all."""
    known = {str(band["name"]): band for band in bands}
    for channel in channels or ():
        if channel not in known:
            raise KeyError(f"{name} has no channel {channel!r}; it has {', '.join(known)}.")
    return [known[channel] for channel in channels or known]


def band_tables(
    name: str, channels: Sequence[str] | None = None, folder: Path = Path()
) -> list[dict[str, Any]]:
    """Return bands of a preset, or of a file in a folder, as tables of an experiment file.

    The file is one that `Instrument.from_table` reads, or has bands of an experiment file.
    """
    presets, path = packaged("instruments.toml"), folder / name
    if name in presets:
        bands = presets[name]["bands"]
    elif path.is_file():
        from jaxsky.io.instruments import read_instrument  # astropy, which takes its time

        bands = read_instrument(path)["bands"]
    else:
        raise KeyError(f"Unknown instrument {name!r}; known are {', '.join(presets)}, or a file.")
    return _chosen(name, bands, channels)
