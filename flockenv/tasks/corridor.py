"""Corridor: two opposite streams of people in one corridor, which move faster in lanes."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.engine import Look
from flockenv.geometry.shapes import Wall
from flockenv.geometry.space import Torus
from flockenv.jit.decorators import kernel, like
from flockenv.maths.counter_rng import normal, uniform
from flockenv.maths.vectors import add, norm, scale, sub
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import ObstacleContact
from flockenv.scene import Group, Scene
from flockenv.scene.presets import PRESETS
from flockenv.tasks.lasting import MEASURES, METRICS, LastingTask, write_aim_measures, write_aim_metrics
from flockenv.tasks.layout import Layout, Slot
from flockenv.tasks.observations import (
    local_components,
    neighbour_slots,
    offset,
    velocity_of,
    write_crowding,
    write_neighbour,
    write_vector,
)
from flockenv.tasks.task import Frame

__all__ = ["Corridor"]

_RADIUS = 0.25  # m, of every body
_WALL = 1.0  # m, where the lower wall is


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place people at rest, each in a random cell of its own; the first half walks to the right, the others left.

    Memory: walking direction (+-1), desired speed, m/s.
    """
    n, columns, rows = frame.pos.shape[1], int(p.columns), int(p.rows)
    for i in range(n):
        frame.memory[0, i] = i
    for i in range(n - 1, 0, -1):  # the cells are shuffled (Fisher and Yates)
        j = int((i + 1) * uniform(frame.key, 0, i, 3))
        frame.memory[0, i], frame.memory[0, j] = frame.memory[0, j], frame.memory[0, i]
    wide, high = p.length / columns, p.width / rows
    for i in range(n):
        cell = int(frame.memory[0, i])
        free_x, free_y = wide - 2.0 * _RADIUS, high - 2.0 * _RADIUS
        frame.pos[0, i] = (cell % columns) * wide + _RADIUS + free_x * uniform(frame.key, 0, i, 0)
        frame.pos[1, i] = _WALL + (cell // columns) * high + _RADIUS + free_y * uniform(frame.key, 0, i, 1)
        frame.vel[0, i], frame.vel[1, i] = 0.0, 0.0
        pace = p.desired_speed + p.spread * normal(frame.key, 0, i, 2)
        frame.memory[0, i] = 1.0 if 2 * i < n else -1.0
        frame.memory[1, i] = min(max(pace, 0.5 * p.desired_speed), 1.5 * p.desired_speed)


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each learner's action as a force (along its walking direction, to its left); others: `_steer_walker`."""
    for i in range(frame.pos.shape[1]):
        direction = np.float64(frame.memory[0, i])
        if i < action.shape[0]:
            force[0, i] = direction * action[i, 0] * frame.max_force[i]
            force[1, i] = direction * action[i, 1] * frame.max_force[i]
        else:
            _steer_walker(p, frame, i, force)


@kernel
def _steer_walker(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write the force of a scripted walker: the social force of Moussaid et al. 2009, with repulsion from walls."""
    velocity, y = velocity_of(frame, i), np.float64(frame.pos[1, i]) - _WALL
    desired = (np.float64(frame.memory[0, i] * frame.memory[1, i]), 0.0)
    decay = p.obstacle_repulsion_decay
    wall_force = p.obstacle_repulsion_acceleration * (
        math.exp(-max(y, 0.0) / decay) - math.exp(-max(p.width - y, 0.0) / decay)
    )
    total = add(scale(sub(desired, velocity), 1.0 / p.driving_tau), (0.0, wall_force))
    for j in range(frame.pos.shape[1]):
        x = offset(np.float64(frame.pos[0, i]), np.float64(frame.pos[0, j]), p.length)
        to = (x, np.float64(frame.pos[1, j] - frame.pos[1, i]))
        if j != i and norm(to) < p.sight:
            separation = (1.0, 0.0) if j < i else (-1.0, 0.0)
            push = steering.sidestep(
                to, velocity, velocity_of(frame, j), separation, p.sidestep_importance, p.sidestep_gamma,
                p.sidestep_angular, p.sidestep_forward, p.sidestep_bias,
            )  # fmt: skip
            total = add(total, scale(push, p.sidestep_acceleration))
    force[0, i], force[1, i] = total[0], total[1]


@kernel
def _speed_share(frame: Frame, i: int) -> float:
    """Return the speed of agent i along its walking direction over its desired speed."""
    return np.float64(frame.vel[0, i]) * np.float64(frame.memory[0, i]) / np.float64(frame.memory[1, i])


@kernel
def _speed_score(frame: Frame, i: int) -> float:
    """Return 1 - |speed along the walking direction / desired speed - 1|."""
    return 1.0 - abs(_speed_share(frame, i) - 1.0)


@kernel
def _count_touches(frame: Frame, i: int) -> float:
    """Return the number of agents that agent i touches."""
    touches = 0.0
    for s in range(frame.near_count[i]):
        touches += 1.0 if frame.near_square[s, i] < 4.0 * _RADIUS * _RADIUS else 0.0
    return touches


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms along (largest at the desired speed), touch, effort."""
    for i in range(terms.shape[0]):
        push = action[i, 0] * action[i, 0] + action[i, 1] * action[i, 1]
        terms[i, at.along] = p.along_reward * _speed_score(after, i) * p.control_dt
        terms[i, at.touch] = -p.touch_cost * _count_touches(after, i) * p.control_dt
        terms[i, at.effort] = -p.effort_cost * min(push, 1.0) * p.control_dt


@kernel
def _lane_order(p: Any, frame: Frame) -> float:
    """Return the lane order: the share of pairs in a row with the same direction minus that with opposite directions.

    Rows run along the corridor. For n people in a row whose directions (+-1) sum to D it is (D^2 - n) / (n^2 - n),
    numerator and denominator summed over rows: the order of Feliciani and Nishinari 2016, mean (D / n)^2, less its
    expectation by chance, 1 / n. Without pairs it is 0.
    """
    rows = int(p.lane_rows)
    same, pairs = 0.0, 0.0
    for r in range(rows):
        directions, n = 0.0, 0.0
        for i in range(frame.pos.shape[1]):
            row = int((np.float64(frame.pos[1, i]) - _WALL) * rows / p.width)
            if min(max(row, 0), rows - 1) == r:
                directions += frame.memory[0, i]
                n += 1.0
        same += directions * directions - n
        pairs += n * n - n
    return same / pairs if pairs > 0.0 else 0.0


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End no learner; return whether the aim holds now: learners keep to their desired speeds and touch no agent."""
    n = over.shape[0]
    share, touches = 0.0, 0.0
    for i in range(n):
        share += _speed_score(after, i)
        touches += _count_touches(after, i)
    holds = bool(share > p.aim * n and touches == 0.0)
    write_aim_measures(p, at, after.step, holds, numbers)
    return holds


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write the learners' mean speed over the desired one, contacts that began, and lane order in the second half."""
    n, length = int(p.learners), p.length
    share, began = 0.0, 0.0
    for i in range(n):
        share += _speed_share(after, i) / n
        for s in range(after.near_count[i]):
            if after.near_square[s, i] >= 4.0 * _RADIUS * _RADIUS:
                break
            j = after.near_index[s, i]
            x = offset(np.float64(before.pos[0, i]), np.float64(before.pos[0, j]), length)
            y = np.float64(before.pos[1, j] - before.pos[1, i])
            both = 0.5 if j < n else 1.0  # a pair of learners is counted from both sides
            began += both if x * x + y * y >= 4.0 * _RADIUS * _RADIUS else 0.0
    late = 2 * after.step > p.horizon
    numbers[at.share], numbers[at.touches] = share, began
    numbers[at.order], numbers[at.late] = _lane_order(p, after) if late else 0.0, 1.0 if late else 0.0


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write mean speed over the desired one; contacts that began; lane order in the second half; metrics of the aim."""
    write_aim_metrics(at, sums, last, steps, numbers)
    numbers[at.speed] = sums.share / max(steps, 1)
    numbers[at.collisions] = sums.touches
    if sums.late > 0:
        numbers[at.lane_order] = sums.order / sums.late


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, desired speed, walls, nearest others; vectors are (along the walking direction, left)."""
    one = like(p.sight, 1.0)
    for i in range(rows.shape[0]):
        row = rows[i]
        for c in range(rows.shape[1]):
            row[np.uint64(c)] = 0.0
        direction = (frame.memory[0, i], like(frame.memory[0, i], 0.0))
        low, high = frame.pos[1, i] - _WALL, _WALL + p.width - frame.pos[1, i]
        left, right = (high, low) if frame.memory[0, i] > 0.0 else (low, high)
        velocity = (frame.vel[0, i], frame.vel[1, i])
        write_vector(row, at.velocity, local_components(velocity, direction, one / p.max_speed))
        row[np.uint64(at.desired_speed)] = min(frame.memory[1, i] / p.max_speed, one)
        write_vector(row, at.walls, (min(max(left / p.width, 0.0), 1.0), min(max(right / p.width, 0.0), 1.0)))
        for s in range(frame.near_count[i]):
            j = np.uint64(frame.near_index[s, i])
            x, y = offset(frame.pos[0, i], frame.pos[0, j], p.length), frame.pos[1, j] - frame.pos[1, i]
            relative = (frame.vel[0, j] - frame.vel[0, i], frame.vel[1, j] - frame.vel[1, i])
            distance = max(math.sqrt(x * x + y * y), 1e-9)
            write_neighbour(row, at, s, (x, y), relative, direction, one / p.sight, 0.5 * one / p.max_speed)
            write_crowding(row, at, s, (x, y), direction, distance, distance - 2.0 * _RADIUS, p.near)


class Corridor(LastingTask):
    """Two opposite streams of people walk in one corridor, which is periodic along its length.

    Each agent has its own desired speed, drawn from N(1.34, 0.26) m/s, and its reward is largest at that speed. A
    contact stops no agent; it costs as long as it lasts. Walls are solid. All learners share one policy; scripted
    agents walk by the forces of Moussaid et al. 2009. Observations are in the frame of the agent's own walking
    direction, so that lanes, or keeping to one side, emerge from the policy. No agent terminates.

    The aim holds while the mean over learners of 1 - |speed along the walking direction / desired speed - 1| is above
    `aim`, and no learner touches another agent. Success: it holds in the share `lasting` of the decisions after
    `settling` s.
    """

    name: ClassVar[str] = "corridor"
    terms: ClassVar[tuple[str, ...]] = ("along", "touch", "effort")
    metric_names: ClassVar[tuple[str, ...]] = ("speed", "collisions", "lane_order", *METRICS)
    measures: ClassVar[tuple[str, ...]] = ("share", "touches", "order", "late", *MEASURES)
    memory: ClassVar[int] = 2

    people: int = Field(default=24, ge=2, le=1000, description="number of people, half of them in each direction")
    learners: int = Field(
        default_factory=lambda given: given.get("people", 24), ge=1,
        description="number of learners (default of the task: all); the others are scripted",
    )  # fmt: skip
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    length: float = Field(default=12.0, gt=1, description="m, period of the corridor")
    width: float = Field(default=3.0, gt=0.6, description="m, between the walls")
    lane_rows: int = Field(default=6, ge=1, description="rows into which the width is cut to measure lane order")
    desired_speed: float = Field(default=1.34, gt=0, description="m/s, mean")
    spread: float = Field(default=0.26, ge=0, description="m/s, standard deviation of desired speeds")
    max_speed: float = Field(default=2.0, gt=0, description="m/s")
    max_force: float = Field(default=5.0, gt=0, description="N; the mass is 1 kg")
    sight: float = Field(default=4.0, gt=0, description="m, range within which others are seen")
    neighbours: int = Field(default=8, ge=1, le=32, description="number of others seen, nearest first")
    near: float = Field(default=0.75, gt=0, description="m between bodies, below which `crowding` is not 0")
    aim: float = Field(
        default=0.9, ge=0, le=1, description="closeness to the desired speeds that the aim needs; 1: exactly at them"
    )
    along_reward: float = Field(
        default=1.0, ge=0, description="per s at the desired speed; less in proportion to the deviation from it"
    )
    touch_cost: float = Field(default=5.0, ge=0, description="per s and agent touched")
    effort_cost: float = Field(default=0.1, ge=0, description="per s at full force")

    @model_validator(mode="after")
    def _check_room(self) -> Corridor:
        """Raise ValueError for more learners than people, more people than fit, or a sight beyond half the length."""
        if self.learners > self.people:
            raise ValueError(f"learners = {self.learners}: there are only {self.people} people")
        columns, rows = self.cells
        if min(self.length / columns, self.width / rows) < 2 * _RADIUS:
            raise ValueError(f"people = {self.people}: do not fit into {self.length:g} m x {self.width:g} m")
        if self.sight > self.length / 2:
            raise ValueError(f"sight = {self.sight:g} m: at most length / 2 = {self.length / 2:g} m is allowed")
        return self

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the grid of starting cells."""
        rows = max(1, round(math.sqrt(self.people * self.width / self.length)))
        return -(-self.people // rows), rows

    def parameters(self) -> dict[str, float]:
        """Return the fields, the grid of starting cells, and the parameters of scripted walkers."""
        columns, rows = self.cells
        cells = {"columns": float(columns), "rows": float(rows)}
        return super().parameters() | cells | PRESETS["moussaid_2009"].numbers

    @property
    def agents(self) -> int:
        """N: all people."""
        return self.people

    @property
    def agent_names(self) -> tuple[str, ...]:
        """walker_0 ..."""
        return tuple(f"walker_{i}" for i in range(self.learners))

    @functools.cached_property
    def scene(self) -> Scene:
        """A periodic corridor between two walls; only contact with walls acts on people beside their own forces."""
        high, half = _WALL + self.width, self.length / 2
        limits: dict[str, Any] = {"max_speed": self.max_speed, "max_force": self.max_force, "radius": _RADIUS}
        limits["spawn"] = Spawn(low=(0.0, _WALL), high=(self.length, high))
        groups = [Group(count=self.learners, role="learner", **limits)]
        if self.people > self.learners:
            groups.append(Group(count=self.people - self.learners, role="agent", **limits))
        return Scene(
            space=Torus(size=(self.length, max(high + _WALL, 2.0 * self.sight))),
            groups=tuple(groups),
            obstacles=tuple(  # no wall segment is longer than half of the period
                Wall(vertices=((x, y), (x + half, y))) for y in (_WALL, high) for x in (0.0, half)
            ),
            effects=(ObstacleContact(stiffness=200.0, ratio=0.5),),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def look(self) -> Look:
        """The nearest others."""
        return Look(self.sight, self.neighbours)

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; every vector is (along the walking direction, to its left)."""
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (along the walking direction, to its left)"),
            Slot("desired_speed", (), self.max_speed, "m/s", "own desired speed", low=0.0),
            Slot("walls", (2,), self.width, "m", "distance to the wall on the left, and on the right", low=0.0),
            *neighbour_slots(self.neighbours, self.sight, 2 * self.max_speed, "people", crowding=True),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force in the frame of the walking direction."""
        meaning = "force (along the walking direction, to its left) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def roles(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[str, ...]:
        """Return two names, and so two colours, for the two walking directions."""
        names = zip(self.scene.roles, memory[0, world] < 0, strict=True)
        return tuple(f"{role} 2" if back else role for role, back in names)

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the corridor and a margin beyond its walls, m."""
        return (0.0, 0.0), (self.length, self.width + 2 * _WALL)
