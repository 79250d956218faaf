"""The settings of a forecast: a TOML file, validated with a sentence for each mistake."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from jaxsky.settings import FileName, SettingsFile, Table, TemplateFile, check_angles
from jaxsky.settings_load import load
from jaxsky.settings_types import (
    BandName,
    ComponentName,
    Distinct,
    Nside,
    Pair,
    Seed,
    Several,
    TensorRatio,
    Word,
    check_names,
)
from jaxsky.units import UNITS

__all__ = ["DEFAULT", "EXAMPLE", "Fisher", "ForecastSettings", "Mask", "Spectra", "load_forecast"]

DEFAULT = Path(__file__).with_name("default.toml")
EXAMPLE = Path(__file__).with_name("example.toml")

Positive = Annotated[float, Field(gt=0)]
Multipole = Annotated[int, Field(ge=2)]


class Experiment(Table):
    """An instrument of `jaxsky.instrument`."""

    instrument: str | None = None
    channels: Several[Word] | None = None


class BandTable(Table):
    """A band of an experiment of one's own; see `jaxsky.instrument.Channel`."""

    name: BandName
    center: Positive
    width: Positive
    fwhm: Positive
    noise: Positive
    noise_unit: str = "uK_CMB"

    @field_validator("noise_unit")
    @classmethod
    def _temperature(cls, value: str) -> str:
        if UNITS.get(value, (1.0, ""))[1] not in ("K_RJ", "K_CMB"):
            raise ValueError(f"must be a temperature such as uK_RJ or mK_CMB, not {value!r}")
        return value


class Embedded(Table):
    """The embedded model of the Galaxy."""

    nside: Nside = 128
    seed: Seed = 0


class Mask(Table):
    """What is used of the sky: a mask in a file, or latitudes above one; its edge made smooth."""

    file: FileName | None = None
    key: str | None = None
    ordering: Literal["RING", "NESTED"] | None = None
    latitude: float | None = Field(None, ge=0, lt=90)
    apodization: float = Field(4.0, ge=0, lt=90)

    @model_validator(mode="after")
    def _one_kind(self) -> "Mask":
        if (self.file is None) == (self.latitude is None):
            raise ValueError("give either the file of a mask or a latitude; 0 is the full sky")
        if self.file is None and (self.key or self.ordering):
            raise ValueError("key and ordering are those of a file")
        return self


class Spectra(Table):
    """Spectra of the foregrounds outside the mask, and what they are shown against."""

    bands: Annotated[Several[Word], Field(max_length=7)] | None = None
    lmin: Multipole = 2
    lmax: Multipole = 250
    width: int = Field(10, ge=1)
    fit: Pair[Multipole] = (20, 200)
    r: Several[Positive] = Field([0.1, 0.01, 0.001], max_length=4)

    @model_validator(mode="after")
    def _ranges(self) -> "Spectra":
        if not self.lmin < self.lmax:
            raise ValueError(f"lmax, {self.lmax}, must be above lmin, {self.lmin}")
        if not self.fit[0] < self.fit[1]:
            raise ValueError(f"fit must increase, but is {self.fit[0]}, {self.fit[1]}")
        return self


class Fisher(Table):
    """The Fisher matrix: what is free, and what is known of it before."""

    free: Several[Word] = Field(["r"])
    foregrounds: Distinct[Literal["amplitude", "slope", "correlation"]] = Field(
        ["amplitude", "slope", "correlation"]
    )
    priors: dict[str, Positive] = Field(default={})
    spectra: Several[Literal["EE", "BB"]] = Field(["BB"])
    lmin: Multipole = 2
    lmax: Annotated[int, Field(ge=2, le=3000)] = 300
    r: TensorRatio = 0.0
    A_lens: float = Field(1.0, ge=0)

    @model_validator(mode="after")
    def _consistent(self) -> "Fisher":
        if not self.lmin < self.lmax:
            raise ValueError(f"lmax, {self.lmax}, must be above lmin, {self.lmin}")
        return self


class ForecastSettings(SettingsFile):
    """All settings of a forecast."""

    experiment: Experiment = Experiment()
    bands: list[BandTable] = Field(default=[])
    embedded: Embedded | None = None
    templates: dict[ComponentName, TemplateFile] = Field(default={})
    fixed: dict[str, float] = Field(default={})
    mask: Mask
    spectra: Spectra = Spectra()
    fisher: Fisher = Fisher()

    @model_validator(mode="after")
    def _consistent(self) -> "ForecastSettings":
        if (self.experiment.instrument is None) == (not self.bands):
            raise ValueError("give either experiment.instrument or bands")
        if self.bands and self.experiment.channels:
            raise ValueError("experiment.channels chooses from an instrument, not from bands")
        if (self.embedded is None) == (not self.templates):
            raise ValueError("give either templates or the table embedded")
        check_names("bands", (band.name for band in self.bands))
        check_names("templates", self.templates)
        check_angles(self.templates)
        return self


def load_forecast(path: Path) -> ForecastSettings:
    """Settings from a TOML file; see `jaxsky.settings_load.load`."""
    return load(path, ForecastSettings)
