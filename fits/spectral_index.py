"""The paper's spectral-index test: templates scaled to other bands and fitted to maps there.

Templates and data are brought to a common resolution; the parameters are then fitted in each
region, to Q, to U and to both, on a grid, by gradient and by MCMC.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Bool

from fits.common import CommonMaps
from fits.grid import grid_fit
from fits.inputs import Inputs
from fits.kept import KeptChain, fingerprint
from fits.mixing import nominal
from fits.optimize import best_fit
from fits.posterior import chi2
from fits.priors import Prior, Uniform, priors_of
from fits.results import FitResult
from fits.sampling import sample
from fits.template_likelihood import SkyLikelihood, TemplateLikelihood
from jaxsky import observe_components, parameter_names, set_parameters
from jaxsky.programs import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key

#: A band with less than this fraction of the weight of every template counts as weightless.
WEIGHTLESS = 1e-6
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
    # Simulated bands have nominal parameters.
    truth = inputs.truth | nominal(free)
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


def _fit_pixels(
    settings: Experiment,
    prepared: CommonMaps,
    used: Bool[np.ndarray, " pix"],
    region: str,
    stokes: str,
    out: Path | None,
    mark: str,
    progress: Progress,
) -> RegionFit:
    """Fit one region and choice of Stokes parameters; see `fit_regions`.

    `mark` stands for the maps, of which chains in `out` are.
    """
    # An offset of a Stokes parameter that is not fitted has no effect.
    start = {
        name: value
        for name, value in settings.start("fit").items()
        if not name.startswith("offset.") or name[-1] in stokes
    }
    priors = {name: prior for name, prior in priors_of(settings, "fit").items() if name in start}
    progress.step(f"{region}, {stokes}: inner products")
    with at_key("free"):
        plain = prepared._replace(template_errors=None)
        diagonal = plain.likelihood(start, stokes=stokes, region=used, kind="diagonal")
        like, dof_amplitudes = diagonal, None
        exact = settings.fit.likelihood == "exact"
        if exact or prepared.template_errors is not None:
            kind = settings.fit.likelihood
            make = partial(prepared.likelihood, stokes=stokes, region=used, kind=kind)
            like = make(start) if prepared.template_errors is None else settled(make, start, priors)
    nothing = weightless(prepared, start, used, stokes)
    number = len(prepared.bands) - len(nothing)
    if exact:
        values = like.residuals(start).size * number / len(prepared.bands)
        dof_amplitudes = round(values) - len(start)
    results: dict[str, FitResult] = {}
    for method in settings.fit.methods:
        progress.step(f"{region}, {stokes}: {method}")
        if method == "grid":
            if len(start) <= 2 and all(isinstance(priors.get(n), Uniform) for n in start):
                results[method] = grid_fit(like, start, priors=priors, points=settings.fit.points)
        elif method == "gradient":
            results[method] = best_fit(like, start, priors=priors, throw=False)
        else:
            chain = None
            if out is not None:
                said = settings.fit.likelihood, settings.free, settings.seed
                own = f"{mark} {fingerprint(used)} {stokes} {said}"
                chain = KeptChain(out / f"chain_{region}_{stokes}.npz", own)
            results[method] = sample(
                like,
                start,
                priors=priors,
                nsteps=settings.fit.nsteps,
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
    expected = _expected(prepared, used, stokes, nothing)
    results = {
        method: r.judged(chi2s[method], dof, start, expected) for method, r in results.items()
    }
    noisy = prepared.template_errors is not None
    shares = _noise_shares(prepared, used, stokes) if noisy else {}
    known = nothing, shares, isinstance(like, TemplateLikelihood)
    return RegionFit(region, stokes, results, chi2s, dof, dof_amplitudes, *known)


def _noise_shares(
    prepared: CommonMaps, used: Bool[np.ndarray, " pix"], stokes: str
) -> dict[str, float]:
    """Return the fraction of the weighted power of each template that is noise."""
    errors = prepared.template_errors
    assert prepared.sky is not None
    assert errors is not None  # checked by the caller
    keep = np.array([s in stokes for s in "QU"])
    inside = used & np.isfinite(prepared.sigma) & keep[:, None]
    weights = np.where(inside, 1 / np.asarray(prepared.sigma) ** 2, 0.0)
    templates = np.stack([c.amplitude for c in prepared.sky.components.values()])
    templates = np.where(prepared.used, templates, 0.0)
    noise = np.einsum("bsp,usp,ku->k", weights, errors.variance, errors.parts**2)
    shares = noise / np.einsum("bsp,ksp,ksp->k", weights, templates, templates)
    return dict(zip(prepared.sky, shares.tolist(), strict=True))


def _expected(
    prepared: CommonMaps, used: Bool[np.ndarray, " pix"], stokes: str, left_out: Sequence[str]
) -> float:
    """Return the mean square of noise and CMB over that of noise, which alone chi^2 counts."""
    power = prepared.fluctuations.cmb_power().sum(axis=1)
    ell = np.arange(power.shape[-1])
    # Q and U each have half the variance of E and B.
    variance = power @ (2 * ell + 1) / (8 * np.pi)
    keep = np.array(["QU".index(s) for s in stokes])
    ratio = variance[:, None, None] / np.asarray(prepared.sigma)[:, keep][..., used] ** 2
    counted = [name not in left_out for name in prepared.bands]
    return 1.0 + float(ratio[counted].mean())


def weightless(
    prepared: CommonMaps,
    params: Mapping[str, float],
    used: Bool[np.ndarray, " pix"],
    stokes: str,
) -> tuple[str, ...]:
    """Return bands that carry no weight for any template, compared with the other bands."""
    assert prepared.sky is not None  # there are templates
    known = parameter_names(prepared.sky)
    values = {name: value for name, value in params.items() if name in known}
    sky = set_parameters(prepared.sky, values)
    seen = observe_components(sky, list(prepared.bands.values()))
    keep = np.array(["QU".index(s) for s in stokes])
    power = np.stack(
        [
            np.sum(np.where(used, maps / prepared.sigma, 0.0)[:, keep] ** 2, axis=(1, 2))
            for maps in seen.values()
        ]
    )
    total = power.sum(axis=1, keepdims=True)
    share = np.max(power / np.where(total > 0, total, 1.0), axis=0)
    return tuple(n for n, part in zip(prepared.bands, share, strict=True) if part < WEIGHTLESS)


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
