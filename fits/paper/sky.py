"""The sky of the paper's figures: templates, AME, index maps, made when needed; and its texts."""

import dataclasses
import re
import tomllib
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.commands.report import ResultTable, Section
from fits.common import prepared_maps
from fits.comparison import Comparison, compare
from fits.inputs import Inputs, inputs_of
from fits.regions import region_masks
from jaxsky import AME, Dust, Synchrotron, inputs
from jaxsky.checks import listed
from jaxsky.cmb import gaussian_fields
from jaxsky.galaxy import EmbeddedSky
from jaxsky.harmonics import gaussian_beam, synthesis
from jaxsky.io import InputError
from jaxsky.io.curves import read_text
from jaxsky.noise import realisation_key, stream
from jaxsky.settings import (
    BeamedMap,
    ComponentTable,
    Experiment,
    RadioIndexMap,
    SettingsError,
    SmallScalesTable,
    at_key,
    find_file,
)
from jaxsky.small_scales import Continued, SmallScales, continue_templates
from jaxsky.templates import dust_index, from_pysm_beta, polarization_template, steepening

#: Titles, captions, differences from the paper, and numbers from its text, by label.
TEXTS: dict[str, Any] = tomllib.loads(
    Path(__file__).with_name("paper.toml").read_text(encoding="utf-8")
)
WORDS = TEXTS["sky"]
#: Beams of the paper's templates [arcmin].
PAPER_FWHM = {"dust": 10.0, "synchrotron": 60.0}
#: The paper's ranges of the fits of power laws.
RANGES = {
    "synchrotron": SmallScalesTable(EE=(10, 120), BB=(4, 40)),
    "dust": SmallScalesTable(EE=(60, 600), BB=(60, 600)),
}
#: Reference frequency [GHz] and resolution [arcmin] of the AME; nside of random indices, and of the
#: embedded model next to templates from files.
NU_AME, AME_FWHM, NSIDE = 23.0, 60.0, 64
#: Fits of power laws end at this times nside; pixels resolve l = 2 nside.
KNOWN = 15 / 8
#: Width in pixels of the narrowest beam that a map resolves well.
PIXELS = 1.45
#: Resolution of the paper's maps of indices [arcmin].
FWHM = {"beta_dust": 180.0, "beta_syn": 600.0}
#: Statistics of random index maps: the paper's mean; the scatter, which the paper gives only for
#: synchrotron; and the exponent of the spectrum.
MEAN = {"beta_dust": 1.53, "beta_syn": 2.9}
SCATTER = {"beta_dust": 0.04, "beta_syn": 0.1}
SLOPE = -2.0
#: Map of an index, its resolution [arcmin], by how much it was made steeper (None if it is
#: random), and its origin, the end of a sentence that begins with its symbol.
Index: TypeAlias = tuple[Float[Array, " pix"], float, float | None, str]


class Impossible(ValueError):
    """Raised, with the reason, for a figure that the settings do not allow; others are made."""


class Number(NamedTuple):
    """A number from the paper's text next to ours, with a remark."""

    what: str
    ours: str
    note: str = ""
    paper: str = ""


class PaperFigure(NamedTuple):
    """A figure or table with the paper's label ("Figure 1"), and the seconds that it took.

    The note of its section says what differs from the paper; `numbers` are from the paper's text.
    """

    label: str
    section: Section
    numbers: tuple[Number, ...] = ()
    seconds: float = 0.0


def filled(text: str, **words: Any) -> str:
    """Return a text of `paper.toml` on one line, with the fields in braces filled in."""
    return " ".join(text.format_map(words).split())


def picture_of(label: str) -> str:
    """Return the file name of the picture of a figure."""
    return re.sub(r"\d+", lambda n: f"{int(n[0]):02d}", label.lower().replace(" ", "_")) + ".png"


class Layer(NamedTuple):
    """Dust or synchrotron as a `Source`, with the paper's beam [arcmin] or its map's if wider."""

    component: Dust | Synchrotron
    fwhm: float
    small_scales: SmallScales

    @property
    def maps(self) -> Float[Array, "2 pix"]:
        """Q and U of the template [uK_RJ]."""
        return self.component.template

    @property
    def nside(self) -> int:
        """Resolution of the template."""
        return healpy.npix2nside(self.maps.shape[-1])


