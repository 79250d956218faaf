"""Bring templates, maps and their noise to a common resolution, where they can be compared.

There the noise of a band is a linear operator applied to white noise, and the CMB is synthesised
from independent coefficients, one set for all bands. The inner products of rows with the data
therefore have a covariance that follows exactly from a few transposed transforms of the rows; no
simulation, no matrix over pixels.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from fits.compress import Noise, as_noise, chunks
from fits.inputs import Inputs, prepare_component
from fits.kept import remembered
from fits.mixing import TemplateErrors, template_errors
from fits.regions import common_holes
from fits.template_likelihood import CovarianceOf, SkyLikelihood, likelihood
from jaxsky import Bandpass, Sky, observe
from jaxsky.checks import Numeric
from jaxsky.cmb import realisation
from jaxsky.harmonics import (
    Preparation,
    adjoint_synthesis,
    alm_ell,
    average_pixels,
    beam_ratio,
    expand,
    gaussian_beam,
    map_variance,
    pixel_window,
    synthesis,
)
from jaxsky.noise import draw, pixel_covariance, stream, white_alm
from jaxsky.settings import Experiment, at_key

#: Largest fraction of missing input, smoothed or averaged, in a pixel that is used.
MISSING = 0.01
#: Pixels whose products are summed at once; few enough to stay in cache.
CHUNK = 1 << 16


class MapNoise(NamedTuple):
    """Noise of Q and U of a map, with the preparation for the common resolution.

    `noise` is that of its own pixels, a level [uK_RJ arcmin] or the covariance of Q and U in each
    [uK_RJ^2]; `correlated` C_l of noise that is correlated between pixels, the same for E and B, in
    the prepared map [uK_RJ^2], None where there is none.
    """

    preparation: Preparation
    noise: Numeric
    correlated: Float[Array, " ell"] | None

    def covariance(self, rows: Float[Array, "row stokes pix"]) -> Float[np.ndarray, "row row"]:
        """Return the covariance of the inner products of rows with the prepared noise.

        Rows at the resolution of the noise are stored in its precision.
        """
        count = len(rows)
        block = np.zeros((count, count))
        if np.ndim(self.noise) or self.noise:
            noise = pixel_covariance(self.noise, self.preparation.nside_in)
            before = [
                np.asarray(self.preparation.transpose(row).astype(noise.dtype).block_until_ready())
                for row in rows
            ]
            covariance = np.asarray(noise)
            for cut in chunks(covariance.shape[-1], CHUNK):
                maps = np.array([row[:, cut] for row in before], dtype=float)
                seen = np.einsum("stp,jtp->jsp", covariance[..., cut].astype(float), maps)
                block += maps.reshape(count, -1) @ seen.reshape(count, -1).T
            block = (block + block.T) / 2
        if self.correlated is None:
            return block
        modes = np.asarray(_modes(rows, np.stack([self.correlated] * 2)))
        return block + modes @ modes.T

    def alm(self, key: Array, name: str) -> Float[Array, "2 alm"]:
        """Return E and B of a realisation of smoothed noise; the map's name is in its key."""
        window = self.preparation.window
        assert window is not None  # there is a common beam
        white = white_alm(stream(key, "noise", name), self.noise, window.size - 1) * expand(window)
        return white if self.correlated is None else white + self._correlated_alm(key, name)

    def _correlated_alm(self, key: Array, name: str) -> Float[Array, "2 alm"]:
        spectrum = jnp.asarray(self.correlated)
        white = jax.random.normal(stream(key, "correlated", name), (2, spectrum.size**2))
        return white * expand(jnp.sqrt(spectrum))

    def realisation(self, key: Array, name: str) -> Float[Array, "stokes pix"]:
        """Return noise at the common resolution [uK_RJ], with random numbers by name."""
        nside = self.preparation.nside
        if self.preparation.window is not None:
            return synthesis(self.alm(key, name), nside)
        pixels = jnp.asarray(pixel_covariance(self.noise, self.preparation.nside_in), float)
        total = average_pixels(draw(stream(key, "noise", name), pixels), nside)
        if self.correlated is None:
            return total
        return total + synthesis(self._correlated_alm(key, name), nside)

    def variance(self) -> Float[np.ndarray, "stokes pix"]:
        """Return the variance in each prepared pixel [uK_RJ^2]; see `Fluctuations.sigma`."""
        if np.ndim(self.noise):
            pixels = jnp.asarray(self.noise)
            total = np.asarray(self.preparation.variance([pixels[s, s] for s in range(2)]))
        else:
            shape = (2, healpy.nside2npix(self.preparation.nside))
            total = np.full(shape, self.preparation.uniform_variance(float(self.noise)))
        return total if self.correlated is None else total + map_variance(self.correlated)


