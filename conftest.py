"""Double precision for all tests and slow checks, and the real sky data where it is to be had."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)

DATA = Path(os.environ.get("JAXSKY_DATA", Path(__file__).parents[1] / "shared" / "data"))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder with the real sky maps and bandpasses; tests that need it are skipped without."""
    if not DATA.is_dir():
        pytest.skip(f"no sky data at {DATA} (set JAXSKY_DATA)")
    return DATA
