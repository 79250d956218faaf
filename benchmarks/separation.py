"""Component separation: likelihoods next to FURAX, fits from cold starts, simulations, samples.

FGBuster is not on PyPI, so it is left out.
"""

import json
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.separation_runs import (
    NAMES,
    SIMULATIONS,
    START,
    TEMPLATES,
    TRUTH,
    UNIT,
    litebird,
    maps_in_memory,
    white_sky,
)
from benchmarks.table import Row, time_text
from benchmarks.timing import Usage, interleave, seconds, usage
from fits.posterior import Uniform
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.sampling import sample
from jaxsky import Bandpass, observe
from jaxsky.sed import cmb_derivative

#: Points at which the codes are compared; they are timed at the first.
POINTS = np.array([[20.0, 1.54, 3.0], [21.0, 1.5, 3.1], [18.5, 1.6, 2.95]])
#: Noise of a pixel and band is that of the instrument times a number between these.
SPREAD = (0.5, 2.0)
PRIORS = {
    "dust.T_dust": Uniform(10.0, 40.0),
    "dust.beta_dust": Uniform(1.0, 2.2),
    "synchrotron.beta_syn": Uniform(2.0, 4.0),
}

Evaluation = Callable[[np.ndarray], tuple[float, np.ndarray]]


@jax.jit
def _value_and_gradient(like, theta):
    """-ln L and its gradient, as the fits use them."""
    return jax.value_and_grad(lambda t: like.total(t[like.index]) / 2)(theta)


def _evaluation(like: SpectralLikelihood) -> Evaluation:
    return lambda theta: _value_and_gradient(like, jnp.asarray(theta))


def _errors(evaluation: Evaluation, truth: Evaluation) -> str:
    """Relative differences of the likelihood between points, and of the gradient at them."""
    ours, theirs = ([each(theta) for theta in POINTS] for each in (truth, evaluation))
    steps = [
        abs((b[0] - theirs[0][0]) / (a[0] - ours[0][0]) - 1)
        for a, b in zip(ours[1:], theirs[1:], strict=True)
    ]
    slopes = [
        np.linalg.norm(b[1] - a[1]) / np.linalg.norm(a[1])
        for a, b in zip(ours, theirs, strict=True)
    ]
    return f"differences to {float(max(steps)):.0e}, gradient to {float(max(slopes)):.0e}"


class _Beside(NamedTuple):
    """The same likelihood in both codes, at FURAX's monochromatic bands, and with real ones."""

    same: SpectralLikelihood
    wide: SpectralLikelihood
    peer: object

    @classmethod
    def made(cls, nside: int, pixel: bool) -> "_Beside":
        from benchmarks import furax_peer

        rng = np.random.default_rng(4)
        bands, sigma = litebird(nside)
        nu = np.array([float(band.center) for band in bands.values()])
        lines = dict(zip(bands, map(Bandpass.delta, nu), strict=True))
        sky = white_sky(12 * nside**2, rng, T_cmb=furax_peer.T_CMB)
        sigma = sigma[:, None, None]
        if pixel:
            sigma = sigma * rng.uniform(*SPREAD, (len(nu), *sky.shape))
        factor = np.asarray(cmb_derivative(nu, furax_peer.T_CMB))[:, None, None]
        data = np.asarray(observe(sky, list(lines.values()))) / factor
        data += sigma * rng.standard_normal(data.shape)
        noise = sigma * factor
        given = noise if pixel else noise[:, 0, 0]
        # In uK_RJ here, because units of uK_CMB are those of jaxsky's own T_CMB.
        same, wide = (
            spectral_likelihood(sky, each, data * factor, given, START) for each in (lines, bands)
        )
        return cls(same, wide, furax_peer.Furax(nu, data, sigma))


def uniform_noise(quick: bool) -> list[Row]:
    """Likelihood and gradient where each band has one noise: the pixels are compressed."""
    nside = 16 if quick else 64
    same, wide, furax = _Beside.made(nside, pixel=False)
    ways = {
        "its function": furax.conjugate_gradients(),
        "preconditioned": furax.conjugate_gradients(preconditioned=POINTS[1]),
        "direct": furax.direct(),
    }
    ours = _evaluation(same)
    errors = {name: _errors(way, ours) for name, way in ways.items()}
    calls = {name: lambda way=way: way(POINTS[0]) for name, way in ways.items()}
    calls["lines"] = lambda: ours(POINTS[0])
    calls["bands"] = lambda: _evaluation(wide)(POINTS[0])
    calls["bands"]()
    times = interleave(calls, 2 if quick else 7, atleast=0.2)
    ratio = times.ratio("its function", "bands")
    return [
        Row(
            f"separation, LiteBIRD's 15 bands, Q, U, nside {nside}, one noise a band: likelihood "
            "and gradient in beta_dust, T_dust, beta_syn: FURAX / jaxsky",
            f"{ratio:.0f}x",
            ">= 100x",
            ratio >= 100,
            f"{time_text(times['its function'])} (FURAX {version('furax')}, "
            "`negative_log_likelihood` with its analytical gradient, CG to 1e-6, monochromatic "
            f"bands: it has no others) / {time_text(times['bands'])} (bands of 51 samples; "
            f"monochromatic {time_text(times['lines'])}, "
            f"{times.ratio('its function', 'lines'):.0f}x); at the same bands they agree: "
            f"{errors['its function']}; FURAX with a preconditioner of ours "
            f"{times.ratio('preconditioned', 'bands'):.0f}x, its operators with systems solved "
            f"directly by us {times.ratio('direct', 'bands'):.0f}x",
        )
    ]


