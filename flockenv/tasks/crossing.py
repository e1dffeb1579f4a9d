"""Crossing: agents start on a circle and walk to the opposite points; all paths meet in the middle."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.engine import Look
from flockenv.geometry.space import Plane
from flockenv.jit.decorators import kernel, like
from flockenv.jit.intrinsics import tuple_as_array
from flockenv.maths.counter_rng import uniform
from flockenv.model.snapshot import Mark
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.steering import orca
from flockenv.tasks.layout import Layout, Slot
from flockenv.tasks.observations import local_components, neighbour_slots, write_neighbour, write_vector
from flockenv.tasks.task import Frame, Task

__all__ = ["Crossing"]

_AVOIDED = 6  # neighbours that a scripted walker avoids
_EMPTY = (0.0,) * (_AVOIDED * orca.SLOT)


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place agents at rest, evenly around a circle with some jitter; the goal of each is the opposite point."""
    n = frame.pos.shape[1]
    first = 2.0 * math.pi * uniform(frame.key, 0, 9999, 0)
    for i in range(n):
        off = p.jitter * (2.0 * uniform(frame.key, 0, i, 0) - 1.0)
        angle = first + 2.0 * math.pi * (i + off) / n
        r = p.circle * (1.0 + 0.05 * p.jitter * (2.0 * uniform(frame.key, 0, i, 1) - 1.0))
        c, s = math.cos(angle), math.sin(angle)
        frame.pos[0, i], frame.pos[1, i] = r * c, r * s
        frame.vel[0, i], frame.vel[1, i] = 0.0, 0.0
        frame.memory[0, i], frame.memory[1, i] = -r * c, -r * s
        frame.memory[2, i], frame.memory[3, i] = -c, -s


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each learner's action as a force in the frame of its course; the others avoid neighbours by ORCA."""
    for i in range(frame.pos.shape[1]):
        if i < action.shape[0]:
            hx, hy = frame.memory[2, i], frame.memory[3, i]
            along, left = action[i, 0] * frame.max_force[i], action[i, 1] * frame.max_force[i]
            force[0, i] = along * hx - left * hy
            force[1, i] = along * hy + left * hx
        else:
            _steer_walker(p, frame, i, force)


