"""Boids on a torus, as several benchmarks step them: a number of agents and neighbours, the three rules of a flock."""

from __future__ import annotations

import math
from collections.abc import Callable

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Effect
from flockenv.scene import Group, Scene

__all__ = ["boids", "crowd", "edge_for", "restart_each_call", "rules", "step_from_start", "world"]

REACH = 2.0  # m, how far agents of a crowd look
NEIGHBOURS = 15.0  # within that, on average
WORLD_RADII = {2: (2.0, 4.0, 5.0), 3: (2.0, 4.0, 4.5)}  # m, of a small world by dimension: almost all agents are near
EDGES = {2: 12.0, 3: 10.0}  # m, of a small world


def rules(radii: tuple[float, float, float], fov: float = 360.0) -> tuple[Effect, Effect, Effect]:
    """Return separation, alignment and cohesion within these radii, m, and a field of view, degrees."""
    apart, agree, near = radii
    return (
        Separation(weight=1.5, radius=apart, fov=fov),
        Alignment(weight=0.6, radius=agree, fov=fov),
        Cohesion(weight=0.2, radius=near, fov=fov),
    )


def boids(agents: int, edge: float, effects: tuple[Effect, ...], dtype: str, dimension: int = 2) -> Scene:
    """Return a scene of one world on a torus `edge` m wide."""
    return Scene(
        dimension=dimension, space=Torus(size=(edge,) * dimension), effects=effects, dt=0.05, dtype=dtype,
        groups=(Group(count=agents, max_speed=3.0, max_force=4.0, spawn=Spawn(speed=(1.0, 2.0))),),
    )  # fmt: skip


def world(dtype: str, dimension: int = 2, agents: int = 32) -> Scene:
    """Return a small world, in which each agent interacts with all others."""
    return boids(agents, EDGES[dimension], rules(WORLD_RADII[dimension]), dtype, dimension)


def edge_for(agents: int, dimension: int = 2) -> float:
    """Return the edge, m, of a torus where agents have NEIGHBOURS within REACH."""
    ball = math.pi * REACH**2 if dimension == 2 else 4 / 3 * math.pi * REACH**3
    return float((agents * ball / NEIGHBOURS) ** (1 / dimension))


def crowd(agents: int, dtype: str, dimension: int = 2) -> Scene:
    """Return a large world; its density does not depend on its size. Separation has half the radius of the others."""
    return boids(agents, edge_for(agents, dimension), rules((REACH / 2, REACH, REACH)), dtype, dimension)


def restart_each_call(start: State, state: State, step: Callable[[], object]) -> Callable[[], object]:
    """Return a call that steps from the same state each time: later on flocks are denser, and that is other work."""

    def call() -> None:
        state.x[...] = start.x
        state.v[...] = start.v
        step()

    return call


def step_from_start(scene: Scene, start: State, steps: int) -> Callable[[], object]:
    """Return a call that makes a number of steps of a scene, from the same state each time."""
    state = start.copy()
    return restart_each_call(start, state, lambda: scene.step(state, out=state, steps=steps))
