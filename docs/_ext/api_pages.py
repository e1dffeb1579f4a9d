"""Pages of the API reference: one per public module, by autodoc, with what autodoc does not show."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from docstrings import first_paragraph
from public_api import defined_in, description, is_value, public_modules, type_of

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

__all__ = ["mark_second_names", "pages"]


def pages(docs: Path) -> dict[str, str]:
    """Return a page for each public module.

    All are imported here, before autodoc edits annotations of classes, which pydantic reads.
    """
    for module in public_modules():
        importlib.import_module(module)
    return {f"api/{module}": _page(module) for module in public_modules()}


def _page(module: str) -> str:
    members = "   :no-members:\n" if module == "flockenv" else ""  # documented in the modules that define them
    entries = "\n".join(_entries(module))
    return f"# {module}\n\n```{{eval-rst}}\n.. automodule:: {module}\n{members}\n{entries}```\n"


def _entries(module: str) -> Iterator[str]:
    """Yield an entry for each public name of a module that autodoc does not show."""
    home = importlib.import_module(module)
    for name in _second_names(module):
        value, source = getattr(home, name), defined_in(module, name)
        role = "data" if is_value(value) else "class" if inspect.isclass(value) else "function"
        kind = f"   :type: {type_of(value)}\n" if is_value(value) else ""
        place = f" Defined in ``{source}``." if source != module else ""
        text = first_paragraph(description(module, name))
        yield f".. py:{role}:: {name}\n   :module: {module}\n{kind}\n   {text}{place}\n"


def _second_names(module: str) -> Iterator[str]:
    """Yield the public names of a module that autodoc does not show.

    These are all names of flockenv itself, and the constants and type aliases that a module imports from another.
    """
    home = importlib.import_module(module)
    for name in home.__all__:
        if module == "flockenv" or (is_value(getattr(home, name)) and defined_in(module, name) != module):
            yield name


def mark_second_names(app: Sphinx, env: BuildEnvironment) -> None:
    """Mark these names as aliases, so that a type without its module in a signature leads to the first name."""
    objects = env.get_domain("py").data["objects"]
    for module in public_modules():
        for name in _second_names(module):
            objects[f"{module}.{name}"] = objects[f"{module}.{name}"]._replace(aliased=True)
