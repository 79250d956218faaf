"""Observing the sky with an experiment: the paper's procedure as a function of its parameters.

Every component, prepared once (`jaxsky.observation`), is scaled to a band, all are brought to the
band's beam and added up in harmonic space, and noise is added; bands are made one by one. With
fixed keys the maps are differentiable in all numbers: spectral parameters, slopes and amplitudes
of small scales, beams, band centres.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.cmb import realisation
from jaxsky.harmonics import analysis, beam_ratio, expand, resample, synthesis
from jaxsky.interpolation import Terms, band_sed
from jaxsky.keys import stream
from jaxsky.noise import draw, uniform_alm, uniform_map
from jaxsky.observation import HarmonicSource, Observation, ObservedBand, Source, harmonic_sources


class _Part(NamedTuple):
    """What one component adds to a band: coefficients, their weights, and a window for all."""

    alms: tuple[Float[Array, "stokes alm"], ...]
    weights: Float[Array, " term"] | tuple[Float[Array, ""] | float, ...]
    window: Float[Array, " ell"]


@jax.jit
def _summed(parts: tuple[_Part, ...]) -> Float[Array, "stokes alm"]:
    """The sum of the parts, in one pass and the precision of the coefficients."""
    dtype = parts[0].alms[0].dtype
    return sum(
        expand(window.astype(dtype))
        * sum(jnp.asarray(w, dtype) * a for w, a in zip(weights, alms, strict=True))
        for alms, weights, window in parts
    )


def _noise(
    key: Array, channel: ObservedBand, observation: Observation
) -> _Part | Float[Array, "stokes pix"] | None:
    """Noise of a channel in harmonic space or as a map, whichever it is simpler in."""
    if channel.noise is None:
        return None
    noise = jnp.asarray(channel.noise, observation.dtype)
    stokes, nside, lmax = len(observation.stokes), observation.nside, observation.lmax
    if channel.target is None:
        if noise.ndim:
            return draw(key, noise, diagonal=channel.diagonal)
        return uniform_map(key, noise, nside, stokes)
    window = beam_ratio(channel.target, channel.beam, lmax, "the channel")
    if noise.ndim:
        white = draw(key, noise, diagonal=channel.diagonal)
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
) -> Iterator[tuple[str, dict[str, Float[Array, "stokes pix"]]]]:
    """Names of the channels and their maps [uK_RJ] in turn, so that only one is in memory.

    The key is for CMB and noise. Spectra of the CMB are TT, EE, BB, TE [uK_CMB^2] up to 2 nside at
    least. There is the "total", and with `components` the map of each of these, of "cmb" and
    "noise". What the channels show does not depend on which are asked for (`names`, default all).
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
            parts["noise"] = noise
        yield name, _maps(parts, noise, nside, components)


def _maps(
    parts: Mapping[str, _Part],
    noise: _Part | Float[Array, "stokes pix"] | None,
    nside: int,
    components: bool,
) -> dict[str, Float[Array, "stokes pix"]]:
    """The total of a band, and its components if they are wanted."""
    maps = {}
    if components:
        maps = {which: synthesis(_summed((part,)), nside) for which, part in parts.items()}
        total = sum(maps.values())
    elif parts:
        total = synthesis(_summed(tuple(parts.values())), nside)
    else:
        total = 0.0
    if noise is not None and not isinstance(noise, _Part):
        total = total + noise
        maps = {**maps, "noise": noise} if components else maps
    return {**maps, "total": jnp.asarray(total)}


def _seen(
    source: HarmonicSource,
    channel: ObservedBand,
    index: int,
    lmax: int,
    name: str,
) -> _Part:
    """A component in a band."""
    window = beam_ratio(channel.map_beam, source.fwhm, lmax, f"component {name!r}")
    if source.weights is not None:
        return _Part(source.alms, source.weights[index], window)
    # Kept where there are no weights.
    assert source.component is not None
    assert source.template is not None
    law = band_sed(source.component, channel.band, None)
    seen = source.template * law.astype(source.template.dtype)
    return _Part((analysis(seen, lmax),), (1.0,), window)


def simulate(
    key: Array,
    sources: Mapping[str, Source],
    observation: Observation,
    cmb: Float[Array | np.ndarray, "4 ell"] | None = None,
    *,
    terms: Mapping[str, Terms | None] | None = None,
) -> Float[Array, "band stokes pix"]:
    """Simulated maps of all channels [uK_RJ]: `harmonic_sources` and `observe_bands` in one.

    Differentiable in sources and observation with a fixed key.

    Parameters
    ----------
    key : of jax.random
    sources, observation : what is observed, and how
    cmb : spectra TT, EE, BB, TE [uK_CMB^2], or None
    terms : see `harmonic_sources`

    Raises
    ------
    ValueError
        If a beam is finer than that of a component without small scales.
    """
    prepared = harmonic_sources(key, sources, observation, terms)
    seen = observe_bands(key, prepared, observation, cmb)
    return jnp.stack([maps["total"] for _, maps in seen])
