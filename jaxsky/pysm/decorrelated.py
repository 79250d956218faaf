"""Dust whose frequencies are decorrelated at random, PySM's model d6."""

from typing import Any

import numpy as np
from astropy import units as u

from jaxsky.bandpass import Bandpass
from jaxsky.public import takes_quantities
from jaxsky.pysm.emission import Part, emission_of
from jaxsky.pysm.models import ModifiedBlackBody
from jaxsky.pysm.units import bandpass, unit_of


class DecorrelatedModifiedBlackBody(ModifiedBlackBody):
    """A modified black body times random factors at each frequency, the same in all pixels.

    The factors are 1 at the reference frequency and Gaussian with the correlations
    exp[-(ln nu/nu')^2 / (2 L^2)] (Vansyngel et al. 2017), L being `correlation_length`. They are
    drawn anew in each call, first those of I and then of Q and U, from numpy's global random
    numbers, as in PySM. Mean and covariance given the reference are closed forms here; PySM inverts
    the almost singular matrix of all samples twice, so that from a few samples on its factors are
    dominated by rounding. As it is another sky in each call, it is no component of a `jaxsky.Sky`.
    """

    def _components(self, arguments: dict[str, Any]) -> Any:
        self.correlation_length = float(self._taken("correlation_length", arguments))
        amplitude, nu_I, nu_P = self._maps(arguments)
        law, self._frequencies = self._law(arguments), {"I": nu_I, "QU": nu_P}
        yield "I", law(amplitude[:1], nu_ref=nu_I)
        if len(amplitude) > 1:
            yield "QU", law(amplitude[1:], nu_ref=nu_P)

    @property
    def parts(self) -> tuple[Part, ...]:
        return ()

    @property
    def is_component(self) -> bool:
        return False

    @takes_quantities
    def get_emission(self, freqs: u.Quantity, weights: np.ndarray | None = None) -> u.Quantity:
        """Return I, Q, U [uK_RJ], with factors of this call."""
        band, total = bandpass(freqs, weights), np.zeros(())
        nu, response = np.asarray(band.nu), np.asarray(band.weights)
        for part in self._parts:
            factors = self._drawn(nu, self._frequencies[part.name])
            mean = float(np.sum(np.asarray(band.quadrature) * factors))
            own = Bandpass(nu, response * factors / mean, "power")
            total = total + emission_of([part], own, mean)
        return total << unit_of("uK_RJ")

    def _drawn(self, nu: np.ndarray, nu_ref: float) -> np.ndarray:
        """Draw the factors at frequencies [GHz], given that it is 1 at the reference."""
        log_nu = np.log(nu)

        def correlation(other: Any) -> np.ndarray:
            return np.exp(-0.5 * ((log_nu[:, None] - other) / self.correlation_length) ** 2)

        mean = correlation(np.log([nu_ref]))[:, 0]
        values, vectors = np.linalg.eigh(correlation(log_nu) - np.outer(mean, mean))
        root = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
        return mean + root @ np.random.randn(nu.size)  # noqa: NPY002 - seeded as PySM's
