"""Posterior samples of spectral parameters: the no-U-turn sampler, or emcee's ensemble.

The no-U-turn sampler (Hoffman & Gelman 2014, JMLR 15, 1593) follows the gradient, so it takes a
few evaluations for a sample that does not depend on the last one, however many parameters there
are. It moves in the numbers of `fits.unbounded`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.step_size import dual_averaging_adaptation
from tqdm import tqdm

from fits.chains import ChainFile
from fits.posterior import Problem, value_and_gradient
from fits.priors import Prior, check_priors
from fits.profile_likelihood import SpectralLikelihood
from fits.results import FitResult
from fits.sampling import ensemble, ensemble_summary, summary
from fits.separation.agreement import agreement
from fits.separation.fit import fit_spectra, start_vector
from fits.unbounded import scaled_posterior
from jaxsky.checks import Numeric, check_seed

#: What each sampler takes, with the values if they are not given.
OPTIONS: dict[str, dict[str, Any]] = {
    "nuts": {"nsteps": 1000, "nwarmup": 300, "nchains": 4},
    "emcee": {"nsteps": 5000, "nwalkers": 32, "backend": None},
}
#: Mean acceptance that the step size of the no-U-turn sampler is tuned to.
ACCEPTANCE = 0.9
#: Width of the start positions of its chains, in standard deviations.
SPREAD = 2.0
#: Its steps in one call of a program: what progress is counted in.
BLOCK = 50
#: R-hat of chains that agree, and effective samples that each of them needs, after Vehtari et al.
#: (2021, Bayesian Analysis 16, 667).
AGREEMENT, EFFECTIVE = 1.01, 100
#: Share of divergent steps that does no harm: far out in the tail of a cut posterior.
RARE = 1e-3


@jax.jit
def _log_probs(posterior, values):
    def one(x):
        inside = (x >= posterior.low) & (x <= posterior.high) | ~posterior.bounded
        value = posterior.log_prob(x)
        return jnp.where(inside.all() & jnp.isfinite(value), value, -jnp.inf)

    return jax.vmap(one)(values)


@jax.jit
def _values(posterior, z):
    return jax.vmap(posterior.values)(z)[0]


@jax.jit
def _begun(posterior, z):
    return jax.vmap(lambda x: blackjax.nuts.init(x, posterior.density))(z)


@partial(jax.jit, static_argnames="steps")
def _advanced(posterior, begun, key, first, nwarmup, steps):
    """Some steps of all chains, from the number `first` on: where they end, and their course."""
    kernel = blackjax.nuts.build_kernel()
    metric = jnp.ones(posterior.center.size)
    _, tuned, _ = dual_averaging_adaptation(ACCEPTANCE)

    def step(state, number):
        chains, tuning = state
        warming = number < nwarmup
        size = jnp.exp(jnp.where(warming, tuning.log_step_size, tuning.log_step_size_avg))
        keys = jax.random.split(jax.random.fold_in(key, number), len(chains.logdensity))
        chains, info = jax.vmap(lambda k, c: kernel(k, c, posterior.density, size, metric))(
            keys, chains
        )
        new = tuned(tuning, jnp.mean(jnp.nan_to_num(info.acceptance_rate)))
        tuning = jax.tree.map(partial(jnp.where, warming), new, tuning)
        values, jacobian = jax.vmap(posterior.values)(chains.position)
        course = {
            "chain": values,
            "log_prob": chains.logdensity - jacobian,
            "acceptance": info.acceptance_rate,
            "diverged": info.is_divergent,
            "gradients": info.num_integration_steps,
            "step_size": size,
        }
        return (chains, tuning), course

    return jax.lax.scan(step, begun, first + jnp.arange(steps))


def _course(posterior, z, key, first, last, nwarmup, advance) -> dict[str, np.ndarray]:
    """The steps first ... last - 1 of chains that begin at z, in which the step size is tuned."""
    for _ in range(30):
        chains = _begun(posterior, z)
        bad = ~np.isfinite(np.asarray(chains.logdensity))
        if not bad.any():
            break
        # Far out the laws may not be finite.
        z = np.where(bad[:, None], z / 2, z)
    begin, _, _ = dual_averaging_adaptation(ACCEPTANCE)
    # Of one type from the first call on, so that there is one program.
    tuning = jax.tree.map(lambda x: jnp.asarray(x, float), begin(z.shape[1] ** -0.25))
    state, courses = (chains, tuning), []
    for number in range(first, last, BLOCK):
        state, course = _advanced(posterior, state, key, number, nwarmup, BLOCK)
        courses.append(jax.tree.map(np.asarray, course))
        advance(min(number + BLOCK, last))
    return {k: np.concatenate([c[k] for c in courses])[: last - first] for k in courses[0]}


def _nuts(posterior, labels, chi2_of, *, seed, nsteps, nwarmup, nchains, progress) -> FitResult:
    z = SPREAD * np.random.default_rng(seed).normal(size=(nchains, len(labels)))
    key, total = jax.random.key(seed), nwarmup + nsteps
    pilot = nwarmup // 2 // BLOCK * BLOCK
    with tqdm(total=total, disable=progress is not True, delay=2, leave=False) as bar:

        def advance(done: int) -> None:
            bar.update(done - bar.n)
            if callable(progress):
                progress(done, total)

        if pilot and posterior.root.ndim == 2:
            chain = _course(posterior, z, key, 0, pilot, pilot, advance)["chain"]
            posterior = posterior.adapted(chain[pilot // 3 :].reshape(-1, len(labels)))
            z = posterior.coordinates(chain[-1])
        else:
            pilot = 0
        course = _course(posterior, z, key, pilot, total, nwarmup, advance)
    course = {name: values[nwarmup - pilot :] for name, values in course.items()}
    rhat, effective = agreement(course["chain"])
    worst, least = int(np.argmax(rhat)), float(np.min(effective))
    diverged = int(course["diverged"].sum())
    message = (
        f"{nchains} chains of {nsteps} steps: R-hat {rhat[worst]:.3f} of {labels[worst]!r}, at "
        f"least {least:.0f} effective samples, {diverged} divergent steps"
    )
    failed = []
    if not rhat[worst] < AGREEMENT:
        failed.append(f"an R-hat below {AGREEMENT}")
    if not least >= EFFECTIVE * nchains:
        failed.append(f"{EFFECTIVE * nchains} effective samples")
    if diverged > RARE * nsteps * nchains:
        failed.append(f"at most {RARE * nsteps * nchains:.0f} divergent ones")
    return summary(
        "nuts",
        labels,
        course["chain"],
        course["log_prob"],
        chi2_of,
        tau=nsteps * nchains / effective,
        discard=0,
        thin=1,
        converged=not failed,
        message=message + (f"; needed are {', '.join(failed)}." if failed else "."),
        details={
            "acceptance": float(np.mean(course["acceptance"])),
            "divergences": diverged,
            "rhat": dict(zip(labels, rhat.tolist(), strict=True)),
            "ess": dict(zip(labels, effective.tolist(), strict=True)),
            "gradients": float(np.mean(course["gradients"])),
            "step_size": float(course["step_size"][-1]),
        },
    )


def _undetermined(method: str, labels: tuple[str, ...], unknown: list[str], chi2: float):
    """The result where there is no posterior to draw from."""
    shown = ", ".join(unknown[:6]) + (f" and {len(unknown) - 6} more" if unknown[6:] else "")
    size = len(labels)
    return FitResult(
        method=method,
        free=labels,
        best_fit=dict.fromkeys(labels, np.nan),
        interval_68=dict.fromkeys(labels, (np.nan, np.nan)),
        covariance=np.full((size, size), np.nan),
        chi2=chi2,
        converged=False,
        message=f"Data and priors do not determine {shown}: there is nothing to draw from.",
        details={},
    )


def _options(sampler: str, given: dict[str, Any]) -> dict[str, Any]:
    """What the sampler is called with."""
    if sampler not in OPTIONS:
        names = " or ".join(map(repr, OPTIONS))
        raise ValueError(f"Argument `sampler` must be {names}, not {sampler!r}.")
    known = OPTIONS[sampler]
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in known:
            raise ValueError(f"Argument `{name}` is not one of the sampler {sampler!r}.")
    options = known | given
    if sampler == "nuts" and (
        options["nsteps"] < 4 or options["nwarmup"] < 0 or options["nchains"] < 1
    ):
        shown = ", ".join(f"{name}={value}" for name, value in options.items())
        raise ValueError(f"The sampler 'nuts' needs at least 4 steps and a chain, not {shown}.")
    return options


def sample_spectra(
    like: SpectralLikelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    sampler: str = "nuts",
    nsteps: int | None = None,
    nwarmup: int | None = None,
    nchains: int | None = None,
    nwalkers: int | None = None,
    seed: int = 0,
    backend: ChainFile | None = None,
    progress: bool | Callable[[int, int], None] = True,
    throw: bool = True,
) -> FitResult:
    """Samples of the posterior of spectral parameters.

    The posterior is the spectral likelihood times the priors. Where signals are near the noise of
    a pixel, that likelihood is narrower than the scatter of its maximum, and so are its samples:
    see `SpectralFit.covariance`.

    Parameters
    ----------
    like : from `fits.separation.spectral_likelihood`
    start : start values of the best fit by name; chains and walkers start around that
    priors : priors by name, the same in each region
    sampler : "nuts", the no-U-turn sampler of blackjax, or "emcee". For a few parameters the first
        takes seconds, nearly all of them to compile, and gives ten times as many independent
        samples a second afterwards; for hundreds of regions, where the second fails, minutes. It
        cannot be resumed, the second can.
    nsteps : steps of each chain (1000) or walker (5000) that are kept
    nwarmup : "nuts": steps before that (300): half of them to see how parameters vary together,
        if they are few, and all to tune the step size
    nchains : "nuts": number of chains (4)
    nwalkers : "emcee": size of the ensemble (32)
    seed : of the start positions and the moves
    backend : "emcee": file of the chain, as for `fits.sampling.sample`
    progress : show a progress bar, or call a function with the steps done and those in all
    throw : raise if the chains are too short or do not agree

    Returns
    -------
    Result of method "nuts" or "mcmc", with the most probable sample, central intervals and
    covariance of the samples. Its parameters are called as in `SpectralFit.labels`
    ("dust.beta_dust[3]"); those of regions without a pixel are left out. `details` holds "chain"
    (step, chain or walker, par), "log_prob", "tau" by name, "acceptance", "discard" and "thin" as
    for `fits.sampling.sample`; of "nuts" also "divergences", their number, "rhat" and "ess", the
    number of effective samples, by name, "gradients", their mean number for a step, and
    "step_size".

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, start values outside their prior, an unknown sampler, arguments of
        the other one, and fewer than twice as many walkers as parameters.
    FitError
        If data and priors do not determine the parameters, R-hat is 1.01 or more, there are fewer
        than 100 effective samples for each chain, or more than one in a thousand steps diverged;
        with "emcee", if the chain is shorter than 50 autocorrelation times. If chi^2 is that of
        no fit, or a parameter is left open (`fits.results`). Not if throw=False; the result is in
        its `.result`.
    """
    check_seed("seed", seed)
    options = _options(
        sampler,
        {
            "nsteps": nsteps,
            "nwarmup": nwarmup,
            "nchains": nchains,
            "nwalkers": nwalkers,
            "backend": backend,
        },
    )
    priors = check_priors(priors, like.free)
    fit = fit_spectra(like, start, priors=priors, throw=False)
    problem = Problem(like, priors)
    best = np.array(like.flat(like.check(fit.best_fit)))
    posterior, unknown = scaled_posterior(problem, best)
    labels = tuple(np.array(problem.labels)[problem.present].tolist())
    if unknown:
        method = {"nuts": "nuts", "emcee": "mcmc"}[sampler]
        return _undetermined(method, labels, unknown, fit.chi2).checked(throw)

    def chi2_of(values: dict[str, float]) -> float:
        theta = posterior.theta.at[posterior.present].set(jnp.array(list(values.values())))
        return 2 * float(value_and_gradient(like, theta)[0])

    def judged(result: FitResult) -> FitResult:
        begun = start_vector(like, start, priors)[problem.present]
        return result.judged(result.chi2, fit.dof, dict(zip(labels, begun, strict=True)))

    if sampler == "nuts":
        result = _nuts(posterior, labels, chi2_of, seed=seed, progress=progress, **options)
        return judged(result).checked(throw)
    walkers = options["nwalkers"]
    chains = ensemble(
        lambda values: np.asarray(_log_probs(posterior, values)),
        lambda rng: np.asarray(_values(posterior, rng.normal(size=(walkers, len(labels))))),
        len(labels),
        seed=seed,
        progress=progress,
        **options,
    )
    return judged(ensemble_summary(chains, labels, chi2_of)).checked(throw)
