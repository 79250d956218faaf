"""Components by name: the paper's baseline and the PySM models that follow the same laws.

The amplitudes and parameter maps are the caller's, as arrays; the constants are in
`presets.toml`.
"""

import tomllib
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Any

from jaxtyping import Array, ArrayLike, Float

from jaxsky.checks import as_array
from jaxsky.components import Component, component_class
from jaxsky.sky import Sky


@cache
def _presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads((files("jaxsky") / "presets.toml").read_text())


def from_pysm_beta(beta: ArrayLike) -> Float[Array, "..."]:
    """beta_syn of this package, T ~ nu^-beta_syn, from PySM's T ~ nu^beta.

    Examples
    --------
    >>> float(from_pysm_beta(-3.0))
    3.0
    """
    return -as_array("beta", beta)


def preset_names() -> list[str]:
    """Names that `preset` takes.

    Examples
    --------
    >>> preset_names()
    ['baseline_dust', 'baseline_synchrotron', 'd0', 'd1', 's0', 's1', 's3']
    """
    return list(_presets())


def preset(name: str, amplitude: ArrayLike, **maps: ArrayLike) -> Component:
    """A component with the law and the constants of a preset.

    Parameters
    ----------
    name : one of `preset_names()`
    amplitude : template [uK_RJ] at the preset's reference frequency (353 GHz for dust, 23 GHz
        for PySM's synchrotron, 30 GHz for the paper's), shape (stokes, pix); PySM's I templates
        refer to other frequencies and have to be scaled first
    **maps : the parameters that are maps in this preset, shape (pix,) or numbers: `beta_dust`
        and `T_dust` [K] of d1, `beta_syn` of s1 and s3 (PySM's BETA_S has the other sign:
        `from_pysm_beta`)

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> dust = preset("d1", jnp.ones((2, 12)), beta_dust=jnp.full(12, 1.6), T_dust=20.0)
    >>> float(dust.nu_ref)
    353.0
    """
    presets = _presets()
    if name not in presets:
        raise KeyError(f"Unknown preset {name!r}; known are {', '.join(presets)}.")
    constants = dict(presets[name])
    component: Callable[..., Component] = component_class(constants.pop("law"))
    needed = constants.pop("maps", [])
    for key in needed:
        if key not in maps:
            raise TypeError(f"Preset {name!r} needs the map `{key}` as an argument.")
    for key in maps:
        if key not in needed:
            takes = ", ".join(f"`{k}`" for k in needed) or "no maps"
            raise TypeError(f"Preset {name!r} has no argument `{key}`; it takes {takes}.")
    if "pysm_beta" in constants:
        constants["beta_syn"] = from_pysm_beta(constants.pop("pysm_beta"))
    return component(amplitude, **constants, **maps)


def baseline(dust: ArrayLike, synchrotron: ArrayLike) -> Sky:
    """The paper's baseline sky: components "dust" and "synchrotron".

    Parameters
    ----------
    dust : template at 353 GHz [uK_RJ], shape (stokes, pix)
    synchrotron : template at 30 GHz [uK_RJ], shape (stokes, pix)
    """
    return Sky(
        {
            "dust": preset("baseline_dust", dust),
            "synchrotron": preset("baseline_synchrotron", synchrotron),
        }
    )
