"""Separate components: from data to the cleaned CMB and the tensor-to-scalar ratio.

Smoothed noise is correlated between pixels, which the spectral likelihood ignores. So errors are
taken from simulations: the foregrounds that were found, with new noise. To first order
the parameters move by -H^-1 times the gradient of -ln L; the components are then separated with
those parameters, so that residual foregrounds appear with the noise that caused them.
"""

import dataclasses
import threading
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits import pseudo_cl
from fits.kept import KeptChain, fingerprint, kept_realisations
from fits.optimize import best_fit
from fits.posterior import Gaussian, Likelihood, Posterior, Prior, priors_of, value_and_gradient
from fits.profile_likelihood import SpectralLikelihood
from fits.results import Convergence, FitResult, widened
from fits.sampling import sample
from fits.separated_data import FullSkyData, PixelData
from fits.systems import Factor
from fits.tensor_ratio import TensorFit, fit_tensors, power_model
from jaxsky import job
from jaxsky.checks import Numeric, check_double
from jaxsky.cmb import realisation, tensor_spectra
from jaxsky.experiment import cmb_spectra
from jaxsky.harmonics import expand, gaussian_beam, needed_lmax, resize, synthesis
from jaxsky.io.stacks import Stack, computed, stored
from jaxsky.mesh import spread
from jaxsky.noise import stream
from jaxsky.programs import QUIET, Progress
from jaxsky.settings import Experiment, SettingsError, at_key

#: Most parameters whose posterior is sampled.
SAMPLED = 500
#: Held while a simulation of large maps is made.
ONE = threading.Lock()


class Response:
    """Linear response of a best fit to noise: -H^-1, with H the curvature of -log posterior.

    `theta` is the vector of the best fit, with start values in regions without a pixel.
    """

    def __init__(
        self,
        like: Likelihood,
        params: Mapping[str, Numeric],
        priors: Mapping[str, Prior] | None = None,
    ) -> None:
        posterior = Posterior(like, priors)
        # Without the likelihood, which is large, since workers are sent this.
        self._priors, self._low, self._high = posterior.priors, posterior.low, posterior.high
        self.theta = np.array(like.flat(like.check(params)))
        self._keep = np.flatnonzero(posterior.present & ~posterior.edges(self.theta))
        hessian = posterior.derivatives(self.theta).hessian
        self._factor = Factor(posterior.curvature(self.theta, hessian, self._keep))
        if not self._factor.positive:
            raise ValueError("The best fit is no maximum of the posterior.")

    def moved(self, like: Likelihood, key: Array) -> Float[np.ndarray, " par"]:
        """Return the best fit to the data of `like`, within the bounds of uniform priors.

        The means of Gaussian priors are drawn anew, too, since they are measurements like the data.
        """
        gradient = np.array(value_and_gradient(like, self.theta)[1])
        draws = np.asarray(jax.random.normal(key, gradient.shape))
        for prior, where in self._priors:
            assert isinstance(prior, Gaussian)  # the only prior that is not a bound
            gradient += np.where(where, draws / prior.sigma, 0.0)
        theta = self.theta.copy()
        theta[self._keep] -= self._factor.solve(gradient[self._keep])
        return np.clip(theta, self._low, self._high)


class BModes(NamedTuple):
    """What spectra of polarization take: masked spectra, the beam of the maps, and C_l to its end.

    `lensed` are the spectra of a CMB without tensors [uK_CMB^2].
    """

    spectra: pseudo_cl.MaskedSpectra
    window: Float[np.ndarray, " ell"]
    lensed: Float[np.ndarray, "4 ell"]


class SimulatedNoise(NamedTuple):
    """Parameters minus the best fit, and band powers D_b of BB [uK_CMB^2], per simulation.

    Without polarization there are no powers. They are of the noise in the cleaned CMB, the
    foregrounds left with these parameters, both together, the sum with a CMB without tensors, and
    that CMB without its B modes: E that pixels and mask turn into B. `spectrum` is C_l of noise and
    foregrounds in the masked map.
    """

    theta: Float[np.ndarray, "sim par"]
    noise: Float[np.ndarray, "sim bin"]
    residual: Float[np.ndarray, "sim bin"]
    both: Float[np.ndarray, "sim bin"]
    total: Float[np.ndarray, "sim bin"]
    leaked: Float[np.ndarray, "sim bin"]
    spectrum: Float[np.ndarray, "sim ell"]


