"""Bottleneck: everybody wants to leave a room through one door, soon, and nobody is to be crushed."""

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
from flockenv.tasks.observations import clip, neighbour_slots, place_of, put, put_crowding, put_neighbour, velocity_of
from flockenv.tasks.task import Frame, Task

__all__ = ["Bottleneck"]

_RADIUS = 0.25  # m, of everybody
_MODEL = PRESETS["helbing_farkas_vicsek_2000"]
_MASS, _STIFFNESS, _FRICTION = 80.0, 1.2e5, 2.4e5  # kg; k, N/m, and kappa, kg/(m s), of bodies: those of the model
_RATIO = 0.3  # damping as a share of what is critical: ours, people do not bounce
_BEYOND = 1.5  # m of floor beyond the door


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """At rest, each somewhere in a cell of his own, in the part of the room that is away from the door."""
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
    """Learners push where their action says, along the walls' axes; the others follow `_walker`.

    Who has left in the decision before is taken out of the world now: what was seen then is what there was.
    """
    for i in range(frame.pos.shape[1]):
        frame.alive[i] = frame.alive[i] and frame.memory[2, i] < 1.0
        if i < action.shape[0]:
            force[0, i] = action[i, 0] * frame.max_force[i]
            force[1, i] = action[i, 1] * frame.max_force[i]
        else:
            _walker(p, frame, i, force)


@kernel
def _walker(p: Any, frame: Frame, i: int, force: Any) -> None:
    """A scripted person: to the door at 1.34 m/s or less, and off others, as in Helbing, Farkas and Vicsek 2000."""
    velocity, top = velocity_of(frame, i), min(1.34, p.max_speed)
    y, fits = 0.5 * p.room - np.float64(frame.pos[1, i]), max(0.5 * p.width - 1.2 * _RADIUS, 0.0)
    aside = y - min(max(y, -fits), fits)
    way = unit((max(p.room - np.float64(frame.pos[0, i]), 0.0) + 0.1, aside))
    wish = scale(sub(scale(way, top), velocity), _MASS / p.driving_tau)
    for j in range(frame.pos.shape[1]):
        to = sub(place_of(frame, j), place_of(frame, i))
        if j != i and frame.alive[j] and norm(to) < p.sight:
            tie = (1.0, 0.0) if j < i else (-1.0, 0.0)
            push = steering.repulsion(to, tie, 2.0 * _RADIUS, p.circular_repulsion_decay)
            wish = add(wish, scale(push, p.circular_repulsion_strength))
    force[0, i], force[1, i] = wish[0], wish[1]


@kernel
def _wall_gap(p: Any, frame: Frame, i: int) -> float:
    """Return how far the centre of agent i is from the wall with the door, m."""
    x, y = p.room - np.float64(frame.pos[0, i]), abs(np.float64(frame.pos[1, i]) - 0.5 * p.room)
    beside = 0.5 * p.width - y  # of the door: how far the nearer post is
    return math.hypot(x, beside) if beside > 0.0 else abs(x)


@kernel
def _pressure(p: Any, frame: Frame, i: int) -> float:
    """Return what presses on agent i, N/m: elastic forces of bodies and of the door's wall over his circumference."""
    overlap = max(_RADIUS - _wall_gap(p, frame, i), 0.0)
    for j in range(frame.pos.shape[1]):
        if j != i and frame.alive[j]:
            x, y = frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i]
            overlap += max(2.0 * _RADIUS - math.hypot(x, y), 0.0)
    return _STIFFNESS * overlap / (2.0 * math.pi * _RADIUS)


@kernel
def keep(p: Any, before: Frame, after: Frame) -> None:
    """Remember what presses now, the most so far, N/m; who left now (1), or before (2), and when, s."""
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
def _left(p: Any, frame: Frame, i: int) -> float:
    """Return how far it is from agent i to the middle of the door's far side, m."""
    x, y = p.room + _RADIUS - np.float64(frame.pos[0, i]), 0.5 * p.room - np.float64(frame.pos[1, i])
    return math.hypot(max(x, 0.0), y)


