"""Bottleneck: people leave a room through one door, quickly and without being crushed."""

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
from flockenv.geometry.space import Box
from flockenv.jit.decorators import kernel, like
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import add, norm, scale, sub, unit
from flockenv.model.snapshot import Mark
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Contact, ObstacleContact
from flockenv.scene import Group, Scene
from flockenv.scene.presets import PRESETS
from flockenv.tasks.layout import Layout, Slot
from flockenv.tasks.observations import (
    clip,
    neighbour_slots,
    position_of,
    velocity_of,
    write_crowding,
    write_neighbour,
    write_vector,
)
from flockenv.tasks.price import price_field, price_numbers, price_slots, write_price
from flockenv.tasks.task import Frame, Task

__all__ = ["Bottleneck"]

_RADIUS = 0.25  # m, of every body
_MODEL = PRESETS["helbing_farkas_vicsek_2000"]
_MASS, _STIFFNESS, _FRICTION = 80.0, 1.2e5, 2.4e5  # kg; k, N/m, and kappa, kg/(m s), of the model
_RATIO = 0.3  # share of critical damping; not in the model: people do not bounce
_BEYOND = 1.5  # m of floor beyond the door


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place people at rest, each at random in a cell of its own, at least `clear` m from the wall with the door."""
    columns, rows = int(p.columns), int(p.rows)
    wide, high = (p.room - p.clear) / columns, p.room / rows
    for i in range(frame.pos.shape[1]):
        x, y = float(i % columns), float(i // columns)
        free_x, free_y = wide - 2.0 * _RADIUS, high - 2.0 * _RADIUS
        frame.pos[0, i] = x * wide + _RADIUS + free_x * uniform(frame.key, 0, i, 0)
        frame.pos[1, i] = y * high + _RADIUS + free_y * uniform(frame.key, 0, i, 1)
        frame.vel[0, i], frame.vel[1, i] = 0.0, 0.0
        for k in range(4):
            frame.memory[k, i] = 0.0


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each learner's action as a force along the room's axes; the others follow `_steer_person`.

    An agent that left in the decision before is removed now, so that the last observation still holds it.
    """
    for i in range(frame.pos.shape[1]):
        frame.alive[i] = frame.alive[i] and frame.memory[2, i] < 1.0
        if i < action.shape[0]:
            force[0, i] = action[i, 0] * frame.max_force[i]
            force[1, i] = action[i, 1] * frame.max_force[i]
        else:
            _steer_person(p, frame, i, force)


@kernel
def _steer_person(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write the force of a scripted person: to the door at up to 1.34 m/s, off others, as in Helbing et al. 2000."""
    velocity, speed = velocity_of(frame, i), min(1.34, p.max_speed)
    y, fits = 0.5 * p.room - np.float64(frame.pos[1, i]), max(0.5 * p.width - 1.2 * _RADIUS, 0.0)
    sideways = y - min(max(y, -fits), fits)
    direction = unit((max(p.room - np.float64(frame.pos[0, i]), 0.0) + 0.1, sideways))
    total = scale(sub(scale(direction, speed), velocity), _MASS / p.driving_tau)
    for j in range(frame.pos.shape[1]):
        to = sub(position_of(frame, j), position_of(frame, i))
        if j != i and frame.alive[j] and norm(to) < p.sight:
            separation = (1.0, 0.0) if j < i else (-1.0, 0.0)
            push = steering.repulsion(to, separation, 2.0 * _RADIUS, p.circular_repulsion_decay)
            total = add(total, scale(push, p.circular_repulsion_strength))
    force[0, i], force[1, i] = total[0], total[1]


@kernel
def _wall_gap(p: Any, frame: Frame, i: int) -> float:
    """Return the distance from the centre of agent i to the wall with the door, m."""
    x, y = p.room - np.float64(frame.pos[0, i]), abs(np.float64(frame.pos[1, i]) - 0.5 * p.room)
    beside = 0.5 * p.width - y  # distance to the nearer door post along y
    return math.hypot(x, beside) if beside > 0.0 else abs(x)


@kernel
def _pressure(p: Any, frame: Frame, i: int) -> float:
    """Return the pressure on agent i, N/m: elastic forces of bodies and of the door's wall over its circumference."""
    overlap = max(_RADIUS - _wall_gap(p, frame, i), 0.0)
    for j in range(frame.pos.shape[1]):
        if j != i and frame.alive[j]:
            x, y = frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i]
            overlap += max(2.0 * _RADIUS - math.hypot(x, y), 0.0)
    return _STIFFNESS * overlap / (2.0 * math.pi * _RADIUS)


