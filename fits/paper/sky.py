"""The sky of the figures: templates, AME, maps of indices, made when needed; and their words."""

import dataclasses
import re
import tomllib
from collections.abc import Sequence
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
from jaxsky import AME, Dust, Synchrotron
from jaxsky.checks import listed
from jaxsky.cmb import gaussian_fields
from jaxsky.galaxy import EmbeddedSky
from jaxsky.harmonics import gaussian_beam, synthesis
from jaxsky.inputs import (
    default_galaxy,
    embedded_galaxy,
    parameter_map,
    read,
    read_sky,
    uK_RJ_per,
)
from jaxsky.io import InputError
from jaxsky.io.curves import read_text
from jaxsky.noise import realisation_key, stream
from jaxsky.settings import (
    BeamedMap,
    ComponentTable,
    Experiment,
    RadioIndexMap,
    SettingsError,
    at_key,
    find_file,
)
from jaxsky.small_scales import Continued, SmallScales, continue_templates
from jaxsky.templates import dust_index, from_pysm_beta, polarization_template, steepening

#: Titles, captions, what differs from the paper, and numbers of its text, by label.
TEXTS: dict[str, Any] = tomllib.loads(
    Path(__file__).with_name("paper.toml").read_text(encoding="utf-8")
)
WORDS = TEXTS["sky"]
#: Beams of the paper's templates [arcmin].
PAPER_FWHM = {"dust": 10.0, "synchrotron": 60.0}
#: Reference frequency of the AME [GHz], its resolution [arcmin] and nside, and those of its
#: correlation with the dust.
NU_AME, AME_FWHM, NSIDE = 23.0, 60.0, 64
#: Fits of power laws end at this times nside; pixels resolve twice nside.
KNOWN = 15 / 8
#: A map resolves beams of 1.5 pixels, and of 1.45 still well.
PIXELS = 1.45
#: Resolution of the paper's maps of indices [arcmin].
FWHM = {"beta_dust": 180.0, "beta_syn": 600.0}
#: Names as they are shown.
SYMBOLS = {"beta_dust": "β_dust", "beta_syn": "β_syn"}
#: What a map has that is drawn: the paper's mean; its scatter, of which the paper gives that of
#: the synchrotron only; and the exponent of its spectrum.
MEAN = {"beta_dust": 1.53, "beta_syn": 2.9}
SCATTER = {"beta_dust": 0.04, "beta_syn": 0.1}
SLOPE = -2.0
#: Pixels of an index, its resolution [arcmin], by how much it was made steeper (None if it was
#: drawn), and where it is from, as a part of a sentence.
Index: TypeAlias = tuple[Float[Array, " pix"], float, float | None, str]


class Impossible(ValueError):
    """A figure that the settings do not allow, and why in one sentence: the others go on."""


class Number(NamedTuple):
    """A number of the paper's text next to ours, and what is to be known about it."""

    what: str
    ours: str
    note: str = ""
    paper: str = ""


class PaperFigure(NamedTuple):
    """A figure or a table, by the paper's number ("Figure 1"), and the seconds that it took.

    The note of its section is on what differs from the paper, whose text gives the numbers.
    """

    label: str
    section: Section
    numbers: tuple[Number, ...] = ()
    seconds: float = 0.0


def filled(text: str, **words: Any) -> str:
    """A text of `paper.toml` on one line, its words in braces filled in."""
    return " ".join(text.format_map(words).split())


def picture_of(label: str) -> str:
    """Name of the picture of a figure."""
    return re.sub(r"\d+", lambda n: f"{int(n[0]):02d}", label.lower().replace(" ", "_")) + ".png"


