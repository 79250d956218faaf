"""Checks of values in settings; ValueError with the words that follow the key."""

from collections.abc import Mapping
from typing import Any

from jaxsky.components import component_class, declared

__all__ = [
    "MistakeAt",
    "check_reference",
    "check_sign",
    "check_signs",
    "file_names",
    "hdu_numbers",
    "missing_numbers",
    "stokes_words",
]


class MistakeAt(ValueError):
    """A mistake at a key inside of the table that is checked."""

    def __init__(self, key: str, mistake: str | ValueError) -> None:
        self.key, self.words = key, str(mistake)
        if isinstance(mistake, MistakeAt):
            self.key, self.words = f"{key}.{mistake.key}", mistake.words
        super().__init__(f"{self.key}: {self.words}")


def check_reference(law: str, nu_ref: float | None, parameters: Mapping[str, Any]) -> None:
    """Raise ValueError for a reference frequency that is given twice, or not in GHz."""
    if nu_ref is not None and "nu_ref" in parameters:
        raise ValueError(
            f"nu_ref is given twice, {nu_ref:g} and in parameters; leave one of them out"
        )
    given = parameters.get("nu_ref", nu_ref)
    known = declared(component_class(law), "nu_ref")
    if given is not None and not known:
        raise ValueError(f"the law {law!r} has no nu_ref: its maps are in uK_CMB")
    if not isinstance(given, int | float) or known["within"] is None:
        return
    least, most = known["within"]
    if not least <= given <= most:
        raise ValueError(
            f"nu_ref is in GHz, for the law {law!r} from {least:g} to {most:g}, not {given:g}"
        )


def check_sign(name: str, *values: float) -> None:
    """Raise ValueError for an index beta_syn in the sign of T ~ nu^beta, by its dotted name."""
    negative = [value for value in values if value <= 0]
    if name.split(".")[-1] == "beta_syn" and negative:
        raise MistakeAt(
            name,
            "beta_syn is the index in T ~ nu^-beta_syn, positive and about 3, not "
            f"{negative[0]:g}; that of T ~ nu^beta has the other sign",
        )


def check_signs(table: str, values: Mapping[str, Any]) -> None:
    """`check_sign` of the numbers in a table of settings."""
    for name, value in values.items():
        numbers = value if isinstance(value, list) else [value]
        try:
            check_sign(name, *(x for x in numbers if isinstance(x, int | float)))
        except ValueError as error:
            raise MistakeAt(table, error) from None


def file_names(value: Any) -> Any:
    """The name of a file, or several."""
    names = value if isinstance(value, list | tuple) else [value]
    if not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"must be the name of a file, or a list of them, not {value!r}")
    return value


def hdu_numbers(value: Any) -> Any:
    """The number of an HDU, or several."""
    numbers = value if isinstance(value, list | tuple) else [value]
    whole = all(isinstance(n, int) and not isinstance(n, bool) and n >= 1 for n in numbers)
    if not numbers or not whole:
        raise ValueError(
            f"must be the number of an HDU, 1 or more, or a list of them, not {value!r}"
        )
    return value


def stokes_words(value: Any) -> Any:
    """What `jaxsky.io.read_maps` takes as `stokes`."""
    from jaxsky.io.columns import parse_stokes  # reading is slow to import

    parse_stokes(value if isinstance(value, str | list | tuple) else [value])
    return value


def missing_numbers(value: Any) -> Any:
    """What `jaxsky.io.read_maps` takes as `missing`."""
    from jaxsky.io.missing import parse_missing

    parse_missing([value] if not isinstance(value, list | tuple) else value)
    return value
