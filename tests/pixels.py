"""Skies, data and noise whose pixels may be distributed, and all that is found from them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.experimental.multihost_utils import process_allgather

from fits.compress import as_noise
from fits.optimize import best_fit
from fits.posterior import chi2, value_and_gradient
from fits.products import gram
from fits.profile_likelihood import spectral_likelihood
from fits.separated_maps import component_maps
from fits.template_likelihood import likelihood
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe, observe_components
from jaxsky.mesh import spread

BANDS = {
    "30": Bandpass.top_hat(30.0, 8.0, samples=9),
    "44": Bandpass.top_hat(44.0, 10.0, samples=11),
    "70": Bandpass(np.linspace(63.0, 77.0, 15), np.hanning(17)[1:-1], "power"),
    "143": Bandpass.top_hat(143.0, 40.0, samples=15),
    "217": Bandpass.top_hat(217.0, 60.0, samples=15),
}
START = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}

#: Maps, and the value of their padding, to maps that are distributed or as they were.
Place = Callable[..., Any]


def sky_of(npix: int, varying: bool) -> Sky:
    """Dust and synchrotron; `varying` indices are maps."""
    rng = np.random.default_rng(1)
    dust, synchrotron = 10 * rng.normal(size=(2, 2, npix))
    beta = 1.53 + 0.02 * rng.uniform(-1, 1, npix) if varying else 1.53
    return Sky({"dust": Dust(dust, beta, 21.0), "synchrotron": Synchrotron(synchrotron, 3.1)})


def placed(sky: Sky, place: Place) -> Sky:
    """The sky with its maps in their place."""
    return jax.tree.map(lambda leaf: place(np.asarray(leaf), None) if leaf.ndim else leaf, sky)


def data_of(npix: int, varying: bool) -> tuple[np.ndarray, np.ndarray]:
    """Maps in the bands, and standard deviations, infinite in some pixels."""
    rng = np.random.default_rng(2)
    maps = np.asarray(observe(sky_of(npix, varying), list(BANDS.values())))
    sigma = rng.uniform(0.5, 1.5, maps.shape)
    sigma[:, :, rng.uniform(size=npix) < 0.1] = np.inf
    noise = rng.normal(size=maps.shape)
    return maps + np.where(np.isfinite(sigma), sigma, 1.0) * noise, sigma


def whole(maps: Any, npix: int) -> np.ndarray:
    """All pixels of maps without their padding, from all processes."""
    if spread(maps) and jax.process_count() > 1:
        maps = process_allgather(maps, tiled=True)
    return np.asarray(maps)[..., :npix]


#: Few bands are enough for templates, and are compiled sooner.
FEW = {name: BANDS[name] for name in ("44", "70")}


def of_templates(npix: int, place: Place, varying: bool) -> dict[str, np.ndarray]:
    """What the model and the likelihood of templates say."""
    sky = placed(sky_of(npix, varying), place)
    data, sigma = (maps[1:3] for maps in data_of(npix, varying))
    data, sigma = place(data), place(sigma, np.inf)
    bands = list(FEW.values())
    found = {"maps": whole(observe(sky, bands), npix)}
    for name, maps in observe_components(sky, bands).items():
        found[f"maps of {name}"] = whole(maps, npix)
    suffix = ".offset" if varying else ""
    start = {f"dust.beta_dust{suffix}": 0.05 if varying else 1.6, "offset.70.Q": 0.0}
    like = likelihood(sky, FEW, data, sigma, start)
    found["chi2"] = np.asarray(chi2(like, start))
    fit = best_fit(like, throw=False)
    names = sorted(start)
    found |= {"sigma": np.array([fit.sigma[n] for n in names]), "dof": np.array(fit.dof)}
    found["best fit in sigma"] = np.array([fit.best_fit[n] / fit.sigma[n] for n in names])
    if not varying:
        templates = jnp.stack([sky[name].amplitude for name in sky])
        weights = jnp.where(jnp.isfinite(sigma), 1 / sigma**2, 0)
        found["inner products"] = np.asarray(gram(data, templates, weights))

        def covariance_of(rows):  # of independent pixels; the whole sky of each row is needed
            flat = np.asarray(rows).reshape(len(FEW), -1, data.shape[1] * rows.shape[-1])
            return scipy.linalg.block_diag(*(own @ own.T for own in flat))

        exact = likelihood(sky, FEW, data, sigma, start, covariance_of=covariance_of)
        found["exact chi2"] = np.asarray(chi2(exact, start))
    return found


def noise_of(kind: str, npix: int, place: Place) -> Any:
    """Noise of bands alone, with a factor or all in pixels, or with covariances of Q and U."""
    rng = np.random.default_rng(3)
    factor = np.where(rng.uniform(size=npix) < 0.1, np.inf, rng.uniform(0.8, 1.2, npix))
    level = np.linspace(0.5, 1.5, len(BANDS))
    if kind == "bands":
        return level
    if kind == "factor":
        factor = place(factor, np.inf)
        return as_noise(level, (len(BANDS), 2, factor.size), factor)
    sigma = level[:, None, None] * factor * rng.uniform(0.9, 1.1, (len(BANDS), 2, npix))
    if kind == "pixels":
        return place(sigma, np.inf)
    QQ, UU = sigma[:, 0] ** 2, sigma[:, 1] ** 2
    QU = np.where(np.isinf(QQ), 0.0, 0.3 * sigma[:, 0] * sigma[:, 1])
    covariance = np.stack([QQ, QU, QU, UU], axis=1)
    return place(covariance.reshape(len(BANDS), 2, 2, npix), np.inf)


def of_components(
    npix: int, place: Place, kind: str, regions: bool, compress: bool | None = None
) -> dict[str, np.ndarray]:
    """What the spectral likelihood says, and the components' maps."""
    data, noise = place(data_of(npix, False)[0]), noise_of(kind, npix, place)
    labels = {"dust.beta_dust": place(np.arange(npix) // 5 % 3)} if regions else {}
    options = {"labels": labels, "compress": compress}
    like = spectral_likelihood(sky_of(1, False), BANDS, data, noise, START, **options)
    value, gradient = value_and_gradient(like, like.flat({}))
    fit = best_fit(like, throw=False)
    names = sorted(START)
    sigma = np.concatenate([np.atleast_1d(fit.sigma[name]) for name in names])
    values = np.concatenate([np.atleast_1d(fit.best_fit[name]) for name in names])
    found = {"chi2": np.asarray(value), "gradient": np.asarray(gradient), "sigma": sigma}
    found |= {"best fit in sigma": values / sigma, "dof": np.array(fit.dof)}
    maps = component_maps(like, {}, data, noise)
    for name in maps._fields[1:]:
        found[f"{name} of maps"] = whole(getattr(maps, name), npix)
    found["degradation"] = whole(maps.degradation("dust"), npix)
    return found


def in_single_precision(npix: int, place: Place) -> dict[str, np.ndarray]:
    """Inner products and emission of maps in single precision."""
    sky = sky_of(npix, False)
    data, sigma = (maps.astype(np.float32) for maps in data_of(npix, False))
    weights = np.where(np.isfinite(sigma), 1 / sigma**2, 0)
    templates = np.stack([sky[name].amplitude for name in sky]).astype(np.float32)
    products = gram(place(data, 0.0), place(templates, 0.0), place(weights, 0.0))
    return {"inner products": np.asarray(products)}


def every(npix: int, place: Place) -> dict[str, np.ndarray]:
    """All of these by name, with the same order everywhere."""
    cases = {
        "templates": of_templates(npix, place, False),
        "varying": of_templates(npix, place, True),
        "factor": of_components(npix, place, "factor", False),
        "pixels": of_components(npix, place, "pixels", True),
        "covariance": of_components(npix, place, "covariance", False),
        "single": in_single_precision(npix, place),
    }
    return {f"{case}: {name}": v for case, found in cases.items() for name, v in found.items()}


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Equal to rounding; parameters to 1e-6 of their standard deviation, and that likewise."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(np.isnan(found[name]), np.isnan(value), err_msg=name)
        fitted = name.endswith("sigma")
        scale = 1.0 if name.endswith("in sigma") else np.nanmax(np.abs(value))
        most = 1e-6 if fitted else 1e-5 if name.startswith("single") else 1e-12
        assert np.nanmax(np.abs(found[name] - value)) <= most * scale, name
