"""The experiment file: one grammar for all commands, a sentence for each mistake.

What each key means is said in `fits/defaults/experiment.toml`, which `jaxsky init` writes.
"""

import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, model_validator

from jaxsky.checks import listed
from jaxsky.settings.files import BeamedMap, MapFile
from jaxsky.settings.tables import BandTable, CMBTable, FreeParameter, SkyTable, SmallScalesTable
from jaxsky.settings.types import (
    WORDS,
    Distinct,
    FileName,
    Interval,
    MistakeAt,
    Nside,
    Pair,
    Positive,
    Seed,
    SettingsError,
    SettingsTable,
    Several,
    check_name,
    check_names,
    check_signs,
    valid,
)

#: Regions that are predefined.
REGIONS: dict[str, str | MapFile] = {"strip": "|b| <= 20", "outside": "|b| > 20", "full": "full"}


def parse_region(text: str) -> tuple[str, float] | None:
    """Return comparison and latitude [deg] of a region like "|b| > 20"; None for the full sky."""
    if text == "full":
        return None
    match = re.fullmatch(r"\|b\|\s*(<=|<|>=|>)\s*(\d+(?:\.\d*)?)", text.strip())
    if match is None or not 0 <= float(match[2]) < 90:
        raise ValueError(
            f'must be "full", latitudes such as "|b| > 20" or "|b| <= 20" below 90 deg, or the '
            f"file of a mask, {{ file = ... }}, not {text!r}"
        )
    return match[1], float(match[2])


def _mask(value: MapFile) -> None:
    if others := value.changed(set(MapFile.model_fields) - {"file", "hdu", "fields", "ordering"}):
        raise MistakeAt(others[0], "is not of a mask")
    if len(value.files) != 1 or len(value.fields or [0]) != 1 or isinstance(value.hdu, list):
        raise ValueError("a mask is one of the fields of one file")


#: A mask, 1 where a pixel is used: a column of a FITS table, or one entry of an .npz file.
MaskFile = Annotated[MapFile, valid(_mask)]
Region = Annotated[str, valid(parse_region)] | MaskFile
Multipole = Annotated[int, Field(ge=2)]


class ResolutionTable(SettingsTable):
    """Pixels, the beam [arcmin] and Stokes parameters of maps; a beam of 0 smooths none."""

    nside: Nside | None = None
    fwhm: float = Field(0.0, ge=0)
    stokes: Literal["QU", "I", "IQU"] = "QU"


class CommonTable(ResolutionTable):
    """The common resolution of templates and maps in fit, compare, separate and paper."""

    nside: Nside = 64
    fwhm: float = Field(60.0, ge=0)
    mask: MaskFile | None = None
    components: Several[str] | None = None
    maps: FileName | None = None


class SimulateTable(ResolutionTable):
    """How bands without a map are simulated, and what `jaxsky simulate` writes."""

    unit: Literal["uK_RJ", "uK_CMB"] = "uK_RJ"
    components: bool = False
    precision: Literal["single", "double"] = "single"
    sheet: bool = True
    include: Several[str] | None = None
    diagonal_noise: bool = False
    small_scales_seed: Seed | None = None


class ByRegionTable(SettingsTable):
    """Regions of which fit and compare give results, one after the other."""

    regions: Several[str] = Field(["strip", "outside", "full"])


class ChainsTable(SettingsTable):
    """Steps of the chains of fit and separate; by default those of the sampler."""

    nsteps: int | None = Field(None, ge=1)


class FitTable(ByRegionTable, ChainsTable):
    """How spectral parameters are fitted to templates."""

    nsteps: int | None = Field(3000, ge=1)
    regions: Several[str] = Field(["strip", "full"])
    stokes: Several[Literal["Q", "U", "QU", "I", "IQU"]] | None = None
    methods: Several[Literal["grid", "gradient", "mcmc"]] = Field(["grid", "gradient", "mcmc"])
    likelihood: Literal["exact", "diagonal"] = "exact"
    points: int = Field(200, ge=20, le=2000)


class SpectraTable(SettingsTable):
    """Binned spectra, of compare, separate and forecast."""

    lmin: Multipole = 2
    lmax: Multipole | None = None
    width: int = Field(10, ge=1)

    @model_validator(mode="after")
    def _increase(self) -> "SpectraTable":
        for key, most in self:
            if key.endswith("lmax") and most is not None and most <= self.lmin:
                raise ValueError(f"{key}, {most}, must be above lmin, {self.lmin}")
        return self


