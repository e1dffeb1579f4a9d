"""Arbitration of behaviours that contradict each other: collisions, and the share granted to each behaviour.

Reynolds 1987: the sum of "left, around the obstacle" and "right, towards the flock" leads straight into the obstacle;
and in an emergency the most urgent behaviour must not share a bounded force with all others.
"""

from __future__ import annotations

import numpy as np

from flockenv.model.state import Floats
from flockenv.studies.arbitration_trace import Grants, SteerShares
from flockenv.studies.experiments.experiment import Trial, depth
from flockenv.studies.experiments.plan import SteerPlan

__all__ = ["COLUMNS", "SHOWN", "more_columns", "trial"]

COLUMNS = {
    "collisions": "obstacles run into, per agent",
    "deepest": "m, the deepest that any agent was in an obstacle",
    "nearer": "m, how much nearer to the goal an agent came",
    "switches": "1/s, how often another behaviour has the largest part of the force",
}
SHOWN = ("collisions", "switches")


def more_columns(plan: SteerPlan) -> dict[str, str]:
    """Return a column for every behaviour of the cases."""
    scenes = (plan.scene_of(case, variant) for case in plan.cases for variant in plan.variants)
    names = dict.fromkeys(behaviour.kind for scene in scenes for behaviour in scene.effects[0].components)
    return {f"share {name}": f"of what {name} wishes for, granted on average while it wishes" for name in names}


def trial(plan: SteerPlan, case: str, variant: str) -> Trial:
    """Run one case under one variant, in all worlds of the plan."""
    scene, target = plan.scene_of(case, variant), np.array(plan.cases[case].target)
    grants, steps = Grants(scene), round(plan.cases[case].seconds / scene.dt)
    state = scene.start(plan.seed, worlds=plan.worlds)
    began = np.linalg.norm(state.pos - target, axis=-1)
    deep, instants, path = [], [], [state.pos[0].copy()]
    for _ in range(steps):
        instants.append(grants.at(state)[0])
        state = scene.step(state)
        deep.append(depth(scene, state))
        path.append(state.pos[0].copy())
    numbers = _contacts(np.array(deep)) | _shares_and_switches(instants, scene.dt)
    nearer = began - np.linalg.norm(state.pos - target, axis=-1)
    return Trial(numbers | {"nearer": float(nearer.mean())}, scene, np.array(path))


def _contacts(depth: Floats) -> dict[str, float]:
    """Return the collisions with obstacles and the greatest depth in one; depth (T, B, N) m."""
    inside = depth > 0
    entered = inside[0].sum() + (inside[1:] & ~inside[:-1]).sum()
    return {"collisions": float(entered / inside[0].size), "deepest": float(max(depth.max(), 0.0))}


def _shares_and_switches(instants: list[SteerShares], dt: float) -> dict[str, float]:
    """Return how often the behaviour with the largest part of the force changes, and the mean share of each."""
    share = np.stack([each.share for each in instants])  # (T, B, N, K)
    size = np.stack([np.linalg.norm(each.requested, axis=-1) for each in instants])
    part = share * size
    leader = np.where(part.max(axis=-1) > 0, part.argmax(axis=-1), -1)
    switches = (leader[1:] != leader[:-1]).sum(axis=0).mean() / ((len(leader) - 1) * dt)
    names = instants[0].names
    shares = {
        f"share {name}": float(share[..., k][size[..., k] > 0].mean()) if (size[..., k] > 0).any() else np.nan
        for k, name in enumerate(names)
    }
    return {"switches": float(switches), **shares}
