"""Pixels shared out over devices, of one process or of several, and passes over them.

Maps are distributed over a mesh of devices with the axis "pix", and the types of arrays say so; a
pass over pixels is marked with `over_pixels`, and ends in sums over the devices. Arrays that are
not distributed pass through unchanged.
"""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Final, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from jaxsky.public import refuse_unit

#: Name of the axis of devices that share the pixels.
PIX: Final = "pix"
#: Pixels that are read at a time.
PIECE: Final = 1 << 18
#: Results of passes: sums over all pixels, and maps whose last axis are pixels.
SUMS: Final = PartitionSpec()
#: How many times more pixels than a CPU an accelerator takes at once.
WIDER = 64

Tree = TypeVar("Tree")


def maps_of(axes: int) -> PartitionSpec:
    """Return how arrays with this number of axes are distributed if the last one are pixels."""
    return PartitionSpec(*[None] * (axes - 1), PIX)


def pixel_mesh(devices: Any = None) -> Mesh:
    """Return the mesh of devices, by default all of all processes, with the axis "pix"."""
    every = np.array(jax.devices() if devices is None else devices)
    return Mesh(every.ravel(), (PIX,), axis_types=(AxisType.Explicit,))


def distribute(
    maps: Any,
    mesh: Mesh | None = None,
    *,
    shape: tuple[int, ...] | None = None,
    dtype: Any = float,
    fill: float | None = np.nan,
) -> Array:
    """Distribute maps over the devices of a mesh; each process supplies its own pixels only.

    Each device has the same number of pixels. If there are not enough, some are added at the end.
    So that they have no weight, they have to be infinite (`fill=np.inf`) in standard deviations.

    Parameters
    ----------
    maps : array (..., pix), or one on disk (`jaxsky.io.stacks`), or a function that returns the
        pixels of a slice, (..., pixels), to read or make no more than a process needs
    mesh : by default `pixel_mesh()`; ValueError if it has more devices than there are pixels
    shape, dtype : shape (..., pix) and type of all maps, if `maps` is a function
    fill : value of pixels that are added: NaN, which is refused wherever it would count; None for
        that of the last pixel, for maps of a sky and of labels

    Examples
    --------
    >>> distribute(np.ones((2, 48))).shape
    (2, 48)
    """
    refuse_unit("maps", maps)
    mesh = pixel_mesh() if mesh is None else mesh
    if callable(maps):
        if shape is None:
            raise TypeError("Argument `shape` is missing: `maps` is a function.")
        read: Callable[[slice], Any] = maps
    else:
        # What lies on disk is read in pieces.
        on_disk = hasattr(maps, "__array__") and not isinstance(maps, jax.Array)
        array = maps if on_disk else np.asarray(maps)
        shape, dtype, read = array.shape, array.dtype, lambda pixels: array[..., pixels]
    *rows, npix = shape
    if not np.issubdtype(dtype, np.floating):
        fill = None
    if mesh.size > npix:
        raise ValueError(
            f"Argument `mesh` has {mesh.size} devices for {npix} pixels; take one with fewer."
        )

    def part(start: int, stop: int) -> np.ndarray:
        """Return some pixels, padded."""
        found = np.asarray(read(slice(min(start, npix - 1), min(stop, npix))), dtype)
        last = found[..., -1:] if fill is None else np.full_like(found[..., -1:], fill)
        missing = max(0, stop - max(start, npix))
        kept = found if start < npix else found[..., :0]
        return np.concatenate([kept, np.repeat(last, missing, axis=-1)], -1) if missing else found

    def own(device: jax.Device, start: int, stop: int) -> Array:
        """Return the pixels of a device, read in pieces so that there are no two copies."""
        if stop - start <= PIECE:
            return jax.device_put(part(start, stop), device)
        pixels = jnp.zeros((*rows, stop - start), dtype, device=device)
        for first in range(start, stop, PIECE):
            first = min(first, stop - PIECE)
            # One after the other, or pieces that wait take as much memory again.
            pixels = _put(pixels, part(first, first + PIECE), first - start).block_until_ready()
        return pixels

    padded = (*rows, -(-npix // mesh.size) * mesh.size)
    sharding = NamedSharding(mesh, maps_of(len(padded)))
    places = sharding.addressable_devices_indices_map(padded)
    parts = [own(d, *index[-1].indices(padded[-1])[:2]) for d, index in places.items() if index]
    return jax.make_array_from_single_device_arrays(padded, sharding, parts)


@partial(jax.jit, donate_argnums=0)
def _put(pixels, piece, start):
    """Return maps with a piece in its place."""
    return jax.lax.dynamic_update_slice_in_dim(pixels, piece, start, axis=-1)


def _devices(value: Any) -> set[jax.Device]:
    """Return the devices that hold an array of JAX; none if it is traced, or anything else."""
    held = isinstance(value, jax.Array) and not isinstance(value, jax.core.Tracer)
    return value.sharding.device_set if held else set()


def spread(value: Any) -> bool:
    """Return whether an array lies on several devices, or is distributed over a mesh of one."""
    devices = _devices(value)
    return len(devices) > 1 or (len(devices) == 1 and mesh_of(value) is not None)


def on_accelerator(value: Any) -> bool:
    """Return whether an array lies on accelerators: looking at it on the host means a copy."""
    devices = _devices(value)
    return bool(devices) and all(device.platform != "cpu" for device in devices)


def at_once(few: int) -> int:
    """Return how many pixels a step of a pass takes: few, for the cache of a CPU, or many."""
    # An accelerator needs longer to begin a step than to compute a small one.
    return few if jax.default_backend() == "cpu" else WIDER * few


def in_place(data: Any, *others: Any) -> tuple[Any, ...]:
    """Return maps (..., band, stokes, pix) as distributed over the accelerator of the data."""
    # Nothing is copied, and nothing changed if the data lie elsewhere or are distributed already.
    if spread(data) or not on_accelerator(data):
        return data, *others
    mesh = pixel_mesh(list(data.devices()))
    return tuple(
        jax.device_put(one, NamedSharding(mesh, maps_of(one.ndim)))
        if on_accelerator(one) and one.ndim > 2
        else one
        for one in (data, *others)
    )


def module_of(array: Any) -> Any:
    """Return the module for the functions of an array, `numpy` or `jax.numpy`."""
    return jnp if isinstance(array, jax.Array) else np


def as_double(array: Any) -> Any:
    """Return an array in double precision, of numpy or of JAX as before."""
    return module_of(array).asarray(array, float)


def mesh_of(tree: Any) -> Any:
    """Return the mesh over which arrays are distributed by their types, None if none is."""
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, jax.Array):
            traced = isinstance(leaf, jax.core.Tracer)
            sharding: Any = jax.typeof(leaf).sharding if traced else leaf.sharding
            mesh = getattr(sharding, "mesh", None)
            if mesh is not None and PIX in mesh.explicit_axes:
                return mesh
    return None


def typed(tree: Tree) -> Tree:
    """Return arrays with what is distributed in their types, on any mesh, without a copy."""
    # While something is traced, XLA distributes the work.
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree)):
        return tree

    def one(leaf: Any) -> Any:
        sharding: Any = leaf.sharding if spread(leaf) and mesh_of(leaf) is None else None
        if not isinstance(sharding, NamedSharding):
            return leaf
        axes = tuple(sharding.spec)
        shared = bool(axes) and len(axes) == leaf.ndim and axes[-1] is not None
        mesh = pixel_mesh(sharding.mesh.devices)
        return jax.device_put(leaf, NamedSharding(mesh, maps_of(leaf.ndim) if shared else SUMS))

    return jax.tree.map(one, tree)


