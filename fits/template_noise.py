"""Noise of the templates: taken out of the inner products of a fit, and added to its errors.

With templates T = t + n the products with the data have the mean t^T W d, but those of templates
with each other t^T W t + <n^T W n>: amplitudes come out too small, and indices are moved. The
mean of the noise is known where its covariance is, and is subtracted (errors in variables; Fuller
1987, Measurement Error Models, ch. 2). What is left, sum_j c_j T_k^T W n_j in a band where
template j is seen with the coefficient c_j, is the same noise in all bands; its covariance joins
that of the data, at the coefficients of the best fit.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.kept import remembered
from jaxsky.checks import Numeric, listed
from jaxsky.harmonics import gaussian_beam
from jaxsky.inputs import Template, uK_RJ_per
from jaxsky.noise_inputs import read_noise
from jaxsky.settings import ComponentTable, SettingsError

if TYPE_CHECKING:
    from fits.common import MapNoise


class TemplateNoise(NamedTuple):
    """Noise of Q and U of a template; without any of these it has none.

    `noise` is that of the pixels of its map, a level [uK_RJ arcmin] or the covariance of Q and U in
    each [uK_RJ^2]; `correlated` the spectrum C_l of noise that is correlated between pixels
    [uK_RJ^2]. `shared` says how many times the noise of a band, by name, is in the template, too.
    """

    noise: Numeric = 0.0
    correlated: Float[Array, " ell"] | None = None
    shared: Mapping[str, float] = MappingProxyType({})

    @property
    def own(self) -> bool:
        """Whether there is noise that is not a band's."""
        return bool(np.ndim(self.noise)) or bool(self.noise) or self.correlated is not None


def level_spectrum(level: float, fwhm: float, lmax: int) -> Float[Array, " ell"]:
    """Spectrum of white noise of a level [uK_RJ arcmin], seen through a beam of fwhm [arcmin]."""
    white = (level * np.radians(1 / 60)) ** 2 * jnp.asarray(gaussian_beam(fwhm, lmax)) ** 2
    return white.at[:2].set(0.0)


def read_template_noise(
    folder: Path, name: str, spec: ComponentTable, template: Template
) -> TemplateNoise | None:
    """The noise that the settings state of a template; None where they do not."""
    noise, where = spec.noise, f"sky.{name}.noise"
    if noise is None:
        return TemplateNoise() if spec.file is None else None  # the embedded maps are exact
    if noise.rms == 0 or noise.level == 0:
        return TemplateNoise(shared=noise.shared)
    if spec.angles is not None:
        raise SettingsError(
            f"{where}: is not known for a template with the angles of another; write "
            "{ rms = 0.0 } to take it as exact."
        )
    nside = healpy.npix2nside(template.used.size)
    if noise.level is not None:
        level = noise.level * uK_RJ_per(noise.unit or template.unit, spec.nu_ref, where)
        spectrum = level_spectrum(level, template.fwhm, 4 * nside)
        return TemplateNoise(correlated=spectrum, shared=noise.shared)
    found, _ = read_noise(
        folder,
        noise,
        spec.nu_ref,
        nside,
        where,
        template.unit,
        own=spec,
        maps=template.component.amplitude,
        used=template.used,
    )
    return TemplateNoise(found, shared=noise.shared)


class TemplateErrors(NamedTuple):
    """Noise of templates at the common resolution, as a sum of independent sources.

    Sources are the noise of each template that no other map has, and that of bands which
    templates share.

    Attributes
    ----------
    covariances_of : covariance of the products of rows with each source, (source, row, row)
    parts : of each source in each template, shape (template, source)
    of_band : 1 where a source is the noise of a band, shape (band, source)
    variance : of each source in each pixel [uK_RJ^2], shape (source, stokes, pix)
    """

    covariances_of: Callable[[Float[Array, "row stokes pix"]], Float[np.ndarray, "source row row"]]
    parts: Float[np.ndarray, "template source"]
    of_band: Float[np.ndarray, "band source"]
    variance: Float[Array, "source stokes pix"]

    def mean_products(
        self, weights: Float[Array, "band stokes pix"]
    ) -> Float[np.ndarray, "band stokes row row"]:
        """Means of what noise adds to the products of (data, templates, 1), as `gram` has them."""
        power = np.einsum("bsp,usp->bsu", weights, self.variance)
        bands, stokes, _ = power.shape
        size = len(self.parts) + 2
        total = np.zeros((bands, stokes, size, size))
        total[..., 1:-1, 1:-1] = np.einsum("bsu,ku,ju->bskj", power, self.parts, self.parts)
        with_data = np.einsum("bsu,bu,ku->bsk", power, self.of_band, self.parts)
        total[..., 0, 1:-1] = total[..., 1:-1, 0] = with_data
        return total

    def covariance(
        self,
        rows: Float[Array, "band row stokes pix"],
        coefficients: Float[np.ndarray, "band row template"],
    ) -> Float[np.ndarray, "bandrow bandrow"]:
        """What noise of templates adds to the covariance of products of rows with residuals.

        `coefficients` are those of the templates in what each row is multiplied with.
        """
        flat = rows.reshape(-1, *rows.shape[2:])
        each = self.covariances_of(flat)
        own = np.repeat(self.of_band, rows.shape[1], axis=0)
        seen = own - np.asarray(coefficients).reshape(len(flat), -1) @ self.parts
        return np.einsum("umn,mu,nu->mn", each, seen, seen) - np.einsum(
            "umn,mu,nu->mn", each, own, own
        )


def template_errors(
    names: Sequence[str],
    noises: Mapping[str, TemplateNoise],
    own: Mapping[str, "MapNoise"],
    bands: Mapping[str, "MapNoise"],
) -> TemplateErrors | None:
    """Errors of templates from the noise that some have of their own, and that of all bands.

    None where there is neither.
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
    variance = np.stack([source.variance() for source in sources])
    return TemplateErrors(
        remembered(lambda rows: np.stack([source.covariance(rows) for source in sources])),
        np.array(parts),
        np.array(of_band),
        jnp.asarray(np.where(variance > 0, variance, 0.0)),
    )


def check_signal(products: Float[np.ndarray, "band stokes template template"]) -> None:
    """Raise ValueError where the noise of templates leaves none of their power, or less."""
    total = products.sum(axis=(0, 1))
    scale = np.sqrt(np.abs(np.diagonal(total)))
    if np.linalg.eigvalsh(total / scale / scale[:, None])[0] <= 0:
        raise ValueError(
            "The noise of the templates is all that they hold in this region, or more than that; "
            "look at its level and unit."
        )


def unknown_noise(names: Sequence[str]) -> str:
    """A warning that nothing is said about the noise of templates, with the size of its effect."""
    return (
        f"Nothing is said about the noise of the templates ({listed(names)}), which attenuates "
        "them and moves the indices. At about the level of Commander's maps, 34 uK_RJ arcmin for "
        "dust and 200 for synchrotron, fits to Planck's 44 and 70 GHz get beta_dust wrong by "
        "-0.007 (-0.8 sigma) and beta_syn by +0.036 (+2.7 sigma) at |b| < 20 deg, -0.019 (-2.1 "
        "sigma) and +0.076 (+5.3 sigma) on the full sky. State it in the templates, noise = "
        "{ level = 34.0 }, and the fit is corrected for it, or noise = { rms = 0.0 } for exact "
        "templates."
    )
