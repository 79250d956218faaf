"""The settings of an analysis: a TOML file, validated with a sentence for each mistake."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from fits.priors import Gaussian, Prior, Uniform
from jaxsky import settings as shared
from jaxsky.settings import (
    BandpassSpec,
    FileName,
    MapFile,
    MaskFile,
    NoiseFile,
    SettingsFile,
    Table,
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
from jaxsky.settings_values import check_signs

__all__ = ["Settings", "leaks", "load_settings"]

EMBEDDED = Path(__file__).with_name("embedded.toml")
EMBEDDED_COMPARISON = Path(__file__).with_name("comparison") / "embedded.toml"
EXAMPLE = Path(__file__).with_name("example.toml")


class Analysis(Table):
    """What is compared, at which resolution, and how."""

    nside: Nside = 64
    fwhm: float = Field(60.0, ge=0)
    regions: Several[FileName] = Field(["strip", "full"])
    latitude: float = Field(20.0, gt=0, lt=90)
    mask: MaskFile | None = None
    stokes: Several[Literal["Q", "U", "QU"]] = Field(["Q", "U", "QU"])
    methods: Several[Literal["grid", "gradient", "mcmc"]] = Field(["grid", "gradient", "mcmc"])
    likelihood: Literal["exact", "diagonal"] = "exact"
    seed: Seed = 0


class Parameter(Table):
    """A free parameter: where to start, and its prior."""

    start: float
    uniform: Pair[float] | None = None
    gaussian: Pair[float] | None = None

    @model_validator(mode="after")
    def _one_prior(self) -> "Parameter":
        if self.uniform and self.gaussian:
            raise ValueError("give one prior, either uniform or gaussian")
        if self.uniform and not self.uniform[0] < self.start < self.uniform[1]:
            raise ValueError(f"start {self.start:g} is not inside the uniform prior {self.uniform}")
        self.prior()
        return self

    def prior(self) -> Prior | None:
        """The prior, if there is one."""
        if self.uniform:
            return Uniform(*self.uniform)
        return Gaussian(*self.gaussian) if self.gaussian else None


def check_free(free: Mapping[str, Parameter]) -> None:
    """Raise ValueError for start values and priors in the other sign convention."""
    for name, parameter in free.items():
        mean = [parameter.gaussian[0]] if parameter.gaussian else []
        end = [parameter.uniform[1]] if parameter.uniform else []
        check_signs("free", {name: [parameter.start, *mean, *end]})


class Noise(NoiseFile):
    """Noise of a band: from files, or at latitudes above one estimated from its own map."""

    KINDS = (*NoiseFile.KINDS, "estimate_above")

    estimate_above: float | None = Field(None, ge=0, lt=90)
    correlated: bool = False

    @model_validator(mode="after")
    def _not_given(self) -> "Noise":
        if self.correlated and self.estimate_above is None:
            raise ValueError("correlated goes with estimate_above only")
        return self


class LevelNoise(NoiseFile):
    """Noise of a template: as that of a band, or a level seen through its beam [unit arcmin].

    A level or an rms of zero states that the template is exact.
    """

    KINDS = ("level", *NoiseFile.KINDS)

    level: float | None = Field(None, ge=0)
    rms: float | None = Field(None, ge=0)


class TemplateFile(shared.TemplateFile):
    """A template of a fit; what is not said about its noise is not known."""

    noise: LevelNoise | None = None


class Leakage(MapFile):
    """What leaked from intensity into Q and U, to be subtracted; in the map's unit."""

    fwhm: float = Field(0.0, ge=0)


#: Release and correction in the names of Planck's files.
_RELEASE = re.compile(r"_R(\d)\.\d\d")
#: Maps of LFI's second and third release, and of HFI's second, that are as they were observed: of
#: the whole mission, years, surveys and half rings, whole or compressed.
_LEAKY = re.compile(
    r"(LFI_SkyMap_0\d\d|HFI_SkyMap_(?:100|143|217|353)(?=.*_R2))(.*_R[23]\.\d\d.*)", re.IGNORECASE
)


def _without_leakage(name: str) -> str | None:
    """What to take in place of a map that holds leakage, or None if it is not known to."""
    match = _LEAKY.fullmatch(name)
    if match is None or "bpasscorr" in name.lower():
        return None
    start, rest = match.groups()
    if start.upper().startswith("HFI"):  # corrected as it was mapped since the third release
        return f"Take {start}_2048_R3.01_full.fits"
    corrected, beam = f"{start}-BPassCorrected{rest}", "fwhm = ..."
    channel = start.rsplit("_", 1)[1]
    correction = f"LFI_CorrMap_{channel}-BPassCorr{rest.replace('-field-IQU', '')}"
    if "_R2." in rest.upper():  # corrected at nside 256 and 1 degree only
        corrected, beam = f"{start}-BPassCorrected_1024_R3.00_full.fits", "fwhm = 60.0"
        correction = f"LFI_CorrMap_{channel}-BPassCorr_0256_R2.01_full.fits"
    return f'Take {corrected}, or subtract it: leakage = {{ file = "{correction}", {beam} }}'