def along(data: Any, tree: Tree) -> Tree:
    """Return arrays with as many pixels as data, distributed like these if they are."""
    mesh = mesh_of(data)
    if mesh is None:
        return tree

    def one(leaf: Any) -> Any:
        alike = np.shape(leaf)[-1:] == data.shape[-1:] and not spread(leaf)
        return distribute(leaf, mesh) if alike else leaf

    return jax.tree.map(one, typed(tree))


def parts_of(maps: Array) -> list[np.ndarray]:
    """Return the pixels (..., pix) of each device of this process."""
    return [np.asarray(shard.data) for shard in maps.addressable_shards]


def from_parts(parts: Any, like: Array) -> Array:
    """Join arrays of the devices of this process, in the order of `parts_of(like)`, on axis 0."""
    mesh = mesh_of(like)
    sharding = NamedSharding(mesh, PartitionSpec(PIX))
    devices = [shard.device for shard in like.addressable_shards]
    shape = (mesh.size * len(parts[0]), *parts[0].shape[1:])
    placed = [jax.device_put(part, device) for part, device in zip(parts, devices, strict=True)]
    return jax.make_array_from_single_device_arrays(shape, sharding, placed)


def _inside() -> bool:
    """Return whether a pass over distributed pixels is being traced."""
    return PIX in jax.sharding.get_abstract_mesh().manual_axes


def total(value: Any) -> Any:
    """Return sums over the pixels of a device, summed over devices; to be used in a pass."""
    return jax.lax.psum(value, PIX) if _inside() else value


def extremes(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the least and greatest values of all devices; to be used in a pass."""
    return (jax.lax.pmin(low, PIX), jax.lax.pmax(high, PIX)) if _inside() else (low, high)


def of_own(value: Array) -> Array:
    """Return a parameter whose derivatives are those of a device's own pixels; for a pass."""
    return jax.lax.pcast(value, PIX, to="varying") if _inside() else value


def over_pixels(out: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Mark a function as a pass over pixels of its positional arguments, which may be distributed.

    Each device then runs it on its own pixels, and nothing is exchanged but what the function asks
    for by `total` and `extremes`. For other arrays, and inside of another pass, it is unchanged.
    `out` is `SUMS` or `maps_of(axes)`, for all results or for each of them.
    """

    def marked(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def passed(*args: Any, **options: Any) -> Any:
            mesh = None if _inside() else mesh_of(args)
            if mesh is None:
                return function(*args, **options)
            own = partial(function, **options)
            return jax.shard_map(own, mesh=mesh, out_specs=out)(*args)

        return passed

    return marked
