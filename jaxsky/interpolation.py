"""Fast band averages of components, by interpolation in their spectral parameters.

The band-averaged law is a smooth function of the spectral parameters. Where these are maps, it is
summed over the band at a few Chebyshev nodes only and interpolated in every pixel. The cost per
pixel does not depend on the number of samples in the band, and the error is at most that asked
for: the number of nodes follows from the decay of the Chebyshev coefficients over the maps' range.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.polynomial.chebyshev import chebpts1, chebvander

from jaxsky.arrays import Map, Scalar
from jaxsky.bandpass import Bandpass, Samples, stack_bands
from jaxsky.checks import EXACT, is_concrete
from jaxsky.components import Component
from jaxsky.mesh import SUMS, at_once, extremes, over_pixels


class NodeCounts(NamedTuple):
    """Node counts for each parameter that is a map, and a tolerance if still to be checked."""

    counts: tuple[int, ...]
    tolerance: float | None = None


#: How a component is averaged (None for the direct sum), and each component of a sky.
Nodes: TypeAlias = NodeCounts | None
Plan: TypeAlias = tuple[Nodes, ...]

#: Most nodes tried; a law that they do not resolve is summed directly.
MAX_NODES = 33
#: Nodes used when JAX is tracing, so that the range of a map is unknown: error 1e-10 for indices
#: within +-0.7 and temperatures within 15-30 K, over any band from 20 to 900 GHz.
TRACED_NODES = 16
#: Pixels interpolated at once in many bands.
AT_ONCE = 4096
#: With more parameter maps than this, a tensor of nodes would cost more than the direct sum.
MAX_DIMENSIONS = 2


def _coefficients(values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return Chebyshev coefficients along every axis of a tensor of values at the nodes."""
    for axis, n in enumerate(values.shape):
        inverse = chebvander(chebpts1(n), n - 1).T * 2 / n
        inverse[0] /= 2
        own = jnp.asarray(inverse, values.dtype)
        moved = jnp.tensordot(own, values, axes=(1, axis), precision=EXACT)
        values = jnp.moveaxis(moved, 0, axis)
    return values


def _evaluate(coefs: Float[Array, "..."], *points: Map) -> Map:
    """Sum the series at points in [-1, 1]^d (one array per dimension), by Clenshaw's recurrence."""
    # The loops are unrolled: node counts are small, and everything fuses into one pass.
    if not points:
        return coefs
    t, *rest = points
    terms = [_evaluate(c, *rest) for c in coefs]
    if len(terms) == 1:
        return terms[0] * jnp.ones_like(t)
    high, higher = terms[-1], jnp.zeros_like(t)
    for term in terms[-2:0:-1]:
        high, higher = 2 * t * high - higher + term, high
    return t * high - higher + terms[0]


def _split(component: Component) -> tuple[list[Array], Callable[..., Component]]:
    """Return the parameters that are maps, and a function that puts other values in their place."""
    maps, rest = eqx.partition(component, lambda leaf: eqx.is_array(leaf) and leaf.ndim == 1)
    leaves, structure = jax.tree.flatten(maps)
    return leaves, lambda values: eqx.combine(jax.tree.unflatten(structure, values), rest)


def _range(values: Array) -> tuple[Array, Array]:
    """Return the middle and half-width of the values; a constant map gets a small width."""
    low, high = extremes(*jax.lax.stop_gradient((values.min(), values.max())))
    middle = (low + high) / 2
    # Wide enough that the slope of the series is not lost in the rounding of its values.
    least = float(jnp.finfo(values.dtype).eps) ** (1 / 3)
    return middle, jnp.maximum((high - low) / 2, least * (1 + jnp.abs(middle)))


