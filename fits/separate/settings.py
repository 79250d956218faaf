"""The settings of a component separation: a TOML file, a sentence for each mistake."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from fits.priors import Gaussian, Prior
from fits.settings import Band, Parameter, check_free
from jaxsky.settings import MapFile, MaskFile, SettingsFile, Table
from jaxsky.settings_load import load
from jaxsky.settings_types import (
    Law,
    Nside,
    Seed,
    SeparatedName,
    Several,
    TensorRatio,
    Word,
    check_names,
)
from jaxsky.settings_values import check_reference, check_signs

__all__ = [
    "EMBEDDED",
    "EXAMPLE",
    "ComponentTable",
    "Embedded",
    "FreeParameter",
    "Main",
    "Regions",
    "SeparateSettings",
    "Tensors",
    "load_separate",
]

EMBEDDED = Path(__file__).with_name("embedded.toml")
EXAMPLE = Path(__file__).with_name("example.toml")

Multipole = Annotated[int, Field(ge=2)]


class Main(Table):
    """What is separated, in which domain and at which resolution."""

    domain: Literal["pixel", "harmonic"] = "pixel"
    nside: Nside = 64
    fwhm: float = Field(90.0, gt=0)
    latitude: float = Field(0.0, ge=0, lt=90)
    mask: MaskFile | None = None
    unit: Literal["uK_CMB", "uK_RJ"] = "uK_CMB"
    nsims: int = Field(100, ge=20)
    sampler: Literal["nuts", "emcee", "none"] = "nuts"
    nsteps: int | None = Field(None, ge=100)
    seed: Seed = 0


class ComponentTable(Table):
    """The law of a component, with parameters that are not default; maps take the place of numbers.

    CMB: "cmb". The amplitudes are free in each pixel.
    """

    law: Law
    nu_ref: float | None = Field(None, gt=0)
    parameters: dict[str, float | list[float] | MapFile] = Field(default={})

    @model_validator(mode="after")
    def _no_reference(self) -> "ComponentTable":
        check_reference(self.law, self.nu_ref, self.parameters)
        check_signs("parameters", self.parameters)
        return self


class Regions(Table):
    """Where a parameter has values of its own: exactly one of these."""

    KINDS: ClassVar[tuple[str, ...]] = ("nside", "latitudes", "clusters", "file")

    nside: Nside | None = None
    latitudes: list[float] | None = Field(None, min_length=1)
    clusters: int | None = Field(None, ge=1)
    of: list[MapFile] = Field(default=[])
    file: MapFile | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "Regions":
        given = [kind for kind in self.KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            raise ValueError(
                f"give the regions as exactly one of {', '.join(self.KINDS)}, "
                f"not {', '.join(given) or 'none'}"
            )
        if self.of and self.clusters is None:
            raise ValueError("of goes with clusters only")
        return self


class FreeParameter(Parameter):
    """A free parameter: where to start, its prior, and its regions if it has several values."""

    regions: Regions | None = None


class Embedded(Table):
    """The embedded model of the Galaxy with CMB and noise, observed by an instrument.

    `truth` changes the laws of what is observed, not of what is fitted.
    """

    instrument: str = "litebird"
    channels: Annotated[Several[Word], Field(min_length=2)] | None = None
    nside: Nside = 64
    truth: dict[str, float] = Field(default={})
    r: TensorRatio = 0.0

    @model_validator(mode="after")
    def _signs(self) -> "Embedded":
        check_signs("truth", self.truth)
        return self


class Tensors(Table):
    """How the tensor-to-scalar ratio is taken from BB of the cleaned CMB."""

    lmin: Multipole = 2
    lmax: Multipole | None = None
    width: int = Field(10, ge=1)
    apodization: float = Field(15.0, ge=0, lt=90)
    purify: bool = True
    A_lens: float = Field(1.0, ge=0)


class SeparateSettings(SettingsFile):
    """All settings of a component separation."""

    separation: Main = Main()
    components: dict[SeparatedName, ComponentTable] = Field(min_length=2)
    free: dict[str, FreeParameter] = Field(min_length=1)
    embedded: Embedded | None = None
    bands: list[Band] = Field(default=[])
    tensors: Tensors = Tensors()

    @model_validator(mode="after")
    def _consistent(self) -> "SeparateSettings":
        if (self.embedded is None) == (not self.bands):
            raise ValueError("give either bands or the table embedded")
        check_names("bands", (band.name for band in self.bands))
        check_names("components", self.components)
        if self.cmb is None:
            raise ValueError("components: one must have the law 'cmb'")
        if self.components.get("cmb", self.components[self.cmb]).law != "cmb":
            raise ValueError("components.cmb: must have the law 'cmb'; choose another name")
        check_free(self.free)
        if self.separation.domain == "harmonic":
            divided = [name for name, parameter in self.free.items() if parameter.regions]
            if divided:
                raise ValueError(
                    f"free.{divided[0]}: regions are those of pixels; the domain 'harmonic' takes "
                    "one value for the whole sky"
                )
        return self

    @property
    def cmb(self) -> str | None:
        """Name of the CMB among the components."""
        return next((n for n, c in self.components.items() if c.law == "cmb"), None)

    def start(self) -> dict[str, float]:
        """Start values of the free parameters."""
        return {name: parameter.start for name, parameter in self.free.items()}

    def priors(self) -> dict[str, Prior]:
        """Priors of the free parameters that have one."""
        priors = {name: parameter.prior() for name, parameter in self.free.items()}
        return {name: prior for name, prior in priors.items() if prior is not None}

    def gaussian(self) -> dict[str, Gaussian]:
        """Those of the priors that are Gaussian."""
        return {n: p for n, p in self.priors().items() if isinstance(p, Gaussian)}


def load_separate(
    path: Path, overrides: Mapping[str, Mapping[str, Any]] | None = None
) -> SeparateSettings:
    """Settings from a TOML file; see `jaxsky.settings_load.load`."""
    return load(path, SeparateSettings, overrides)
