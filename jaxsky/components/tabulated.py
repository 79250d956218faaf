"""Components whose law is a table of numbers: emissivities of dust grains from other codes."""

from typing import Any, ClassVar, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.arrays import Scalar, StokesMaps
from jaxsky.checks import Parameter, as_array, check_positive, check_shape, is_concrete
from jaxsky.components.base import Component, parameter, reference, table, template

#: Wavelength times frequency [um GHz].
SPEED_OF_LIGHT: Final = 299792.458
#: Below this frequency [GHz] the grains of Hensley & Draine (2017) are not tabulated; PySM, and so
#: this package, continue their antenna temperature as a power law with the index below.
LOWEST: Final = 10.0
INDEX: Final = 1.54


def _check_increasing(name: str, what: str, values: Float[Array, " row"]) -> None:
    if is_concrete(values) and not np.all(np.diff(values) > 0):
        raise ValueError(f"Argument `{name}` has {what} that do not increase strictly.")


class SpinningDust(Component, law="spinning_dust"):
    """Spinning dust: an emissivity j(nu), stretched in frequency so that it peaks at nu_peak.

    T(nu)/T(nu_ref) = (nu/nu_ref)^-2 j(nu s)/j(nu_ref s) with s = nu_table/nu_peak: the law of
    PySM's models a1 and a2 (Thorne et al. 2017), whose table is SPDUST2's for a cold neutral medium
    (Ali-Haimoud et al. 2009, Silsbee et al. 2011). Between rows j is linear in nu, as in PySM, so
    derivatives have steps at rows; beyond the first and last one it is constant.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    emissivity : table (row, 2) of frequencies [GHz], strictly increasing, and j_nu in any unit of
        brightness, both positive
    nu_peak : frequency of the peak [GHz]
    nu_table : frequency of the table that comes to lie at nu_peak [GHz], 30 in PySM; by default
        that of its largest j
    nu_ref : reference frequency [GHz]

    Raises
    ------
    TypeError, ValueError
        As for any `Component`, and for a table that is not as said above.

    Examples
    --------
    >>> import numpy as np
    >>> nu = np.geomspace(1.0, 500.0, 200)
    >>> table = np.stack([nu, np.exp(-np.log(nu / 30) ** 2)], axis=1)
    >>> dust = SpinningDust(np.ones((2, 12)), table, nu_peak=30.0, nu_table=30.0)
    >>> round(float(dust.sed(40.0)), 4)
    0.3275
    """

    smooth: ClassVar[bool] = False

    amplitude: StokesMaps = template()
    emissivity: Float[Array, "row 2 1"] = table("frequencies [GHz] and emissivities")
    nu_peak: Parameter = parameter(
        30.0, positive=True, symbol=r"\nu_{\rm peak}", unit="GHz", zero=False
    )
    nu_table: Parameter | None = parameter(
        None, positive=True, symbol=r"\nu_{\rm table}", unit="GHz"
    )
    nu_ref: Parameter = reference(22.8, within=(0.01, 1e3))

    def __check_init__(self) -> None:
        if self.emissivity is None:
            return  # the base class says so
        found = as_array("emissivity", self.emissivity)
        good = found.ndim == 3 and found.shape[1:] == (2, 1) and len(found) > 1
        form = "be a table (row, 2) of frequencies [GHz] and emissivities"
        check_shape("emissivity", found, good, form)
        check_positive("emissivity", found)
        _check_increasing("emissivity", "frequencies in its first column", found[:, 0, 0])

    def sed(self, nu: Any):
        frequencies, values = self.emissivity[..., 0].T
        own = frequencies[jnp.argmax(values)] if self.nu_table is None else self.nu_table
        stretch = own / self.nu_peak

        def emissivity(nu):
            return jnp.interp(nu * stretch, frequencies, values)

        return (self.nu_ref / nu) ** 2 * emissivity(nu) / emissivity(self.nu_ref)


class _Spline(NamedTuple):
    """A cubic spline through `values` (knot, ...) at `knots`, with its slopes there."""

    knots: Float[Array, " knot"]
    values: Float[Array, "knot ..."]
    slopes: Float[Array, "knot ..."]

    def __call__(self, x: Scalar) -> Float[Array, "..."]:
        """Return the spline at one point; beyond the ends it is constant."""
        x = jnp.clip(x, self.knots[0], self.knots[-1])
        k = jnp.clip(jnp.searchsorted(self.knots, x, side="right") - 1, 0, len(self.knots) - 2)
        width = self.knots[k + 1] - self.knots[k]
        t = (x - self.knots[k]) / width
        low, high = self.values[k], self.values[k + 1]
        out, into = width * self.slopes[k], width * self.slopes[k + 1]
        # Hermite's cubic of an interval, in Bernstein form.
        near = (1 - t) ** 2 * ((1 + 2 * t) * low + t * out)
        return near + t**2 * ((3 - 2 * t) * high - (1 - t) * into)


