"""The spectral likelihood of component separation: laws, with amplitudes profiled out.

With A (band, component) the band-averaged laws and any amplitudes in each pixel (Stompor et al.
2009, MNRAS 392, 216),

    -2 ln L = sum_p [d^T N^-1 d - (A^T N^-1 d)^T (A^T N^-1 A)^-1 (A^T N^-1 d)].

Parameters are numbers, or arrays with a value for each region of a map of labels; a cell is an
intersection of regions. Where noise is separable and cells are large, a few vectors replace the
pixels (`fits.compress`), and the cost does not depend on nside.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fits import compress as in_memory
from fits import distributed, regions, systems
from fits.compress import Layout, Noise, as_noise, bare, compressed, streamed
from fits.mixing import Mixing, named_bands, spectral_names, unit_sky
from fits.posterior import Likelihood
from fits.regions import check_labels
from fits.shrinkage import AmplitudePrior, amplitude_prior
from fits.systems import Pixels
from jaxsky import Bandpass, Component, Sky, get_parameters
from jaxsky.arrays import STOKES
from jaxsky.bandpass import parse_unit
from jaxsky.checks import Numeric, as_array, check_double, check_finite, check_shape
from jaxsky.io.stacks import Stack
from jaxsky.mesh import SUMS, along, at_once, in_place, maps_of, over_pixels, spread
from jaxsky.mesh import total as over_devices
from jaxsky.sky import check_parameter, unknown_parameter

#: Pixels processed at once.
PASS = 4096


class SpectralLikelihood(Likelihood):
    """See `spectral_likelihood`; for grids and chains like any `Likelihood`."""

    mixing: Mixing
    #: parameters that are maps and not free, in each cell
    fixed: dict[str, Float[Array, " cell"]]
    #: position of each free parameter of each cell in the vector of all
    index: Int[Array, "cell free"]
    #: data and weights, for each of `layout`
    pixels: tuple[Pixels, ...]
    #: cell of each block of pixels, and of each pixel, -1 where masked
    block_cell: Int[Array, " block"] | None
    of_pixel: Int[Array, " pix"] | None
    layout: tuple[Layout, ...] = eqx.field(static=True)
    #: Stokes parameters of the data
    stokes: str = eqx.field(static=True)
    #: bands that carry no weight next to the others, and are not counted
    weightless: tuple[str, ...] = eqx.field(static=True)
    #: where `pixels` and `block_cell` are read from, piece by piece, if they are too many
    source: Callable[[], Iterator[tuple[Any, Array]]] | None = eqx.field(static=True, default=None)
    #: of amplitudes, as further rows of matrices, data and weights
    prior: AmplitudePrior | None = None

    profiled = True

    def check(self, params):
        known = (*spectral_names(self.mixing.sky), *self.mixing.band_parameters())
        for name, value in params.items():
            if name not in known:
                raise unknown_parameter(name, known)
            if name not in self.start:
                raise ValueError(
                    f"Parameter {name!r} is not free; name it in `start` of the likelihood."
                )
            if jnp.shape(value) not in ((), self.start[name].shape):
                raise ValueError(
                    f"Parameter {name!r} must be a number or have shape "
                    f"{self.start[name].shape}, a value for each region, but has shape "
                    f"{jnp.shape(value)}."
                )
        if not self.start:
            raise ValueError("Argument `start` must name at least one free parameter.")
        seen = np.zeros(sum(value.size for value in self.start.values()), bool)
        seen[np.asarray(self.index)] = True
        result = {}
        for name, has_pixels in self.named(jnp.asarray(seen)).items():
            default = self.start[name]
            value = as_array(name, params.get(name, default))
            # Fits return NaN for regions without a pixel.
            result[name] = jnp.where(has_pixels, value, default)
            check_finite(name, result[name])
        return result

    def cells(self):
        return self.index

    def without_data(self) -> "SpectralLikelihood":
        """Return it without pixels, for the matrices alone."""
        return dataclasses.replace(self, pixels=(), block_cell=None, source=None)

    def matrices(self, local: Float[Array, "cell free"]) -> tuple[Array, ...]:
        """Return mixing matrices (cell, row, unknown), for each of `layout`."""
        values = {name: local[:, k] for k, name in enumerate(self.free)} | self.fixed
        matrix = self.mixing(values, len(local))
        if self.prior is not None:
            rows = self.prior.rows(tuple(self.mixing.sky))
            rows = jnp.broadcast_to(rows, (len(matrix), *rows.shape))
            matrix = jnp.concatenate([matrix, rows], axis=1)
        every = [each.own(matrix, axis=-1) for each in self.layout]
        return tuple(
            self.mixing.rotated(own, values) if each.joint else own
            for each, own in zip(self.layout, every, strict=True)
        )

    def unknowns(self) -> Int[np.ndarray, " stokes"]:
        """Return the number of components that each Stokes parameter has."""
        number = np.zeros(len(self.stokes), int)
        for each in self.layout:
            number[list(each.stokes)] = len(each.own(np.arange(len(self.mixing.sky.components))))
        return number

    def pieces(self):
        own = [(self.pixels, self.block_cell)] if self.source is None else self.source()
        for pixels, cells in own:
            yield dataclasses.replace(self, pixels=pixels, block_cell=cells, source=None)

    def _blocks(self):
        """Return what passes take: the pixels in blocks, for each of `layout`, and their cells."""
        if self.source is not None:
            raise ValueError(
                "Maps on disk whose noise differs from pixel to pixel and from band to band can be "
                'fitted by fits.Newton() only, and not sampled (separate.sampler = "none").'
            )
        return self.pixels, self.block_cell

    def total(self, local):
        @over_pixels(SUMS)
        def summed(matrices, pixels, cells):
            parts = _mapped(systems.least_chi2, matrices, pixels, cells)
            return over_devices(sum((jnp.sum(part) for part in parts), jnp.zeros(())))

        return summed(self.matrices(local), *self._blocks())

    def derivatives(self, local):
        units = jnp.eye(local.shape[1])

        def with_slopes(function):
            """Return a function that also returns the derivatives in each parameter of a cell."""

            def along(x, unit):
                return jax.jvp(function, (x,), (jnp.broadcast_to(unit, x.shape),))

            return lambda x: jax.vmap(partial(along, x), out_axes=(None, 1))(units)

        (matrices, one), (_, two) = with_slopes(with_slopes(self.matrices))(local)
        every = tuple(zip(matrices, one, two, strict=True))

        @over_pixels(SUMS)
        def summed(every, pixels, cells):
            def of_cells(part):
                return jax.tree.map(lambda x: jax.ops.segment_sum(x, cells, len(local)), part)

            def of_block(m, own):
                return systems.derivatives(m[0], m[1], m[2], own)

            parts = _mapped(of_block, every, pixels, cells)
            return over_devices(jax.tree.map(lambda *rows: sum(rows), *map(of_cells, parts)))

        return summed(every, *self._blocks())

    def residuals(self, params):
        @over_pixels(maps_of(1))
        def rows(matrices, pixels, cells):
            parts = _mapped(systems.residuals, matrices, pixels, cells)
            return jnp.concatenate([part.ravel() for part in parts])

        return rows(self.matrices(self.flat(params)[self.index]), *self._blocks())


def _mapped(function, matrices, pixels, cells):
    """Apply a function of (matrices, pixels) to all blocks, for each layout."""
    results = []
    for of_cell, own in zip(matrices, pixels, strict=True):
        blocks, *_, size = own.data.shape

        def one(inputs, of_cell=of_cell):
            cell, block = inputs
            return function(jax.tree.map(lambda x: x[cell], of_cell), block)

        most = at_once(PASS)
        if blocks * size <= most:
            results.append(jax.vmap(one)((cells, own)))
            continue
        # With a batch size of 1 XLA copies all data and weights first.
        batch = most // size if 2 * size <= most else None
        results.append(jax.lax.map(one, (cells, own), batch_size=batch))
    return tuple(results)


def _start_values(
    mixing: Mixing, start: Mapping[str, Numeric], labels: Mapping[str, np.ndarray]
) -> dict[str, Array]:
    """Return start values as arrays, one value per region where there are labels."""
    spectral = spectral_names(mixing.sky)
    for name in (*start, *labels):
        if name not in (known := (*spectral, *mixing.band_parameters())):
            raise unknown_parameter(name, known)
        if name not in start:
            raise ValueError(f"There are labels for {name!r}, which is not in `start`.")
        if name in labels and name not in spectral:
            raise ValueError(f"Parameter {name!r} of a band cannot vary between regions.")
    values = {}
    for name in sorted(start):
        value = as_array(name, start[name])
        check_finite(name, value)
        if name in spectral:
            check_parameter(mixing.sky, name, name, value)
        wanted: tuple[int, ...] = ()
        if name in labels:
            last = int(labels[name].max())
            wanted = value.shape if value.ndim == 1 else (last + 1,)
            if last >= wanted[0]:
                raise ValueError(
                    f"Start of {name!r} has {wanted[0]} values, but its labels go up to {last}."
                )
        if value.shape not in ((), wanted):
            raise ValueError(
                f"Start of {name!r} must be a number, or an array with a value for each of its "
                f"labels, but has shape {value.shape}."
            )
        values[name] = jnp.broadcast_to(value.astype(float), wanted)
    return values


def spectral_likelihood(
    sky: Sky | Mapping[str, Component],
    bands: Mapping[str, Bandpass] | Sequence[Bandpass],
    data: Numeric,
    noise: Noise | Numeric,
    start: Mapping[str, Numeric],
    *,
    labels: Mapping[str, Int[np.ndarray, " pix"]] | None = None,
    unit: str = "uK_RJ",
    compress: bool | None = None,
    prior: Mapping[str, Numeric] | None = None,
) -> SpectralLikelihood:
    """Return the likelihood of the spectral parameters named in `start`, to be fitted or sampled.

    Parameters
    ----------
    sky : components by name. Their laws count, not their amplitudes; parameters that are not
        free keep their values, maps of the data's pixels among them.
    bands : the bands by name, or as a list
    data : observed maps, shape (band, stokes, pix) with Stokes I, or Q, U, or I, Q, U
    noise : standard deviations or covariances in the unit of the data; see
        `fits.compress.as_noise`
    start : start values of the free parameters by name: of the laws ("dust.beta_dust"), or of
        bands ("shift.<band>", "width.<band>", "gain.<band>", "angle.<band>"; see
        `fits.mixing`)
    labels : maps of region numbers from 0 for parameters that vary, by name; start values are
        then arrays with one value for each region, or a number for all
    unit : unit of the data ("uK_RJ", "K_CMB", ...); amplitudes are uK in any case (CMB: uK_CMB)
    compress : whether vectors replace pixels, which needs separable noise; by default if they are
        fewer
    prior : standard deviations, or covariances, of amplitudes by name of the component, with mean
        0; see `fits.shrinkage.amplitude_prior`. chi^2 then includes that of the amplitudes.

    Raises
    ------
    RuntimeError : without double precision
    KeyError : for unknown parameters, and priors of unknown components
    TypeError, ValueError : for shapes that do not match, units, noise that is not positive, data
        that are not finite, too few bands, components that cannot be told apart, invalid labels
    """
    check_double("fits")
    sky = sky if isinstance(sky, Sky) else Sky(sky)
    bands = named_bands(bands)
    held = get_parameters(sky, [name for name in spectral_names(sky) if name not in start])
    fixed: dict[str, Any] = {name: np.asarray(value) for name, value in held.items() if value.ndim}
    # On one accelerator, maps of parameters are taken by the pass on the host.
    data, noise = (data, noise) if fixed else in_place(data, noise)
    data = bare("data", data)
    components = len(sky.components)
    if parse_unit(unit)[1] not in ("K_RJ", "K_CMB"):
        raise ValueError(f"Argument `unit` must be one of K_RJ or K_CMB, not {unit!r}.")
    good = data.ndim == 3 and len(data) == len(bands) and data.shape[1] in STOKES
    form = f"(band, stokes, pix) with {len(bands)} bands and Stokes I, or Q, U, or I, Q, U"
    check_shape("data", data, good, f"have shape {form}")
    if len(bands) < (needed := components - len(prior or ())) + bool(start):
        raise ValueError(
            f"{len(bands)} bands are too few: amplitudes of {needed} components take as many, "
            "and their laws one more."
        )
    mixing = Mixing.of(unit_sky(sky), bands, unit)
    noise = along(data, as_noise(noise, data.shape))
    shrunk = amplitude_prior(prior or {}, mixing.sky, data.shape[1:])
    rows_of_data = tuple(bands)
    if shrunk is not None:
        data, noise = shrunk.joined(data, noise)
        rows_of_data += shrunk.names
    looked, apart = distributed.look(data, noise, components), spread(data)
    used: Any = looked.used
    varying = {n: check_labels(n, v, used) for n, v in (labels or {}).items()}
    values = _start_values(mixing, start, varying)
    if apart and fixed:
        raise ValueError(
            f"Parameter {next(iter(fixed))!r} is a map, which distributed pixels do not take; give "
            "a number, or free it with `labels`."
        )
    for name, value in fixed.items():
        if value.shape != used.shape:
            raise ValueError(
                f"Parameter {name!r} is a map of {value.size} pixels, but the data have "
                f"{used.size}."
            )
        # The values that are there, and which of them each pixel has.
        fixed[name], varying[name] = np.unique(value, return_inverse=True)
    passes: Any = distributed if apart else in_memory
    cells = (distributed if apart else regions).intersections(varying, used)
    index, position = np.zeros((cells.number, len(values)), int), 0
    for column, (name, value) in zip(index.T, values.items(), strict=True):
        column[:] = position + (cells.labels[name] if value.ndim else 0)
        position += value.size
    angles = any(name.startswith("angle.") for name in start)
    polarized = [component.polarized for component in sky.components.values()]
    if data.shape[1] == 3 and not any(polarized):
        raise ValueError("None of the components is polarized; take data of I alone.")
    like = SpectralLikelihood(
        start=values,
        values=0,
        mixing=mixing,
        fixed={name: jnp.asarray(each[cells.labels[name]]) for name, each in fixed.items()},
        index=jnp.asarray(index),
        pixels=(),
        block_cell=None,
        of_pixel=None if cells.of_pixel is None else jnp.asarray(cells.of_pixel),
        layout=Layout.of(data.shape[1], angles or noise.covariance is not None, polarized),
        stokes=STOKES[data.shape[1]],
        weightless=(),
        prior=shrunk,
    )
    matrix = _check_matrices(like)[:, : len(data), :components]
    heavy = distributed.carry_weight(looked.weights[:, None] * np.mean(matrix**2, axis=0))
    rows = [len(data) * len(layout.groups[0]) for layout in like.layout]
    fewer = cells.number * max(rows) < looked.number
    if compress and not noise.separable:
        raise ValueError("Only noise that is separable into bands and pixels can be compressed.")
    parts, block_cell, source = [], None, None
    if noise.separable and (fewer if compress is None else compress):
        for layout in like.layout:
            summed = passes.band_covariance(data, noise, cells, used, layout)
            parts.append(compressed(summed, noise, layout))
        block_cell = jnp.arange(cells.number)
    else:
        blocks = passes.blocks(cells, used)
        if isinstance(data, Stack):
            source = partial(streamed, data, noise, blocks, like.layout)
        else:
            block_cell = jnp.asarray(blocks.cell)
            parts = [passes.gathered(data, noise, blocks, layout=each) for each in like.layout]
    return dataclasses.replace(
        like,
        pixels=tuple(parts),
        block_cell=block_cell,
        source=source,
        values=int(looked.counts[heavy].sum()) - int(like.unknowns().sum()) * looked.number,
        weightless=tuple(n for n, some in zip(rows_of_data, heavy, strict=True) if not some),
    )


def matrices_at(like: SpectralLikelihood, params: Mapping[str, Numeric]) -> tuple[Array, ...]:
    """Return mixing matrices (cell, row, unknown) for parameters, for each of `layout`."""
    params = like.check(params) if params and like.start else {}
    # Without data: compiled programs keep what is static, such as the source.
    return _matrices(like.without_data(), params)


@jax.jit
def _matrices(like, params):
    return like.matrices(like.flat(params)[like.index])


def _check_matrices(like: SpectralLikelihood) -> np.ndarray:
    """Return the matrices at the start; ValueError if two components have the same law there."""
    given = np.asarray(matrices_at(like, {})[0])
    matrix = given / np.linalg.norm(given, axis=1, keepdims=True)
    if not np.isfinite(matrix).all():
        raise ValueError("The laws are not finite at the start values.")
    if np.linalg.svd(matrix, compute_uv=False)[:, -1].min() < 1e-7:
        raise ValueError(
            f"The components {', '.join(like.mixing.sky)} cannot be told apart at the start "
            "values: their laws are the same in these bands."
        )
    return given