@kernel
def keep(p: Any, before: Frame, after: Frame) -> None:
    """Store the pressure now and its maximum so far, N/m; whether an agent left now (1) or before (2), and when, s."""
    for i in range(after.pos.shape[1]):
        inside = after.memory[2, i] < 1.0
        now = _pressure(p, after, i) if inside else 0.0
        after.memory[0, i] = now
        after.memory[1, i] = max(np.float64(after.memory[1, i]), now)
        if not inside:
            after.memory[2, i] = 2.0
        elif after.pos[0, i] > p.room + _RADIUS:
            after.memory[2, i], after.memory[3, i] = 1.0, after.step * p.control_dt


@kernel
def _exit_distance(p: Any, frame: Frame, i: int) -> float:
    """Return the distance from agent i to the middle of the door's far side, m."""
    x, y = p.room + _RADIUS - np.float64(frame.pos[0, i]), 0.5 * p.room - np.float64(frame.pos[1, i])
    return math.hypot(max(x, 0.0), y)


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, out, pressed, hurt, time; all 0 for an agent that left in an earlier decision."""
    for i in range(terms.shape[0]):
        for k in range(terms.shape[1]):
            terms[i, k] = 0.0
        if after.memory[2, i] < 2.0:
            pressure = np.float64(after.memory[0, i])
            terms[i, at.progress] = p.progress_reward * (_exit_distance(p, before, i) - _exit_distance(p, after, i))
            terms[i, at.out] = p.out_reward if after.memory[2, i] > 0.0 else 0.0
            terms[i, at.pressed] = -p.press_cost * min(pressure / p.limit, 1.0) * p.control_dt * p.price
            terms[i, at.hurt] = -p.hurt_cost * p.control_dt * p.price if pressure > p.limit else 0.0
            terms[i, at.time] = -p.time_cost * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the learners that are through the door; return True if all are out and none of them was ever hurt."""
    all_out, unhurt = True, True
    for i in range(over.shape[0]):
        out = bool(after.memory[2, i] > 0.0)
        over[i] = out
        all_out &= out
        unhurt &= bool(after.memory[1, i] <= p.limit)
    if p.together > 0.0:
        for i in range(over.shape[0]):
            over[i] = all_out
    return all_out and unhurt


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write learners out; times of the first and last exit, s; peak pressure so far, N/m; contact and hurt time, s.

    Contact and hurt time are what this decision adds to the mean over learners: time in contact with a body or the
    door's wall, and time above the pressure limit.
    """
    n = int(p.learners)
    out, first, latest, most, touched, hurt = 0.0, np.inf, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        if after.memory[2, i] > 0.0:
            out += 1.0
            first = min(first, np.float64(after.memory[3, i]))
            latest = max(latest, np.float64(after.memory[3, i]))
        most = max(most, np.float64(after.memory[1, i]))
        touched += p.control_dt / n if after.memory[0, i] > 0.0 else 0.0
        hurt += p.control_dt / n if after.memory[0, i] > p.limit else 0.0
    numbers[at.out], numbers[at.first], numbers[at.latest] = out, first, latest
    numbers[at.most], numbers[at.touched], numbers[at.hurt] = most, touched, hurt


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write the share out; evacuation time, s, if all are out; specific flow, persons/(s m) of door from the first to
    the last exit, if two are out; mean contact time, s; peak pressure on a learner, N/m; mean hurt time, s.
    """  # fmt: skip
    span = last.latest - last.first
    numbers[at.share_out] = last.out / p.learners
    if last.out >= p.learners:
        numbers[at.evacuation_time] = last.latest
    if last.out >= 2 and span > 0:
        numbers[at.specific_flow] = (last.out - 1) / span / p.width
    numbers[at.contact_time], numbers[at.most_pressure], numbers[at.hurt_time] = sums.touched, last.most, sums.hurt


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, offset of the door on two scales, wall distances, pressure, the nearest others."""
    one = like(p.sight, 1.0)
    half, axis = 0.5 * p.room, (one, like(one, 0.0))
    for i in range(rows.shape[0]):
        row = rows[i]
        for c in range(rows.shape[1]):
            row[np.uint64(c)] = 0.0
        if frame.memory[2, i] > 0.0:
            continue
        x, y = p.room - frame.pos[0, i], half - frame.pos[1, i]
        write_vector(row, at.velocity, (clip(frame.vel[0, i] / p.max_speed), clip(frame.vel[1, i] / p.max_speed)))
        write_vector(row, at.door, (clip(x / p.room), clip(y / p.room)))
        write_vector(row, at.door_near, (clip(x / p.close), clip(y / p.close)))
        write_vector(row, at.to_sides, (clip(frame.pos[1, i] / p.room), clip((p.room - frame.pos[1, i]) / p.room)))
        row[np.uint64(at.pressure)] = min(np.float64(frame.memory[0, i]) / p.limit, 1.0)
        for s in range(frame.near_count[i]):
            j = np.uint64(frame.near_index[s, i])
            to = (frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i])
            relative = (frame.vel[0, j] - frame.vel[0, i], frame.vel[1, j] - frame.vel[1, i])
            distance = max(math.sqrt(to[0] * to[0] + to[1] * to[1]), 1e-9)
            write_neighbour(row, at, s, to, relative, axis, one / p.sight, 0.5 * one / p.max_speed)
            write_crowding(row, at, s, to, axis, distance, distance - 2.0 * _RADIUS, p.near)
        write_price(p, row)


class Bottleneck(Task):
    """N people leave a room through one door. All learners share one policy.

    A learner terminates once it is through the door, and the others go on. With `together`, a learner that is out
    waits, outside the world, with reward 0 and an observation of zeros, until all learners are out: vector environments
    need learners that end together.

    Bodies and walls are those of Helbing, Farkas and Vicsek 2000 (Nature 407:487): k = 1.2e5 kg/s^2, sliding friction
    kappa = 2.4e5 kg/(m s), 80 kg. Contacts are also damped, which is not in the paper, because people do not bounce. As
    in the paper, an agent is hurt while the pressing forces exceed 1600 N per metre of its circumference, 2.5 kN in
    all. Elastic forces of other bodies and of the wall with the door count; the other walls are hard and exert no
    pressure. Rewards are individual. Success: all learners are out, and none of them was ever hurt. Scripted agents
    walk by the paper's forces between people; walls stop them as bodies do.
    """

    name: ClassVar[str] = "bottleneck"
    terms: ClassVar[tuple[str, ...]] = ("progress", "out", "pressed", "hurt", "time")
    metric_names: ClassVar[tuple[str, ...]] = (
        "share_out", "evacuation_time", "specific_flow", "contact_time", "most_pressure", "hurt_time",
    )  # fmt: skip
    priced: ClassVar[tuple[str, ...]] = ("pressed", "hurt")
    harm: ClassVar[str] = "hurt"
    measures: ClassVar[tuple[str, ...]] = ("out", "first", "latest", "most", "touched", "hurt")
    memory: ClassVar[int] = 4
    keeps: ClassVar[bool] = True

    dt: float = Field(default=0.01, gt=0, description="s, one physics step; small, because bodies are stiff")
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    people: int = Field(default=20, ge=1, le=400, description="number of people in the room")
    learners: int = Field(
        default_factory=lambda given: given.get("people", 20), ge=1,
        description="number of learners (default of the task: all); the others are scripted",
    )  # fmt: skip
    together: bool = Field(default=False, description="True if learners that are out wait until all are")
    room: float = Field(default=6.0, gt=1, description="m, edge of the room")
    width: float = Field(default=1.0, gt=0.5, description="m, width of the door; bodies are 0.5 m wide")
    clear: float = Field(default=1.5, ge=0, description="m before the wall with the door, in which no agent starts")
    max_speed: float = Field(default=1.5, gt=0, description="m/s")
    max_force: float = Field(default=600.0, gt=0, description="N; the mass is 80 kg")
    sight: float = Field(default=2.0, gt=0, description="m, range within which others are seen")
    neighbours: int = Field(default=6, ge=1, le=32, description="number of others seen, nearest first")
    near: float = Field(default=0.5, gt=0, description="m between bodies, below which `crowding` is not 0")
    close: float = Field(default=1.5, gt=0, description="m, fine scale on which the door is seen")
    limit: float = Field(
        default=1600.0, gt=0, description="N/m, pressure (force over circumference) above which an agent is hurt"
    )
    progress_reward: float = Field(default=0.5, ge=0, description="per m nearer to the door")
    out_reward: float = Field(default=5.0, ge=0, description="for getting out")
    press_cost: float = Field(default=2.0, ge=0, description="per s at the pressure limit; in proportion below it")
    hurt_cost: float = Field(default=50.0, ge=0, description="per s above the pressure limit")
    time_cost: float = Field(default=0.5, ge=0, description="per s in the room")
    price: float | None = price_field("`pressed` and `hurt`")

    @model_validator(mode="after")
    def _check_room(self) -> Bottleneck:
        """Raise ValueError for more learners than people, a door wider than its wall, or more people than fit."""
        if self.learners > self.people:
            raise ValueError(f"learners = {self.learners}: there are only {self.people} people")
        if self.width >= self.room:
            raise ValueError(f"width = {self.width:g} m: must be below room = {self.room:g} m")
        if self.clear >= self.room - 1.0:
            raise ValueError(f"clear = {self.clear:g} m: at most room - 1 = {self.room - 1:g} m is allowed")
        columns, rows = self.cells
        if min((self.room - self.clear) / columns, self.room / rows) < 2 * _RADIUS:
            raise ValueError(f"people = {self.people}: do not fit into {self.room:g} m x {self.room - self.clear:g} m")
        return self

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the grid of starting cells."""
        columns = max(1, round(math.sqrt(self.people * (self.room - self.clear) / self.room)))
        return columns, -(-self.people // columns)

    def parameters(self) -> dict[str, float]:
        """Return the fields, the grid of starting cells, and the parameters of scripted people."""
        columns, rows = self.cells
        cells = {"columns": float(columns), "rows": float(rows)}
        return super().parameters() | price_numbers(self.price) | cells | _MODEL.numbers

    @property
    def agents(self) -> int:
        """N: all people."""
        return self.people

    @property
    def ends_together(self) -> bool:
        """True with `together`, or with one learner."""
        return self.together or self.learners == 1

    @property
    def agent_names(self) -> tuple[str, ...]:
        """person_0 ..."""
        return tuple(f"person_{i}" for i in range(self.learners))

    @functools.cached_property
    def scene(self) -> Scene:
        """A room with a door in one wall, and stiff bodies."""
        low, high = 0.5 * (self.room - self.width), 0.5 * (self.room + self.width)
        solid = {"stiffness": _STIFFNESS, "friction": _FRICTION, "ratio": _RATIO}
        limits: dict[str, Any] = {"max_speed": self.max_speed, "max_force": self.max_force}
        limits |= {"mass": _MASS, "radius": _RADIUS, "spawn": Spawn(low=(0.0, 0.0), high=(self.room, self.room))}
        groups = [Group(count=self.learners, role="learner", **limits)]
        if self.people > self.learners:
            groups.append(Group(count=self.people - self.learners, role="agent", **limits))
        return Scene(
            space=Box(size=(self.room + _BEYOND, self.room)),
            groups=tuple(groups),
            obstacles=(
                Wall(vertices=((self.room, 0.0), (self.room, low))),
                Wall(vertices=((self.room, high), (self.room, self.room))),
            ),
            effects=(Contact(radius=2.2 * _RADIUS, **solid), ObstacleContact(**solid)),
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
        """Axes are the room's; the door is in the wall that x points to."""
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (x, y)"),
            Slot("door", (2,), self.room, "m", "offset of the middle of the door"),
            Slot("door_near", (2,), self.close, "m", "the same offset on a finer scale, clipped"),
            Slot("to_sides", (2,), self.room, "m", "distance to the walls at y = 0 and y = room", low=0.0),
            Slot("pressure", (), self.limit, "N/m", "sum of the contact forces / circumference of the body", low=0.0),
            *neighbour_slots(self.neighbours, self.sight, 2 * self.max_speed, "people", crowding=True),
            *price_slots(self.price),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force along the room's axes."""
        meaning = "force (x, y) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark at the door."""
        return (Mark("goal", np.array([self.room, self.room / 2]), np.zeros(2), self.width / 2),)

    def own_success(self, state: State, memory: NDArray[Any], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return whether each learner is out and was never hurt, (B, L)."""
        n = self.learners
        return np.asarray((memory[:, 2, :n] > 0.0) & (memory[:, 1, :n] <= self.limit))

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the room and the floor beyond the door, m."""
        return (0.0, 0.0), (self.room + _BEYOND, self.room)
