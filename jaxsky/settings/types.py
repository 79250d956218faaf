"""Types of the values in settings, and checks that raise ValueError with a sentence about them."""

import re
import reprlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError

T = TypeVar("T")

#: Names are parts of file names and of columns in FITS files.
LONGEST = 40
#: First parts of free parameters that do not name a component, and the commands that know them.
WORDS = {
    "offset": ("fit",),
    **dict.fromkeys(("gain", "shift", "width", "angle"), ("fit", "separate")),
    **dict.fromkeys(("r", "A_lens", "EE", "BB"), ("forecast",)),
}
#: Names with a meaning of their own in results and columns.
RESERVED = ("cmb", "noise", "total", "residual", "center", "embedded", *map(str.lower, WORDS))
#: What is said of some kinds of pydantic's errors.
PLAINLY = {
    "extra_forbidden": "unknown key",
    "missing": "is missing",
    "string_too_short": "must not be empty",
}


class SettingsError(ValueError):
    """An error in the settings, as one sentence that names the file and the key."""


class MistakeAt(ValueError):
    """An error at a key inside the table that is being checked."""

    def __init__(self, key: str, mistake: str | ValueError) -> None:
        self.key, self.words = key, str(mistake)
        if isinstance(mistake, MistakeAt):
            self.key, self.words = f"{key}.{mistake.key}", mistake.words
        super().__init__(f"{self.key}: {self.words}")


class SettingsTable(BaseModel):
    """A table of settings: its fields are the allowed keys, with values of their types.

    A number in quotes, a boolean in place of a number and an empty string are errors.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, str_min_length=1)

    def changed(self, keys: Iterable[str]) -> list[str]:
        """Return those of `keys` whose value is not the default (logs contain defaults, too)."""
        fields = type(self).model_fields
        return [key for key in keys if getattr(self, key) != fields[key].default]

    def one_of(self, what: str, kinds: Sequence[str]) -> None:
        """Raise ValueError unless exactly one of some keys is given."""
        if len(given := self.changed(kinds)) != 1:
            raise ValueError(
                f"give the {what} as exactly one of {', '.join(kinds)}, "
                f"not {', '.join(given) or 'none'}"
            )


class NamedFile(str):
    """The name of a file, as opposed to other text; see `find_file`."""


def _power_of_two(value: int) -> None:
    if value & (value - 1):
        raise ValueError(f"nside must be a power of two, not {value}")


def _distinct(values: list[Any]) -> None:
    for i, value in enumerate(values):
        if value in values[:i]:
            raise ValueError(f"has {value!r} twice")


def _increasing(values: tuple[Any, Any]) -> None:
    if not values[0] < values[1]:
        raise ValueError(f"must increase, but is {values[0]}, {values[1]}")


def valid(check: Callable[[Any], object]) -> AfterValidator:
    """Make a validator of a function that raises ValueError for a bad value."""

    def kept(value: Any) -> Any:
        check(value)
        return value

    return AfterValidator(kept)


def check_name(value: str, characters: str = "", reserved: Collection[str] = ()) -> None:
    """Raise ValueError unless a name can be part of names of files and columns."""
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


Positive = Annotated[float, Field(gt=0)]
Nside = Annotated[int, Field(gt=0, le=8192), valid(_power_of_two)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
FileName = Annotated[str, AfterValidator(NamedFile)]
#: A list without repetitions, and one that is not empty either.
Distinct = Annotated[list[T], valid(_distinct)]
Several = Annotated[list[T], Field(min_length=1), valid(_distinct)]
#: Two values, a list in TOML, and two that increase.
Pair = Annotated[tuple[T, T], Strict(False)]
Interval = Annotated[tuple[T, T], Strict(False), valid(_increasing)]


def _key(raw: Any, place: Sequence[str | int], missing: bool) -> str:
    """Return the dotted key of an error; pydantic's location also contains types, dropped here."""
    keys = []
    for i, step in enumerate(place):
        if isinstance(raw, dict) and step in raw:
            keys.append(str(step))
            raw = raw[step]
        elif isinstance(raw, list) and isinstance(step, int):
            keys.append(str(step))
            raw = raw[step] if step < len(raw) else None
        elif missing and i == len(place) - 1:
            keys.append(str(step))
    return ".".join(keys)


def mistakes(raw: Any, error: ValidationError, assigned: Collection[str] = ()) -> str:
    """Return a sentence about all errors in the tables, with their keys, some given with --set."""
    wrong: dict[str, list[str]] = {}
    types: dict[str, list[str]] = {}
    inputs: dict[str, str] = {}
    for found in error.errors():
        what = found["msg"].removeprefix("Value error, ").rstrip(".")
        where = _key(raw, found["loc"], found["type"] == "missing")
        mistake, given = found.get("ctx", {}).get("error"), reprlib.repr(found["input"])
        if isinstance(mistake, MistakeAt):
            where = f"{where}.{mistake.key}" if where else mistake.key
            what = mistake.words.rstrip(".")
        elif found["type"] in PLAINLY:
            what = PLAINLY[found["type"]]
        elif found["type"].endswith(("_type", "literal_error")):
            wanted = what.removeprefix("Input should be ").partition(" or instance")[0]
            types.setdefault(where, []).append(wanted.replace("dictionary", "table"))
            inputs[where] = given
            continue
        elif found["msg"] == what:
            what = f"{what[0].lower()}{what[1:]}" + ("" if ", not " in what else f", not {given}")
        wrong.setdefault(where, []).append(what)
    # Where a value may have one of several types, a mismatch matters only if all of them fail.
    places = [*wrong, *types]
    for where, kinds in types.items():
        if where not in wrong and not any(place.startswith(f"{where}.") for place in places):
            wrong[where] = [f"input should be {' or '.join(kinds)}, not {inputs[where]}"]
    sentences = []
    for where, said in wrong.items():
        from_option = any(f"{where}.".startswith(f"{key}.") for key in assigned)
        remark = " (given with --set)" if from_option else ""
        sentences.append(": ".join(filter(None, (where, " or ".join(said)))) + remark)
    return "; ".join(sentences)


def check_names(kind: str, names: Iterable[str]) -> None:
    """Raise ValueError if names are the same, or differ by capital letters only."""
    names = list(names)
    for known, more in ((set(names), ""), ({n.lower() for n in names}, " by more than capitals")):
        if len(known) < len(names):
            raise ValueError(
                f"the names of the {kind} must differ{more}, but are {', '.join(names)}"
            )


def check_signs(values: Mapping[str, Any], table: str = "") -> None:
    """Raise ValueError for a beta_syn with the sign of T ~ nu^beta; names are dotted."""
    for name, value in values.items():
        if name.split(".")[-1] != "beta_syn":
            continue
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int | float) and number <= 0:
                raise MistakeAt(
                    f"{table}.{name}" if table else name,
                    "beta_syn is the index in T ~ nu^-beta_syn, positive and about 3, not "
                    f"{number:g}; that of T ~ nu^beta has the other sign",
                )