class Fluctuations(eqx.Module):
    """Noise and CMB: what Q, U maps in several bands contain besides the model.

    Parameters
    ----------
    preparations, noise, correlated : per band; see `MapNoise`
    cmb_spectra : C_l of EE and BB [uK_CMB^2], shape (2, ell); None without CMB
    cmb_windows : beam and pixel window of the prepared maps of each band, shape (band, ell)
    cmb_factors : uK_RJ per uK_CMB in each band, shape (band,)
    names : names of the bands, from which the random numbers of each are derived
    """

    preparations: tuple[Preparation, ...]
    noise: tuple[Numeric, ...]
    correlated: tuple[Float[Array, " ell"] | None, ...]
    cmb_spectra: Float[Array, "stokes ell"] | None
    cmb_windows: Float[Array, "band ell"] | None
    cmb_factors: Float[Array, " band"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def noises(self) -> dict[str, MapNoise]:
        """The noise of each band by name."""
        each = map(MapNoise, self.preparations, self.noise, self.correlated)
        return dict(zip(self.names, each, strict=True))

    # Not one program: XLA would keep the maps of all rows and bands in memory at once.
    def covariance(
        self, rows: Float[Array, "band row stokes pix"]
    ) -> Float[np.ndarray, "bandrow bandrow"]:
        """Return the covariance of the inner products of rows with the fluctuations."""
        blocks = [one.covariance(own) for one, own in zip(self.noises.values(), rows, strict=True)]
        total = scipy.linalg.block_diag(*blocks)
        if self.cmb_spectra is None or self.cmb_windows is None:
            return total
        spectra = np.asarray(self.cmb_spectra)
        bands = zip(self.cmb_factors, self.cmb_windows, rows, strict=True)
        modes = np.concatenate(
            [
                np.asarray(factor) * _modes(own, spectra * np.asarray(window) ** 2)
                for factor, window, own in bands
            ]
        )
        return total + modes @ modes.T

    # Not one program: there XLA would draw the normals anew for each row.
    def noise_realisation(self, key: Array) -> Float[Array, "band stokes pix"]:
        """Return noise of all bands at the common resolution [uK_RJ]."""
        return jnp.stack([noise.realisation(key, name) for name, noise in self.noises.items()])

    @eqx.filter_jit
    def cmb_realisation(self, key: Array) -> Float[Array, "band stokes pix"]:
        """Return the CMB in all bands at the common resolution [uK_RJ]; zero without CMB."""
        nside = self.preparations[0].nside
        if self.cmb_spectra is None or self.cmb_windows is None:
            return jnp.zeros((len(self.preparations), 2, healpy.nside2npix(nside)))
        EE, BB = self.cmb_spectra
        zero = jnp.zeros_like(EE)
        alm = realisation(stream(key, "cmb"), jnp.stack([zero, EE, BB, zero]))
        seen = self.cmb_factors[:, None] * self.cmb_windows
        return jnp.stack([synthesis(alm * expand(window), nside) for window in seen])

    def cmb_power(self) -> Float[np.ndarray, "band 2 ell"]:
        """Return mean spectra EE and BB of the CMB in the maps of each band [uK_RJ^2]."""
        if self.cmb_spectra is None or self.cmb_windows is None:
            return np.zeros((len(self.preparations), 2, 1))
        seen = np.asarray(self.cmb_factors)[:, None] * np.asarray(self.cmb_windows)
        return seen[:, None] ** 2 * np.asarray(self.cmb_spectra)

    def sigma(self) -> Float[Array, "band stokes pix"]:
        """Return the standard deviation of the noise in each prepared pixel [uK_RJ].

        NaN where it is unknown: next to steps of the noise by more than a factor of about 100,
        where the smoothed map of variances rings below zero.
        """
        total = np.stack([noise.variance() for noise in self.noises.values()])
        return jnp.asarray(np.sqrt(np.where(total > 0, total, np.nan)))


@jax.jit
def _modes(
    rows: Float[Array, "row stokes pix"], spectra: Float[Array, "stokes ell"]
) -> Float[Array, "row mode"]:
    """Project rows on independent modes of unit variance, with the spectra of E and B."""
    lmax = spectra.shape[-1] - 1
    root = jnp.sqrt(spectra)[:, alm_ell(lmax)]
    return jnp.stack([(root * adjoint_synthesis(row, lmax)).ravel() for row in rows])


class CommonMaps(NamedTuple):
    """Templates and maps at the common resolution.

    `sky` is None if there are no templates. `leakage` was subtracted from the data, by band;
    `sources` is the nside of each template and map before preparation. `covariance_of` is that of
    the fluctuations, and caches its last result. `template_errors` is the noise of the templates
    where it is known, None if there is none.
    """

    sky: Sky | None
    bands: dict[str, Bandpass]
    data: Float[Array, "band stokes pix"]
    sigma: Float[Array, "band stokes pix"]
    used: Bool[np.ndarray, " pix"]
    fluctuations: Fluctuations
    leakage: dict[str, Float[Array, "stokes pix"]]
    sources: dict[str, int]
    covariance_of: CovarianceOf
    template_errors: TemplateErrors | None

    def model(self) -> Float[Array, "band stokes pix"]:
        """Return the emission of the templates in the bands [uK_RJ]."""
        assert self.sky is not None  # there are templates
        return observe(self.sky, list(self.bands.values()))

    def likelihood(
        self,
        start: Mapping[str, Numeric],
        *,
        stokes: str = "QU",
        region: Bool[np.ndarray, " pix"] | None = None,
        kind: str = "exact",
    ) -> SkyLikelihood:
        """Return a likelihood of the parameters in `start`, see `template_likelihood.likelihood`.

        Parameters
        ----------
        start : free parameters by name; errors from noise of the templates are those at these
            values
        stokes : "Q", "U" or "QU"
        region : pixels to use, among those usable; default all
        kind : "exact", or "diagonal" for the paper's sum over pixels
        """
        if kind not in ("exact", "diagonal"):
            raise ValueError(f"Argument `kind` must be 'exact' or 'diagonal', not {kind!r}.")
        used = self.used if region is None else self.used & region
        assert self.sky is not None  # there are templates
        return likelihood(
            self.sky,
            self.bands,
            self.data,
            jnp.where(used, self.sigma, jnp.inf),
            start,
            stokes=stokes,
            covariance_of=self.covariance_of if kind == "exact" else None,
            template_errors=self.template_errors,
        )

    def pixel_noise(
        self, used: Bool[np.ndarray, " pix"], factors: Float[np.ndarray, " band"]
    ) -> Noise:
        """Return the noise for spectral likelihoods, in a unit of which uK_RJ is `factors`."""
        sigma = np.asarray(self.sigma) * factors[:, None, None]
        return as_noise(np.where(used, sigma, np.inf), sigma.shape)


def prepared_maps(settings: Experiment, inputs: Inputs) -> CommonMaps:
    """Bring templates and maps to the resolution of the settings, named in errors."""
    with at_key("common"):
        return common_maps(inputs, settings.common.nside, settings.common.fwhm)


def common_maps(inputs: Inputs, nside: int, fwhm: float) -> CommonMaps:
    """Bring templates and maps to a common nside and, if fwhm > 0, a common beam.

    With fwhm = 0 pixels are averaged and beams unchanged. Otherwise, with fwhm in arcmin, all maps
    are cut at one multipole, up to which the coarsest is good.
    """
    templates = {f"template {name!r}": t for name, t in inputs.templates.items()}
    bands = {f"band {name!r}": b for name, b in inputs.bands.items()}
    leaked = {f"leakage of {what}": b.leakage for what, b in bands.items() if b.leakage is not None}
    given: dict[str, tuple[Bool[np.ndarray, " pix"], Any]] = {
        what: (t.used, t.fwhm) for what, t in templates.items()
    }
    given |= {what: (each.used, each.beam) for what, each in (bands | leaked).items()}
    nsides = {what: healpy.npix2nside(used.size) for what, (used, _) in given.items()}
    lmax = min(3 * nside - 1, 2 * min(nsides.values()))
    operators = {
        what: Preparation.smoothing(nsides[what], own, nside, fwhm, lmax, what)
        if fwhm
        else Preparation.averaging(nsides[what], nside, what)
        for what, (_, own) in given.items()
    }
    holes = common_holes([used for used, _ in given.values()]) if fwhm else {}
    kept = {what: holes.get(own) for what, own in nsides.items()}

    used = np.ones(healpy.nside2npix(nside), bool)
    for what, (own_used, _) in given.items():
        if not own_used.all():
            spread = operators[what]
            if fwhm:  # the whole beam, without the ringing that the cut at lmax causes
                window = gaussian_beam(fwhm, 2 * nsides[what])
                spread, own_used = Preparation(window, nsides[what], nside), holes[nsides[what]]
            left = spread(jnp.asarray(own_used[None], float))[0]
            used &= np.asarray(left) > 1 - MISSING
    sky = {
        name: prepare_component(template.component, operators[what], kept[what])
        for (what, template), name in zip(templates.items(), inputs.templates, strict=True)
    }

    def brought(what: str, maps: Array) -> Array:
        """Bring maps to the common resolution in double precision, zero in holes."""
        maps, own = jnp.asarray(maps, float), kept[what]
        return operators[what](maps if own is None else maps * own)

    leakage = {
        name: brought(f"leakage of band {name!r}", band.leakage.maps)
        for name, band in inputs.bands.items()
        if band.leakage is not None
    }
    data = [
        # Band by band: JAX would otherwise prepare the input of all transforms at once.
        (brought(f"band {name!r}", band.maps) - leakage.get(name, 0.0)).block_until_ready()
        for name, band in inputs.bands.items()
    ]
    # Averaged pixels contain multipoles beyond those they resolve.
    reach = lmax if fwhm else 4 * nside

    def noise_of(what: str, noise: Numeric, spectrum: Float[Array, " ell"] | None) -> MapNoise:
        """Return noise of the pixels that are kept, and C_l of its correlated part."""
        operator, own = operators[what], kept[what]
        if own is not None:
            noise = pixel_covariance(noise, operator.nside_in) * own
        if spectrum is not None:
            spectrum = spectrum[: reach + 1] * window_of(operator, reach) ** 2
        return MapNoise(operator, noise, spectrum)

    noises = [noise_of(what, band.noise, band.correlated) for what, band in bands.items()]
    each, cmb = zip(*noises, strict=True), _cmb(inputs, nside, fwhm, reach)
    preparations, noise, correlated = each
    fluctuations = Fluctuations(preparations, noise, correlated, *cmb, tuple(inputs.bands))
    sigma = fluctuations.sigma()
    known = np.asarray(jnp.isfinite(sigma).all(axis=(0, 1)))
    own_noise = {
        name: noise_of(f"template {name!r}", one.noise, one.correlated)
        for name, one in inputs.template_noise.items()
        if one.own
    }
    return CommonMaps(
        Sky(sky) if sky else None,
        {name: band.bandpass for name, band in inputs.bands.items()},
        jnp.stack(data),
        jnp.where(known, sigma, jnp.inf),
        used & known,
        fluctuations,
        leakage,
        nsides,
        remembered(fluctuations.covariance),
        template_errors(list(sky), inputs.template_noise, own_noise, fluctuations.noises),
    )


def _cmb(
    inputs: Inputs, nside: int, fwhm: float, lmax: int
) -> tuple[Array | None, Array | None, Array]:
    """Return spectra, windows and factors of the CMB for `Fluctuations`."""
    bands = inputs.bands.values()
    factors = jnp.stack([band.bandpass.conversion("uK_CMB", "uK_RJ") for band in bands])
    if inputs.cmb is None:
        return None, None, factors
    windows = jnp.stack([beam_ratio(fwhm or band.beam, 0.0, lmax) for band in bands])
    if not fwhm:
        windows = windows * pixel_window(nside, lmax)
    return jnp.asarray(inputs.cmb(lmax)[1:3]), windows, factors


def window_of(preparation: Preparation, lmax: int) -> Float[Array, " ell"]:
    """Return the factors by which a preparation multiplies the multipoles of a map."""
    if preparation.window is not None:
        return preparation.window[: lmax + 1]
    pixels = pixel_window(preparation.nside, lmax) / pixel_window(preparation.nside_in, lmax)
    return jnp.asarray(pixels)