@kernel
def _steer_walker(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write the force of a scripted walker by ORCA: the collision-free velocity (2 s) nearest to that to its goal."""
    neighbours, lines, relaxed = tuple_as_array(_EMPTY), tuple_as_array(_EMPTY), tuple_as_array(_EMPTY)
    v = (np.float64(frame.vel[0, i]), np.float64(frame.vel[1, i]))
    count, previous, previous_square = 0, -1, -1.0
    for _ in range(_AVOIDED):
        j, square = _next_nearest(p, frame, i, previous, previous_square)
        if j < 0:
            break
        at, previous, previous_square = orca.SLOT * count, j, square
        for k in range(2):
            neighbours[at + k] = frame.pos[k, j] - frame.pos[k, i]
            neighbours[at + 2 + k] = frame.vel[k, j]
        neighbours[at + 4], neighbours[at + 5] = frame.radius[j] + 0.1, 0.5
        count += 1
    gx, gy = _goal_offset(frame, i)
    distance = math.sqrt(gx * gx + gy * gy)
    top = np.float64(frame.max_speed[i])
    share = min(top, distance) / max(distance, 1e-9)
    desired = ((gx * share, gy * share), top, 0.3)
    change = orca.orca_change(
        v, np.float64(frame.radius[i]), desired, 2.0, p.control_dt, neighbours, count, lines, relaxed
    )
    fx, fy = change[0] / p.control_dt, change[1] / p.control_dt
    factor = min(1.0, frame.max_force[i] / max(math.sqrt(fx * fx + fy * fy), 1e-9))
    force[0, i], force[1, i] = factor * fx, factor * fy


@kernel
def _next_nearest(p: Any, frame: Frame, i: int, previous: int, previous_square: float) -> tuple[int, float]:
    """Return the nearest agent to i after `previous`, in sight, ties by index, and its squared distance; or -1."""
    least, nearest = np.float64(p.sight * p.sight), -1
    for j in range(frame.pos.shape[1]):
        dx, dy = frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i]
        square = np.float64(dx * dx + dy * dy)
        beyond = square > previous_square or (square == previous_square and j > previous)
        if j != i and frame.alive[j] and beyond and square < least:
            least, nearest = square, j
    return nearest, least


@kernel
def _goal_offset(frame: Frame, i: int) -> tuple[float, float]:
    """Return the offset from agent i to its goal, m."""
    return frame.memory[0, i] - np.float64(frame.pos[0, i]), frame.memory[1, i] - np.float64(frame.pos[1, i])


@kernel
def _goal_distance(frame: Frame, i: int) -> float:
    """Return the distance from agent i to its goal, m."""
    x, y = _goal_offset(frame, i)
    return math.sqrt(x * x + y * y)


@kernel
def _count_touches(frame: Frame, i: int) -> float:
    """Return the number of agents that agent i touches."""
    touches = 0.0
    for s in range(frame.near_count[i]):
        contact = frame.radius[i] + frame.radius[frame.near_index[s, i]]
        touches += 1.0 if frame.near_square[s, i] < contact * contact else 0.0
    return touches


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, arrival (taken back on leaving), touch, time (while away from the goal), effort."""
    for i in range(terms.shape[0]):
        before_distance, distance = _goal_distance(before, i), _goal_distance(after, i)
        arrivals = (1.0 if distance <= p.goal_radius else 0.0) - (1.0 if before_distance <= p.goal_radius else 0.0)
        push = action[i, 0] * action[i, 0] + action[i, 1] * action[i, 1]
        terms[i, at.progress] = p.progress_reward * (before_distance - distance)
        terms[i, at.arrival] = p.arrival_reward * arrivals
        terms[i, at.touch] = -p.touch_cost * _count_touches(after, i) * p.control_dt
        terms[i, at.time] = -p.time_cost * p.control_dt if distance > p.goal_radius else 0.0
        terms[i, at.effort] = -p.effort_cost * min(push, 1.0) * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End all learners once every one is at its goal, which is success."""
    all_there = True
    for i in range(over.shape[0]):
        all_there &= _goal_distance(after, i) <= p.goal_radius
    for i in range(over.shape[0]):
        over[i] = all_there
    return all_there


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write the learners' contacts that began; share at the goal; mean metres gained, and walked."""
    learners = int(p.learners)
    began, at_goal, gained, walked = 0.0, 0.0, 0.0, 0.0
    for i in range(learners):
        distance = _goal_distance(after, i)
        at_goal += 1.0 if distance <= p.goal_radius else 0.0
        gained += _goal_distance(before, i) - distance
        walked += math.hypot(after.pos[0, i] - before.pos[0, i], after.pos[1, i] - before.pos[1, i])
        for s in range(after.near_count[i]):
            j = after.near_index[s, i]
            contact = after.radius[i] + after.radius[j]
            if after.near_square[s, i] >= contact * contact:
                break
            x, y = before.pos[0, j] - before.pos[0, i], before.pos[1, j] - before.pos[1, i]
            both = 0.5 if j < learners else 1.0  # a pair of learners is counted from both sides
            began += both if x * x + y * y >= contact * contact else 0.0
    numbers[at.touches], numbers[at.there] = began, at_goal / learners
    numbers[at.gained], numbers[at.walked] = gained / learners, walked / learners


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write contacts that began; mean time away from the goal, s; last share at the goal; metres gained / walked."""
    numbers[at.collisions] = sums.touches
    numbers[at.time_to_goal] = (steps - sums.there) * p.control_dt
    numbers[at.arrived] = last.there
    numbers[at.path_efficiency] = sums.gained / max(sums.walked, 1e-9)


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, offset of the goal, nearest neighbours, in the frame of the course: (along, left)."""
    one = like(p.sight, 1.0)
    for i in range(rows.shape[0]):
        row, course = rows[i], (frame.memory[2, i], frame.memory[3, i])
        for c in range(rows.shape[1]):
            row[np.uint64(c)] = 0.0
        write_vector(row, at.velocity, local_components((frame.vel[0, i], frame.vel[1, i]), course, one / p.max_speed))
        write_vector(row, at.goal, local_components(_goal_offset(frame, i), course, one / (3.0 * p.circle)))
        for s in range(frame.near_count[i]):
            j = np.uint64(frame.near_index[s, i])
            to = (frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i])
            relative = (frame.vel[0, j] - frame.vel[0, i], frame.vel[1, j] - frame.vel[1, i])
            write_neighbour(row, at, s, to, relative, course, one / p.sight, 0.5 * one / p.max_speed)


