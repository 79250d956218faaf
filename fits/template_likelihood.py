"""Likelihoods of the parameters of a sky, given maps in bands.

All are a sum of squares of `residuals(params)`, a jitted and differentiable function of a plain
dict of parameters, so the grid, the optimiser and the sampler share one definition:

* "diagonal", the paper's: sum over pixels of (data - model)^2 / sigma^2.
* "exact": the data reduced to their inner products with the templates, y = T^T W d, with the
  exact covariance of y (`fits.common`). Smoothed noise is correlated between pixels and the
  CMB between bands; the diagonal form ignores both and so misstates its errors, while y is
  linear in the data, hence Gaussian with a covariance that can be computed.

Both exist on inner products formed once (`TemplateLikelihood`) and, for spectral parameters that
vary from pixel to pixel, pixel by pixel (`PixelLikelihood`), and agree where both apply.

Names of parameters are those of the sky ("dust.beta_dust"), of bands (`fits.mixing`), which are
calibrated on the CMB, and "offset.<band>.<stokes>", a constant added to the model [uK_RJ].

If an angle is free, Q of a band also contains U of the templates, and U their Q: these are then
added as further templates after the others.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from fits import products
from fits.mixing import Mixing, TemplateErrors, check_signal, named_bands, unit_sky
from fits.posterior import Likelihood
from fits.systems import square_root
from jaxsky import Bandpass, Sky, observe_components, parameter_names
from jaxsky.arrays import STOKES
from jaxsky.checks import Numeric, as_array, check_double, check_shape
from jaxsky.interpolation import NodeCounts, Nodes
from jaxsky.io.stacks import Stack
from jaxsky.mesh import SUMS, along, maps_of, of_own, over_pixels, spread, total, typed
from jaxsky.sky import OFFSET, interpolation_nodes, unknown_parameter

#: Covariance of the inner products <rows, data>: (band, row, stokes, pix) -> square matrix over
#: (band, row) flattened. `fits.common.Fluctuations.covariance` is one.
CovarianceOf = Callable[[Any], Float[np.ndarray, "row row"]]


class SkyLikelihood(Likelihood):
    """Base class of likelihoods whose amplitudes are the templates.

    `values` counts pixels with weight, or amplitudes for the exact form.
    """

    mixing: Mixing
    #: Stokes parameters of the maps
    stokes: str = eqx.field(static=True)
    #: whether angles of bands may be free
    angles: bool = eqx.field(static=True)

    def rotated(
        self, seen: Float[Array, "band stokes x"], params: Mapping[str, Array]
    ) -> tuple[Float[Array, "band stokes x"], Float[Array, "band stokes x"]]:
        """Return what rotated bands see of the same Stokes parameter, and of the other one."""
        sign = np.array([{"I": 0, "Q": -1, "U": 1}[s] for s in self.stokes])[:, None]
        angle = 2 * jnp.deg2rad(self.mixing.of_bands("angle", params))[:, None, None] * sign
        return jnp.cos(angle) * seen, jnp.sin(angle) * products.swapped(seen)

    def offset(self, params: Mapping[str, Array]) -> Float[Array, "band stokes"]:
        """Return offsets [uK_RJ], 0 unless given."""
        return jnp.array(
            [[params.get(f"offset.{b}.{s}", 0.0) for s in self.stokes] for b in self.mixing.names]
        )

    def check(self, params):
        if not params:
            raise ValueError("Argument `start` must name at least one free parameter.")
        bands = [f"offset.{band}.{s}" for band in self.mixing.names for s in self.stokes]
        bands = [*self.mixing.band_parameters(), *bands]
        of_sky = [n for n in parameter_names(self.mixing.sky) if not n.endswith(".amplitude")]
        for name, value in params.items():
            if name.removesuffix(OFFSET) not in of_sky and name not in bands:
                raise unknown_parameter(name, (*of_sky, *bands))
            if jnp.shape(value) != ():
                raise ValueError(f"Free parameter {name!r} must be a number, not a map.")
            if name.startswith("angle.") and not self.angles:
                raise ValueError(f"Parameter {name!r} must be free in the likelihood already.")
        return {name: as_array(name, value).astype(float) for name, value in params.items()}


class TemplateLikelihood(SkyLikelihood):
    """Likelihood on inner products; for spectral parameters that are constant over the region.

    The sky of `mixing` has unit amplitudes on a single pixel: the signal of a component in a band
    is then the coefficient of its template. `matrix` turns (1, -coefficients, -offset) of all bands
    and Stokes parameters into residuals.
    """

    matrix: Float[Array, "row vector"]

    def coefficients(self, params: Mapping[str, Array]) -> Float[Array, "band stokes template"]:
        """Return the factor of each template in each band."""
        laws = self.mixing.one(params)[:, None]
        components = self.mixing.laws(params).components.values()
        seen = laws * jnp.concatenate([c.template for c in components], axis=1)
        return jnp.concatenate(self.rotated(seen, params), axis=-1) if self.angles else seen

    def residuals(self, params):
        coefficients = self.coefficients(params)
        offset = self.offset(params)[..., None]
        vector = jnp.concatenate([jnp.ones_like(offset), -coefficients, -offset], axis=-1)
        return self.matrix @ vector.ravel()


class PixelLikelihood(SkyLikelihood):
    """Likelihood pixel by pixel; for spectral parameters that are maps."""

    data: Float[Array, "band stokes pix"]
    root_weights: Float[Array, "band stokes pix"]
    nodes: tuple[Nodes, ...] = eqx.field(static=True)
    #: rows of inner products and their whitening, for the exact form; None for the diagonal one
    rows: Float[Array, "band row stokes pix"] | None
    whitening: Float[Array, "row row"] | None

    def residuals(self, params):
        out = maps_of(1) if self.rows is None else SUMS
        return over_pixels(out)(PixelLikelihood._residuals)(self, params)

    def derivatives(self, local):
        # Of each device's own pixels, and then their sum.
        def own(like, local):
            return jax.tree.map(total, Likelihood.derivatives(like, of_own(local)))

        whole = super().derivatives
        return over_pixels(SUMS)(own)(self, local) if self.rows is None else whole(local)

    def _residuals(self, params):
        bands = self.mixing.moved(params)
        seen = observe_components(self.mixing.laws(params), bands, nodes=self.nodes)
        model = sum(seen.values()) * self.mixing.factors(bands, params)[:, None, None]
        if self.angles:
            same, other = self.rotated(model, params)
            model = same + other
        model = model + self.offset(params)[..., None]
        if self.rows is None:
            return ((self.data - model) * self.root_weights).ravel()
        inner = total(jnp.einsum("brsp,bsp->br", self.rows, self.data - model))
        return jnp.asarray(self.whitening) @ inner.ravel()


def likelihood(
    sky: Sky,
    bands: Mapping[str, Bandpass] | Sequence[Bandpass],
    data: Numeric | Stack,
    sigma: Numeric | Stack,
    start: Mapping[str, Numeric],
    *,
    stokes: str | None = None,
    covariance_of: CovarianceOf | None = None,
    pixelwise: bool = False,
    template_errors: TemplateErrors | None = None,
) -> SkyLikelihood:
    """Return the likelihood of maps as a function of the parameters named in `start`.

    `chi2(like, params)` and `like.residuals(params)` are its values.

    Parameters
    ----------
    sky : templates and spectral laws at the resolution of the data, amplitudes in uK_RJ
    bands : the bands by name, or as a list
    data : observed maps [uK_RJ], shape (band, stokes, pix); if they lie on disk
        (`jaxsky.io.stacks`), they are read range by range, unless pixel by pixel
    sigma : standard deviation of the data [uK_RJ], broadcasting to their shape; infinite where
        a pixel is masked
    start : free parameters by name, with values at which the sky is otherwise expanded; a free
        parameter that is a map in `sky` is replaced by a constant, or shifted if ".offset" is
        appended to its name
    stokes : which rows to use, e.g. "Q"; default all, "I", "QU" or "IQU" by their number
    covariance_of : covariance of inner products with the data, for the exact likelihood;
        None for the paper's diagonal one
    pixelwise : evaluate pixel by pixel even where inner products would do
    template_errors : noise of the templates, which is subtracted from the inner products; its
        part of their covariance is that at `start`. Likelihoods pixel by pixel ignore it.

    Raises
    ------
    RuntimeError, KeyError
        If JAX is not in double precision; for unknown parameters.
    ValueError
        For shapes that do not match, sigma that is not positive, data that are not finite, no
        pixel left, unknown Stokes parameters, or templates that cannot be told apart.
    """
    check_double("fits")
    bands = named_bands(bands)
    data, sigma = typed((products.as_maps("data", data), products.as_maps("sigma", sigma)))
    sky, sigma = along(data, (sky, sigma))
    shape = (len(bands), *sky.shape)
    form = f"(band, stokes, pix) = {shape}"
    check_shape("data", data, data.shape == shape, f"have shape {form}")
    pairs = zip(sigma.shape[::-1], shape[::-1], strict=False)
    broadcasts = sigma.ndim <= len(shape) and all(n in (1, size) for n, size in pairs)
    check_shape("sigma", sigma, broadcasts, f"broadcast to {form}")
    if isinstance(data, Stack) and not isinstance(sigma, Stack):
        sigma = np.broadcast_to(sigma, shape)
    weights, counts = products.checked_weights(data, sigma)
    labels = STOKES[shape[1]]
    stokes = labels if stokes is None else stokes
    if not stokes or set(stokes) - set(labels):
        raise ValueError(f"Argument `stokes` must be among {labels!r}, not {stokes!r}.")
    keep = np.array([labels.index(s) for s in stokes])
    mixing = Mixing.of(sky, bands, "uK_RJ", on_cmb=True)
    angles = [name for name in start if name.startswith("angle.")]
    params = SkyLikelihood({}, 0, mixing, labels, bool(angles)).check(start)
    offsets = [name for name in params if name.startswith("offset.")]
    silent = [n for n in offsets if n[-1] not in stokes] + (angles if stokes == "I" else [])
    if silent:
        raise ValueError(f"Parameter {silent[0]!r} has no effect on Stokes {stokes}.")
    sky = mixing.laws({n: value for n, value in params.items() if not n.endswith(OFFSET)})
    if pixelwise or any(leaf.ndim == 1 for leaf in jax.tree.leaves(sky)):
        sky, data, weights = jax.tree.map(jnp.asarray, (sky, data, weights))  # in memory
        if spread(data) and covariance_of is not None:
            raise ValueError(
                "Argument `covariance_of` takes parameters that are numbers where pixels are "
                "distributed; leave it out, or do not distribute."
            )
        mixing = dataclasses.replace(mixing, sky=sky)
        like = SkyLikelihood(params, 0, mixing, labels, bool(angles))
        return _on_pixels(like, data, weights, keep, covariance_of)

    if angles and template_errors is not None:
        raise ValueError(
            f"Parameter {angles[0]!r} cannot be free where noise of templates is given, as it is "
            "not corrected for in bands that are rotated; leave out one of the two."
        )
    mixing = dataclasses.replace(mixing, sky=unit_sky(sky, len(labels)))
    templates: list[Any] = [c.amplitude for c in sky.components.values()]
    templates += [products.swapped(one) for one in templates] if angles else []
    inner = products.summed(products.gram, data, products.stacked(templates), weights)
    inner, count = np.asarray(inner), len(templates)
    values = jnp.asarray(int(counts[:, keep].sum()))
    none = jnp.zeros((0, 0))  # until there is one
    like = TemplateLikelihood(params, values, mixing, labels, bool(angles), none)
    if covariance_of is None and template_errors is None:
        matrix = _matrix(np.asarray(square_root(inner[:, keep])), keep, len(labels))
        return dataclasses.replace(like, matrix=matrix)
    # A constant row tells offsets from templates.
    if offsets:
        first = templates[0]
        on_disk = isinstance(first, Stack)
        templates.append(np.broadcast_to(1.0, first.shape) if on_disk else jnp.ones_like(first))
    maps = products.stacked(templates)
    rows = products.Rows(maps, weights)
    used = slice(1, len(maps) + 1)
    if covariance_of is not None:
        covariance = np.asarray(covariance_of(rows))
    else:  # that of T^T W n, with white noise n, is T^T W T
        covariance = scipy.linalg.block_diag(*inner[..., used, used].reshape(-1, *2 * [len(maps)]))
    blocks = inner[:, :, used]
    if template_errors is not None:
        seen = np.repeat(np.asarray(like.coefficients(params)), len(maps), axis=1)
        covariance = covariance + template_errors.covariance(rows, seen)
        blocks = blocks - template_errors.mean_products(weights)[:, :, used]
        check_signal(blocks[:, keep, :count, used][..., :count])
    whitening = _whitening(covariance, rows, keep)
    matrix = _matrix(blocks[:, keep], keep, len(labels), whitening)
    if covariance_of is not None:
        return dataclasses.replace(like, values=jnp.asarray(len(whitening)), matrix=matrix)
    # The part that no combination of templates explains is the same for all parameters.
    left = inner[:, keep, : used.stop, : used.stop]
    constant = jnp.zeros_like(matrix[:1]).at[0, keep[0] * inner.shape[-1]]
    unexplained = constant.set(np.sqrt(np.sum(1 / np.linalg.inv(left)[..., 0, 0])))
    return dataclasses.replace(like, matrix=jnp.concatenate([matrix, unexplained]))


def _matrix(blocks, keep, stokes, whitening=None):
    """Put blocks (band, kept stokes, row, vector) on the diagonal of a matrix for all Stokes."""
    bands, kept, rows, size = blocks.shape
    matrix = scipy.linalg.block_diag(*blocks.reshape(-1, rows, size))
    if whitening is not None:
        matrix = whitening @ matrix
    full = np.zeros((len(matrix), bands, stokes, size))
    full[:, :, keep] = matrix.reshape(-1, bands, kept, size)
    return jnp.asarray(full.reshape(len(matrix), -1))


def _whitening(covariance, rows, keep):
    """Return W with W^T W the inverse covariance of the products of rows of kept Stokes."""
    bands, count, stokes, _ = rows.shape
    split = covariance.reshape(2 * (bands, stokes, count // stokes))
    size = bands * len(keep) * count // stokes
    covariance = split[:, keep][:, :, :, :, keep].reshape(size, size)
    scale = np.sqrt(np.diagonal(covariance))
    safe = np.where(scale > 0, scale, 1.0)
    correlation = covariance / safe[:, None] / safe
    if not (np.all(scale > 0) and np.linalg.eigvalsh(correlation)[0] > 1e-12):
        raise ValueError(
            "The templates cannot be told apart in this region: the covariance of their "
            "amplitudes is not positive definite."
        )
    root = np.linalg.cholesky(correlation)
    return scipy.linalg.solve_triangular(root, np.diag(1 / scale), lower=True)


def _on_pixels(like, data, weights, keep, covariance_of):
    """Return a likelihood on pixels; its rows are the components' maps at the start values."""
    mixing, params = like.mixing, like.start
    at_start = mixing.laws({n: value for n, value in params.items() if n.endswith(OFFSET)})
    kept = np.isin(np.arange(len(like.stokes)), keep)[:, None]
    used = jnp.where(kept, weights, 0)
    data = jnp.where(used > 0, data, 0)
    # Two spare nodes: a shift of a map moves its range, hardly its width.
    plan = interpolation_nodes(at_start, mixing.bandpasses, 1e-10)
    nodes = tuple(n and NodeCounts(tuple(k + 2 for k in n.counts)) for n in plan)
    rows = whitening = None
    values = jnp.sum(used > 0)
    if covariance_of is not None:
        maps = list(observe_components(at_start, mixing.bandpasses, nodes=nodes).values())
        if like.angles:
            maps += [products.swapped(one) for one in maps]
        if any(name.startswith("offset.") for name in params):
            maps.append(jnp.ones_like(data))
        rows = products.one_stokes_each(jnp.stack(maps, axis=1), weights)
        whitening = jnp.asarray(_whitening(np.asarray(covariance_of(rows)), rows, keep))
        kept = (keep[:, None] * len(maps) + np.arange(len(maps))).ravel()
        rows = rows[:, kept]
        values = jnp.array(len(whitening))
    more = data, jnp.sqrt(used), nodes, rows, whitening
    return PixelLikelihood(params, values, mixing, like.stokes, like.angles, *more)
