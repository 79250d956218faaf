"""Bandpasses: weights over frequency, band averages of spectra, and brightness units.

Units are named by strings such as "uK_CMB", "mK_RJ", "MJy/sr", which are static under jit. Inside
the package everything is in uK_RJ.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.arrays import Scalar
from jaxsky.checks import (
    EXACT,
    Numeric,
    Printed,
    as_array,
    check_choice,
    check_finite,
    check_positive,
    is_concrete,
    shown,
)
from jaxsky.sed import cmb_derivative

#: convention -> factor that turns its weights into weights on antenna temperature
CONVENTIONS: dict[str, Callable[[Array], Array]] = {
    "RJ": jnp.ones_like,
    "power": lambda nu: (nu / nu[0]) ** 2,
    "CMB": lambda nu: 1 / cmb_derivative(nu),
}
#: Higher frequencies [GHz] are taken to be given in the wrong unit.
MAX_NU = 1e6


class Bandpass(Printed, eqx.Module):
    """The response of a detector as a function of frequency.

    A band observes the weighted mean of the antenna temperature, int W S dnu / int W dnu (the
    paper's eq. 8, by the trapezoid rule). Tables of W come in three conventions, which differ by
    a factor at each frequency: the response to unit antenna temperature ("RJ": the paper, Planck
    LFI), to unit power, Jy/sr ("power": WMAP, Planck HFI, PySM) or to unit thermodynamic
    temperature ("CMB").

    Parameters
    ----------
    nu : frequencies [GHz], shape (sample,), positive and strictly increasing, at most 1e6 GHz;
        one sample is a delta function
    weights : response, shape (sample,), any normalisation, with a positive integral
    convention : "RJ", "power" or "CMB"

    Raises
    ------
    TypeError, ValueError
        For arguments with a unit, and for those that are not as said above.

    Examples
    --------
    >>> band = Bandpass([28.0, 30.0, 32.0], [1.0, 2.0, 1.0])
    >>> round(float(band.center), 6)
    30.0
    """

    nu: Float[Array, " sample"]
    weights: Float[Array, " sample"]
    convention: str = eqx.field(static=True)

    def __init__(self, nu: ArrayLike, weights: ArrayLike, convention: str = "RJ") -> None:
        self.nu, self.weights = as_array("nu", nu), as_array("weights", weights)
        self.convention = convention
        check_choice("convention", convention, CONVENTIONS)
        if self.nu.ndim != 1 or self.nu.shape != self.weights.shape or not self.nu.size:
            raise ValueError(
                "Arguments `nu` and `weights` must have one shape (sample,), "
                f"but have shapes {self.nu.shape} and {self.weights.shape}."
            )
        check_positive("nu", self.nu)
        check_finite("weights", self.weights)
        if is_concrete(self.nu) and (highest := np.asarray(self.nu).max()) > MAX_NU:
            raise ValueError(f"Argument `nu` reaches {highest:g} GHz; it has to be in GHz, not Hz.")
        if is_concrete(self.nu) and not np.all(np.diff(self.nu) > 0):
            raise ValueError("Argument `nu` must increase strictly from sample to sample.")
        integrand = _integrand(self.nu, self.weights, convention)
        if is_concrete(integrand) and not np.asarray(integrand).sum() > 0:
            raise ValueError("Argument `weights` has an integral over `nu` that is not positive.")

    @classmethod
    def delta(cls, nu: ArrayLike) -> "Bandpass":
        """Return a monochromatic band at nu [GHz]."""
        nu = jnp.atleast_1d(as_array("nu", nu))
        return cls(nu, jnp.ones_like(nu))

    @classmethod
    def top_hat(
        cls, center: ArrayLike, width: ArrayLike, convention: str = "RJ", samples: int = 51
    ) -> "Bandpass":
        """Return a band of constant weight over center +- width/2 [GHz], differentiable in both."""
        center, width = as_array("center", center), as_array("width", width)
        check_positive("width", width)
        if samples < 2:
            raise ValueError(f"Argument `samples` must be at least 2, but is {samples}.")
        nu = _across(center, width, samples)
        return cls(nu, np.ones(samples, nu.dtype), convention)

    def summary(self):
        rows = [
            ("center", shown(self.center, "GHz")),
            ("from", shown(self.nu[0], "GHz")),
            ("to", shown(self.nu[-1], "GHz")),
            ("samples", str(self.nu.size)),
        ]
        return f"Bandpass, weights by the convention {self.convention!r}", rows

    @property
    @jax.jit
    def quadrature(self) -> Float[Array, " sample"]:
        """Weights w_k with sum 1, such that the band reads sum_k w_k T(nu_k) in K_RJ."""
        integrand = _integrand(self.nu, self.weights, self.convention)
        return integrand / integrand.sum()

    @property
    def center(self) -> Scalar:
        """Mean frequency with the weights on antenna temperature [GHz]."""
        return jnp.dot(self.quadrature, self.nu, precision=EXACT)

    def shifted(self, delta: ArrayLike) -> "Bandpass":
        """Return the band shifted by delta [GHz]; averages over it are normalised again."""
        return Bandpass(self.nu + delta, self.weights, self.convention)

    def stretched(self, factor: ArrayLike) -> "Bandpass":
        """Return the band widened by a factor about its center; averages are renormalised."""
        nu = self.center + factor * (self.nu - self.center)
        return Bandpass(nu, self.weights, self.convention)

    def conversion(
        self,
        source: str,
        target: str,
        nu_ref: Numeric | None = None,
        *,
        T_cmb: Numeric | None = None,
        flat: bool = False,
    ) -> Scalar:
        """Return the factor between brightness units in this band; see `band_conversion`.

        MJy/sr requires `nu_ref`, the frequency at which it is quoted [GHz]: published factors
        are for nominal frequencies, from which the center differs by a few percent. With `flat`,
        it is that of a spectrum of constant intensity, the same at any frequency. `T_cmb` [K] is
        the temperature of the CMB in K_CMB, by default `jaxsky.sed.T_CMB`.
        """
        kinds = parse_unit(source)[1], parse_unit(target)[1]
        if nu_ref is None and "MJy/sr" in kinds and not flat:
            raise ValueError("Over a band MJy/sr needs `nu_ref`, the frequency it is quoted at.")
        nu_ref = 1.0 if nu_ref is None else nu_ref
        return band_conversion(source, target, self.nu, self.quadrature, nu_ref, T_cmb, flat=flat)


# These pieces are compiled: outside jit every operation is a program of its own, and compiling
# those for the bands of a simulation would take longer than making its maps.


@partial(jax.jit, static_argnames="samples")
def _across(center: Array, width: Array, samples: int) -> Float[Array, " sample"]:
    return center + width * jnp.linspace(-0.5, 0.5, samples)


@partial(jax.jit, static_argnames="convention")
def _integrand(
    nu: Float[Array, " sample"], weights: Float[Array, " sample"], convention: str
) -> Float[Array, " sample"]:
    """Return the weights on antenna temperature times the steps of the trapezoid rule."""
    weights = weights * CONVENTIONS[convention](nu)
    return weights if nu.size == 1 else weights * _spans(nu) / 2


def _spans(nu: Float[Array, " sample"]) -> Float[Array, " sample"]:
    """Return the distance from the sample before to that behind each one [GHz]."""
    steps = jnp.diff(nu)
    ends = jnp.zeros(1, steps.dtype)
    return jnp.concatenate([ends, steps]) + jnp.concatenate([steps, ends])


class Samples(NamedTuple):
    """Frequencies [GHz] of one or several bands, and weights with sum 1, to average spectra."""

    nu: Float[Array, "... sample"]
    quadrature: Float[Array, "... sample"]


@jax.jit
def stack_bands(bands: Sequence[Bandpass]) -> Samples:
    """Return bands as tables with one row each, for `jax.vmap`, padded by samples of weight 0."""
    longest = max(band.nu.size for band in bands)
    missing = [(0, longest - band.nu.size) for band in bands]
    arrays = [(band.nu, band.quadrature) for band in bands]
    # Of many bands, thousands of small programs would be run.
    array = np if all(is_concrete(leaf) for leaf in jax.tree.leaves(arrays)) else jnp
    nu = [array.pad(own, n, mode="edge") for (own, _), n in zip(arrays, missing, strict=True)]
    weights = [array.pad(own, n) for (_, own), n in zip(arrays, missing, strict=True)]
    return Samples(jnp.asarray(array.stack(nu)), jnp.asarray(array.stack(weights)))


def average(sed: Callable[[Array], Array], band: Bandpass | Samples) -> Float[Array, "..."]:
    """Return the band average sum_k w_k S(nu_k) of a spectrum, by direct summation.

    `sed` is a function of one frequency [GHz] that returns a number or a map; the result has the
    same shape, with an axis of bands in front if there are several (`stack_bands`). Maps are summed
    one sample at a time, so that memory does not grow with the number of samples; gradients
    recompute the maps instead of storing them.
    """
    if band.nu.ndim > 1:
        return jax.vmap(partial(average, sed))(band)
    shape = jax.eval_shape(sed, band.nu[0]).shape
    if shape == ():
        return jnp.dot(band.quadrature, jax.vmap(sed)(band.nu), precision=EXACT)

    @jax.checkpoint
    def add(total, sample):
        nu, weight = sample
        return total + weight * sed(nu), None

    first = band.quadrature[0] * sed(band.nu[0])
    return jax.lax.scan(add, first, (band.nu[1:], band.quadrature[1:]))[0]


def response_at(nu: Numeric, band: Bandpass | Samples) -> Float[Array, "..."]:
    """Return the response to antenna temperature per GHz at a frequency, W / int W dnu [1/GHz].

    Linear between the samples of a band, and zero outside; a single sample has no width and gives
    zero. With an axis of bands in front if there are several (`stack_bands`).
    """
    if band.nu.ndim > 1:
        return jax.vmap(partial(response_at, nu))(band)
    spans = _spans(band.nu)
    density = 2 * band.quadrature / jnp.where(spans > 0, spans, jnp.inf)
    # Samples that fill up a row of several bands lie on the last one, and have its value.
    density = jnp.where(spans > 0, density, density[jnp.sum(spans > 0) - 1])
    return jnp.interp(nu, band.nu, density, left=0.0, right=0.0)


# Brightness units.

#: Brightness of 1 K_RJ at 1 GHz, 2 k nu^2 / c^2 [MJy/sr].
MJYSR_PER_K_RJ_AT_1GHZ: Final = 2 * 1.380649e-23 * 1e18 / 299792458.0**2 * 1e20

_PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}
#: name -> (size in the unit of its kind, kind)
UNITS: dict[str, tuple[float, str]] = {
    f"{prefix}{kind}": (size, kind)
    for kind in ("K_RJ", "K_CMB")
    for prefix, size in _PREFIXES.items()
} | {"MJy/sr": (1.0, "MJy/sr"), "kJy/sr": (1e-3, "MJy/sr"), "Jy/sr": (1e-6, "MJy/sr")}


def parse_unit(unit: str) -> tuple[float, str]:
    """Return the size and kind ("K_RJ", "K_CMB" or "MJy/sr") of a unit, given its name."""
    try:
        return UNITS[unit]
    except KeyError:
        raise ValueError(f"Unknown unit {unit!r}; known units are {', '.join(UNITS)}.") from None


def conversion(
    source: str, target: str, nu: Numeric, T_cmb: Numeric | None = None
) -> Float[Array, "..."]:
    """Return the factor from one brightness unit to another at a frequency [GHz].

    K_CMB are those about the temperature `T_cmb` [K], by default `jaxsky.sed.T_CMB`; PySM has
    2.7255 K.
    """
    nu = jnp.asarray(nu)
    return band_conversion(source, target, nu[..., None], jnp.ones(1, nu.dtype), nu, T_cmb)


@partial(jax.jit, static_argnames=("source", "target", "flat"))
def band_conversion(
    source: str,
    target: str,
    nu: Float[Array, "... sample"],
    weights: Float[Array, " sample"],
    nu_ref: Numeric,
    T_cmb: Numeric | None = None,
    *,
    flat: bool = False,
) -> Float[Array, "..."]:
    """Return the factor from one brightness unit to another over a band.

    A band reports the weighted mean of the antenna temperature, so 1 K_CMB reads sum w g(nu)
    K_RJ, where g is `cmb_derivative` at `T_cmb` [K]. A value in MJy/sr is the intensity at `nu_ref`
    [GHz] of a spectrum I ~ 1/nu (the IRAS convention, which Planck HFI follows: Planck 2013 results
    IX), or if `flat` that of a spectrum of constant intensity, where `nu_ref` has no effect (PySM's
    `bandpass_unit_conversion`, with T_cmb = 2.7255 K).
    The weights act on antenna temperature and have sum 1 (`Bandpass.quadrature`).
    """
    (source_size, source_kind), (target_size, target_kind) = parse_unit(source), parse_unit(target)
    scale = source_size / target_size
    # Left out where it is not given: as a number in the program it rounds otherwise.
    temperature = () if T_cmb is None else (T_cmb,)
    if source_kind == target_kind:
        return jnp.asarray(scale)

    def K_RJ_per(kind: str) -> Any:
        if kind == "K_RJ":
            return 1.0
        if kind == "K_CMB":
            return jnp.sum(weights * cmb_derivative(nu, *temperature), axis=-1)
        falling = 1.0 if flat else jnp.asarray(nu_ref)[..., None] / nu
        return jnp.sum(weights * falling / (MJYSR_PER_K_RJ_AT_1GHZ * nu**2), axis=-1)

    return scale * K_RJ_per(source_kind) / K_RJ_per(target_kind)
