"""Herd: dogs gather sheep that flock and flee from them, and drive them into a pen."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.geometry.space import Plane
from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.counter_rng import smooth, uniform
from flockenv.maths.vectors import add, norm, scale, sub, unit
from flockenv.model.snapshot import Mark
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.tasks.layout import Layout, Slot, slots_of
from flockenv.tasks.observations import clip, position_of, velocity_of
from flockenv.tasks.task import Frame, Task

__all__ = ["Herd"]

_TRIES = 64
_GAIN = 5.0  # kg/s: a sheep reaches its desired velocity within 0.2 s


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place the pen, sheep around a point at least `away` m from it, dogs beyond `fear_distance`; all at rest."""
    frame.vel[:, :] = 0.0
    middle: Vec = (0.0, 0.0)
    for t in range(_TRIES):
        pen, middle = _random_point(p, frame, t, 0), _random_point(p, frame, t, 1)
        frame.memory[0, :], frame.memory[1, :] = pen[0], pen[1]
        if norm(sub(pen, middle)) >= p.away:
            break
    dogs, n = int(p.dogs), frame.pos.shape[1]
    for i in range(dogs, n):
        for t in range(_TRIES):
            r = p.scatter * math.sqrt(uniform(frame.key, t, i, 3))
            a = 2.0 * math.pi * uniform(frame.key, t, i, 4)
            frame.pos[0, i], frame.pos[1, i] = middle[0] + r * math.cos(a), middle[1] + r * math.sin(a)
            if _is_clear(frame, i, dogs, i, p.apart_distance):
                break
    for i in range(dogs):
        for t in range(_TRIES):
            place = _random_point(p, frame, t, 10 + i)
            frame.pos[0, i], frame.pos[1, i] = place[0], place[1]
            if _is_clear(frame, i, dogs, n, p.fear_distance) and _is_clear(frame, i, 0, i, 2.0):
                break


@kernel
def _random_point(p: Any, frame: Frame, t: int, channel: int) -> Vec:
    """Return a random point of the middle half of the field, at least a quarter of the edge from its border."""
    x = p.size * (0.25 + 0.5 * uniform(frame.key, t, 500 + channel, 5))
    return (np.float64(x), np.float64(p.size * (0.25 + 0.5 * uniform(frame.key, t, 500 + channel, 6))))


@kernel
def _is_clear(frame: Frame, i: int, first: int, end: int, distance: float) -> bool:
    """Return True if agent i is at least `distance` m from the agents [first, end)."""
    for j in range(first, end):  # noqa: SIM110  # there are no generators in compiled code
        if norm(_offset_to(frame, i, j)) < distance:
            return False
    return True


@kernel
def _offset_to(frame: Frame, i: int, j: int) -> Vec:
    """Return the offset of agent j from agent i, m."""
    return sub(position_of(frame, j), position_of(frame, i))


@kernel
def _flock_centre(p: Any, frame: Frame) -> Vec:
    """Return the centre of the flock, m."""
    x, y, dogs, n = 0.0, 0.0, int(p.dogs), frame.pos.shape[1]
    for j in range(dogs, n):
        x += frame.pos[0, j]
        y += frame.pos[1, j]
    return (x / (n - dogs), y / (n - dogs))


@kernel
def _pen_position(frame: Frame) -> Vec:
    return (np.float64(frame.memory[0, 0]), np.float64(frame.memory[1, 0]))


@kernel
def _course(p: Any, frame: Frame) -> Vec:
    """Return the unit vector from the flock's centre to the pen; the x axis if the centre is at the pen."""
    direction = unit(sub(_pen_position(frame), _flock_centre(p, frame)))
    return direction if direction[0] != 0.0 or direction[1] != 0.0 else (1.0, 0.0)


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each dog's action as a force in the frame of the course; sheep follow `_steer_sheep`."""
    course, dogs = _course(p, frame), int(p.dogs)
    for i in range(dogs):
        along, left = action[i, 0] * frame.max_force[i], action[i, 1] * frame.max_force[i]
        force[0, i] = along * course[0] - left * course[1]
        force[1, i] = along * course[1] + left * course[0]
    for i in range(dogs, frame.pos.shape[1]):
        _steer_sheep(p, frame, i, force)


