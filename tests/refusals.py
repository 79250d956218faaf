"""What is said of bad input: one sentence that names it; and tables of such input."""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxsky.io import InputError

CASES = Path(__file__).with_name("cases")


def cases(table: str) -> Any:
    """The rows of a table of cases, "file/name".

    "None" stands for None, {ones = shape} and {full = [shape, value]} for arrays of numpy.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(entry) for entry in value]
        if isinstance(value, dict) and value.keys() <= {"ones", "full"} and value:
            return np.ones(value["ones"]) if "ones" in value else np.full(*value["full"])
        if isinstance(value, dict):
            return {key: plain(entry) for key, entry in value.items()}
        return None if value == "None" else value

    file, name = table.split("/")
    return plain(tomllib.loads((CASES / f"{file}.toml").read_text())[name])


@contextmanager
def refused(
    words: str, error: type[Exception] = InputError, file: Path | None = None
) -> Iterator[pytest.ExceptionInfo]:
    """An error of one sentence with this pattern in it; a file is left as it is."""
    before = file and file.read_bytes()
    with pytest.raises(error, match=words) as caught:
        yield caught
    said = str(caught.value)
    assert said.endswith("."), said
    assert "\n" not in said, said
    assert file is None or file.read_bytes() == before


def raises(error: type[Exception], words: str, call: Callable, *arguments, **options) -> None:
    """The call ends in an error with this pattern in it."""
    with pytest.raises(error, match=words):
        call(*arguments, **options)


def refuses(words: str, call: Callable, *arguments, **options) -> None:
    """The call ends in an error of one sentence with this pattern in it."""
    with refused(words):
        call(*arguments, **options)
