"""Arrays of maps that may be larger than memory: in scratch files, or computed when they are read.

Small arrays stay arrays of numpy. Both are read alike, `maps[..., pixels]`, range by range.
"""

import itertools
import mmap
import os
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxsky.io.files import check_guards, partial

#: Arrays of more bytes than this lie on disk.
LIMIT = 1 << 29
#: Pixels that are read or computed at once.
PIECE = 1 << 18

_number = itertools.count()
_place: list[Path] = []


@contextmanager
def scratch(folder: Path) -> Iterator[None]:
    """Put scratch files into a folder, and remove them at the end; else they are in $TMPDIR.

    Those of a process that is killed are removed when the next one works in the folder.
    """
    _place.append(folder)
    try:
        yield
    finally:
        _place.remove(folder)
        for path in folder.glob(partial("*.maps")):
            path.unlink(missing_ok=True)


def ranges(npix: int, size: int = PIECE) -> Iterator[slice]:
    """Yield slices that cover the pixels."""
    for start in range(0, npix, size):
        yield slice(start, min(start + size, npix))


def aligned(shape: tuple[int, ...], dtype: Any = float) -> np.ndarray:
    """Return an array to be filled, whose memory JAX can use as it is; see `loaded`."""
    size, edge = int(np.prod(shape)) * np.dtype(dtype).itemsize, 64
    memory = np.empty(size + edge, np.uint8)
    start = -memory.ctypes.data % edge
    return memory[start : start + size].view(dtype).reshape(shape)


def loaded(array: ArrayLike) -> Array:
    """Return an array of JAX, which may use the memory of one that is not changed any more."""
    return jax.device_put(array, may_alias=True)


class Stack:
    """Base class: an array (row ..., pix) of which any pixels can be read into memory."""

    def __init__(self, shape: tuple[int, ...], dtype: Any = float) -> None:
        self.shape, self.dtype = tuple(shape), np.dtype(dtype)
        self.ndim, self.size = len(self.shape), int(np.prod(self.shape))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        raise TypeError(f"{type(self).__name__} must define `__getitem__`.")

    def __jax_array__(self) -> Array:
        return loaded(self[...])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[...].astype(self.dtype if dtype is None else dtype, copy=False)


class Stored(Stack):
    """An array in a scratch file; what is read of it does not stay in memory.

    With `path`, the file is that of another process, which removes it.
    """

    def __init__(
        self, shape: tuple[int, ...], dtype: Any = float, path: Path | None = None
    ) -> None:
        super().__init__(shape, dtype)
        if path is not None:
            self.path = path
            self._open(os.O_RDWR)
            return
        check_guards()
        place = _place[-1] if _place else Path(tempfile.gettempdir())
        self.path = (place / partial(f"{next(_number)}.maps")).absolute()
        length = self.size * self.dtype.itemsize
        try:
            self._open(os.O_RDWR | os.O_CREAT | os.O_EXCL)
            # Reserved: a page without room on the disk would kill the process.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._file, 0, length)
            else:
                os.truncate(self._file, length)
        except OSError as error:
            self.path.unlink(missing_ok=True)
            raise OSError(
                f"{place}: has no room for {length / 1e9:.1f} GB of maps that do not fit into "
                f"memory ({error.strerror})."
            ) from error
        weakref.finalize(self, self.path.unlink, missing_ok=True)

    def _open(self, flags: int) -> None:
        self._file = os.open(self.path, flags, 0o600)
        weakref.finalize(self, os.close, self._file)

    def __reduce__(self) -> tuple[Any, ...]:
        return Stored, (self.shape, self.dtype, self.path)

    def _block(self, index: Any) -> tuple[int, tuple[int, ...]] | None:
        """Return the place and shape of what numbers choose on the first axes, else None."""
        rows = index if isinstance(index, tuple) else (index,)
        if len(rows) >= self.ndim or not all(isinstance(row, int | np.integer) for row in rows):
            return None
        sizes, shape = self.shape[: len(rows)], self.shape[len(rows) :]
        places = [range(size)[row] for row, size in zip(rows, sizes, strict=True)]
        first = int(np.ravel_multi_index(places, sizes))
        return first * int(np.prod(shape)) * self.dtype.itemsize, shape

    def _pieces(self, values: np.ndarray, place: int) -> Iterator[tuple[np.ndarray, int]]:
        """Yield pieces of a flat array that lies in the file from `place` on, and their places."""
        for part in ranges(values.size):
            yield values[part], place + part.start * self.dtype.itemsize

    @contextmanager
    def _mapped(self, access: int, scattered: bool = False) -> Iterator[np.ndarray]:
        # Mapped anew each time: pages count as memory of the process as long as they are mapped.
        # Whole rows are not mapped, but copied in pieces: both would be in memory at once.
        whole = mmap.mmap(self._file, self.size * self.dtype.itemsize, access=access)
        if scattered and hasattr(whole, "madvise"):
            whole.madvise(mmap.MADV_RANDOM)  # no pages around those that are read
        try:
            yield np.frombuffer(whole, self.dtype).reshape(self.shape)
        finally:
            with suppress(BufferError):
                whole.close()

    def __getitem__(self, index: Any) -> np.ndarray:
        if block := self._block(index):
            place, shape = block
            found = aligned(shape, self.dtype)
            for piece, start in self._pieces(found.reshape(-1), place):
                piece[:] = np.frombuffer(os.pread(self._file, piece.nbytes, start), self.dtype)
            return found
        last = index[-1] if isinstance(index, tuple) else index
        with self._mapped(mmap.ACCESS_READ, isinstance(last, np.ndarray)) as values:
            chosen = values[index]
            found = aligned(chosen.shape, chosen.dtype)
            found[...] = chosen
            del values, chosen
        return found

    def __setitem__(self, index: Any, value: ArrayLike) -> None:
        if block := self._block(index):
            place, shape = block
            given = np.broadcast_to(np.asarray(value, self.dtype), shape)
            for piece, start in self._pieces(np.ascontiguousarray(given).reshape(-1), place):
                if os.pwrite(self._file, piece.data, start) < piece.nbytes:
                    raise OSError(f"{self.path}: was not written in full; is the disk full?")
            return
        with self._mapped(mmap.ACCESS_WRITE) as values:
            values[index] = value
            del values


