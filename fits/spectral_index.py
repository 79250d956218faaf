"""The paper's spectral-index test: templates scaled to other bands and fitted to maps there.

Templates and data are brought to a common resolution; the parameters are then fitted in each
region, to Q, to U and to both, on a grid, by gradient and by MCMC.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.stats
from jaxtyping import Bool

from fits.common import CommonMaps
from fits.distributed import carry_weight
from fits.grid import grid_fit
from fits.inputs import Inputs
from fits.kept import KeptChain, fingerprint
from fits.mixing import nominal
from fits.optimize import best_fit
from fits.posterior import Prior, Uniform, chi2, priors_of
from fits.results import FitResult
from fits.sampling import sample
from fits.template_likelihood import SkyLikelihood, TemplateLikelihood
from jaxsky import observe_components, parameter_names, set_parameters
from jaxsky.io.stacks import ranges
from jaxsky.job import by_turns
from jaxsky.programs import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key

#: A fit on which its own errors depend is repeated until it moves by less than this [sigma].
SETTLED = 0.01


class RegionFit(NamedTuple):
    """The fits of one region and choice of Stokes parameters, by method.

    `chi2` is the paper's sum over pixels at the best fit of each method, with `dof` degrees of
    freedom; `chi2_amplitudes` and `dof_amplitudes` are those of the exact likelihood, which
    compares only the amplitudes of the templates. Bands without weight (`weightless`) are not
    counted in either. `noise_shares` is the fraction of the weighted power of each template that
    is noise, if any, and `corrected` is True if the fits allow for it.
    """

    region: str
    stokes: str
    results: dict[str, FitResult]
    chi2: dict[str, float]
    dof: int
    dof_amplitudes: int | None
    weightless: tuple[str, ...] = ()
    noise_shares: Mapping[str, float] = MappingProxyType({})
    corrected: bool = True

    def probability_to_exceed(self, method: str) -> float | None:
        """Return the probability of a larger chi^2 of amplitudes; None if diagonal."""
        if not self.dof_amplitudes:
            return None
        return float(scipy.stats.chi2.sf(self.results[method].chi2, self.dof_amplitudes))


def all_free(fits: Sequence[RegionFit]) -> tuple[str, ...]:
    """Return names of the parameters that are free in any of the fits."""
    return tuple(sorted({name for f in fits for r in f.results.values() for name in r.free}))


def known_truth(inputs: Inputs, fits: Sequence[RegionFit]) -> dict[str, float] | None:
    """Return the true values of the free parameters, if they are known."""
    if inputs.truth is None:
        return None
    free = all_free(fits)
    truth = inputs.truth | nominal(free)  # simulated bands have nominal parameters
    return {name: truth[name] for name in free if name in truth}


def settled(
    make: Callable[[Mapping[str, float]], SkyLikelihood],
    start: Mapping[str, float],
    priors: Mapping[str, Prior],
) -> SkyLikelihood:
    """Return the likelihood whose covariance is that at its own best fit.

    `make` returns the likelihood with the covariance at given parameters. Its weights are then
    fixed, so that its best fit is unbiased.
    """
    like, values = make(start), dict(start)
    if not isinstance(like, TemplateLikelihood):
        return like  # likelihoods on pixels ignore the noise of templates
    for _ in range(5):
        found = best_fit(like, start, priors=priors, throw=False)
        moved = [
            abs(found.best_fit[n] - values[n]) / s for n, s in found.sigma.items() if np.isfinite(s)
        ]
        values = dict(found.best_fit)
        if not found.converged or max(moved, default=0.0) < SETTLED:
            break
        like = make(values)
    return like


def _fit_pixels(settings, prepared, used, region, stokes, out, mark, progress):
    """Fit one region and choice of Stokes parameters; `mark` stands for the maps of chains."""
    # An offset of a Stokes parameter that is not fitted has no effect.
    start = {
        name: value
        for name, value in settings.start("fit").items()
        if not name.startswith("offset.") or name[-1] in stokes
    }
    priors = {name: prior for name, prior in priors_of(settings, "fit").items() if name in start}
    spec, errors = settings.fit, prepared.template_errors
    progress.step(f"{region}, {stokes}: inner products")
    with at_key("free"):
        plain = prepared._replace(template_errors=None)
        like = diagonal = plain.likelihood(start, stokes=stokes, region=used, kind="diagonal")
        if spec.likelihood == "exact" or errors is not None:
            make = partial(prepared.likelihood, stokes=stokes, region=used, kind=spec.likelihood)
            like = make(start) if errors is None else settled(make, start, priors)
    nothing, expected, shares = _look(prepared, start, used, stokes)
    number, dof_amplitudes = len(prepared.bands) - len(nothing), None
    if spec.likelihood == "exact":
        values = like.residuals(start).size * number / len(prepared.bands)
        dof_amplitudes = round(values) - len(start)
    results: dict[str, FitResult] = {}
    for method in spec.methods:
        progress.step(f"{region}, {stokes}: {method}")
        if method == "grid":
            if len(start) <= 2 and all(isinstance(priors.get(n), Uniform) for n in start):
                results[method] = grid_fit(like, start, priors=priors, points=spec.points)
        elif method == "gradient":
            results[method] = best_fit(like, start, priors=priors, throw=False)
        else:
            chain = None
            if out is not None:
                said = spec.likelihood, settings.free, settings.seed
                own = f"{mark} {fingerprint(used)} {stokes} {said}"
                chain = KeptChain(out / f"chain_{region}_{stokes}.npz", own)
            results[method] = sample(
                like,
                start,
                priors=priors,
                nsteps=spec.nsteps,
                seed=settings.seed,
                backend=chain,
                progress=progress.advance,
                throw=False,
            )
    if not results:
        raise SettingsError(
            "fit.methods: a grid alone takes one or two free parameters with uniform priors."
        )
    chi2s = {method: float(chi2(diagonal, r.best_fit)) for method, r in results.items()}
    dof = int(used.sum()) * number * len(stokes) - len(start)
    results = {m: r.judged(chi2s[m], dof, start, expected) for m, r in results.items()}
    known = nothing, shares, isinstance(like, TemplateLikelihood)
    return RegionFit(region, stokes, results, chi2s, dof, dof_amplitudes, *known)


def _look(
    prepared: CommonMaps, params: Mapping[str, float], used: Bool[np.ndarray, " pix"], stokes: str
) -> tuple[tuple[str, ...], float, dict[str, float]]:
    """Look at the signal and the noise of all bands in one pass over the pixels.

    Return the bands that carry no weight for any template, compared with the others; the mean
    square of noise and CMB over that of noise, which alone chi^2 counts; and the fraction of the
    weighted power of each template that is noise, if any is known.
    """
    errors, sky = prepared.template_errors, prepared.sky
    assert sky is not None  # there are templates
    bands, keep = list(prepared.bands.values()), np.array(["QU".index(s) for s in stokes])
    known = parameter_names(sky)
    moved = set_parameters(sky, {name: v for name, v in params.items() if name in known})

    def of_part(part: slice) -> tuple[np.ndarray, ...]:
        """Return sums over some pixels: of weights, and of weighted squares of maps."""

        def own(maps: Any) -> Any:
            return maps if np.shape(maps)[-1:] in ((), (1,)) else maps[..., part]

        inside = used[part]
        weights = np.where(inside, 1 / np.asarray(own(prepared.sigma))[:, keep] ** 2, 0.0)
        seen = observe_components(jax.tree.map(own, moved), bands)
        maps = np.where(inside, np.stack([m[:, keep] for m in seen.values()]), 0.0)
        sums = weights.sum(axis=-1), np.einsum("bsp,kbsp,kbsp->kb", weights, maps, maps)
        if errors is None:
            return sums
        templates = np.stack([own(c.amplitude)[keep] for c in sky.components.values()])
        templates = np.where(inside, templates, 0.0)
        variance = np.asarray(own(errors.variance))[:, keep]
        return (
            *sums,
            np.einsum("bsp,ksp,ksp->k", weights, templates, templates),
            np.einsum("bsp,usp,ku->k", weights, variance, errors.parts**2),
        )

    parts = zip(*by_turns(of_part, list(ranges(used.size))), strict=True)
    weight, power, *squares = (np.sum(part, axis=0) for part in parts)
    heavy = carry_weight(power.T)
    weightless = tuple(n for n, some in zip(prepared.bands, heavy, strict=True) if not some)
    cmb = prepared.fluctuations.cmb_power().sum(axis=1)
    # Q and U each have half the variance of E and B.
    variance = cmb @ (2 * np.arange(cmb.shape[-1]) + 1) / (8 * np.pi)
    ratio = variance[:, None] * weight / used.sum()
    shares = (squares[1] / squares[0]).tolist() if squares else []
    return weightless, 1.0 + float(ratio[heavy].mean()), dict(zip(sky, shares, strict=False))


def fit_regions(
    settings: Experiment,
    prepared: CommonMaps,
    regions: dict[str, Bool[np.ndarray, " pix"]],
    out: Path | None = None,
    progress: Progress = QUIET,
) -> list[RegionFit]:
    """Make all fits of the settings, in each region.

    `out` is a folder for the chains; steps that it already contains are not made again.
    """
    if not settings.free_in("fit"):
        raise SettingsError("free: name at least one parameter to fit.")
    used = {region: inside & prepared.used for region, inside in regions.items()}
    for region, pixels in used.items():
        if not pixels.any():
            raise SettingsError(f"fit.regions: region {region!r} leaves no pixel.")
    # Not that of a likelihood, whose sums depend on how many processes share the pixels.
    mark = fingerprint(prepared) if out is not None and "mcmc" in settings.fit.methods else ""
    return [
        _fit_pixels(settings, prepared, pixels, region, stokes, out, mark, progress)
        for region, pixels in used.items()
        for stokes in settings.fit.stokes
    ]
