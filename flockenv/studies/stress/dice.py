"""Hard cases of rigid bodies: a stack of ten dice, a free block that turns over again and again, an incline."""

from __future__ import annotations

import numpy as np

from flockenv.geometry.shapes import HalfSpace
from flockenv.model.blocks import Blocks
from flockenv.model.state import State
from flockenv.physics.constraints import RigidBodies
from flockenv.physics.effects import Gravity
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from flockenv.studies.trial_log import Case, Value

__all__ = ["DICE"]

G = 9.81  # m/s^2
FLOOR = HalfSpace(point=(0, 0, 0), direction=(0, 0, 1))


def block_scene(method: Integrator, blocks: Blocks, gravity: float, slope: float = 0.0) -> Scene:
    """Return blocks of 9 kg above a floor, which rises by `slope` rad: one set of laws for all cases of this file.

    The axes are those of the floor; blocks slide towards +x.
    """
    pull = (gravity * np.sin(slope), 0, -gravity * np.cos(slope))
    return Scene(
        dimension=3, groups=(Group(network=blocks, radius=0.05),), effects=(Gravity(acceleration=pull),),
        obstacles=(FLOOR,), constraints=(RigidBodies(friction=0.5),), integrator=method, dt=0.02,
    )  # fmt: skip


def stack(method: Integrator) -> Value:
    """Check that ten dice of 1 m, on top of each other, stand for 10 s."""
    places = tuple((0.0, 0.0, k + 0.5) for k in range(10))
    scene = block_scene(method, Blocks(sides=(1, 1, 1), centres=places), G)
    end = scene.run(scene.start(0), 500)
    moved = float(np.linalg.norm(end.pos[0, 8::9] - places, axis=1).max())
    return Value(moved, moved <= 0.01, f"{end.count_of('unsolved')} steps with unsolved contacts")


def tumbling(method: Integrator) -> Value:
    """Check that a free block, spun about its intermediate axis, keeps its energy for 100 s."""
    blocks = Blocks(sides=(1, 2, 3), centres=((0, 0, 9),), spins=((0.05, 4, 0.02),))
    scene = block_scene(method, blocks, 0.0)
    start = scene.start(0)
    before, state, off = _energy(scene, start), start, 0.0
    for _ in range(100):
        state = scene.run(state, 50)
        off = max(off, abs(_energy(scene, state) / before - 1))
    return Value(off, off <= 1e-9, f"energy within {off:.2g}")


def incline(method: Integrator) -> Value:
    """Check a die on inclines for 2 s: friction 0.5 holds at 26 degrees; at 35 it slides g (sin - 0.5 cos) t^2 / 2."""
    slid = []
    for degrees in (26.0, 35.0):
        scene = block_scene(method, Blocks(sides=(1, 1, 1), centres=((0, 0, 0.5),)), G, np.radians(degrees))
        slid.append(float(scene.run(scene.start(0), 100).pos[0, -1, 0]))
    expected = 0.5 * G * (np.sin(np.radians(35.0)) - 0.5 * np.cos(np.radians(35.0))) * 2.0**2
    off = max(abs(slid[1] / expected - 1), abs(slid[0]) / expected)
    return Value(off, off <= 0.02, f"slides {slid[0]:.2g} m at 26 degrees, {slid[1]:.4g} m at 35")


def _energy(scene: Scene, state: State) -> float:
    """Return the kinetic energy, J."""
    return float(0.5 * (np.asarray(scene.body.mass) * (state.vel[0] ** 2).sum(axis=1)).sum())


DICE = (
    Case("N45", "stack of ten dice, 10 s", "moves 1 % of an edge", stack),
    Case("N46", "free block, 100 s", "energy within 1e-9", tumbling),
    Case("N52", "die on inclines, friction .5", "stays at 26, slides at 35 degrees +- 2 %", incline),
)
