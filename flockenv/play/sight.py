"""Sight: what moves one agent and what it observes: forces by effect and behaviour, neighbours, numbers, its path."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.behaviours.steer import Steer
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Sight
from flockenv.physics.integrators import ImplicitEuler
from flockenv.play.fields import scene_of
from flockenv.play.lane import Lane, collected_warnings
from flockenv.play.scene_lane import SceneLane
from flockenv.play.task_lane import TaskLane
from flockenv.scene import Scene
from flockenv.studies.arbitration_trace import Grants

__all__ = ["AHEAD", "look", "neighbours_in", "prepare_look"]

AHEAD = 2.0
"""Time of a predicted path, s."""

POINTS, WORK = 24, 400_000
"""Points of a predicted path; agent-steps that its prediction may take: of more agents it is shorter."""


def look(lane: Lane, agent: int) -> dict[str, Any]:
    """Return all about one agent now, as JSON: numbers that are not finite are None.

    agent, role, group, pos, vel, mass, radius, inner; forces: name, path, kind (effect, behaviour, drive, total),
    vector, N, and of behaviours `granted`, the share of it that was granted; neighbours: indices; view: the widest
    sight, radius and fov; observation: slots with name, unit, meaning, low, value; reward: terms so far; path: points
    of the next AHEAD seconds without further edits. Raises ValueError if there is no such living agent.

    Its first call for a scene compiles kernels, which may take some seconds, unless `prepare_look` has done it.
    """
    scene, state = scene_of(lane), _state_of(lane)
    if not 0 <= agent < scene.agents or not state.alive[0, agent]:
        raise ValueError(f"agent = {agent}: there is no such living agent among {scene.agents}")
    path = _path(lane, scene, agent)
    state = _state_of(lane)  # the path has been taken back
    group = int(np.searchsorted(scene.starts, agent, side="right")) - 1
    sights = _sights(scene)
    near = sorted({j for _, sight in sights for j in neighbours_in(scene, state, agent, sight)})
    widest = max((sight for _, sight in sights), key=lambda sight: sight.radius, default=None)
    about = {
        "agent": agent, "role": lane.snapshot().roles[agent], "group": group, "pos": state.pos[0, agent],
        "vel": state.vel[0, agent], "mass": scene.body.mass[agent], "radius": scene.body.radius[agent],
        "inner": {name: scene.inner(state, name)[0, agent] for name in scene.parts.inner},
        "forces": _forces(lane, scene, state, agent), "neighbours": near,
        "view": None if widest is None else {"radius": widest.radius, "fov": widest.fov},
        "path": path, **_seen(lane, agent),
    }  # fmt: skip
    found: dict[str, Any] = _json(about)
    return found


def prepare_look(lane: Lane) -> None:
    """Compile what `look` needs, in any thread: forces by effect and by behaviour."""
    _prepare(scene_of(lane))


@functools.lru_cache(maxsize=8)
def _prepare(scene: Scene) -> None:
    """Compute the forces of a scene once, at its start: they have one kernel, and those of each `Steer` another."""
    with collected_warnings():
        state = scene.start(0)
    scene.acceleration(state)
    for single in _alone(scene):
        single.acceleration(state)
    if (grants := _grants(scene)) is not None:
        grants.at(state)


def _state_of(lane: Lane) -> State:
    if isinstance(lane, TaskLane):
        return lane.world.state
    assert isinstance(lane, SceneLane)
    return lane.state


def _json(value: Any) -> Any:
    """Return a value without arrays; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {key: _json(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json(each) for each in value]
    if isinstance(value, np.ndarray):
        return _json(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


# --- forces -----------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=8)
def _alone(scene: Scene) -> tuple[Scene, ...]:
    """Return the scene with one of its effects each, the others idle: the same compiled code for all."""
    with collected_warnings():
        idle = tuple(effect.idle_copy() for effect in scene.effects)
        sets = [(*idle[:k], effect, *idle[k + 1 :]) for k, effect in enumerate(scene.effects)]
        # nothing is stepped: with a method without a limit no dt is warned of or rejected
        return tuple(scene.model_copy(update={"effects": each, "integrator": ImplicitEuler()}) for each in sets)


@functools.lru_cache(maxsize=4)
def _grants(scene: Scene) -> Grants | None:
    with collected_warnings():
        return Grants(scene) if any(isinstance(effect, Steer) for effect in scene.effects) else None


def _forces(lane: Lane, scene: Scene, state: State, agent: int) -> list[dict[str, Any]]:
    """Return the forces on an agent, N: of each effect, of each behaviour, of the drive, and their sum."""
    mass = float(scene.body.mass[agent])
    mass = mass if np.isfinite(mass) else 0.0
    counted = state.copy()  # acceleration() counts its work in the state
    found: list[dict[str, Any]] = []
    for k, single in enumerate(_alone(scene)):
        vector = single.acceleration(counted)[0, agent] * mass
        found.append({"name": scene.effects[k].kind, "path": f"effects[{k}]", "kind": "effect", "vector": vector})
    found += _behaviours(scene, counted, agent)
    drive = _drive(lane, scene, agent)
    if drive is not None:
        found.append({"name": "drive", "path": None, "kind": "drive", "vector": drive})
    whole = np.zeros(state.shape)
    if drive is not None:
        whole[0, agent] = drive
    total = scene.acceleration(counted, whole)[0, agent] * mass
    return [*found, {"name": "total", "path": None, "kind": "total", "vector": total}]


def _behaviours(scene: Scene, state: State, agent: int) -> list[dict[str, Any]]:
    """Return the steering force of each behaviour of the agent's `Steer` effects, and the share granted."""
    grants = _grants(scene)
    found = []
    for each in grants.at(state) if grants is not None else ():
        for k, name in enumerate(each.names):
            vector = each.requested[0, agent, k]
            if each.steer.group is None or scene.starts[each.steer.group] <= agent < scene.starts[each.steer.group + 1]:
                path = f"effects[{each.effect}].behaviours[{k}]"
                share = each.share[0, agent, k]
                found.append({"name": name, "path": path, "kind": "behaviour", "vector": vector, "granted": share})
    return found


def _drive(lane: Lane, scene: Scene, agent: int) -> NDArray[Any] | None:
    """Return the driving force of a learner's last action, or of the pointer, N; None without one."""
    if isinstance(lane, TaskLane):
        if agent >= lane.record.learners:
            return None
        force = lane.record.action_layout.unpack(lane.actions[agent])
        vector = next(iter(vars(force).values()))
        return np.asarray(vector) if np.shape(vector) == (scene.dimension,) else None
    assert isinstance(lane, SceneLane)
    return None if lane.pointer is None else lane.pointer_force(lane.pointer)[0, agent]


# --- neighbours and numbers -------------------------------------------------------------------------------------------


def _sights(scene: Scene) -> list[tuple[Effect, Sight]]:
    """Return the effects and behaviours that see neighbours, each with its sight."""
    every = [each for effect in scene.effects for each in (effect.components or (effect,))]
    return [(each, each.sight) for each in every if each.sight is not None]


def neighbours_in(scene: Scene, state: State, agent: int, sight: Sight) -> list[int]:
    """Return the agents that one sees in the first world, before obstacles hide any: as the neighbour query does."""
    pos, heading = np.asarray(state.pos[0], float), np.asarray(state.heading[0, agent], float)
    offset = scene.space.displacement(pos[agent], pos)
    distance = np.linalg.norm(offset, axis=1)
    seen = state.alive[0] & (distance < sight.radius)
    seen[agent] = False
    if sight.group is not None:
        who = np.arange(scene.agents)
        seen &= (who >= scene.starts[sight.group]) & (who < scene.starts[sight.group + 1])
    if sight.fov < 360 and heading.any():
        ahead = offset @ heading / np.linalg.norm(heading)
        seen &= ahead >= np.cos(np.radians(sight.fov / 2)) * distance
    found = np.flatnonzero(seen)
    if sight.nearest is not None and len(found) > sight.nearest:
        limit = np.sort(distance[found])[sight.nearest - 1]
        found = found[distance[found] <= limit]
    return [int(k) for k in found]


def _seen(lane: Lane, agent: int) -> dict[str, Any]:
    """Return what a learner observes by slot, its last action, and its reward terms so far; {} of other agents."""
    if not isinstance(lane, TaskLane) or agent >= lane.record.learners:
        return {"observation": [], "reward": []}
    task, row = lane.record, lane.observation[agent]
    slots, at = [], 0
    for slot in task.layout.slots:
        value = (row[at : at + slot.size].astype(float) * slot.scale).reshape(slot.shape)
        about = {"name": slot.name, "unit": slot.unit, "meaning": slot.meaning}
        slots.append({**about, "low": slot.low * slot.scale, "high": slot.scale, "value": value})
        at += slot.size
    reward = [{"name": name, "total": total} for name, total in zip(task.terms, lane.world.paid[0, agent], strict=True)]
    return {"observation": slots, "reward": reward, "action": lane.actions[agent], "player": lane.players[agent]}


def _path(lane: Lane, scene: Scene, agent: int) -> list[Any]:
    """Return the places of an agent over the next AHEAD seconds, from here on; the lane stays as it is."""
    if lane.stopped or (isinstance(lane, TaskLane) and any(name in lane.files.names for name in lane.players)):
        return []  # what a player file keeps to itself could not be put back
    per_tick = lane.per_tick if isinstance(lane, SceneLane) else lane.record.substeps
    ticks = min(round(AHEAD / lane.interval), WORK // (scene.agents * per_tick))
    kept, stride = lane.keep(), max(1, ticks // POINTS)
    points = []
    try:
        for _ in range(0, ticks, stride):
            points.append(lane.drawn.pos[:, agent].copy())
            before = lane.tick
            lane.step(stride)
            if lane.tick < before + stride:
                break  # it has stopped
    finally:
        lane.restore(kept)
    return points