class Layer(NamedTuple):
    """A `Source` of dust or synchrotron: of the paper's beam [arcmin] if its map has that."""

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
    """What is shared by the figures of one set of settings."""

    def __init__(self, settings: Experiment) -> None:
        self.settings = settings
        self.folder = Path(settings.data_dir)
        self.key = realisation_key(settings.seed)
        # Made once, at the first call.
        self.template = cache(self._template)
        self.continued = cache(self.with_small_scales)

    def forget_bands(self) -> None:
        """Forget the maps of the bands, the largest of all that is kept."""
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
    def description(self) -> str:
        """What the sky is, in a sentence."""
        if self.embedded:
            return filled(WORDS["model"])
        tables = self.settings.sky.components.items()
        files = [f"{name} {one.label}" for name, one in tables if one.file is not None]
        return filled(WORDS["files"], files=", ".join(files))

    @property
    def differs(self) -> str:
        """The part of a line that says what the sky is, for a figure that shows it."""
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
        """The same for a figure that shows observed maps."""
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
        """A figure with the texts of its label, filled in, and what the paper says of its numbers.

        Texts may name these words, tables of the settings, and what this `sky` knows of itself;
        other `texts` than those of the label are named by their heading in `paper.toml`.
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
            return embedded_galaxy(self.settings)
        return default_galaxy(NSIDE)

    @cached_property
    def inputs(self) -> Inputs:
        """Templates and maps of the bands."""
        return inputs_of(self.settings, galaxy=self.galaxy if self.embedded else None)

    @cached_property
    def comparison(self) -> Comparison:
        """The maps against the model, at the common resolution."""
        masks = region_masks(self.settings, self.settings.compare.regions)
        return compare(self.settings, prepared_maps(self.settings, self.inputs), masks)

    def _spec(self, law: str) -> tuple[str, ComponentTable]:
        found = [(n, spec) for n, spec in self.settings.sky.components.items() if spec.law == law]
        if len(found) != 1:
            raise Impossible(
                f"It takes one template of the law {law!r}, but there are {len(found)}."
            )
        return found[0]

    def _template(self, law: str) -> Layer:
        """Q, U of dust or synchrotron at the resolution of the paper's, as far as its map has it.

        Ranges of power laws that are beyond the multipoles of the map keep their ratio of ends.
        """
        name, _ = self._spec(law)
        galaxy = None if self.settings.sky.embedded is None else self.galaxy
        own = read_sky(self.settings, names=[name], galaxy=galaxy)[0][name]
        if missing := int(np.sum(~own.used)):
            raise SettingsError(
                f"sky.{name}: {missing} pixels have no value; the figures of the paper take "
                "maps of the full sky."
            )
        fwhm = max(own.fwhm, PAPER_FWHM[law])
        nside = healpy.npix2nside(own.used.size)
        maps = polarization_template(own.component.template, own.fwhm, fwhm, nside)
        numbers = getattr(self.settings.paper, law).model_dump(exclude={"correlated_with"})
        last = int(KNOWN * nside)
        for kind in ("EE", "BB"):
            first, end = numbers[kind]
            if end > last:
                numbers[kind] = max(2, round(first * last / end)), last
        with at_key(f"paper.{law}"):
            small = SmallScales(**numbers)
        assert isinstance(own.component, Dust | Synchrotron)  # by its law
        return Layer(dataclasses.replace(own.component, amplitude=maps), fwhm, small)

    @property
    def nside_fine(self) -> int:
        """Pixels that resolve the beam of the small scales."""
        nside = 8
        while PIXELS * healpy.nside2resol(nside, arcmin=True) > self.settings.paper.fwhm:
            nside *= 2
        return nside

    def with_small_scales(
        self, name: str, tilt: float = 0.0, kind: str = "small scales"
    ) -> Continued:
        """Dust or synchrotron with small scales, also tilted or drawn with keys of another kind.

        `continued` has those that are the same in all figures.
        """
        layer = self.template(name)
        small = dataclasses.replace(layer.small_scales, tilt=float(layer.small_scales.tilt) + tilt)
        key = stream(self.key, kind, name)
        return continue_templates(key, [layer.maps], [layer.fwhm], [small], self.nside_fine)

    def ame(self) -> tuple[Float[Array, "2 pix"], Float[Array, "2 pix"], str, str]:
        """Q, U of AME at 23 GHz and 1 degree, 1 % polarized along the dust, and those of the dust.

        Then their resolution in words, and where the intensity is from, as a part of a sentence.
        """
        dust, spec = self.template("dust"), self.settings.paper.ame
        nu_ref, own, nside = NU_AME, 0.0, dust.nside
        if spec is not None:
            found = read(self.folder, spec)
            if found.stokes not in (("I",), (None,), ("",)):
                raise SettingsError(
                    f"paper.ame.fields: must name one intensity map, not {', '.join(found.names)}."
                )
            if missing := int(np.sum(~np.asarray(found.mask))):
                raise SettingsError(f"paper.ame: {missing} pixels have no value.")
            nu_ref, own = spec.nu_ref, spec.fwhm or 0.0
            intensity = jnp.asarray(found.maps[0] * uK_RJ_per(found.unit, nu_ref, "paper.ame"))
            origin = f"the intensity of AME is {spec.label}"
            origin += f", from {nu_ref:g} to 23 GHz by the paper's law" * (nu_ref != NU_AME)
        else:
            intensity = self.galaxy.dust[0] / 2
            origin = (
                "there is no intensity of AME, and half of that of the embedded model's dust at "
                "353 GHz takes its place"
            )
        fwhm, pixel = max(AME_FWHM, own, dust.fwhm), healpy.nside2resol(nside, arcmin=True)
        resolution = f"a beam of {fwhm / 60:.3g}°"
        polarized = dust.maps
        if fwhm < PIXELS * pixel and intensity.size == polarized.shape[-1]:
            # Pixels are as wide as the beam; cut where they end, bright structures would ring.
            resolution = f"pixels of {pixel:.0f} arcmin"
        else:
            polarized = polarization_template(polarized, dust.fwhm, fwhm, nside)
            intensity = dust_index(intensity, own, fwhm, nside)
        ame = AME.from_dust_angles(intensity, polarized, nu_ref=nu_ref)
        return ame.template * ame.sed(NU_AME), polarized, resolution, origin

    def index(self, name: str) -> Index:
        """The map of beta_dust or beta_syn: of a file, of the template, or drawn."""
        layer = self.template("dust" if name == "beta_dust" else "synchrotron")
        held, nside = getattr(layer.component, name), layer.nside
        spec: BeamedMap | None = getattr(self.settings.paper, name)
        if spec is not None:
            return _read_index(self.folder, name, spec)
        if not isinstance(held, tuple) and held.ndim == 1:
            smooth = dust_index(held, 0.0, FWHM[name], nside)
            return smooth, FWHM[name], 0.0, f"{SYMBOLS[name]} is that of the template"
        return _drawn_index(stream(self.key, "index", name), name, min(NSIDE, nside))


def _drawn_index(key: Array, name: str, nside: int) -> Index:
    """A Gaussian field with the mean and the scatter of the paper's map."""
    lmax, fwhm = 2 * nside, FWHM[name]
    ell = jnp.arange(lmax + 1)
    power = jnp.where(ell < 1, 0.0, jnp.maximum(ell, 1.0) ** SLOPE) * gaussian_beam(fwhm, lmax) ** 2
    field = synthesis(gaussian_fields(key, power[None, None]), nside)[0]
    values = MEAN[name] + SCATTER[name] * (field - field.mean()) / field.std()
    origin = (
        f"{SYMBOLS[name]} is a Gaussian field of mean {MEAN[name]:g} and scatter {SCATTER[name]:g}"
    )
    return values, fwhm, None, origin


