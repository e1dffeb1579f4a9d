"""Obstacle avoidance: share of agents that arrive, their time and path length, and collisions.

Reynolds 1988, "Not Bumping Into Things": a force field only brakes an agent that comes head-on, and pushes one that
flies past. Steering to avoid does neither, but like any local method it gets stuck in dead ends; a global path does
not.
"""

from __future__ import annotations

import numpy as np

from flockenv.studies.experiments.experiment import Trial, depth
from flockenv.studies.experiments.plan import SteerPlan

__all__ = ["ARRIVED", "COLUMNS", "SHOWN", "trial"]

ARRIVED = 0.4
"""m, distance from the target within which an agent has arrived."""

COLUMNS = {
    "arrived": f"share that came within {ARRIVED:g} m of the target in time",
    "time": "s until arrival, mean over agents that arrived",
    "path": "path length over the straight distance, of the same agents",
    "speed lost": "share of max_speed, mean until arrival or the end",
    "collisions": "obstacles run into, per agent",
    "deepest": "m, the deepest that any agent was in an obstacle",
}
SHOWN = ("arrived", "time", "collisions")


def trial(plan: SteerPlan, case: str, variant: str) -> Trial:
    """Run one case under one variant, in all worlds of the plan, to the end of its time; measure the first agent.

    Raises ValueError if that agent has no max_speed.
    """
    scene, target = plan.scene_of(case, variant), np.array(plan.cases[case].target)
    fastest = float(scene.body.max_speed[0])
    if not np.isfinite(fastest):
        raise ValueError(
            f"cases.{case}.scene.groups[0].max_speed = None: must be given, in m/s; the loss of speed is a share of it"
        )
    state = scene.start(plan.seed, worlds=plan.worlds)
    begin, path, deep, speed = state.pos[:, 0].copy(), [state.pos[:, 0].copy()], [depth(scene, state)[:, 0]], []
    for _ in range(round(plan.cases[case].seconds / scene.dt)):
        state = scene.step(state)
        path.append(state.pos[:, 0].copy())
        speed.append(np.linalg.norm(state.vel[:, 0], axis=1))
        deep.append(depth(scene, state)[:, 0])
    track, within, fast = np.array(path), np.array(deep), np.array(speed)
    near = np.linalg.norm(track - target, axis=-1) < ARRIVED
    has_arrived = near.any(axis=0)
    last = np.where(has_arrived, near.argmax(axis=0), len(track) - 1)  # (B,) steps until then
    until = np.arange(len(track))[:, None] <= last
    moved = np.linalg.norm(np.diff(track, axis=0), axis=-1)
    length = (moved * until[1:]).sum(axis=0)
    straight = np.linalg.norm(target - begin, axis=1) - ARRIVED
    inside = (within > 0) & until
    lost = 1 - (fast * until[1:]).sum(axis=0) / (fastest * np.maximum(last, 1))
    numbers = {
        "arrived": float(has_arrived.mean()),
        "time": float((last * scene.dt)[has_arrived].mean()) if has_arrived.any() else np.nan,
        "path": float((length / straight)[has_arrived].mean()) if has_arrived.any() else np.nan,
        "speed lost": float(lost.mean()),
        "collisions": float((inside[0] + (inside[1:] & ~inside[:-1]).sum(axis=0)).mean()),
        "deepest": float(max(0.0, (within * until).max())),
    }
    return Trial(numbers, scene, track[: int(last.max()) + 1, :1])
