"""What is said of bad input: one sentence that names it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from jaxsky.io import InputError


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
