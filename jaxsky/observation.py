"""What is observed, and how: components with their beams, bands with theirs, pixels.

Components are brought into harmonic space once, ready to be seen in any band: templates get their
small scales; a component whose law is the same everywhere is transformed once for all bands, one
whose parameters are maps a few times (`interpolation.choose_terms`).
"""

import math
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsky.bandpass import Bandpass, Samples, average, stack_bands
from jaxsky.checks import is_concrete
from jaxsky.components import Component
from jaxsky.harmonics import (
    analysis,
    expand,
    gaussian_beam,
    low_multipoles,
    resample,
    synthesis,
)
from jaxsky.interpolation import Terms, choose_terms, term, term_weights
from jaxsky.keys import stream
from jaxsky.printed import Printed, shown
from jaxsky.small_scales import SmallScales, continue_templates

#: Types of numbers by the name of their precision.
DTYPES: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}
#: Error of the varying laws, relative to the maps of a band.
TOLERANCE = 1e-7
#: Most Jacobi steps of an analysis; below nside 128, where the quadrature is worse, one more.
STEPS = 2


class Source(eqx.Module):
    """A component of the sky at the resolution of its template.

    Parameters
    ----------
    component : template and law; Q, U, or I, Q, U
    fwhm : own beam of the template [arcmin]
    small_scales : how the template is continued below its beam; None leaves it as it is
    correlated_with : name of a source whose small scales are drawn together with these
    """

    component: Component
    fwhm: Float[Array, ""] | float = 0.0
    small_scales: SmallScales | None = None
    correlated_with: str | None = eqx.field(static=True, default=None)


class ObservedBand(Printed, eqx.Module):
    """How a band is observed.

    Parameters
    ----------
    band : the bandpass
    beam : FWHM of a Gaussian [arcmin], or a table b_l
    target : beam to which the observed map is smoothed; None leaves it as observed
    noise : uniform level [uK_RJ arcmin], covariance of each pixel [uK_RJ^2], shape
        (stokes, stokes, pix), or None
    diagonal : noise with the diagonal of the Cholesky factor only (`noise.draw`)
    """

    band: Bandpass
    beam: Float[Array, ""] | Float[Array, " ell"] | float
    target: Float[Array, ""] | float | None = None
    noise: Float[Array, ""] | Float[Array, "stokes stokes pix"] | float | None = None
    diagonal: bool = eqx.field(static=True, default=False)

    def summary(self):
        beam, noise = self.beam, "none" if self.noise is None else "a covariance"
        if self.noise is not None and not jnp.ndim(self.noise):
            noise = shown(self.noise, "uK_RJ arcmin")
        rows = [
            ("center", shown(self.band.center, "GHz")),
            ("width", shown(self.band.nu[-1] - self.band.nu[0], "GHz")),
            ("beam", "a table b_l" if jnp.ndim(beam) else shown(beam, "arcmin")),
            ("noise", noise),
        ]
        return "Observed band", rows

    @property
    def map_beam(self) -> Float[Array, ""] | Float[Array, " ell"] | float:
        """Beam of the observed map: the target, or the own one."""
        return self.beam if self.target is None else self.target


class Observation(eqx.Module):
    """An experiment: channels by name, and the pixels of the maps.

    Parameters
    ----------
    channels : by name, in order
    nside : resolution of the maps
    stokes : "QU" or "IQU"
    finest : beam to which small scales are made [arcmin], at most the finest one observed
    lmax : largest multipole of the sky in the maps, by default 2 nside
    precision : "double" or "single", in which the maps are computed; single takes half the memory
        and rounds to 1e-7 of the rms of a map

    Raises
    ------
    ValueError
        If there is no channel, or `stokes` or `precision` is neither.
    """

    channels: dict[str, ObservedBand]
    nside: int = eqx.field(static=True)
    stokes: str = eqx.field(static=True, default="QU")
    finest: Float[Array, ""] | float = 0.0
    lmax: int = eqx.field(static=True, default=None)
    precision: str = eqx.field(static=True, default="double")
    names: tuple[str, ...] = eqx.field(static=True, init=False)

    def __post_init__(self) -> None:
        # JAX sorts dictionaries when it takes them apart.
        self.channels, self.names = dict(self.channels), tuple(self.channels)
        if self.lmax is None:
            self.lmax = 2 * self.nside
        if not self.channels:
            raise ValueError("Argument `channels` must have at least one channel.")
        for name, known in {"stokes": ("QU", "IQU"), "precision": tuple(DTYPES)}.items():
            if (value := getattr(self, name)) not in known:
                one, other = known
                raise ValueError(f"Argument `{name}` must be {one!r} or {other!r}, not {value!r}.")

    @property
    def dtype(self) -> type[np.floating]:
        """Type of the numbers in maps and coefficients."""
        return DTYPES[self.precision]

    @property
    def bands(self) -> tuple[Bandpass, ...]:
        """The bandpasses in order."""
        return tuple(self.channels[name].band for name in self.names)


