"""The mixing matrix of components in bands, and the noise of templates.

The matrix is the signal of each component of unit amplitude in each band. Names of parameters are
those of the sky ("dust.beta_dust"), and of bands:

* "shift.<band>": the band is moved by this fraction of its center; 0 if not given
* "width.<band>": it is stretched about its center by this factor; 1
* "gain.<band>": factor on the signal of the band; 1
* "angle.<band>": rotation of its polarization, Q + iU times exp(2i angle) [deg]; 0

With templates T = t + n, products with the data have the mean t^T W d, but products of templates
t^T W t + <n^T W n>: amplitudes come out too small, and indices are biased. The noise term is known
from the covariance of the noise, and is subtracted (errors in variables; Fuller 1987, Measurement
Error Models, ch. 2). The rest, sum_j c_j T_k^T W n_j in a band where template j has the coefficient
c_j, is the same noise in all bands; its covariance is added to that of the data, at the
coefficients of the best fit.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.kept import remembered
from fits.products import summed, weighted
from jaxsky import Bandpass, Sky, parameter_names, set_parameters
from jaxsky.bandpass import Samples, average, parse_unit, stack_bands
from jaxsky.checks import Numeric
from jaxsky.components import declared
from jaxsky.interpolation import band_seds, choose_nodes
from jaxsky.io.stacks import Maps, computed, stored
from jaxsky.mesh import distribute, mesh_of
from jaxsky.sed import cmb_derivative

if TYPE_CHECKING:
    from fits.common import MapNoise
    from fits.inputs import TemplateNoise

#: Parameters of a band, and their values if not given.
NOMINAL = {"shift": 0.0, "width": 1.0, "gain": 1.0, "angle": 0.0}
#: Fields that only change amplitudes, which are free in every pixel anyway.
NOT_SPECTRAL = ("amplitude", "polarization_fraction", "nu_ref", "nu_ref_I")
#: Most cells averaged over the bands at a time; for more, laws are interpolated.
CELLS = 512
#: Relative error of interpolated laws.
TOLERANCE = 1e-11


def nominal(names: Iterable[str]) -> dict[str, float]:
    """Return the nominal values of the parameters of bands among some names."""
    words = {name: name.split(".")[0] for name in names}
    return {name: NOMINAL[word] for name, word in words.items() if word in NOMINAL}


def spectral_names(sky: Sky) -> tuple[str, ...]:
    """Return names of the parameters of the laws: not tables, nor what only scales amplitudes."""

    def spectral(component: str, field: str) -> bool:
        return field not in NOT_SPECTRAL and "table" not in declared(type(sky[component]), field)

    return tuple(n for n in parameter_names(sky) if spectral(*n.split(".")[:2]))


def named_bands(bands: Mapping[str, Bandpass] | Sequence[Bandpass]) -> dict[str, Bandpass]:
    """Return bands by name; those of a list are called "0", "1", ..."""
    if isinstance(bands, Mapping):
        return dict(bands)
    return {str(i): band for i, band in enumerate(bands)}


def unit_sky(sky: Sky, stokes: int = 2, mask: Float[np.ndarray, " pix"] | None = None) -> Sky:
    """Return the laws of a sky: amplitude 1 in one pixel, and maps of parameters as their mean.

    The mean is weighted with the mask.
    """

    def reduced(leaf):
        if leaf.ndim == 2:
            return jnp.asarray(np.ones((stokes, 1)))
        is_map = leaf.ndim == 1
        return jnp.asarray(np.average(leaf, weights=mask)) if is_map else leaf.astype(float)

    return jax.tree.map(reduced, sky)


class Mixing(eqx.Module):
    """Mixing matrices as a function of spectral parameters.

    A band with data in K_CMB is calibrated on the CMB: shifted or stretched, its CMB signal is the
    same. In K_RJ it is calibrated on a source of constant antenna temperature, unless `on_cmb`:
    then its data in K_CMB were converted with the nominal band, neither shifted nor stretched.
    """

    #: the laws, on a single pixel
    sky: Sky
    bandpasses: tuple[Bandpass, ...]
    #: frequencies and weights of the nominal bands
    samples: Samples
    names: tuple[str, ...] = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    on_cmb: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls, sky: Sky, bands: Mapping[str, Bandpass], unit: str, on_cmb: bool = False
    ) -> "Mixing":
        """Make it from bands by name."""
        seen = tuple(bands.values())
        return cls(sky, seen, stack_bands(seen), tuple(bands), unit, on_cmb)

    def band_parameters(self) -> tuple[str, ...]:
        """Return names of the parameters of the bands."""
        return tuple(f"{kind}.{band}" for kind in NOMINAL for band in self.names)

    def laws(self, params: Mapping[str, Numeric]) -> Sky:
        """Return the sky with those parameters that belong to its components."""
        own = {name: v for name, v in params.items() if name.split(".")[0] in self.sky}
        return set_parameters(self.sky, own)

    def of_bands(self, kind: str, params: Mapping[str, Numeric]) -> Float[Array, "band ..."]:
        """Return the parameters of one kind in all bands."""
        given = [params.get(f"{kind}.{band}", NOMINAL[kind]) for band in self.names]
        return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, given)))

    def moved(self, params: Mapping[str, Numeric]) -> tuple[Bandpass, ...]:
        """Return the bands, shifted and stretched; the same object if none has parameters."""
        bands = self.bandpasses
        for i, (name, band) in enumerate(zip(self.names, bands, strict=True)):
            if {f"width.{name}", f"shift.{name}"} & set(params):
                band = band.stretched(params.get(f"width.{name}", 1.0))
                band = band.shifted(params.get(f"shift.{name}", 0.0) * band.center)
                bands = (*bands[:i], band, *bands[i + 1 :])
        return bands

    def _samples(self, bands: tuple[Bandpass, ...]) -> Samples:
        return self.samples if bands is self.bandpasses else stack_bands(bands)

    def factors(
        self, bands: tuple[Bandpass, ...], params: Mapping[str, Numeric]
    ) -> Float[Array, " band"]:
        """Return the signal of 1 uK_RJ in bands, after any shift, in the unit of the data."""
        size, kind = parse_unit(self.unit)
        factor = 1e-6 / size * self.of_bands("gain", params)
        cmb = partial(average, cmb_derivative)
        if kind == "K_CMB":
            return factor / cmb(self._samples(bands))
        if self.on_cmb and bands is not self.bandpasses:
            return factor * cmb(self.samples) / cmb(self._samples(bands))
        return factor

    def one(self, params: Mapping[str, Numeric]) -> Float[Array, "band component"]:
        """Return the matrix for parameters that are numbers."""
        bands = self.moved(params)
        samples = self._samples(bands)
        laws = [c.band_average(samples) for c in self.laws(params).components.values()]
        return jnp.stack(laws, axis=-1) * self.factors(bands, params)[:, None]

    def _interpolated(self, params, cells) -> Float[Array, "cell band component"]:
        """Return the matrix in many cells; bands must not be shifted or stretched."""
        wide = jax.tree.map(lambda x: jnp.ones((2, cells)) if x.ndim == 2 else x, self.sky)
        columns = []
        for component in dataclasses.replace(self, sky=wide).laws(params).components.values():
            nodes = choose_nodes(component, self.bandpasses, TOLERANCE)
            laws = band_seds(component, self.samples, nodes)
            columns.append(jnp.broadcast_to(laws, (cells, len(self.names))))
        factors = jax.vmap(lambda own: self.factors(self.bandpasses, own), axis_size=cells)(params)
        return jnp.stack(columns, axis=-1) * factors[..., None]

    def __call__(
        self, params: Mapping[str, Float[Array, " cell"]], cells: int
    ) -> Float[Array, "cell band component"]:
        """Return matrices of cells with their own parameters; others keep their values."""
        params = dict(params)
        if cells == 1:
            return self.one({name: value[0] for name, value in params.items()})[None]
        if cells <= CELLS:
            return jax.vmap(lambda p: self.one(p))(params)
        if any(name.split(".")[0] in ("shift", "width") for name in params):
            return jax.lax.map(jax.checkpoint(lambda p: self.one(p)), params, batch_size=CELLS)
        return self._interpolated(params, cells)

    def rotated(
        self, matrix: Float[Array, "cell band component"], params: Mapping[str, Array]
    ) -> Float[Array, "cell row unknown"]:
        """Return a matrix for Q and U together: rows Q of all bands, then U; unknowns likewise.

        Rows that follow those of the bands are not rotated.
        """
        angle = 2 * jnp.deg2rad(self.of_bands("angle", params))
        angle = angle.reshape(len(self.names), -1).T[..., None]
        if others := matrix.shape[1] - len(self.names):
            angle = jnp.pad(angle, ((0, 0), (0, others), (0, 0)))
        cosine, sine = jnp.cos(angle) * matrix, jnp.sin(angle) * matrix
        return jnp.block([[cosine, -sine], [sine, cosine]])


class TemplateErrors(NamedTuple):
    """Noise of templates at the common resolution, as a sum of independent sources.

    Sources are the noise of each template that no other map has, and the noise of bands that
    templates share. `covariances_of` returns the covariance of the products of rows (band, row,
    stokes, pix) with each of them; `parts` is the factor of each in each template, `of_band` is 1
    where one is the noise of a band, and `variance` is that in each pixel [uK_RJ^2].
    """

    covariances_of: Callable[[Any], Float[np.ndarray, "source bandrow bandrow"]]
    parts: Float[np.ndarray, "template source"]
    of_band: Float[np.ndarray, "band source"]
    variance: Float[np.ndarray, "source stokes pix"] | Maps

    def mean_products(
        self, weights: Float[Array, "band stokes pix"]
    ) -> Float[np.ndarray, "band stokes row row"]:
        """Return the mean that noise adds to products of (data, templates, 1), as in `gram`."""
        variance, mesh = self.variance, mesh_of(weights)
        if mesh is not None:
            variance = distribute(variance, mesh, fill=0.0)
        power = np.asarray(summed(weighted, weights, variance))
        rows = np.stack([np.vstack([own, self.parts, 0 * own]) for own in self.of_band])
        total = np.einsum("bsu,bru,bqu->bsrq", power, rows, rows)
        total[..., 0, 0] = 0.0  # noise of the data, which is in their own products only
        return total

    def covariance(
        self, rows: Any, coefficients: Float[np.ndarray, "band row template"]
    ) -> Float[np.ndarray, "bandrow bandrow"]:
        """Return what noise of templates adds to the covariance of rows times residuals.

        `coefficients` are those of the templates in the residuals that each row multiplies.
        """
        each = self.covariances_of(rows)
        own = np.repeat(self.of_band, rows.shape[1], axis=0)
        seen = own - coefficients.reshape(len(own), -1) @ self.parts
        sums = "umn,mu,nu->mn"
        return np.einsum(sums, each, seen, seen) - np.einsum(sums, each, own, own)


def template_errors(
    names: Sequence[str],
    noises: Mapping[str, "TemplateNoise"],
    own: Mapping[str, "MapNoise"],
    bands: Mapping[str, "MapNoise"],
) -> TemplateErrors | None:
    """Return errors of templates from their own noise and the noise of bands that they share.

    None if there is neither.
    """
    shared = [noises[name].shared if name in noises else {} for name in names]
    which = [band for band in bands if any(band in one for one in shared)]
    if not own and not which:
        return None
    sources = [*own.values(), *(bands[band] for band in which)]
    parts = [
        [float(n == name) for name in own] + [one.get(band, 0.0) for band in which]
        for n, one in zip(names, shared, strict=True)
    ]
    of_band = [[0.0] * len(own) + [float(b == name) for b in which] for name in bands]
    each = [stored(source.variance(), len(sources)) for source in sources]
    shape = len(each), *each[0].shape

    def variance(pixels: Any) -> np.ndarray:
        return np.maximum(np.stack([one[..., pixels] for one in each]), 0.0)

    def covariances(rows: Any) -> Float[np.ndarray, "source bandrow bandrow"]:
        def flat() -> Iterator[Any]:
            return (row[..., : shape[-1]] for own in rows for row in own)

        count = rows.shape[0] * rows.shape[1]
        return np.stack([source.covariance(flat(), count) for source in sources])

    variances = computed(shape, variance)
    return TemplateErrors(remembered(covariances), np.array(parts), np.array(of_band), variances)


def check_signal(products: Float[np.ndarray, "band stokes template template"]) -> None:
    """Raise ValueError if the noise of templates has all of their power, or more."""
    total = products.sum(axis=(0, 1))
    scale = np.sqrt(np.abs(np.diagonal(total)))
    if np.linalg.eigvalsh(total / scale / scale[:, None])[0] <= 0:
        raise ValueError(
            "The noise of the templates is all that they hold in this region, or more than that; "
            "look at its level and unit."
        )
