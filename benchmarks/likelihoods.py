"""Likelihoods on a grid and in chains, next to a sum over pixels in numpy and emcee by itself."""

import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import emcee
import jax
import numpy as np

from benchmarks.table import Row, time_text
from benchmarks.timing import interleave, seconds
from fits.grid import chi2_on_grid
from fits.kept import KeptChain
from fits.posterior import Likelihood, Uniform
from fits.products import gram
from fits.sampling import sample
from fits.template_likelihood import likelihood
from jaxsky import Bandpass, Dust, Sky, Synchrotron, observe
from jaxsky.sed import H_OVER_K

NU_DUST, NU_SYNCHROTRON, T_DUST = 353.0, 30.0, 21.0
START = {"dust.beta_dust": 1.53, "synchrotron.beta_syn": 3.1}
PRIORS = {"dust.beta_dust": Uniform(1.2, 1.9), "synchrotron.beta_syn": Uniform(2.7, 3.5)}
WALKERS = 32


class Problem(NamedTuple):
    """Maps of Q, U in two bands, and all that a fit of two indices to them needs."""

    sky: Sky
    bands: list[Bandpass]
    data: np.ndarray
    sigma: np.ndarray

    @property
    def templates(self) -> np.ndarray:
        """Shape (template, stokes, pix)."""
        return np.stack([c.amplitude for c in self.sky.components.values()])

    @property
    def weights(self) -> np.ndarray:
        """1/sigma^2 of each pixel."""
        return np.broadcast_to(1 / self.sigma**2, self.data.shape)

    def likelihood(self) -> Likelihood:
        """The likelihood on inner products."""
        return likelihood(self.sky, self.bands, self.data, self.sigma, START)


def _problem(nside: int) -> Problem:
    rng = np.random.default_rng(3)
    shape = (2, 12 * nside**2)
    dust = Dust(rng.normal(0, 10, shape), 1.53, T_DUST, nu_ref=NU_DUST)
    synchrotron = Synchrotron(rng.normal(0, 10, shape), 3.1, nu_ref=NU_SYNCHROTRON)
    sky = Sky({"dust": dust, "synchrotron": synchrotron})
    bands = [Bandpass.top_hat(44.0, 8.8), Bandpass.top_hat(70.0, 14.0)]
    sigma = np.array([2.0, 1.0])[:, None, None]
    data = np.asarray(observe(sky, bands)) + sigma * rng.standard_normal((2, *shape))
    return Problem(sky, bands, data, sigma)


def _brute_force(problem: Problem) -> Callable[[float, float], float]:
    """chi^2 as a sum over all pixels, in numpy."""
    nu = np.stack([band.nu for band in problem.bands])
    quadrature = np.stack([band.quadrature for band in problem.bands])
    dust, synchrotron = problem.templates
    root = 1 / problem.sigma

    def body(x, beta_dust):
        return x ** (beta_dust + 1) / np.expm1(H_OVER_K * x / T_DUST)

    def chi2(beta_dust, beta_syn):
        dust_sed = body(nu, beta_dust) / body(NU_DUST, beta_dust)
        synchrotron_sed = (nu / NU_SYNCHROTRON) ** -beta_syn
        a, b = ((quadrature * s).sum(axis=1) for s in (dust_sed, synchrotron_sed))
        model = a[:, None, None] * dust + b[:, None, None] * synchrotron
        return float(np.sum(((problem.data - model) * root) ** 2))

    return chi2


def _grid_at(nside: int, points: int) -> tuple[Row, dict[str, float]]:
    """chi^2 on a grid, and the times of the one pass before it."""
    problem = _problem(nside)
    maps = jax.device_put((problem.data, problem.templates, problem.weights))
    like = problem.likelihood()
    jax.block_until_ready(gram(*maps))
    one_pass = interleave({"gram": lambda: gram(*maps), "likelihood": problem.likelihood}, 5)

    axes = {name: np.linspace(p.low, p.high, points) for name, p in PRIORS.items()}
    pixels = _brute_force(problem)
    beta_dust, beta_syn = (axis[points // 3] for axis in axes.values())

    def ours():
        return chi2_on_grid(like, axes)

    jax.clear_caches()
    first = seconds(ours)
    value = float(ours()[points // 3, points // 3])
    error = abs(value / pixels(beta_dust, beta_syn) - 1)
    times = interleave({"ours": ours, "pixels": lambda: pixels(beta_dust, beta_syn)}, 5)
    row = Row(
        f"chi2 on a {points} x {points} grid, two bands, nside {nside}",
        time_text(times["ours"]),
        "< 50 ms",
        times["ours"] < 0.05,
        f"numpy over the pixels / jaxsky {times.ratio('pixels', 'ours') * points**2:.2g}x "
        f"({time_text(times['pixels'])} a point, times {points**2}: extrapolated); "
        f"relative difference {error:.0e}; first call {time_text(first)}",
    )
    return row, {name: one_pass[name] for name in ("gram", "likelihood")}


def grid(quick: bool) -> list[Row]:
    """A grid of two indices at a low and a high resolution, and the pass over the maps."""
    nsides = (8, 16) if quick else (64, 1024)
    (low, before), (high, after) = (_grid_at(nside, 200) for nside in nsides)
    pixels, time = (nsides[1] / nsides[0]) ** 2, after["gram"] / before["gram"]
    one_pass = Row(
        f"the one pass over the maps before it, nside {nsides[0]} and {nsides[1]}",
        f"{time_text(before['gram'])} and {time_text(after['gram'])}",
        remarks=f"{time:.0f}x for {pixels:.0f}x the pixels; with all of `likelihood(...)` "
        f"{time_text(before['likelihood'])} and {time_text(after['likelihood'])}",
    )
    return [low, high, one_pass]


def _emcee_alone(path: Path, nsteps: int) -> None:
    """emcee and its own file, with a log-probability that costs nothing."""
    sampler = emcee.EnsembleSampler(
        WALKERS,
        len(START),
        lambda theta: -np.sum(theta**2, axis=1) / 2,
        vectorize=True,
        backend=emcee.backends.HDFBackend(path),
    )
    sampler.run_mcmc(np.random.default_rng(4).normal(size=(WALKERS, len(START))), nsteps)


def chain(quick: bool) -> list[Row]:
    """A chain kept in a file."""
    nside, nsteps, part = (16, 500, 100) if quick else (64, 5000, 500)
    like = _problem(nside).likelihood()
    with tempfile.TemporaryDirectory() as folder:
        files = (Path(folder) / f"{i}.npz" for i in itertools.count())

        def ours(nsteps=nsteps):
            backend = KeptChain(next(files))
            options = {"nwalkers": WALKERS, "backend": backend, "progress": False, "throw": False}
            return sample(like, START, priors=PRIORS, nsteps=nsteps, **options).chi2

        first = seconds(lambda: ours(part))
        calls = {"ours": ours, "emcee": lambda: _emcee_alone(next(files), part)}
        times = interleave(calls, 2 if quick else 3)
    scale = nsteps / part
    return [
        Row(
            f"emcee, {WALKERS} walkers x {nsteps} steps into a file, two indices",
            time_text(times["ours"]),
            "< 15 s",
            times["ours"] < 15,
            f"emcee with its own file and no likelihood / jaxsky "
            f"{times.ratio('emcee', 'ours') * scale:.2g}x ({time_text(times['emcee'] * scale)}, "
            f"scaled from {part} steps); first call, {part} steps with compilation, "
            f"{time_text(first)}",
        )
    ]
