"""Obstacles: reach a goal through a random field of round obstacles without touching one."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.engine import Look
from flockenv.geometry.space import Box
from flockenv.jit.decorators import kernel, like
from flockenv.maths.counter_rng import uniform
from flockenv.model.snapshot import Mark
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.tasks.layout import Layout, Slot, slots_of
from flockenv.tasks.observations import clip, leaves_gap, ray_directions, shorten_free_paths
from flockenv.tasks.task import Frame, Task

__all__ = ["Obstacles"]


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Draw a start on the left, a goal on the right, and obstacles with gaps of at least `min_gap` between them."""
    frame.pos[0, 0] = 1.5
    frame.pos[1, 0] = 2.0 + (p.size - 4.0) * uniform(frame.key, 0, 0, 0)
    frame.vel[:, 0] = 0.0
    frame.memory[0, 0] = p.size - 1.5
    frame.memory[1, 0] = 2.0 + (p.size - 4.0) * uniform(frame.key, 0, 0, 1)
    frame.memory[2, 0] = math.hypot(frame.memory[0, 0] - frame.pos[0, 0], frame.memory[1, 0] - frame.pos[1, 0])
    frame.memory[3, 0] = 0.0
    for m in range(frame.rho.shape[0]):
        frame.rho[m] = 0.0
        for t in range(32):
            rho = p.least_radius + (p.greatest_radius - p.least_radius) * uniform(frame.key, t, 100 + m, 0)
            x = 4.0 + (p.size - 8.0) * uniform(frame.key, t, 100 + m, 1)
            y = p.size * uniform(frame.key, t, 100 + m, 2)
            if leaves_gap(p, frame, m, x, y, rho):
                frame.centre[0, m], frame.centre[1, m], frame.rho[m] = x, y, rho
                break


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write the learner's action as a force along the field's axes."""
    for k in range(2):
        force[k, 0] = action[0, k] * frame.max_force[0]


@kernel
def _goal_distance(frame: Frame) -> float:
    return math.hypot(frame.memory[0, 0] - frame.pos[0, 0], frame.memory[1, 0] - frame.pos[1, 0])


@kernel
def _touches(before: Frame, after: Frame) -> bool:
    """Return True if the straight path of the decision comes nearer to an obstacle than the sum of radii."""
    x, y = before.pos[0, 0], before.pos[1, 0]
    dx, dy = after.pos[0, 0] - x, after.pos[1, 0] - y
    squared_length = dx * dx + dy * dy
    for m in range(after.rho.shape[0]):
        if after.rho[m] > 0.0:
            cx, cy = after.centre[0, m] - x, after.centre[1, m] - y
            share = min(max((cx * dx + cy * dy) / squared_length, 0.0), 1.0) if squared_length > 0.0 else 0.0
            off_x, off_y = cx - share * dx, cy - share * dy
            if math.sqrt(off_x * off_x + off_y * off_y) < after.rho[m] + after.radius[0]:
                return True
    return False


@kernel
def keep(p: Any, before: Frame, after: Frame) -> None:
    """Store whether the agent touched an obstacle in this decision; `reward`, `ended` and `measure` read it."""
    after.memory[3, 0] = 1.0 if _touches(before, after) else 0.0


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, goal, touch, time."""
    touch = after.memory[3, 0] > 0.0
    there = not touch and _goal_distance(after) <= p.goal_radius
    terms[0, at.progress] = p.progress_reward * (_goal_distance(before) - _goal_distance(after))
    terms[0, at.goal] = p.goal_reward if there else 0.0
    terms[0, at.touch] = -p.touch_cost if touch else 0.0
    terms[0, at.time] = -p.time_cost * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the episode at a contact, or at the goal, which is success."""
    touch = after.memory[3, 0] > 0.0
    there = not touch and _goal_distance(after) <= p.goal_radius
    over[0] = touch or there
    return there


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write path, m; contacts (0 or 1); distance to the goal, m, now and at the start."""
    numbers[at.path] = math.hypot(after.pos[0, 0] - before.pos[0, 0], after.pos[1, 0] - before.pos[1, 0])
    numbers[at.touch] = after.memory[3, 0]
    numbers[at.left] = _goal_distance(after)
    numbers[at.straight] = after.memory[2, 0]


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write time to the goal, s, if it is reached; contacts; metres gained towards the goal per metre of path."""
    if last.left <= p.goal_radius and sums.touch == 0 and steps > 0:
        numbers[at.time_to_goal] = steps * p.control_dt
    numbers[at.collisions] = sums.touch
    numbers[at.path_efficiency] = max(last.straight - last.left, 0.0) / max(sums.path, 1e-9)


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, goal, walls, nearest obstacles, free path lengths."""
    row = rows[0]
    for c in range(row.shape[0]):
        row[c] = 0.0
    for k in range(2):
        row[at.velocity + k] = clip(frame.vel[k, 0] / p.max_speed)
        row[at.goal + k] = clip((frame.memory[k, 0] - frame.pos[k, 0]) / p.size)
        row[at.to_low + k] = clip(frame.pos[k, 0] / p.size)
        row[at.to_high + k] = clip((p.size - frame.pos[k, 0]) / p.size)
    rays = int(p.rays)
    for s in range(frame.obstacle_count[0]):
        m, gap = frame.obstacle_index[s, 0], frame.obstacle_gap[s, 0] - frame.radius[0]
        for k in range(2):
            row[at.obstacles + 2 * s + k] = clip((frame.centre[k, m] - frame.pos[k, 0]) / (p.sight + p.greatest_radius))
        row[at.obstacle_radius + s] = frame.rho[m] / p.greatest_radius
        row[at.clearance + s] = clip(gap) if gap < 1.0 else 1.0
    for r in range(rays):
        row[at.free_way + r] = 1.0
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0:
            to = (frame.centre[0, m] - frame.pos[0, 0], frame.centre[1, m] - frame.pos[1, 0])
            ahead = (like(to[0], 1.0), like(to[0], 0.0))
            shorten_free_paths(row, at.free_way, rays, frame.table, to, ahead, frame.rho[m] + frame.radius[0], p.sight)


