"""The public surface: names imported on first use, and functions that refuse values with units.

JAX and numpy silently drop the unit of an astropy quantity. Importing this module, as the two
packages do before anything else, wraps every function and method whose name has no leading
underscore, as beartype and jaxtyping do: an argument with a unit is refused by name, and no
function can be forgotten.
"""

import ast
import functools
import importlib
import inspect
import sys
import tomllib
from collections.abc import Callable
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.resources import files
from types import ModuleType
from typing import Any, TypeVar

import jax
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

PACKAGES = ("jaxsky", "fits")
#: Types that never carry a unit; checked first, because that is quick.
PLAIN = frozenset({bool, int, float, str, type(None), np.ndarray, np.float64, np.int64})


def exported(package: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package, from its block for type checkers.

    The imports under `if TYPE_CHECKING:`, which Python skips, are made one name at a time.
    """
    module: Any = sys.modules[package]
    tree = ast.parse(module.__spec__.loader.get_source(package))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    places = {
        alias.name: line.module
        for line in block.body
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(str(places[name])), name)
        setattr(module, name, value)
        return value

    return sorted(places), get, lambda: sorted({*vars(module), *places})


@functools.cache
def packaged(name: str) -> dict[str, Any]:
    """Read a table that comes with the package, once."""
    return tomllib.loads((files("jaxsky") / name).read_text())


def refuse_unit(name: str, value: object) -> None:
    """Raise TypeError if a value, or an entry of a list or dict, carries a unit."""
    if type(value) in PLAIN or isinstance(value, jax.Array):
        return
    if isinstance(value, dict):
        for key, entry in value.items():
            refuse_unit(str(key), entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            refuse_unit(name, entry)
    # A number or an array from astropy, unyt or pint.
    elif any(hasattr(value, word) for word in ("__array__", "value", "magnitude")):
        unit = getattr(value, "unit", getattr(value, "units", None))
        if unit is not None:
            raise TypeError(
                f"Argument `{name}` carries the unit {unit}; jaxsky takes bare arrays. "
                "Convert it first, for example with jaxsky.io.from_quantity."
            )


def takes_quantities(function: F) -> F:
    """Mark a public function that converts or refuses quantities itself."""
    function.__dict__["takes_quantities"] = True
    return function


def _guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters if p.kind not in (p.KEYWORD_ONLY, p.VAR_KEYWORD)]

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        for i, value in enumerate(args):
            if type(value) not in PLAIN:
                refuse_unit(names[min(i, len(names) - 1)] if names else "", value)
        for name, value in kwargs.items():
            refuse_unit(name, value)
        return function(*args, **kwargs)

    return checked


def _guard(holder: ModuleType | type) -> None:
    """Guard the public functions that a module or class defines, constructors included."""
    of_module = isinstance(holder, ModuleType)
    for name, member in list(vars(holder).items()):
        public = not name.startswith("_") or name in ("__init__", "__call__")
        foreign = of_module and getattr(member, "__module__", None) != holder.__name__
        function = getattr(member, "__func__", member)
        if not public or foreign or not callable(function):
            continue
        if inspect.isclass(function):
            # Pydantic models of settings check types themselves.
            typed = issubclass(function, BaseException) or hasattr(function, "model_fields")
            if of_module and not typed:
                _guard(function)
        elif not hasattr(function, "takes_quantities"):
            guarded = _guarded(function)
            static = isinstance(member, classmethod | staticmethod)
            setattr(holder, name, type(member)(guarded) if static else guarded)


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        _guard(module)


class _Finder:
    """Finds modules of the packages as Python does, and guards them once executed."""

    @staticmethod
    def find_spec(name: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if name.partition(".")[0] not in PACKAGES:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and type(spec.loader) is SourceFileLoader:
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


sys.meta_path.insert(0, _Finder)
