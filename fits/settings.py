"""The settings of a spectral-index fit: a TOML file, validated with a sentence for each mistake."""

import os
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from fits.priors import Gaussian, Prior, Uniform

__all__ = ["Settings", "SettingsError", "load_settings"]

EMBEDDED = Path(__file__).with_name("embedded.toml")
EXAMPLE = Path(__file__).with_name("example.toml")


class SettingsError(ValueError):
    """Settings that cannot work, as one sentence that names the file and the key."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Analysis(_Table):
    """What is compared, at which resolution, and how."""

    nside: int = Field(64, gt=0)
    fwhm: float = Field(60.0, ge=0)
    regions: list[str] = Field(["strip", "full"], min_length=1)
    latitude: float = Field(20.0, gt=0, lt=90)
    mask: "MaskFile | None" = None
    stokes: list[Literal["Q", "U", "QU"]] = Field(["Q", "U", "QU"], min_length=1)
    methods: list[Literal["grid", "gradient", "mcmc"]] = Field(
        ["grid", "gradient", "mcmc"], min_length=1
    )
    likelihood: Literal["exact", "diagonal"] = "exact"
    seed: int = Field(0, ge=0)

    @field_validator("nside")
    @classmethod
    def _power_of_two(cls, value: int) -> int:
        if value & (value - 1):
            raise ValueError(f"nside must be a power of two, not {value}")
        return value


class Parameter(_Table):
    """A free parameter: where to start, and its prior."""

    start: float
    uniform: tuple[float, float] | None = None
    gaussian: tuple[float, float] | None = None

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


class MapFile(_Table):
    """Columns of a FITS map; what its header says need not be given."""

    file: str
    fields: list[str | int] | None = None
    hdu: int = Field(1, ge=1)
    unit: str | None = None
    ordering: Literal["RING", "NESTED"] | None = None
    coordinates: Literal["G", "C", "E"] | None = None
    polarization: Literal["COSMO", "IAU"] | None = None


class MaskFile(_Table):
    """A mask, 1 where a pixel is used: FITS, or one entry of an .npz file."""

    file: str
    key: str | None = None
    ordering: Literal["RING", "NESTED"] | None = None


class Template(MapFile):
    """A component: its map at a reference frequency, its law, parameters that are not default."""

    law: Literal["dust", "synchrotron", "ame"]
    nu_ref: float = Field(gt=0)
    fwhm: float = Field(0.0, ge=0)
    angles: str | None = None
    parameters: dict[str, float | list[float] | MapFile] = {}

    @model_validator(mode="after")
    def _angles(self) -> "Template":
        if self.angles and self.law != "ame":
            raise ValueError("angles are for the law 'ame' only")
        return self


class BandpassSpec(_Table):
    """A bandpass: a table in a file, or a top-hat."""

    file: str | None = None
    band: str | None = None
    detectors: list[str] | None = None
    convention: Literal["RJ", "power", "CMB"] | None = None
    center: float | None = Field(None, gt=0)
    width: float | None = Field(None, ge=0)

    @model_validator(mode="after")
    def _one_kind(self) -> "BandpassSpec":
        if (self.file is None) == (self.center is None):
            raise ValueError("give a bandpass either as file or as center and width")
        return self


class Noise(_Table):
    """Noise of a map: exactly one of these; per pixel of the map as it is in the file."""

    rms: float | None = Field(None, gt=0)
    map: MapFile | None = None
    covariance: tuple[str, str, str] | None = None
    estimate_above: float | None = Field(None, ge=0, lt=90)
    correlated: bool = False

    @model_validator(mode="after")
    def _one_kind(self) -> "Noise":
        given = [
            k
            for k in ("rms", "map", "covariance", "estimate_above")
            if getattr(self, k) is not None
        ]
        if len(given) != 1:
            raise ValueError(
                "give the noise as exactly one of rms, map, covariance (columns QQ, QU, UU) or "
                f"estimate_above (a latitude), not {', '.join(given) or 'none'}"
            )
        if self.correlated and self.estimate_above is None:
            raise ValueError("correlated goes with estimate_above only")
        return self


class Band(MapFile):
    """An observed map with its bandpass, beam and noise."""

    name: str = Field(min_length=1)
    bandpass: BandpassSpec
    fwhm: float = Field(0.0, ge=0)
    noise: Noise


class Embedded(_Table):
    """The embedded model of the Galaxy, observed with channels of an instrument."""

    instrument: str = "planck"
    channels: list[str] = Field(["44", "70"], min_length=1)
    nside: int = Field(128, gt=0)


class CMBSettings(_Table):
    """The CMB in the maps: part of their covariance, and of the embedded observation."""

    include: bool = True
    r: float = Field(0.0, ge=0)


class Grid(_Table):
    """The grid."""

    points: int = Field(200, ge=20, le=2000)


class MCMC(_Table):
    """The chains."""

    nwalkers: int = Field(32, ge=4)
    nsteps: int = Field(3000, ge=1)


class Settings(_Table):
    """All settings of a fit."""

    title: str = ""
    data_dir: str = "."
    analysis: Analysis = Analysis()
    free: dict[str, Parameter] = Field(min_length=1)
    fixed: dict[str, float] = {}
    embedded: Embedded | None = None
    templates: dict[str, Template] = {}
    bands: list[Band] = []
    cmb: CMBSettings = CMBSettings()
    grid: Grid = Grid()
    mcmc: MCMC = MCMC()

    @model_validator(mode="after")
    def _consistent(self) -> "Settings":
        if self.embedded is None and not (self.templates and self.bands):
            raise ValueError("give templates and bands, or the table embedded")
        if self.embedded is not None and (self.templates or self.bands):
            raise ValueError("the embedded sky takes no templates or bands")
        if both := set(self.free) & set(self.fixed):
            raise ValueError(f"{', '.join(sorted(both))} cannot be both free and fixed")
        names = [band.name for band in self.bands]
        if len(set(names)) < len(names):
            raise ValueError(f"the names of the bands must differ, but are {', '.join(names)}")
        for name, template in self.templates.items():
            if template.angles and template.angles not in self.templates:
                raise ValueError(f"templates.{name}.angles: there is no template {template.angles}")
        return self

    def start(self) -> dict[str, float]:
        """Start values of the free parameters."""
        return {name: parameter.start for name, parameter in self.free.items()}

    def priors(self) -> dict[str, Prior]:
        """Priors of the free parameters that have one."""
        priors = {name: parameter.prior() for name, parameter in self.free.items()}
        return {name: prior for name, prior in priors.items() if prior is not None}


def _expand(text: str) -> str:
    """Environment variables in a path: $NAME, or ${NAME:-default}."""

    def value(match: re.Match[str]) -> str:
        name, default = match["braced"] or match["plain"], match["default"]
        found = os.environ.get(name) or default
        if found is None:
            raise ValueError(f"the environment variable {name} is not set")
        return found

    pattern = r"\$(?:\{(?P<braced>\w+)(?::-(?P<default>[^}]*))?\}|(?P<plain>\w+))"
    return re.sub(pattern, value, text)


def _sentence(path: Path, error: ValidationError) -> str:
    parts = []
    for item in error.errors():
        where = ".".join(str(key) for key in item["loc"])
        what = item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden":
            what = "unknown key"
        elif item["type"] == "missing":
            what = "is missing"
        elif not item["msg"].startswith("Value error"):
            what = f"{what[0].lower()}{what[1:]}, not {item['input']!r}"
        parts.append(f"{where}: {what}" if where else what)
    return f"{path}: {'; '.join(parts)}."


def load_settings(path: Path, overrides: dict[str, Any] | None = None) -> Settings:
    """Settings from a TOML file.

    Parameters
    ----------
    path : the file; relative paths in it are relative to its `data_dir`, and that to its folder
    overrides : values for the table `analysis` that replace those of the file; None is ignored

    Raises
    ------
    SettingsError
        If the file is absent, is not TOML, or has a mistake; the message names file and key.
    """
    try:
        raw = tomllib.loads(path.read_text())
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}).") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: is not valid TOML ({error}).") from None
    given = {key: value for key, value in (overrides or {}).items() if value is not None}
    if given and isinstance(raw.get("analysis", {}), dict):
        raw["analysis"] = raw.get("analysis", {}) | given
    try:
        settings = Settings.model_validate(raw)
        folder = path.resolve().parent / _expand(settings.data_dir)
    except ValidationError as error:
        raise SettingsError(_sentence(path, error)) from None
    except ValueError as error:
        raise SettingsError(f"{path}: data_dir: {error}.") from None
    return settings.model_copy(update={"data_dir": str(folder.resolve())})


def known_regions() -> Iterable[str]:
    """Names of regions that are not files."""
    return ("strip", "outside", "full")
