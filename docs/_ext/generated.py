"""Pages that are made from the code: settings, commands, names, and tables of what is packaged."""

import inspect
import json
import re
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx

import fits
import jaxsky
from fits.app import app as commands
from jaxsky.public import packaged
from jaxsky.pysm.presets import pysm_presets
from jaxsky.settings import Experiment


def _cell(value: object) -> str:
    """Return a value as code in a cell of a table."""
    text = " ".join(str(value).split()).replace("|", "\\|")
    return f"`{text}`" if text else ""


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table of Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _tables_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Find the classes of settings in a type."""
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in typing.get_args(annotation):
        yield from _tables_of(inner)


def _type(annotation: Any) -> str:
    """Return a type in the words of a settings file."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _type(inner[0])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_type(one) for one in inner if one is not type(None)))
    if origin is typing.Literal:
        return " or ".join(map(repr, inner))
    if origin in (list, tuple):
        return f"list of {_type(inner[0])}"
    if origin is dict:
        return f"table of {_type(inner[1])}"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    words = {str: "text", float: "number", int: "whole number", bool: "true or false"}
    return words.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _default(field: FieldInfo) -> str:
    """Return the default of a key; nothing where there is none, or where it is a table."""
    value = field.default
    if value is PydanticUndefined:
        return "(required)" if field.is_required() else ""
    if value is None or isinstance(value, BaseModel):
        return ""
    return _cell(json.dumps(value, ensure_ascii=False))  # as in TOML


def _limits(field: FieldInfo) -> str:
    """Return the limits that are declared with a key."""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    found = [
        f"{sign} {getattr(one, name)}"
        for one in field.metadata
        for name, sign in signs.items()
        if getattr(one, name, None) is not None
    ]
    return ", ".join(found)


def settings() -> str:
    """Return the page of all keys of the experiment file, from the schema itself."""
    found: dict[type[BaseModel], list[str]] = {Experiment: [""]}
    queue = [Experiment]
    parts = []
    while queue:
        model = queue.pop(0)
        fields = model.model_fields
        rows = []
        for key, field in fields.items():
            rows.append((f"`{key}`", _type(field.annotation), _limits(field), _default(field)))
        for annotation in _inner(model):
            for other in _tables_of(annotation):
                if other not in found:
                    found[other] = []
                    queue.append(other)
        name = "The file" if model is Experiment else model.__name__
        body = table(("key", "value", "limits", "default"), rows) if rows else ""
        parts.append(f"## {name}\n\n{_prose(model)}\n\n{body}")
    return "\n".join(parts)


def _inner(model: type[BaseModel]) -> list[Any]:
    """Return the types of a table's values, with those of keys that the user names."""
    extra = typing.get_type_hints(model).get("__pydantic_extra__")
    return [field.annotation for field in model.model_fields.values()] + ([extra] if extra else [])


def _prose(thing: Any) -> str:
    """Return a docstring without what Markdown would take as its own."""
    return re.sub(r"(?<!`)([|*<\[\]])", r"\\\1", inspect.getdoc(thing) or "")


def command_line() -> str:
    """Return the page of the commands, from the command line itself."""
    return "\n".join(_command(typer.main.get_command(commands), "jaxsky"))


def _command(command: Any, name: str) -> Iterator[str]:
    """Describe a command, and those below it."""
    rows = []
    for one in command.params:
        words = ", ".join(f"`{word}`" for word in (*one.opts, *one.secondary_opts))
        if one.param_type_name == "argument":
            words = f"`{one.metavar or one.name.upper()}`"
        rows.append((words, getattr(one, "help", None) or "", _shown(one.default)))
    yield f"## `{name}`\n\n{command.help or ''}\n"
    if rows:
        yield table(("argument or option", "what it does", "default"), rows)
    for word, below in sorted(getattr(command, "commands", {}).items()):
        yield from _command(below, f"{name} {word}")


def _shown(value: object) -> str:
    """Return the default of an option."""
    return "" if value in (None, False, "", ()) or callable(value) else _cell(value)


def instruments() -> str:
    """Return the page of instruments, of their packaged table."""
    parts = []
    for name, entry in packaged("instruments.toml").items():
        if not isinstance(entry, Mapping) or "bands" not in entry:
            continue
        rows = []
        for band in entry["bands"]:
            bandpass, noise = band.get("bandpass", {}), band.get("noise", {})
            unit = noise.get("unit", "uK_CMB")
            cells = (band["name"], bandpass.get("center"), bandpass.get("width"), band.get("fwhm"))
            level = f"{noise.get('level', '')} {unit} arcmin" if noise else ""
            rows.append((*("" if one is None else str(one) for one in cells), level))
        head = ("channel", "centre [GHz]", "width [GHz]", "FWHM [arcmin]", "noise of Q, U")
        parts.append(f"## {entry['title']}\n\n`{name}`\n\n{table(head, rows)}")
    return "\n".join(parts)


