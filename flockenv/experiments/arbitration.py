"""How wishes that contradict each other should be reconciled: every arbitration in three scenes of conflict.

Reynolds 1987: the sum of "left, around the obstacle" and "right, to where the flock is" is straight into it; and in an
emergency the most pressing wish must not share a bounded force with all others.
"""

from __future__ import annotations

import numpy as np

from flockenv.arbitration import (
    Allocation,
    Arbitration,
    Blend,
    ContextSteering,
    Dithering,
    Priority,
    RoundRobin,
    RunningSum,
)
from flockenv.config import load_scene
from flockenv.experiments.base import Experiment, Trial, depth
from flockenv.grants import Granted, Grants
from flockenv.scene import Scene
from flockenv.state import Floats
from flockenv.steer import Steer

__all__ = ["CASES", "EXPERIMENT", "VARIANTS", "scene_of"]

WORLDS = 32
SEED = 0

CASES: dict[str, tuple[str, float, str]] = {
    "cancelling": (
        "the way around an obstacle and the course to a goal behind it pull apart, until their sum is nothing",
        8.0,
        """
groups:
  - {count: 1, radius: 0.2, max_speed: 2, max_force: 6, role: learner, spawn: {low: [-7, 0.1], high: [-6, 0.5],
     speed: [2, 2], heading: [1, 0]}}
effects:
  - kind: steer
    behaviours:
      - {kind: avoid_obstacles, weight: 4, horizon: 1.5, margin: 0.1}
      - {kind: separation, weight: 1, radius: 1}
      - {kind: seek, weight: 8, target: [12, 0]}
obstacles: [{centre: [0, 0], radius: 1}]
dt: 0.02
""",
    ),
    "emergency": (
        "a dense group in a hurry meets obstacles late: everybody wants more than the bounded force is",
        8.0,
        """
groups:
  - {count: 12, radius: 0.2, max_speed: 3, max_force: 9, role: flockmate, spawn: {low: [-9, -2], high: [-5, 2],
     speed: [3, 3], heading: [1, 0]}}
effects:
  - kind: steer
    behaviours:
      - {kind: avoid_obstacles, weight: 9, horizon: 0.9, margin: 0.1}
      - {kind: separation, weight: 6, radius: 1}
      - {kind: seek, weight: 12, target: [14, 0]}
obstacles: [{centre: [0, 0.3], radius: 0.9}, {centre: [4, -1.6], radius: 0.9}, {centre: [4, 2], radius: 0.9}]
dt: 0.02
""",
    ),
    "chatter": (
        "a goal right behind a large obstacle: on the way around it the threat comes and goes",
        10.0,
        """
groups:
  - {count: 1, radius: 0.2, max_speed: 2, max_force: 6, role: learner, spawn: {low: [-7, -1], high: [-6, 1],
     speed: [2, 2], heading: [1, 0]}}
effects:
  - kind: steer
    behaviours:
      - {kind: avoid_obstacles, weight: 6, horizon: 1.2, margin: 0.1}
      - {kind: separation, weight: 1, radius: 1}
      - {kind: seek, weight: 3, target: [6, 0]}
obstacles: [{centre: [0, 0], radius: 3}]
dt: 0.02
""",
    ),
}
"""What happens, for how long in s, and the scene, as YAML; its arbitration is the variant's."""

VARIANTS: dict[str, Arbitration] = {
    each.kind: each
    for each in (
        Blend(), Priority(), Dithering(), Allocation(), RunningSum(), RoundRobin(), ContextSteering(dangers=1),
    )
}  # fmt: skip


def scene_of(case: str, variant: str) -> Scene:
    """Return the scene of a case, under an arbitration."""
    scene = load_scene(CASES[case][2])
    steer = scene.effects[0]
    assert isinstance(steer, Steer)
    return scene.with_effects(steer.model_copy(update={"arbitration": VARIANTS[variant]}))


def _trial(case: str, variant: str) -> Trial:
    """Run one case under one arbitration, in so many worlds."""
    scene = scene_of(case, variant)
    steer, grants, steps = scene.effects[0], Grants(scene), round(CASES[case][1] / scene.dt)
    assert isinstance(steer, Steer)
    target = np.array(next(b for b in steer.behaviours if b.kind == "seek").parameters()["target"])
    state = scene.start(SEED, worlds=WORLDS)
    began = np.linalg.norm(state.pos - target, axis=-1)
    deep, granted, path = [], [], [state.pos[0].copy()]
    for _ in range(steps):
        granted.append(grants.at(state)[0])
        state = scene.step(state)
        deep.append(depth(scene, state))
        path.append(state.pos[0].copy())
    numbers = _contacts(np.array(deep)) | _grants(granted, scene.dt)
    nearer = began - np.linalg.norm(state.pos - target, axis=-1)
    return Trial(numbers | {"nearer": float(nearer.mean())}, scene, np.array(path))


def _contacts(depth: Floats) -> dict[str, float]:
    """Return numbers about obstacles that were run into; depth (T, B, N) m."""
    inside = depth > 0
    entered = inside[0].sum() + (inside[1:] & ~inside[:-1]).sum()
    return {"collisions": float(entered / inside[0].size), "deepest": float(max(depth.max(), 0.0))}


def _grants(granted: list[Granted], dt: float) -> dict[str, float]:
    """Return numbers about who was heard: whose part of the force is the largest, and with which share."""
    share = np.stack([each.share for each in granted])  # (T, B, N, K)
    wish = np.stack([np.linalg.norm(each.wish, axis=-1) for each in granted])
    part = share * wish
    leader = np.where(part.max(axis=-1) > 0, part.argmax(axis=-1), -1)
    switches = (leader[1:] != leader[:-1]).sum(axis=0).mean() / ((len(leader) - 1) * dt)
    names = granted[0].names
    shares = {
        f"share {name}": float(share[..., k][wish[..., k] > 0].mean()) if (wish[..., k] > 0).any() else np.nan
        for k, name in enumerate(names)
    }
    return {"switches": float(switches), **shares}


def _columns() -> dict[str, str]:
    names = ("avoid_obstacles", "separation", "seek")
    return {
        "collisions": "obstacles run into, per agent",
        "deepest": "m, the deepest that any agent was in an obstacle",
        "nearer": "m, how much nearer to the goal an agent came",
        "switches": "1/s, how often another behaviour has the largest part of the force",
        **{f"share {name}": f"of what {name} wishes for, granted on average while it wishes" for name in names},
    }


EXPERIMENT = Experiment(
    name="arbitration",
    title=f"Arbitrations in conflict, {WORLDS} worlds each",
    cases={name: case[0] for name, case in CASES.items()},
    variants=tuple(VARIANTS),
    columns=_columns(),
    shown=("collisions", "switches"),
    trial=_trial,
)
"""`flockenv experiment arbitration`."""
