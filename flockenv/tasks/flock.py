"""Flock: travel together along a given heading, spaced and aligned, without collisions, past obstacles."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.engine import Look
from flockenv.geometry.space import Torus
from flockenv.jit.decorators import kernel, like
from flockenv.jit.intrinsics import tuple_as_array
from flockenv.jit.simd_rows import SIDE
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import norm, scale, sub, unit
from flockenv.model.snapshot import Mark
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.steering import arbitration
from flockenv.tasks.lasting import MEASURES, METRICS, LastingTask, write_aim_measures, write_aim_metrics
from flockenv.tasks.layout import Layout, Slot, slots_of
from flockenv.tasks.observations import local_components, offset, ray_directions, shorten_free_paths
from flockenv.tasks.task import Frame

__all__ = ["Flock"]


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place agents loosely in the middle with random velocities; draw a heading, and obstacles elsewhere, with gaps."""
    turn = 2.0 * math.pi * uniform(frame.key, 0, 9999, 0)
    frame.memory[0, :], frame.memory[1, :] = math.cos(turn), math.sin(turn)
    n = frame.pos.shape[1]
    radius = p.spacing * math.sqrt(n) * 0.8
    for i in range(n):
        for t in range(64):
            r = radius * math.sqrt(uniform(frame.key, t, i, 0))
            a = 2.0 * math.pi * uniform(frame.key, t, i, 1)
            frame.pos[0, i] = p.size / 2 + r * math.cos(a)
            frame.pos[1, i] = p.size / 2 + r * math.sin(a)
            if _is_clear(frame, i, 4.0 * frame.radius[i]):
                break
        course = 2.0 * math.pi * uniform(frame.key, 0, i, 2)
        speed = p.cruise * uniform(frame.key, 0, i, 3)
        frame.vel[0, i], frame.vel[1, i] = speed * math.cos(course), speed * math.sin(course)
    for m in range(frame.rho.shape[0]):
        frame.rho[m] = 0.0
        for t in range(64):
            rho = p.least_radius + (p.greatest_radius - p.least_radius) * uniform(frame.key, t, 20000 + m, 0)
            x = p.size * uniform(frame.key, t, 20000 + m, 1)
            y = p.size * uniform(frame.key, t, 20000 + m, 2)
            away = math.hypot(x - p.size / 2, y - p.size / 2) > radius + rho + 2.0
            if away and _obstacle_fits(p, frame, m, x, y, rho):
                frame.centre[0, m], frame.centre[1, m], frame.rho[m] = x, y, rho
                break


@kernel
def _is_clear(frame: Frame, i: int, distance: float) -> bool:
    """Return True if agent i is at least `distance` m from those placed before it."""
    for j in range(i):
        dx, dy = frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i]
        if math.sqrt(dx * dx + dy * dy) < distance:
            return False
    return True


@kernel
def _obstacle_fits(p: Any, frame: Frame, m: int, x: float, y: float, rho: float) -> bool:
    """Return True if an obstacle at (x, y) leaves a gap of 3 m to those before it."""
    for k in range(m):
        if frame.rho[k] > 0.0:
            dx, dy = offset(frame.centre[0, k], x, p.size), offset(frame.centre[1, k], y, p.size)
            if math.sqrt(dx * dx + dy * dy) < frame.rho[k] + rho + 3.0:
                return False
    return True


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each learner's action as a force in the frame of the heading; flockmates follow `_steer_flockmate`."""
    for i in range(np.uint64(action.shape[0])):  # no branches, so that SIMD is used
        hx, hy = frame.memory[0, i], frame.memory[1, i]
        along, left = action[i, 0] * frame.max_force[i], action[i, 1] * frame.max_force[i]
        force[0, i] = along * hx - left * hy
        force[1, i] = along * hy + left * hx
    for i in range(action.shape[0], frame.pos.shape[1]):
        _steer_flockmate(p, frame, i, force)


