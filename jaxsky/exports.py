"""Names of a package that are imported when they are first asked for."""

import ast
import importlib
import sys
from collections.abc import Callable
from typing import Any


def exported(package: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """`__all__`, `__getattr__` and `__dir__` of a package, as its block for type checkers says.

    The imports under `if TYPE_CHECKING:`, which Python passes over, are made one name at a time.
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