class SimulationsTable(SpectraTable):
    """Spectra with errors from simulations, of compare and separate."""

    nsims: int = Field(100, ge=20)


class WindowTable(SettingsTable):
    """A region whose edge is apodized [deg], of separate and forecast."""

    region: str = "full"
    apodization: float = Field(15.0, ge=0, lt=90)


class CompareTable(SimulationsTable, ByRegionTable):
    """How maps are compared with the model."""

    lmax: int = Field(100, ge=10)
    patches: str | None = None


class SeparateTable(SimulationsTable, WindowTable, ChainsTable):
    """How components are separated, and how r is measured from the cleaned BB."""

    domain: Literal["pixel", "harmonic"] = "pixel"
    unit: Literal["uK_CMB", "uK_RJ"] = "uK_CMB"
    sampler: Literal["nuts", "emcee", "none"] = "nuts"
    nsteps: int | None = Field(None, ge=100)
    purify: bool = True


class ForecastTable(SpectraTable, WindowTable):
    """Spectra of the foregrounds outside a mask, and the Fisher matrix."""

    region: str = "outside"
    apodization: float = Field(4.0, ge=0, lt=90)
    bands: Annotated[Several[str], Field(max_length=7)] | None = None
    lmax: Multipole = 250
    fit: Interval[Multipole] = (20, 200)
    show_r: Several[Positive] = Field([0.1, 0.01, 0.001], max_length=4)
    free: Distinct[Literal["r", "A_lens", "amplitude", "slope", "correlation"]] = Field(
        ["r", "amplitude", "slope", "correlation"]
    )
    spectra: Several[Literal["EE", "BB"]] = Field(["BB"])
    fisher_lmax: int = Field(300, ge=2, le=3000)


class RadioIndexMap(BeamedMap):
    """A map of beta_syn, to which `steepening` is added if it was measured at radio frequencies."""

    #: A number, or the file of a spectrum: frequency [GHz] and antenna temperature.
    steepening: float | FileName = 0.0


class PaperTable(SettingsTable):
    """Settings that only the figures of the paper need."""

    fwhm: Positive = 5.0
    center: Pair[float] = (180.0, 30.0)
    small_scales: dict[Literal["dust", "synchrotron"], SmallScalesTable] = Field(default={})
    beta_dust: BeamedMap | None = None
    beta_syn: RadioIndexMap | None = None


