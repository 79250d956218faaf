"""LiteBIRD's 15 bands with CMB, dust and synchrotron, and fits to them in a process of their own.

`python -m benchmarks.separation_runs NAME NSIDE OUT` makes maps, times the call that fits them for
the first time in this process, compilation included, and again, and writes the times as JSON.
"""

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits

from benchmarks.timing import seconds
from fits.optimize import best_fit
from fits.profile_likelihood import spectral_likelihood
from fits.regions import superpixels
from jaxsky import CMB, Bandpass, Dust, Sky, Synchrotron, observe, observe_components
from jaxsky.observation import band_tables, load_instrument

NAMES = ("dust.T_dust", "dust.beta_dust", "synchrotron.beta_syn")
TRUTH = dict(zip(NAMES, (20.0, 1.54, 3.0), strict=True))
START = dict(zip(NAMES, (19.0, 1.6, 3.1), strict=True))
NU_DUST, NU_SYNCHROTRON = 353.0, 23.0
#: Standard deviation of Q and U of CMB [uK_CMB], dust and synchrotron [uK_RJ at their NU].
SIZES = (0.6, 20.0, 15.0)
UNIT = "uK_CMB"
#: Pixels made at a time, so that nothing but the maps themselves takes memory.
PIXELS = 1 << 16
SIMULATIONS = 1000
#: Real polarisation with maps of the indices, all at nside 64; see `../shared/data/README.md`.
TEMPLATES = (
    Path(os.environ.get("JAXSKY_DATA", Path(__file__).parents[2] / "shared" / "data")) / "templates"
)
DUST, SYNCHROTRON = "pysm2_d1_QU353GHz_betad_Td_n64.fits", "pysm2_s1_QU23GHz_betas_n64.fits"


class Experiment(NamedTuple):
    """Bands, and noise of Q and U in a pixel [uK_CMB]."""

    bands: dict[str, Bandpass]
    sigma: np.ndarray

    @property
    def conversion(self) -> np.ndarray:
        """uK_CMB per uK_RJ in each band."""
        return np.array([float(b.conversion("uK_RJ", UNIT)) for b in self.bands.values()])


def litebird(nside: int) -> Experiment:
    """The instrument as `jaxsky.observation` has it: top hats of 51 samples, white noise."""
    levels = [band["noise"]["level"] for band in band_tables("litebird")]
    pixel = np.degrees(np.sqrt(4 * np.pi / (12 * nside**2))) * 60
    sigma = np.array(levels) / pixel
    return Experiment(load_instrument("litebird").bands(), sigma)


def white_sky(npix: int, rng: np.random.Generator, **cmb: float) -> Sky:
    """White Q and U of three components."""
    amplitudes = [size * rng.standard_normal((2, npix)) for size in SIZES]
    return Sky(
        {
            "cmb": CMB(amplitudes[0], **cmb),
            "dust": Dust(
                amplitudes[1], TRUTH["dust.beta_dust"], TRUTH["dust.T_dust"], nu_ref=NU_DUST
            ),
            "synchrotron": Synchrotron(
                amplitudes[2], TRUTH["synchrotron.beta_syn"], nu_ref=NU_SYNCHROTRON
            ),
        }
    )


def maps_in_memory(nside: int, noise: bool = True) -> np.ndarray:
    """Maps (band, stokes, pix) [uK_CMB], made with little memory besides."""
    bands, sigma = experiment = litebird(nside)
    rng = np.random.default_rng(1)
    one = jax.tree.map(lambda x: jnp.ones((2, 1)) if x.ndim == 2 else x, white_sky(1, rng))
    seen = observe_components(one, list(bands.values()))
    matrix = np.stack([maps[:, 0, 0] for maps in seen.values()], axis=1)
    matrix *= experiment.conversion[:, None]
    maps = np.empty((len(bands), 2, 12 * nside**2))
    for begin in range(0, maps.shape[-1], PIXELS):
        part = maps[..., begin : begin + PIXELS]
        sky = np.array(SIZES)[:, None, None] * rng.standard_normal((3, *part.shape[1:]))
        part[:] = np.tensordot(matrix, sky, 1)
        if noise:
            part += sigma[:, None, None] * rng.standard_normal(part.shape)
    return maps


