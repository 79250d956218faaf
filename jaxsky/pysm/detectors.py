"""The emission of components in thousands of bands, each a few multiplications per pixel.

The band averages of a law whose parameters are maps are combinations of a few maps, the same for
all bands (`jaxsky.interpolation.choose_terms`), so that maps of all bands are one matrix product.
"""

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxsky.bandpass import Bandpass, stack_bands
from jaxsky.checks import EXACT
from jaxsky.interpolation import Terms, band_seds, choose_terms, term, weight_matrix
from jaxsky.pysm.emission import TOLERANCE, Part, above_cut, emission_of, iqu


def _terms(part: Part, bands: tuple[Bandpass, ...]) -> Terms | None:
    """Return the maps that span the emission of a component, accurate relative to each band."""
    laws = np.atleast_2d(band_seds(part.ends, stack_bands(bands), None))
    size = np.abs(laws).min(axis=0)
    if not size.all():
        return None if len(laws) > 1 else choose_terms(part.ends, bands, None, TOLERANCE)
    return choose_terms(part.ends, bands, jnp.asarray(1 / size), TOLERANCE)


@jax.jit
def _map(component, coefs):
    """Return I, Q, U of a term, shape (3, pix)."""
    return iqu(component.template * term(component, coefs))


@jax.jit
def _combined(weights, maps):
    """Return I, Q, U in each band from the weights of maps, (band, term) and (term, 3, pix)."""
    return jnp.tensordot(weights, maps, axes=1, precision=EXACT)


def emission_in_bands(
    parts: Sequence[Part], bands: Sequence[Bandpass], factors: np.ndarray, at_once: int
) -> Iterator[np.ndarray]:
    """Yield I, Q, U [uK_RJ] in each band, times its factor, shape (3, pix), `at_once` computed."""
    weights: list[np.ndarray] = []
    maps, others = [], []
    for part in parts:
        own = tuple(map(above_cut, bands)) if part.cut else tuple(bands)
        terms = _terms(part, own)
        if terms is None:
            others.append(part)
            continue
        coefs = [terms.coefs(index) for index in range(len(terms.sizes))]
        maps += [_map(part.ready, jnp.asarray(one)) for one in coefs]
        weights.append(np.asarray(weight_matrix(part.ends, own, terms)))
    if maps:
        together, shared = jnp.stack(maps), np.concatenate(weights, axis=1) * factors[:, None]
    for start in range(0, len(bands), at_once):
        block = slice(start, start + at_once)
        found = np.asarray(_combined(shared[block], together)) if maps else None
        for i, band in enumerate(bands[block]):
            seen = np.zeros((3, 1)) if found is None else found[i]
            yield seen + emission_of(others, band, factors[start + i]) if others else seen
