"""The two domains of a separation: pixels at a common resolution, and multipoles.

Both have the same methods, so that a run does not ask which one it has.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.fluctuations import Fluctuations
from fits.multipoles import harmonic_likelihood, multipoles_of
from fits.noise import Noise
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.separated_maps import (
    ComponentMaps,
    HarmonicMaps,
    component_maps,
    emission_maps,
    harmonic_component_maps,
    noise_degradation,
    residual_maps,
)
from jaxsky import Bandpass, Sky
from jaxsky.harmonics import analysis, expand, gaussian_beam, lmax_of, synthesis
from jaxsky.keys import stream
from jaxsky.noise import draw, uniform_alm


class PixelDomain(NamedTuple):
    """Pixel by pixel, all maps at one resolution.

    Parameters
    ----------
    sky : the laws
    bands : bandpasses by name
    start : start values of the free parameters
    labels : regions of those that have them
    unit : of data and noise
    noise : of the data, infinite where masked
    used : pixels that are separated
    fluctuations : what noise there is, correlated between pixels as it is [uK_RJ]
    factors : `unit` per uK_RJ in each band
    """

    sky: Sky
    bands: dict[str, Bandpass]
    start: dict[str, float]
    labels: dict[str, np.ndarray]
    unit: str
    noise: Noise
    used: Bool[np.ndarray, " pix"]
    fluctuations: Fluctuations
    factors: Float[np.ndarray, " band"]

    def likelihood(self, data: Float[np.ndarray, "band stokes pix"]) -> SpectralLikelihood:
        """The likelihood of data."""
        return spectral_likelihood(
            self.sky, self.bands, data, self.noise, self.start, labels=self.labels, unit=self.unit
        )

    def noise_realisation(self, key: Array) -> Float[np.ndarray, "band stokes pix"]:
        """Noise like that of the data."""
        noise = self.fluctuations.noise_realisation(key)
        return np.asarray(noise) * self.factors[:, None, None]

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        """Amplitudes of the components with all that is known of them."""
        return component_maps(like, params, data, self.noise, **options)

    def maps(self, found: ComponentMaps) -> Float[np.ndarray, "component stokes pix"]:
        """Amplitudes as maps."""
        return found.amplitude

    def degradation(self, like: SpectralLikelihood, params: Mapping, component: str):
        """Noise of a component over that of a sky without others, (stokes, 1 or pix)."""
        return noise_degradation(like, params, self.noise, self.used.size, component)

    def residuals(self, like: SpectralLikelihood, params: Mapping, data, found: ComponentMaps):
        """Maps (band, stokes, pix) of the data less the components; NaN in masked pixels."""
        return residual_maps(like, params, data, found.amplitude)

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """What components show in the bands; zero in masked pixels."""
        return emission_maps(like, params, np.where(self.used, amplitude, 0.0))


class HarmonicDomain(NamedTuple):
    """Multipole by multipole on the full sky, each band with its own beam.

    Parameters
    ----------
    sky, bands, start, unit : as of `PixelDomain`
    fwhms : of the bands [arcmin]
    noise : N_l of the maps as observed [unit^2 sr]
    covariance : of Q and U in each pixel of the bands [unit^2], each at its own nside
    levels : of the noise of the bands [unit arcmin] where it is uniform, else None
    correlated : N_l of noise that is correlated between pixels, part of `noise`; zero where none
    lmax : largest multipole
    nside, fwhm : of the maps that are made [arcmin]
    """

    sky: Sky
    bands: dict[str, Bandpass]
    start: dict[str, float]
    unit: str
    fwhms: Float[np.ndarray, " band"]
    noise: Float[np.ndarray, "band stokes ell"]
    covariance: tuple[Float[Array, "stokes stokes pix"], ...]
    levels: tuple[float | None, ...]
    correlated: Float[np.ndarray, "band ell"]
    lmax: int
    nside: int
    fwhm: float

    def likelihood(self, data: Float[np.ndarray, "band stokes alm"]) -> SpectralLikelihood:
        """The likelihood of data."""
        return harmonic_likelihood(
            self.sky, self.bands, data, self.noise, self.start, beams=self.fwhms, unit=self.unit
        )

    def noise_realisation(self, key: Array) -> Float[np.ndarray, "band stokes alm"]:
        """Noise like that of the data."""
        bands = []
        for name, covariance, level, spectrum in zip(
            self.bands, self.covariance, self.levels, self.correlated, strict=True
        ):
            own = stream(key, "noise", name)
            if level is not None:
                alm = uniform_alm(own, level, self.lmax)
            else:
                alm = analysis(draw(own, covariance), self.lmax, 0)
            white = jax.random.normal(stream(key, "correlated", name), alm.shape)
            bands.append(np.asarray(alm + white * expand(jnp.sqrt(jnp.asarray(spectrum)))))
        return np.stack(bands)

    def components(self, like: SpectralLikelihood, params: Mapping, data, **options):
        """Amplitudes of the components with all that is known of them."""
        return harmonic_component_maps(like, params, data, self.noise, beams=self.fwhms, **options)

    def maps(self, found: HarmonicMaps) -> Float[np.ndarray, "component stokes pix"]:
        """Amplitudes as maps."""
        return found.maps(self.nside, self.fwhm)

    def degradation(self, like: SpectralLikelihood, params: Mapping, component: str):
        """Noise of a component over that of a sky without others, (stokes, ell)."""
        nothing = np.zeros((*self.noise.shape[:2], (self.lmax + 1) ** 2))
        known = multipoles_of(nothing, self.noise, self.fwhms, len(like.sky.components), 2, None)
        return noise_degradation(like, params, Noise(known.sigma), self.lmax + 1, component)

    def residuals(self, like: SpectralLikelihood, params: Mapping, data, found: HarmonicMaps):
        """Maps (band, stokes, pix) of the data less the components, each with its own beam."""
        rest = data - self.emission(like, params, found.amplitude)
        return np.stack([np.asarray(synthesis(jnp.asarray(alm), self.nside)) for alm in rest])

    def emission(self, like: SpectralLikelihood, params: Mapping, amplitude):
        """What components show in the bands, with their beams."""
        windows = jnp.stack([gaussian_beam(f, lmax_of(amplitude)) for f in self.fwhms])
        return emission_maps(like, params, amplitude) * np.asarray(expand(windows))[:, None]


Domain = PixelDomain | HarmonicDomain