class Obstacles(Task):
    """One learner crosses a walled square full of round obstacles to a goal, without touching an obstacle.

    Start and goal are drawn on opposite sides, obstacles between them with gaps of at least `min_gap`. The episode ends
    at a contact with an obstacle, or at the goal, which is success. The walls of the square stop the agent and do not
    count as a contact.
    """

    name: ClassVar[str] = "obstacles"
    terms: ClassVar[tuple[str, ...]] = ("progress", "goal", "touch", "time")
    metric_names: ClassVar[tuple[str, ...]] = ("time_to_goal", "collisions", "path_efficiency")
    measures: ClassVar[tuple[str, ...]] = ("path", "touch", "left", "straight")
    memory: ClassVar[int] = 4
    keeps: ClassVar[bool] = True

    horizon: int = Field(default=250, ge=1, description="decisions until the time limit (truncation)")
    size: float = Field(default=24.0, gt=10, description="m, edge of the square")
    count: int = Field(default=26, ge=0, le=200, description="number of obstacles; those that do not fit are left out")
    least_radius: float = Field(default=0.6, gt=0, description="m, least radius of an obstacle")
    greatest_radius: float = Field(default=2.0, gt=0, description="m, greatest radius of an obstacle")
    min_gap: float = Field(default=1.0, ge=0, description="m between obstacles; the agent's diameter is 0.6 m")
    max_speed: float = Field(default=3.0, gt=0, description="m/s")
    max_force: float = Field(default=5.0, gt=0, description="N; the mass is 1 kg")
    goal_radius: float = Field(default=0.8, gt=0, description="m, the goal is reached within this distance")
    sight: float = Field(default=8.0, gt=0, description="m, range within which the surfaces of obstacles are seen")
    slots: int = Field(default=6, ge=1, le=32, description="number of obstacles seen, nearest first")
    rays: int = Field(default=16, ge=1, le=128, description="number of directions in which the free path is seen")
    progress_reward: float = Field(default=0.5, ge=0, description="per m nearer to the goal")
    goal_reward: float = Field(default=10.0, ge=0, description="once, at the goal")
    touch_cost: float = Field(default=10.0, ge=0, description="once, at a contact")
    time_cost: float = Field(default=0.5, ge=0, description="per s")

    @model_validator(mode="after")
    def _check_sizes(self) -> Obstacles:
        """Raise ValueError for radii in the wrong order, or large enough to cover the start or the goal."""
        if not self.least_radius <= self.greatest_radius <= 2.0:
            raise ValueError(
                f"least_radius = {self.least_radius:g}, greatest_radius = {self.greatest_radius:g}: "
                "must be in this order, and at most 2 m, as a larger obstacle could cover the start"
            )
        return self

    @property
    def learners(self) -> int:
        """L: 1, the walker."""
        return 1

    @property
    def agents(self) -> int:
        """N: 1."""
        return 1

    @property
    def agent_names(self) -> tuple[str, ...]:
        """walker_0."""
        return ("walker_0",)

    @property
    def obstacle_slots(self) -> int:
        """M: the number of obstacles."""
        return self.count

    @functools.cached_property
    def scene(self) -> Scene:
        """A walled square, in which only the agent's own force acts."""
        walker = Group(count=1, radius=0.3, max_speed=self.max_speed, max_force=self.max_force, role="learner")
        return Scene(
            space=Box(size=(self.size, self.size)),
            groups=(walker,),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def look(self) -> Look:
        """The nearest obstacles."""
        return Look(self.sight, obstacles=self.slots)

    def table(self) -> tuple[float, ...]:
        """Return the directions of the rays."""
        return ray_directions(self.rays)

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; axes are the field's, and offsets are relative to the agent."""
        paths = "free path length of the body to the nearest obstacle in each direction, anticlockwise from the x axis"
        seen = "offsets of the centres of the nearest obstacles, nearest surface first; zeros: empty slot"
        radii = "their radii; 0: empty slot"
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (x, y)"),
            Slot("goal", (2,), self.size, "m", "offset of the goal"),
            Slot("to_low", (2,), self.size, "m", "distance to the walls at x = 0 and y = 0", low=0.0),
            Slot("to_high", (2,), self.size, "m", "distance to the walls at x = size and y = size", low=0.0),
            *slots_of("obstacles",
                Slot("obstacles", (self.slots, 2), self.sight + self.greatest_radius, "m", seen),
                Slot("obstacle_radius", (self.slots,), self.greatest_radius, "m", radii, low=0.0),
                Slot("clearance", (self.slots,), 1.0, "m", "gap between the bodies, at most 1 m; 0: empty slot"),
            ),
            Slot("free_way", (self.rays,), self.sight, "m", paths, low=0.0),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force along the field's axes."""
        return Layout((Slot("force", (2,), self.max_force, "N", "force (x, y) / max_force, shortened to length 1"),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark at the goal."""
        return (Mark("goal", memory[:2, world, 0], np.zeros(2), self.goal_radius),)
