"""Contents of a scene's kernel, for tests."""

from __future__ import annotations

from flockenv.engine import step_of
from flockenv.jit.sources import functions_in
from flockenv.scene import Scene

__all__ = ["functions_of"]


def functions_of(scene: Scene) -> set[str]:
    """Return the names of all sections and laws in the step of a scene."""
    make, plan = step_of(scene.parts).made_of  # type: ignore[attr-defined]
    return {function.__name__ for function in functions_in(make(*plan))}