@jax.jit
@over_pixels(SUMS)
def _tails(component: Component, samples: Samples) -> Float[Array, "maps node"]:
    """Bound the relative error of a series cut at each length, for each map, over all bands."""
    maps, rebuild = _split(component)

    def tail(values, band):
        line = jax.vmap(lambda *v: rebuild(v).band_average(band))(*values)
        coefs = jnp.abs(_coefficients(line))
        return jnp.cumsum(coefs[::-1])[::-1] / jnp.abs(line).min()

    ranges = [_range(m) for m in maps]
    grid = jnp.asarray(chebpts1(MAX_NODES))
    worst = []
    for axis in range(len(maps)):
        lines = []  # at the ends and the middle of the ranges of the others
        for corner in itertools.product((-1.0, 0.0, 1.0), repeat=len(maps) - 1):
            unit: list[Any] = [*corner[:axis], grid, *corner[axis:]]
            values = [mid + half * u for (mid, half), u in zip(ranges, unit, strict=True)]
            values = [jnp.broadcast_to(v, (MAX_NODES,)) for v in values]
            lines.append(jax.vmap(partial(tail, values))(samples))
        worst.append(jnp.concatenate(lines).max(axis=0))
    return jnp.stack(worst)


def choose_nodes(component: Component, bands: tuple[Bandpass, ...], tolerance: float) -> Nodes:
    """Choose node counts for a relative tolerance; None if the direct sum is better, or no map."""
    maps, _ = _split(component)
    if not maps or len(maps) > MAX_DIMENSIONS or tolerance <= 0 or not component.smooth:
        return None
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves((component, bands))):
        return NodeCounts((TRACED_NODES,) * len(maps), tolerance)
    with jax.ensure_compile_time_eval():  # also where other parts of a sky are traced
        tails = np.asarray(_tails(component, stack_bands(bands)))
    # A series of n terms leaves out the tail from n on; below the floor that is rounding.
    floor = 8 * np.finfo(tails.dtype).eps
    resolved = tails <= max(tolerance / (2 * len(maps)), floor)
    if not resolved.any(axis=1).all():
        return None
    return NodeCounts(tuple(int(max(first, 2)) for first in resolved.argmax(axis=1)))


