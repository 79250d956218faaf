"""Types of values in settings: numbers within their bounds, names, and lists of them."""

import re
from collections.abc import Collection, Iterable
from typing import Annotated, TypeVar

from pydantic import AfterValidator, Field, Strict

from jaxsky.components import component_class
from jaxsky.settings.values import MistakeAt

T = TypeVar("T")

#: Names are parts of file names and of columns in FITS files.
LONGEST = 40
#: What else is called by a name in results, columns, and parameters such as "calibration.44".
RESERVED = (
    "cmb", "noise", "total", "residual", "r", "a_lens", "calibration", "offset", "gain", "shift",
    "width", "angle", "center", "embedded",
)  # fmt: skip


def _power_of_two(value: int) -> int:
    if value & (value - 1):
        raise ValueError(f"nside must be a power of two, not {value}")
    return value


def _distinct(values: list[T]) -> list[T]:
    for i, value in enumerate(values):
        if value in values[:i]:
            raise ValueError(f"has {value!r} twice")
    return values


def _law(value: str) -> str:
    component_class(value)
    return value


def _name(value: str, characters: str, reserved: Collection[str] = ()) -> str:
    if value.lower() in reserved:
        raise ValueError(f"the name {value!r} has a meaning of its own in results; choose another")
    if len(value) > LONGEST:
        raise ValueError(f"a name has at most {LONGEST} characters, not {len(value)}: {value!r}")
    if not re.fullmatch(rf"[A-Za-z0-9_+][A-Za-z0-9_+{characters}-]*", value):
        others = f"_ + - {characters}".strip()
        raise ValueError(
            f"a name consists of letters, digits and {others}, and begins with a letter or digit, "
            f"unlike {value!r}"
        )
    return value


#: The largest leaves the tensors far above all else.
TensorRatio = Annotated[float, Field(ge=0, le=1000)]
Nside = Annotated[int, Field(gt=0, le=8192), AfterValidator(_power_of_two)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Word = Annotated[str, Field(min_length=1)]
#: A list without repetitions, and one that is not empty either.
Distinct = Annotated[list[T], AfterValidator(_distinct)]
Several = Annotated[list[T], Field(min_length=1), AfterValidator(_distinct)]
#: Two values; a list in TOML.
Pair = Annotated[tuple[T, T], Strict(False)]
#: The law of a component: a name, or "module:Class" (`jaxsky.components.component_class`).
Law = Annotated[str, AfterValidator(_law)]
BandName = Annotated[str, AfterValidator(lambda value: _name(value, "."))]
RegionName = Annotated[str, AfterValidator(lambda value: _name(value, ""))]


def check_names(kind: str, names: Iterable[str]) -> None:
    """Raise ValueError if names are the same, or differ by capital letters only."""
    names = list(names)
    for known, more in ((set(names), ""), ({n.lower() for n in names}, " by more than capitals")):
        if len(known) < len(names):
            raise ValueError(
                f"the names of the {kind} must differ{more}, but are {', '.join(names)}"
            )


def check_component_names(names: Iterable[str]) -> None:
    """Raise MistakeAt its name if a component cannot be called so."""
    names = list(names)
    check_names("components", names)
    for name in names:
        try:
            _name(name, "", RESERVED)
        except ValueError as error:
            raise MistakeAt(name, error) from None
