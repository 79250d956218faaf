"""Long work: its compiled programs, kept on disk by JAX's own cache, and what it says of itself.

Compilation takes longer than most commands compute. Programs with a transform are not kept, see
`jaxsky.harmonics.transforms`.
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
    """Told what is being done and how far it is; this one keeps it to itself."""

    def step(self, message: str) -> None:
        """Begin a step; the one before it is done."""

    def advance(self, done: int, of: int) -> None:
        """Say how much of the step is done."""


QUIET = Progress()


#: Most that is kept [bytes], and how many kinds of processor and versions of JAX it is kept for.
LARGEST, KINDS = 2**30, 4


class _Cache(lru_cache.LRUCache):
    """JAX's cache, with entries that appear complete or not at all."""

    def put(self, key: str, value: bytes) -> None:
        final = Path(self._path) / f"{key}-cache"
        part = final.with_name(f".partial-{os.getpid()}-{key}")
        try:
            part.write_bytes(value)
            part.replace(final)
        except OSError:  # a full disk: it is done without
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)


def program_folder(folder: Path) -> Path:
    """The folder for programs of this version of JAX and this processor, within another one."""
    # What the processor can do: a program for one may not run on another.
    processor = f"{platform.machine()} {platform.processor()}"
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        said = [line for line in lines if line.startswith(("flags", "Features", "model"))]
        processor = "\n".join(dict.fromkeys(said))
    kind = hashlib.sha256(processor.encode()).hexdigest()[:12]
    return folder / f"{jax.__version__}-{jaxlib.__version__}-{kind}"


def keep_programs(folder: Path) -> None:
    """Keep compiled programs in a folder, and take those that are there.

    JAX's own settings go first: with $JAX_ENABLE_COMPILATION_CACHE=0 nothing is kept, and with
    $JAX_COMPILATION_CACHE_DIR it is there. A folder that cannot be written is done without. It is
    that for all versions and processors; the oldest programs go when it is too large.
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
    """Forget all compiled programs of this process, and give their memory back to the system."""
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # of glibc: what lies between live pieces
        ctypes.CDLL(None).malloc_trim(0)


def _prune(folder: Path) -> None:
    """Remove the oldest programs, and all of the kinds that were not used for longest."""

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