_MOST = 32  # limit of `neighbours`
_FAR, _NO_INDEX = (math.inf,) * _MOST, (np.uint64(0),) * _MOST


@kernel
def _steer_flockmate(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write a flockmate's force; priorities: avoid obstacles, separate, align, cohere, follow the heading.

    It reacts to the `neighbours` nearest within sight.
    """
    x, y = frame.pos[0, i], frame.pos[1, i]
    v = (np.float64(frame.vel[0, i]), np.float64(frame.vel[1, i]))
    squares, indices = tuple_as_array(_FAR), tuple_as_array(_NO_INDEX)
    found = _list_nearest(p, frame, i, squares, indices)
    push, sum_v, centre = (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)
    for s in range(found):
        j, square = indices[s], squares[s]
        d = (np.float64(offset(x, frame.pos[0, j], p.size)), np.float64(offset(y, frame.pos[1, j], p.size)))
        one = steering.separate(d, (1.0, 0.0))
        is_near = 1.0 if math.sqrt(square) < p.spacing else 0.0
        push = (push[0] + is_near * one[0], push[1] + is_near * one[1])
        sum_v = (sum_v[0] + frame.vel[0, j], sum_v[1] + frame.vel[1, j])
        centre = (centre[0] + d[0], centre[1] + d[1])
    share = 1.0 / max(np.float64(found), 1.0)
    alignment = steering.align(v, scale(sum_v, share)) if found > 0 else (0.0, 0.0)
    course = (p.cruise * frame.memory[0, i] - v[0], p.cruise * frame.memory[1, i] - v[1])
    avoidance = _avoid_obstacles(p, frame, i, v)
    forces = (avoidance, scale(push, 2.0), scale(alignment, 1.5), scale(centre, 0.3 * share), scale(course, 2.0))
    total = arbitration.allocate(forces, np.float64(frame.max_force[i]))
    force[0, i], force[1, i] = total[0], total[1]


@kernel
def _list_nearest(p: Any, frame: Frame, i: int, squares: Any, indices: Any) -> Any:
    """List the nearest within sight of agent i, ties by index, and squared distances; return their number."""
    one, count, last = np.uint64(1), np.uint64(0), np.uint64(p.neighbours) - np.uint64(1)
    for j in range(np.uint64(frame.pos.shape[1])):
        dx = offset(frame.pos[0, i], frame.pos[0, j], p.size)
        dy = offset(frame.pos[1, i], frame.pos[1, j], p.size)
        square = np.float64(dx * dx + dy * dy)
        if j != np.uint64(i) and frame.alive[j] and square < min(np.float64(p.sight * p.sight), squares[last]):
            place = last
            while place > 0 and square < squares[place - one]:
                squares[place], indices[place] = squares[place - one], indices[place - one]
                place -= one
            squares[place], indices[place] = square, j
            count = min(count + one, last + one)
    return count


@kernel
def _avoid_obstacles(p: Any, frame: Frame, i: int, v: Any) -> Any:
    """Return the force around the obstacle that would be hit first within 2 s, at the force limit."""
    forward = unit(v)
    nearest, position, least_clearance = np.inf, (0.0, 0.0), 0.0
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0:
            dx = offset(frame.pos[0, i], frame.centre[0, m], p.size)
            dy = offset(frame.pos[1, i], frame.centre[1, m], p.size)
            d = (np.float64(dx), np.float64(dy))
            clearance = np.float64(frame.rho[m] + frame.radius[i]) + 0.3
            t = steering.threat(forward, d, clearance, 2.0 * norm(v))
            if t < nearest:
                nearest, position, least_clearance = t, d, clearance
    if nearest < np.inf:
        return steering.avoid(forward, position, least_clearance, np.float64(frame.max_force[i]))
    else:
        return (0.0, 0.0)


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, alignment, spacing, together, touch, obstacle; all of the state after the step."""
    one, o = like(p.sight, 1.0), like(p.sight, 0.0)
    per_cruise, per_spacing, per_slot = one / p.cruise, one / p.spacing, one / p.neighbours
    for i in range(np.uint64(terms.shape[0])):  # no branches, so that SIMD is used
        v = (after.vel[0, i], after.vel[1, i])
        along = v[0] * like(one, after.memory[0, i]) + v[1] * like(one, after.memory[1, i])
        count = after.near_count[i]
        mean, touches, inside = (o, o), o, o
        for s in range(np.uint64(p.listed)):
            exists = np.int32(s) < count
            vx, vy = after.near_vel[0, s, i], after.near_vel[1, s, i]
            mean = (mean[0] + (vx if exists else o), mean[1] + (vy if exists else o))
            contact = after.radius[i] + after.near_radius[s, i]
            touches += one if after.near_square[s, i] < contact * contact else o
        for s in range(np.uint64(p.obstacles_seen)):
            inside += one if after.obstacle_gap[s, i] < after.radius[i] else o
        seen = like(one, count)
        deviation = norm(sub(v, scale(mean, one / max(seen, one)))) * per_cruise if count > 0 else one
        gap = np.sqrt(after.near_square[0, i]) if count > 0 else p.sight
        off_speed, off_place = abs(along - p.cruise) * per_cruise, abs(gap - p.spacing) * per_spacing
        terms[i, at.progress] = p.progress_reward * (one - min(off_speed, one)) * p.control_dt
        terms[i, at.alignment] = -p.alignment_cost * min(deviation, one) * p.control_dt
        terms[i, at.spacing] = -p.spacing_cost * min(off_place, one) * p.control_dt
        terms[i, at.together] = -p.loneliness_cost * (one - seen * per_slot) * p.control_dt
        terms[i, at.touch] = -p.touch_cost * touches * p.control_dt
        terms[i, at.obstacle] = -p.obstacle_cost * inside * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End no learner; return whether the aim holds now: aligned, moving along the heading, no contact."""
    polarisation, along = numbers[at.polarisation], numbers[at.along] = _polarisation_and_speed(after)
    holds = polarisation > 0.9 and along > 0.8 * p.cruise and not _any_agent_touches(after)
    write_aim_measures(p, at, after.step, holds, numbers)
    return holds


_ZEROS = (0.0,) * SIDE
"""A partial sum for each SIMD lane, so that the order of summation is the same on every machine."""


@kernel
def _polarisation_and_speed(frame: Frame) -> tuple[float, float]:
    """Return the polarisation, and the mean speed along the heading, m/s."""
    n, lanes = np.uint64(frame.alive.shape[0]), np.uint64(SIDE)
    o, one, least = like(frame.vel[0, 0], 0.0), like(frame.vel[0, 0], 1.0), like(frame.vel[0, 0], 1e-12)
    ux, uy, along = tuple_as_array(_ZEROS), tuple_as_array(_ZEROS), tuple_as_array(_ZEROS)
    for first in range(np.uint64(0), n, lanes):
        for k in range(lanes):
            i = np.uint64(first + k)
            there, vx, vy = i < n, frame.vel[0, i], frame.vel[1, i]
            speed = np.sqrt(vx * vx + vy * vy)
            share = one / speed if there & (speed > least) else o
            ux[k] += vx * share if there else o
            uy[k] += vy * share if there else o
            along[k] += vx * frame.memory[0, i] + vy * frame.memory[1, i] if there else o
    sum_x, sum_y, sum_along = 0.0, 0.0, 0.0
    for k in range(lanes):
        sum_x, sum_y, sum_along = sum_x + ux[k], sum_y + uy[k], sum_along + along[k]
    return math.sqrt(sum_x * sum_x + sum_y * sum_y) / n, sum_along / n


@kernel
def _any_agent_touches(frame: Frame) -> bool:
    """Return True if an agent touches its nearest neighbour or its nearest obstacle."""
    touching = np.int32(0)  # a count vectorises; of an early exit LLVM makes a scalar search
    for i in range(np.uint64(frame.alive.shape[0])):
        touching += np.int32(1) if _touches(frame, i) else np.int32(0)
    return bool(touching > np.int32(0))


@kernel
def _touches(frame: Frame, i: int) -> Any:
    """Return True if agent i touches its nearest neighbour or obstacle; a missing one is infinitely far."""
    contact = frame.radius[i] + frame.near_radius[0, i]
    return (frame.near_square[0, i] < contact * contact) | (frame.obstacle_gap[0, i] < frame.radius[i])


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write the mean nearest distance in sight, m, and contacts that began; `ended` writes the order measures."""
    numbers[at.nearest] = _mean_nearest_distance(p, after)
    numbers[at.touches] = _count_new_contacts(p, before, after) if _any_agent_touches(after) else 0.0


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write polarisation, nearest distance, m, and speed along, m/s (means); contacts that began; the aim's."""
    n = max(steps, 1)
    write_aim_metrics(at, sums, last, steps, numbers)
    numbers[at.polarisation], numbers[at.nearest_neighbour] = sums.polarisation / n, sums.nearest / n
    numbers[at.collisions], numbers[at.speed_along] = sums.touches, sums.along / n


@kernel
def _mean_nearest_distance(p: Any, frame: Frame) -> float:
    """Return the mean distance of the nearest neighbour, m; `sight` counts for an agent that sees none."""
    n, lanes, sums = np.uint64(frame.alive.shape[0]), np.uint64(SIDE), tuple_as_array(_ZEROS)
    for first in range(np.uint64(0), n, lanes):
        for k in range(lanes):
            i = np.uint64(first + k)
            root = np.sqrt(frame.near_square[0, i])
            distance = root if frame.near_count[i] > 0 else like(root, p.sight)  # no branch, so that SIMD is used
            sums[k] += distance if i < n else like(distance, 0.0)
    mean = 0.0
    for k in range(lanes):
        mean += sums[k]
    return mean / n


@kernel
def _count_new_contacts(p: Any, before: Frame, after: Frame) -> float:
    """Return the number of contacts that began in this step, of two agents, or of an agent and an obstacle."""
    began = 0.0
    for i in range(after.alive.shape[0]):
        if not _touches(after, i):
            continue
        for s in range(after.near_count[i]):
            j = after.near_index[s, i]
            contact = after.radius[i] + after.radius[j]
            if after.near_square[s, i] >= contact * contact:
                break
            began += 0.0 if _was_near(p, before, i, before.pos[0, j], before.pos[1, j], contact) else 0.5
        for s in range(after.obstacle_count[i]):
            m = after.obstacle_index[s, i]
            if after.obstacle_gap[s, i] < after.radius[i]:
                clearance = after.rho[m] + after.radius[i]
                began += 0.0 if _was_near(p, before, i, after.centre[0, m], after.centre[1, m], clearance) else 1.0
    return began


@kernel
def _was_near(p: Any, frame: Frame, i: int, x: float, y: float, contact: float) -> bool:
    """Return True if agent i was nearer than `contact` m to the point (x, y)."""
    dx, dy = offset(frame.pos[0, i], x, p.size), offset(frame.pos[1, i], y, p.size)
    return dx * dx + dy * dy < contact * contact


@kernel
def abreast(p: Any, at: Any, frame: Frame, columns: Any) -> None:
    """Write own velocity, nearest neighbours and obstacles, in the frame of the heading: (along, left)."""
    n, one = np.uint64(columns.shape[0]), like(p.sight, 1.0)
    listed, seen = np.uint64(p.listed), np.uint64(p.obstacles_seen)
    scales = (one / p.sight, like(one, 0.5) / p.max_speed, one / p.spacing)
    for i in range(n):
        own = local_components((frame.vel[0, i], frame.vel[1, i]), _heading(p, frame, i), like(one, 2.0) * scales[1])
        columns[i, at.velocity], columns[i, at.velocity + 1] = own[0], own[1]
    for s in range(listed):
        for i in range(n):
            _write_neighbour(p, at, frame, i, s, scales, columns)
    shown = seen if frame.rho.shape[0] > 0 else np.uint64(0)
    for s in range(shown):
        for i in range(n):
            _write_obstacle(p, at, frame, i, s, columns)
    for s in range(shown, seen):
        for c in (at.obstacles + 2 * s, at.obstacles + 2 * s + 1, at.obstacle_radius + s):
            columns[:, c] = like(p.sight, 0.0)


@kernel
def _heading(p: Any, frame: Frame, i: int) -> Any:
    """Return the heading, in the precision of the scene."""
    return (like(p.sight, frame.memory[0, i]), like(p.sight, frame.memory[1, i]))


@kernel
def _write_neighbour(p: Any, at: Any, frame: Frame, i: int, s: int, scales: Any, columns: Any) -> None:
    """Write the offset, relative velocity, presence and crowding of agent i's s-th nearest neighbour.

    Zeros if there is none. The values are computed in any case: an empty entry of the list holds a valid index.
    """
    o, one, two, heading = like(p.sight, 0.0), like(p.sight, 1.0), np.uint64(2), _heading(p, frame, i)
    exists = np.int32(s) < frame.near_count[i]
    x, y = frame.near_pos[0, s, i], frame.near_pos[1, s, i]
    to = (offset(frame.pos[0, i], x, p.size), offset(frame.pos[1, i], y, p.size))
    relative = (frame.near_vel[0, s, i] - frame.vel[0, i], frame.near_vel[1, s, i] - frame.vel[1, i])
    distance = np.sqrt(frame.near_square[s, i])
    closeness = one - distance * scales[2]
    crowded = (closeness > o) & (distance > o)
    to_local, relative_local = local_components(to, heading, scales[0]), local_components(relative, heading, scales[1])
    _write_if(exists, columns, i, np.uint64(at.neighbours) + two * s, to_local)
    _write_if(exists, columns, i, np.uint64(at.neighbour_velocity) + two * s, relative_local)
    columns[i, np.uint64(at.neighbour_present) + s] = one if exists else o
    crowding = local_components(to, heading, closeness / distance if crowded else o)
    _write_if(exists, columns, i, np.uint64(at.crowding) + two * s, crowding)


@kernel
def _write_obstacle(p: Any, at: Any, frame: Frame, i: int, s: int, columns: Any) -> None:
    """Write the offset and radius of agent i's s-th nearest obstacle, or zeros.

    As with neighbours, an empty entry of the list holds a valid index if there are obstacles at all.
    """
    exists = np.int32(s) < frame.obstacle_count[i]
    centre, rho = _obstacle(frame, i, s)
    o = like(rho, 0.0)
    to = (offset(frame.pos[0, i], centre[0], p.size), offset(frame.pos[1, i], centre[1], p.size))
    vector = local_components(to, _heading(p, frame, i), like(o, 1.0) / (p.sight + p.greatest_radius))
    _write_if(exists, columns, i, np.uint64(at.obstacles) + np.uint64(2) * s, vector)
    columns[i, np.uint64(at.obstacle_radius) + s] = rho / p.greatest_radius if exists else o


@kernel
def _obstacle(frame: Frame, i: int, s: int) -> Any:
    """Return centre and radius of the s-th nearest obstacle of agent i."""
    m = np.uint64(frame.obstacle_index[s, i])
    return (frame.centre[0, m], frame.centre[1, m]), frame.rho[m]


@kernel
def _write_if(exists: Any, columns: Any, i: int, at: Any, vector: Any) -> None:
    """Write two numbers of agent i from column `at` on, or zeros."""
    o = like(vector[0], 0.0)
    columns[i, at] = vector[0] if exists else o
    columns[i, at + np.uint64(1)] = vector[1] if exists else o


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write the free path lengths, anticlockwise from the heading, and zeros in slots beyond the neighbour list."""
    slots, listed, rays = int(p.neighbours), int(p.listed), int(p.rays)
    for i in range(rows.shape[0]):
        row, heading = rows[i], _heading(p, frame, i)
        for r in range(np.uint64(rays)):
            row[np.uint64(at.free_way) + r] = 1.0
        for first, width in (
            (at.neighbours, 2), (at.neighbour_velocity, 2), (at.neighbour_present, 1), (at.crowding, 2),
        ):  # fmt: skip
            for c in range(first + width * listed, first + width * slots):
                row[np.uint64(c)] = 0.0
        for s in range(frame.obstacle_count[i]):
            centre, rho = _obstacle(frame, i, s)
            to = (offset(frame.pos[0, i], centre[0], p.size), offset(frame.pos[1, i], centre[1], p.size))
            shorten_free_paths(row, at.free_way, rays, frame.table, to, heading, rho + frame.radius[i], p.sight)


class Flock(LastingTask):
    """N learners with one shared policy (or one among scripted flockmates) travel along a heading as a flock.

    Agents start as a loose crowd with random velocities, in a periodic field with round obstacles. Observations are
    relative to the agent, in the frame of the heading. No agent is removed; contacts cost as long as they last.

    The aim holds while the polarisation is above 0.9, the mean speed along the heading above 0.8 `cruise`, and no agent
    touches another or an obstacle. Success: it holds in the share `lasting` of the decisions after `settling` s.
    """

    name: ClassVar[str] = "flock"
    terms: ClassVar[tuple[str, ...]] = ("progress", "alignment", "spacing", "together", "touch", "obstacle")
    metric_names: ClassVar[tuple[str, ...]] = (
        "polarisation",
        "nearest_neighbour",
        "collisions",
        "speed_along",
        *METRICS,
    )
    measures: ClassVar[tuple[str, ...]] = ("polarisation", "nearest", "touches", "along", *MEASURES)
    counts: ClassVar[tuple[str, ...]] = ("neighbours", "listed", "obstacles_seen", "rays")
    memory: ClassVar[int] = 2

    agents: int = Field(default=24, ge=1, le=100_000, description="number of agents")
    learners: int = Field(
        default_factory=lambda given: given.get("agents", 24), ge=1,
        description="number of learners (default of the task: all); the others are scripted",
    )  # fmt: skip
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    size: float = Field(default=40.0, gt=14, description="m, edge of the periodic field")
    obstacle_count: int = Field(
        default=6, ge=0, le=200, description="number of obstacles; those that do not fit are left out"
    )
    least_radius: float = Field(default=0.8, gt=0, description="m, least radius of an obstacle")
    greatest_radius: float = Field(default=2.0, gt=0, description="m, greatest radius of an obstacle")
    cruise: float = Field(default=2.0, gt=0, description="m/s, desired speed along the heading")
    max_speed: float = Field(default=3.0, gt=0, description="m/s")
    max_force: float = Field(default=4.0, gt=0, description="N; the mass is 1 kg")
    spacing: float = Field(default=1.5, gt=0, description="m, desired distance of the nearest neighbour")
    sight: float = Field(default=6.0, gt=0, description="m, range within which neighbours and obstacles are seen")
    neighbours: int = Field(default=6, ge=1, le=_MOST, description="number of neighbours seen, nearest first")
    obstacles_seen: int = Field(default=2, ge=1, le=32, description="number of obstacles seen, nearest surface first")
    rays: int = Field(default=16, ge=1, le=128, description="number of directions in which the free path is seen")
    progress_reward: float = Field(default=1.0, ge=0, description="per s at cruising speed along the heading")
    alignment_cost: float = Field(
        default=0.5, ge=0, description="per s at a velocity that differs from the neighbours' mean by `cruise`"
    )
    spacing_cost: float = Field(
        default=0.5, ge=0, description="per s at a nearest distance that differs from `spacing` by 100 %"
    )
    loneliness_cost: float = Field(default=0.5, ge=0, description="per s without any neighbour in sight")
    touch_cost: float = Field(default=10.0, ge=0, description="per s and agent touched")
    obstacle_cost: float = Field(default=10.0, ge=0, description="per s and obstacle touched")

    @model_validator(mode="after")
    def _check_numbers(self) -> Flock:
        """Raise ValueError for more learners than agents, radii in the wrong order, or sight above half the field."""
        if self.learners > self.agents:
            raise ValueError(f"learners = {self.learners}: there are only {self.agents} agents")
        if self.least_radius > self.greatest_radius:
            raise ValueError(
                f"least_radius = {self.least_radius:g} is above greatest_radius = {self.greatest_radius:g}"
            )
        if self.sight > self.size / 2:
            raise ValueError(f"sight = {self.sight:g} m reaches around the field; at most size / 2 = {self.size / 2:g}")
        return self

    @property
    def agent_names(self) -> tuple[str, ...]:
        """boid_0 ..."""
        return tuple(f"boid_{i}" for i in range(self.learners))

    @property
    def abreast(self) -> int:
        """How many numbers the kernel `abreast` writes: all but the free path lengths."""
        return self.layout.size - self.rays

    @property
    def obstacle_slots(self) -> int:
        """M: the number of obstacles."""
        return self.obstacle_count

    @functools.cached_property
    def scene(self) -> Scene:
        """A periodic square, in which only the agents' own forces act."""
        limits: dict[str, Any] = {"radius": 0.3, "max_speed": self.max_speed, "max_force": self.max_force}
        groups = [Group(count=self.learners, role="learner", **limits)]
        if self.agents > self.learners:
            groups.append(Group(count=self.agents - self.learners, role="flockmate", **limits))
        return Scene(
            space=Torus(size=(self.size, self.size)),
            groups=tuple(groups),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def _list_length(self) -> int:
        """Length of the neighbour lists; at least 1, also for a single agent."""
        return min(self.neighbours, max(self.agents - 1, 1))

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the length of neighbour lists."""
        return {**super().parameters(), "listed": float(self._list_length)}

    @property
    def look(self) -> Look:
        """The nearest flockmates and obstacles."""
        return Look(self.sight, self._list_length, self.obstacles_seen)

    def table(self) -> tuple[float, ...]:
        """Return the directions of the rays."""
        return ray_directions(self.rays)

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; every vector is (along the heading, to its left)."""
        n, m = self.neighbours, self.obstacles_seen
        paths = "free path length of the body to the nearest obstacle in each direction, anticlockwise from the heading"
        here = "1 for each neighbour, 0 for an empty slot, whose other numbers are also 0"
        crowding = "unit vectors towards them, times 1 - distance / spacing; 0 for a distance above the spacing"
        seen = "offsets of the centres of the nearest obstacles, nearest surface first; zeros: empty slot"
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (along the heading, to its left)"),
            *slots_of("neighbours",
                Slot("neighbours", (n, 2), self.sight, "m", "offsets of the nearest neighbours, nearest first"),
                Slot("neighbour_velocity", (n, 2), 2 * self.max_speed, "m/s", "their velocities minus the agent's own"),
                Slot("neighbour_present", (n,), 1.0, "1", here, low=0.0),
                Slot("crowding", (n, 2), 1.0, "1", crowding),
            ),
            *slots_of("obstacles",
                Slot("obstacles", (m, 2), self.sight + self.greatest_radius, "m", seen),
                Slot("obstacle_radius", (m,), self.greatest_radius, "m", "their radii; 0: empty slot", low=0.0),
            ),
            Slot("free_way", (self.rays,), self.sight, "m", paths, low=0.0),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force in the frame of the heading."""
        meaning = "force (along the heading, to its left) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark that shows the heading."""
        at = np.array([0.13, 0.82]) * self.size
        return (Mark("heading", at, memory[:2, world, 0], 0.0),)