def pixel_noise(quick: bool) -> list[Row]:
    """Likelihood and gradient where each pixel has its own noise in each band."""
    nside = 8 if quick else 64
    same, wide, furax = _Beside.made(nside, pixel=True)
    from benchmarks import furax_peer

    ways = {
        "plain": furax.conjugate_gradients(),
        "preconditioned": furax.conjugate_gradients(preconditioned=POINTS[1]),
        "direct": furax.direct(),
    }
    ours = _evaluation(same)
    errors, steps = {}, {}
    for name, way in ways.items():
        furax.steps.clear()
        errors[name] = _errors(way, ours)
        steps[name] = max(furax.steps, default=0)
    calls = {name: lambda way=way: way(POINTS[0]) for name, way in ways.items()}
    calls["lines"] = lambda: ours(POINTS[0])
    calls["bands"] = lambda: _evaluation(wide)(POINTS[0])
    calls["bands"]()
    times = interleave(calls, 2 if quick else 5, atleast=0.2)
    # As it comes, it takes minutes and is not done: once at each point is enough.
    usual = furax.conjugate_gradients(furax_peer.USUAL, max_steps=500)
    spent: list[float] = []

    def timed(theta):
        result = []
        spent.append(seconds(lambda: result.append(usual(theta))))
        return result[0]

    usual_errors = _errors(timed, ours)
    ratio = times.ratio("plain", "bands")
    row = Row(
        f"the same, nside {nside}, noise of its own in each pixel and band",
        f"{ratio:.0f}x",
        ">= 20x",
        ratio >= 20,
        f"{time_text(times['plain'])} (FURAX's function, converged to 1e-6 in {steps['plain']} "
        f"steps, with references at 220 and 80 GHz, where these are fewest; {errors['plain']}) / "
        f"{time_text(times['bands'])} (51 samples; monochromatic {time_text(times['lines'])}, "
        f"{times.ratio('plain', 'lines'):.0f}x); FURAX as in its own benchmarks, at 150 and "
        f"20 GHz, stopped after 500 steps, {median(spent) / times['bands']:.0f}x "
        f"({time_text(median(spent))}; {usual_errors}); with a block preconditioner of ours, at "
        f"most {steps['preconditioned']} steps, {times.ratio('preconditioned', 'bands'):.0f}x "
        f"({time_text(times['preconditioned'])}; {errors['preconditioned']}); its operators with "
        f"systems solved directly by us {times.ratio('direct', 'bands'):.0f}x "
        f"({time_text(times['direct'])}; {errors['direct']})",
    )
    return [row, _growth((8, 16) if quick else (32, 64, 128, 256))]


def _growth(nsides: tuple[int, ...]) -> Row:
    """jaxsky alone, against the number of pixels."""
    times = {}
    for nside in nsides:
        rng = np.random.default_rng(5)
        bands, sigma = litebird(nside)
        maps = maps_in_memory(nside)
        noise = sigma[:, None, None] * rng.uniform(*SPREAD, maps.shape)
        like = spectral_likelihood(white_sky(1, rng), bands, maps, noise, START, unit=UNIT)
        del maps, noise
        evaluation = _evaluation(like)
        evaluation(POINTS[0])
        call = {nside: lambda evaluation=evaluation: evaluation(POINTS[0])}
        times[nside] = interleave(call, 5, atleast=0.3)[nside]
    pixel = {nside: time / (12 * nside**2) for nside, time in times.items()}
    low, high = min(pixel.values()), max(pixel.values())
    power = np.log(times[nsides[-1]] / times[nsides[0]]) / np.log(nsides[-1] / nsides[0]) / 2
    return Row(
        f"the same, jaxsky, nside {nsides[0]} to {nsides[-1]}: time a pixel",
        f"{low * 1e9:.0f} to {high * 1e9:.0f} ns",
        "linear",
        power < 1.1,
        ", ".join(f"{n}: {time_text(t)} ({pixel[n] * 1e9:.0f} ns)" for n, t in times.items())
        + f"; pixels^{power:.2f}",
    )


