"""Parameters of a sky by dotted name, such as "dust.beta_dust".

A sky is a tree of arrays, so the names are read off the tree: the component, the field and, for
fields that are tuples, the position ("dust.T_dust.1"). A name with ".offset" behind it stands for
a number added to that parameter, which is how a map is shifted as a whole.
"""

from collections.abc import Iterable, Mapping

import jax
from jaxtyping import Array, ArrayLike

from jaxsky.checks import as_array
from jaxsky.components import check_value
from jaxsky.sky import Sky

OFFSET = ".offset"


def _key_name(key: object) -> str:
    for attribute in ("key", "name", "idx"):
        if hasattr(key, attribute):
            return str(getattr(key, attribute))
    raise TypeError(f"A sky cannot hold {key!r}.")


def _flatten(sky: Sky) -> tuple[dict[str, Array], "jax.tree_util.PyTreeDef"]:
    paths, structure = jax.tree_util.tree_flatten_with_path(sky)
    return {".".join(map(_key_name, path[1:])): leaf for path, leaf in paths}, structure


def parameter_names(sky: Sky) -> tuple[str, ...]:
    """Names of all parameters of a sky, amplitudes among them."""
    return tuple(_flatten(sky)[0])


def unknown_parameter(name: str, known: Iterable[str]) -> KeyError:
    """The error that an unknown parameter name is answered with."""
    return KeyError(f"Unknown parameter {name!r}; known parameters are {', '.join(known)}.")


def get_parameters(sky: Sky, names: Iterable[str]) -> dict[str, Array]:
    """Values by name.

    Raises
    ------
    KeyError
        If a name is unknown; the message lists the known ones.
    """
    leaves, _ = _flatten(sky)
    for name in names:
        if name not in leaves:
            raise unknown_parameter(name, leaves)
    return {name: leaves[name] for name in names}


def check_parameter(sky: Sky, target: str, name: str, value: Array) -> None:
    """Raise ValueError if a concrete value, called `name`, is none that a parameter may have."""
    component, field = target.split(".")[:2]
    check_value(type(sky[component]), field, name, value)


def set_parameters(sky: Sky, params: Mapping[str, ArrayLike]) -> Sky:
    """A sky with some parameters replaced, or shifted for names that end in ".offset".

    Parameters
    ----------
    sky : the sky to start from, which stays as it is
    params : values by name: numbers, or maps of the sky's pixels

    Raises
    ------
    KeyError
        If a name is unknown; the message lists the known ones.
    ValueError
        If a value is neither a number nor a map of the sky's pixels (amplitudes: of their shape),
        is not finite, or none that the component takes.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from jaxsky import Dust
    >>> sky = Sky({"dust": Dust(jnp.ones((2, 12)), beta_dust=1.5)})
    >>> moved = set_parameters(sky, {"dust.beta_dust.offset": 0.25})
    >>> float(moved["dust"].beta_dust)
    1.75
    """
    leaves, structure = _flatten(sky)
    stokes, npix = sky.shape
    # Values first, then shifts, whatever the order of the dictionary.
    for name, value in sorted(params.items(), key=lambda item: item[0].endswith(OFFSET)):
        target = name.removesuffix(OFFSET)
        if target not in leaves:
            raise unknown_parameter(name, leaves)
        value = as_array(name, value)
        amplitude = target.endswith(".amplitude")
        if value.shape not in (((stokes, npix),) if amplitude else ((), (npix,))):
            wanted = f"shape {(stokes, npix)}" if amplitude else f"a number or of shape ({npix},)"
            raise ValueError(f"Parameter {name!r} must be {wanted}, but has shape {value.shape}.")
        leaves[target] = leaves[target] + value if name.endswith(OFFSET) else value
        check_parameter(sky, target, name, leaves[target])
    return jax.tree.unflatten(structure, list(leaves.values()))
