"""Benchmark problems of solids and liquids: springs, a sheet of triangles, elastic cubes, a free block, a drop."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.model.blocks import Blocks
from flockenv.model.networks import Cloth, Jelly, Rope
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import RigidBodies
from flockenv.physics.effects import (
    AltitudeSprings,
    Bending,
    Effect,
    Elastic,
    Gravity,
    Membrane,
    Pressure,
    Springs,
    SurfaceTension,
    Viscosity,
)
from flockenv.scene import Group, Scene
from flockenv.studies.accuracy.paths import Floats
from flockenv.studies.accuracy.problem import Problem

__all__ = ["altitudes", "bar", "block", "breaking", "drop", "jelly", "sheet", "yielding"]

STEPS = tuple(2**k for k in range(6, 15))
REST, RATE = 1.0, 10.0
"""Springs that yield or break: rest length, m, and sqrt(k / m), 1/s."""


def _free(group: Group, *effects: Effect, **more: Any) -> Scene:
    """Return a scene in 3-D of one group without obstacles."""
    return Scene(dimension=3, groups=(group,), effects=effects, dt=1e-3, **more)


def bar() -> Problem:
    """Return a bar of 8 springs, 100 N/m, and masses of 0.1 kg in its first longitudinal mode, for 1.3 periods.

    x_i = i L + a sin(i q) cos(w t), q = pi / (2 N + 1), w = 2 sqrt(k / m) sin(q / 2): a chain with one free end.
    """
    many, long, stiffness, mass, far = 8, 0.25, 100.0, 0.1, 0.1
    index = np.arange(many + 1)
    shape = far * np.sin(index * math.pi / (2 * many + 1))
    w = 2 * math.sqrt(stiffness / mass) * math.sin(math.pi / (4 * many + 2))

    def exact(t: float) -> tuple[Floats, Floats]:
        still = np.zeros(many + 1)
        x, v = long * index + shape * math.cos(w * t), -w * shape * math.sin(w * t)
        return np.stack([x, still], axis=1), np.stack([v, still], axis=1)

    rope = Rope(links=many, length=many * long, pinned=("start",))
    scene = Scene(groups=(Group(network=rope, mass=mass),), effects=(Springs(stiffness=stiffness),))
    return Problem.of(
        scene, 1.3 * 2 * math.pi / w, STEPS, name="bar", title="Bar of 8 springs, 1.3 periods",
        motion=exact(0.0), exact=exact,
    )  # fmt: skip


def sheet() -> Problem:
    """Return a sheet of 18 triangles that swings down from one edge: stretch, shear, bending and damping."""
    cloth = Cloth(cells=(3, 3), edges=((0.6, 0, 0), (0, 0.6, 0)), pinned=("top",))
    scene = _free(
        Group(network=cloth, mass=0.03), Membrane(stretch=40.0, shear=10.0, damping=0.001), Bending(stiffness=0.02),
        Gravity(acceleration=(0.0, 0.0, -9.81)),
    )  # fmt: skip
    return Problem.of(scene, 0.7, STEPS, name="sheet", title="Sheet of 18 triangles that swings down")


def _spinning_cube(name: str, title: str, *effects: Effect) -> Problem:
    """Return a cube of 5 tetrahedra that turns once a second, stretched by a fifth at the start."""
    scene = _free(Group(network=Jelly(cells=(1, 1, 1), sides=(1, 1, 1)), mass=0.1), *effects)
    pos = (scene.start(0).pos[0] - 0.5) * (1.2, 1.0, 1.0)
    vel = 2 * math.pi * np.stack([-pos[:, 1], pos[:, 0], 0 * pos[:, 0]], axis=1)
    return Problem.of(scene, 0.7, STEPS, name=name, title=title, motion=(pos, vel))


def jelly() -> Problem:
    """Return a spinning cube of corotated elements."""
    return _spinning_cube("jelly", "Jelly that spins, 0.7 turns", Elastic(young=50.0, strain="corotated"))


def altitudes() -> Problem:
    """Return a spinning cube of springs: along edges, from corners to faces, and between opposite edges."""
    effects = Springs(stiffness=3.0), AltitudeSprings(stiffness=3.0, across=1.0, damping=0.01)
    return _spinning_cube("altitudes", "Cube of altitude springs that spins", *effects)


def _pull(limit: float) -> tuple[Callable[[float], tuple[float, float]], float]:
    """Return the length and its rate of a spring that is pulled while elastic, m and m/s, and the time at `limit`."""
    pressed, speed = -0.05, 3.0
    far, phase = math.hypot(pressed, speed / RATE), math.atan2(pressed, speed / RATE)

    def elastic(t: float) -> tuple[float, float]:
        return REST + far * math.sin(RATE * t + phase), far * RATE * math.cos(RATE * t + phase)

    return elastic, (math.asin((limit - REST) / far) - phase) / RATE


def _on_a_spring(name: str, title: str, springs: Springs, motion: Callable[[float], tuple[float, float]]) -> Problem:
    """Return the problem of 1 kg on one spring; motion: t -> length of the spring, m, and its rate, m/s."""

    def exact(t: float) -> tuple[Floats, Floats]:
        x, v = motion(t)
        return np.array([[0.0, 0.0], [x, 0.0]]), np.array([[0.0, 0.0], [v, 0.0]])

    rope = Rope(links=1, start=(0.0, 0.0), end=(REST, 0.0), pinned=("start",))
    scene = Scene(groups=(Group(network=rope),), effects=(springs,))
    return Problem.of(scene, 0.55, STEPS, name=name, title=title, motion=exact(0.0), exact=exact)


def yielding() -> Problem:
    """Return a mass of 1 kg on a spring of 100 N/m and 1 m that yields at a tenth; pulled from 0.95 m at 3 m/s.

    Up to the length 1.1 m it is elastic, with w^2 = k / m. Then the strain is constant, so the force is proportional to
    the length: k l y / (1 + y), an oscillation about length 0. From its greatest length on it is elastic again.
    """
    y, length = 0.1, 1.1 * REST
    elastic, yields = _pull(length)
    u, out = RATE * math.sqrt(y / (1 + y)), elastic(yields)[1]
    longest, turns = math.hypot(length, out / u), yields + math.atan2(out / u, length) / u
    spare = longest * y / (1 + y)

    def motion(t: float) -> tuple[float, float]:
        if t < yields:
            return elastic(t)
        if t < turns:
            return longest * math.cos(u * (turns - t)), longest * u * math.sin(u * (turns - t))
        angle = RATE * (t - turns)
        return longest - spare * (1 - math.cos(angle)), -spare * RATE * math.sin(angle)

    springs = Springs(stiffness=RATE**2, yield_strain=y)
    return _on_a_spring("yielding", "Spring that yields", springs, motion)


def breaking() -> Problem:
    """Return the mass of `yielding` on a spring that breaks at 1.1 m: from there on its velocity is constant."""
    elastic, breaks = _pull(1.1 * REST)

    def motion(t: float) -> tuple[float, float]:
        x, v = elastic(min(t, breaks))
        return x + v * max(t - breaks, 0.0), v

    return _on_a_spring("breaking", "Spring that breaks", Springs(stiffness=RATE**2, break_strain=0.1), motion)


def block() -> Problem:
    """Return a free rigid block that turns over: it is spun about its intermediate axis."""
    blocks = Blocks(sides=(1, 2, 3), centres=((0, 0, 0),), spins=((0.05, 4, 0.02),))
    scene = _free(Group(network=blocks, radius=0.05), constraints=(RigidBodies(),))
    return Problem.of(scene, 3.0, STEPS, name="block", title="Free block that turns over")


def drop() -> Problem:
    """Return a drop of 24 agents, oblong at the start: pressure, viscosity and surface tension."""
    near = np.moveaxis(np.mgrid[:6, :4], 0, -1).reshape(-1, 2).astype(float)
    pos = near + 0.1 * np.sin(np.arange(48)).reshape(24, 2)
    group = Group(count=24, spawn=Spawn(low=(0, 0), high=(1, 1)))
    effects = (
        Pressure(strength=0.75, density=1.0, radius=1.35),
        Viscosity(viscosity=0.2, density=1.0, radius=2.4),
        SurfaceTension(tension=3.0, density=1.0, radius=2.4),
    )
    scene = Scene(groups=(group,), effects=effects)
    title = "Drop of 24 agents, oblong at the start"
    return Problem.of(scene, 2.0, STEPS, name="drop", title=title, motion=(pos, 0 * pos))
