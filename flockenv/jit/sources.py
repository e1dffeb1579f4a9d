"""Text of everything that machine code depends on: functions with free variables, and the sources of all laws.

numba's own disk cache never finds a closure again, and does not notice a change of a law that a cached function calls.
So machine code is stored under a digest of this text. A second process compiles nothing; an edited law is always
compiled again.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numba
import numpy as np

from flockenv.jit.decorators import python_of

__all__ = [
    "code_text",
    "description",
    "free_values",
    "functions_in",
    "laws_digest",
    "sources_of_code",
    "texts_outside",
]

PACKAGE = Path(__file__).parent.parent


def sources_of_code() -> Iterator[tuple[Path, bytes]]:
    """Yield path and content of every source of the package that defines laws or their records, or compiles them."""
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if b"flockenv.jit" in text or path.relative_to(PACKAGE).parts[0] in ("jit", "engine", "tasks"):
            yield path, text


@functools.cache
def laws_digest() -> str:
    """Return a digest of `sources_of_code` and of the versions of numba and Python.

    After an edit of a source, machine code is compiled again. The digest does not depend on the machine.
    """
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for _, text in sources_of_code():
        digest.update(text)
    return digest.hexdigest()


def texts_outside(modules: set[str]) -> str:
    """Return the text of those of `modules` that are outside flockenv, and of the modules whose laws they use."""
    todo = set(modules)
    done: set[str] = set()
    texts = []
    while todo - done:
        name = min(todo - done)
        done.add(name)
        module = sys.modules.get(name)
        if module is None or name.split(".")[0] in ("flockenv", "numpy", "numba", "collections", "math"):
            continue
        path, laws = Path(getattr(module, "__file__", None) or ""), [v for v in vars(module).values() if _is_law(v)]
        # a notebook has no file: the current code of its functions is used
        texts.append(path.read_text(encoding="utf-8") if path.suffix == ".py" else "".join(map(code_text, laws)))
        todo |= {python_of(law).__module__ for law in laws}
    return "".join(texts)


def _is_law(value: Any) -> bool:
    return hasattr(value, "py_func")


def code_text(function: Any) -> str:
    """Return the byte code of a function as text: the same for the same code, different after an edit."""

    def text(code: CodeType) -> str:
        inner = [text(each) if isinstance(each, CodeType) else each for each in code.co_consts]
        return repr((code.co_name, code.co_code, code.co_names, inner))

    return text(python_of(function).__code__)


def free_values(python: FunctionType) -> tuple[Any, ...]:
    """Return the values of a function's free variables."""
    return tuple(cell.cell_contents for cell in python.__closure__ or ())


def functions_in(part: Any) -> Iterator[FunctionType]:
    """Yield a Python function and all functions in its free variables, recursively; likewise for a tuple."""
    python = python_of(part)
    if isinstance(python, FunctionType):
        yield python
        part = free_values(python)
    for inner in part if isinstance(part, tuple) else ():
        yield from functions_in(inner)


def description(part: Any) -> str:
    """Return a part of a plan as text: functions by code and free variables, numbers by repr, arrays by bytes."""
    python = python_of(part)
    if isinstance(python, FunctionType):
        return _function_description(python)
    if isinstance(part, tuple):
        return f"({', '.join(map(description, part))})"
    return f"{part.dtype} {part.shape} {part.tobytes()!r}" if isinstance(part, np.ndarray) else repr(part)


@functools.lru_cache(maxsize=4096)
def _function_description(python: FunctionType) -> str:
    """Return a function's name and the digest of its code and free variables, which keeps nested text short."""
    text = f"{code_text(python)} {description(free_values(python))}"
    return f"{python.__module__}.{python.__qualname__} {hashlib.sha256(text.encode()).hexdigest()}"
