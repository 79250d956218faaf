"""The mixing matrix: what each component of unit amplitude shows in each band.

Names of parameters are those of the sky ("dust.beta_dust"), and of bands:

* "shift.<band>": the band is moved by this fraction of its center; 0 if not given
* "width.<band>": it is stretched about its center by this factor; 1
* "gain.<band>": factor on what the band shows; 1
* "angle.<band>": rotation of its polarization, Q + iU times exp(2i angle) [deg]; 0
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fits.template_likelihood import NamedBands
from jaxsky import Sky, parameter_names, set_parameters
from jaxsky.bandpass import Samples, average
from jaxsky.checks import Numeric
from jaxsky.interpolation import band_seds, choose_nodes
from jaxsky.sed import cmb_derivative
from jaxsky.units import parse_unit

#: parameter of a band -> its value if not given
NOMINAL = {"shift": 0.0, "width": 1.0, "gain": 1.0, "angle": 0.0}
#: Fields that act on amplitudes, which are free in every pixel anyway.
NOT_SPECTRAL = ("amplitude", "polarization_fraction", "nu_ref")
#: Cells averaged over the bands at a time; above, laws are interpolated.
CELLS = 512
#: Relative error of interpolated laws.
TOLERANCE = 1e-11


def spectral_names(sky: Sky) -> tuple[str, ...]:
    """Names of the parameters of the laws: all but those that only scale amplitudes."""
    return tuple(n for n in parameter_names(sky) if n.split(".")[1] not in NOT_SPECTRAL)


class SpectralBands(NamedBands):
    """Named bands with the parameters that act on their mixing matrix."""

    def parameter_names(self) -> tuple[str, ...]:
        return tuple(f"{kind}.{band}" for kind in NOMINAL for band in self.names)

    def values(self, kind: str, params: Mapping[str, Numeric]) -> Float[Array, "band ..."]:
        """Parameters of one kind in all bands."""
        given = [params.get(f"{kind}.{band}", NOMINAL[kind]) for band in self.names]
        return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, given)))

    def moved(self, samples: Samples, params: Mapping[str, Numeric]) -> Samples:
        """Frequencies and weights of the bands, those with parameters shifted and stretched."""
        for i, (name, band) in enumerate(zip(self.names, self.bandpasses, strict=True)):
            if not {f"width.{name}", f"shift.{name}"} & set(params):
                continue
            band = band.stretched(params.get(f"width.{name}", 1.0))
            band = band.shifted(params.get(f"shift.{name}", 0.0) * band.center)
            missing = (0, samples.nu.shape[1] - band.nu.size)
            samples = Samples(
                samples.nu.at[i].set(jnp.pad(band.nu, missing, mode="edge")),
                samples.quadrature.at[i].set(jnp.pad(band.quadrature, missing)),
            )
        return samples


class Mixing(eqx.Module):
    """Mixing matrices as a function of spectral parameters.

    Parameters
    ----------
    sky : the laws, on a single pixel
    bands : the bands
    samples : their frequencies and weights while they are where they should be
    unit : of the data. A band with data in K_CMB is calibrated on the CMB: shifted or stretched,
        it shows the CMB as before. In K_RJ it is calibrated on a source of constant antenna
        temperature.
    """

    sky: Sky
    bands: SpectralBands
    samples: Samples
    unit: str = eqx.field(static=True)

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components, in order."""
        return tuple(self.sky)

    def _calibrated(self, laws, bands):
        """Rows of the matrix in units of the data: amplitudes are uK."""
        size, kind = parse_unit(self.unit)
        factor = jnp.asarray(1e-6 / size)
        if kind == "K_CMB":
            factor = factor / jax.vmap(lambda b: average(cmb_derivative, b))(bands)[:, None]
        return laws * factor

    def one(self, params: Mapping[str, Array]) -> Float[Array, "band component"]:
        """The matrix for parameters that are numbers."""
        sky = set_parameters(self.sky, self.bands.sky_parameters(params))
        bands = self.bands.moved(self.samples, params)
        laws = [jax.vmap(lambda b, c=c: average(c.sed, b))(bands) for c in sky.components.values()]
        matrix = self._calibrated(jnp.stack(laws, axis=-1), bands)
        return matrix * self.bands.values("gain", params)[:, None]

    def _interpolated(self, params, cells) -> Float[Array, "cell band component"]:
        """The matrix in many cells; bands must not move."""
        amplitude = jnp.ones((2, cells))
        names = list(self.sky)
        wide = eqx.tree_at(
            lambda s: [s[n].amplitude for n in names], self.sky, [amplitude] * len(names)
        )
        wide = set_parameters(wide, self.bands.sky_parameters(params))
        columns = []
        for component in wide.components.values():
            nodes = choose_nodes(component, self.bands.bandpasses, TOLERANCE)
            laws = band_seds(component, self.samples, nodes)
            columns.append(jnp.broadcast_to(laws, (cells, len(self.bands.names))))
        stacked = jnp.stack(columns, axis=-1)
        matrix = jax.vmap(lambda m: self._calibrated(m, self.samples))(stacked)
        gain = self.bands.values("gain", params)
        return matrix * jnp.broadcast_to(gain.T, (cells, len(gain)))[..., None]

    def __call__(
        self, params: Mapping[str, Float[Array, " cell"]], cells: int
    ) -> Float[Array, "cell band component"]:
        """The matrices of cells with their own parameters; those not given keep their values."""
        moving = any(name.split(".")[0] in ("shift", "width") for name in params)
        if cells > CELLS and not moving:
            return self._interpolated(params, cells)
        if not params:
            return jnp.broadcast_to(self.one({}), (cells, *jax.eval_shape(self.one, {}).shape))
        if cells == 1:
            return self.one({name: value[0] for name, value in params.items()})[None]
        if cells <= CELLS:
            return jax.vmap(lambda p: self.one(p))(dict(params))
        return jax.lax.map(jax.checkpoint(lambda p: self.one(p)), dict(params), batch_size=CELLS)

    def rotated(
        self, matrix: Float[Array, "cell band component"], params: Mapping[str, Array]
    ) -> Float[Array, "cell row unknown"]:
        """The matrix for Q and U together: rows Q of all bands, then U; unknowns likewise."""
        angle = 2 * jnp.deg2rad(self.bands.values("angle", params))
        angle = angle.reshape(len(self.bands.names), -1).T[..., None]
        cosine, sine = jnp.cos(angle) * matrix, jnp.sin(angle) * matrix
        return jnp.block([[cosine, -sine], [sine, cosine]])