class PaperSky:
    """Data shared by the figures of one experiment, made when first needed."""

    def __init__(self, settings: Experiment, executor: Executor | None = None) -> None:
        self.settings, self.executor = settings, executor
        self.folder = Path(settings.data_dir)
        self.key = realisation_key(settings.seed)
        # Made once, at the first call.
        self.template = cache(self._template)
        self.continued = cache(self.with_small_scales)

    def forget_bands(self) -> None:
        """Free the maps of the bands, the largest data that are kept."""
        for name in ("inputs", "comparison"):
            vars(self).pop(name, None)

    @property
    def embedded(self) -> bool:
        """True if dust and synchrotron are those of the embedded model."""
        tables = self.settings.sky.components.values()
        return self.settings.sky.embedded is not None and all(
            one.file is None for one in tables if one.law in PAPER_FWHM
        )

    @property
    def simulated(self) -> bool:
        """True if the observed maps are simulated."""
        bands = self.settings.bands
        return self.settings.common.maps is not None or all(band.file is None for band in bands)

    @property
    def small_scales(self) -> dict[str, SmallScalesTable]:
        """Small scales by law: those of the settings, or with the paper's ranges."""
        return RANGES | self.settings.paper.small_scales

    @property
    def description(self) -> str:
        """Description of the sky in a sentence."""
        if self.embedded:
            return filled(WORDS["model"])
        tables = self.settings.sky.components.items()
        files = [f"{name} {one.label}" for name, one in tables if one.file is not None]
        return filled(WORDS["files"], files=", ".join(files))

    @property
    def differs(self) -> str:
        """Clause that says what the sky is, for a figure that shows it."""
        embedded = self.settings.sky.embedded
        if self.embedded and embedded is not None:
            return filled(WORDS["differs"]["model"], nside=embedded.nside)
        files = [
            f"{law} from {self._spec(law)[1].label} (nside {self.template(law).nside})"
            for law in PAPER_FWHM
        ]
        return filled(WORDS["differs"]["files"], files=listed(files))

    @property
    def maps_differ(self) -> str:
        """The same clause for a figure that shows observed maps."""
        return filled(WORDS["differs"]["simulated"]) if self.simulated else self.differs

    def described(
        self,
        label: str,
        numbers: Sequence[Number] = (),
        *,
        table: ResultTable | None = None,
        texts: str | None = None,
        **words: Any,
    ) -> PaperFigure:
        """Return a figure with the texts of its label and the paper's values of its numbers.

        Texts may refer to `words`, tables of the settings, and properties of this `sky`; `texts` is
        their heading in `paper.toml` if that is not the label.
        """
        own, words = TEXTS[texts or label], {**dict(self.settings), "sky": self, **words}
        published, otherwise = own.get("published", {}), own.get("otherwise", "not given")
        section = Section(
            f"{label}: {filled(own['title'], **words)}",
            filled(own["caption"], **words),
            picture_of(label) if table is None else None,
            table,
            f"Differs from the paper: {filled(own['differs'], **words)}",
        )
        said = [one._replace(paper=published.get(one.what, otherwise)) for one in numbers]
        return PaperFigure(label, section, tuple(said))

    @cached_property
    def galaxy(self) -> EmbeddedSky:
        """The embedded model; where templates come from files, at low resolution."""
        if self.settings.sky.embedded is not None:
            return inputs.embedded_galaxy(self.settings)
        return inputs.default_galaxy(NSIDE)

    @cached_property
    def inputs(self) -> Inputs:
        """Templates and maps of the bands."""
        if not self.settings.bands:
            raise Impossible("It takes observed maps, but there are no bands.")
        return inputs_of(self.settings, galaxy=self.galaxy if self.embedded else None)

    @cached_property
    def comparison(self) -> Comparison:
        """Comparison of the maps with the model, at the common resolution."""
        masks = region_masks(self.settings, self.settings.compare.regions)
        prepared = prepared_maps(self.settings, self.inputs)
        return compare(self.settings, prepared, masks, executor=self.executor)

    def _spec(self, law: str) -> tuple[str, ComponentTable]:
        found = [(n, spec) for n, spec in self.settings.sky.components.items() if spec.law == law]
        if len(found) != 1:
            raise Impossible(
                f"It takes one template of the law {law!r}, but there are {len(found)}."
            )
        return found[0]

    def _template(self, law: str) -> Layer:
        """Return Q, U of dust or synchrotron at the paper's resolution, or its map's if coarser.

        Ranges of power laws beyond the map's multipoles are lowered, their ratio of ends kept.
        """
        name, _ = self._spec(law)
        galaxy = None if self.settings.sky.embedded is None else self.galaxy
        own = inputs.read_sky(self.settings, names=[name], galaxy=galaxy)[0][name]
        if missing := int(np.sum(~own.used)):
            raise SettingsError(
                f"sky.{name}: {missing} pixels have no value; the figures of the paper take "
                "maps of the full sky."
            )
        fwhm = max(own.fwhm, PAPER_FWHM[law])
        nside = healpy.npix2nside(own.used.size)
        maps = polarization_template(own.component.template, own.fwhm, fwhm, nside)
        numbers = self.small_scales[law].model_dump(exclude={"correlated_with"})
        last = int(KNOWN * nside)
        for kind in ("EE", "BB"):
            first, end = numbers[kind]
            if end > last:
                numbers[kind] = max(2, round(first * last / end)), last
        with at_key(f"paper.small_scales.{law}"):
            small = SmallScales(**numbers)
        assert isinstance(own.component, Dust | Synchrotron)  # by its law
        return Layer(dataclasses.replace(own.component, amplitude=maps), fwhm, small)

    @property
    def nside_fine(self) -> int:
        """Nside that resolves the beam of the small scales."""
        nside = 8
        while PIXELS * healpy.nside2resol(nside, arcmin=True) > self.settings.paper.fwhm:
            nside *= 2
        return nside

    def with_small_scales(
        self, name: str, tilt: float = 0.0, kind: str = "small scales"
    ) -> Continued:
        """Return dust or synchrotron with small scales, tilted or of another random `kind`.

        `continued` has those that all figures share.
        """
        layer = self.template(name)
        small = dataclasses.replace(layer.small_scales, tilt=float(layer.small_scales.tilt) + tilt)
        key = stream(self.key, kind, name)
        return continue_templates(key, [layer.maps], [layer.fwhm], [small], self.nside_fine)

    def ame(self) -> tuple[Float[Array, "2 pix"], Float[Array, "2 pix"], str, str]:
        """Return Q, U of AME at 23 GHz and 1 degree, 1 % polarized along the dust, and of dust.

        Then words on their resolution and on the origin of the intensity.
        """
        dust = self.template("dust")
        parameters: dict[str, Any] = {"nu_ref": NU_AME}
        name, own, nside = "ame", 0.0, dust.nside
        if any(one.law == "ame" and one.file for one in self.settings.sky.given.values()):
            name, spec = self._spec("ame")
            found, own, where = inputs.read(self.folder, spec), spec.fwhm or 0.0, f"sky.{name}"
            inputs.check_stokes(where, found, "I")
            if missing := int(np.sum(~np.asarray(found.mask))):
                raise SettingsError(f"{where}: {missing} pixels have no value.")
            parameters, _ = inputs.read_parameters(self.folder, name, spec, found.nside)
            fixed = [(key.partition("."), value) for key, value in self.settings.fixed.items()]
            parameters |= {key: value for (component, _, key), value in fixed if component == name}
            if any(map(np.ndim, parameters.values())):
                raise Impossible("It takes parameters of AME that are numbers, not maps.")
            factor = inputs.uK_RJ_per(found.unit, spec.reference("I"), where)
            intensity = jnp.asarray(found.maps[0] * factor)
            origin = f"The intensity of AME is {spec.label}"
            if spec.nu_ref != NU_AME:
                origin += f", from {spec.nu_ref:g} to 23 GHz by the paper's law"
        else:
            intensity = self.galaxy.dust[0] / 2
            origin = (
                "There is no intensity of AME, and half of that of the embedded model's dust at "
                "353 GHz takes its place"
            )
        fwhm, pixel = max(AME_FWHM, own, dust.fwhm), healpy.nside2resol(nside, arcmin=True)
        resolution = f"a beam of {fwhm / 60:.3g}°"
        polarized = dust.maps
        if fwhm < PIXELS * pixel and intensity.size == polarized.shape[-1]:
            # Pixels are as wide as the beam; cut at their lmax, bright structures would ring.
            resolution = f"pixels of {pixel:.0f} arcmin"
        else:
            polarized = polarization_template(polarized, dust.fwhm, fwhm, nside)
            intensity = dust_index(intensity, own, fwhm, nside)
        with at_key(f"sky.{name}"):
            ame = AME.from_dust_angles(intensity, polarized, **parameters)
        return ame.template * ame.sed(NU_AME), polarized, resolution, origin

    def index(self, name: str) -> Index:
        """Return the map of beta_dust or beta_syn: from a file, from the template, or random."""
        layer = self.template("dust" if name == "beta_dust" else "synchrotron")
        held, nside = getattr(layer.component, name), layer.nside
        spec: BeamedMap | None = getattr(self.settings.paper, name)
        if spec is not None:
            return _read_index(self.folder, name, spec)
        if not isinstance(held, tuple) and held.ndim == 1:
            smooth = dust_index(held, 0.0, FWHM[name], nside)
            return smooth, FWHM[name], 0.0, "is that of the template"
        return _drawn_index(stream(self.key, "index", name), name, min(NSIDE, nside))