class Crossing(Task):
    """N walkers start on a circle and swap to the opposite points, all at once, without touching.

    All learners share one policy. Observations are relative to the walker, in the frame of its course, from its start
    to its goal. A contact removes and stops no agent; it costs as long as it lasts. The episode ends, with success,
    once every learner is at its goal.
    """

    name: ClassVar[str] = "crossing"
    terms: ClassVar[tuple[str, ...]] = ("progress", "arrival", "touch", "time", "effort")
    metric_names: ClassVar[tuple[str, ...]] = ("collisions", "time_to_goal", "arrived", "path_efficiency")
    measures: ClassVar[tuple[str, ...]] = ("touches", "there", "gained", "walked")
    memory: ClassVar[int] = 4

    agents: int = Field(default=12, ge=1, le=1000, description="number of walkers")
    learners: int = Field(
        default_factory=lambda given: given.get("agents", 12), ge=1,
        description="number of learners (default of the task: all); the others are scripted",
    )  # fmt: skip
    horizon: int = Field(default=200, ge=1, description="decisions until the time limit (truncation)")
    circle: float = Field(default=6.0, gt=0, description="m, radius of the circle")
    jitter: float = Field(
        default=0.1, ge=0, le=0.5, description="largest offset of a start, as a share of the gap between starts"
    )
    max_speed: float = Field(default=2.0, gt=0, description="m/s")
    max_force: float = Field(default=5.0, gt=0, description="N; the mass is 1 kg")
    goal_radius: float = Field(
        default=0.4, gt=0, description="m, a walker within this distance of its goal has arrived"
    )
    sight: float = Field(default=6.0, gt=0, description="m, range within which neighbours are seen")
    neighbours: int = Field(default=6, ge=1, le=32, description="number of neighbours seen, nearest first")
    progress_reward: float = Field(default=0.5, ge=0, description="per m nearer to the goal")
    arrival_reward: float = Field(default=5.0, ge=0, description="on arrival at the goal; taken back on leaving it")
    touch_cost: float = Field(default=10.0, ge=0, description="per s and agent touched")
    time_cost: float = Field(default=0.5, ge=0, description="per s away from the goal")
    effort_cost: float = Field(default=0.1, ge=0, description="per s at full force")

    @model_validator(mode="after")
    def _check_numbers(self) -> Crossing:
        """Raise ValueError for more learners than agents, or more agents than fit on the circle."""
        if self.learners > self.agents:
            raise ValueError(f"learners = {self.learners}: there are only {self.agents} agents")
        room = 2 * math.pi * self.circle * (1 - 2 * self.jitter) / self.agents
        if self.agents > 1 and room < 0.8:
            least = 0.8 * self.agents / (2 * math.pi * (1 - 2 * self.jitter)) if self.jitter < 0.5 else math.inf
            raise ValueError(f"circle = {self.circle:g} m has no room for {self.agents} agents; at least {least:.3g}")
        return self

    @property
    def agent_names(self) -> tuple[str, ...]:
        """walker_0 ..."""
        return tuple(f"walker_{i}" for i in range(self.learners))

    @functools.cached_property
    def scene(self) -> Scene:
        """A plane, in which only the walkers' own forces act."""
        around = Spawn(low=(-self.circle, -self.circle), high=(self.circle, self.circle))
        limits: dict[str, Any] = {"radius": 0.3, "max_speed": self.max_speed, "max_force": self.max_force}
        limits["spawn"] = around  # before an episode begins
        groups = [Group(count=self.learners, role="learner", **limits)]
        if self.agents > self.learners:
            groups.append(Group(count=self.agents - self.learners, role="agent", **limits))
        return Scene(space=Plane(), groups=tuple(groups), integrator=self.integrator, dt=self.dt, dtype=self.dtype)

    @property
    def look(self) -> Look:
        """The nearest walkers."""
        return Look(self.sight, self.neighbours)

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; every vector is (along the course, to its left)."""
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (along the course, to its left)"),
            Slot("goal", (2,), 3 * self.circle, "m", "offset of the goal"),
            *neighbour_slots(self.neighbours, self.sight, 2 * self.max_speed, "neighbours", crowding=False),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force in the frame of the course."""
        meaning = "force (along the course, to its left) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark at each goal."""
        return tuple(Mark("goal", memory[:2, world, i], np.zeros(2), self.goal_radius) for i in range(self.agents))

    def own_success(self, state: State, memory: NDArray[Any], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return whether each learner is at its goal, (B, L)."""
        n = self.learners
        to_goal = memory[:, :2, :n].transpose(0, 2, 1) - state.pos[:, :n]
        return np.asarray(np.linalg.norm(to_goal, axis=2) <= self.goal_radius)

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the circle and a margin around it, m."""
        edge = 1.3 * self.circle
        return (-edge, -edge), (edge, edge)
