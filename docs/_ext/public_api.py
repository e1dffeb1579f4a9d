"""The public API: the modules that docs/api.md lists as public, their `__all__`, and the signatures of its names."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import io
import itertools
import re
import textwrap
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_origin

from pydantic import BaseModel

__all__ = [
    "defined_in",
    "description",
    "field_comments",
    "internal_modules",
    "is_value",
    "lines",
    "names_of",
    "public_modules",
    "type_of",
]

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


def is_value(value: Any) -> bool:
    """True for a constant or a type alias: what is neither a class nor a function."""
    compiled = hasattr(value, "py_func")
    return get_origin(value) is not None or not (inspect.isclass(value) or inspect.isroutine(value) or compiled)


def type_of(value: Any) -> str:
    """Return the name of the type of a constant; `type` for a type alias."""
    return "type" if get_origin(value) is not None else type(value).__name__


def defined_in(module: str, name: str) -> str:
    """Return the module that defines a name of a module, which may import it from there."""
    if module == "flockenv":  # it imports on first use, from the public module that has the same object
        value = getattr(importlib.import_module(module), name)
        homes = (each for each in public_modules() if each != module)
        found = [each for each in homes if getattr(importlib.import_module(each), name, None) is value]
        return defined_in(found[0], name) if found else module
    for node in _statements(_tree(module)):
        if isinstance(node, ast.ImportFrom) and any((each.asname or each.name) == name for each in node.names):
            return defined_in(str(node.module), name)
    return module


def description(module: str, name: str) -> str:
    """Return the docstring of a public name: of a constant or type alias, the text below its assignment; else ''."""
    value = getattr(importlib.import_module(module), name)
    if not is_value(value):
        return inspect.getdoc(value) or ""
    for node, after in itertools.pairwise(_statements(_tree(defined_in(module, name)))):
        if name in _targets(node) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return inspect.cleandoc(str(after.value.value))
    return ""


def field_comments(thing: type) -> dict[str, str]:
    """Return the comments of a class's fields, by name: text and unit, those of the base classes first."""
    found: dict[str, str] = {}
    for each in reversed([base for base in thing.__mro__ if base.__module__.startswith("flockenv")]):
        text = textwrap.dedent(inspect.getsource(each))
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        comments = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
        for node in getattr(ast.parse(text).body[0], "body", ()):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.end_lineno in comments:
                found[node.target.id] = comments[node.end_lineno]
    return found


def names_of(module: str) -> set[str]:
    """Return the names that a module defines or assigns, also under `if`; not those that it imports."""
    nodes = [*_statements(_tree(module))]
    defined = {each.name for each in nodes if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)}
    return defined.union(*map(_targets, nodes))


@functools.cache
def _tree(module: str) -> ast.Module:
    return ast.parse(inspect.getsource(importlib.import_module(module)))


def _statements(block: ast.Module | ast.If) -> Iterator[ast.stmt]:
    """Yield the statements of a module, also those under `if` and `else`."""
    for node in (*block.body, *getattr(block, "orelse", ())):
        yield node
        if isinstance(node, ast.If):
            yield from _statements(node)


def _targets(node: ast.stmt) -> set[str]:
    """Return the names that a statement assigns."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}


def _form(value: Any) -> str:
    """Return the fields of a record, the parameters of a function or class, or the type of another value."""
    if is_value(value):
        return f": {type_of(value)}"
    if inspect.isclass(value) and issubclass(value, BaseModel):
        return f"(*{''.join(_fields(value))})"
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