class HarmonicSource(NamedTuple):
    """A component in harmonic space, ready to be seen in any band.

    Coefficients are those of the template times each term of its law, with its beam, `fwhm`
    [arcmin]; `weights` are those of the terms in each band. Where bands are averaged one by one
    there are no weights, but the law, with parameters at the resolution of the observation, and the
    template. At `repaired` multipoles the matrix of correlated small scales was repaired.
    """

    alms: tuple[Float[Array, "stokes alm"], ...]
    weights: tuple[Float[Array, " term"], ...] | None
    component: Component | None
    template: Float[Array, "stokes pix"] | None
    fwhm: Float[Array, ""] | float
    repaired: Int[Array, ""] | int = 0


def _continued(
    key: Array, sources: Mapping[str, Source], observation: Observation
) -> dict[str, tuple[Float[Array, "2 alm"], Int[Array, ""]]]:
    """Coefficients of the sources that have small scales, without beam, and how many repaired."""
    leaders = {
        name: source.correlated_with or name
        for name, source in sources.items()
        if source.small_scales is not None
    }
    result = {}
    for leader in sorted(set(leaders.values())):
        group = [leader, *sorted(n for n, first in leaders.items() if first == leader != n)]
        members = [sources[name] for name in group]
        try:
            continued = continue_templates(
                stream(key, "small scales", leader),
                [source.component.template.astype(float) for source in members],
                [source.fwhm for source in members],
                [source.small_scales for source in members if source.small_scales is not None],
                observation.nside,
                observation.lmax,
            )
        except ValueError as error:
            raise ValueError(f"Small scales of {', '.join(group)}: {error}") from None
        for name, alm in zip(group, continued.alms, strict=True):
            result[name] = alm, continued.repaired
    return result


def _at(component: Component, nside: int) -> Component:
    """A component whose parameters that are maps have the resolution of the observation."""

    def bring(leaf):
        if leaf.ndim != 1 or leaf.shape[-1] == healpy.nside2npix(nside):
            return leaf
        lmax = 2 * min(nside, healpy.npix2nside(leaf.shape[-1]))
        return resample(leaf[None], jnp.ones(lmax + 1, leaf.dtype), nside)[0]

    return jax.tree.map(bring, component)


def _law(component: Component) -> Component:
    """A component without the pixels of its template."""
    return jax.tree.map(
        lambda leaf: np.zeros((len(leaf), 0), leaf.dtype) if leaf.ndim == 2 else leaf, component
    )


def plan_terms(
    sources: Mapping[str, Source], observation: Observation, tolerance: float = TOLERANCE
) -> dict[str, Terms | None]:
    """Terms of each source for `harmonic_sources`, chosen from values that are not being traced.

    The tolerance is the error of varying laws relative to the maps of a band.
    """
    # Terms are for the ranges of the maps as they are used.
    components = {n: _at(source.component, observation.nside) for n, source in sources.items()}
    if any(leaf.ndim == 1 for leaf in jax.tree.leaves(components)):
        importance = _importance(components, stack_bands(observation.bands))
    else:
        importance = dict.fromkeys(components)
    return {
        name: choose_terms(component, observation.bands, importance[name], tolerance)
        for name, component in components.items()
    }


@jax.jit
def _importance(
    components: dict[str, Component], samples: Samples
) -> dict[str, Float[Array, " band"]]:
    """The rms of each template relative to all that is seen in each band.

    By its law in each band at the mean of its parameters.
    """
    rms, levels = {}, {}
    for name, component in components.items():
        middle = jax.tree.map(lambda x: x.mean() if x.ndim == 1 else x, component)
        rms[name] = jnp.sqrt(jnp.mean(component.template**2))
        levels[name] = rms[name] * jax.vmap(partial(average, middle.sed))(samples)
    total = jnp.sqrt(sum(level**2 for level in levels.values()))
    return {name: value / total for name, value in rms.items()}


