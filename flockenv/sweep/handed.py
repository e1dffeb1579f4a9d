"""What the functions of a source are handed: of the records of context and scratch they take out what they name."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from flockenv.sweep.parts import Parts
from flockenv.sweep.scratch import scratch_of

__all__ = ["OPEN_CONTEXT", "OPEN_SCRATCH", "Context", "opened"]

OPEN_CONTEXT, OPEN_SCRATCH = "<from context>", "<from scratch>"
"""Lines that stand where a function takes out of its context, or of the scratch, what it names."""


class Context(NamedTuple):
    """One world in progress, as what computes accelerations sees it."""

    obstacle_x: Any  # (D, B, M) m
    obstacle_radius: Any  # (B, M) m
    work: Any  # (B, 8) counters
    params: Any  # the numbers of the scene in one row, with its tables behind them
    numbers: Any  # the same by name: numbers.Numbers
    key: Any  # (B,) of random numbers
    b: Any  # which world
    n: Any  # how many agents
    present: Any  # how many of them are alive
    arranged: Any  # do they lie by tiles, and not by number?
    first: Any  # this thread's blocks: [first, end)
    end: Any
    rank: Any  # which thread of the team that steps this world
    team: Any  # how many those are
    scratch: Any  # a record of arrays, see scratch.py


def opened(parts: Parts, source: str) -> str:
    """Return a source in which every function takes out of its records what it names."""
    scratch = [name for name in scratch_of(parts, parts.width) if not name.startswith("inner")]
    functions = re.split(r"(?=^@)", source, flags=re.MULTILINE)
    return "".join(_opened(text, scratch) for text in functions)


def _opened(text: str, scratch: list[str]) -> str:
    words, arguments = _words(text), set(re.findall(r"\w+", text[text.find("(") : text.find("):")]))
    arrays = [name for name in scratch if name in words and name not in arguments]
    shared = [name for name in Context._fields if name in words and name not in arguments and name != "scratch"]
    from_scratch = [f"{name} = scratch.{name}" for name in arrays]
    from_context = [f"{name} = context.{name}" for name in [*shared, "scratch"]]
    text = text.replace(OPEN_SCRATCH, "; ".join(from_scratch) or "pass")
    return text.replace(OPEN_CONTEXT, "; ".join([*from_context, *from_scratch]) or "pass")


def _words(text: str) -> set[str]:
    """Return all words of a text's code; a comment needs no array."""
    return set(re.findall(r"\w+", re.sub(r"#.*", "", text)))
