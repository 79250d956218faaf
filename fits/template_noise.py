"""Noise of the templates: how much it attenuates them, and where that moves a fit.

The products of a noisy template with itself hold its noise as well, those with the data do not,
so the amplitudes that a fit finds are too small. Nothing is corrected here: what the noise does is
computed to first order and said.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.compress import gram
from fits.posterior import Likelihood
from fits.results import FitResult
from fits.template_likelihood import TemplateLikelihood
from jaxsky import Sky
from jaxsky.harmonics import Preparation, gaussian_beam, pixel_window
from jaxsky.inputs import Template
from jaxsky.noise import pixel_covariance
from jaxsky.noise_inputs import read_noise
from jaxsky.settings import ComponentTable, SettingsError
from jaxsky.units import conversion


class TemplateNoise(NamedTuple):
    """Noise of Q and U of a template; without both it has none.

    `level` is that of white noise seen through the template's own beam [uK_RJ arcmin], and
    `covariance` that of each pixel of its map [uK_RJ^2].
    """

    level: float = 0.0
    covariance: Float[Array, "2 2 pix"] | None = None


class Attenuation(NamedTuple):
    """What the noise of the templates does to a fit.

    `shares` is the part of each template's weighted power that is noise, by which its amplitude is
    attenuated; `shifts` what that adds to each parameter, to first order.
    """

    shares: dict[str, float]
    shifts: dict[str, float]


def read_template_noise(
    folder: Path, name: str, spec: ComponentTable, template: Template
) -> TemplateNoise:
    """The noise that the settings state of a template."""
    noise, where = spec.noise, f"sky.{name}.noise"
    assert noise is not None  # as called
    if noise.rms == 0 or noise.level == 0:
        return TemplateNoise()
    if spec.angles is not None:
        raise SettingsError(
            f"{where}: is not known for a template with the angles of another; write "
            "{ rms = 0.0 } to take it as exact."
        )
    nu_ref = float(template.component.nu_ref)  # type: ignore[attr-defined]
    if noise.level is not None:
        unit = noise.unit or template.unit
        return TemplateNoise(noise.level * float(conversion(unit, "uK_RJ", nu_ref)))
    maps = template.component.amplitude
    nside, used = healpy.npix2nside(template.used.size), template.used
    found, _ = read_noise(
        folder, noise, nu_ref, nside, where, template.unit, own=spec, maps=maps, used=used
    )
    return TemplateNoise(covariance=pixel_covariance(found, nside))


def prepared_variance(
    noise: TemplateNoise, own_fwhm: float, preparation: Preparation, fwhm: float
) -> Float[Array, "2 pix"]:
    """Variance of a template's noise in each pixel at the common resolution [uK_RJ^2]."""
    npix = healpy.nside2npix(preparation.nside)
    if noise.covariance is not None:
        return preparation.variance([noise.covariance[s, s] for s in range(2)])
    if preparation.window is None:
        lmax = 4 * preparation.nside
        window = gaussian_beam(own_fwhm, lmax) * pixel_window(preparation.nside, lmax)
    else:
        window = gaussian_beam(fwhm, preparation.window.size - 1)
    ell = np.arange(2, window.size)
    power = (noise.level * np.radians(1 / 60)) ** 2 * np.asarray(window)[2:] ** 2
    return jnp.asarray(np.full((2, npix), np.sum((2 * ell + 1) * power) / (4 * np.pi)))


def attenuation(
    like: Likelihood,
    result: FitResult,
    sky: Sky,
    variances: Mapping[str, Float[Array, "stokes pix"]],
    sigma: Float[Array, "band stokes pix"],
    used: Bool[np.ndarray, " pix"],
    stokes: str,
) -> Attenuation:
    """What the noise of templates does to the fit of one region and choice of Stokes parameters.

    `sky` has the templates at the common resolution, and `variances` are those of their noise;
    templates that it does not name are exact. No shifts are known for parameters that are maps.
    """
    weights = jnp.where(used & jnp.isfinite(sigma), 1 / sigma**2, 0.0)
    templates = jnp.stack([c.amplitude for c in sky.components.values()])
    spread = jnp.stack([variances.get(n, jnp.zeros_like(templates[0])) for n in sky])
    keep = np.array(["QU".index(s) for s in stokes])
    noise = jnp.einsum("bsp,ksp->bsk", weights, spread)[:, keep]
    products = gram(jnp.zeros_like(sigma), templates, weights)[:, keep, 1:, 1:]
    power = jnp.einsum("bskk->bsk", products)[..., :-1]
    totals = np.asarray(noise.sum(axis=(0, 1)) / power.sum(axis=(0, 1)))
    shares = dict(zip(sky, totals.tolist(), strict=True))
    if not isinstance(like, TemplateLikelihood):
        return Attenuation(shares, {})
    params = {name: jnp.asarray(value) for name, value in result.best_fit.items()}
    lost = like.coefficients(params)[:, keep] * noise
    # The amplitudes that the products with the data lack, with a constant if an offset is free.
    count = lost.shape[-1] + any(name.startswith("offset.") for name in params)
    lost = jnp.pad(lost, ((0, 0), (0, 0), (0, count - lost.shape[-1])))
    lacking = jnp.linalg.solve(products[..., :count, :count], lost[..., None])[..., 0]
    lacking = jnp.pad(lacking, ((0, 0), (0, 0), (0, len(templates) + 1 - count)))
    vector = jnp.zeros((len(sigma), sigma.shape[1], len(templates) + 2))
    moved = like.matrix @ vector.at[:, keep, 1:].set(-lacking).ravel()
    gradient = jax.vjp(like.residuals, params)[1](moved)[0]
    slope = np.array([float(gradient[name]) for name in result.free])
    # A parameter at the edge of its prior has no error, and stays there.
    covariance = np.asarray(result.covariance)
    shifts = -np.nan_to_num(covariance) @ slope
    shifts[np.isnan(np.diagonal(covariance))] = np.nan
    return Attenuation(shares, dict(zip(result.free, shifts.tolist(), strict=True)))


def unknown_noise(names: Sequence[str]) -> str:
    """A warning that nothing is said about the noise of templates, with the size of its effect."""
    which = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    return (
        f"Nothing is said about the noise of the templates ({which}), which attenuates them and "
        "moves the indices. At about the level of Commander's maps, 34 uK_RJ arcmin for dust and "
        "200 for synchrotron, fits to Planck's 44 and 70 GHz get beta_dust wrong by -0.007 (-0.8 "
        "sigma) and beta_syn by +0.036 (+2.7 sigma) at |b| < 20 deg, -0.019 (-2.1 sigma) and "
        "+0.076 (+5.3 sigma) on the full sky. State it in the templates, noise = { level = 34.0 }, "
        "or noise = { rms = 0.0 } for exact templates."
    )