def _cold(name: str, nside: int, again: int = 0) -> tuple[Usage, dict]:
    """A run in a process of its own, and what it wrote."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "times.json"
        line = [sys.executable, "-m", "benchmarks.separation_runs", name, str(nside), str(out)]
        run = usage([*line, "--again", str(again)])
        return run, json.loads(out.read_text())


def whole_fit(quick: bool) -> list[Row]:
    """Maps of nside 512 to three numbers and their errors."""
    nside = 64 if quick else 512
    runs = [_cold("constant", nside, again=2) for _ in range(1 if quick else 3)]
    first = median(found["first"] for _, found in runs)
    again = median(time for _, found in runs for time in found["again"])
    peak = median(run.peak for run, _ in runs)
    maps = 15 * 2 * 12 * nside**2 * 8 / 2**30
    found = runs[0][1]
    work = f"separation, constant parameters, nside {nside}, 15 bands, Q, U"
    return [
        Row(
            f"{work}: maps in memory to best fit and errors, first call in a process",
            time_text(first),
            "< 3 s",
            first < 3,
            f"runs {', '.join(time_text(found['first']) for _, found in runs)}, compilation "
            f"included; again {time_text(again)}; {found['steps']} Newton steps; largest "
            f"deviation from the truth {found['deviation']:.1f} sigma",
        ),
        Row(
            "the same: peak memory of the process",
            f"{peak:.2f} GiB, {peak / maps:.2f}x the maps",
            "< 2x",
            peak < 2 * maps,
            f"maps {maps:.2f} GiB in double precision, included",
        ),
    ]


def regions(quick: bool) -> list[Row]:
    """Superpixels on a real sky, first call in a process."""
    work = (
        "separation, superpixels of nside 4 for beta_dust and T_dust, 2 for beta_syn, nside 64, "
        "first call in a process"
    )
    if not TEMPLATES.is_dir():
        return [Row(work, "not run", remarks=f"no sky data at {TEMPLATES}")]
    runs = [_cold("regions", 64, again=2)[1] for _ in range(1 if quick else 3)]
    first = median(found["first"] for found in runs)
    again = median(time for found in runs for time in found["again"])
    return [
        Row(
            work,
            time_text(first),
            "< 10 s",
            first < 10,
            f"runs {', '.join(time_text(found['first']) for found in runs)}; again "
            f"{time_text(again)}; {runs[0]['parameters']} parameters, {runs[0]['steps']} Newton "
            "steps; dust and synchrotron of PySM's d1 and s1, whose indices vary from pixel to "
            "pixel, full sky",
        )
    ]


def simulations(quick: bool) -> list[Row]:
    """Simulations of the constant-parameter fit."""
    nside = 16 if quick else 64
    _, found = _cold("simulations", nside)
    scatter = ", ".join(f"{s:.2f}" for s in found["scatter"])
    return [
        Row(
            f"separation, {found['count']} simulations at nside {nside}, fit of three parameters",
            time_text(found["first"]),
            "< 60 s",
            found["first"] < 60 * found["count"] / SIMULATIONS,
            "in each: noise drawn in all pixels and bands and added to the sky, the pass over the "
            f"maps, {found['steps']:.0f} Newton steps from afar, errors; compilation included; "
            f"scatter over claimed sigma {scatter} (T_dust, beta_dust, beta_syn)",
        )
    ]


def samples(quick: bool) -> list[Row]:
    """Effective samples a second of both samplers, three parameters."""
    nside, nsteps = (16, 300) if quick else (64, 1000)
    bands, sigma = litebird(nside)
    laws = white_sky(1, np.random.default_rng(0))
    like = spectral_likelihood(laws, bands, maps_in_memory(nside), sigma, TRUTH, unit=UNIT)
    runs = {"nuts": {"nsteps": nsteps}, "emcee": {"nsteps": 5 * nsteps}}
    rates, texts = {}, []
    for sampler, options in runs.items():
        results = []

        def call(sampler=sampler, options=options, results=results):
            options = {"priors": PRIORS, "sampler": sampler, "progress": False, **options}
            results.append(sample(like, throw=False, **options))

        first = seconds(call)
        time = median(seconds(call) for _ in range(1 if quick else 3))
        details = results[-1].details
        if sampler == "nuts":
            effective = min(details["ess"].values())
            work = f"4 chains of 500 + {nsteps} steps"
        else:
            walkers = details["chain"].shape[1]
            longest = max(details["tau"][name] for name in NAMES)
            effective = (5 * nsteps - details["discard"]) * walkers / longest
            work = f"{walkers} walkers x {5 * nsteps} steps, tau {longest:.0f}"
        rates[sampler] = effective / time
        texts.append(
            f"{sampler}: {work}, {effective:.0f} effective samples in {time_text(time)}, first "
            f"call {time_text(first)}"
        )
    return [
        Row(
            f"separation, posterior of three parameters, nside {nside}, one noise a band: "
            "effective samples a second, NUTS and emcee",
            " and ".join(f"{rates[sampler]:.0f}" for sampler in runs),
            remarks="; ".join(texts) + "; warm-up included, worst parameter",
        )
    ]