class Separation(NamedTuple):
    """Results of a separation; spectra are of the cleaned CMB [uK_CMB^2].

    `fit` has the most probable spectral parameters with the errors that the likelihood gives. It
    takes smoothed noise as independent between pixels, and multipoles of a masked sky as
    independent, so `sigma`, by name, and `covariance`, in the order of `fit.labels` and None for
    too many parameters, come from simulations, except for multipoles of the full sky. `found`
    are the components with their errors, and `maps` their maps at one beam. `residuals` are maps of
    the data minus the components, and `left` the band powers of foregrounds left in the CMB, None
    where these are not known. Without polarization there are no spectra and no tensors.
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
    spectra: pseudo_cl.MaskedSpectra | None
    tensors: TensorFit | None
    left: Float[np.ndarray, " bin"] | None
    chain: FitResult | None

    def of_pixel(
        self, name: str, values: Mapping[str, Any], part: slice = slice(None)
    ) -> Float[np.ndarray, " pix"]:
        """Return the map of a parameter with regions, from its values; NaN where masked."""
        assert isinstance(self.data, PixelData)  # the one with regions
        labels = self.data.labels[name][part]
        return np.where(self.data.used[part], np.asarray(values[name])[labels], np.nan)


def separate_data(
    settings: Experiment,
    data: PixelData | FullSkyData,
    out: Path | None = None,
    progress: Progress = QUIET,
    executor: Executor | None = None,
) -> Separation:
    """Fit the laws, separate the components, and measure r if they are polarized.

    `data` are from `fits.separated_data.separation_data`, and `out` is the folder for simulations
    and chains; what it contains is not made again. `executor` makes the simulations, by default
    this process; see `kept_realisations`.
    """
    check_double("A separation")
    spec, priors = settings.separate, priors_of(settings, "separate")
    # Processes of a job each take their own pixels.
    own = data.distributed()
    progress.step("spectral parameters")
    with at_key("free"):
        like = own.likelihood(own.observed)
    fit = best_fit(like, priors=priors, throw=False)
    # Data that no law describes are separated nevertheless, with a warning.
    fit.checked(throw=fit.converged is not Convergence.misfit)
    response = Response(like, fit.best_fit, priors)
    progress.step("components")
    best = like.named(jnp.asarray(response.theta))
    found, maps = own.components(like, best, own.observed)
    whole = like
    if spread(own.observed):
        found = job.collected(found, data.observed.shape[-1])
        maps, whole = found.amplitude, data.likelihood(data.observed)
    amplitude = found.amplitude if data.exact else maps
    row = found.components.index("cmb")

    progress.step("simulations")
    modes = None if settings.common.stokes == "I" else _b_modes(settings, data.mask)
    others = (np.arange(len(found.components)) != row)[:, None, None]
    foregrounds = computed(amplitude.shape, lambda part: amplitude[..., part] * others)
    emission = data.emission(whole, best, foregrounds)
    bare = dataclasses.replace(whole, source=None)  # the noise of other data takes its place
    make = partial(_simulation, data, bare, response, emission, modes)
    path = None if out is None else out / "simulations.npz"
    kept = spec.nsims, settings.seed, path, _mark(settings, data), progress.advance, executor
    simulated = kept_realisations(make, SimulatedNoise, *kept)
    ratio = left = None
    if modes is not None:
        progress.step("tensor-to-scalar ratio")
        ratio = _tensors(settings, modes, simulated, maps[row])
        if data.foregrounds is not None:
            left = _BB(modes.spectra, _cleaned_cmb(data, whole, best, data.foregrounds))
    sigma, covariance = _errors(data, like, fit, simulated)
    chain = None
    if spec.sampler != "none" and len(fit.labels) <= SAMPLED and like.source is None:
        progress.step("posterior")
        chain = _chain(settings, data, like, fit, simulated, out, progress)
    return Separation(
        data=data,
        like=whole,
        fit=fit,
        sigma=sigma,
        covariance=covariance,
        found=found,
        maps=maps,
        residuals=data.residuals(whole, best, amplitude),
        simulated=simulated,
        spectra=None if modes is None else modes.spectra,
        tensors=ratio,
        left=left,
        chain=chain,
    )


def _cleaned_cmb(data, like, params, observed):
    """Return the map of the CMB in `observed`, separated with these parameters."""
    found, maps = data.components(like, params, observed, covariance=False)
    return stored(maps[found.components.index("cmb")])


def _BB(spectra, maps):
    """Return the band powers of BB of maps Q, U or I, Q, U."""
    return pseudo_cl.band_powers(spectra, maps[-2:])[1]


def _tensors(settings, modes, simulated, cleaned):
    """Fit r to BB of the cleaned CMB, given `BModes` and `SimulatedNoise`."""
    spectra, window, lensed = modes
    with at_key("cmb.cosmology"):
        tensors = tensor_spectra(window.size - 1, **settings.cmb.cosmology)
    # The model has the mean E in B that the windows know of; only the rest is added.
    EE = lensed[1, : spectra.lmax + 1]
    leaked = simulated.leaked.mean(axis=0) - spectra.windows[1, :, 0] @ EE
    model = power_model(
        spectra,
        window,
        lensed,
        tensors,
        additive=simulated.both.mean(axis=0) + leaked,
        noise=simulated.spectrum.mean(axis=0),
        simulated=simulated.total,
    )
    return fit_tensors(model, _BB(spectra, cleaned))


def _simulation(data, like, response, emission, modes, key):
    """Return `SimulatedNoise` of one realisation of noise, on foregrounds.

    `response` is that of the best fit to noise, `emission` the foregrounds in the bands, and
    `modes` the `BModes`, None without polarization.
    """
    # Transforms of large maps use all processors, and much memory: one after the other.
    with ONE if isinstance(emission, Stack) else nullcontext():
        noise = data.noise_realisation(key)
        observed = computed(noise.shape, lambda at: emission[..., at] + noise[..., at])
        theta = response.moved(data.likelihood(observed), stream(key, "priors"))
        if modes is None:
            return SimulatedNoise(theta - response.theta, *6 * (np.zeros(0),))
        spectra, window, lensed = modes
        alone = _cleaned_cmb(data, like, like.named(jnp.asarray(response.theta)), noise)
        both = _cleaned_cmb(data, like, like.named(jnp.asarray(theta)), observed)
        nside = healpy.npix2nside(both.shape[-1])
        alm = realisation(stream(key, "cmb"), lensed) * expand(jnp.asarray(window))
        alm = resize(alm, max(2, needed_lmax(window)))
        BB = partial(_BB, spectra)
        # Maps are made one by one, since they may be large.
        return SimulatedNoise(
            theta=theta - response.theta,
            noise=BB(alone),
            residual=BB(both[...] - alone[...]),
            both=BB(both),
            total=BB(both[-2:] + synthesis(alm, nside)),
            leaked=BB(synthesis(alm.at[1].set(0.0), nside)),
            spectrum=pseudo_cl.mean_spectrum(spectra.mask, both[-2:], spectra.lmax),
        )


def _b_modes(settings: Experiment, mask: np.ndarray) -> BModes:
    """Return what spectra of the maps take."""
    how, nside, fwhm = settings.separate, settings.common.nside, settings.common.fwhm
    highest = 2 * nside
    window = np.asarray(gaussian_beam(fwhm, highest))
    reach = int(np.flatnonzero(window > pseudo_cl.LEAST_WINDOW).max())
    # Bins beyond lmax are needed for power that the mask mixes into those below.
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
    edges = pseudo_cl.bin_edges(how.lmin, lmax, how.width)
    spectra = pseudo_cl.masked_spectra(mask, edges, window=window, pure=pure)
    # Lensing is that of the settings, in simulations and in the model.
    return BModes(spectra, window, cmb_spectra(settings, highest, r=0.0))


def _mark(settings: Experiment, data: PixelData | FullSkyData) -> str:
    """Return a mark of all that the simulations depend on."""
    left_out = {"separate": {"nsims", "sampler", "nsteps"}}
    said = settings.model_dump_json(exclude=left_out)
    return f"{fingerprint((data.observed, data.mask))} {said}"


def _errors(data, like, fit, simulated):
    """Return standard deviations by name, and the covariance."""
    if data.exact:
        return fit.sigma, fit.covariance
    sigma = simulated.theta.std(axis=0, ddof=1)
    determined = np.isfinite(np.asarray(like.flat(fit.best_fit))) & (sigma > 0)
    sizes = Posterior(like, None).named(np.where(determined, sigma, np.nan))
    if fit.covariance is None:
        return sizes, None
    covariance = np.atleast_2d(np.cov(simulated.theta.T))
    return sizes, np.where(determined & determined[:, None], covariance, np.nan)


def _chain(settings, data, like, fit, simulated, out, progress):
    """Sample the posterior, with the errors of the simulations if it is not exact."""
    spec = settings.separate
    backend = None
    if spec.sampler == "emcee" and out is not None:
        backend = KeptChain(out / "chain.npz", f"{_mark(settings, data)} {len(fit.labels)}")
    samples = sample(
        like,
        fit.best_fit,
        priors=priors_of(settings, "separate"),
        sampler=spec.sampler,
        nsteps=spec.nsteps,
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
