"""Check arguments, with one sentence per error, and print values as text or HTML."""

import html
from collections.abc import Iterable, Sequence
from typing import Any, Final, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.mesh import on_accelerator, spread
from jaxsky.public import refuse_unit, takes_quantities

#: Arguments of the spectral laws: numbers or arrays that broadcast.
Numeric: TypeAlias = float | Array | np.ndarray
#: Precision of matrix products: GPUs round single-precision factors to 11 bits unless told not to.
EXACT: Final = "highest"
#: A spectral parameter: a number or a map; inside a component always an array.
Parameter: TypeAlias = Float[Array, ""] | Float[Array, " pix"] | float


def is_concrete(x: object) -> bool:
    """Return whether `x` has values that can be read now (it is not being traced)."""
    return not isinstance(x, jax.core.Tracer)


@takes_quantities
def as_array(name: str, value: object) -> Array:
    """Return `value` as a floating-point JAX array in native byte order."""
    refuse_unit(name, value)
    if isinstance(value, np.ndarray) and not value.dtype.isnative:
        value = value.astype(value.dtype.newbyteorder("="))
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise TypeError(
            f"Argument `{name}` must be a number or a numeric array, but is {type(value).__name__}."
        ) from None
    if jnp.iscomplexobj(array):
        raise TypeError(
            f"Argument `{name}` must be real, but is complex. (Coefficients of healpy are no maps: "
            "healpy.alm2map makes maps of them.)"
        )
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)


def listed(words: Iterable[str]) -> str:
    """Join words as in a sentence: "a, b and c"."""
    first = list(words)
    return " and ".join(filter(None, (", ".join(first[:-1]), *first[-1:])))


def check_type(what: str, value: object, kind: type, form: str) -> None:
    """Raise TypeError, stating what a value must be, unless it is of a kind."""
    if not isinstance(value, kind):
        raise TypeError(f"{what} must be {form}, but is {type(value).__name__}.")


def check_shape(name: str, array: Any, good: bool, form: str) -> None:
    """Raise ValueError, stating the form that an array must have, unless `good`."""
    if not good:
        raise ValueError(f"Argument `{name}` must {form}, but has shape {array.shape}.")


#: Values below this are HEALPix's mark for missing pixels, -1.6375e30.
UNSEEN = -1.6e30


def looked_at(value: Any) -> tuple[Any, Any]:
    """Return numbers to look at, and the module for it; those on other devices stay there."""
    away = spread(value) or on_accelerator(value)
    return (value, jnp) if away else (np.asarray(value), np)


def check_finite(name: str, value: Array | np.ndarray) -> None:
    """Raise ValueError if a concrete array has NaN, infinite or UNSEEN values, and count them."""
    if not is_concrete(value):
        return
    numbers, xp = looked_at(value)
    if bad := int(xp.sum(~xp.isfinite(numbers) | (numbers < UNSEEN))):
        raise ValueError(
            f"Argument `{name}` has {bad} of {value.size} values that are not finite (or UNSEEN)."
        )


def check_positive(name: str, value: Array | np.ndarray) -> None:
    """Raise ValueError if a concrete array has values that are not finite and positive."""
    check_finite(name, value)
    if is_concrete(value) and not (looked_at(value)[0] > 0).all():
        raise ValueError(
            f"Argument `{name}` must be positive, but its smallest value is {float(value.min()):g}."
        )


def check_not_negative(name: str, value: Numeric) -> None:
    """Raise ValueError if a concrete number is negative or not finite; arrays are not looked at."""
    if is_concrete(value) and not np.ndim(value):
        check_finite(name, np.asarray(value))
        if (number := float(np.asarray(value))) < 0:
            raise ValueError(f"Argument `{name}` must not be negative, but is {number:g}.")


def check_nside(name: str, value: int) -> None:
    """Raise ValueError unless a resolution is a power of 2."""
    if int(value) != value or value < 1 or int(value).bit_count() != 1:
        raise ValueError(f"Argument `{name}` must be a power of 2, but is {value}.")


def check_names(name: str, value: object) -> None:
    """Raise TypeError if a string is given for a list of names: it would be split into letters."""
    if isinstance(value, str):
        raise TypeError(f"Argument `{name}` must be a list of names, not the string {value!r}.")


@takes_quantities
def as_number(name: str, value: object, positive: bool = False) -> Float[Array, ""]:
    """Return `value` as an array without axes, checked to be finite (and positive on request)."""
    number = as_array(name, value)
    check_shape(name, number, not number.shape, "be a number")
    (check_positive if positive else check_finite)(name, number)
    return number


def check_seed(name: str, value: object) -> None:
    """Raise TypeError if a seed is not an integer, ValueError unless it is from 0 to 2^32 - 1.

    Without double precision, JAX silently keeps only the lower 32 bits of other seeds.
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise TypeError(f"Argument `{name}` must be an int, but is {value!r}.")
    if not 0 <= value < 2**32:
        raise ValueError(f"Argument `{name}` must be from 0 to 2^32 - 1, but is {value}.")


def check_choice(name: str, value: object, known: Iterable[str]) -> None:
    """Raise ValueError unless an argument is one of the known words."""
    if value not in (words := tuple(known)):
        raise ValueError(f"Argument `{name}` must be one of {', '.join(words)}, not {value!r}.")


def check_double(what: str) -> None:
    """Raise RuntimeError if JAX is not in double precision, which `what` needs."""
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            f"{what} needs double precision; call jax.config.update('jax_enable_x64', True) first."
        )


#: A heading, and rows that all have the same number of cells.
Summary = tuple[str, Sequence[Sequence[str]]]


class Printed:
    """Base class of objects that print their `summary`; in notebooks as an HTML table."""

    def summary(self) -> Summary:
        """Return a heading and rows of cells."""
        raise TypeError(f"{type(self).__name__} must define `summary`.")

    def __str__(self) -> str:
        return as_text(self.summary())

    def _repr_html_(self) -> str:
        return as_html(self.summary())


def as_text(summary: Summary) -> str:
    """Format a summary as lines for a terminal."""
    heading, rows = summary
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join([heading, *(f"  {line}" for line in lines)])


def as_html(summary: Summary) -> str:
    """Format a summary as an HTML table for a notebook."""
    heading, rows = summary
    cells = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    return f"<b>{html.escape(heading)}</b><table>{body}</table>"


def shown(value: Any, unit: str = "") -> str:
    """Format a number, the range of a map, or a tuple of either, with the unit."""
    if isinstance(value, tuple):
        return ", ".join(shown(one, unit) for one in value)
    if not is_concrete(value):
        return f"unknown while JAX traces, shape {np.shape(value)}"
    if spread(value):
        return f"map over {len(value.sharding.device_set)} devices"
    if np.ndim(value):
        low, middle, high = np.percentile(value, [0, 50, 100])
        return f"map from {shown(low)} to {shown(high, unit)}, median {middle:.5g}"
    return f"{float(value):.5g} {unit}".rstrip()
