"""Pages of the API reference: one per public module, by autodoc, with what autodoc does not show."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

from docstrings import first_paragraph
from public_api import defined_in, description, is_value, public_modules, type_of

__all__ = ["pages"]


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
    """Yield an entry for each public name that autodoc does not show.

    These are all names of flockenv itself, and the constants and type aliases that a module imports from another.
    """
    home = importlib.import_module(module)
    for name in home.__all__:
        value, source = getattr(home, name), defined_in(module, name)
        if module == "flockenv" or (is_value(value) and source != module):
            role = "data" if is_value(value) else "class" if inspect.isclass(value) else "function"
            kind = f"   :type: {type_of(value)}\n" if is_value(value) else ""
            place = f" Defined in ``{source}``." if source != module else ""
            yield (
                f".. py:{role}:: {name}\n   :module: {module}\n{kind}\n"
                f"   {first_paragraph(description(module, name))}{place}\n"
            )
