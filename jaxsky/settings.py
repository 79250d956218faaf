"""Settings in TOML files: what commands share, validated with a sentence for each mistake."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from jaxsky.components import AME, component_class
from jaxsky.settings_types import Law, Several, Word
from jaxsky.settings_values import (
    check_reference,
    check_signs,
    file_names,
    hdu_numbers,
    missing_numbers,
    stokes_words,
)

__all__ = [
    "BandpassSpec",
    "CovarianceColumns",
    "FileName",
    "Hits",
    "MapFile",
    "MaskFile",
    "NamedFile",
    "NoiseColumns",
    "NoiseFile",
    "SettingsError",
    "SettingsFile",
    "Table",
    "TemplateFile",
    "Weights",
    "check_angles",
    "expand",
]


class SettingsError(ValueError):
    """Settings that cannot work, as one sentence that names the file and the key."""


class Table(BaseModel):
    """A table of settings: its fields are the keys, and no others, with values of their types.

    A number in quotes, a switch where a number is meant and an empty word are mistakes.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)

    @field_validator("*")
    @classmethod
    def _not_empty(cls, value: Any, info: ValidationInfo) -> Any:
        if value == "" and info.field_name not in ("title", "unit"):
            raise ValueError("must not be empty")
        return value


class NamedFile(str):
    """The name of a file, told from other text; see `jaxsky.lookup.find_file`."""

    __slots__ = ()


FileName = Annotated[str, Field(min_length=1), AfterValidator(NamedFile)]


Files = Annotated[FileName | list[FileName], BeforeValidator(file_names)]
Hdus = Annotated[int | list[int], BeforeValidator(hdu_numbers)]
Stokes = Annotated[str | list[str], BeforeValidator(stokes_words)]
Missing = Annotated[float | list[float], BeforeValidator(missing_numbers)]


class _Columns(Table):
    fields: list[str | int] | None = None
    unit: str | None = None
    ordering: Literal["RING", "NESTED"] | None = None
    coordinates: Literal["G", "C", "E"] | None = None
    polarization: Literal["COSMO", "IAU"] | None = None
    missing: Missing | None = None


class MapFile(_Columns):
    """Columns of a FITS map, or of several with a column each; see `jaxsky.io.read_maps`.

    What a header says, or the name of a column for certain, need not be given.
    """

    file: Files
    hdu: Hdus = 1
    stokes: Stokes | None = None

    @property
    def files(self) -> list[str]:
        """Names of the files, however many."""
        return [self.file] if isinstance(self.file, str) else self.file

    @property
    def label(self) -> str:
        """Names of the files without folders, to be shown."""
        return ", ".join(Path(file).name for file in self.files)


class MaskFile(Table):
    """A mask, 1 where a pixel is used: FITS, or one entry of an .npz file."""

    file: FileName
    key: str | None = None
    ordering: Literal["RING", "NESTED"] | None = None


class TemplateFile(MapFile):
    """A component: its map at a reference frequency, its law, parameters that are not default."""

    law: Law
    nu_ref: float = Field(gt=0)
    fwhm: float = Field(0.0, ge=0)
    angles: str | None = None
    parameters: dict[str, float | list[float] | MapFile] = {}

    @model_validator(mode="after")
    def _angles(self) -> "TemplateFile":
        if self.angles and component_class(self.law) is not AME:
            raise ValueError("angles are for the law 'ame' only")
        return self

    @model_validator(mode="after")
    def _plausible(self) -> "TemplateFile":
        check_reference(self.law, self.nu_ref, self.parameters)
        check_signs("parameters", self.parameters)
        return self


class BandpassSpec(Table):
    """A bandpass: a table in a file, or a top-hat."""

    file: FileName | None = None
    band: str | None = None
    detectors: Several[Word] | None = None
    convention: Literal["RJ", "power", "CMB"] | None = None
    unit: str | None = None
    fields: list[str | int] | None = None
    center: float | None = Field(None, gt=0)
    width: float | None = Field(None, ge=0)

    @model_validator(mode="after")
    def _one_kind(self) -> "BandpassSpec":
        if (self.file is None) == (self.center is None):
            raise ValueError("give a bandpass either as file or as center and width")
        of_file = [key for key in ("band", "detectors", "unit", "fields") if getattr(self, key)]
        if self.file is None and of_file:
            raise ValueError(f"{', '.join(of_file)}: of the file of a bandpass, not of center")
        return self


