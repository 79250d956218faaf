"""Small skies with known answers, shared by the tests."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsky import AME, CMB, Bandpass, Component, Dust, Sky, Synchrotron
from jaxsky.components import HensleyDraine, InterpolatedMap, LineEmission, SpinningDust

NPIX = 48


def random_maps(seed: int, stokes: int = 2, npix: int = NPIX) -> jnp.ndarray:
    return jnp.asarray(np.random.default_rng(seed).normal(size=(stokes, npix)) * 10)


def spread(center: float, width: float, npix: int = NPIX) -> jnp.ndarray:
    """A map of a parameter, even over center +- width."""
    return jnp.asarray(center + width * np.random.default_rng(9).uniform(-1, 1, npix))


def emissivity() -> np.ndarray:
    """A table like SPDUST2's: it rises as a power, and falls steeply beyond 30 GHz."""
    x = np.geomspace(0.02, 15.0, 300)
    return np.stack([30 * x, 1e-18 * x**2 * np.exp(1 - x**1.2)], axis=1)


def grains() -> np.ndarray:
    """A table like those of Hensley & Draine: intensities by frequency and log10 of the field."""
    nu, u = np.geomspace(9.0, 1000.0, 60), np.linspace(-2, 2, 17)
    intensity = nu[:, None] ** 4.6 / np.expm1(np.outer(0.048 * nu, 10 ** (-u / 5.6) / 19))
    return np.block([[np.zeros((1, 1)), u[None]], [nu[:, None], intensity]])


def components(stokes: int = 2) -> dict[str, Component]:
    """One component of each kind, every parameter at a value at which it matters."""
    maps = random_maps(1, stokes)
    dust = random_maps(2, stokes)
    ame = AME.from_dust_angles(jnp.abs(maps[0]), dust, 0.01, nu_ref=22.8) if stokes > 1 else None
    return {
        "synchrotron": Synchrotron(maps, 3.1, curvature=-0.2, nu_piv=23.0, nu_ref=30.0),
        "dust": Dust(maps, 1.53, 21.0, nu_ref=353.0),
        "two_body_dust": Dust(
            maps, (1.67, 2.70), (9.4, 16.2), (0.49, 1.0), nu_ref=353.0, nu_pivot=3000.0
        ),
        "ame": ame or AME(maps, nu_ref=22.8),
        "cmb": CMB(maps),
        "interpolated": InterpolatedMap(maps, 40.0, 200.0, 100.0),
        "line": LineEmission(maps, 70.3),
        "hd17": HensleyDraine(maps, grains(), 0.3),
        "spinning_dust": SpinningDust(maps, emissivity(), 33.35, nu_table=30.0),
    }


def bands() -> list[Bandpass]:
    nu = np.linspace(60.0, 80.0, 21)
    return [Bandpass(nu, np.hanning(23)[1:-1], "power"), Bandpass.top_hat(143.0, 40.0, samples=15)]


def dust_and_synchrotron(npix: int = NPIX) -> Sky:
    return Sky(
        {
            "dust": Dust(random_maps(3, npix=npix), 1.53, 21.0),
            "synchrotron": Synchrotron(random_maps(4, npix=npix), 3.1),
        }
    )


def small_experiment(
    channels: tuple[str, ...], instrument: str = "planck", nside: int = 16, **tables: Any
) -> dict[str, Any]:
    """Settings on the embedded sky at a low resolution; tables are added, or replace others."""
    return {
        "title": "small",
        "sky": {"embedded": {"nside": nside}},
        "bands": [{"instrument": instrument, "channels": list(channels)}],
        "common": {"nside": nside // 2, "fwhm": 600.0},
    } | tables