def _read_index(folder: Path, name: str, spec: BeamedMap) -> Index:
    """The index of a file, smoothed; that of the synchrotron made steeper, if so wished."""
    pure = spec if spec.unit is not None else spec.model_copy(update={"unit": ""})
    where, found = f"paper.{name}", read(folder, pure, stokes="", zeros_are_data=True)
    own, by = spec.fwhm or 0.0, 0.0
    origin, fwhm = f"{SYMBOLS[name]} is that of {spec.label}", max(FWHM[name], own)
    if name == "beta_syn" and bool(np.all(found.maps[:, found.mask] < 0)):
        found = dataclasses.replace(found, maps=np.asarray(from_pysm_beta(found.maps)))
        origin = f"{origin} with the other sign"
    stated = spec.missing is not None
    values, used = parameter_map(found, name, found.nside, where, stated=stated)
    smooth = dust_index(values, own, fwhm, found.nside, None if used.all() else used)
    if isinstance(spec, RadioIndexMap):
        given = spec.steepening
        by = _of_spectrum(folder, given) if isinstance(given, str) else given
        origin += f", made steeper by {by:.2f}" if by else ", not made steeper"
    return smooth + by, fwhm, by, origin


def _of_spectrum(folder: Path, file: str) -> float:
    """By how much a spectrum in a file steepens: frequency [GHz] and antenna temperature."""
    key = "paper.beta_syn.steepening"
    try:
        nu, temperature = read_text(find_file(folder, file)).numbers([0, 1]).T
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    with at_key(f"{key}: {file}"):
        return float(steepening(nu, temperature))
