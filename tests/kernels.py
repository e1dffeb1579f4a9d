"""What the kernels of a scene are made of, for tests that ask what is in them."""

from __future__ import annotations

from flockenv.engine import step_of
from flockenv.jit.sources import functions_in
from flockenv.scene import Scene

__all__ = ["functions_of"]


def functions_of(scene: Scene) -> set[str]:
    """The names of all sections and laws that the step of a scene holds."""
    make, plan = step_of(scene.parts).made_of  # type: ignore[attr-defined]
    return {function.__name__ for function in functions_in(make(*plan))}
