"""Results of fits: numbers by name, how far to trust them, and how they are written."""

import json
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic_core import to_jsonable_python

from jaxsky.checks import Numeric, Summary, as_html, as_text, check_choice
from jaxsky.io import write_text
from jaxsky.settings import Experiment, circumstances

if TYPE_CHECKING:
    from getdist import MCSamples

#: A chi^2 above this multiple of the degrees of freedom (at least `FEW`) means that nothing was
#: fitted. Real skies, with laws that vary, errors that are too small and bright planes, have some
#: ten per degree of freedom; a few missing values read as data give hundreds and more.
ASTRONOMICAL, FEW = 100.0, 100
#: A parameter, or its error, above this multiple of its start (at least 1) has run away.
LOST = 50.0


def misfit(chi2: float, dof: int, expected: float = 1.0) -> str | None:
    """Return a message if chi^2 can only be explained by wrong input, else None.

    `expected` is chi2 per degree of freedom of the right model, if chi2 omits known fluctuations.
    """
    if chi2 <= ASTRONOMICAL * expected * max(dof, FEW):
        return None
    return (
        f"chi2 is {chi2:.3g} for {dof} degrees of freedom, so the model does not describe the "
        "data: look for missing values that are read as data, a wrong unit, or noise that is "
        "far too small."
    )


def help_by_prior(names: tuple[str, ...]) -> str:
    """Return the end of a sentence on parameters that the data do not constrain."""
    return f"a Gaussian prior on {' or '.join(names)} (mean, standard deviation) would help"


class Convergence(StrEnum):
    """How a fit ended, as a sentence; true if its numbers can be relied on."""

    converged = "The fit converged."
    max_steps = "The search made all its steps without reaching an optimum."
    stalled = "The search ended away from an optimum, before its last step."
    not_finite = "The search left the finite numbers."
    at_edge = "The best fit lies at the edge of a uniform prior."
    undetermined = "Data and priors do not determine all parameters."
    unresolved = "The grid is too coarse for the posterior, or misses part of it."
    unmixed = "Chains are too short, or do not agree."
    misfit = "An optimum was reached, but chi2 is that of no fit."

    def __bool__(self) -> bool:
        return self is Convergence.converged


class FitError(RuntimeError):
    """Raised if a fit did not converge; carries the result as `.result`."""

    def __init__(self, message: str, result: "FitResult") -> None:
        super().__init__(message)
        self.result = result