class Computed(Stack):
    """An array that is computed when it is read: `read` returns all rows of some pixels."""

    def __init__(
        self, shape: tuple[int, ...], read: Callable[[Any], np.ndarray], dtype: Any = float
    ) -> None:
        super().__init__(shape, dtype)
        self._read = read
        self._kept: Stored | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # For other processes it is written to a file.
        if self._kept is None:
            self._kept = filled(Stored(self.shape, self.dtype), self._read)
        return self._kept.__reduce__()

    def __getitem__(self, index: Any) -> np.ndarray:
        index = index if isinstance(index, tuple) else (index,)
        if len(index) > 1 and (index[0] is Ellipsis or len(index) == self.ndim):
            return self._read(index[-1])[(*index[:-1], slice(None))]
        rows = (*index, ..., slice(None)) if index != (...,) else (..., slice(None))
        parts = [self._read(part)[rows] for part in ranges(self.shape[-1])]
        return np.concatenate(parts, axis=-1)


#: An array that is read in pieces: of numpy or JAX, or a `Stack`.
Maps: TypeAlias = Any


def filled(array: Maps, read: Callable[[slice], np.ndarray]) -> Maps:
    """Fill an array with the pixels that `read` returns, range by range, and return it."""
    for part in ranges(array.shape[-1]):
        array[..., part] = read(part)
    return array


def is_large(shape: tuple[int, ...], dtype: Any = float, copies: int = 1) -> bool:
    """Return whether an array, of which there are several, lies on disk."""
    return int(np.prod(shape)) * np.dtype(dtype).itemsize * copies > LIMIT


def empty(shape: tuple[int, ...], dtype: Any = float, copies: int = 1) -> Maps:
    """Return an array to be filled, on disk if it, or all its `copies` together, are large."""
    large = is_large(shape, dtype, copies)
    return Stored(shape, dtype) if large else np.empty(shape, dtype)


def stored(array: Any, copies: int = 1) -> Any:
    """Return an array as it is, or on disk if it and its `copies` are large."""
    if isinstance(array, Stack) or not is_large(array.shape, array.dtype, copies):
        return array
    found = Stored(array.shape, array.dtype)
    found[...] = np.asarray(array)
    return found


def computed(
    shape: tuple[int, ...], read: Callable[[Any], np.ndarray], dtype: Any = float, copies: int = 1
) -> Maps:
    """Return an array whose pixels `read` returns; if it is large, they are computed when read."""
    if is_large(shape, dtype, copies):
        return Computed(shape, read, dtype)
    return filled(np.empty(shape, dtype), read)
