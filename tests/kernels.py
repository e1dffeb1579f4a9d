"""Contents of a scene's kernel, for tests."""

from __future__ import annotations

from types import FunctionType

from flockenv.engine import step_of
from flockenv.jit.sources import functions_in
from flockenv.scene import Scene

__all__ = ["functions_of", "modules_of"]


def functions_of(scene: Scene) -> set[str]:
    """Return the names of all sections and laws in the step of a scene."""
    return {function.__name__ for function in _functions(scene)}


def modules_of(scene: Scene) -> set[str]:
    """Return the names of the modules in which they are defined."""
    return {function.__module__ for function in _functions(scene)}


def _functions(scene: Scene) -> list[FunctionType]:
    make, plan = step_of(scene.parts).made_of  # type: ignore[attr-defined]
    return list(functions_in(make(*plan)))
