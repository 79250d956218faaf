"""An experiment as a list of channels: band, beam and noise, with presets as data."""

import tomllib
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxsky.bandpass import Bandpass
from jaxsky.checks import Parameter, as_number, check_positive, is_concrete
from jaxsky.observation import ObservedBand
from jaxsky.printed import Printed, shown
from jaxsky.units import parse_unit


class Channel(Printed, eqx.Module):
    """A channel: a top-hat band [GHz], a Gaussian beam [arcmin], white noise of Q and U.

    The unit of the noise [noise_unit arcmin] is one of temperature in `jaxsky.units`.
    """

    name: str = eqx.field(static=True)
    center: Parameter
    width: Parameter
    fwhm: Parameter
    noise: Parameter
    noise_unit: str = eqx.field(static=True, default="uK_CMB")

    def __post_init__(self) -> None:
        for name in ("center", "width", "fwhm", "noise"):
            setattr(self, name, as_number(name, getattr(self, name), positive=True))
        if is_concrete(self.center) and is_concrete(self.width):
            lowest = np.asarray(self.center) - np.asarray(self.width) / 2
            check_positive("center - width / 2", lowest)
        parse_unit(self.noise_unit)

    def summary(self):
        units = {"center": "GHz", "width": "GHz", "fwhm": "arcmin"}
        units["noise"] = f"{self.noise_unit} arcmin"
        return f"Channel {self.name}", [(k, shown(getattr(self, k), u)) for k, u in units.items()]

    def band(self, samples: int = 51) -> Bandpass:
        """The top-hat band; see `Bandpass.top_hat`."""
        return Bandpass.top_hat(self.center, self.width, samples=samples)


class Instrument(Printed, eqx.Module):
    """Channels in order, looked up by their names, which differ.

    Examples
    --------
    >>> planck = load_instrument("planck").select(["30", "353"])
    >>> planck.names, f"{planck['353'].center:.1f}"
    (('30', '353'), '361.3')
    """

    name: str = eqx.field(static=True)
    channels: Sequence[Channel]

    def __post_init__(self) -> None:
        self.channels = tuple(self.channels)
        for i, channel in enumerate(self.channels):
            if not isinstance(channel, Channel):
                raise TypeError(
                    f"Entry {i} of `channels` must be a Channel, not {type(channel).__name__}."
                )
        if not self.channels:
            raise ValueError("Argument `channels` must have at least one channel.")
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"Channels must have different names, but are {list(self.names)}.")

    def summary(self):
        table = [dict(channel.summary()[1]) for channel in self]
        rows = [("channel", *table[0])]
        rows += [(c.name, *values.values()) for c, values in zip(self, table, strict=True)]
        return f"Instrument {self.name}", rows

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)

    def __getitem__(self, name: str) -> Channel:
        try:
            return self.channels[self.names.index(name)]
        except ValueError:
            known = ", ".join(self.names)
            raise KeyError(f"{self.name} has no channel {name!r}; it has {known}.") from None

    def __iter__(self) -> Iterator[Channel]:
        return iter(self.channels)

    def __len__(self) -> int:
        return len(self.channels)

    def select(self, names: Sequence[str]) -> "Instrument":
        """The instrument with these channels only, in this order; KeyError for an unknown one."""
        if isinstance(names, str):
            raise TypeError(f"Argument `names` must be a list of names, not the string {names!r}.")
        return Instrument(self.name, [self[name] for name in names])

    def bands(self, samples: int = 51) -> dict[str, Bandpass]:
        """The top-hat bands of all channels by name; see `Bandpass.top_hat`."""
        return {channel.name: channel.band(samples) for channel in self.channels}

    def observed(
        self, target: Array | float | None = None, samples: int = 51
    ) -> dict[str, ObservedBand]:
        """All channels by name as `Observation` takes them, with noise in uK_RJ arcmin.

        Target is the common beam of the maps [arcmin]; None leaves each its own.
        """
        found = {}
        for c, band in zip(self, self.bands(samples).values(), strict=True):
            noise = c.noise * band.conversion(c.noise_unit, "uK_RJ")
            found[c.name] = ObservedBand(band, c.fwhm, target, noise)
        return found


@cache
def _presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads((files("jaxsky") / "instruments.toml").read_text())


def load_instrument(name: str) -> Instrument:
    """An instrument of `instruments.toml`, where the source of every figure is given.

    Parameters
    ----------
    name : "planck", "wmap", "core" or "litebird"

    Raises
    ------
    KeyError
        If the name is unknown; lists the known ones.
    """
    presets = _presets()
    if name not in presets:
        raise KeyError(f"Unknown instrument {name!r}; known are {', '.join(presets)}.")
    channels = [
        Channel(
            band["name"],
            **band["bandpass"],
            fwhm=band["fwhm"],
            noise=band["noise"]["level"],
            noise_unit=band["noise"].get("unit", "uK_CMB"),
        )
        for band in presets[name]["bands"]
    ]
    return Instrument(presets[name]["title"], channels)


def band_tables(
    name: str, channels: Sequence[str] | None = None, folder: Path = Path()
) -> list[dict[str, Any]]:
    """Bands of an instrument, all or some, as tables of an experiment file.

    Its name is that of a preset, or of a file with a list `bands`, relative to `folder`.
    """
    presets, path = _presets(), folder / name
    if name in presets:
        bands = presets[name]["bands"]
    elif path.is_file():
        try:
            bands = tomllib.loads(path.read_text())["bands"]
            names = [str(band["name"]) for band in bands]
            if not names or len(set(names)) < len(names):
                raise ValueError(", ".join(names) or "there are none")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(
                f"{path}: is no TOML file with a list of bands that have different names ({error})"
            ) from None
    else:
        raise KeyError(f"Unknown instrument {name!r}; known are {', '.join(presets)}, or a file.")
    known = {str(band["name"]): band for band in bands}
    for channel in channels or ():
        if channel not in known:
            raise KeyError(f"{name} has no channel {channel!r}; it has {', '.join(known)}.")
    return [known[channel] for channel in channels or known]