def _drawn_index(key: Array, name: str, nside: int) -> Index:
    """Return a Gaussian field with the mean and the scatter of the paper's map."""
    lmax, fwhm = 2 * nside, FWHM[name]
    ell = jnp.arange(lmax + 1)
    power = jnp.where(ell < 1, 0.0, jnp.maximum(ell, 1.0) ** SLOPE) * gaussian_beam(fwhm, lmax) ** 2
    field = synthesis(gaussian_fields(key, power[None, None]), nside)[0]
    values = MEAN[name] + SCATTER[name] * (field - field.mean()) / field.std()
    origin = f"is a Gaussian field of mean {MEAN[name]:g} and scatter {SCATTER[name]:g}"
    return values, fwhm, None, origin


def _read_index(folder: Path, name: str, spec: BeamedMap) -> Index:
    """Read an index from a file and smooth it; beta_syn is made steeper if the settings say so."""
    pure = spec if spec.unit is not None else spec.model_copy(update={"unit": ""})
    where, found = f"paper.{name}", inputs.read(folder, pure, stokes="", zeros_are_data=True)
    own, by = spec.fwhm or 0.0, 0.0
    origin, fwhm = f"is that of {spec.label}", max(FWHM[name], own)
    if name == "beta_syn" and bool(np.all(found.maps[:, found.mask] < 0)):
        found = dataclasses.replace(found, maps=np.asarray(from_pysm_beta(found.maps)))
        origin = f"{origin} with the other sign"
    stated = spec.missing is not None
    values, used = inputs.parameter_map(found, name, found.nside, where, stated=stated)
    smooth = dust_index(values, own, fwhm, found.nside, None if used.all() else used)
    if isinstance(spec, RadioIndexMap):
        given = spec.steepening
        by = _of_spectrum(folder, given) if isinstance(given, str) else given
        origin += f", made steeper by {by:.2f}" if by else ", not made steeper"
    return smooth + by, fwhm, by, origin


def _of_spectrum(folder: Path, file: str) -> float:
    """Return how much a spectrum in a file steepens: frequency [GHz], antenna temperature."""
    key = "paper.beta_syn.steepening"
    try:
        nu, temperature = read_text(find_file(folder, file)).numbers([0, 1]).T
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    with at_key(f"{key}: {file}"):
        return float(steepening(nu, temperature))
