"""Double precision for all tests and slow checks, and the real sky data where it is to be had."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from jaxsky.programs import forget_programs, keep_programs
from jaxsky.workers import processors

jax.config.update("jax_enable_x64", True)
# What can be had again, of the tests and of the commands that they start.
CACHE = Path(__file__).parent / ".cache"
os.environ["JAXSKY_CACHE"] = str(CACHE)
keep_programs(CACHE / "programs")

#: Tests run many small programs, which take longer to compile than to run. Slow checks are compiled
#: as they are for users.
COMPILED_SOON = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
#: Of memory, from which on programs are forgotten; the programs of so many take about 0.4 GB.
MOST_PIECES = 2_500
DATA = Path(os.environ.get("JAXSKY_DATA", Path(__file__).parents[1] / "shared" / "data"))


def pytest_configure(config: pytest.Config) -> None:
    """Share out the processors, and compile tests without much optimisation, here and in commands.

    The processes of pytest-xdist start after this. With as many threads as processors in each, the
    threads of healpy take turns, and wait for each other in loops: twice the time of one thread.
    XLA keeps its threads, as one alone waits forever for a callback.
    """
    if getattr(config.option, "numprocesses", None):
        threads = max(1, processors() // len(config.option.tx))
        os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {COMPILED_SOON}"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All of the folder `validation` is slow."""
    for item in items:
        if "validation" in item.path.parts[-2:]:
            item.add_marker("slow")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder with the real sky maps and bandpasses; tests that need it are skipped without."""
    if not DATA.is_dir():
        pytest.skip(f"no sky data at {DATA} (set JAXSKY_DATA)")
    return DATA


def _pieces() -> int:
    """Pieces of memory that this process holds; many where the system does not say it."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return MOST_PIECES + 1


@pytest.fixture(scope="module", autouse=True)
def _programs() -> Iterator[None]:
    """Forget compiled programs at the end of a file, once they are many.

    Each holds pieces of memory that the system counts, 65530 for a process by default: all of
    them at once are more, which is a segmentation fault in the compiler.
    """
    yield
    if _pieces() > MOST_PIECES:
        forget_programs()
