"""Tables of an experiment file that describe the sky and the bands in which it is observed."""

import math
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationError, model_validator

from jaxsky.components import AME, component_class, declared
from jaxsky.galaxy import GalaxyModel
from jaxsky.observation import band_tables
from jaxsky.settings.files import BandpassSpec, BeamedMap, MapFile, MapKeys, SeenKeys, TableKeys
from jaxsky.settings.types import (
    RESERVED,
    FileName,
    Interval,
    MistakeAt,
    Nside,
    Pair,
    Positive,
    Seed,
    SettingsTable,
    Several,
    check_name,
    check_names,
    check_signs,
    mistakes,
    valid,
)

#: Release and correction in the names of Planck's files.
_RELEASE = re.compile(r"_R(\d)\.\d\d")
#: Maps of LFI's second and third release, and of HFI's second, without correction for leakage: of
#: the whole mission, years, surveys and half rings, compressed or not.
_LEAKY = re.compile(
    r"(LFI_SkyMap_0\d\d|HFI_SkyMap_(?:100|143|217|353)(?=.*_R2))(.*_R[23]\.\d\d.*)", re.IGNORECASE
)


def _without_leakage(name: str) -> str | None:
    """Say what to use in place of a map that contains leakage; None if it is not known to."""
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


#: Components of the embedded model, which have the names of their laws.
EMBEDDED = ("dust", "synchrotron")


class EmbeddedTable(SettingsTable):
    """The embedded model of the Galaxy; other keys are fields of `jaxsky.galaxy.GalaxyModel`."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float] = Field(init=False)

    nside: Nside = 128
    seed: Seed = 0

    @model_validator(mode="after")
    def _known(self) -> "EmbeddedTable":
        known = GalaxyModel.__dataclass_fields__
        for name in self.model_extra or ():
            if name not in known:
                raise MistakeAt(name, f"is none of nside, seed, {', '.join(known)}")
        return self


class SmallScalesTable(SettingsTable):
    """Small scales of a component; see `jaxsky.small_scales.SmallScales`."""

    EE: Interval[int]
    BB: Interval[int]
    slope: float | Pair[float] | None = None
    tilt: float = 0.0
    amplitude: float = Field(1.0, ge=0)
    modulation_fwhm: Positive = 180.0
    correlated_with: str | None = None


class ComponentTable(SeenKeys):
    """A component: its law, parameters that differ from the defaults, its map at `nu_ref` [GHz].

    Two values of `nu_ref` are those of I and of polarization.
    A component without a map belongs to the embedded model, or is found by a separation from its
    law alone. `angles` names the component along which an intensity is polarized.
    """

    law: Annotated[str, valid(component_class)] | None = None
    nu_ref: Positive | Pair[Positive] | None = None
    angles: str | None = None
    parameters: dict[str, float | list[float] | MapFile] = Field(default={})
    small_scales: SmallScalesTable | None = None

    @model_validator(mode="after")
    def _plausible(self) -> "ComponentTable":
        if self.noise is not None and self.noise.estimate_above is not None:
            raise MistakeAt("noise.estimate_above", "is of bands")
        if self.noise is not None and self.noise.of_I_alone:
            raise MistakeAt("noise.level", "a list is of I and of polarization; leave out its [ ]")
        if self.law == "cmb":
            raise MistakeAt("law", "the CMB is described in the table cmb")
        check_signs(self.parameters, "parameters")
        if "nu_ref" in self.parameters:
            raise MistakeAt("parameters.nu_ref", "belongs next to law")
        reference = declared(component_class(self.law), "nu_ref") if self.law else None
        if self.law and self.nu_ref is not None:
            if not reference:
                raise ValueError(f"the law {self.law!r} has no nu_ref")
            least, most = reference["within"] or (0, math.inf)
            for nu in (self.reference("I"), self.reference("Q")):
                if nu is not None and not least <= nu <= most:
                    raise ValueError(
                        f"nu_ref is in GHz, for the law {self.law!r} from {least:g} to {most:g}, "
                        f"not {nu:g}"
                    )
        self.check_file(("fwhm", "angles", "noise"))
        if self.file is not None and self.law is None:
            raise ValueError("law is missing")
        if self.file is not None and reference and self.nu_ref is None:
            raise ValueError("nu_ref is missing")
        return self

    def reference(self, stokes: str) -> float | None:
        """Return the frequency of the map of a Stokes parameter [GHz], if it is given."""
        return self.nu_ref[stokes != "I"] if isinstance(self.nu_ref, tuple) else self.nu_ref

    @property
    def maps(self) -> dict[str, MapFile]:
        """The parameters that are maps."""
        return self._files(table=False)

    @property
    def tables(self) -> dict[str, MapFile]:
        """The parameters that are files of a table of numbers, which the law interpolates."""
        return self._files(table=True)

    def _files(self, table: bool) -> dict[str, MapFile]:
        found = {k: v for k, v in self.parameters.items() if isinstance(v, MapFile)}
        law = component_class(self.law or EMBEDDED[0])
        return {k: v for k, v in found.items() if table == ("table" in declared(law, k))}

    @property
    def polarized(self) -> bool:
        """Whether the law, which must be given, is polarized."""
        return component_class(str(self.law)).polarized


class SkyTable(SettingsTable):
    """Components of the sky by name, and the embedded model, whose maps they replace."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ComponentTable] = Field(init=False)

    embedded: EmbeddedTable | None = None

    @property
    def given(self) -> dict[str, ComponentTable]:
        """The components that have a table of their own."""
        return self.__pydantic_extra__ or {}

    @property
    def components(self) -> dict[str, ComponentTable]:
        """All components, each with its law."""
        known = EMBEDDED if self.embedded is not None else ()
        found = {name: ComponentTable() for name in known} | self.given
        return {
            name: one if one.law or name not in known else one.model_copy(update={"law": name})
            for name, one in found.items()
        }

    @property
    def templates(self) -> list[str]:
        """Names of the components that have maps."""
        known = EMBEDDED if self.embedded is not None else ()
        return [n for n, one in self.components.items() if one.file is not None or n in known]

    @model_validator(mode="after")
    def _consistent(self) -> "SkyTable":
        check_names("components", self.given)
        for name, one in self.components.items():
            try:
                check_name(name, "", RESERVED)
                if one.law is None:
                    raise ValueError("law is missing")
                own = one.file is None and name in self.templates
                if own and (one.law != name or one.nu_ref is not None):
                    raise ValueError("law and nu_ref are those of the embedded map; give a file")
                if one.angles is None:
                    continue
                if component_class(one.law) is not AME:
                    raise ValueError("angles are for the law 'ame' only")
                if one.angles not in self.templates:
                    raise MistakeAt("angles", f"there is no map of {one.angles}")
                if self.components[one.angles].angles:
                    raise MistakeAt("angles", f"{one.angles} has none of its own")
            except ValueError as error:
                raise MistakeAt(name, error) from None
        return self