def _iterations(size: float, nside: int, beam: Array | float) -> int:
    """Jacobi steps for a term that adds so much to the maps, for an error below `TOLERANCE`.

    Without steps a spectrum like that of the Galaxy is wrong by some 3e-5 of the map at nside
    256 and a beam of 2 pixels, in proportion to the pixel, and to what the beam leaves of the
    multipoles where the quadrature is bad. Each step gains at least a factor of 20.
    """
    pixels = float(beam) / healpy.nside2resol(nside, arcmin=True) if is_concrete(beam) else 0.0
    error = 3e-5 * (256 / nside) * (2 / max(pixels, 1.0)) ** 2 * size
    needed = math.ceil(math.log(max(error / TOLERANCE, 1.0)) / math.log(20))
    return min(needed, STEPS + (nside < 128))


def harmonic_sources(
    key: Array,
    sources: Mapping[str, Source],
    observation: Observation,
    terms: Mapping[str, Terms | None] | None = None,
    *,
    release: bool = False,
) -> dict[str, HarmonicSource]:
    """Sources with their small scales, which the key is for, in harmonic space.

    Terms are those of `plan_terms`, by default made here; None for a source averages its bands one
    by one, as is necessary where its parameters that are maps are being traced. `release` takes
    each source out of `sources`, a dict, when it has served, to free its memory.
    """
    _check_sources(sources, observation)
    terms = plan_terms(sources, observation) if terms is None else terms
    lmax, nside, dtype = observation.lmax, observation.nside, observation.dtype
    continued = _continued(key, sources, observation)
    result = {}
    for name in list(sources):
        chosen, component = terms[name], _law(_at(sources[name].component, nside))
        repaired: Array | int = 0
        fwhm = sources[name].fwhm
        if name in continued:
            (alm, repaired), fwhm = continued[name], 0.0
        else:
            alm = _low_multipoles(sources[name].component.template.astype(dtype), observation)
        alm = alm.astype(dtype)
        if release:
            assert isinstance(sources, dict)
            del sources[name]
        if chosen is not None and not chosen.counts:
            weights = term_weights(component, observation.bands, chosen)
            result[name] = HarmonicSource((alm,), weights, None, None, fwhm, repaired)
            continue
        if name in continued:
            fwhm = observation.finest
            alm = alm * expand(gaussian_beam(fwhm, lmax).astype(dtype))
        template = synthesis(alm, nside)
        if chosen is None:
            result[name] = HarmonicSource((), None, component, template, fwhm, repaired)
            continue
        alms = []
        for i, size in enumerate(chosen.sizes):
            steps = _iterations(size, nside, observation.finest)
            alms.append(_term_alm(template, component, chosen.coefs(i), lmax, steps))
            if is_concrete(alms[-1]):
                # JAX would make the maps of all terms ahead of their analysis.
                alms[-1].block_until_ready()
        weights = term_weights(component, observation.bands, chosen)
        result[name] = HarmonicSource(tuple(alms), weights, None, None, fwhm, repaired)
    return result


def _low_multipoles(
    template: Float[Array, "stokes pix"], observation: Observation
) -> Float[Array, "stokes alm"]:
    """Coefficients of a template, with the steps that its pixels need at the beam observed."""
    steps = _iterations(1.0, healpy.npix2nside(template.shape[-1]), observation.finest)
    return low_multipoles(template, observation.lmax, steps)


@partial(jax.jit, static_argnames=("lmax", "steps"))
def _term_alm(
    template: Float[Array, "stokes pix"],
    component: Component,
    coefs: Float[Array, "..."],
    lmax: int,
    steps: int,
) -> Float[Array, "stokes alm"]:
    """Coefficients of a template times a term of the law; in one program the product is no map."""
    return analysis(template * term(component, coefs).astype(template.dtype), lmax, steps)


def _check_sources(sources: Mapping[str, Source], observation: Observation) -> None:
    for name, source in sources.items():
        rows, wanted = len(source.component.template), observation.stokes
        if rows != len(wanted):
            raise ValueError(
                f"Component {name!r} has {rows} Stokes parameters, but {wanted} are observed."
            )
        if source.small_scales is not None and rows != 2:
            raise ValueError(
                f"Component {name!r} has small scales, which are added to Q and U only; observe "
                "stokes 'QU'."
            )
        leader = source.correlated_with
        if leader is not None and (
            leader not in sources
            or leader == name
            or sources[leader].small_scales is None
            or sources[leader].correlated_with is not None
            or source.small_scales is None
        ):
            raise ValueError(
                f"The small scales of {name!r} are to be correlated with those of {leader!r}: "
                "both need to be components with small scales, and the second one must not be "
                "correlated with yet another."
            )