def products() -> str:
    """Return the page of official files that `jaxsky data` knows."""
    parts = []
    for name, entry in packaged("products.toml")["groups"].items():
        rows = [
            (f"`{file}`", about.get("what", ""), _cell(about.get("hash", "")[:19]))
            for file, about in entry["files"].items()
        ]
        head = ("file", "what", "hash begins")
        parts.append(f"## `{name}`\n\n{entry['title']}\n\n{table(head, rows)}")
    return "\n".join(parts)


def presets() -> str:
    """Return the page of PySM's presets: those that there are, and those refused."""
    entries = packaged("presets.toml")
    rows = []
    for name in pysm_presets():
        entry = entries[name]
        single = "model" in entry or "files" in entry
        parts = [entry] if single else [one for one in entry.values() if isinstance(one, Mapping)]
        laws = dict.fromkeys(part.get("law") or part.get("model") for part in parts)
        maps = dict.fromkeys(one for part in parts for one in part.get("maps", ()))
        rows.append((f"`{name}`", ", ".join(map(_cell, laws)), ", ".join(map(_cell, maps))))
    there = table(("preset", "law or model", "parameters that are maps"), rows)
    refused = [(f"`{name}`", f"it {why}") for name, why in entries["refused"].items()]
    return f"{there}\n## Not in jaxsky\n\n{table(('preset', 'why'), refused)}"


def names(package: types.ModuleType) -> str:
    """Return the page of a package's public names, in alphabetical order."""
    parts = []
    for name in sorted(package.__all__, key=str.lower):
        kind = "autoclass" if inspect.isclass(getattr(package, name)) else "autofunction"
        where = getattr(package, name).__module__
        option = "   :members:\n" if kind == "autoclass" else ""
        parts.append(f"## {name}\n\n```{{eval-rst}}\n.. {kind}:: {where}.{name}\n{option}```\n")
    return "\n".join(parts)


#: Files below docs/generated, and what makes them.
PAGES = {
    "settings": settings,
    "commands": command_line,
    "instruments": instruments,
    "products": products,
    "presets": presets,
    "jaxsky": lambda: names(jaxsky),
    "fits": lambda: names(fits),
}


def write(app: Sphinx) -> None:
    """Write all parts that pages include, and the notebooks, where they have changed."""
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    for name, make in PAGES.items():
        path, text = folder / f"{name}.txt", make()
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
    for notebook in (Path(app.srcdir).parent / "notebooks").glob("*.ipynb"):
        path, text = folder / notebook.name, notebook.read_text()
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


#: What is not meant as such in docstrings; a star before a blank is an item of a list.
MARKUP = re.compile(r"[|]|\*(?! )|(?<=\w)_(?!\w)")


def _plain(app, what, name, obj, options, lines: list[str]) -> None:
    """Escape what plain English in docstrings shares with markup: |b|, nu_, *."""
    for i, line in enumerate(lines):
        pieces = re.split(r"(`[^`]*`)", line)
        pieces[::2] = [
            re.sub(r"([|]|\*(?! ))|(?<=\w)(_)(?!\w)", r"\\\g<0>", one) for one in pieces[::2]
        ]
        if not line.lstrip().startswith((">>>", "...", ":", "..")):
            lines[i] = "".join(pieces)


def _described(app, what, name, obj, options, lines: list[str]) -> None:
    """Give what follows `name :` a line of its own: it describes the argument, and is no type."""
    named, found = False, list[str]()
    for i, line in enumerate(lines):
        if lines[i + 1 : i + 2] and set(lines[i + 1]) == {"-"}:
            named = line in ("Parameters", "Attributes", "Raises")
        key, colon, text = line.partition(" : ")
        split = named and colon and not line.startswith(" ")
        found += [key, f"    {text}"] if split else [line]
    lines[:] = found


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the parts before pages are read."""
    app.connect("builder-inited", write)
    app.connect("autodoc-process-docstring", _plain, priority=100)
    app.connect("autodoc-process-docstring", _described, priority=200)  # napoleon's is 500
    return {"parallel_read_safe": True, "parallel_write_safe": True}