@kernel
def reward(p: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Terms: progress, out, pressed, hurt, time; nothing for who has left before."""
    for i in range(terms.shape[0]):
        for k in range(5):
            terms[i, k] = 0.0
        if after.memory[2, i] < 2.0:
            pressure = np.float64(after.memory[0, i])
            terms[i, 0] = p.progress_reward * (_left(p, before, i) - _left(p, after, i))
            terms[i, 1] = p.out_reward if after.memory[2, i] > 0.0 else 0.0
            terms[i, 2] = -p.press_cost * min(pressure / p.limit, 1.0) * p.control_dt
            terms[i, 3] = -p.hurt_cost * p.control_dt if pressure > p.limit else 0.0
            terms[i, 4] = -p.time_cost * p.control_dt


@kernel
def ended(p: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """Who is through the door is out; all learners out, and none of them ever hurt: success."""
    everybody, unhurt = True, True
    for i in range(over.shape[0]):
        out = bool(after.memory[2, i] > 0.0)
        over[i] = out
        everybody &= out
        unhurt &= bool(after.memory[1, i] <= p.limit)
    if p.together > 0.0:
        for i in range(over.shape[0]):
            over[i] = everybody
    return everybody and unhurt


@kernel
def measure(p: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Learners out; when the first and the last of them left, s; most pressure so far, N/m; in touch, and hurt, s.

    The last two: the time, on average over them, in which somebody or the wall was touched, and in which it hurt.
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
    numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5] = out, first, latest, most, touched, hurt


@kernel
def metrics(p: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Share that is out; s until the last was, if all are; persons per s and m of door between the first and the last,
    once two are out; s in touch, each, on average; most pressure on anybody, N/m; s in which it hurt, each, on average.
    """  # fmt: skip
    span = last.latest - last.first
    numbers[0] = last.out / p.learners
    if last.out >= p.learners:
        numbers[1] = last.latest
    if last.out >= 2 and span > 0:
        numbers[2] = (last.out - 1) / span / p.width
    numbers[3], numbers[4], numbers[5] = sums.touched, last.most, sums.hurt


@kernel
def observe(p: Any, frame: Frame, rows: Any) -> None:
    """Own velocity, the way to the door on two scales, walls, what presses, the nearest others."""
    slots, one = int(p.neighbours), like(p.sight, 1.0)
    half, axis = 0.5 * p.room, (one, like(one, 0.0))
    for i in range(rows.shape[0]):
        row = rows[i]
        for c in range(rows.shape[1]):
            row[np.uint64(c)] = 0.0
        if frame.memory[2, i] > 0.0:
            continue
        x, y = p.room - frame.pos[0, i], half - frame.pos[1, i]
        put(row, 0, (clip(frame.vel[0, i] / p.max_speed), clip(frame.vel[1, i] / p.max_speed)))
        put(row, 2, (clip(x / p.room), clip(y / p.room)))
        put(row, 4, (clip(x / p.close), clip(y / p.close)))
        put(row, 6, (clip(frame.pos[1, i] / p.room), clip((p.room - frame.pos[1, i]) / p.room)))
        row[np.uint64(8)] = min(np.float64(frame.memory[0, i]) / p.limit, 1.0)
        for s in range(frame.near_count[i]):
            j = np.uint64(frame.near_who[s, i])
            to = (frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i])
            relative = (frame.vel[0, j] - frame.vel[0, i], frame.vel[1, j] - frame.vel[1, i])
            distance = max(math.sqrt(to[0] * to[0] + to[1] * to[1]), 1e-9)
            put_neighbour(row, 9, slots, s, to, relative, axis, one / p.sight, 0.5 * one / p.max_speed)
            put_crowding(row, 9, slots, s, to, axis, distance, distance - 2.0 * _RADIUS, p.near)
            row[np.uint64(9 + 6 * slots + s)] = 1.0


