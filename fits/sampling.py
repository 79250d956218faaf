"""Sample a posterior with emcee's ensemble, kept in a file, or blackjax's no-U-turn sampler.

The no-U-turn sampler (Hoffman & Gelman 2014, JMLR 15, 1593) follows the gradient, so it needs a
few evaluations per independent sample, however many parameters there are. It moves in the numbers
of `fits.unbounded`, in which the walkers of emcee also start.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import partial

import blackjax
import emcee
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.step_size import dual_averaging_adaptation
from blackjax.diagnostics import ess_bulk, rhat
from jaxtyping import Array, Float
from rich.progress import Progress as Bar

from fits.kept import KeptChain
from fits.optimize import best_fit
from fits.posterior import Likelihood, Posterior, Prior, first_few
from fits.results import Convergence, FitResult
from fits.unbounded import unbounded_posterior
from jaxsky.checks import Numeric, check_choice, check_seed

#: A chain of emcee shorter than this many autocorrelation times is reported as too short.
ENOUGH = 50
#: Walkers of an ensemble, or more for many parameters.
WALKERS = 32
#: Mean acceptance that the step size of the no-U-turn sampler is tuned to.
ACCEPTANCE = 0.9
#: Width of the start positions of its chains, in standard deviations.
SPREAD = 2.0
#: Its steps per call of a program, the unit of progress.
BLOCK = 50
#: R-hat of chains that agree, and effective samples that each of them needs, after Vehtari et al.
#: (2021, Bayesian Analysis 16, 667).
AGREEMENT, EFFECTIVE = 1.01, 100
#: Harmless share of divergent steps, far out in the tail of a posterior cut by a prior.
RARE = 1e-3


@partial(jax.jit, static_argnames="structure")
def _log_probs(positions, leaves, structure):
    density = jax.tree.unflatten(structure, leaves)

    def one(x):
        inside = (x >= density.low) & (x <= density.high) | ~density.bounded
        value = density.log_prob(x)
        # Outside the prior the model may not even be finite.
        return jnp.where(inside.all() & jnp.isfinite(value), value, -jnp.inf)

    return jax.vmap(one)(positions)


@jax.jit
def _values(unbounded, z):
    return jax.vmap(unbounded.values)(z)[0]


def _ensemble(unbounded, labels, seed, report, nsteps=5000, nwalkers=None, backend=None):
    """Run emcee's ensemble; steps that a file already contains are not made again."""
    size = len(labels)
    nwalkers = max(WALKERS, 2 * size + 2) if nwalkers is None else nwalkers
    if nwalkers < 2 * size or nsteps < 1:
        raise ValueError(
            f"MCMC needs at least {2 * size} walkers and a step for {size} parameters, "
            f"not nwalkers={nwalkers}, nsteps={nsteps}."
        )
    # Flattened once rather than at each step, where it would take a third of the time.
    leaves, structure = jax.tree.flatten(unbounded.density)

    def log_probs(theta: np.ndarray) -> np.ndarray:
        # Also at the start in the halves that emcee moves: one program instead of two.
        parts = np.split(theta, 2) if len(theta) == nwalkers and nwalkers % 2 == 0 else [theta]
        return np.concatenate([_log_probs(part, leaves, structure) for part in parts])

    sampler = emcee.EnsembleSampler(nwalkers, size, log_probs, vectorize=True, backend=backend)
    # emcee's own wrapper prints a traceback when it is interrupted.
    sampler.log_prob_fn = sampler.log_prob_fn.f
    if done := sampler.iteration:
        state = sampler.get_last_sample()
    else:
        rng = np.random.default_rng(seed)
        positions = np.asarray(_values(unbounded, rng.normal(size=(nwalkers, size))))
        random_state = np.random.RandomState(rng.integers(2**32)).get_state()
        state = emcee.State(positions, random_state=random_state)
    try:
        for i, _ in enumerate(sampler.sample(state, iterations=max(0, nsteps - done)), done + 1):
            report(i, nsteps)
    finally:
        if backend is not None:
            backend.flush()
    chain = sampler.get_chain()
    tau = emcee.autocorr.integrated_time(chain, tol=0)
    worst = float(np.nanmax(tau)) if np.isfinite(tau).any() else float(len(chain))
    message = f"{len(chain)} steps are {len(chain) / worst:.0f} autocorrelation times ({worst:.0f})"
    enough = len(chain) >= ENOUGH * worst
    return {
        "converged": Convergence.converged if enough else Convergence.unmixed,
        "message": message + ("." if enough else f", of which at least {ENOUGH} are needed."),
        "chain": chain,
        "log_prob": sampler.get_log_prob(),
        "tau": tau,
        "discard": min(int(np.ceil(2 * worst)), len(chain) // 2),
        "thin": max(1, int(worst / 2)),
        "acceptance": float(np.mean(sampler.acceptance_fraction)),
    }


@jax.jit
def agreement(
    chain: Float[Array, "step chain par"],
) -> tuple[Float[Array, " par"], Float[Array, " par"]]:
    """Return R-hat and effective number of samples of each parameter; R-hat NaN if it never moves.

    Of both, the worse of two: of ranks, and of ranks of distances from the median, which show how
    well widths are known (Vehtari et al. 2021, Bayesian Analysis 16, 667).
    """
    chain = jnp.swapaxes(chain, 0, 1)
    distances = jnp.abs(chain - jnp.median(chain, axis=(0, 1)))
    effective = jnp.minimum(ess_bulk(chain), ess_bulk(distances))
    return jnp.atleast_1d(rhat(chain)), jnp.atleast_1d(effective)


@jax.jit
def _begun(unbounded, z):
    return jax.vmap(lambda x: blackjax.nuts.init(x, unbounded.log_density))(z)


@partial(jax.jit, static_argnames="steps")
def _advanced(unbounded, begun, key, first, nwarmup, steps):
    """Make some steps of all chains, from number `first`; return their end and their course."""
    kernel = blackjax.nuts.build_kernel()
    metric = jnp.ones(unbounded.center.size)
    _, tuned, _ = dual_averaging_adaptation(ACCEPTANCE)

    def step(state, number):
        chains, tuning = state
        warming = number < nwarmup
        size = jnp.exp(jnp.where(warming, tuning.log_step_size, tuning.log_step_size_avg))
        keys = jax.random.split(jax.random.fold_in(key, number), len(chains.logdensity))
        chains, info = jax.vmap(lambda k, c: kernel(k, c, unbounded.log_density, size, metric))(
            keys, chains
        )
        new = tuned(tuning, jnp.mean(jnp.nan_to_num(info.acceptance_rate)))
        tuning = jax.tree.map(partial(jnp.where, warming), new, tuning)
        values, jacobian = jax.vmap(unbounded.values)(chains.position)
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


def _course(unbounded, z, key, first, last, nwarmup, report) -> dict[str, np.ndarray]:
    """Return steps first ... last - 1 of chains that begin at z, tuning the step size."""
    for _ in range(30):
        chains = _begun(unbounded, z)
        bad = ~np.isfinite(np.asarray(chains.logdensity))
        if not bad.any():
            break
        # Far out the laws may not be finite.
        z = np.where(bad[:, None], z / 2, z)
    begin, _, _ = dual_averaging_adaptation(ACCEPTANCE)
    # The same type from the first call on, so that there is one program.
    tuning = jax.tree.map(lambda x: jnp.asarray(x, float), begin(z.shape[1] ** -0.25))
    state, courses = (chains, tuning), []
    for number in range(first, last, BLOCK):
        state, course = _advanced(unbounded, state, key, number, nwarmup, BLOCK)
        courses.append(jax.tree.map(np.asarray, course))
        report(min(number + BLOCK, last))
    return {k: np.concatenate([c[k] for c in courses])[: last - first] for k in courses[0]}


def _no_u_turn(unbounded, labels, seed, report, nsteps=1000, nwarmup=300, nchains=4):
    """Run chains of the no-U-turn sampler."""
    if nsteps < 4 or nwarmup < 0 or nchains < 1:
        raise ValueError(
            "The sampler 'nuts' needs at least 4 steps and a chain, not "
            f"nsteps={nsteps}, nwarmup={nwarmup}, nchains={nchains}."
        )
    z = SPREAD * np.random.default_rng(seed).normal(size=(nchains, len(labels)))
    key, total = jax.random.key(seed), nwarmup + nsteps
    parts = partial(_course, key=key, nwarmup=nwarmup, report=lambda done: report(done, total))
    # Half of the warm-up measures the covariance of the parameters, if these are few.
    pilot = nwarmup // 2 // BLOCK * BLOCK if unbounded.root.ndim == 2 else 0
    if pilot:
        chain = parts(unbounded, z, first=0, last=pilot, nwarmup=pilot)["chain"]
        unbounded = unbounded.adapted(chain[pilot // 3 :].reshape(-1, len(labels)))
        z = unbounded.coordinates(chain[-1])
    course = parts(unbounded, z, first=pilot, last=total)
    course = {name: values[nwarmup - pilot :] for name, values in course.items()}
    ratio, effective = map(np.asarray, agreement(course["chain"]))
    worst, least = int(np.argmax(ratio)), float(np.min(effective))
    diverged = int(course["diverged"].sum())
    message = (
        f"{nchains} chains of {nsteps} steps: R-hat {ratio[worst]:.3f} of {labels[worst]!r}, at "
        f"least {least:.0f} effective samples, {diverged} divergent steps"
    )
    most = RARE * nsteps * nchains
    needed = {
        f"an R-hat below {AGREEMENT}": ratio[worst] < AGREEMENT,
        f"{EFFECTIVE * nchains} effective samples": least >= EFFECTIVE * nchains,
        f"at most {most:.0f} divergent ones": diverged <= most,
    }
    failed = [words for words, reached in needed.items() if not reached]
    with np.errstate(divide="ignore"):
        tau = nsteps * nchains / effective
    return {
        "converged": Convergence.unmixed if failed else Convergence.converged,
        "message": message + (f"; needed are {', '.join(failed)}." if failed else "."),
        "chain": course["chain"],
        "log_prob": course["log_prob"],
        "tau": tau,
        "discard": 0,
        "thin": 1,
        "acceptance": float(np.mean(course["acceptance"])),
        "divergences": diverged,
        "rhat": dict(zip(labels, ratio.tolist(), strict=True)),
        "ess": dict(zip(labels, effective.tolist(), strict=True)),
        "gradients": float(np.mean(course["gradients"])),
        "step_size": float(course["step_size"][-1]),
    }


#: The samplers, and the `method` of their results.
SAMPLERS: dict[str, tuple[Callable, str]] = {
    "emcee": (_ensemble, "mcmc"),
    "nuts": (_no_u_turn, "nuts"),
}


def sample(
    like: Likelihood,
    start: Mapping[str, Numeric] | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    sampler: str = "emcee",
    nsteps: int | None = None,
    nwarmup: int | None = None,
    nchains: int | None = None,
    nwalkers: int | None = None,
    seed: int = 0,
    backend: KeptChain | None = None,
    progress: bool | Callable[[int, int], None] = True,
    throw: bool = True,
) -> FitResult:
    """Draw samples of the posterior: the likelihood times the priors.

    Where signals are near the noise of a pixel, a spectral likelihood is narrower than the scatter
    of its maximum, and so are its samples: see the covariance of `best_fit`.

    Parameters
    ----------
    like, start, priors : as for `best_fit`; chains and walkers start around the best fit
    sampler : "emcee", the affine-invariant ensemble, which can be resumed, or "nuts", the no-U-turn
        sampler of blackjax, which gives ten times as many independent samples per second after some
        seconds of compilation, and takes minutes for hundreds of regions, where the first fails
    nsteps : all steps of each walker (5000), or those of each chain that are kept (1000)
    nwarmup : "nuts": steps before that (300): half of them to measure the covariance of the
        parameters, if these are few, and all to tune the step size
    nchains : "nuts": number of chains (4)
    nwalkers : "emcee": size of the ensemble (32, or more for more than 15 parameters)
    seed : seed of the start positions and the moves
    backend : "emcee": file of the chain; one that already has steps is resumed up to `nsteps`,
        with exactly the steps that an uninterrupted run would have made
    progress : show a progress bar, or call a function with the numbers of steps done and of all
    throw : raise if the chains are too short or do not agree

    Returns
    -------
    Result of method "mcmc" or "nuts", with the most probable sample, central intervals and
    covariance of the samples, of emcee after two autocorrelation times. Regions without a pixel
    have no row in it. `details` has "chain" (step, walker or chain, row), "log_prob", "tau" by
    label, "acceptance", "discard" and "thin"; of "nuts" also the number of "divergences", "rhat"
    and "ess", effective samples, by label, the mean number of "gradients" per step, and
    "step_size".

    Raises
    ------
    KeyError, ValueError
        For unknown parameters, start values outside their prior, an unknown sampler, arguments of
        the other one, and fewer than twice as many walkers as parameters.
    FitError
        Unless throw=False, with the result as `.result`: if data and priors do not determine the
        parameters; a chain of emcee is shorter than 50 autocorrelation times; with "nuts", R-hat is
        1.01 or more, there are fewer than 100 effective samples per chain, or more than one in a
        thousand steps diverged; or chi^2 or parameters are those of no fit (`fits.results`).
    """
    check_seed("seed", seed)
    check_choice("sampler", sampler, SAMPLERS)
    run, method = SAMPLERS[sampler]
    options = {"nsteps": nsteps, "nwarmup": nwarmup, "nchains": nchains, "nwalkers": nwalkers}
    options = {n: v for n, v in (options | {"backend": backend}).items() if v is not None}
    for name in options:
        if name not in inspect.signature(run).parameters:
            raise ValueError(f"Argument `{name}` is not one of the sampler {sampler!r}.")
    like = like.at(start)
    posterior = Posterior(like, priors)
    fit = best_fit(like, priors=priors, throw=False)
    center = np.array(like.flat(like.check(fit.best_fit)))
    unbounded, unknown = unbounded_posterior(posterior, center)
    labels = tuple(np.array(posterior.labels)[posterior.present].tolist())
    fit = fit._replace(method=method, labels=labels)
    if unknown:
        nothing = posterior.named(np.full(posterior.start.size, np.nan))
        return fit._replace(
            best_fit=nothing,
            sigma=nothing,
            interval_68={name: (value, value) for name, value in nothing.items()},
            covariance=np.full((len(labels), len(labels)), np.nan),
            converged=Convergence.undetermined,
            message=f"Data and priors do not determine {first_few(unknown)}: "
            "there is nothing to draw from.",
            details={},
        ).checked(throw)
    with Bar(transient=True, disable=progress is not True) as bar:
        task = bar.add_task("samples", total=None)

        def draw(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        report = progress if callable(progress) else draw
        details = run(unbounded, labels, seed, report, **options)
    details["tau"] = dict(zip(labels, details["tau"].tolist(), strict=True))
    best = np.unravel_index(np.argmax(details["log_prob"]), details["log_prob"].shape)
    theta = np.array(unbounded.density.theta)
    theta[posterior.present] = details["chain"][best]
    result = fit._replace(
        best_fit=posterior.named(theta),
        chi2=2 * float(posterior.derivatives(theta).value.sum()),
        converged=details.pop("converged"),
        message=details.pop("message"),
        details=details,
    ).with_chain(details["chain"])
    return result.judged(result.chi2, result.dof, like.start).checked(throw)
