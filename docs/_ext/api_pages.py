"""Pages of the API reference: one per public module, by autodoc."""

from __future__ import annotations

import importlib
from pathlib import Path

from public_api import public_modules

__all__ = ["pages"]


def pages(docs: Path) -> dict[str, str]:
    """Return a page for each public module.

    All are imported here, before autodoc edits annotations of classes, which pydantic reads.
    """
    for module in public_modules():
        importlib.import_module(module)
    return {f"api/{module}": _page(module) for module in public_modules()}


def _page(module: str) -> str:
    members = (
        "   :no-members:\n" if module == "flockenv" else ""
    )  # its names are documented in the modules that define them
    return f"# {module}\n\n```{{eval-rst}}\n.. automodule:: {module}\n{members}```\n"