class Bottleneck(Task):
    """N people leave a room through one door; who is through is out, and the others go on. One policy for all.

    Who is out leaves the game. With `together` he stays in it, out of the world, paid nothing and shown zeros, until
    all are out: vector environments want learners that end together, and learn from the same returns.

    Bodies and walls are those of Helbing, Farkas and Vicsek 2000 (Nature 407:487): k = 1.2e5 kg/s^2, sliding friction
    kappa = 2.4e5 kg/(m s), 80 kg; damped (ours), because people do not bounce. Somebody is hurt, as there, where the
    forces that press on him are more than 1600 N for each metre of his circumference: 2.5 kN in all. Elastic forces of
    other bodies and of the wall with the door count; the other walls are hard and press on nobody. Everybody is paid
    for himself. All out, and none of them ever hurt, is success. Who does not learn walks by the forces of 2000 between
    people; walls stop him as bodies do.
    """

    name: ClassVar[str] = "bottleneck"
    terms: ClassVar[tuple[str, ...]] = ("progress", "out", "pressed", "hurt", "time")
    metric_names: ClassVar[tuple[str, ...]] = (
        "share_out", "evacuation_time", "specific_flow", "contact_time", "most_pressure", "hurt_time",
    )  # fmt: skip
    measures: ClassVar[tuple[str, ...]] = ("out", "first", "latest", "most", "touched", "hurt")
    memory: ClassVar[int] = 4
    keeps: ClassVar[bool] = True

    dt: float = Field(default=0.01, gt=0, description="s, one physics step: bodies are stiff")
    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    people: int = Field(default=20, ge=1, le=400, description="how many want to leave")
    learners: int = Field(
        default_factory=lambda given: given.get("people", 20), ge=1,
        description="how many of them learn (default: all); the others follow a script",
    )  # fmt: skip
    together: bool = Field(default=False, description="do learners who are out wait until all are?")
    room: float = Field(default=6.0, gt=1, description="m, edge of the room")
    width: float = Field(default=1.0, gt=0.5, description="m, of the door; bodies are 0.5 m wide")
    clear: float = Field(default=1.5, ge=0, description="m before the door, in which nobody begins")
    max_speed: float = Field(default=1.5, gt=0, description="m/s")
    max_force: float = Field(default=600.0, gt=0, description="N; the mass is 80 kg")
    sight: float = Field(default=2.0, gt=0, description="m, others are seen within this")
    neighbours: int = Field(default=6, ge=1, le=32, description="how many others are seen, nearest first")
    near: float = Field(default=0.5, gt=0, description="m between bodies, within which closeness is seen")
    close: float = Field(default=1.5, gt=0, description="m, the fine scale on which the door is seen")
    limit: float = Field(default=1600.0, gt=0, description="N/m, force on a body over its circumference that hurts")
    progress_reward: float = Field(default=0.5, ge=0, description="per m nearer to the door")
    out_reward: float = Field(default=5.0, ge=0, description="for getting out")
    press_cost: float = Field(default=2.0, ge=0, description="per s at the limit of pressure, less in proportion")
    hurt_cost: float = Field(default=50.0, ge=0, description="per s above the limit")
    time_cost: float = Field(default=0.5, ge=0, description="per s in the room")

    @model_validator(mode="after")
    def _room_for_all(self) -> Bottleneck:
        """Refuse more learners than people, a door that is wider than its wall, and more people than have room."""
        if self.learners > self.people:
            raise ValueError(f"learners = {self.learners}: there are only {self.people} people")
        if self.width >= self.room:
            raise ValueError(f"width = {self.width:g} m: the wall has {self.room:g} m")
        if self.clear >= self.room - 1.0:
            raise ValueError(f"clear = {self.clear:g} m: at most room - 1 = {self.room - 1:g} m is allowed")
        columns, rows = self.cells
        if min((self.room - self.clear) / columns, self.room / rows) < 2 * _RADIUS:
            raise ValueError(f"people = {self.people}: have no room in {self.room:g} m x {self.room - self.clear:g} m")
        return self

    @property
    def cells(self) -> tuple[int, int]:
        """In how many columns and rows they begin."""
        columns = max(1, round(math.sqrt(self.people * (self.room - self.clear) / self.room)))
        return columns, -(-self.people // columns)

    def parameters(self) -> dict[str, float]:
        """The fields, where people begin, and how those walk who do not learn."""
        columns, rows = self.cells
        begin = {"columns": float(columns), "rows": float(rows)}
        return super().parameters() | begin | _MODEL.numbers

    @property
    def agents(self) -> int:
        """Everybody."""
        return self.people

    @property
    def ends_together(self) -> bool:
        """Who is out is out, unless he waits, or is the only one."""
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
            Slot("door_near", (2,), self.close, "m", "the same on a fine scale, cut off beyond it"),
            Slot("to_sides", (2,), self.room, "m", "distance to the walls at y = 0 and y = room", low=0.0),
            Slot("pressure", (), self.limit, "N/m", "what presses, over the circumference", low=0.0),
            *neighbour_slots(self.neighbours, self.sight, 2 * self.max_speed, "others", crowding=True),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force, in the room's axes."""
        meaning = "force (x, y) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """The door."""
        return (Mark("goal", np.array([self.room, self.room / 2]), np.zeros(2), self.width / 2),)

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The room, and what is beyond the door."""
        return (0.0, 0.0), (self.room + _BEYOND, self.room)
