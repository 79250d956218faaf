"""Errors that values of settings lead to: named with their key, and with the file."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxsky.io import InputError
from jaxsky.settings.files import SettingsError


@contextmanager
def at_key(name: str) -> Iterator[None]:
    """Have an error of the numerics name the key of the value that led to it."""
    try:
        yield
    except (InputError, SettingsError):
        raise
    except (ValueError, TypeError, KeyError, ArithmeticError) as error:
        message = str(error.args[0] if isinstance(error, KeyError) else error)
        if (unknown := re.search(r"unexpected keyword argument ('\w+')", message)) is not None:
            message = f"there is no parameter {unknown[1]}"
        raise SettingsError(f"{name}: {message.rstrip('.')}.") from error


@contextmanager
def of_file(path: Path) -> Iterator[None]:
    """Have errors about settings name their file."""
    try:
        yield
    except SettingsError as error:
        if str(error).startswith(f"{path}: "):
            raise
        raise SettingsError(f"{path}: {error}") from error
