"""The paper's spectral-index test: templates scaled to other bands, compared with maps there.

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
from fits.grid import grid_fit, grid_is_possible
from fits.inputs import Inputs
from fits.kept import KeptChain, fingerprint
from fits.mixing import nominal
from fits.optimize import best_fit
from fits.posterior import chi2
from fits.priors import Prior, priors_of
from fits.results import FitResult
from fits.sampling import sample
from fits.template_likelihood import SkyLikelihood, TemplateLikelihood
from jaxsky import observe_components, parameter_names, set_parameters
from jaxsky.programs import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key

#: A band in which each template has less than this part of its weight has none.
WEIGHTLESS = 1e-6

#: A fit whose coefficients change its own errors is repeated until it moves by less [sigma].
SETTLED = 0.01


class RegionFit(NamedTuple):
    """The fits of one region and choice of Stokes parameters, by method.

    `chi2` is the paper's sum over pixels at the best fit of each method, with `dof` degrees of
    freedom; `chi2_amplitudes` and `dof_amplitudes` are those of the exact likelihood, which
    compares the amplitudes of the templates only. Bands without weight (`weightless`) are not
    counted in either. `noise_shares`
    says which part of the weighted power of each template is noise, where there is any, and
    `corrected` whether the fits know of it.
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
        """Probability of a larger chi^2 of the amplitudes; None for the diagonal likelihood."""
        if not self.dof_amplitudes:
            return None
        return float(scipy.stats.chi2.sf(self.results[method].chi2, self.dof_amplitudes))


def all_free(fits: Sequence[RegionFit]) -> tuple[str, ...]:
    """Names of the parameters that are free in any of the fits."""
    return tuple(sorted({name for f in fits for r in f.results.values() for name in r.free}))


def known_truth(inputs: Inputs, fits: Sequence[RegionFit]) -> dict[str, float] | None:
    """The truth about the free parameters, if there is one."""
    if inputs.truth is None:
        return None
    free = all_free(fits)
    # Bands are simulated as they are described.
    truth = inputs.truth | nominal(free)
    return {name: truth[name] for name in free if name in truth}


def settled(
    make: Callable[[Mapping[str, float]], SkyLikelihood],
    start: Mapping[str, float],
    priors: Mapping[str, Prior],
) -> SkyLikelihood:
    """The likelihood whose covariance is that at its own best fit.

    `make` gives the likelihood with the covariance at given parameters. Within one the weights
    are fixed, so that its best fit is unbiased.
    """
    like, values = make(start), dict(start)
    if not isinstance(like, TemplateLikelihood):
        return like  # those of pixels do not know of the noise
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
    out: Path | None = None,
    progress: Progress = QUIET,
) -> RegionFit:
    """The fits of one region and choice of Stokes parameters; see `fit_regions`."""
    # An offset of a Stokes parameter that is not looked at has no effect.
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
    weighty = 1 - len(nothing) / len(prepared.bands)
    if exact:
        dof_amplitudes = round(like.residuals(start).size * weighty) - len(start)
    results: dict[str, FitResult] = {}
    for method in settings.fit.methods:
        progress.step(f"{region}, {stokes}: {method}")
        if method == "grid":
            if grid_is_possible(start, priors):
                results[method] = grid_fit(like, start, priors=priors, points=settings.fit.points)
        elif method == "gradient":
            results[method] = best_fit(like, start, priors=priors, throw=False)
        else:
            chain = None
            if out is not None:
                size = settings.fit.nwalkers, len(start)
                mark = f"{fingerprint(like)} {settings.free} {settings.seed} {size}"
                chain = KeptChain(out / f"chain_{region}_{stokes}.npz", mark)
            results[method] = sample(
                like,
                start,
                priors=priors,
                nwalkers=settings.fit.nwalkers,
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
    values = {method: float(chi2(diagonal, r.best_fit)) for method, r in results.items()}
    number = len(prepared.bands) - len(nothing)
    dof = int(used.sum()) * number * len(stokes) - len(start)
    expected = _expected(prepared, used, stokes, nothing)
    results = {
        method: r.judged(values[method], dof, start, expected) for method, r in results.items()
    }
    shares: dict[str, float] = {}
    if prepared.template_errors is not None:
        shares = prepared.noise_shares(used, stokes)
    corrected = isinstance(like, TemplateLikelihood)
    return RegionFit(
        region, stokes, results, values, dof, dof_amplitudes, nothing, shares, corrected
    )


def _expected(
    prepared: CommonMaps, used: Bool[np.ndarray, " pix"], stokes: str, left_out: Sequence[str]
) -> float:
    """Mean square of noise and CMB in a pixel over that of the noise, which chi^2 counts alone."""
    power = prepared.fluctuations.cmb_power().sum(axis=1)
    ell = np.arange(power.shape[-1])
    # Q and U have half of E and B each.
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
    """Bands in which no template is seen with any weight, compared with the other bands."""
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
    """All fits that the settings ask for, in each region.

    `out` is a folder that keeps the chains; steps that it already holds are not made again.
    """
    if not settings.free_in("fit"):
        raise SettingsError("free: name at least one parameter to fit.")
    used = {region: inside & prepared.used for region, inside in regions.items()}
    for region, pixels in used.items():
        if not pixels.any():
            raise SettingsError(f"fit.regions: region {region!r} leaves no pixel.")
    return [
        _fit_pixels(settings, prepared, pixels, region, stokes, out, progress)
        for region, pixels in used.items()
        for stokes in settings.fit.stokes
    ]
