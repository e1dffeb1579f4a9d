"""Which fields of agents laws read: found from the names in their code, and in that of the laws that they call."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from flockenv.jit.decorators import IN_PYTHON, python_of
from flockenv.jit.sources import free_values
from flockenv.physics.effects.effect import LAWS, Effect

__all__ = ["OF_PAIRS", "names_read"]

OF_PAIRS = ("pair_start", "pair_law", "apart_law", "finish_law")
"""The slots of laws about a neighbour."""


def names_read(effect: Effect, slots: Sequence[str]) -> set[str]:
    """Return every name in the code of some of an effect's laws and of the laws that they call."""
    laws = [*(getattr(effect, slot) for slot in slots), effect.obstacle_law if effect.is_joint_fold else None]
    todo: list[Any] = [law for law in laws if law is not None]
    if effect.components and slots == LAWS:
        todo.append(effect.steer_law)
    seen: set[int] = set()
    names: set[str] = set()
    while todo:
        python = python_of(todo.pop())
        if id(python) in seen:
            continue
        seen.add(id(python))
        names |= set(python.__code__.co_names)
        called: list[Any] = [python.__globals__.get(name) for name in python.__code__.co_names]
        called += free_values(python)
        modules = [m for m in called if inspect.ismodule(m)]
        called += [getattr(m, name, None) for m in modules for name in python.__code__.co_names]
        todo += [f for f in called if hasattr(f, "py_func") or (IN_PYTHON and inspect.isfunction(f))]
    return names
