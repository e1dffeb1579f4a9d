"""The public API: docs/api.md names its modules, tests/public_api.txt its names with their parameters.

If a change is intended, `python -m tests.test_public_api` writes the list anew; tell users in CHANGELOG.md.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

import flockenv
from docs._ext.public_api import (
    description,
    field_comments,
    internal_modules,
    is_value,
    lines,
    names_of,
    public_modules,
    type_of,
)

ROOT = Path(__file__).resolve().parent.parent
LIST = Path(__file__).with_name("public_api.txt")


def test_the_public_api_is_that_of_the_list() -> None:
    """If this fails, see the docstring of this file."""
    listed, found = LIST.read_text(encoding="utf-8").splitlines(), list(lines())
    assert {"gone": sorted({*listed} - {*found}), "new": sorted({*found} - {*listed})} == {"gone": [], "new": []}
    assert found == listed


def test_every_package_is_public_or_internal() -> None:
    """A package without names of its own may have public modules; its others are then internal, as the page says."""
    public, internal = public_modules(), internal_modules()
    packages = [each.name for each in pkgutil.walk_packages(flockenv.__path__, "flockenv.") if each.ispkg]
    assert {*packages} >= {"flockenv.scene", "flockenv.engine"}
    for name in packages:
        inside = any(name == each or name.startswith(f"{each}.") for each in internal)
        parts = any(each.startswith(f"{name}.") for each in public)
        has_names = bool(getattr(importlib.import_module(name), "__all__", ()))
        assert (name in public) != inside or (parts and not has_names), f"{name}: docs/api.md does not list it"


def test_every_public_name_has_a_description() -> None:
    """A docstring; of a constant or type alias, the text below its assignment."""
    names = [(module, name) for module in public_modules() for name in importlib.import_module(module).__all__]
    assert [f"{module}.{name}" for module, name in names if not description(module, name)] == []
    assert description("flockenv.evaluation", "TUNING").startswith("First world seeds")  # assigned beside another name
    assert description("flockenv.scene", "AnyEffect").startswith("An effect")  # under `else`


def own_parameters(function: Callable[..., Any]) -> list[str]:
    """Return the names of the parameters; none of a class of C, which has no signature."""
    try:
        names = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return []
    return [name for name in names if name not in ("self", "cls") and not name.startswith("_")]


def plain(value: Any) -> Any:
    """Return a function as it is written in Python: without a decorator of classes or of numba."""
    value = getattr(value, "__func__", value)
    return getattr(value, "py_func", value)


def bases(home: type) -> list[type]:
    """Return a class of flockenv and its base classes of flockenv."""
    return [each for each in home.__mro__ if each.__module__.startswith("flockenv")]


def text_of_method(home: type, name: str) -> str:
    """Return the docstrings of a method in a class and its bases.

    If a base only declares it, the text below that declaration and the docstring of its module belong to it: the forms
    of laws are described there.
    """
    texts = []
    for each in bases(home):
        if name in vars(each):
            texts.append(inspect.getdoc(plain(vars(each)[name])))
        if name in vars(each).get("__annotations__", {}):
            texts += [inspect.getdoc(inspect.getmodule(each)), below_declaration(each, name)]
    return "\n".join(filter(None, texts))


def below_declaration(home: type, name: str) -> str:
    """Return the string below `name: type` in a class; "" if there is none."""
    found = re.search(rf'^    {name}: [^\n]*\n    """(.*?)"""', inspect.getsource(home), re.DOTALL | re.MULTILINE)
    return found[1] if found else ""


def text_of_class(home: type) -> str:
    """Return the docstrings of a class and its constructor, also of its bases, and its fields with a text."""
    texts = [text for each in bases(home) for text in (each.__doc__, vars(each).get("__init__", each).__doc__)]
    fields = [name for each in bases(home) for name in vars(each).get("__annotations__", {})]
    described = [name for name in fields if any(below_declaration(each, name) for each in bases(home))]
    return " ".join([*filter(None, texts), *field_comments(home), *described])


def described_parameters() -> Iterator[tuple[str, list[str], str]]:
    """Yield the name, the parameters and the text of each public function, method and constructor.

    Without constructors of records, whose fields have descriptions, and of protocols.
    """
    for module in public_modules():
        for name in importlib.import_module(module).__all__:
            value = getattr(importlib.import_module(module), name)
            if is_value(value):
                continue
            if not inspect.isclass(value):
                yield f"{module}.{name}", own_parameters(plain(value)), inspect.getdoc(plain(value)) or ""
                continue
            if not issubclass(value, BaseModel) and not getattr(value, "_is_protocol", False):
                yield f"{module}.{name}", own_parameters(value), text_of_class(value)
            for method, function in vars(value).items():
                if not method.startswith("_") and inspect.isfunction(plain(function)):
                    yield f"{module}.{name}.{method}", own_parameters(plain(function)), text_of_method(value, method)


def test_every_parameter_is_named_in_a_description() -> None:
    """In the docstring of the function, method or class, of the same method of a base, or in the text of a field."""
    found = [*described_parameters()]
    missing = {
        name: left for name, all_, text in found if (left := [n for n in all_ if not re.search(rf"\b{n}\b", text)])
    }
    assert missing == {}
    assert {"flockenv.steering.seek", "flockenv.scene.Scene.start", "flockenv.evaluation.Interval"} <= {
        name for name, all_, _ in found if all_
    }


def imported_in(text: str) -> Iterator[tuple[str, str]]:
    """Yield the module and name of each import from flockenv."""
    for module, block, line in re.findall(r"from (flockenv[\w.]*) import (?:\(([^)]*)\)|([^\n]*))", text):
        names = re.sub(r"#.*", "", block or line).split(",")
        yield from ((module, name.split(" as ")[0].strip()) for name in names if name.strip())


def named_in(text: str) -> Iterator[tuple[str, str]]:
    """Yield the module and name of each import from flockenv in a page, and of each dotted name of flockenv."""
    yield from imported_in(text)
    for dotted in re.findall(r"\bflockenv(?:\.[A-Za-z_]\w*)+", text):
        module = max((each for each in modules() if f"{dotted}.".startswith(f"{each}.")), key=len)
        if dotted != module:
            yield module, dotted.removeprefix(f"{module}.").split(".")[0]


@functools.cache
def modules() -> frozenset[str]:
    return frozenset(["flockenv", *(each.name for each in pkgutil.walk_packages(flockenv.__path__, "flockenv."))])


def is_public(module: str, name: str) -> bool:
    """True for a public name, and for a module that is public."""
    return f"{module}.{name}" in public_modules() or (
        module in public_modules() and name in importlib.import_module(module).__all__
    )


def test_pages_name_public_names_only() -> None:
    pages = [*ROOT.glob("[!C]*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")]
    found = {(page.name, *each) for page in pages for each in named_in(page.read_text(encoding="utf-8"))}
    assert sorted(each for each in found if not is_public(*each[1:])) == []
    assert ("README.md", "flockenv.players", "load_player") in found
    assert ("numerics.md", "flockenv.scene.stability", "growth") in found


def bare_names() -> Iterator[tuple[str, str, Any]]:
    """Yield module, name and value of what a public module defines or assigns outside `__all__` without an underscore.

    Without the names that another module imports.
    """
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "flockenv").rglob("*.py"))
    imports = {each for text in texts for each in imported_in(text)}
    for module in public_modules():
        home = importlib.import_module(module)
        for name in sorted(names_of(module)):
            if not name.startswith("_") and name not in home.__all__ and (module, name) not in imports:
                yield module, name, getattr(home, name, None)


def is_constant_or_type(name: str, value: Any) -> bool:
    """True for a constant, in capitals, and for a type alias or variable: the exception of docs/api.md."""
    return is_value(value) and (name.isupper() or isinstance(value, TypeVar) or type_of(value) == "type")


def test_names_outside_all_begin_with_an_underscore_unless_another_module_imports_them() -> None:
    """Except for constants and types: docs/api.md says so."""
    bare = [*bare_names()]
    assert [f"{module}.{name}" for module, name, value in bare if not is_constant_or_type(name, value)] == []
    assert {("flockenv.envs.world", "LEAST"), ("flockenv.model.spawn", "Edge")} <= {each[:2] for each in bare}


if __name__ == "__main__":
    LIST.write_text("".join(f"{line}\n" for line in lines()), encoding="utf-8")