class FitResult(NamedTuple):
    """Parameters of a fit by one method: numbers, or arrays with one value per region.

    Attributes
    ----------
    method : "gradient", "grid", "mcmc" or "nuts"
    best_fit : most probable values by name; NaN for regions without a pixel
    sigma : their standard deviations, likewise; NaN where they were not determined
    interval_68 : (low, high) of the central 68.27 % of each marginal distribution
    labels : name, and region if there are several, of each row of the covariance
        ("dust.beta_dust[3]")
    covariance : that of the estimates, shape (par, par); None for too many parameters
    chi2 : smallest value of -2 log L, priors left out; for the exact likelihood that of the
        template amplitudes
    dof : number of data with weight minus that of amplitudes and free parameters
    converged, message : how it ended, true if the numbers can be relied on, and in words
    details : results that only this method has
    """

    method: str
    best_fit: dict[str, Any]
    sigma: dict[str, Any]
    interval_68: dict[str, tuple[Any, Any]]
    labels: tuple[str, ...]
    covariance: Float[np.ndarray, "par par"] | None
    chi2: float
    dof: int
    converged: Convergence
    message: str
    details: dict[str, Any]

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.best_fit)

    def __str__(self) -> str:
        return as_text(self.summary())

    def _repr_html_(self) -> str:
        return as_html(self.summary())

    def summary(self) -> Summary:
        """Return a heading, and values with errors, or their medians over regions."""
        rows = []
        for name, value in self.best_fit.items():
            known = np.isfinite(value)
            both = (np.asarray(x)[known] for x in (value, self.sigma[name]))
            shown = with_error(*map(np.median, both)) if known.any() else "unknown"
            regions = f", median of {known.sum()} regions" if np.ndim(value) else ""
            rows.append((name, shown + regions))
        rows.append(("chi2", f"{self.chi2:.1f} for {self.dof} degrees of freedom"))
        state = "converged" if self.converged else f"not converged: {self.message}"
        return f"Fit by {self.method}, {state}", rows

    def of_row(self, values: Mapping[str, Any], label: str) -> Any:
        """Return the entry of values by name that belongs to a row of the covariance."""
        name, _, region = label.partition("[")
        return np.asarray(values[name])[..., int(region[:-1])] if region else values[name]

    def with_chain(self, chain: Float[np.ndarray, "step walker par"]) -> "FitResult":
        """Return the result with these samples, and errors from those not discarded."""
        flat = chain[self.details["discard"] :].reshape(-1, len(self.labels))
        low, high = map(self._named, np.percentile(flat, [15.865525, 84.134475], axis=0))
        return self._replace(
            sigma=self._named(flat.std(axis=0, ddof=1)),
            interval_68={name: (low[name], high[name]) for name in low},
            covariance=np.atleast_2d(np.cov(flat.T)),
            details=self.details | {"chain": chain},
        )

    def _named(self, rows: Float[np.ndarray, " par"]) -> dict[str, Any]:
        """Return values by name from rows of the covariance; NaN for other regions."""
        values = {name: np.full(np.shape(value), np.nan) for name, value in self.best_fit.items()}
        for label, row in zip(self.labels, rows, strict=True):
            name, _, region = label.partition("[")
            values[name][int(region[:-1]) if region else ()] = row
        return {name: v if v.ndim else float(v) for name, v in values.items()}

    def correlation(self, first: str, second: str) -> float:
        """Return the correlation coefficient of two entries of `labels`."""
        if self.covariance is None:
            raise ValueError("The covariance of so many parameters was not computed.")
        check_choice("first", first, self.labels)
        check_choice("second", second, self.labels)
        i, j = self.labels.index(first), self.labels.index(second)
        scale = np.sqrt(self.covariance[i, i] * self.covariance[j, j])
        return float(self.covariance[i, j] / scale)

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers except the details by name, for files."""
        numbers = self._asdict() | {"converged": bool(self.converged)}
        del numbers["details"]
        return {"free": self.free} | numbers

    def to_getdist(
        self, title: str | None = None, symbol: Callable[[str], str] | None = None
    ) -> "MCSamples":
        """Return the samples of a chain for getdist; ValueError if there are none.

        `title` names the samples in legends, and `symbol` returns TeX without dollar signs for an
        entry of `labels`; by default the entry itself.
        """
        from getdist import MCSamples, chains

        if "chain" not in self.details:
            raise ValueError(f"A fit by the method {self.method!r} has no samples.")
        chains.print_load_details = False  # getdist otherwise prints about burn-in
        chain = self.details["chain"][self.details["discard"] :: self.details["thin"]]
        return MCSamples(
            samples=chain.reshape(-1, len(self.labels)),
            names=list(self.labels),
            labels=[symbol(n) if symbol else n for n in self.labels],
            label=title,
        )

    def judged(
        self, chi2: float, dof: int, start: Mapping[str, Numeric], expected: float = 1.0
    ) -> "FitResult":
        """Return the result, not converged if parameters ran away or chi^2 is far too large.

        A parameter ran away if it or its error is far from its start; offsets, in the unit of maps,
        are exempt. chi^2 and dof, for `misfit`, are of the data, or of the likelihood's residuals.
        """
        ended, failures = self.converged, [] if self.converged else [self.message]
        for name, value in self.best_fit.items():
            limit = LOST * np.maximum(np.abs(start[name]), 1.0)
            lost = np.asarray((np.abs(value) > limit) | (np.asarray(self.sigma[name]) > limit))
            if not self.converged or not lost.any() or name.startswith("offset."):
                continue
            where = f" in {lost.sum()} of {np.isfinite(value).sum()} regions"
            if not lost.ndim:
                where = f": from {start[name]:g} it went to {value:.3g} +- {self.sigma[name]:.2g}"
            failures.append(f"The data do not constrain {name!r}{where}; {help_by_prior((name,))}.")
            ended = Convergence.undetermined
        # Where nothing was found, there is no chi^2 either.
        wrong = misfit(chi2, dof, expected) if np.isfinite(chi2) or self.converged else None
        if wrong and wrong not in self.message:
            failures.insert(0, wrong)
            ended = ended if failures[1:] else Convergence.misfit
        if not failures:
            return self
        return self._replace(converged=ended, message=" ".join(failures))

    def checked(self, throw: bool) -> "FitResult":
        """Return the result; raise FitError if it did not converge and `throw` is set."""
        if throw and not self.converged:
            raise FitError(self.message, self)
        return self


def widened(
    samples: FitResult,
    center: Float[np.ndarray, " par"],
    hessian: Float[np.ndarray, "par par"],
    errors: Float[np.ndarray, "sim par"],
) -> FitResult:
    """Stretch samples of a posterior whose likelihood has wrong errors to the right ones.

    They are stretched about the best fit by S L^-1, with L L^T = H^-1 and S S^T the covariance of
    the estimates: the open-faced sandwich of Shaby (2014, J. Comput. Graph. Stat. 23, 853); with
    too few simulations, each parameter by its ratio of standard deviations. `center` is the best
    fit in the order of the samples, with the `hessian` of -log posterior there.
    """
    inverse = np.linalg.inv(hessian)
    if len(errors) > 4 * len(center):
        wanted = np.atleast_2d(np.cov(errors.T))
        turn = np.linalg.cholesky(wanted) @ np.linalg.inv(np.linalg.cholesky(inverse))
    else:
        turn = np.diag(errors.std(axis=0, ddof=1) / np.sqrt(np.diagonal(inverse)))
    return samples.with_chain(center + (samples.details["chain"] - center) @ turn.T)


def _digits(size: float) -> int:
    """Return decimals that give a positive number two significant digits; 4 for others."""
    usable = np.isfinite(size) and size > 0
    return max(0, 1 - int(np.floor(np.log10(size)))) if usable else 4


def two_digits(value: float) -> str:
    """Return a number with two significant digits, without an exponent."""
    return f"{value:.{_digits(value)}f}"


def with_error(value: float, error: float) -> str:
    """Return a value with its standard error, both to two digits of the error."""
    digits = _digits(error)
    return f"{value:.{digits}f} \u00b1 {error:.{digits}f}"


def with_errors(best: float, low: float, high: float) -> str:
    """Return a value with its interval as differences, to two digits of the smaller one.

    Without an interval the value alone, and an empty text if there is no value.
    """
    if not np.isfinite([low, high]).all():
        return f"{best:.4f}" if np.isfinite(best) else ""
    digits = _digits(min(abs(high - best), abs(best - low)))
    return f"{best:.{digits}f} {low - best:+.{digits}f} {high - best:+.{digits}f}"


def probability(value: float) -> str:
    """Return a probability with two decimals, or its order of magnitude."""
    if value < 1e-99:
        return "<1e-99"
    return f"{value:.2f}" if value >= 0.01 else f"{value:.0e}"


def write_json(path: Path, results: dict[str, Any]) -> None:
    """Write results of a run; arrays become lists, and numbers that are not finite null."""
    plain = to_jsonable_python(results, inf_nan_mode="null", fallback=lambda array: array.tolist())
    write_text(path, json.dumps(plain, indent=2, allow_nan=False) + "\n")


def write_log(path: Path, settings: Experiment, seconds: float) -> None:
    """Write when, where, how long, with which versions, settings and files a run was made."""
    said = settings.model_dump(mode="json", exclude_none=True)
    log = {**circumstances(settings), "seconds": round(seconds, 2), "settings": said}
    write_text(path, json.dumps(log, indent=2) + "\n")
