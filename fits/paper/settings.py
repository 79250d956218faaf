"""The settings of `jaxsky paper`: those of an analysis, and a table of its own."""

from pathlib import Path

from pydantic import Field, model_validator

from fits.settings import Settings
from jaxsky.experiment.settings import SmallScalesTable
from jaxsky.settings import FileName, MapFile, MaskFile, Table
from jaxsky.settings_load import load
from jaxsky.settings_types import Pair
from jaxsky.settings_values import check_reference
from jaxsky.small_scales import DUST, SYNCHROTRON

__all__ = ["EMBEDDED", "EXAMPLE", "PaperSettings", "load_paper"]

EMBEDDED = Path(__file__).with_name("embedded.toml")
EXAMPLE = Path(__file__).with_name("example.toml")


class IntensityFile(MapFile):
    """The intensity of AME, to be polarized along the dust."""

    nu_ref: float = Field(gt=0)
    fwhm: float = Field(0.0, ge=0)

    @model_validator(mode="after")
    def _plausible(self) -> "IntensityFile":
        check_reference("ame", self.nu_ref, {})
        return self


class IndexFile(MapFile):
    """A map of spectral indices."""

    unit: str | None = ""
    fwhm: float = Field(0.0, ge=0)


class SynchrotronIndexFile(IndexFile):
    """The index of the synchrotron, in either sign.

    A map at radio frequencies is made steeper: by a number, the paper's is 0.13, or as a spectrum
    says, a table of frequency [GHz] and antenna temperature.
    """

    steepening: float = 0.0
    spectrum: FileName | None = None


class Paper(Table):
    """What only the figures of the paper need."""

    fwhm: float = Field(5.0, gt=0)
    center: Pair[float] = (180.0, 30.0)
    dust: SmallScalesTable = SmallScalesTable(EE=DUST.EE, BB=DUST.BB)
    synchrotron: SmallScalesTable = SmallScalesTable(EE=SYNCHROTRON.EE, BB=SYNCHROTRON.BB)
    ame: IntensityFile | None = None
    beta_dust: IndexFile | None = None
    beta_syn: SynchrotronIndexFile | None = None
    mask: MaskFile | None = None


class PaperSettings(Settings):
    """An analysis file, with a table `paper` that may be left out."""

    paper: Paper = Paper()


def load_paper(path: Path) -> PaperSettings:
    """Settings from a TOML file.

    Raises
    ------
    jaxsky.settings.SettingsError
        If the file is absent, is not TOML, or has a mistake; the message names file and key.
    """
    return load(path, PaperSettings)
