"""Benchmark problems of contacts with faces: a ball that falls on a slope, and one that falls on a sheet."""

from __future__ import annotations

import math

import numpy as np

from flockenv.model.networks import Cloth, Mesh
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import FaceCollisions
from flockenv.physics.effects import Effect, Gravity, Springs
from flockenv.scene import Group, Scene
from flockenv.studies.accuracy.paths import Floats
from flockenv.studies.accuracy.problem import Problem

__all__ = ["slope", "trampoline"]

GRAVITY, THICKNESS = 9.81, 0.01
STEPS = tuple(2**k for k in range(6, 15))


def _ball(radius: float, mass: float = 1.0) -> Group:
    """Return the group of a ball."""
    return Group(count=1, radius=radius, mass=mass, spawn=Spawn(low=(0, 0, 0), high=(0, 0, 0)))


def _ball_on(group: Group, ball: Group, friction: float, *effects: Effect) -> Scene:
    """Return a scene of a ball that falls on the faces of a group."""
    return Scene(
        dimension=3, groups=(group, ball), effects=(Gravity(acceleration=(0.0, 0.0, -GRAVITY)), *effects),
        constraints=(FaceCollisions(thickness=THICKNESS, friction=friction),), dt=1e-3,
    )  # fmt: skip


def slope() -> Problem:
    """Return a ball that falls by 0.3 m on a face held at 20 degrees and slides down it, with friction 0.2.

    The impact takes the velocity along the normal, v_n, and friction 0.2 v_n of that along the face; then the ball is
    accelerated by g (sin 20 degrees - 0.2 cos 20 degrees). It is a particle: it does not roll.
    """
    tilt, friction, radius, drop = math.radians(20), 0.2, 0.1, 0.3
    c, s, up = math.cos(tilt), math.sin(tilt), np.array([0.0, 0.0, 1.0])
    down, normal = np.array([c, 0.0, -s]), np.array([s, 0.0, c])
    corners = np.array([-1.0, 4.0, -1.0])[:, None] * down + np.array([-2.0, -2.0, 3.0])[:, None] * [0.0, 1.0, 0.0]
    hits = math.sqrt(2 * drop / GRAVITY)
    lands, slides = (radius + THICKNESS) * normal, GRAVITY * (s - friction * c)
    speed = slides * hits

    def exact(t: float) -> tuple[Floats, Floats]:
        if t < hits:
            x, v = lands + (drop - GRAVITY * t * t / 2) * up, -GRAVITY * t * up
        else:
            after = t - hits
            x, v = lands + down * (speed * after + slides * after**2 / 2), down * (speed + slides * after)
        return np.vstack([corners, x]), np.vstack([0 * corners, v])

    mesh = Mesh(vertices=tuple(map(tuple, corners.tolist())), triangles=((0, 1, 2),), pinned=(0, 1, 2))
    scene = _ball_on(Group(network=mesh, radius=0.0), _ball(radius), friction)
    return Problem.of(
        scene, 0.83, STEPS, name="slope", title="Ball that falls on a slope", motion=exact(0.0), exact=exact
    )


def trampoline() -> Problem:
    """Return a ball of 0.5 kg that falls by 0.14 m on a sheet of 26 springs held at its border, with friction 0.3."""
    cloth = Cloth(cells=(2, 2), edges=((1, 0, 0), (0, 1, 0)), pinned=("border",))
    scene = _ball_on(
        Group(network=cloth, mass=0.1, radius=0.0), _ball(0.05, 0.5), 0.3,
        Springs(stiffness=100.0, damping=0.2),
    )  # fmt: skip
    pos = np.vstack([scene.start(0).pos[0][:-1], (0.6, 0.68, 0.2)])
    return Problem.of(scene, 0.4, STEPS, name="trampoline", title="Ball that falls on a sheet", motion=(pos, 0 * pos))
