"""The settings of a simulation: a TOML file, validated with a sentence for each mistake."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from jaxsky.settings import (
    BandpassSpec,
    FileName,
    NoiseFile,
    SettingsFile,
    Table,
    TemplateFile,
    check_angles,
)
from jaxsky.settings_load import load
from jaxsky.settings_types import (
    BandName,
    ComponentName,
    Nside,
    Pair,
    Seed,
    Several,
    TensorRatio,
    Word,
    check_names,
)
from jaxsky.units import UNITS

__all__ = [
    "DEFAULT",
    "EXAMPLE",
    "BandTable",
    "CMBTable",
    "Embedded",
    "Experiment",
    "Main",
    "NoiseTable",
    "SmallScalesTable",
    "load_experiment",
]

DEFAULT = Path(__file__).with_name("core.toml")
EXAMPLE = Path(__file__).with_name("example.toml")


class Main(Table):
    """What is observed, and what is written."""

    instrument: str | None = None
    channels: Several[Word] | None = None
    samples: int = Field(51, ge=2)
    nside: Nside = 256
    fwhm: float | Literal["own"] = "own"
    stokes: Literal["QU", "IQU"] = "QU"
    unit: Literal["uK_RJ", "uK_CMB"] = "uK_RJ"
    include: Several[Word] | None = None
    outputs: Several[Literal["total", "components"]] = Field(["total"])
    precision: Literal["single", "double"] = "single"
    sheet: bool = True
    diagonal_noise: bool = False
    seed: Seed = 0
    small_scales_seed: Seed | None = None

    @field_validator("fwhm")
    @classmethod
    def _positive(cls, value: float | str) -> float | str:
        if not isinstance(value, str) and value <= 0:
            raise ValueError(f"fwhm must be positive, or 'own', not {value:g}")
        return value


class Embedded(Table):
    """The embedded model of the Galaxy."""

    nside: Nside = 256
    seed: Seed = 0
    model: dict[str, float] = Field(default={})


class SmallScalesTable(Table):
    """Small scales of a component; see `jaxsky.small_scales.SmallScales`."""

    EE: Pair[int]
    BB: Pair[int]
    slope: float | Pair[float] | None = None
    tilt: float = 0.0
    amplitude: float = Field(1.0, ge=0)
    modulation_fwhm: float = Field(180.0, gt=0)
    correlated_with: str | None = None


class CMBTable(Table):
    """The CMB: from CAMB, or from a file of spectra."""

    r: TensorRatio = 0.0
    cosmology: dict[str, float] = Field(default={})
    spectra: FileName | None = None
    format: Literal["camb", "planck"] | None = None
    unit: str | None = None

    @model_validator(mode="after")
    def _one_source(self) -> "CMBTable":
        if self.spectra is not None and (self.r or self.cosmology):
            raise ValueError("r and cosmology are for CAMB; leave them out with spectra")
        if self.spectra is None and (self.format or self.unit):
            raise ValueError("format and unit are those of spectra, a file")
        return self


class NoiseTable(NoiseFile):
    """Noise of a band: a uniform level [unit arcmin], or that of each pixel.

    `unit` is also that of rms, map, covariance (squared) and sigma0 where a file does not say it.
    """

    KINDS = ("level", *NoiseFile.KINDS)

    level: float | None = Field(None, gt=0)
    unit: str = "uK_CMB"

    @field_validator("unit")
    @classmethod
    def _known(cls, value: str) -> str:
        if UNITS.get(value, (1.0, ""))[1] not in ("K_RJ", "K_CMB"):
            raise ValueError(f"must be a temperature such as uK_RJ or mK_CMB, not {value!r}")
        return value


class BandTable(Table):
    """A band of an experiment of one's own."""

    name: BandName
    bandpass: BandpassSpec
    fwhm: float | None = Field(None, ge=0)
    beam: FileName | None = None
    noise: NoiseTable | None = None

    @model_validator(mode="after")
    def _one_beam(self) -> "BandTable":
        if (self.fwhm is None) == (self.beam is None):
            raise ValueError("give the beam either as fwhm or as the file of a window, beam")
        return self


class Experiment(SettingsFile):
    """All settings of a simulation."""

    experiment: Main = Main()
    embedded: Embedded | None = None
    templates: dict[ComponentName, TemplateFile] = Field(default={})
    fixed: dict[str, float] = Field(default={})
    small_scales: dict[str, SmallScalesTable] = Field(default={})
    cmb: CMBTable = CMBTable()
    bands: list[BandTable] = Field(default=[])

    @model_validator(mode="after")
    def _consistent(self) -> "Experiment":
        if (self.experiment.instrument is None) == (not self.bands):
            raise ValueError("give either experiment.instrument or bands")
        if self.bands and self.experiment.channels:
            raise ValueError("experiment.channels chooses from an instrument, not from bands")
        if self.bands and "samples" in self.experiment.model_fields_set:
            raise ValueError("experiment.samples is of an instrument's bands, not of bands")
        if self.embedded is not None and self.templates:
            raise ValueError("give either templates or the table embedded")
        check_names("bands", (band.name for band in self.bands))
        check_names("templates", self.templates)
        check_angles(self.templates)
        known = [*self.foregrounds(), "cmb", "noise"]
        for name in self.experiment.include or []:
            if name not in known:
                raise ValueError(f"experiment.include: {name!r} is none of {', '.join(known)}")
        for name in self.small_scales:
            if name not in self.foregrounds():
                raise ValueError(f"small_scales.{name}: there is no such component")
        return self

    def foregrounds(self) -> list[str]:
        """Names of the components that have templates."""
        return ["dust", "synchrotron"] if self.embedded is not None else list(self.templates)

    def included(self) -> list[str]:
        """Names of all that is simulated, "cmb" and "noise" among them."""
        everything = [*self.foregrounds(), "cmb", "noise"]
        return [n for n in everything if n in (self.experiment.include or everything)]


def load_experiment(
    path: Path, overrides: Mapping[str, Mapping[str, object]] | None = None
) -> Experiment:
    """Settings from a TOML file; see `jaxsky.settings_load.load`."""
    return load(path, Experiment, overrides)