class Experiment(SettingsTable):
    """All settings: a sky, the bands in which it is observed, and what commands do with them."""

    title: str = Field("", min_length=0)
    data_dir: str = "."
    seed: Seed = 0
    sky: SkyTable = SkyTable()
    bands: list[BandTable] = Field(default=[])
    cmb: CMBTable = CMBTable()
    common: CommonTable = CommonTable()
    regions: dict[Annotated[str, valid(check_name)], Region] = Field(default={})
    free: dict[str, FreeParameter] = Field(default={})
    fixed: dict[str, float] = Field(default={})
    truth: dict[str, float] = Field(default={})
    simulate: SimulateTable = SimulateTable()
    fit: FitTable = FitTable()
    compare: CompareTable = CompareTable()
    separate: SeparateTable = SeparateTable()
    forecast: ForecastTable = ForecastTable()
    paper: PaperTable = PaperTable()

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> "Experiment":
        folder = Path((info.context or {}).get("folder", "."))
        bands: list[BandTable] = []
        for i, entry in enumerate(self.bands):
            try:
                bands += entry.bands(folder)
            except (KeyError, ValueError, OSError) as error:
                what = error.args[0] if isinstance(error, KeyError) else str(error)
                raise MistakeAt(f"bands.{i}.instrument", what) from None
        self.bands = bands
        self.regions = REGIONS | self.regions
        names = [str(band.name) for band in bands]
        polarized = [str(band.name) for band in bands if band.polarized]
        check_names("bands", names)
        check_names("regions", self.regions)
        if both := set(self.free) & set(self.fixed):
            raise ValueError(f"{', '.join(sorted(both))} cannot be both free and fixed")
        check_signs(self.fixed, "fixed")
        check_signs(self.truth, "truth")
        check_signs({name: one.numbers() for name, one in self.free.items()}, "free")
        for name in self.sky.components:
            if f"{name}.nu_ref" in self.fixed:
                raise MistakeAt(f"fixed.{name}.nu_ref", f"belongs next to law in sky.{name}")
        if not self.forecast.free and not self.free_in("forecast"):
            raise MistakeAt("forecast.free", "is empty, and so is the table free")
        if self.compare.patches and self.common.stokes != "QU":
            raise MistakeAt("compare.patches", "takes Q and U alone; choose QU as common.stokes")
        if "cmb" in (self.simulate.include or ()) and not self.cmb.include:
            raise MistakeAt("simulate.include", "has 'cmb', but cmb.include is false")
        components = self.sky.components
        choices = [s for s in ("I", "Q", "U", "QU", "IQU") if set(s) <= set(self.common.stokes)]
        known: list[tuple[str, Iterable[str] | None, Collection[str]]] = [
            ("common.components", self.common.components, components),
            ("simulate.include", self.simulate.include, [*components, "cmb", "noise"]),
            ("compare.patches", self.compare.patches, polarized),
            ("fit.stokes", self.fit.stokes, choices),
            ("fit.regions", self.fit.regions, self.regions),
            ("compare.regions", self.compare.regions, self.regions),
            ("separate.region", self.separate.region, self.regions),
            ("forecast.region", self.forecast.region, self.regions),
            ("forecast.bands", self.forecast.bands, polarized),
        ]
        for name, one in components.items():
            if one.noise is not None:
                known.append((f"sky.{name}.noise.shared", one.noise.shared, names))
        for key, values, allowed in known:
            for value in [values] if isinstance(values, str) else values or ():
                if value not in allowed:
                    there = ", ".join(allowed) or "none is there"
                    raise MistakeAt(key, f"{value!r} is none of {there}")
        return self

    def bands_of(self, stokes: str) -> list[BandTable]:
        """Return the bands that observe some Stokes parameters, "I", "QU" or "IQU".

        Bands without polarization are left out of Q and U, SettingsError if no other is there.
        """
        found = [band for band in self.bands if stokes == "I" or band.polarized]
        if self.bands and not found:
            raise SettingsError(
                f"bands: {listed([str(band.name) for band in self.bands])} have no polarization "
                "(noise of I alone); choose I as common.stokes, or simulate.stokes for simulations."
            )
        return found

    def unpolarized(self, stokes: str) -> list[str]:
        """Return a warning about the bands that `bands_of` leaves out, if there are any."""
        left = [str(b.name) for b in self.bands if stokes != "I" and not b.polarized]
        return [f"Left out, as they have no polarization: {', '.join(left)}."] if left else []

    def modelled(self) -> list[str]:
        """Return the names of the components in the model."""
        return [n for n in self.sky.components if n in (self.common.components or [n])]

    def fitted(self) -> list[str]:
        """Return the choices of Stokes parameters that are fitted."""
        defaults = {"QU": ["Q", "U", "QU"], "I": ["I"], "IQU": ["I", "QU", "IQU"]}
        return list(self.fit.stokes or defaults[self.common.stokes])

    def included(self) -> list[str]:
        """Return the names of everything that is simulated, with "cmb" and "noise"."""
        include = self.simulate.include
        everything = [*self.sky.components, *(["cmb"] if self.cmb.include else []), "noise"]
        return [n for n in everything if include is None or n in include]

    def free_in(self, command: str) -> dict[str, FreeParameter]:
        """Return the free parameters that a command knows: those of components, and its own."""
        return {
            name: one
            for name, one in self.free.items()
            if command in WORDS.get(name.split(".")[0], [command])
        }

    def leaks(self) -> list[str]:
        """Return warnings about maps that contain leakage which is not subtracted."""
        return [
            f"bands.{band.name}: {file} holds intensity that has leaked into Q and U through the "
            "bandpasses, and nothing is subtracted; indices fitted to it may be wrong by many "
            f"sigma. {advice}."
            for band in (self.bands if self.common.stokes != "I" else [])
            for file, advice in band.leaking().items()
        ]

    def left_out(self, command: str) -> list[str]:
        """Return warnings about settings of free parameters that a command ignores."""
        here = self.free_in(command)
        others = [n for n in self.free if n not in here]
        regions = [n for n, one in here.items() if one.regions and command != "separate"]
        uniform = [n for n, one in here.items() if one.uniform and command == "forecast"]
        parts = {
            "Not free here, as jaxsky {} does not have them": others,
            "One value for all, as jaxsky {} does not have regions of parameters": regions,
            "Without a prior, as jaxsky {} does not have uniform ones": uniform,
        }
        return [f"{w.format(command)}: {', '.join(names)}." for w, names in parts.items() if names]

    def start(self, command: str) -> dict[str, float]:
        """Return the start values of the free parameters of a command."""
        values = {}
        for name, one in self.free_in(command).items():
            if one.start is None:
                raise SettingsError(f"free.{name}: start is missing.")
            values[name] = one.start
        return values
