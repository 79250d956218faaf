"""Bring templates, maps and their noise to a common resolution, where they can be compared."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.compress import Noise, as_noise
from fits.fluctuations import Fluctuations, MapNoise
from fits.inputs import Inputs
from fits.kept import remembered
from fits.mixing import TemplateErrors, template_errors
from fits.regions import common_holes
from fits.template_likelihood import CovarianceOf, SkyLikelihood, likelihood
from jaxsky import Bandpass, Component, Sky, job, observe
from jaxsky.arrays import stokes_rows
from jaxsky.checks import Numeric, check_choice
from jaxsky.harmonics import Preparation, beam_ratio, gaussian_beam, pixel_window, shortened
from jaxsky.io.stacks import Computed, Maps, Stack, computed, is_large, ranges, stored
from jaxsky.job import filled
from jaxsky.mesh import distribute, spread
from jaxsky.noise import pixel_covariance
from jaxsky.programs import return_memory
from jaxsky.settings import Experiment, at_key

#: Largest fraction of missing input, smoothed or averaged, in a pixel that is used.
MISSING = 0.01


class CommonMaps(NamedTuple):
    """Templates and maps at the common resolution.

    `sky` is None if there are no templates. `leakage` was subtracted from the data, by band;
    `sources` is the nside of each template and map before preparation. `covariance_of` is that of
    the fluctuations, and caches its last result. `template_errors` is the noise of the templates
    where it is known, None if there is none. Large maps of all bands lie on disk, or are computed
    when they are read (`jaxsky.io.stacks`).
    """

    sky: Sky | None
    bands: dict[str, Bandpass]
    data: Float[Array, "band stokes pix"] | Maps
    sigma: Float[Array, "band stokes pix"] | Maps
    used: Bool[np.ndarray, " pix"]
    fluctuations: Fluctuations
    leakage: dict[str, Float[Array, "stokes pix"]]
    sources: dict[str, int]
    covariance_of: CovarianceOf
    template_errors: TemplateErrors | None

    def model(self) -> Float[Array, "band stokes pix"]:
        """Return the emission of the templates in the bands [uK_RJ]."""
        assert self.sky is not None  # there are templates
        return observe(jax.tree.map(jnp.asarray, self.sky), list(self.bands.values()))

    def likelihood(
        self,
        start: Mapping[str, Numeric],
        *,
        stokes: str | None = None,
        region: Bool[np.ndarray, " pix"] | None = None,
        kind: str = "exact",
    ) -> SkyLikelihood:
        """Return a likelihood of the parameters in `start`, see `template_likelihood.likelihood`.

        Parameters
        ----------
        start : free parameters by name; errors from noise of the templates are those at these
            values
        stokes : some of the Stokes parameters of the maps, "Q", "U", "QU", "I" or "IQU"; all by
            default
        region : pixels to use, among those usable; default all
        kind : "exact", or "diagonal" for the paper's sum over pixels
        """
        check_choice("kind", kind, ("exact", "diagonal"))
        used: Any = self.used if region is None else self.used & region
        assert self.sky is not None  # there are templates
        sky, data, sigma = _own_pixels(self.sky, self.data, self.sigma)
        masked: Any
        if isinstance(sigma, Stack):
            masked = Computed(sigma.shape, lambda at: np.where(used[at], sigma[..., at], np.inf))
        else:
            masked = jnp.where(distribute(used) if spread(data) else used, sigma, jnp.inf)
        return likelihood(
            sky,
            self.bands,
            data,
            masked,
            start,
            stokes=stokes,
            covariance_of=self.covariance_of if kind == "exact" else None,
            template_errors=self.template_errors,
        )

    def pixel_noise(
        self, used: Bool[np.ndarray, " pix"], factors: Float[np.ndarray, " band"]
    ) -> Noise:
        """Return the noise for spectral likelihoods, in a unit of which uK_RJ is `factors`."""
        shape: Any = self.sigma.shape

        def sigma(part):
            return np.where(used[part], self.sigma[..., part] * factors[:, None, None], np.inf)

        return as_noise(computed(shape, sigma), shape)


def prepare_component(
    component: Component,
    preparation: Preparation,
    kept: Bool[np.ndarray, " pix"] | None = None,
    copies: int = 1,
) -> Component:
    """Bring a component's amplitude, and parameters that are maps, to the common resolution.

    Pixels of the amplitude that are not kept are set to zero; by default all are kept. Amplitudes
    that are large, if there were so many, lie on disk.
    """

    def brought(leaf):
        if leaf.ndim not in (1, 2):
            return leaf
        values = jnp.atleast_2d(jnp.asarray(leaf, float))
        if leaf.ndim == 2:
            values = values if kept is None else values * kept
        prepared = preparation(values).block_until_ready()
        return stored(prepared, copies) if leaf.ndim == 2 else prepared[0]

    return jax.tree.map(brought, component)


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
    given: dict[str, Any] = {what: (t.used, t.fwhm) for what, t in templates.items()}
    given |= {what: (each.used, each.beam) for what, each in (bands | leaked).items()}
    nsides = {what: healpy.npix2nside(used.size) for what, (used, _) in given.items()}
    lmax = min(3 * nside - 1, 2 * min(nsides.values()))
    operators = {
        what: Preparation.smoothing(nsides[what], own, nside, fwhm or None, lmax, what)
        for what, (_, own) in given.items()
    }
    holes = common_holes([used for used, _ in given.values()]) if fwhm else {}
    many, npix, stokes = len(inputs.bands), healpy.nside2npix(nside), len(inputs.stokes)
    if is_large((many, stokes, npix)) or any(isinstance(b.maps, Stack) for b in bands.values()):
        return_memory()
    kept = {what: holes.get(own) for what, own in nsides.items()}

    used = np.ones(npix, bool)
    for what, (own_used, _) in given.items():
        if not own_used.all():
            spread = operators[what]
            if fwhm:  # the whole beam, without the ringing that the cut at lmax causes
                window = shortened(gaussian_beam(fwhm, 2 * nsides[what]))
                spread, own_used = Preparation(window, nsides[what], nside), holes[nsides[what]]
            left = spread(jnp.asarray(own_used[None], float))[0]
            used &= np.asarray(left) > 1 - MISSING
    sky = {
        name: prepare_component(template.component, operators[what], kept[what], many)
        for (what, template), name in zip(templates.items(), inputs.templates, strict=True)
    }

    def brought(what: str, maps: Array | Maps) -> Array:
        """Bring maps to the common resolution in double precision, zero in holes."""
        own, given = kept[what], jnp.asarray(np.asarray(maps), float)
        given = given if own is None else given * own
        return operators[what](given)

    leakage = {
        name: brought(f"leakage of band {name!r}", band.leakage.maps)
        for name, band in inputs.bands.items()
        if band.leakage is not None
    }

    def observed(i: int) -> Array:
        name, band = list(inputs.bands.items())[i]
        maps = brought(f"band {name!r}", band.maps)
        return maps - leakage[name] if name in leakage else maps

    # Band by band: JAX would otherwise prepare the input of all transforms at once.
    data = filled((many, stokes, npix), observed)
    # Averaged pixels contain multipoles beyond those they resolve.
    reach = lmax if fwhm else 4 * nside

    def noise_of(
        what: str, noise: Numeric, spectrum: Float[Array, "*stokes ell"] | None
    ) -> MapNoise:
        """Return noise of the pixels that are kept, and C_l of its correlated part."""
        operator, own = operators[what], kept[what]
        if own is not None:
            whole = pixel_covariance(noise, operator.nside_in, stokes)
            shape, dtype = whole.shape, whole.dtype
            noise = computed(shape, lambda at: whole[..., at] * own[at], dtype, many)
        if spectrum is not None:
            last = reach if operator.window is None else operator.window.size - 1
            spectrum = spectrum[..., : last + 1] * window_of(operator, last) ** 2
        return MapNoise(operator, noise, spectrum, inputs.stokes)

    noises = {
        name: noise_of(f"band {name!r}", band.noise, band.correlated)
        for name, band in inputs.bands.items()
    }
    cmb = _cmb(inputs, nside, fwhm, reach)
    fluctuations = Fluctuations(tuple(noises.values()), *cmb, tuple(noises))
    sigma = fluctuations.sigma()
    known = np.ones(npix, bool)
    for part in ranges(npix):
        known[part] = np.isfinite(sigma[..., part]).all(axis=(0, 1))
    own_noise = {
        name: noise_of(f"template {name!r}", one.noise, one.correlated)
        for name, one in inputs.template_noise.items()
        if one.own
    }
    seen = computed(sigma.shape, lambda at: np.where(known[at], sigma[..., at], np.inf))
    return CommonMaps(
        sky=Sky(sky) if sky else None,
        bands={name: band.bandpass for name, band in inputs.bands.items()},
        data=_in_memory(data),
        sigma=_in_memory(seen),
        used=used & known,
        fluctuations=fluctuations,
        leakage=leakage,
        sources=nsides,
        covariance_of=remembered(fluctuations.covariance),
        template_errors=template_errors(list(sky), inputs.template_noise, own_noise, noises),
    )


#: The maps that were distributed last, and what they are then.
_distributed: list[Any] = [(), ()]


def _own_pixels(sky: Sky, data: Any, sigma: Any) -> tuple[Sky, Any, Any]:
    """Return maps distributed over the processes of a job, unless laws have maps of parameters."""
    maps = sky, data, sigma
    if job.number() == 1 or any(leaf.ndim == 1 for leaf in jax.tree.leaves(sky)):
        return maps
    if list(map(id, _distributed[0])) != list(map(id, maps)):
        own = jax.tree.map(lambda x: distribute(x, fill=None) if x.ndim == 2 else x, sky)
        _distributed[:] = maps, (own, distribute(data), distribute(sigma, fill=np.inf))
    return _distributed[1]


def _in_memory(maps: Maps) -> Any:
    """Return maps as an array of JAX, or those that lie on disk as they are."""
    return maps if isinstance(maps, Stack) else jnp.asarray(maps)


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
    spectra = inputs.cmb(lmax)
    if inputs.stokes != "IQU":
        spectra = spectra[stokes_rows(inputs.stokes)]
    return jnp.asarray(spectra), windows, factors


def window_of(preparation: Preparation, lmax: int) -> Float[Array, " ell"]:
    """Return the factors by which a preparation multiplies the multipoles of a map."""
    if preparation.window is not None:
        window = preparation.window[: lmax + 1]
        return jnp.pad(window, (0, lmax + 1 - window.size))
    pixels = pixel_window(preparation.nside, lmax) / pixel_window(preparation.nside_in, lmax)
    return jnp.asarray(pixels)