def _constant(nside: int) -> Callable[[], dict[str, Any]]:
    """Three numbers for the whole sky."""
    bands, sigma = litebird(nside)
    maps = maps_in_memory(nside)
    laws = white_sky(1, np.random.default_rng(0))

    def run() -> dict[str, Any]:
        fit = best_fit(spectral_likelihood(laws, bands, maps, sigma, START, unit=UNIT))
        off = [(fit.best_fit[name] - TRUTH[name]) / fit.sigma[name] for name in NAMES]
        return {"steps": fit.details["steps"], "deviation": float(np.max(np.abs(off)))}

    return run


def _columns(name: str, *columns: str) -> list[np.ndarray]:
    with pyfits.open(TEMPLATES / name) as file:
        return [np.asarray(file[1].data[c], float).ravel() for c in columns]


def _regions(nside: int) -> Callable[[], dict[str, Any]]:
    """Superpixels of nside 4 for dust and 2 for synchrotron, on a sky that varies within them."""
    *dust, beta_dust, T_dust = _columns(DUST, "Q_353GHz", "U_353GHz", "BETA_D", "T_D")
    *synchrotron, beta_syn = _columns(SYNCHROTRON, "Q_23GHz", "U_23GHz", "BETA_S")
    if len(beta_syn) != 12 * nside**2:
        raise ValueError(f"The templates have {len(beta_syn)} pixels: not those of nside {nside}.")
    rng = np.random.default_rng(2)
    bands, sigma = experiment = litebird(nside)
    cmb = SIZES[0] * rng.standard_normal((2, len(beta_syn)))
    sky = Sky(
        {
            "cmb": CMB(cmb),
            "dust": Dust(np.stack(dust), beta_dust, T_dust, nu_ref=NU_DUST),
            # The files have the field's sign: T ~ nu^beta.
            "synchrotron": Synchrotron(np.stack(synchrotron), -beta_syn, nu_ref=NU_SYNCHROTRON),
        }
    )
    maps = np.asarray(observe(sky, list(bands.values()))) * experiment.conversion[:, None, None]
    maps += sigma[:, None, None] * rng.standard_normal(maps.shape)
    fine, coarse = superpixels(nside, 4), superpixels(nside, 2)
    labels = dict(zip(NAMES, (fine, fine, coarse), strict=True))
    laws = white_sky(1, rng)

    def run() -> dict[str, Any]:
        like = spectral_likelihood(laws, bands, maps, sigma, START, labels=labels, unit=UNIT)
        fit = best_fit(like)
        return {"steps": fit.details["steps"], "parameters": len(fit.labels)}

    return run


def _simulations(nside: int) -> Callable[[], dict[str, Any]]:
    """Many fits of three numbers to one sky, each with noise of its own."""
    bands, sigma = litebird(nside)
    rng = np.random.default_rng(3)
    signal = maps_in_memory(nside, noise=False)
    laws = white_sky(1, rng)
    wide = sigma[:, None, None]
    count = SIMULATIONS if nside >= 64 else 20

    def run() -> dict[str, Any]:
        noise, found, steps = np.empty_like(signal), [], 0
        for _ in range(count):
            rng.standard_normal(out=noise)
            noise *= wide
            noise += signal
            like = spectral_likelihood(laws, bands, noise, sigma, START, unit=UNIT)
            fit = best_fit(like)
            found.append([fit.best_fit[name] for name in NAMES])
            steps += fit.details["steps"]
        claimed = [fit.sigma[name] for name in NAMES]
        scatter = np.std(found, axis=0, ddof=1) / claimed
        return {"count": count, "steps": steps / count, "scatter": scatter.tolist()}

    return run


RUNS = {"constant": _constant, "regions": _regions, "simulations": _simulations}


def main() -> None:
    parser = argparse.ArgumentParser("python -m benchmarks.separation_runs", description="A fit.")
    parser.add_argument("name", choices=RUNS)
    parser.add_argument("nside", type=int)
    parser.add_argument("out", type=Path, help="JSON file with the times")
    parser.add_argument("--again", type=int, default=0, help="calls after the first")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    prepared = RUNS[arguments.name](arguments.nside)
    result: dict[str, Any] = {}
    calls = [seconds(lambda: result.update(prepared())) for _ in range(1 + arguments.again)]
    arguments.out.write_text(json.dumps({"first": calls[0], "again": calls[1:], **result}))


if __name__ == "__main__":
    main()