class CMBTable(TableKeys):
    """The CMB: from CAMB, or from a file of spectra, see `jaxsky.io.read_spectra`."""

    include: bool = True
    r: float = Field(0.0, ge=0, le=1000)  # the largest leaves the tensors far above all else
    A_lens: float = Field(1.0, ge=0)
    cosmology: dict[str, float] = Field(default={})

    @model_validator(mode="after")
    def _one_source(self) -> "CMBTable":
        if self.file is not None and (self.r or self.cosmology or self.A_lens != 1):
            raise ValueError("r, A_lens and cosmology are for CAMB; leave them out with a file")
        for name in {"r", "lmax"} & set(self.cosmology):
            raise MistakeAt("cosmology", f"{name!r} is no parameter of the cosmology")
        self.check_file(TableKeys.model_fields, 1)
        return self


class BandTable(SeenKeys):
    """A band: how it observes the sky, and its map; a band without a map is simulated."""

    name: Annotated[str, valid(lambda value: check_name(value, "."))] | None = None
    instrument: str | None = None
    channels: Several[str] | None = None
    bandpass: BandpassSpec | None = None
    samples: int = Field(51, ge=2)
    beam: FileName | None = None
    #: Subtracted from the map in the file; a number is the fraction of the intensity that leaks.
    leakage: float | BeamedMap | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "BandTable":
        if self.instrument is None and self.name is None:
            raise ValueError("name is missing")
        if self.channels is not None and (self.instrument is None or self.name is not None):
            raise ValueError("channels choose from an instrument, in place of a name")
        if self.file is not None and self.name is None:
            raise MistakeAt("file", "is of one band; give its name")
        if self.fwhm is not None and self.beam is not None:
            raise ValueError("give the beam either as fwhm or as the file of a window, beam")
        if self.changed(["samples"]) and self.bandpass and not self.bandpass.width:
            raise MistakeAt("samples", "is of a top-hat, but the bandpass has no width")
        if self.noise is not None and 0 in (
            self.noise.level_of("I"),
            self.noise.level_of("Q"),
            self.noise.rms,
        ):
            raise MistakeAt("noise", "must be greater than 0, not 0")
        if self.noise is not None and self.noise.shared:
            raise MistakeAt("noise.shared", "is of templates, which share the noise of bands")
        if self.file is None:
            if isinstance(self.leakage, BeamedMap):
                raise MistakeAt("leakage", "is subtracted from a map, but file is missing")
            if self.noise is not None and self.noise.estimate_above is not None:
                raise MistakeAt("noise.estimate_above", "is of a map, but file is missing")
        elif isinstance(self.leakage, BeamedMap):
            self._check_release(self.leakage)
        return self

    @property
    def polarized(self) -> bool:
        """Whether it observes Q and U; if not, its noise is of I alone."""
        return self.noise is None or not self.noise.of_I_alone

    def _check_release(self, leakage: BeamedMap) -> None:
        """Refuse leakage from another release than the map, or that has been subtracted already."""
        for file in self.files:
            if "BPassCorrected" in file:
                raise ValueError(f"leakage is subtracted from {file} already")
        releases = [_RELEASE.search(file) for file in (*self.files, *leakage.files)]
        first, *others = [release[1] for release in releases if release] or [""]
        if set(others) - {first}:
            raise ValueError(
                f"leakage {leakage.label} is of release {others[-1]}, but the map {self.label} of "
                f"release {first}"
            )

    def leaking(self) -> dict[str, str]:
        """Return what to use in place of files with leakage that is not subtracted, by name."""
        names = [Path(file).name for file in self.files] if self.leakage is None else []
        return {name: advice for name in names if (advice := _without_leakage(name))}

    def bands(self, folder: Path) -> list["BandTable"]:
        """Return the bands of this entry: channels of an instrument, updated by the keys here.

        Noise levels of an instrument are in uK_CMB, whatever the unit of a map that is given here.
        """
        if self.instrument is None:
            return [self]
        channels = self.channels if self.name is None else [self.name]
        own = self.model_dump(exclude_unset=True, exclude={"instrument", "channels", "name"})
        beam = {"fwhm", "beam"} if {"fwhm", "beam"} & set(own) else set()
        bands = []
        for channel in band_tables(self.instrument, channels, folder):
            raw = {k: v for k, v in channel.items() if k not in beam}
            noise: Any = raw.get("noise")
            if (of_I := raw.pop("noise_I", None)) is not None:
                noise = raw["noise"] = noise | {"level": [of_I, noise["level"]]}
            if "file" not in raw and isinstance(noise, dict) and {"level", "rms"} & set(noise):
                raw["noise"] = {"unit": "uK_CMB"} | noise
            raw |= own
            try:
                if "instrument" in channel:
                    raise MistakeAt("instrument", "a band of an instrument has none")
                bands.append(BandTable.model_validate(raw))
            except ValueError as error:
                what = mistakes(raw, error) if isinstance(error, ValidationError) else str(error)
                raise ValueError(f"{self.instrument}, band {channel['name']}: {what}") from None
        return bands


