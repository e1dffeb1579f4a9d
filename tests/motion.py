"""Both uses of a method behind one signature: its `__call__` with forces in Python, and a scene's kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flockenv.model.spawn import Spawn
from flockenv.model.state import State, blank
from flockenv.physics.effects import Drag
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from tests.catalogue import INTEGRATORS, Array

METHODS = pytest.mark.parametrize("row", INTEGRATORS, ids=lambda row: row.name)
WAYS = pytest.mark.parametrize("way", ["python", pytest.param("compiled", marks=pytest.mark.slow)])

Advance = Callable[[Integrator, float, int], State]
"""(method, dt, steps) -> the state at the end."""

X0, V0 = 1.0, 0.3


def at_start(state: State, pos: Any = X0, vel: Any = V0) -> State:
    state.pos[...], state.vel[...] = pos, vel
    return state


def tethered(tether: Any, way: str, pos: Any = X0, vel: Any = V0, drag: float = 0.0, **given: Any) -> Advance:
    """Return the motion of a 1 kg point under the forces of catalogue.TETHER and a drag that methods may split off.

    Arguments that are not fields of the effect are fields of the point's group.
    """
    forces = {name: given.pop(name) for name in tuple(given) if name in tether.model_fields}
    it = tether(**forces)

    def law(x: Array, v: Array, t: float) -> Array:
        pull = it.stiffness + it.sun / np.maximum(np.sum(x * x, axis=1, keepdims=True), 1e-12) ** 1.5
        return -pull * x - it.damping * v - it.sine * np.sin(x) + it.push * math.cos(2 * t) + it.weight

    def in_python(method: Integrator, dt: float, steps: int) -> State:
        state, own = at_start(blank(1, 1, 2, 0, dt), pos, vel), drag if method.splits_drag else 0.0
        for _ in range(steps):
            state = method(lambda x, v, t: law(x, v, t) - (drag - own) * v, state, dt, drag=own)
        return state

    def compiled(method: Integrator, dt: float, steps: int) -> State:
        group = Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1)), **given)
        effects = (it, Drag(rate=drag)) if drag else (it,)
        scene = Scene(groups=(group,), effects=effects, integrator=method, dt=dt)
        return scene.run(at_start(scene.start(0), pos, vel), steps)

    return in_python if way == "python" else compiled


def motion(state: State) -> tuple[float, float]:
    """Return position and velocity along the first axis."""
    return float(state.pos[0, 0, 0]), float(state.vel[0, 0, 0])


def order(end: Advance, method: Integrator, target: tuple[float, float], seconds: float, first: int) -> float:
    """Return the order measured over five halvings of the step, the last ones above rounding.

    The error is that of position and velocity together, because either alone may vanish by chance at one instant.
    """
    steps = [first * 2**k for k in range(8)]
    errors = np.array([math.dist(motion(end(method, seconds / n, n)), target) for n in steps])
    last = np.flatnonzero(errors > 1e-13)[-6:]
    assert len(last) == 6, errors
    slope, _ = np.polyfit(np.log(seconds / np.array(steps)[last]), np.log(errors[last]), 1)
    return float(slope)


def first_of(method: Integrator) -> int:
    """Return a first number of steps, so that five halvings lie between too coarse steps and rounding."""
    return 16 if not method.adaptive else 8 if method.order < 5 else 4
