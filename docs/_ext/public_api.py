"""The public API: the modules that docs/api.md lists as public, their `__all__`, and the signatures of its names."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_origin

from pydantic import BaseModel

__all__ = ["internal_modules", "lines", "public_modules"]

PAGE = Path(__file__).resolve().parent.parent / "api.md"


def _listed(section: str) -> list[str]:
    """Return the modules in the table of a section of docs/api.md."""
    text = PAGE.read_text(encoding="utf-8").split(f"\n## {section}\n")[1].split("\n## ")[0]
    return re.findall(r"^\| `(flockenv[\w.]*)` \|", text, re.MULTILINE)


def public_modules() -> list[str]:
    """Return the names of the public modules."""
    return _listed("Public modules")


def internal_modules() -> list[str]:
    """Return the names of the packages that are internal, but for those of their modules that are public."""
    return _listed("Internal packages")


def lines() -> Iterator[str]:
    """Yield a line for each public name: module.name, and its parameters or its type."""
    for module in public_modules():
        home = importlib.import_module(module)
        for name in sorted(home.__all__):
            yield f"{module}.{name}{_form(getattr(home, name))}"


def _form(value: Any) -> str:
    """Return the fields of a record, the parameters of a function or class, or the type of another value."""
    if get_origin(value) is not None:
        return ": type"
    if inspect.isclass(value) and issubclass(value, BaseModel):
        return f"(*{''.join(_fields(value))})"
    if not (inspect.isclass(value) or inspect.isroutine(value) or hasattr(value, "py_func")):  # py_func: compiled
        return f": {type(value).__name__}"
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):  # a class of C
        return ""
    return f"({', '.join(_parameters(list(parameters)))})"


def _fields(model: type[BaseModel]) -> Iterator[str]:
    """Yield the fields of a record as parameters."""
    for name, field in model.model_fields.items():
        default = ... if field.default_factory is not None else field.default
        yield f", {name}" if field.is_required() else f", {name}={_short(default)}"


def _parameters(parameters: list[inspect.Parameter]) -> Iterator[str]:
    """Yield the parameters without their types: `*` before those by keyword, `=` with a default that is short."""
    starred = False
    for each in parameters:
        if each.kind is each.VAR_POSITIONAL:
            starred = True
        elif each.kind is each.KEYWORD_ONLY and not starred:
            starred = True
            yield "*"
        mark = "*" if each.kind is each.VAR_POSITIONAL else "**" if each.kind is each.VAR_KEYWORD else ""
        yield mark + each.name + ("" if each.default is each.empty else f"={_short(each.default)}")


def _short(value: Any) -> str:
    """Return a default if it is a number, a text or None; else `...`, as its text may differ between runs."""
    return repr(value) if value is None or isinstance(value, (bool, int, float, str)) else "..."
