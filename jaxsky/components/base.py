"""The base class of sky components, its fields, and the registry of laws by name."""

import dataclasses
import importlib
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsky.arrays import STOKES, Map, Scalar, StokesMaps
from jaxsky.bandpass import Bandpass, Samples, average
from jaxsky.checks import (
    Parameter,
    Printed,
    as_array,
    check_finite,
    check_positive,
    check_shape,
    is_concrete,
    looked_at,
    shown,
)
from jaxsky.mesh import spread

#: Components by the name of their law, or "module:Class"; filled as classes are defined.
_LAWS: dict[str, type["Component"]] = {}


def template() -> Any:
    """Declare the field of a component for its amplitude, (stokes, pix)."""
    return eqx.field(converter=_converted)


def parameter(
    default: Any = dataclasses.MISSING,
    *,
    positive: bool = False,
    within: tuple[float, float] | None = None,
    hint: str = "",
    symbol: str = "",
    unit: str = "",
    zero: bool = True,
    kw_only: bool = False,
) -> Any:
    """Declare the field of a component for a spectral parameter: a number, or a map (pix,).

    Parameters
    ----------
    default : default value; without one, the parameter is required
    positive : refuse values that are not positive
    within, hint : refuse a number, or the median of a map, outside this range, with a hint
    symbol, unit : for figures and tables; by default the name (in TeX), and "" for a pure number
    zero : whether exact zeros in a map are data; if not, they are taken to mark missing values
    kw_only : whether it can be given by name only
    """
    refused = {"positive": positive, "within": within, "hint": hint}
    metadata = refused | {"symbol": symbol, "unit": unit, "zero": zero}
    return eqx.field(converter=_converted, metadata=metadata, default=default, kw_only=kw_only)


def reference(default: float, within: tuple[float, float]) -> Any:
    """Declare the field for the reference frequency of a law [GHz], within a range."""
    hint, symbol = "it has to be in GHz", r"\nu_{\rm ref}"
    return parameter(default, positive=True, within=within, hint=hint, symbol=symbol, unit="GHz")


def table(columns: str) -> Any:
    """Declare the field of a component for a table of numbers, (row, column), that its law uses.

    It is kept with a last axis of length 1, (row, column, 1), because maps of parameters have one
    axis and amplitudes two. Derivatives in its numbers are as for any parameter; fits do not vary
    it. `columns` says in words what it holds.
    """
    return eqx.field(converter=_tabulated, metadata={"table": columns}, default=None)


def _converted(value: Any) -> Any:
    """Convert to an array, or a tuple of them; leave anything else for the later check by name."""
    if value is None or isinstance(value, tuple):
        return value and tuple(map(_converted, value))
    try:
        return as_array("value", value)
    except TypeError:
        return value


def _tabulated(value: Any) -> Any:
    """Convert a table to (row, column, 1); leave anything else for the later check by name."""
    value = _converted(list(value) if isinstance(value, tuple) else value)
    return value[..., None] if getattr(value, "ndim", 0) == 2 else value


