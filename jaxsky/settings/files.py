"""Tables of settings that name maps, masks, bandpasses and noise in files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, Strict, model_validator

from jaxsky.bandpass import UNITS
from jaxsky.checks import listed
from jaxsky.io.columns import parse_stokes
from jaxsky.noise import COVARIANCE_COLUMNS
from jaxsky.settings.types import FileName, MistakeAt, Positive, SettingsTable, Several, valid

Files = FileName | Annotated[list[FileName], Field(min_length=1)]
_Hdu = Annotated[int, Field(ge=1)]
_Stokes = Annotated[str, Field(min_length=0)]  # a column may have none


class TableKeys(SettingsTable):
    """Columns of a table in one or several files, and their unit."""

    file: Files | None = None
    fields: list[str | int] | None = None
    unit: str | None = Field(None, min_length=0)

    @property
    def files(self) -> list[str]:
        """The names of all files."""
        return [self.file] if isinstance(self.file, str) else self.file or []

    @property
    def label(self) -> str:
        """The names of the files without folders, for display."""
        return ", ".join(Path(file).name for file in self.files)

    def check_file(self, keys: Iterable[str], most: int | None = None) -> None:
        """Raise ValueError for more than `most` files, or keys of a file that is missing."""
        if most and len(self.files) > most:
            raise MistakeAt("file", f"must be one file, not {self.label}")
        if self.file is None and (given := self.changed(keys)):
            verb = "is" if len(given) == 1 else "are"
            raise ValueError(f"{listed(given)} {verb} of a file, but file is missing")


class ColumnKeys(TableKeys):
    """Columns of HEALPix maps in one FITS table, or in several with one column each.

    Keys may be left out where the header has the answer; see `jaxsky.io.read_maps`.
    """

    hdu: _Hdu | Annotated[list[_Hdu], Field(min_length=1)] | None = None
    ordering: Literal["RING", "NESTED"] | None = None
    coordinates: Literal["G", "C", "E"] | None = None
    polarization: Literal["COSMO", "IAU"] | None = None
    missing: float | list[float] | None = None


class MapKeys(ColumnKeys):
    """An optional map, and its Stokes parameters if the column names do not tell them."""

    stokes: Annotated[str | list[_Stokes], valid(parse_stokes)] | None = None

    @model_validator(mode="after")
    def _of_a_file(self) -> "MapKeys":
        self.check_file(MapKeys.model_fields)
        return self


class MapFile(MapKeys):
    """A map."""

    file: Files


class BeamedKeys(MapKeys):
    """An optional map, and the FWHM of its Gaussian beam [arcmin]."""

    fwhm: float | None = Field(None, ge=0)


class BeamedMap(MapFile, BeamedKeys):
    """A map and the FWHM of its Gaussian beam [arcmin]."""


class BandpassSpec(TableKeys):
    """A bandpass: a table in a file, or a top-hat."""

    band: str | None = None
    detectors: Several[str] | None = None
    convention: Literal["RJ", "power", "CMB"] | None = None
    center: Positive | None = None
    width: float | None = Field(None, ge=0)

    @model_validator(mode="after")
    def _one_kind(self) -> "BandpassSpec":
        if (self.file is None) == (self.center is None):
            raise ValueError("give a bandpass either as file or as center and width")
        self.check_file(("band", "detectors", "unit", "fields"), 1)
        return self


def _list(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else [value]


def _temperature(unit: str) -> None:
    if UNITS.get(unit, (1.0, ""))[1] not in ("K_RJ", "K_CMB"):
        raise ValueError(f"must be a temperature such as uK_RJ or mK_CMB, not {unit!r}")


class NoiseColumns(ColumnKeys):
    """Columns that describe the noise, or a list of their names; other keys are the map's own."""

    #: Noise of one observation: a number, or one per Stokes parameter.
    sigma0: Annotated[list[Positive], Field(max_length=3), BeforeValidator(_list)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        return {"fields": list(value)} if isinstance(value, list | tuple) else value


_Level = Annotated[float, Field(ge=0)]
_Levels = Annotated[tuple[_Level, ...], Field(min_length=1, max_length=2), Strict(False)]


class NoiseTable(SettingsTable):
    """Noise of a band or of a template, as exactly one of its kinds: a level, or of each pixel.

    Two levels are those of I and of polarization; one in a list is that of I, in a band without
    polarization. `unit` is that of level, rms, covariance
    (squared) and sigma0, by default that of the map, or uK_CMB where there is no map. `weights` are
    the inverse covariance in units of sigma0.
    """

    KINDS: ClassVar[tuple[str, ...]] = (
        "level", "rms", "covariance", "hits", "weights", "estimate_above"
    )  # fmt: skip
    #: Stokes parameters of the columns of a kind, by their number; hits have none.
    COLUMNS: ClassVar[dict[str, dict[int, tuple[str, ...]]]] = {
        "rms": {2: ("QQ", "UU"), 3: ("II", "QQ", "UU")},
        "covariance": COVARIANCE_COLUMNS,
        "weights": {3: COVARIANCE_COLUMNS[3]},
    }

    level: _Level | _Levels | None = None
    rms: _Level | NoiseColumns | None = None
    covariance: NoiseColumns | None = None
    hits: NoiseColumns | None = None
    weights: NoiseColumns | None = None
    estimate_above: float | None = Field(None, ge=0, lt=90)
    correlated: bool = False
    plausible: bool = False
    shared: dict[str, float] = Field(default={})
    unit: Annotated[str, valid(_temperature)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "NoiseTable":
        self.one_of("noise", self.KINDS)
        if self.correlated and self.estimate_above is None:
            raise ValueError("correlated goes with estimate_above only")
        for kind in self.KINDS:
            if isinstance(spec := getattr(self, kind), NoiseColumns):
                self._check_columns(kind, spec)
        return self

    def level_of(self, stokes: str) -> float | None:
        """Return the level of a Stokes parameter, if levels are given."""
        if not isinstance(self.level, tuple):
            return self.level
        return dict(zip("IP", self.level, strict=False)).get("I" if stokes == "I" else "P")

    @property
    def of_I_alone(self) -> bool:
        """Whether there is a level of I, but none of Q and U."""
        return self.level_of("I") is not None and self.level_of("Q") is None

    def _check_columns(self, kind: str, spec: NoiseColumns) -> None:
        numbered = kind in ("hits", "weights")
        if numbered != bool(spec.sigma0):
            words = "is missing" if numbered else f"is of hits and weights, not of {kind}"
            raise MistakeAt(f"{kind}.sigma0", words)
        if kind == "rms":
            if spec.file is None and not spec.fields:
                raise MistakeAt("rms.file", "is missing, or fields of the map's own file")
            return
        choices = self.COLUMNS.get(kind, {1: ("N_OBS",)})
        if len(spec.fields or []) not in choices:
            wanted = " or ".join(map(", ".join, choices.values()))
            named = ", ".join(map(str, spec.fields or [])) or "none"
            raise MistakeAt(f"{kind}.fields", f"name the columns {wanted}, not {named}")


class SeenKeys(BeamedKeys):
    """An optional map as it was seen, with its beam and its noise: of a band or of a component."""

    noise: NoiseTable | None = None