@partial(jax.jit, static_argnames="counts")
def _series(
    component: Component, band: Bandpass | Samples, counts: tuple[int, ...]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return coefficients of the band average and values at the nodes, an axis per map."""
    maps, rebuild = _split(component)
    if not maps:
        value = component.band_average(band)
        return value, value
    axes = [
        mid + half * jnp.asarray(chebpts1(n), mid.dtype)
        for (mid, half), n in zip(map(_range, maps), counts, strict=True)
    ]
    mesh = [axis.ravel() for axis in jnp.meshgrid(*axes, indexing="ij")]
    values = jax.vmap(lambda *v: rebuild(v).band_average(band))(*mesh).reshape(counts)
    return _coefficients(values), values


@partial(jax.jit, static_argnames="counts")
def _all_series(
    component: Component, samples: Samples, counts: tuple[int, ...]
) -> Float[Array, "band node"]:
    """Return the coefficients of `_series` in each band."""
    return jax.vmap(lambda band: _series(component, band, counts)[0].ravel())(samples)


def _points(component: Component) -> list[Map]:
    """Return the parameters that are maps, scaled to [-1, 1]."""
    maps, _ = _split(component)
    ranges = map(_range, maps)
    return [(values - middle) / half for values, (middle, half) in zip(maps, ranges, strict=True)]


class Terms(NamedTuple):
    """Combinations of Chebyshev polynomials that span the band averages of a component."""

    vectors: Float[np.ndarray, "term node"]  # orthonormal Chebyshev coefficients
    counts: tuple[int, ...]  # of nodes along each parameter map
    sizes: tuple[float, ...]  # bounds of what each term adds to the maps, relative to these

    def coefs(self, index: int) -> Float[np.ndarray, "..."]:
        """Return Chebyshev coefficients of a term in the scaled parameters that are maps."""
        return self.vectors[index].reshape(self.counts)


def choose_terms(
    component: Component,
    bands: tuple[Bandpass, ...],
    importance: Float[Array, " band"] | None,
    tolerance: float,
) -> Terms | None:
    """Find the fewest maps whose linear combinations give a component's emission in all bands.

    The singular values of the law's matrix (band, node) fall fast, so a few combinations of
    polynomials serve all bands, and linear operations (a transform) are applied to these only.
    `importance` times the law is the component's size relative to the maps of a band, and so is
    the tolerance. Returns one constant term where no parameter is a map, and None where bands are
    better averaged one by one.
    """
    if not _split(component)[0]:
        return Terms(np.ones((1, 1)), (), (1.0,))
    nodes = choose_nodes(component, bands, tolerance)
    if nodes is None or nodes.tolerance is not None:
        return None
    series = np.asarray(_all_series(component, stack_bands(bands), nodes.counts))
    weighted = np.asarray(importance)[:, None] * series
    _, sizes, vectors = np.linalg.svd(weighted, full_matrices=False)
    kept = max(1, int(np.sum(sizes > tolerance)))
    return Terms(vectors[:kept], nodes.counts, tuple(map(float, sizes[:kept])))


def term_weights(
    component: Component, bands: tuple[Bandpass, ...], terms: Terms
) -> tuple[Float[Array, " term"], ...]:
    """Return the weight of each term of a component in each band."""
    return _weights(component, stack_bands(bands), terms.vectors, terms.counts)


def weight_matrix(
    component: Component, bands: tuple[Bandpass, ...], terms: Terms
) -> Float[Array, "band term"]:
    """Return `term_weights` as one array: a tuple of thousands takes a minute to compile."""
    return _weight_matrix(component, stack_bands(bands), terms.vectors, terms.counts)


@partial(jax.jit, static_argnames="counts")
def _weights(component, samples, vectors, counts):
    return tuple(_weight_matrix(component, samples, vectors, counts))


@partial(jax.jit, static_argnames="counts")
def _weight_matrix(component, samples, vectors, counts):
    return jnp.dot(_all_series(component, samples, counts), vectors.T, precision=EXACT)


@jax.jit
def term(component: Component, coefs: Float[Array, "..."]) -> Map:
    """Evaluate a term (`Terms.coefs`) in each pixel; a number if no parameter is a map."""
    return _evaluate(coefs, *_points(component))


def band_sed(component: Component, band: Bandpass, nodes: Nodes) -> Scalar | Map:
    """Return the band-averaged law of a component: a number, or a map if a parameter is one."""
    if nodes is None:
        return component.band_average(band)
    coefs, values = _series(component, band, nodes.counts)
    points = _points(component)
    if nodes.tolerance is None:
        return _evaluate(coefs, *points)
    return jax.lax.cond(
        _resolved(coefs, values, nodes.tolerance),
        lambda: _evaluate(coefs, *points),
        lambda: component.band_average(band),
    )


def _resolved(
    coefs: Float[Array, "..."], values: Float[Array, "..."], tolerance: float
) -> Bool[Array, ""]:
    """Return whether a series is long enough; `values` are those at its nodes."""
    # The last two orders along each axis bound the contribution of the orders left out.
    size = jnp.abs(coefs)
    tail = sum(jnp.moveaxis(size, axis, 0)[-2:].sum() for axis in range(size.ndim))
    limit = max(tolerance, 8 * float(jnp.finfo(values.dtype).eps))
    return tail <= limit * jnp.abs(values).min()


def band_seds(
    component: Component, samples: Samples, nodes: Nodes
) -> Float[Array, " band"] | Float[Array, "pix band"]:
    """Compute `band_sed` in many bands (`stack_bands`) by matrix products: one small program."""
    maps, _ = _split(component)
    if not maps:
        return component.band_average(samples)

    def direct():
        return jax.lax.map(lambda band: component.band_average(band), samples).T

    if nodes is None:
        return direct()
    coefs, values = jax.vmap(lambda band: _series(component, band, nodes.counts))(samples)

    @jax.checkpoint
    def pixel(points):
        product = coefs
        for n, point in zip(nodes.counts[::-1], points[::-1], strict=True):
            polynomials = [jnp.ones_like(point), point]
            for _ in range(n - 2):
                polynomials.append(2 * point * polynomials[-1] - polynomials[-2])
            product = jnp.matmul(product, jnp.stack(polynomials[:n]), precision=EXACT)
        return product

    def interpolated():
        return jax.lax.map(pixel, _points(component), batch_size=at_once(AT_ONCE))

    if nodes.tolerance is None:
        return interpolated()
    enough = jax.vmap(partial(_resolved, tolerance=nodes.tolerance))(coefs, values).all()
    return jax.lax.cond(enough, interpolated, direct)