class NoiseColumns(_Columns):
    """Columns about the noise; what is not given is as in the map that has it, file included."""

    file: Files | None = None
    hdu: Hdus | None = None


class CovarianceColumns(NoiseColumns):
    """Columns QQ, QU, UU or II, IQ, IU, QQ, QU, UU, in this order; a list alone names them."""

    fields: list[str | int]

    @model_validator(mode="before")
    @classmethod
    def _list(cls, value: Any) -> Any:
        return {"fields": list(value)} if isinstance(value, list | tuple) else value

    @field_validator("fields")
    @classmethod
    def _three_or_six(cls, value: list[str | int]) -> list[str | int]:
        if len(value) not in (3, 6):
            raise ValueError(
                "name the columns QQ, QU, UU or II, IQ, IU, QQ, QU, UU, "
                f"not {', '.join(map(str, value)) or 'none'}"
            )
        return value


class Hits(NoiseColumns):
    """Number of observations of a pixel, and the noise of one of them.

    `sigma0` is a number or one for each Stokes parameter, in `sigma0_unit` or that of the map.
    """

    fields: list[str | int] = Field(min_length=1, max_length=1)
    sigma0: list[Annotated[float, Field(gt=0)]] = Field(min_length=1, max_length=3)
    sigma0_unit: str | None = None

    @field_validator("sigma0", mode="before")
    @classmethod
    def _list(cls, value: Any) -> Any:
        return value if isinstance(value, list | tuple) else [value]


class Weights(Hits):
    """Weights QQ, QU, UU of each pixel, in this order: the inverse of Q and U's covariance.

    In units of the noise of one observation, `sigma0`, as in the second table of WMAP's maps.
    """

    fields: list[str | int] = Field(min_length=3, max_length=3)


class NoiseFile(Table):
    """Noise of a map: exactly one of these; per pixel of the map as it is in the file.

    `plausible` says that noise is meant which is far from the rms of its map.
    """

    KINDS: ClassVar[tuple[str, ...]] = ("rms", "map", "covariance", "hits", "weights")

    rms: float | None = Field(None, gt=0)
    map: MapFile | None = None
    covariance: CovarianceColumns | None = None
    hits: Hits | None = None
    weights: Weights | None = None
    plausible: bool = False

    @model_validator(mode="after")
    def _one_kind(self) -> "NoiseFile":
        given = [kind for kind in self.KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            raise ValueError(
                f"give the noise as exactly one of {', '.join(self.KINDS)}, "
                f"not {', '.join(given) or 'none'}"
            )
        return self


class SettingsFile(Table):
    """What any file of settings has; a command's settings derive from it."""

    title: str = ""
    data_dir: str = "."

    @model_validator(mode="after")
    def _signs(self) -> "SettingsFile":
        fixed, templates = getattr(self, "fixed", {}), getattr(self, "templates", {})
        check_signs("fixed", fixed)
        for name in templates:
            if f"{name}.nu_ref" in fixed:
                raise ValueError(
                    f"fixed.{name}.nu_ref: nu_ref is given twice, here and in templates.{name}"
                )
        return self


def check_angles(templates: Mapping[str, TemplateFile]) -> None:
    """Raise ValueError if a template takes its angles from one that has none of its own."""
    for name, template in templates.items():
        if not template.angles:
            continue
        if template.angles not in templates:
            raise ValueError(f"templates.{name}.angles: there is no template {template.angles}")
        if templates[template.angles].angles:
            raise ValueError(
                f"templates.{name}.angles: template {template.angles} has none of its own"
            )


def expand(text: str) -> str:
    """Expand `~` and environment variables, $NAME or ${NAME:-default}, in a path.

    Raises
    ------
    ValueError
        If a variable is not set and has no default.
    """

    def value(match: re.Match[str]) -> str:
        name, default = match["braced"] or match["plain"], match["default"]
        found = os.environ.get(name) or default
        if found is None:
            raise ValueError(f"the environment variable {name} is not set")
        return found

    pattern = r"\$(?:\{(?P<braced>\w+)(?::-(?P<default>[^}]*))?\}|(?P<plain>\w+))"
    return os.path.expanduser(re.sub(pattern, value, text))
