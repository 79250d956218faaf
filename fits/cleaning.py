"""A component separation, from data to the cleaned CMB and the tensor-to-scalar ratio."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fits.kept import fingerprint, kept_chain, kept_realisations
from fits.noise_response import Realisation, Response, SimulatedNoise, widened
from fits.optimize import best_fit
from fits.priors import priors_of
from fits.profile_likelihood import SpectralLikelihood
from fits.pseudo_cl import LEAST_WINDOW, MaskedSpectra, band_powers, bin_edges, masked_spectra
from fits.results import FitResult, misfit
from fits.sampling import sample
from fits.separated_data import FullSkyData, PixelData
from fits.tensor_ratio import TensorFit, fit_tensors, power_model
from jaxsky.checks import check_double
from jaxsky.cmb import tensor_spectra
from jaxsky.experiment import cmb_spectra
from jaxsky.harmonics import gaussian_beam
from jaxsky.progress import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key

#: Walkers of emcee, if they are enough.
WALKERS = 32
#: The posterior of more parameters is not sampled.
SAMPLED = 500


class Separation(NamedTuple):
    """What a separation finds; spectra are of the cleaned CMB [uK_CMB^2].

    `fit` has the most probable spectral parameters with the errors that the likelihood gives. It
    takes smoothed noise as independent between pixels, and multipoles of a masked sky as
    independent, so `sigma`, by name, and `covariance`, in the order of `fit.labels` and None for
    too many parameters, are those of the simulations, but for multipoles of the full sky. `found`
    are the components with all that is known of them, and `maps` they at one beam. `residuals` are
    maps of the data less components, and `left` the band powers of the foregrounds that are left
    in the CMB, None where they are not known.
    """

    data: PixelData | FullSkyData
    like: SpectralLikelihood
    fit: FitResult
    sigma: dict[str, Any]
    covariance: Float[np.ndarray, "par par"] | None
    found: Any
    maps: Float[np.ndarray, "component stokes pix"]
    residuals: Float[np.ndarray, "band stokes pix"]
    simulated: SimulatedNoise
    spectra: MaskedSpectra
    tensors: TensorFit
    left: Float[np.ndarray, " bin"] | None
    chain: FitResult | None

    @property
    def components(self) -> tuple[str, ...]:
        """Their names, in order."""
        return tuple(self.like.mixing.sky)

    @property
    def degradation(self) -> float:
        """Mean noise of the CMB over that of a sky without foregrounds."""
        return float(np.nanmean(self.found.degradation("cmb")))

    def of_pixel(self, name: str, values: Mapping[str, Any]) -> Float[np.ndarray, " pix"]:
        """The map of a parameter with regions, from its values; NaN where masked."""
        assert isinstance(self.data, PixelData)  # the one with regions
        labels = self.data.labels[name]
        return np.where(self.data.used, np.asarray(values[name])[labels], np.nan)


def separate_data(
    settings: Experiment,
    data: PixelData | FullSkyData,
    out: Path | None = None,
    progress: Progress = QUIET,
) -> Separation:
    """Fit the laws, separate the components, and measure r.

    Parameters
    ----------
    settings : how
    data : what is separated, from `fits.separated_data.separation_data`
    out : folder that keeps simulations and chains; what it holds is not made again
    progress : told of each step of the work
    """
    check_double("A separation")
    spec, priors = settings.separate, priors_of(settings, "separate")
    progress.step("spectral parameters")
    with at_key("free"):
        like = data.likelihood(data.observed)
    fit = best_fit(like, priors=priors, throw=False)
    # What no law describes is separated nevertheless, and said.
    fit.checked(throw=fit.message != misfit(fit.chi2, fit.dof))
    response = Response(like, fit.best_fit, priors)
    progress.step("components")
    best = like.named(jnp.asarray(response.theta))
    found = data.components(like, best, data.observed)
    maps = data.maps(found, like, best, data.observed)
    amplitude = maps if data.in_pixels else found.amplitude
    row = found.components.index("cmb")

    progress.step("simulations")
    window, spectra = _spectra(settings, data.mask)
    highest = window.size - 1
    with at_key("cmb.cosmology"):
        tensors = tensor_spectra(highest, **settings.cmb.cosmology)
    # Simulated and modelled, lensing is what the settings say.
    lensed = cmb_spectra(settings, highest, r=0.0)
    foregrounds = np.array(amplitude)
    foregrounds[row] = 0.0
    emission = data.emission(like, best, foregrounds)
    simulation = Realisation(data, like, best, response, emission, spectra, window, lensed)
    made = kept_realisations(
        simulation.of,
        SimulatedNoise._fields,
        spec.nsims,
        settings.seed,
        None if out is None else out / "simulations.npz",
        _mark(settings, data),
        progress.advance,
    )
    simulated = SimulatedNoise(*made)
    progress.step("tensor-to-scalar ratio")
    # What the spectra know of E in B is part of the model.
    EE = lensed[1, : spectra.lmax + 1]
    leaked = simulated.leaked.mean(axis=0) - spectra.windows[1, :, 0] @ EE
    model = power_model(
        spectra,
        window,
        lensed,
        tensors,
        simulated.both.mean(axis=0) + leaked,
        simulated.spectrum.mean(axis=0),
        simulated=simulated.total,
    )
    left = None
    if data.foregrounds is not None:
        alone = simulation.cleaned(best, data.foregrounds)
        left = band_powers(spectra, jnp.asarray(alone))[1]
    sigma, covariance = _errors(data, like, fit, simulated)
    chain = None
    ratio = fit_tensors(model, band_powers(spectra, maps[row])[1])
    if spec.sampler != "none" and len(fit.labels) <= SAMPLED:
        progress.step("posterior")
        chain = _chain(settings, data, like, fit, simulated, out, progress)
    return Separation(
        data=data,
        like=like,
        fit=fit,
        sigma=sigma,
        covariance=covariance,
        found=found,
        maps=maps,
        residuals=data.residuals(like, best, amplitude),
        simulated=simulated,
        spectra=spectra,
        tensors=ratio,
        left=left,
        chain=chain,
    )


def _spectra(
    settings: Experiment, mask: np.ndarray
) -> tuple[Float[np.ndarray, " ell"], MaskedSpectra]:
    """The beam of the maps, and how their spectra are taken."""
    how, nside, fwhm = settings.separate, settings.common.nside, settings.common.fwhm
    highest = 2 * nside
    window = np.asarray(gaussian_beam(fwhm, highest))
    reach = int(np.flatnonzero(window > LEAST_WINDOW).max())
    # Bins next to the last multipole are needed for what the mask mixes into those below.
    lmax = min(reach, highest - how.width) if how.lmax is None else how.lmax
    if lmax > min(reach, highest - 1):
        raise SettingsError(
            f"separate.lmax: {lmax} is beyond what nside {nside} and a beam of {fwhm:g} arcmin "
            f"resolve, {min(reach, highest - 1)}."
        )
    if how.lmin + how.width > lmax:
        raise SettingsError(
            f"separate: no bin of {how.width} multipoles fits between lmin, {how.lmin}, and {lmax}."
        )
    pure = how.purify and not np.all(mask == 1)
    edges = bin_edges(how.lmin, lmax, how.width)
    return window, masked_spectra(mask, edges, window=window, pure=pure)


def _mark(settings: Experiment, data: PixelData | FullSkyData) -> str:
    """What the simulations depend on."""
    left_out = {"separate": {"nsims", "sampler", "nsteps"}}
    said = settings.model_dump_json(exclude=left_out)
    return f"{fingerprint((data.observed, data.mask))} {said}"


def _errors(data, like, fit, simulated):
    """Standard deviations by name, and the covariance."""
    if data.exact:
        return fit.sigma, fit.covariance
    sigma = simulated.theta.std(axis=0, ddof=1)
    determined = np.isfinite(np.asarray(like.flat(fit.best_fit))) & (sigma > 0)
    named = like.named(np.where(determined, sigma, np.nan))
    sizes = {n: float(v) if v.ndim == 0 else np.asarray(v) for n, v in named.items()}
    if fit.covariance is None:
        return sizes, None
    covariance = np.atleast_2d(np.cov(simulated.theta.T))
    return sizes, np.where(determined & determined[:, None], covariance, np.nan)


def _chain(settings, data, like, fit, simulated, out, progress):
    """Samples of the posterior; with the errors of the simulations if it is not exact."""
    spec = settings.separate
    size = int(np.isfinite(np.asarray(like.flat(fit.best_fit))).sum())
    nwalkers = max(WALKERS, 2 * size + 2)
    backend = None
    if spec.sampler == "emcee" and out is not None:
        backend = kept_chain(out / "chain.h5", "mcmc", (nwalkers, size), _mark(settings, data))
    samples = sample(
        like,
        fit.best_fit,
        priors=priors_of(settings, "separate"),
        sampler=spec.sampler,
        nsteps=spec.nsteps,
        nwalkers=nwalkers if spec.sampler == "emcee" else None,
        seed=settings.seed,
        backend=backend,
        progress=progress.advance,
        throw=False,
    )
    if data.exact or not samples.details:
        return samples
    at = [fit.labels.index(label) for label in samples.labels]
    center = np.asarray(like.flat(fit.best_fit))[at]
    return widened(samples, center, fit.details["hessian"][np.ix_(at, at)], simulated.theta[:, at])
