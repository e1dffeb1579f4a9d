"""Errors of numba about a law outside the package, as one line: the law, its file and line, and the reason.

numba's own text lists all functions that call the law, down to the entry point; the law comes first or not at all.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba.core import types
from numba.core.errors import ForceLiteralArg, NumbaError, TypingError, UnsupportedBytecodeError

from flockenv.jit.decorators import python_of
from flockenv.jit.sources import PACKAGE, free_values

__all__ = ["LawError", "explain_errors"]

PLACES = re.compile(r'File "(?P<file>[^"\n]+)", line (?P<line>\d+):|\bat (?P<path>[^\n()]+) \((?P<number>\d+)\)')
"""Places in numba's text, the innermost first."""

NO_MEMORY = "NRT required but not enabled"
"""numba's reason if a law allocates memory."""


class LawError(TypingError, TypeError):
    """A law that cannot be compiled: its name, file and line, and the reason; its cause is numba's error."""


def explain_errors(compile_types: Callable[..., Any], plan: tuple[Any, ...]) -> Callable[..., Any]:
    """Return numba's `compile_types(...)` of an entry point that raises LawError if a law of its plan is at fault."""

    def compile_or_explain(*types: Any) -> Any:
        try:
            return compile_types(*types)
        except ForceLiteralArg:  # numba compiles again
            raise
        except (NumbaError, UnsupportedBytecodeError) as error:
            try:
                text = _explanation(str(error), plan)
            except Exception:  # numba's error must not be lost
                text = None
            if text is None:
                raise
            raise LawError(text) from error

    return compile_or_explain


def _explanation(text: str, plan: tuple[Any, ...]) -> str | None:
    """Return one line about the law at fault; None if no law from outside the package is, as far as the text tells."""
    laws = [law for law in dict.fromkeys(_laws_in(plan)) if _is_outside(python_of(law).__code__.co_filename)]
    if not laws:
        return None
    found, reason = {id(python_of(law)): law for law in laws}, _reason(text)
    addresses = [int(at, 16) for at in re.findall(r"0x([0-9A-Fa-f]+)>", text)]  # the innermost first
    called = [found[at] for at in addresses if at in found]
    if called:
        file, line = _place_in(text) or _beginning(called[0])
        at_fault = f"{file}:{line}: law {python_of(called[0]).__name__!r}"
    else:  # all were compiled, and the result of one does not fit
        at_fault = "; ".join(_result(law) for law in laws if not _gives_numbers(law))
    if not at_fault or not reason:
        return None
    return f"{at_fault}: {reason}; run it once with NUMBA_DISABLE_JIT=1 for a debugger"


def _laws_in(part: Any) -> Iterator[Any]:
    """Yield the functions in a plan as they are, compiled or not, also those in free variables of functions."""
    python, inside = python_of(part), part
    if isinstance(python, FunctionType):
        yield part
        inside = free_values(python)
    for inner in inside if isinstance(inside, tuple) else ():
        yield from _laws_in(inner)


def _is_outside(file: str) -> bool:
    """Return True for a file that is part of neither this package nor numba."""
    return not any(Path(file).is_relative_to(folder) for folder in (PACKAGE, Path(numba.__file__).parent))


def _beginning(law: Any) -> tuple[str, int]:
    code = python_of(law).__code__
    return code.co_filename, code.co_firstlineno


def _result(law: Any) -> str:
    """Return place, name and type of the result of a law, in words."""
    (file, line), signatures = _beginning(law), getattr(law, "nopython_signatures", ())
    unfit = "is not compiled" if hasattr(law, "py_func") else "is not marked @law"
    result = f"returns {signatures[-1].return_type}" if signatures else unfit
    return f"{file}:{line}: law {python_of(law).__name__!r} {result}"


def _gives_numbers(law: Any) -> bool:
    """Return True if a law was compiled, and returns a tuple of numbers, as most laws do."""
    signatures = getattr(law, "nopython_signatures", ())
    result = signatures[-1].return_type if signatures else None
    parts: Any = result if isinstance(result, types.BaseTuple) else [None]
    return all(isinstance(each, types.Number) for each in parts)


def _place_in(text: str) -> tuple[str, int] | None:
    """Return file and line of the innermost place outside the packages; it may be in a function that a law calls."""
    for found in PLACES.finditer(text):
        file = os.path.abspath(found["file"] or found["path"])
        if _is_outside(file):
            return file, int(found["line"] or found["number"])
    return None


def _reason(text: str) -> str:
    """Return the innermost reason in numba's text, as one line: it lies before the first place."""
    first = re.search(rf"^\s*During: |{PLACES.pattern}", text, re.MULTILINE)
    lines = [line.strip() for line in text[: first.start() if first else None].splitlines() if line.strip()]
    begins = max((k + 1 for k, line in enumerate(lines) if "Failed in " in line), default=0)
    reason, *more = lines[begins:] or [" ".join(text.split())]
    if reason.endswith(":") and more:  # the call that has no implementation
        reason = f"{reason} {more[0].removeprefix('>>> ')}"
    if reason == NO_MEMORY:
        return "it allocates memory (for a list, an array or a text), which laws cannot"
    short = re.sub(r"( of type \w+)\(.*", r"\1", reason).removesuffix(". Raised from None")
    return re.sub(r"Record__(\w+)", lambda found: f"Record({found[1].replace('__', ', ')})", short)
