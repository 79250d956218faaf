"""Settings in TOML files: what commands share, validated with a sentence for each mistake."""

import os
import re
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

from jaxsky.settings.types import (
    Several,
    Word,
    file_names,
    hdu_numbers,
    missing_numbers,
    stokes_words,
)
from jaxsky.units import UNITS


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
    """The name of a file, told from other text; see `jaxsky.settings.toml.find_file`."""

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


class MapKeys(_Columns):
    """Columns of a FITS map, or of several with a column each, where there may be none.

    What a header says, or the name of a column for certain, need not be given; see
    `jaxsky.io.read_maps`.
    """

    file: Files | None = None
    hdu: Hdus = 1
    stokes: Stokes | None = None

    @property
    def files(self) -> list[str]:
        """Names of the files, however many."""
        return [self.file] if isinstance(self.file, str) else self.file or []

    @property
    def label(self) -> str:
        """Names of the files without folders, to be shown."""
        return ", ".join(Path(file).name for file in self.files)

    @model_validator(mode="after")
    def _of_a_file(self) -> "MapKeys":
        # Those that are as by default may be from a log.
        of_file = [k for k, one in MapKeys.model_fields.items() if getattr(self, k) != one.default]
        if self.file is None and of_file:
            raise ValueError(f"{', '.join(of_file)}: of a file, but file is missing")
        return self


class MapFile(MapKeys):
    """Columns of a FITS map, or of several with a column each; see `jaxsky.io.read_maps`."""

    file: Files


class MaskFile(Table):
    """A mask, 1 where a pixel is used: FITS, or one entry of an .npz file."""

    file: FileName
    key: str | None = None
    ordering: Literal["RING", "NESTED"] | None = None


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


class NoiseTable(Table):
    """Noise of a band or of a template: exactly one of its kinds.

    A level is white noise [unit arcmin]; that of a template is seen through its beam. The others
    are of a pixel of the map as it is in the file. `unit` is that of level, rms, map, covariance
    (squared) and sigma0, by default that of the map, or uK_CMB where there is no map. `plausible`
    says that noise is meant which is far from the rms of its map; `correlated`, that noise
    estimated from a map has a spectrum.
    """

    KINDS: ClassVar[tuple[str, ...]] = (
        "level", "rms", "map", "covariance", "hits", "weights", "estimate_above"
    )  # fmt: skip

    level: float | None = Field(None, ge=0)
    rms: float | None = Field(None, ge=0)
    map: MapFile | None = None
    covariance: CovarianceColumns | None = None
    hits: Hits | None = None
    weights: Weights | None = None
    estimate_above: float | None = Field(None, ge=0, lt=90)
    correlated: bool = False
    plausible: bool = False
    unit: str | None = None

    @field_validator("unit")
    @classmethod
    def _temperature(cls, value: str | None) -> str | None:
        if value is not None and UNITS.get(value, (1.0, ""))[1] not in ("K_RJ", "K_CMB"):
            raise ValueError(f"must be a temperature such as uK_RJ or mK_CMB, not {value!r}")
        return value

    @model_validator(mode="after")
    def _one_kind(self) -> "NoiseTable":
        given = [kind for kind in self.KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            raise ValueError(
                f"give the noise as exactly one of {', '.join(self.KINDS)}, "
                f"not {', '.join(given) or 'none'}"
            )
        if self.correlated and self.estimate_above is None:
            raise ValueError("correlated goes with estimate_above only")
        return self


class SettingsFile(Table):
    """What any file of settings has."""

    title: str = ""
    data_dir: str = "."


def expand(text: str) -> str:
    """Expand `~` and environment variables, $NAME or ${NAME:-default}, in a path."""

    def value(match: re.Match[str]) -> str:
        name, default = match["braced"] or match["plain"], match["default"]
        found = os.environ.get(name) or default
        if found is None:
            raise ValueError(f"the environment variable {name} is not set")
        return found

    pattern = r"\$(?:\{(?P<braced>\w+)(?::-(?P<default>[^}]*))?\}|(?P<plain>\w+))"
    return os.path.expanduser(re.sub(pattern, value, text))