class Component(Printed, eqx.Module):
    """Base class of sky components: `template` (stokes, pix) times `sed(nu)`.

    Stokes parameters of the amplitude are I (1 row), Q, U (2 rows) or I, Q, U (3 rows), in uK_RJ at
    the component's reference frequency, HEALPix RING order, Galactic coordinates, COSMO sign of U.

    A subclass declares its fields with `template`, `parameter` and `table` (of numbers), and
    defines `sed`. By the name of its law, or as `law = "module:Class"`, it can be used in the
    settings of every command.

    Attributes
    ----------
    law : name of the law in settings, given in the class statement; by default "module:Class"
    polarized : whether there is anything in Q and U; if not, an amplitude has to be I, or I, Q, U
    smooth : whether the law is smooth in its parameters, so that band averages may be interpolated
        in maps of them (`jaxsky.interpolation`); not so for tables with kinks
    unit : unit of the amplitude
    amplitude_from : functions that make an amplitude of a map in another unit, by that unit as
        `jaxsky.io.unit_name` spells it: proportional to the map, their first argument; others
        are parameters of the law by name
    nu_ref_I : reference frequency [GHz] of the amplitude of I, if it is not `nu_ref`

    Raises
    ------
    TypeError, ValueError
        For quantities with units, wrong shapes, values that are not finite, and those outside a
        declared range, such as a beta_syn of the opposite sign or a nu_ref that is not in GHz.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from jaxsky import sed
    >>> class Steep(Component, law="steep"):
    ...     amplitude: Array = template()
    ...     beta: Array = parameter(2.0)
    ...     nu_ref: Array = reference(30.0, within=(0.1, 1e3))
    ...
    ...     def sed(self, nu):
    ...         return sed.power_law(nu, self.beta, self.nu_ref)
    >>> round(float(component_class("steep")(jnp.ones((2, 12))).sed(60.0)), 4)
    0.25
    """

    law: ClassVar[str] = ""
    polarized: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    unit: ClassVar[str] = "uK_RJ"
    amplitude_from: ClassVar[Mapping[str, Callable[..., Array]]] = {}

    amplitude: eqx.AbstractVar[StokesMaps]
    nu_ref_I: Parameter | None = parameter(
        None, positive=True, symbol=r"\nu_{{\rm ref}, I}", unit="GHz", kw_only=True
    )

    def __init_subclass__(cls, law: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.law = law or f"{cls.__module__}:{cls.__qualname__}"
        known = _LAWS.get(cls.law, cls)
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(f"Law {law!r} is that of {known.__module__}:{known.__qualname__}.")
        _LAWS[cls.law] = cls

    def sed(self, nu: ArrayLike) -> Scalar | Map:
        """Return the spectral law at one frequency [GHz]; a map if any parameter is a map."""
        raise ValueError(f"{type(self).__name__} must define `sed`.")

    def band_average(self, band: Bandpass | Samples) -> Float[Array, "..."]:
        """Return the law averaged over a band: a number, or a map if any parameter is a map.

        With an axis of bands in front if there are several (`jaxsky.bandpass.stack_bands`).
        """
        return average(self.sed, band)

    @property
    def template(self) -> StokesMaps:
        """The maps that the law multiplies: the amplitude, with I brought to `nu_ref`."""
        if self.nu_ref_I is None:
            return self.amplitude
        intensity = self.amplitude[:1] / self.sed(self.nu_ref_I)
        return jnp.concatenate([intensity, self.amplitude[1:]])

    def summary(self):
        stokes, npix = self.amplitude.shape
        maps = f"{', '.join(STOKES[stokes])} in {npix} pixels"
        if is_concrete(self.amplitude) and not spread(self.amplitude):
            rms = np.sqrt(np.mean(np.square(self.amplitude[-2:])))
            maps = f"{maps}, rms {rms:.4g} {self.unit}"
        rows = [("amplitude", maps)]
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if "table" in field.metadata:
                rows.append((field.name, "table of {} x {} numbers".format(*value.shape)))
            elif "positive" in field.metadata and value is not None:
                rows.append((field.name, shown(value, field.metadata["unit"])))
        return f"{type(self).__name__}, law {self.law!r}", rows

    def __check_init__(self) -> None:
        amplitude = as_array("amplitude", self.amplitude)
        good = amplitude.ndim == 2 and len(amplitude) in STOKES
        form = "have shape (stokes, pix) with Stokes I, or Q, U, or I, Q, U"
        check_shape("amplitude", amplitude, good, form)
        if self.nu_ref_I is not None:
            known = declared(type(self), "nu_ref")
            if len(amplitude) == 2 or not known:
                raise ValueError(
                    f"Argument `nu_ref_I` of {type(self).__name__} is for a law with nu_ref and an "
                    "amplitude with I."
                )
            check_value("nu_ref_I", as_array("nu_ref_I", self.nu_ref_I), known)
        if len(amplitude) == 2 and not self.polarized:
            raise ValueError(
                f"{type(self).__name__} is not polarized: it takes part in I, or I, Q, U only, and "
                "has no maps of Q and U."
            )
        check_finite("amplitude", amplitude)
        if not self.polarized and is_concrete(amplitude) and bool((amplitude[1:] != 0).any()):
            raise ValueError(f"{type(self).__name__} is not polarized: Q and U must be zero.")
        for field in dataclasses.fields(self):
            if field.name == "amplitude" or field.metadata.get("static"):
                continue
            value = getattr(self, field.name)
            if "table" in field.metadata:
                check_table(field.name, value, field.metadata["table"])
                continue
            for entry in value if isinstance(value, tuple) else (value,):
                if entry is None:
                    continue
                array, npix = as_array(field.name, entry), amplitude.shape[-1]
                form = f"be a number or a map of shape ({npix},)"
                check_shape(field.name, array, array.shape in ((), (npix,)), form)
                if "positive" not in field.metadata:
                    raise TypeError(
                        f"Field `{field.name}` must be declared with jaxsky.components.parameter."
                    )
                check_value(field.name, array, field.metadata)


def check_value(name: str, value: Array, metadata: Mapping[str, Any]) -> None:
    """Raise ValueError if a concrete value violates the declaration of its field (`declared`)."""
    (check_positive if metadata.get("positive") else check_finite)(name, value)
    within = metadata.get("within")
    if within is None or not is_concrete(value):
        return
    # A median of distributed pixels would gather them.
    kind = "mean" if spread(value) else "median"
    (low, high), middle = within, float(getattr(looked_at(value)[1], kind)(value))
    if not low <= middle <= high:
        what = "is" if value.ndim == 0 else f"its {kind} is"
        raise ValueError(
            f"Argument `{name}` must be from {low:g} to {high:g}, but {what} {middle:g}; "
            f"{metadata['hint']}."
        )


def check_table(name: str, value: Any, columns: str) -> None:
    """Raise TypeError or ValueError unless a value can be a table as `table` keeps it."""
    if value is None:
        raise ValueError(f"Argument `{name}` is missing: a table of {columns}.")
    array = as_array(name, value)
    good = array.ndim == 3 and array.shape[-1] == 1
    check_shape(name, array, good, f"be a table (row, column) of {columns}")
    check_finite(name, array)


def check_law(component: Component, nu: float = 100.0) -> None:
    """Raise ValueError unless a law gives a finite number, or a map of them, at `nu` [GHz]."""
    value, npix = np.asarray(component.sed(jnp.asarray(nu))), component.amplitude.shape[-1]
    law = f"the law {component.law!r} at {nu:g} GHz"
    if value.shape not in ((), (npix,)):
        raise ValueError(
            f"{law} is neither a number nor a map of {npix} pixels, but has shape {value.shape}"
        )
    if not np.isfinite(value).all():
        raise ValueError(f"{law} is not finite for these parameters")


def declared(component: type[Component], field: str) -> Mapping[str, Any]:
    """Return what a component declares about a field with `parameter`; empty if there is none."""
    return next((f.metadata for f in dataclasses.fields(component) if f.name == field), {})


def parameter_declaration(name: str) -> Mapping[str, Any]:
    """Return what the first law with a parameter of this name, dotted or not, declares about it."""
    found = (declared(component, name.split(".")[-1]) for component in _LAWS.values())
    return next((metadata for metadata in found if "symbol" in metadata), {})


def component_class(law: str) -> type[Component]:
    """Return the component class of a law, by name or as "module:Class" for a class of your own.

    Such a module is looked for in the current folder and on Python's path.
    """
    if ":" not in law:
        if law not in _LAWS:
            known = sorted(name for name in _LAWS if ":" not in name)
            raise ValueError(
                f"there is no law {law!r}; laws are {', '.join(known)}, or 'module:Class' for a "
                "class of your own"
            )
        return _LAWS[law]
    module, _, name = law.partition(":")
    sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module), name)
    except Exception as error:  # a module of the user may raise anything
        raise ValueError(f"{law!r} cannot be imported ({type(error).__name__}: {error})") from error
    finally:
        sys.path.pop(0)
    if not (isinstance(found, type) and issubclass(found, Component)):
        raise ValueError(f"{law!r} is not a subclass of jaxsky.Component")
    return found
