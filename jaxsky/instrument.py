"""Instruments as data: bands, beams and noise of channels."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxsky.bandpass import Bandpass
from jaxsky.observation import ObservedBand
from jaxsky.printed import Printed


class Instrument(Printed, dict[str, ObservedBand]):
    """Channels by name, which print as a table."""

    def __init__(self, title: str, channels: Mapping[str, ObservedBand]) -> None:
        super().__init__(channels)
        self.title = title

    def bands(self) -> dict[str, Bandpass]:
        """The bandpasses by name."""
        return {name: channel.band for name, channel in self.items()}

    def summary(self):
        table = [dict(channel.summary()[1]) for channel in self.values()]
        rows = [(name, *row.values()) for name, row in zip(self, table, strict=True)]
        return f"Instrument {self.title}", [("channel", *table[0]), *rows]


@cache
def _presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads((files("jaxsky") / "instruments.toml").read_text())


def load_instrument(
    name: str,
    channels: Sequence[str] | None = None,
    *,
    target: Array | float | None = None,
    samples: int = 51,
) -> Instrument:
    """The channels of an instrument by name, as `Observation` takes them.

    Each has a top-hat band, a Gaussian beam and white noise of Q and U [uK_RJ arcmin], with the
    figures of `instruments.toml`, where the source of every one is given.

    Parameters
    ----------
    name : "planck", "wmap", "core" or "litebird"
    channels : names of those that are wanted, in this order; by default all
    target : common beam of the maps [arcmin]; None leaves each its own
    samples : of each band; see `Bandpass.top_hat`

    Raises
    ------
    KeyError
        If a name is unknown; lists the known ones.
    TypeError
        If `channels` is a string.

    Examples
    --------
    >>> planck = load_instrument("planck", ["353", "30"])
    >>> list(planck), f"{planck['353'].band.center:.1f}"
    (['353', '30'], '361.3')
    """
    if name not in _presets():
        raise KeyError(f"Unknown instrument {name!r}; known are {', '.join(_presets())}.")
    if isinstance(channels, str):
        raise TypeError(
            f"Argument `channels` must be a list of names, not the string {channels!r}."
        )
    found = {}
    for table in band_tables(name, channels):
        band = Bandpass.top_hat(**table["bandpass"], samples=samples)
        noise = table["noise"]
        level = noise["level"] * band.conversion(noise.get("unit", "uK_CMB"), "uK_RJ")
        found[table["name"]] = ObservedBand(band, jnp.asarray(table["fwhm"]), target, level)
    return Instrument(_presets()[name]["title"], found)


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
