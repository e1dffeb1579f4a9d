"""Integrator: (acceleration, state, dt) -> state. A law never knows which method integrates it.

Each method is one file with `advance(acceleration, context, pos, vel, dt, stages, first, end)`: over the coordinates
of one world in one row, in place. Of these it writes [first, end) alone, because several threads may share a world,
each with a part of its own; `acceleration(context, pos, vel, out)` reads everybody's positions, and waits until all
threads have come so far. Compiled, `advance` is a part of a scene's kernel; with a Python function for the acceleration
the very same source runs in Python, which is how its order is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from flockenv.records import Record
from flockenv.state import Floats, State

__all__ = ["INTEGRATORS", "Integrator"]

INTEGRATORS: dict[str, type[Integrator]] = {}
"""Every integrator by its kind; a class registers itself when it is defined."""


class Integrator(Record):
    """A method that advances positions and velocities by one step."""

    kind: str
    order: ClassVar[int]
    """Order of accuracy for forces that depend on position alone."""
    order_with_drag: ClassVar[int]
    """Order of accuracy for forces that depend on velocity too."""
    stages: ClassVar[int]
    """Rows of coordinates it needs as scratch."""
    evaluations: ClassVar[int]
    """Evaluations of the force per step."""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        INTEGRATORS[cls.model_fields["kind"].default] = cls

    @classmethod
    def advance(cls) -> Any:
        """Return the compiled `advance` of the method's module."""
        import sys

        return vars(sys.modules[cls.__module__])["advance"]

    def __call__(self, acceleration: Callable[[Floats, Floats], Floats], state: State, dt: float) -> State:
        """Return the state one step later under an acceleration given as a Python function.

        `acceleration(pos, vel)` takes and returns (N, D), m, m/s, m/s^2. Scenes go through Scene.step: this is Python.
        """
        if not (dt > 0 and np.isfinite(dt)):
            raise ValueError(f"dt is {dt}, must be a positive number of seconds")
        new = state.copy()
        b, n, d = state.shape

        def law(context: Any, pos: Floats, vel: Floats, out: Floats) -> None:
            out[...] = np.asarray(acceleration(pos.reshape(d, n).T, vel.reshape(d, n).T)).T.reshape(-1)

        for k in range(b):
            x, v = new.x[:, k].ravel(), new.v[:, k].ravel()
            stages = np.zeros((max(self.stages, 1), d * n), state.x.dtype)
            self.advance().py_func(law, (), x, v, dt, stages, 0, d * n)
            new.x[:, k], new.v[:, k] = x.reshape(d, n), v.reshape(d, n)
        return replace(new, tick=new.tick + 1)
