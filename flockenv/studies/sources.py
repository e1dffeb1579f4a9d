"""Fingerprint of the code that stored findings depend on: simulator and study, without comments and docstrings."""

from __future__ import annotations

import ast
import functools
import hashlib
import sys
from collections.abc import Iterable
from pathlib import Path

import numba

__all__ = ["SIMULATOR", "fingerprint"]

PACKAGE = Path(__file__).parent.parent

SIMULATOR = (
    "core", "jit", "maths", "steering", "geometry", "model", "physics", "behaviours", "engine", "scene",
)  # fmt: skip
"""The packages that the results of a simulation depend on."""


def fingerprint(folders: Iterable[str], but: Iterable[str] = ()) -> str:
    """Return a digest of the code of some folders of flockenv and of all folders in them, 20 hexadecimal digits.

    but: names of files that results do not depend on.
    """
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for path in sorted(path for folder in folders for path in (PACKAGE / folder).rglob("*.py")):
        if path.name not in but:
            digest.update(_digest(path, path.stat().st_mtime_ns))
    return digest.hexdigest()[:20]


@functools.cache
def _digest(path: Path, changed: int) -> bytes:
    """Return a digest of a module's code, of a file that was changed at a time (ns): each is read once per process."""
    return hashlib.sha256(_code(path.read_text(encoding="utf-8")).encode()).digest()


def _code(text: str) -> str:
    """Return a module as a syntax tree in text, without strings that stand alone."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            node.body = [each for each in node.body if not _is_text(each)]
    return ast.dump(tree)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
