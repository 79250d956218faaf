"""Simulate observations of the sky: the paper's procedure as a function of its parameters.

Components are first taken to harmonic space, for use in any band: templates get their small
scales; a component whose law is the same everywhere is transformed once for all bands, one whose
parameters are maps a few times (`interpolation.choose_terms`). For each band in turn, components
are scaled to the band, smoothed to its beam and summed in harmonic space, and noise is added. With
fixed keys the maps are differentiable in all numbers: spectral parameters, slopes and amplitudes of
small scales, beams, band centres.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial, reduce
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsky.arrays import Alm, BandMaps, Scalar, StokesMaps, Window
from jaxsky.bandpass import Samples, stack_bands
from jaxsky.checks import is_concrete
from jaxsky.cmb import realisation
from jaxsky.components import Component
from jaxsky.harmonics import (
    analysis,
    beam_ratio,
    expand,
    gaussian_beam,
    low_multipoles,
    resample,
    synthesis,
)
from jaxsky.interpolation import Terms, choose_terms, term, term_weights
from jaxsky.noise import draw, stream, uniform_alm, uniform_map
from jaxsky.observation import Observation, ObservedBand, Source, check_sources
from jaxsky.small_scales import continue_templates

#: Error allowed from laws that vary over the sky, relative to the maps of a band.
TOLERANCE = 1e-7
#: Most Jacobi steps per analysis; one more below nside 128, where the quadrature is worse.
STEPS = 2


class HarmonicSource(NamedTuple):
    """A component in harmonic space, ready to be observed in any band.

    `alms` are the coefficients of the template times each term of its law, with the template's
    beam, `fwhm` [arcmin]; `weights` are those of the terms in each band. Where bands are averaged
    one by one, `component` (the law with parameters at the observation's resolution) and `template`
    replace them. At `repaired` multipoles the matrix of correlated small scales was repaired.
    """

    alms: tuple[Alm, ...]
    weights: tuple[Float[Array, " term"], ...]
    fwhm: Scalar | float
    repaired: Int[Array, ""] | int = 0
    component: Component | None = None
    template: StokesMaps | None = None


def _continued(
    key: Array, sources: Mapping[str, Source], observation: Observation
) -> dict[str, tuple[Float[Array, "2 alm"], Int[Array, ""]]]:
    """Return coefficients of sources with small scales, without beam, and repaired multipoles."""
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
    """Return a component with its parameter maps at the resolution of the observation."""

    def bring(leaf):
        if leaf.ndim != 1 or leaf.shape[-1] == healpy.nside2npix(nside):
            return leaf
        lmax = 2 * min(nside, healpy.npix2nside(leaf.shape[-1]))
        return resample(leaf[None], jnp.ones(lmax + 1, leaf.dtype), nside)[0]

    return jax.tree.map(bring, component)


def _law(component: Component) -> Component:
    """Return a component without the pixels of its template."""
    return jax.tree.map(
        lambda leaf: np.zeros((len(leaf), 0), leaf.dtype) if leaf.ndim == 2 else leaf, component
    )


def plan_terms(
    sources: Mapping[str, Source], observation: Observation, tolerance: float = TOLERANCE
) -> dict[str, Terms | None]:
    """Choose the terms of each source for `harmonic_sources`, from values that are not traced."""
    # Terms depend on the ranges of the parameter maps at the resolution at which they are used.
    components = {n: _at(source.component, observation.nside) for n, source in sources.items()}
    varying = any(leaf.ndim == 1 for leaf in jax.tree.leaves(components))
    importance = _importance(components, stack_bands(observation.bands)) if varying else {}
    return {
        name: choose_terms(component, observation.bands, importance.get(name), tolerance)
        for name, component in components.items()
    }


@jax.jit
def _importance(
    components: dict[str, Component], samples: Samples
) -> dict[str, Float[Array, " band"]]:
    """Return the rms of each template relative to the total rms in each band."""
    rms, levels = {}, {}
    for name, component in components.items():
        # For the total, each law is taken at the mean of its parameters.
        middle = jax.tree.map(lambda x: x.mean() if x.ndim == 1 else x, component)
        rms[name] = jnp.sqrt(jnp.mean(component.template**2))
        levels[name] = rms[name] * middle.band_average(samples)
    total = jnp.sqrt(sum(level**2 for level in levels.values()))
    return {name: value / total for name, value in rms.items()}


def _iterations(size: float, nside: int, beam: Array | float) -> int:
    """Return the Jacobi steps for an error below `TOLERANCE` from a term of this relative size."""
    # Without steps a spectrum like the Galaxy's is wrong by some 3e-5 of the map at nside 256 with
    # a beam of 2 pixels. The error scales with the pixel size and with what the beam leaves of the
    # multipoles where the quadrature is poor. Each step gains at least a factor of 20.
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
    """Add small scales to the sources and take them to harmonic space.

    The key is for the small scales. `terms` come from `plan_terms`, by default called here; None
    for a source averages its bands one by one, which is necessary if its parameter maps are being
    traced. `release` removes each source from `sources`, a dict, once used, to free its memory.
    """
    check_sources(sources, observation)
    terms = plan_terms(sources, observation) if terms is None else terms
    lmax, nside, dtype = observation.lmax, observation.nside, observation.dtype
    finest = observation.finest
    continued = _continued(key, sources, observation)
    result = {}
    for name in list(sources):
        chosen, component = terms[name], _law(_at(sources[name].component, nside))
        fwhm: Array | float = 0.0
        repaired: Array | int = 0
        if name in continued:
            alm, repaired = continued[name]
        else:
            template, fwhm = sources[name].component.template.astype(dtype), sources[name].fwhm
            # As many steps as its pixels need at the observed beam.
            steps = _iterations(1.0, healpy.npix2nside(template.shape[-1]), finest)
            alm = low_multipoles(template, lmax, steps)
        alm = alm.astype(dtype)
        if release:
            assert isinstance(sources, dict)
            del sources[name]
        alms = [alm]
        if chosen is None or chosen.counts:
            if name in continued:
                fwhm = finest
                alm = alm * expand(gaussian_beam(fwhm, lmax).astype(dtype))
            alms, template = [], synthesis(alm, nside)
        if chosen is None:
            result[name] = HarmonicSource((), (), fwhm, repaired, component, template)
            continue
        for i, size in enumerate(chosen.sizes if chosen.counts else ()):
            steps = _iterations(size, nside, finest)
            alms.append(_term_alm(template, component, chosen.coefs(i), lmax, steps))
            if is_concrete(alms[-1]):
                # Otherwise JAX would make the maps of all terms before analysing any.
                alms[-1].block_until_ready()
        weights = term_weights(component, observation.bands, chosen)
        result[name] = HarmonicSource(tuple(alms), weights, fwhm, repaired)
    return result


@partial(jax.jit, static_argnames=("lmax", "steps"))
def _term_alm(
    template: StokesMaps, component: Component, coefs: Float[Array, "..."], lmax: int, steps: int
) -> Alm:
    """Analyse a template times a term of the law, in one program to avoid storing the product."""
    return analysis(template * term(component, coefs).astype(template.dtype), lmax, steps)


class _Part(NamedTuple):
    """The contribution of a component to a band: coefficients, their weights, and one window."""

    alms: tuple[Alm, ...]
    weights: Float[Array, " term"] | tuple[Scalar | float, ...]
    window: Window


@jax.jit
def _summed(parts: tuple[_Part, ...]) -> Alm:
    """Sum the parts in one pass, in the precision of the coefficients."""
    dtype = parts[0].alms[0].dtype
    return sum(
        expand(window.astype(dtype))
        * sum(jnp.asarray(w, dtype) * a for w, a in zip(weights, alms, strict=True))
        for alms, weights, window in parts
    )


def _noise(
    key: Array, channel: ObservedBand, observation: Observation
) -> _Part | StokesMaps | None:
    """Draw the noise of a channel, in harmonic space or as a map, whichever is simpler."""
    if channel.noise is None:
        return None
    noise = jnp.asarray(channel.noise, observation.dtype)
    stokes, nside, lmax = len(observation.stokes), observation.nside, observation.lmax
    white = draw(key, noise, diagonal=channel.diagonal) if noise.ndim else None
    if channel.target is None:
        return uniform_map(key, noise, nside, stokes) if white is None else white
    window = beam_ratio(channel.target, channel.beam, lmax, "the channel")
    if white is not None:
        return resample(white, window.astype(observation.dtype), nside)
    # Uniform noise stays isotropic when it is smoothed.
    return _Part((uniform_alm(key, noise, lmax, stokes),), (1.0,), window)


def observe_bands(
    key: Array,
    prepared: Mapping[str, HarmonicSource],
    observation: Observation,
    cmb: Float[Array | np.ndarray, "4 ell"] | None = None,
    *,
    components: bool = False,
    names: Sequence[str] | None = None,
) -> Iterator[tuple[str, dict[str, StokesMaps]]]:
    """Yield the name and maps [uK_RJ] of each channel in turn, so that only one is in memory.

    The key is for CMB and noise. `cmb` has the spectra TT, EE, BB, TE [uK_CMB^2] up to at least the
    observation's lmax. The maps are the "total" and, with `components`, each component, "cmb" and
    "noise". Maps do not depend on which channels are asked for (`names`, by default all).
    """
    nside, lmax, stokes = observation.nside, observation.lmax, observation.stokes
    if taken := {"cmb", "noise", "total"} & set(prepared):
        raise ValueError(f"A component cannot be called {taken.pop()!r}, as another map is.")
    for name, channel in observation.channels.items():
        if not prepared and cmb is None and channel.noise is None:
            raise ValueError(
                f"Nothing is left to be observed in band {name!r}: no component, no CMB, no noise."
            )
    if cmb is not None:
        if cmb.shape[-1] <= lmax:
            raise ValueError(
                f"The spectra of the CMB end at l = {cmb.shape[-1] - 1}, but nside {nside} "
                f"needs {lmax}."
            )
        spectra = cmb[:, : lmax + 1].astype(observation.dtype)
        cmb_alm = realisation(stream(key, "cmb"), spectra, stokes)
    for i, name in enumerate(observation.names):
        if names is not None and name not in names:
            continue
        channel = observation.channels[name]
        parts = {
            which: _seen(source, channel, i, lmax, which) for which, source in prepared.items()
        }
        if cmb is not None:
            factor = channel.band.conversion("uK_CMB", "uK_RJ")
            parts["cmb"] = _Part((cmb_alm,), (factor,), beam_ratio(channel.map_beam, 0.0, lmax))
        noise = _noise(stream(key, "noise", name), channel, observation)
        if isinstance(noise, _Part):
            parts["noise"], noise = noise, None
        yield name, _maps(parts, noise, nside, components)


def _maps(
    parts: Mapping[str, _Part], noise: StokesMaps | None, nside: int, components: bool
) -> dict[str, StokesMaps]:
    """Return the total of a band, and its components on request."""
    maps: dict[str, StokesMaps] = {}
    if components:
        maps = {which: synthesis(_summed((part,)), nside) for which, part in parts.items()}
    elif parts:
        maps = {"sky": synthesis(_summed(tuple(parts.values())), nside)}
    if noise is not None:
        maps["noise"] = noise
    total = reduce(jnp.add, maps.values())
    return {**maps, "total": total} if components else {"total": total}


def _seen(source: HarmonicSource, channel: ObservedBand, index: int, lmax: int, name: str) -> _Part:
    """Return the contribution of a component to a band."""
    window = beam_ratio(channel.map_beam, source.fwhm, lmax, f"component {name!r}")
    if source.component is None or source.template is None:
        return _Part(source.alms, source.weights[index], window)
    law = source.component.band_average(channel.band)
    seen = source.template * law.astype(source.template.dtype)
    return _Part((analysis(seen, lmax),), (1.0,), window)


def simulate(
    key: Array,
    sources: Mapping[str, Source],
    observation: Observation,
    cmb: Float[Array | np.ndarray, "4 ell"] | None = None,
    *,
    terms: Mapping[str, Terms | None] | None = None,
) -> BandMaps:
    """Simulate the maps of all channels [uK_RJ]: `harmonic_sources`, then `observe_bands`.

    With a fixed key, differentiable in sources and observation.

    Parameters
    ----------
    key : key of jax.random
    sources, observation : what is observed, and how
    cmb : spectra TT, EE, BB, TE [uK_CMB^2], or None for no CMB
    terms : see `harmonic_sources`

    Raises
    ------
    TypeError, ValueError
        If `sources` is no dictionary of Source, inputs do not match, or a beam is finer than that
        of a component without small scales.
    """
    prepared = harmonic_sources(key, sources, observation, terms)
    seen = observe_bands(key, prepared, observation, cmb)
    return jnp.stack([maps["total"] for _, maps in seen])
