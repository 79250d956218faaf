"""How a run writes its numbers: with errors, as JSON, and with a log of its circumstances."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxsky.io import write_text
from jaxsky.settings import Experiment, circumstances


def _digits(size: float) -> int:
    """Digits behind the point with which a positive number has two in all; 4 for others."""
    usable = np.isfinite(size) and size > 0
    return max(0, 1 - int(np.floor(np.log10(size)))) if usable else 4


def two_digits(value: float) -> str:
    """A number in two significant digits, without an exponent."""
    return f"{value:.{_digits(value)}f}"


def with_error(value: float, error: float) -> str:
    """A value with its standard error, both to two digits of the error."""
    digits = _digits(error)
    return f"{value:.{digits}f} \u00b1 {error:.{digits}f}"


def with_errors(best: float, low: float, high: float) -> str:
    """A value with its interval as differences, to two digits of the smaller one.

    Without an interval the value alone, and nothing where there is no value.
    """
    if not np.isfinite([low, high]).all():
        return f"{best:.4f}" if np.isfinite(best) else ""
    digits = _digits(min(abs(high - best), abs(best - low)))
    return f"{best:.{digits}f} {low - best:+.{digits}f} {high - best:+.{digits}f}"


def probability(value: float) -> str:
    """A probability in two digits, or its order of magnitude."""
    if value < 1e-99:
        return "<1e-99"
    return f"{value:.2f}" if value >= 0.01 else f"{value:.0e}"


def _plain(value: Any) -> Any:
    """Arrays as lists, and numbers that are not finite as None: what JSON has."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_json(path: Path, results: dict[str, Any]) -> None:
    """Results of a run; arrays become lists, and what is not finite null."""
    write_text(path, json.dumps(_plain(results), indent=2, allow_nan=False) + "\n")


def write_log(path: Path, settings: Experiment, seconds: float) -> None:
    """When, where, how long, with which versions, settings and files a run was made."""
    said = settings.model_dump(mode="json", exclude_none=True)
    log = {**circumstances(settings), "seconds": round(seconds, 2), "settings": said}
    write_text(path, json.dumps(log, indent=2) + "\n")
