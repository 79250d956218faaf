"""Keep compiled programs on disk through JAX's own cache, and define how progress is reported.

Compilation takes longer than the computations of most commands. Programs with a transform are not
kept, see `jaxsky.ducc`.
"""

import contextlib
import ctypes
import gc
import hashlib
import os
import platform
import shutil
from collections.abc import Iterable
from pathlib import Path

import jax
import jaxlib
from jax._src import compilation_cache, lru_cache


class Progress:
    """Receives progress reports; this base class ignores them."""

    def step(self, message: str) -> None:
        """Begin a step, which ends the one before."""

    def advance(self, done: int, of: int) -> None:
        """Report how much of the step is done."""


QUIET = Progress()

#: Parameters of glibc's mallopt: M_ARENA_MAX, M_MMAP_THRESHOLD.
MALLOC = {-8: 1, -3: 8 * 2**20}
#: Largest size of the cache [bytes], and number of (JAX version, processor) pairs in it.
LARGEST, KINDS = 2**30, 4


class _Cache(lru_cache.LRUCache):
    """JAX's cache with atomic writes."""

    def put(self, key: str, value: bytes) -> None:
        final = Path(self._path) / f"{key}-cache"
        part = final.with_name(f".partial-{os.getpid()}-{key}")
        try:
            part.write_bytes(value)
            part.replace(final)
        except OSError:  # for example a full disk: continue without caching
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)


def program_folder(folder: Path) -> Path:
    """Return the subfolder for programs of this version of JAX and this processor."""
    # The processor's features matter: a program compiled for one may not run on another.
    processor = f"{platform.machine()} {platform.processor()}"
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        said = [line for line in lines if line.startswith(("flags", "Features", "model"))]
        processor = "\n".join(dict.fromkeys(said))
    kind = hashlib.sha256(processor.encode()).hexdigest()[:12]
    return folder / f"{jax.__version__}-{jaxlib.__version__}-{kind}"


def keep_programs(folder: Path) -> None:
    """Keep compiled programs in a folder, and reuse those that are there.

    JAX's own settings take precedence: with $JAX_ENABLE_COMPILATION_CACHE=0 nothing is kept, and
    $JAX_COMPILATION_CACHE_DIR replaces the folder. Without write permission nothing is kept. The
    folder serves all versions and processors; its oldest programs are removed if it gets too large.
    """
    if not jax.config.jax_enable_compilation_cache:  # type: ignore[attr-defined]
        return
    if not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        own = program_folder(folder)
        try:
            own.mkdir(parents=True, exist_ok=True)
            own.touch()
            _prune(folder)
        except OSError:
            return
        jax.config.update("jax_compilation_cache_dir", str(own))
    compilation_cache.LRUCache = _Cache  # type: ignore[misc]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def forget_programs() -> None:
    """Forget all compiled programs of this process, and return their memory to the system."""
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # glibc only: free memory inside the heap
        ctypes.CDLL(None).malloc_trim(0)


def return_memory() -> None:
    """Make glibc return freed memory to the system."""
    # It gives each thread of JAX a heap that keeps freed memory, including maps of up to 32 MiB: a
    # third of all memory in use. So all threads share one, with large arrays outside it.
    with contextlib.suppress(OSError, AttributeError):  # other systems have other ways
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in MALLOC.items():
            mallopt(parameter, value)


def _prune(folder: Path) -> None:
    """Remove the oldest programs, and all programs of the least recently used kinds."""

    def newest_first(paths: Iterable[Path]) -> list[Path]:
        return sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True)

    kinds = newest_first(folder.iterdir())
    for kind in kinds[KINDS:]:
        shutil.rmtree(kind)
    size = 0
    for path in newest_first(path for kind in kinds[:KINDS] for path in kind.iterdir()):
        size += path.stat().st_size
        if size > LARGEST:
            path.unlink(missing_ok=True)
