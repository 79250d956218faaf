"""What the figures are drawn from: templates, AME, maps of indices; each made once, when needed."""

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.paper.indices import Index, drawn_index, held_index, read_index
from fits.paper.item import Impossible
from jaxsky import AME, Dust, Synchrotron
from jaxsky.galaxy import EmbeddedSky
from jaxsky.inputs import Template, default_galaxy, embedded_galaxy, read, read_sky, uK_RJ_per
from jaxsky.keys import realisation_key, stream
from jaxsky.settings import ComponentTable, Experiment, IndexFile, SettingsError, SmallScalesTable
from jaxsky.small_scales import Continued, SmallScales, continue_templates
from jaxsky.templates import dust_index, polarization_template

#: Beams of the paper's templates [arcmin].
PAPER_FWHM = {"dust": 10.0, "synchrotron": 60.0}
#: Reference frequency of the AME [GHz], its resolution [arcmin] and nside, and those of its
#: correlation with the dust.
NU_AME, AME_FWHM, NSIDE = 23.0, 60.0, 64
#: Fits of power laws end at this times nside; pixels resolve twice nside.
KNOWN = 15 / 8
#: A map resolves beams of 1.5 pixels, and of 1.45 still well.
PIXELS = 1.45

#: What the embedded sky is.
MODEL = (
    "The sky is a model of the Galaxy, not data: emission is integrated along the line of sight "
    "through a spiral magnetic field with Gaussian turbulence, and scaled to the polarized rms of "
    "the real sky."
)

T = TypeVar("T")


class Layer(NamedTuple):
    """A foreground at the resolution of the paper's template, as far as the map has it.

    Parameters
    ----------
    component : template and law
    fwhm : beam of the template [arcmin]
    small : how it is continued to small scales
    clipped : if the ranges of the fits had to be moved to lower multipoles
    """

    component: Dust | Synchrotron
    fwhm: float
    small: SmallScales
    clipped: bool

    @property
    def maps(self) -> Float[Array, "2 pix"]:
        """Q and U of the template [uK_RJ]."""
        return self.component.template

    @property
    def nside(self) -> int:
        """Resolution of the template."""
        return healpy.npix2nside(self.maps.shape[-1])


class Ame(NamedTuple):
    """AME at 23 GHz.

    Parameters
    ----------
    maps : Q, U [uK_RJ]
    dust : Q, U of the dust at the same resolution [uK_RJ]
    resolution : in words
    origin : where the intensity is from, to be part of a sentence
    """

    maps: Float[Array, "2 pix"]
    dust: Float[Array, "2 pix"]
    resolution: str
    origin: str


