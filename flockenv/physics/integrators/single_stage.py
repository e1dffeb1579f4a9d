"""The base class of methods with one evaluation, at the present, and a formula for each coordinate."""

from __future__ import annotations

from typing import Any, ClassVar

from flockenv.jit.decorators import python_of
from flockenv.model.state import Floats
from flockenv.physics.integrators.integrator import Integrator

__all__ = ["OneStage"]


class OneStage(Integrator):
    """Base class of methods of one formula, `move(x, v, a, dt)`: a coordinate and its velocity one step later."""

    stages: ClassVar[int] = 0
    evaluations: ClassVar[int] = 1

    @classmethod
    def move(cls) -> Any:
        """Return the compiled `move` of the method's module."""
        return cls.module_object("move")

    def _step(
        self, law: Any, context: Any, x: Floats, v: Floats, flow: Any, time: float, dt: float, stages: Floats
    ) -> None:
        """Advance one world by `move`, in Python."""
        law(context, x, v, time, stages[0])
        x[...], v[...] = python_of(self.move())(x, v, stages[0], dt)
        if len(flow):
            x += dt * flow