@kernel
def _steer_sheep(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write a sheep's force: flee dogs within `fear_distance` as in Strombom et al. 2014, else graze slowly, apart."""
    velocity, dogs = velocity_of(frame, i), int(p.dogs)
    crowd: Vec = (0.0, 0.0)
    centre: Vec = (0.0, 0.0)
    away: Vec = (0.0, 0.0)
    for j in range(dogs, frame.pos.shape[1]):
        to = _offset_to(frame, i, j)
        square = to[0] * to[0] + to[1] * to[1]
        if j != i and square < p.flock_sight * p.flock_sight:
            centre = add(centre, to)
            if square < p.apart_distance * p.apart_distance:
                crowd = sub(crowd, unit(to))
    for j in range(dogs):
        to = _offset_to(frame, i, j)
        if norm(to) < p.fear_distance:
            away = sub(away, unit(to))
    time = frame.step * p.control_dt
    noise = (smooth(frame.key, time, i, 21), smooth(frame.key, time, i, 22))
    if away[0] != 0.0 or away[1] != 0.0:
        direction = steering.sheep_direction(
            velocity, centre, crowd, away, noise, p.inertia, p.attraction, p.apart, p.fear, p.error
        )  # fmt: skip
        desired = scale(direction, np.float64(frame.max_speed[i]))
    else:
        desired = scale(add(unit(crowd), noise), np.float64(p.graze_speed))
    total = scale(sub(desired, velocity), _GAIN)
    force[0, i], force[1, i] = total[0], total[1]


@kernel
def _farthest(p: Any, frame: Frame, centre: Vec) -> tuple[int, float]:
    """Return the sheep that is farthest from the centre, and the mean distance of all sheep from it, m."""
    farthest, most, total, dogs, n = 0, -1.0, 0.0, int(p.dogs), frame.pos.shape[1]
    for j in range(dogs, n):
        distance = norm(sub(position_of(frame, j), centre))
        total += distance
        if distance > most:
            farthest, most = j, distance
    return farthest, total / (n - dogs)


@kernel
def _count_penned(p: Any, frame: Frame) -> int:
    """Return the number of sheep in the pen."""
    count, pen = 0, _pen_position(frame)
    for j in range(int(p.dogs), frame.pos.shape[1]):
        count += 1 if norm(sub(position_of(frame, j), pen)) <= p.pen_radius else 0
    return count


@kernel
def _all_penned(p: Any, frame: Frame) -> bool:
    return bool(_count_penned(p, frame) == frame.pos.shape[1] - int(p.dogs))


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, gathering, success, time; the same for every dog."""
    here, there = _flock_centre(p, before), _flock_centre(p, after)
    nearer = norm(sub(_pen_position(before), here)) - norm(sub(_pen_position(after), there))
    _, wide = _farthest(p, before, here)
    _, now_wide = _farthest(p, after, there)
    success = p.success_reward if _all_penned(p, after) else 0.0
    for i in range(terms.shape[0]):
        terms[i, at.progress] = p.progress_reward * nearer
        terms[i, at.gathering] = p.gathering_reward * (wide - now_wide)
        terms[i, at.success] = success
        terms[i, at.time] = -p.time_cost * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the episode when all sheep are in the pen, which is success."""
    done = _all_penned(p, after)
    for i in range(over.shape[0]):
        over[i] = done
    return done


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write the share of sheep penned; time, s; mean distance of sheep from their centre, m; mean path of a dog, m."""
    n, dogs = after.pos.shape[1], int(p.dogs)
    numbers[at.penned] = _count_penned(p, after) / (n - dogs)
    numbers[at.time] = p.control_dt
    _, numbers[at.spread] = _farthest(p, after, _flock_centre(p, after))
    path = 0.0
    for i in range(dogs):
        path += norm(sub(position_of(after, i), position_of(before, i)))
    numbers[at.path] = path / dogs


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write the share of sheep penned; time until all were, s, if they are; spread now, m; mean path of a dog, m."""
    numbers[at.share_penned] = last.penned
    if last.penned >= 1.0 and steps > 0:
        numbers[at.time_to_pen] = sums.time
    numbers[at.spread], numbers[at.path_length] = last.spread, sums.path


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, pen, flock, farthest and nearest sheep, other dogs, in the frame of the course."""
    centre, course, pen = _flock_centre(p, frame), _course(p, frame), _pen_position(frame)
    far, spread = _farthest(p, frame, centre)
    dogs = int(p.dogs)
    for i in range(rows.shape[0]):
        row = rows[i]
        for c in range(rows.shape[1]):
            row[c] = 0.0
        here = position_of(frame, i)
        _write_local(row, at.velocity, scale(velocity_of(frame, i), 1.0 / p.dog_speed), course)
        _write_local(row, at.goal, scale(sub(pen, here), 1.0 / p.sight), course)
        to_centre = sub(centre, here)
        _write_local(row, at.centre, scale(to_centre, 1.0 / p.sight), course)
        _write_local(row, at.centre_bearing, unit(to_centre), course)
        _write_local(row, at.farthest, scale(_offset_to(frame, i, far), 1.0 / p.sight), course)
        row[at.spread] = min(spread / p.spread_scale, 1.0)
        row[at.stray] = min(norm(sub(position_of(frame, far), centre)) / p.spread_scale, 1.0)
        _write_sheep(p, at, frame, i, course, row)
        for j in range(dogs):
            if j != i:
                mate = j if j < i else j - 1
                _write_local(row, at.mates + 2 * mate, scale(_offset_to(frame, i, j), 1.0 / p.sight), course)


@kernel
def _write_sheep(p: Any, at: Any, frame: Frame, i: int, course: Vec, row: Any) -> None:
    """Write the nearest sheep of dog i, nearest first, and the direction and closeness of the first."""
    previous, chosen = -1.0, -1
    for s in range(int(p.sheep_seen)):
        least, nearest = np.inf, -1
        for j in range(int(p.dogs), frame.pos.shape[1]):
            to = _offset_to(frame, i, j)
            square = to[0] * to[0] + to[1] * to[1]
            later = square > previous or (square == previous and j > chosen)
            if later and square < least:
                least, nearest = square, j
        if nearest < 0:
            break
        to = _offset_to(frame, i, nearest)
        _write_local(row, at.sheep + 2 * s, scale(to, 1.0 / p.sight), course)
        _write_local(row, at.sheep_velocity + 2 * s, scale(velocity_of(frame, nearest), 1.0 / p.sheep_speed), course)
        row[at.sheep_present + s] = 1.0
        if s == 0:
            _write_local(row, at.bearing, unit(to), course)
            row[at.closeness] = max(1.0 - norm(to) / p.fear_distance, 0.0)
        previous, chosen = least, nearest


@kernel
def _write_local(row: Any, at: int, vector: Vec, course: Vec) -> None:
    """Write a vector's components along the course and to its left, clipped to [-1, 1]."""
    row[at] = clip(vector[0] * course[0] + vector[1] * course[1])
    row[at + 1] = clip(vector[1] * course[0] - vector[0] * course[1])


class Herd(Task):
    """Dogs with one shared policy gather sheep and drive them into a round pen, in an open field.

    Sheep graze until a dog comes near. Then they move at full speed, in the direction of Strombom et al. 2014 (doi
    10.1098/rsif.2014.0719), a weighted sum: away from dogs, to the centre of the sheep around, away from sheep that are
    too near, inertia, and noise. Observations are relative to the dog, in the frame of the course, which leads from the
    flock's centre to the pen. The episode ends, with success, when all sheep are in the pen at once.
    """

    name: ClassVar[str] = "herd"
    terms: ClassVar[tuple[str, ...]] = ("progress", "gathering", "success", "time")
    metric_names: ClassVar[tuple[str, ...]] = ("share_penned", "time_to_pen", "spread", "path_length")
    measures: ClassVar[tuple[str, ...]] = ("penned", "time", "spread", "path")
    memory: ClassVar[int] = 2

    dogs: int = Field(default=1, ge=1, le=3, description="number of dogs, the learners")
    sheep: int = Field(default=12, ge=2, le=200, description="number of sheep")
    horizon: int = Field(default=600, ge=1, description="decisions until the time limit (truncation)")
    size: float = Field(
        default=60.0,
        gt=0,
        description="m, edge of the field in pictures; the pen and the dogs start in its middle half",
    )
    pen_radius: float = Field(default=4.0, gt=0, description="m, radius of the pen")
    away: float = Field(
        default=15.0, ge=0, description="m, least distance between the pen and the middle of the sheep at the start"
    )
    scatter: float = Field(default=6.0, gt=0, description="m, radius about that middle within which sheep start")
    dog_speed: float = Field(default=3.0, gt=0, description="m/s")
    dog_force: float = Field(default=9.0, gt=0, description="N; the mass is 1 kg")
    sheep_speed: float = Field(default=2.0, gt=0, description="m/s, of a fleeing sheep")
    sheep_force: float = Field(default=6.0, gt=0, description="N; the mass is 1 kg")
    graze_speed: float = Field(default=0.2, ge=0, description="m/s, of a grazing sheep")
    fear_distance: float = Field(default=8.0, gt=0, description="r_s, m, within which a sheep flees a dog")
    apart_distance: float = Field(default=1.0, gt=0, description="r_a, m, within which sheep repel each other")
    flock_sight: float = Field(default=12.0, gt=0, description="m, range within which sheep attract each other")
    inertia: float = Field(default=0.5, ge=0, description="h, weight of the present direction")
    attraction: float = Field(default=1.05, ge=0, description="c, weight of the direction to the centre of the others")
    apart: float = Field(default=2.0, ge=0, description="rho_a, weight of the repulsion from sheep that are too near")
    fear: float = Field(default=1.0, ge=0, description="rho_s, weight of the repulsion from dogs")
    error: float = Field(default=0.3, ge=0, description="e, weight of the noise")
    sight: float = Field(default=40.0, gt=0, description="m, offsets are seen up to this along each axis")
    sheep_seen: int = Field(default=6, ge=1, le=32, description="number of sheep seen one by one, nearest first")
    progress_reward: float = Field(
        default=0.5, ge=0, description="per m by which the flock's centre came nearer to the pen"
    )
    gathering_reward: float = Field(
        default=0.5, ge=0, description="per m by which the mean distance of sheep from their centre fell"
    )
    success_reward: float = Field(default=10.0, ge=0, description="once, when all sheep are in the pen")
    time_cost: float = Field(default=0.2, ge=0, description="per s")

    @model_validator(mode="after")
    def _check_room(self) -> Herd:
        """Raise ValueError if `away` is more than a third of the field."""
        if self.away > self.size / 3:
            raise ValueError(f"away = {self.away:g} m: must be at most size / 3 = {self.size / 3:g} m")
        return self

    @property
    def learners(self) -> int:
        """L: the dogs."""
        return self.dogs

    @property
    def agents(self) -> int:
        """N: dogs and sheep."""
        return self.dogs + self.sheep

    @property
    def agent_names(self) -> tuple[str, ...]:
        """dog_0 ..."""
        return tuple(f"dog_{i}" for i in range(self.dogs))

    @functools.cached_property
    def scene(self) -> Scene:
        """An open plane, in which only the agents' own forces act."""
        common: dict[str, Any] = {"radius": 0.3, "spawn": Spawn(low=(0.0, 0.0), high=(self.size, self.size))}
        dogs = Group(
            count=self.dogs, max_speed=self.dog_speed, max_force=self.dog_force, role="learner", **common
        )  # fmt: skip
        sheep = Group(
            count=self.sheep, max_speed=self.sheep_speed, max_force=self.sheep_force, role="flockmate", **common
        )  # fmt: skip
        return Scene(
            space=Plane(),
            groups=(dogs, sheep),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def spread_scale(self) -> float:
        """Greatest distance from the flock's centre that is seen, m."""
        return 2.0 * self.scatter

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the numbers derived from them."""
        return super().parameters() | {"spread_scale": self.spread_scale}

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; every vector is (along the course from the flock's centre to the pen, to its left)."""
        k, mates, far = self.sheep_seen, self.dogs - 1, self.sight
        near = "1 - distance / fear_distance of the nearest sheep; 0 for a distance above it"
        return Layout((
            Slot("velocity", (2,), self.dog_speed, "m/s", "own velocity (along the course, to its left)"),
            Slot("goal", (2,), far, "m", "offset of the pen's centre"),
            Slot("centre", (2,), far, "m", "offset of the flock's centre"),
            Slot("centre_bearing", (2,), 1.0, "1", "unit vector towards the flock's centre"),
            Slot("farthest", (2,), far, "m", "offset of the sheep that is farthest from the flock's centre"),
            Slot("spread", (), self.spread_scale, "m", "mean distance of the sheep from their centre", low=0.0),
            Slot("stray", (), self.spread_scale, "m", "distance of that sheep from the flock's centre", low=0.0),
            *slots_of("sheep",
                Slot("sheep", (k, 2), far, "m", "offsets of the nearest sheep, nearest first"),
                Slot("sheep_velocity", (k, 2), self.sheep_speed, "m/s", "their velocities"),
                Slot("sheep_present", (k,), 1.0, "1", "1 for each sheep, 0 for an empty slot", low=0.0),
                Slot("bearing", (2,), 1.0, "1", "unit vector towards the nearest sheep", nearest=True),
                Slot("closeness", (), 1.0, "1", near, low=0.0, nearest=True),
            ),
            Slot("mates", (mates, 2), far, "m", "offsets of the other dogs"),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force in the frame of the course."""
        meaning = "force (along the course, to its left) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.dog_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark at the pen."""
        return (Mark("goal", memory[:2, world, 0], np.zeros(2), self.pen_radius),)

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the field in which agents start, m."""
        return (0.0, 0.0), (self.size, self.size)