class Sources:
    """What is shared by the figures of one set of settings.

    Parameters
    ----------
    settings : of the figures
    """

    def __init__(self, settings: Experiment) -> None:
        self.settings = settings
        self.folder = Path(settings.data_dir)
        self.key = realisation_key(settings.seed)
        self._made: dict[str, Any] = {}

    def once(self, name: str, make: Callable[[], T]) -> T:
        """What `make` returns, made at the first call with this name and kept."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

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
            return MODEL
        tables = self.settings.sky.components.items()
        files = ", ".join(f"{name} {one.label}" for name, one in tables if one.file is not None)
        return f"Templates from files: {files}."

    @property
    def sky_differs(self) -> str:
        """The part of a line that says what the sky is, for an item that shows it."""
        if self.embedded:
            assert self.settings.sky.embedded is not None
            return (
                "No maps are given: the sky is the embedded model of the Galaxy at nside "
                f"{self.settings.sky.embedded.nside} rather than Planck's Commander maps."
            )
        files = (
            f"{law} from {self._spec(law)[1].label} (nside {self.template(law).nside})"
            for law in PAPER_FWHM
        )
        return f"The templates are those that are given: {listed(files)}."

    @property
    def galaxy(self) -> EmbeddedSky:
        """The embedded model; where templates come from files, at low resolution."""
        if self.settings.sky.embedded is not None:
            return self.once("galaxy", lambda: embedded_galaxy(self.settings))
        return self.once("galaxy", lambda: default_galaxy(NSIDE))

    def _spec(self, law: str) -> tuple[str, ComponentTable]:
        found = [(n, spec) for n, spec in self.settings.sky.components.items() if spec.law == law]
        if len(found) != 1:
            raise Impossible(
                f"It takes one template of the law {law!r}, but there are {len(found)}."
            )
        return found[0]

    def _templates(self) -> dict[str, Template]:
        names = {law: self._spec(law)[0] for law in PAPER_FWHM}
        galaxy = None if self.settings.sky.embedded is None else self.galaxy
        templates, _ = read_sky(self.settings, names=list(names.values()), galaxy=galaxy)
        return {law: templates[name] for law, name in names.items()}

    def template(self, name: str) -> Layer:
        """The dust or the synchrotron."""
        return self.once(name, lambda: self._layer(name))

    def _layer(self, name: str) -> Layer:
        own = self.once("templates", self._templates)[name]
        if missing := int(np.sum(~own.used)):
            raise SettingsError(
                f"sky.{name}: {missing} pixels have no value; the figures of the paper take "
                "maps of the full sky."
            )
        fwhm = max(own.fwhm, PAPER_FWHM[name])
        nside = healpy.npix2nside(own.used.size)
        maps = polarization_template(own.component.template, own.fwhm, fwhm, nside)
        table: SmallScalesTable = getattr(self.settings.paper, name)
        small, clipped = _small_scales(table, nside)
        assert isinstance(own.component, Dust | Synchrotron)  # by its law
        component = dataclasses.replace(own.component, amplitude=maps)
        return Layer(component, fwhm, small, clipped)

    @property
    def nside_fine(self) -> int:
        """Pixels that resolve the beam of the small scales."""
        nside = 8
        while PIXELS * healpy.nside2resol(nside, arcmin=True) > self.settings.paper.fwhm:
            nside *= 2
        return nside

    def small_scales_key(self, name: str) -> Array:
        """The key of the small scales of a template, the same in all figures."""
        return stream(self.key, "small scales", name)

    def continued(self, name: str) -> Continued:
        """The dust or the synchrotron with small scales."""

        def make() -> Continued:
            layer = self.template(name)
            return continue_templates(
                self.small_scales_key(name),
                [layer.maps],
                [layer.fwhm],
                [layer.small],
                self.nside_fine,
            )

        return self.once(f"continued {name}", make)

    def ame(self) -> Ame:
        """AME at 1 degree, 1 % polarized along the dust."""
        return self.once("ame", self._ame)

    def _ame(self) -> Ame:
        dust, spec = self.template("dust"), self.settings.paper.ame
        nu_ref, own = NU_AME, 0.0
        if spec is not None:
            found = read(self.folder, spec)
            if found.stokes not in (("I",), (None,), ("",)):
                raise SettingsError(
                    f"paper.ame.fields: must name one intensity map, not {', '.join(found.names)}."
                )
            if missing := int(np.sum(~np.asarray(found.mask))):
                raise SettingsError(f"paper.ame: {missing} pixels have no value.")
            factor = uK_RJ_per(found.unit, float(spec.nu_ref or NU_AME), "paper.ame")
            intensity = jnp.asarray(found.maps[0] * factor)
            nu_ref, own = float(spec.nu_ref or NU_AME), spec.fwhm
            origin = f"the intensity of AME is {spec.label}"
            origin += f", from {nu_ref:g} to 23 GHz by the paper's law" * (nu_ref != NU_AME)
        else:
            intensity = self.galaxy.dust[0] / 2
            origin = (
                "there is no intensity of AME, and half of that of the embedded model's dust at "
                "353 GHz takes its place"
            )
        fwhm, pixel = max(AME_FWHM, own, dust.fwhm), healpy.nside2resol(dust.nside, arcmin=True)
        resolution = f"a beam of {fwhm / 60:.3g}°"
        polarized = dust.maps
        if fwhm < PIXELS * pixel and intensity.size == polarized.shape[-1]:
            # Pixels are as wide as the beam; cut where they end, bright structures would ring.
            resolution = f"pixels of {pixel:.0f} arcmin"
        else:
            polarized = polarization_template(polarized, dust.fwhm, fwhm, dust.nside)
            intensity = dust_index(intensity, own, fwhm, dust.nside)
        ame = AME.from_dust_angles(intensity, polarized, nu_ref=nu_ref)
        return Ame(ame.template * ame.sed(NU_AME), polarized, resolution, origin)

    def index(self, name: str) -> Index:
        """The map of beta_dust or beta_syn."""
        return self.once(name, lambda: self._index(name))

    def _index(self, name: str) -> Index:
        layer = self.template("dust" if name == "beta_dust" else "synchrotron")
        held = getattr(layer.component, name)
        spec: IndexFile | None = getattr(self.settings.paper, name)
        if spec is not None:
            return read_index(self.folder, name, spec)
        if not isinstance(held, tuple) and held.ndim == 1:
            return held_index(name, held)
        return drawn_index(stream(self.key, "index", name), name, min(NSIDE, layer.nside))


def _small_scales(table: SmallScalesTable, nside: int) -> tuple[SmallScales, bool]:
    """How a template is continued; ranges beyond its multipoles keep their ratio of ends."""
    last = int(KNOWN * nside)

    def clip(ends: tuple[int, int]) -> tuple[int, int]:
        if ends[1] <= last:
            return ends
        return max(2, round(ends[0] * last / ends[1])), last

    numbers = table.model_dump(exclude={"correlated_with"})
    ranges = {kind: clip(numbers[kind]) for kind in ("EE", "BB")}
    clipped = any(ranges[kind] != tuple(numbers[kind]) for kind in ranges)
    try:
        return SmallScales(**numbers | ranges), clipped
    except ValueError as error:
        raise SettingsError(f"paper: {error}") from None


def listed(words: Iterable[str]) -> str:
    """Words as a list in a sentence.

    Examples
    --------
    >>> listed(["a", "b", "c"])
    'a, b and c'
    """
    first = list(words)
    return " and ".join(filter(None, (", ".join(first[:-1]), *first[-1:])))
