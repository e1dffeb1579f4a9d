"""Integrator: (acceleration, state, dt) -> state. Laws are independent of the method that integrates them.

Each method is one file. A method of one stage is a formula (`single_stage.py`). Any other is a section,
`advance(provided)`. It returns `advance(context, pos, vel, flow, time, dt, stages, first, end)`, which calls the
provided functions and updates, in place, the coordinates of one world, stored in one row. It writes only [first, end),
because several threads may share a world, each with a range of its own. `flow` holds the velocity with which the medium
carries all agents, as of the last acceleration; it is empty, and costs nothing, without a flow. With compiled functions
(`engine/method.py`) it is a part of a scene's kernel; with Python functions the same code runs in Python, where its
order is measured.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba.core import types
from numba.extending import overload

from flockenv.core.errors import nearest, printable
from flockenv.core.record import Record
from flockenv.jit.decorators import OPTIONS
from flockenv.model.state import WORK, Floats, State

__all__ = [
    "INTEGRATORS", "SUBSTEPS", "Alone", "Integrator", "Method", "Provided", "carry", "methods_of",
]  # fmt: skip

Method = Callable[..., None]
"""Advances one world in place: `advance(context, pos, vel, flow, time, dt, stages, first, end)`."""

INTEGRATORS: dict[str, type[Integrator]] = {}
"""Every integrator by its kind; a class registers itself when it is defined."""


def carry(x: float, seconds: float, flow: Any, i: int) -> float:
    """Return a coordinate x after the medium has carried it for some seconds; x itself if `flow` is empty."""
    return float(x + seconds * flow[i]) if len(flow) else x


@overload(carry, jit_options=OPTIONS)
def _carry(x, seconds, flow, i):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    if isinstance(flow, types.BaseTuple):
        return lambda x, seconds, flow, i: x
    return lambda x, seconds, flow, i: x + seconds * flow[i]


class Alone(NamedTuple):
    """What `step` passes to a method as its context: one world, whose laws are Python functions."""

    drag: float | Floats = 0.0  # c / m, 1/s, one for all or one per coordinate (D N,)
    settings: tuple[float, ...] = ()  # of the method, see Integrator.settings
    dimension: int = 1
    work: Any = None  # (8,), the world's row of State.work


def _damping(context: Any, rate: Any, first: int, end: int) -> None:
    rate[first:end] = context.drag


def _settings(context: Any) -> tuple[float, ...]:
    return tuple(context.settings)


def _largest_sum(context: Any, squares: Any, first: int, end: int) -> tuple[float, int]:
    sums = squares[first:end].reshape(context.dimension, -1).sum(axis=0)
    agent = int(np.argmax(sums))
    return sums[agent], first + agent


def _count_substeps(context: Any, accepted: int, rejected: int) -> None:
    if context.work is not None:
        context.work[SUBSTEPS] += accepted
        context.work[SUBSTEPS + 1] += rejected


class Provided(NamedTuple):
    """The functions that a method calls: compiled ones of a scene or, by default, Python ones of a world `Alone`."""

    acceleration: Callable[..., None]
    """(context, pos, vel, time, out): compute accelerations, once all threads have written their positions."""
    settings: Callable[..., tuple[float, ...]] = _settings
    """(context): the settings of the method, in the order of its fields."""
    damping: Callable[..., None] = _damping
    """(context, rate, first, end): write c / m, 1/s, of coordinates [first, end), for a method with `splits_drag`."""
    largest: Callable[..., tuple[float, int]] = _largest_sum
    """(context, squares, first, end): the largest sum over an agent's coordinates, NaN if one is, and its index."""
    count_substeps: Callable[..., None] = _count_substeps
    """(context, accepted, rejected): count substeps in State.work."""


SUBSTEPS = WORK.index("substeps")
"""Column of State.work; rejected substeps are in the next."""


def methods_of(names: Sequence[str]) -> tuple[Integrator, ...]:
    """Return methods by their kinds, each once; raise ValueError, with the nearest name, for an unknown one.

    names: kinds, such as `verlet`.
    """
    for name in names:
        if name not in INTEGRATORS:
            raise ValueError(
                f"methods: {printable(name)}: unknown{nearest(name, INTEGRATORS)} ({', '.join(INTEGRATORS)})"
            )
    return tuple(INTEGRATORS[name]() for name in dict.fromkeys(names))