class Band(MapFile):
    """An observed map with its bandpass, beam and noise."""

    name: BandName
    bandpass: BandpassSpec
    fwhm: float = Field(0.0, ge=0)
    noise: Noise
    leakage: Leakage | None = None

    def leak(self) -> str | None:
        """A warning if the map is known by its name to hold leakage that is not subtracted."""
        names = [Path(file).name for file in self.files]
        advice = {name: words for name in names if (words := _without_leakage(name)) is not None}
        if self.leakage is not None or not advice:
            return None
        name, words = next(iter(advice.items()))
        return (
            f"bands.{self.name}: {name} holds intensity that has leaked into Q and U through "
            "the bandpasses, and nothing is subtracted; indices fitted to it may be wrong by many "
            f"sigma. {words}."
        )

    @model_validator(mode="after")
    def _one_release(self) -> "Band":
        if self.leakage is None:
            return self
        for file in self.files:
            if "BPassCorrected" in file:
                raise ValueError(f"leakage is subtracted from {file} already")
        releases = [_RELEASE.search(file) for file in (*self.files, *self.leakage.files)]
        found = [release[1] for release in releases if release]
        if len(set(found)) > 1:
            raise ValueError(
                f"leakage {self.leakage.label} is of release {found[-1]}, but the map {self.label} "
                f"of release {found[0]}"
            )
        return self


def leaks(bands: Sequence[Band]) -> list[str]:
    """Warnings about maps that are known to hold leakage; see `Band.leak`."""
    return [warning for band in bands if (warning := band.leak()) is not None]


class Embedded(Table):
    """The embedded model of the Galaxy, observed with channels of instruments.

    `leakage` is the fraction of the intensity that leaks into Q and U of a channel, and is
    known: it is subtracted again.
    """

    channels: dict[str, Several[Word]] = Field({"planck": ["44", "70"]}, min_length=1)
    nside: Nside = 128
    leakage: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_channels(self) -> "Embedded":
        names = [name for names in self.channels.values() for name in names]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"channels must be some, with different names, not {names}")
        if unknown := set(self.leakage) - set(names):
            raise ValueError(f"leakage: there is no channel {', '.join(sorted(unknown))}")
        return self


class CMBSettings(Table):
    """The CMB in the maps: part of their covariance, and of the embedded observation."""

    include: bool = True
    r: TensorRatio = 0.0


class Grid(Table):
    """The grid."""

    points: int = Field(200, ge=20, le=2000)


class MCMC(Table):
    """The chains."""

    nwalkers: int = Field(32, ge=4)
    nsteps: int = Field(3000, ge=1)


class Compare(Table):
    """How maps are compared with the model."""

    nsims: int = Field(100, ge=30)
    lmax: int = Field(100, ge=10)
    width: int = Field(10, ge=1)
    panel_nside: Nside = 32
    patches: str | None = None
    patches_nside: Nside = 256


class Settings(SettingsFile):
    """All settings of an analysis: a fit, a comparison, or both."""

    analysis: Analysis = Analysis()
    free: dict[str, Parameter] = Field(default_factory=dict)
    fixed: dict[str, float] = Field(default_factory=dict)
    embedded: Embedded | None = None
    templates: dict[ComponentName, TemplateFile] = Field(default_factory=dict)
    bands: list[Band] = Field(default_factory=list)
    cmb: CMBSettings = CMBSettings()
    grid: Grid = Grid()
    mcmc: MCMC = MCMC()
    compare: Compare = Compare()

    @model_validator(mode="after")
    def _consistent(self) -> "Settings":
        if self.embedded is None and not (self.templates and self.bands):
            raise ValueError("give templates and bands, or the table embedded")
        if self.embedded is not None and (self.templates or self.bands):
            raise ValueError("the embedded sky takes no templates or bands")
        if both := set(self.free) & set(self.fixed):
            raise ValueError(f"{', '.join(sorted(both))} cannot be both free and fixed")
        names = [band.name for band in self.bands]
        check_names("bands", names)
        check_names("templates", self.templates)
        if self.embedded is not None:
            names = [name for names in self.embedded.channels.values() for name in names]
        if self.compare.patches not in (None, *names):
            raise ValueError(
                f"compare.patches: there is no band {self.compare.patches!r} among "
                f"{', '.join(names)}"
            )
        check_angles(self.templates)
        check_free(self.free)
        return self

    def start(self) -> dict[str, float]:
        """Start values of the free parameters."""
        return {name: parameter.start for name, parameter in self.free.items()}

    def priors(self) -> dict[str, Prior]:
        """Priors of the free parameters that have one."""
        priors = {name: parameter.prior() for name, parameter in self.free.items()}
        return {name: prior for name, prior in priors.items() if prior is not None}


def load_settings(
    path: Path, analysis: dict[str, Any] | None = None, compare: dict[str, Any] | None = None
) -> Settings:
    """Settings of an analysis from a TOML file.

    Parameters
    ----------
    path : the file; relative paths in it are relative to its `data_dir`, and that to its folder
    analysis, compare : values that replace those of the tables in the file; None is ignored

    Raises
    ------
    jaxsky.settings.SettingsError
        If the file is absent, is not TOML, or has a mistake; the message names file and key.
    """
    return load(path, Settings, {"analysis": analysis or {}, "compare": compare or {}})