class RegionsTable(MapKeys):
    """Regions with their own value of a parameter: exactly one of these, or the file of a map."""

    nside: Nside | None = None
    latitudes: list[float] | None = Field(None, min_length=1)
    clusters: int | None = Field(None, ge=1)
    of: list[MapFile] = Field(default=[])

    @model_validator(mode="after")
    def _one_kind(self) -> "RegionsTable":
        self.one_of("regions", ("nside", "latitudes", "clusters", "file"))
        if self.of and self.clusters is None:
            raise ValueError("of goes with clusters only")
        return self


class FreeParameter(SettingsTable):
    """A free parameter: its start value, its prior, and its regions if it has several values."""

    start: float | None = None
    uniform: Interval[float] | None = None
    gaussian: Pair[float] | None = None
    regions: RegionsTable | None = None

    @model_validator(mode="after")
    def _one_prior(self) -> "FreeParameter":
        if self.uniform and self.gaussian:
            raise ValueError("give one prior, either uniform or gaussian")
        start = self.start
        if self.uniform and start is not None and not self.uniform[0] < start < self.uniform[1]:
            raise ValueError(f"start {start:g} is not inside the uniform prior {self.uniform}")
        if self.gaussian and not self.gaussian[1] > 0:
            raise ValueError(f"gaussian needs a positive sigma, not {self.gaussian[1]:g}")
        if start is None and (self.gaussian or self.uniform):
            self.start = self.gaussian[0] if self.gaussian else sum(self.uniform or ()) / 2
        return self

    def numbers(self) -> list[float | None]:
        """Return the values that it contains, or None, to check their sign."""
        return [self.start, self.gaussian and self.gaussian[0], self.uniform and self.uniform[1]]