class Integrator(Record):
    """A method that advances positions and velocities by one step."""

    kind: str
    order: ClassVar[int]
    """Order of accuracy for forces that depend on position alone."""
    order_with_drag: ClassVar[int]
    """Order of accuracy for forces that also depend on velocity."""
    stages: ClassVar[int]
    """Rows of coordinates needed as scratch."""
    evaluations: ClassVar[int]
    """Evaluations of the force per step; for adaptive methods, the least number."""
    adaptive: ClassVar[bool] = False
    """True if the method chooses substeps within dt; threads then do not share a world."""
    splits_drag: ClassVar[bool] = False
    """True if the method integrates linear drag exactly, which the acceleration then excludes; see `damping`."""
    solves: ClassVar[bool] = False
    """True if the method solves equations between calls of the kernel; `advance` then only copies the solution."""
    stable_at_any_step: ClassVar[bool] = False
    """True if no step is too long for a damped or undamped oscillation, whatever the forces."""
    linearises: ClassVar[bool] = False
    """True if the method takes the forces of effects with a `derivative` implicitly: these do not limit its step."""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the class under its kind."""
        kind = cls.model_fields["kind"].default
        if isinstance(kind, str):
            INTEGRATORS[kind] = cls

    def settings(self) -> tuple[float, ...]:
        """Return the numbers passed to `advance`: the method's fields, in order."""
        return tuple(float(getattr(self, name)) for name in type(self).model_fields if name != "kind")

    @classmethod
    def module_object(cls, name: str) -> Any:
        """Return the object of this name in the method's module."""
        return vars(sys.modules[cls.__module__])[name]

    @classmethod
    def advance(cls) -> Callable[[Provided], Method]:
        """Return the section `advance` of the method's module."""
        return cls.module_object("advance")  # type: ignore[no-any-return]

    def __call__(
        self,
        acceleration: Callable[[Floats, Floats, float], Floats],
        state: State,
        dt: float,
        flow: Callable[[Floats, float], Floats] | None = None,
        drag: float | Floats = 0.0,
    ) -> State:
        """Return the state one step later under laws given as Python functions.

        `acceleration(pos, vel, time)` takes and returns (N, D), m, m/s, s, m/s^2; `flow(pos, time)` is the velocity of
        a medium that carries all agents, (N, D) m/s; `drag` is c / m, 1/s, one for all or one per coordinate (D N,),
        for a method that integrates linear drag separately. Scenes use the compiled Scene.step instead.
        """
        if not (dt > 0 and np.isfinite(dt)):
            raise ValueError(f"dt is {dt}, must be a positive number of seconds")
        new = state.copy()
        b, n, d = state.shape
        advection: Any = np.zeros(d * n, state.x.dtype) if flow is not None else ()

        def law(context: Any, pos: Floats, vel: Floats, time: float, out: Floats) -> None:
            x, v = pos.reshape(d, n).T, vel.reshape(d, n).T
            out[...] = np.asarray(acceleration(x, v, time)).T.reshape(-1)
            if flow is not None:
                advection[...] = np.asarray(flow(x, time)).T.reshape(-1)

        for k in range(b):
            x, v = new.x[:, k].ravel(), new.v[:, k].ravel()
            stages = np.zeros((max(self.stages, 1), d * n), state.x.dtype)
            context = Alone(drag, self.settings(), d, new.work[k])
            self._step(law, context, x, v, advection, float(state.time[k]), dt, stages)
            new.x[:, k], new.v[:, k] = x.reshape(d, n), v.reshape(d, n)
        return replace(new, tick=new.tick + 1)

    def _step(
        self, law: Any, context: Any, x: Floats, v: Floats, flow: Any, time: float, dt: float, stages: Floats
    ) -> None:
        """Advance one world by `advance`, in Python."""
        self.advance()(Provided(law))(context, x, v, flow, time, dt, stages, 0, len(x))