def _spline(knots: Float[Array, " knot"], values: Float[Array, "knot ..."]) -> _Spline:
    """Return the cubic spline whose third derivative is continuous at the second and last but one.

    These "not-a-knot" conditions at the ends (de Boor 1978) are those of FITPACK, and so of PySM.
    Second derivatives that are continuous are a tridiagonal system for the slopes.
    """
    steps = jnp.diff(knots)
    rows = values.reshape(len(knots), -1)
    secants = jnp.diff(rows, axis=0) / steps[:, None]
    before, after = steps[:-1], steps[1:]
    inner = 3 * (after[:, None] * secants[:-1] + before[:, None] * secants[1:])

    def end(near: Array, next_: Array, first: Array, second: Array) -> tuple[Array, Array]:
        """Return the sum of the two steps at an end, and the right side of its equation."""
        both = near + next_
        return both, ((near + 2 * both) * next_ * first + near**2 * second) / both

    low, first = end(steps[0], steps[1], secants[0], secants[1])
    high, last = end(steps[-1], steps[-2], secants[-1], secants[-2])
    zero = jnp.zeros(1, steps.dtype)
    lower = jnp.concatenate([zero, after, high[None]])
    middle = jnp.concatenate([steps[1:2], 2 * (before + after), steps[-2:-1]])
    upper = jnp.concatenate([low[None], before, zero])
    right = jnp.concatenate([first[None], inner, last[None]])
    slopes = jax.lax.linalg.tridiagonal_solve(lower, middle, upper, right)
    return _Spline(knots, values, slopes.reshape(values.shape))


class HensleyDraine(Component, law="hd17"):
    """Dust of Hensley & Draine (2017): a tabulated intensity per hydrogen, of frequency and field.

    The intensity I_nu(nu, U) is interpolated by cubic splines in log10 of U, the strength of the
    radiation field, and in the wavelength, as in PySM's models d5, d7 and d8, and turned into
    antenna temperature, I_nu nu^-2. Beyond the table I_nu is that at its edge, but below 10 GHz the
    temperature is a power law of index 1.54. Tables of grains may be mixed by adding
    them up with weights. Intensity and polarization have tables of their own: two components, one
    with zeros in Q and U, one with zeros in I.

    Parameters
    ----------
    amplitude : template at nu_ref [uK_RJ], shape (stokes, pix)
    emissivity : table (1 + frequency, 1 + field): in its first row, from the second column, log10
        of U; in its first column, from the second row, frequencies [GHz]; both strictly increasing
        and at least four; elsewhere I_nu, in any unit of brightness. The corner has no meaning.
    log_U : log10 of the strength of the radiation field; 0.2 is about 20 K
    nu_ref : reference frequency [GHz]

    Raises
    ------
    TypeError, ValueError
        As for any `Component`, and for a table that is not as said above.
    """

    smooth: ClassVar[bool] = False

    amplitude: StokesMaps = template()
    emissivity: Float[Array, "row column 1"] = table(
        "intensities, with log10 U in its first row and frequencies [GHz] in its first column"
    )
    log_U: Parameter = parameter(0.2, symbol=r"\log_{10} U")
    nu_ref: Parameter = reference(353.0, within=(1.0, 2e4))

    def __check_init__(self) -> None:
        if self.emissivity is None:
            return  # the base class says so
        found = as_array("emissivity", self.emissivity)
        good = found.ndim == 3 and min(found.shape[:2]) > 4 and found.shape[2] == 1
        form = "be a table of at least 4 frequencies and 4 fields, each with its margin"
        check_shape("emissivity", found, good, form)
        check_positive("emissivity", found[1:, 0, 0])
        _check_increasing("emissivity", "frequencies in its first column", found[1:, 0, 0])
        _check_increasing("emissivity", "log10 U in its first row", found[0, 1:, 0])

    def sed(self, nu: Any):
        numbers = self.emissivity[..., 0]
        wavelengths = SPEED_OF_LIGHT / numbers[:0:-1, 0]
        of_wavelength = _spline(wavelengths, numbers[:0:-1, 1:])

        @jnp.vectorize
        def temperature(nu, log_U):
            above, below = jnp.maximum(nu, LOWEST), jnp.minimum(nu, LOWEST)
            intensity = _spline(numbers[0, 1:], of_wavelength(SPEED_OF_LIGHT / above))(log_U)
            return intensity / above**2 * (below / LOWEST) ** INDEX

        return temperature(nu, self.log_U) / temperature(self.nu_ref, self.log_U)
