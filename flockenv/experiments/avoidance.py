"""How obstacles should be avoided: a force field against steering around them, alone and with the way around them all.

Reynolds 1988, "Not Bumping Into Things": a force field only brakes who comes head-on, and pushes who flies past.
Steering to avoid does neither, and like everything local is caught in a dead end; there the global way is what helps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.arbitration import Allocation, Blend
from flockenv.behaviours import AvoidObstacles, FollowWay, ForceField, Seek, Whiskers
from flockenv.config import load_scene
from flockenv.experiments.base import Experiment, Trial, depth
from flockenv.scene import Scene
from flockenv.steer import Steer

__all__ = ["CASES", "EXPERIMENT", "VARIANTS", "scene_of"]

WORLDS, SEED, SECONDS = 16, 0, 20.0
SPEED, ARRIVED = 2.0, 0.4
"""m/s, the top speed; m from the target, where an agent has arrived."""

CORRIDOR = """
- {kind: polygon, vertices: [[3, 0.6], [9, 0.6], [9, 3], [3, 3]]}
- {kind: polygon, vertices: [[3, -0.6], [9, -0.6], [9, -3], [3, -3]]}
"""

CASES: dict[str, tuple[str, tuple[float, float], str, str]] = {
    "dead ahead": (
        "a circle exactly between an agent and its target", (12, 0), "{low: [0, 0], high: [0, 0]}",
        "[{centre: [6, 0], radius: 1}]",
    ),
    "off centre": (
        "the same, passed at the side", (12, 0), "{low: [0, 0.3], high: [0, 0.9]}", "[{centre: [6, 0], radius: 1}]",
    ),
    "along a wall": (
        "straight along a wall, 0.4 m beside it", (12, 0), "{low: [0, 0], high: [0, 0]}",
        "[{kind: polygon, vertices: [[-3, -0.6], [-3, -2], [15, -2], [15, -0.6]]}]",
    ),
    "corridor": (
        "through a corridor 1.2 m wide", (12, 0), "{low: [0, -0.8], high: [0, 0.8]}", CORRIDOR,
    ),
    "corner": (
        "a target behind the inside of a corner", (9, 5), "{low: [0, -0.6], high: [0, 0.6]}",
        "[{kind: wall, vertices: [[2, 3], [6, 3], [6, -3]], radius: 0.2}]",
    ),
    "U trap": (
        "a target behind a dead end", (12, 0), "{low: [0, -0.8], high: [0, 0.8]}",
        "[{kind: wall, vertices: [[4, -2], [8, -2], [8, 2], [4, 2]], radius: 0.2}]",
    ),
}  # fmt: skip
"""What happens, the target, where agents begin, and the obstacles, as YAML."""

VARIANTS = ("force field", "whiskers", "to avoid", "to avoid, global way")


def scene_of(case: str, variant: str) -> Scene:
    """Return the scene of a case, under one way of avoiding."""
    _, target, spawn, obstacles = CASES[case]
    scene = load_scene(
        f"groups: [{{count: 1, radius: 0.2, max_speed: {SPEED}, max_force: 12, role: learner, spawn: {spawn}}}]\n"
        f"obstacles: {obstacles}\ndt: 0.02\n"
    )
    seek: Any = Seek(weight=4, target=target)
    if variant == "to avoid, global way":
        seek = FollowWay(weight=4, target=target, clearance=0.35, spacing=0.1, slow_radius=ARRIVED)
    around: Any = AvoidObstacles(weight=12, horizon=1, margin=0.05)
    if variant == "force field":
        # a force field is summed up with the rest: it has no moment at which it is silent
        return scene.with_effects(Steer(behaviours=(ForceField(weight=2, range=2), seek), arbitration=Blend()))
    around = Whiskers(weight=20, horizon=1) if variant == "whiskers" else around
    return scene.with_effects(Steer(behaviours=(around, seek), arbitration=Allocation()))


def _trial(case: str, variant: str) -> Trial:
    """Run one case under one variant, in so many worlds, until everybody is there or time is over."""
    scene, target = scene_of(case, variant), np.array(CASES[case][1])
    state = scene.start(SEED, worlds=WORLDS)
    begin, path, deep, speed = state.pos[:, 0].copy(), [state.pos[:, 0].copy()], [depth(scene, state)[:, 0]], []
    for _ in range(round(SECONDS / scene.dt)):
        state = scene.step(state)
        path.append(state.pos[:, 0].copy())
        speed.append(np.linalg.norm(state.vel[:, 0], axis=1))
        deep.append(depth(scene, state)[:, 0])
    way, within, fast = np.array(path), np.array(deep), np.array(speed)
    near = np.linalg.norm(way - target, axis=-1) < ARRIVED
    there = near.any(axis=0)
    last = np.where(there, near.argmax(axis=0), len(way) - 1)  # (B,) steps until then
    until = np.arange(len(way))[:, None] <= last
    moved = np.linalg.norm(np.diff(way, axis=0), axis=-1)
    length = (moved * until[1:]).sum(axis=0)
    straight = np.linalg.norm(target - begin, axis=1) - ARRIVED
    inside = (within > 0) & until
    lost = 1 - (fast * until[1:]).sum(axis=0) / (SPEED * last)
    numbers = {
        "arrived": float(there.mean()),
        "time": float((last * scene.dt)[there].mean()) if there.any() else np.nan,
        "path": float((length / straight)[there].mean()) if there.any() else np.nan,
        "speed lost": float(lost.mean()),
        "collisions": float((inside[0] + (inside[1:] & ~inside[:-1]).sum(axis=0)).mean()),
        "deepest": float(max(0.0, (within * until).max())),
    }
    return Trial(numbers, scene, way[: int(last.max()) + 1, :1])


EXPERIMENT = Experiment(
    name="avoidance",
    title=f"Ways of avoiding obstacles, {WORLDS} worlds each",
    cases={name: case[0] for name, case in CASES.items()},
    variants=VARIANTS,
    columns={
        "arrived": f"share that came within {ARRIVED:g} m of the target in {SECONDS:g} s",
        "time": "s until then, of those who did",
        "path": "length of their way over the straight one",
        "speed lost": f"share of {SPEED:g} m/s, on average until then",
        "collisions": "obstacles run into, per agent",
        "deepest": "m, the deepest that any agent was in an obstacle",
    },
    shown=("arrived", "time", "collisions"),
    trial=_trial,
)
"""`flockenv experiment avoidance`."""
