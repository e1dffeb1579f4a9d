"""Pursuit: catch an evader that is slower but turns faster, in a walled field."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar, Literal

from pydantic import Field

from flockenv import steering
from flockenv.geometry.space import Box
from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import scale
from flockenv.model.spawn import direction
from flockenv.scene import Group, Scene
from flockenv.steering import arbitration
from flockenv.tasks.layout import Layout, Slot, slots_of
from flockenv.tasks.task import Frame, Task

__all__ = ["Pursuit"]

_FAR = 1e30


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place all agents at random, at rest, no evader within 4 m of a pursuer (64 tries)."""
    pursuers, n = int(p.pursuers), frame.pos.shape[1]
    for i in range(n):
        for t in range(64):
            for k in range(2):
                frame.pos[k, i] = 1.0 + (p.size - 2.0) * uniform(frame.key, t, i, k)
            nearest = _FAR
            for j in range(min(i, pursuers)):
                if i >= pursuers:
                    nearest = min(nearest, _distance(frame, i, j))
            if nearest >= 4.0:
                break
        frame.vel[:, i] = 0.0
        direction(frame.key, 0, i, 4, frame.memory[:, i])


@kernel
def _distance(frame: Frame, i: int, j: int) -> float:
    return math.hypot(frame.pos[0, j] - frame.pos[0, i], frame.pos[1, j] - frame.pos[1, i])


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each learner's action as a force along the field's axes; scripted evaders follow `_steer_evader`."""
    for i in range(frame.pos.shape[1]):
        if i < action.shape[0]:
            for k in range(2):
                force[k, i] = action[i, k] * frame.max_force[i]
        else:
            _steer_evader(p, frame, i, force)


@kernel
def _steer_evader(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write a scripted evader's force; priorities: contain, evade the nearest pursuer, wander."""
    velocity, top = (frame.vel[0, i], frame.vel[1, i]), frame.max_speed[i]
    noise = (2.0 * uniform(frame.key, frame.step, i, 11) - 1.0, 2.0 * uniform(frame.key, frame.step, i, 12) - 1.0)
    target = steering.wander_turn((frame.memory[0, i], frame.memory[1, i]), noise, 2.0, p.control_dt)
    frame.memory[0, i], frame.memory[1, i] = target[0], target[1]
    wandering = steering.wander(target, velocity, top, 1.5)
    threat, distance = _nearest(frame, i, 0, int(p.pursuers))
    evasion: Vec = (0.0, 0.0)
    if threat >= 0 and distance < p.alarm_distance:
        offset = (frame.pos[0, threat] - frame.pos[0, i], frame.pos[1, threat] - frame.pos[1, i])
        threat_velocity = (frame.vel[0, threat], frame.vel[1, threat])
        evasion = steering.evade(offset, velocity, threat_velocity, top, min(0.5, distance / frame.max_speed[threat]))
    margin = 1.0
    low = (frame.pos[0, i] - margin, frame.pos[1, i] - margin)
    high = (p.size - margin - frame.pos[0, i], p.size - margin - frame.pos[1, i])
    inside = steering.contain(low, high, velocity, top, 0.5)
    gain = 1.0 / 0.2  # kg/s: the desired velocity is reached within 0.2 s
    forces = (scale(inside, gain), scale(evasion, gain), scale(wandering, gain))
    total = arbitration.allocate(forces, frame.max_force[i])
    force[0, i], force[1, i] = total[0], total[1]


@kernel
def _nearest(frame: Frame, i: int, first: int, end: int) -> tuple[int, float]:
    """Return the nearest living agent in [first, end) other than i, and its distance; -1 if there is none."""
    least, nearest = _FAR, -1
    for j in range(first, end):
        if j != i and frame.alive[j]:
            d = _distance(frame, i, j)
            if d < least:
                least, nearest = d, j
    return nearest, least


@kernel
def _sides(p: Any, frame: Frame, i: int) -> tuple[int, int, int, int, float]:
    """Return the ranges of opponents and of team mates of agent i, and +1 for a pursuer, -1 for an evader."""
    pursuers, n = int(p.pursuers), frame.pos.shape[1]
    if i < pursuers:
        return pursuers, n, 0, pursuers, 1.0
    else:
        return 0, pursuers, pursuers, n, -1.0


@kernel
def _is_caught(p: Any, before: Frame, after: Frame, j: int) -> bool:
    """Return True if evader j was alive before and a pursuer is within the capture distance now."""
    _, distance = _nearest(after, j, 0, int(p.pursuers))
    return bool(before.alive[j]) and distance <= p.capture_distance


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms closing, capture, time; evaders get them with the opposite sign."""
    caught = 0
    for j in range(int(p.pursuers), after.pos.shape[1]):
        caught += 1 if _is_caught(p, before, after, j) else 0
    for i in range(terms.shape[0]):
        for k in range(terms.shape[1]):
            terms[i, k] = 0.0
        if not before.alive[i]:
            continue
        first, end, _, _, side = _sides(p, after, i)
        opponent, d0 = _nearest(before, i, first, end)
        if opponent >= 0:
            terms[i, at.closing] = side * p.closing_reward * (d0 - _distance(after, i, opponent))
        prey = caught if side > 0 else (1 if _is_caught(p, before, after, i) else 0)
        terms[i, at.capture] = side * p.capture_reward * prey
        terms[i, at.time] = -side * p.time_cost * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """Remove caught evaders; end all learners when no evader is left, which is success."""
    pursuers, n = int(p.pursuers), after.pos.shape[1]
    left = 0
    for j in range(pursuers, n):
        out = not before.alive[j] or _is_caught(p, before, after, j)
        if j < over.shape[0]:
            over[j] = out
        after.alive[j] = not out
        left += 0 if out else 1
    for i in range(min(pursuers, over.shape[0])):
        over[i] = left == 0
    return left == 0


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write the path of pursuer 0, m; least distance between the sides, m; evaders caught; time until the last, s."""
    numbers[at.path] = math.hypot(after.pos[0, 0] - before.pos[0, 0], after.pos[1, 0] - before.pos[1, 0])
    n, pursuers = after.pos.shape[1], int(p.pursuers)
    best, caught, free = _FAR, 0, 0
    for j in range(pursuers, n):
        caught += 0 if after.alive[j] else 1
        free += 1 if before.alive[j] else 0
        for i in range(pursuers if before.alive[j] else 0):
            best = min(best, _distance(after, i, j))
    numbers[at.distance] = best
    numbers[at.captured] = caught
    numbers[at.time] = p.control_dt if free > 0 else 0.0


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write time of the last capture, s, if all are caught; path of pursuer 0, m; distance now, m; evaders caught."""
    if last.captured >= p.evaders:
        numbers[at.time_to_capture] = sums.time
    numbers[at.path_length], numbers[at.least_distance] = sums.path, last.distance
    numbers[at.captured] = last.captured


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, walls, and the nearest opponents and team mates, nearest first."""
    for i in range(rows.shape[0]):
        row = rows[i]
        for c in range(row.shape[0]):
            row[c] = 0.0
        first, end, mate, mates_end, _ = _sides(p, frame, i)
        for k in range(2):
            row[at.velocity + k] = _clip(frame.vel[k, i] / p.speed_scale)
            row[at.to_low + k] = _clip(frame.pos[k, i] / p.size)
            row[at.to_high + k] = _clip((p.size - frame.pos[k, i]) / p.size)
        slots = int(p.opponent_slots)
        opponents = (at.opponents, at.opponent_velocity, at.opponent_present)
        _write_nearest(p, frame, i, first, end, slots, row, opponents)
        mates = (at.mates, at.mate_velocity, at.mate_present)
        _write_nearest(p, frame, i, mate, mates_end, int(p.mate_slots), row, mates)
        for s in range(slots):
            dx, dy = row[at.opponents + 2 * s] * p.size, row[at.opponents + 2 * s + 1] * p.size
            distance = math.sqrt(dx * dx + dy * dy)
            if distance > 0.0:
                row[at.bearing + 2 * s], row[at.bearing + 2 * s + 1] = dx / distance, dy / distance
            row[at.closeness + s] = max(1.0 - distance / p.near, 0.0) * row[at.opponent_present + s]


@kernel
def _write_nearest(p: Any, frame: Frame, i: int, first: int, end: int, slots: int, row: Any, places: Any) -> None:
    """Write the nearest `slots` living agents of [first, end): offsets, velocities, presence, from these indices on."""
    offsets, velocities, presence = places
    closest = -1.0
    chosen = -1
    for s in range(slots):
        least, nearest = _FAR, -1
        for j in range(first, end):
            d = _distance(frame, i, j)
            after_last = d > closest or (d == closest and j > chosen)
            if j != i and frame.alive[j] and after_last and d < least:
                least, nearest = d, j
        if nearest < 0:
            break
        for k in range(2):
            row[offsets + 2 * s + k] = _clip((frame.pos[k, nearest] - frame.pos[k, i]) / p.size)
            row[velocities + 2 * s + k] = _clip(frame.vel[k, nearest] / p.speed_scale)
        row[presence + s] = 1.0
        closest, chosen = least, nearest


@kernel
def _clip(x: float) -> float:
    return min(max(x, -1.0), 1.0)


class Pursuit(Task):
    """Pursuers, by default one, chase evaders that are slower but turn faster, in a walled field.

    A scripted evader evades the nearest pursuer within `alarm_distance`, stays in the field, and wanders otherwise, by
    prioritised acceleration allocation in the order contain, evade, wander. With sides="both" the evaders are learners
    also, with rewards of the opposite sign. A caught evader terminates; the episode ends, with success, once all
    evaders are caught.
    """

    name: ClassVar[str] = "pursuit"
    terms: ClassVar[tuple[str, ...]] = ("closing", "capture", "time")
    metric_names: ClassVar[tuple[str, ...]] = ("time_to_capture", "path_length", "least_distance", "captured")
    measures: ClassVar[tuple[str, ...]] = ("path", "distance", "captured", "time")
    memory: ClassVar[int] = 2

    pursuers: int = Field(default=1, ge=1, le=64, description="number of pursuers")
    evaders: int = Field(default=1, ge=1, le=64, description="number of evaders")
    sides: Literal["pursuers", "both"] = Field(
        default="pursuers", description="the learners: pursuers only, or both sides"
    )
    size: float = Field(default=20.0, gt=6, description="m, edge of the field")
    pursuer_speed: float = Field(default=3.0, gt=0, description="m/s")
    pursuer_force: float = Field(default=5.0, gt=0, description="N; the mass is 1 kg")
    evader_speed: float = Field(default=2.4, gt=0, description="m/s")
    evader_force: float = Field(default=12.0, gt=0, description="N; the mass is 1 kg")
    alarm_distance: float = Field(default=8.0, ge=0, description="m, within which a scripted evader flees")
    near: float = Field(default=4.0, gt=0, description="m, range within which `closeness` is not 0")
    capture_distance: float = Field(default=0.6, gt=0, description="m between centres, for a capture")
    closing_reward: float = Field(default=0.1, ge=0, description="per m by which the nearest evader came nearer")
    capture_reward: float = Field(default=10.0, ge=0, description="for each capture, to every pursuer")
    time_cost: float = Field(default=0.5, ge=0, description="per s")

    @property
    def learners(self) -> int:
        """L: the pursuers, or all agents."""
        return self.pursuers + (self.evaders if self.sides == "both" else 0)

    @property
    def agents(self) -> int:
        """N: pursuers and evaders."""
        return self.pursuers + self.evaders

    @property
    def agent_names(self) -> tuple[str, ...]:
        """pursuer_0 ..., evader_0 ..."""
        names = [f"pursuer_{i}" for i in range(self.pursuers)] + [f"evader_{j}" for j in range(self.evaders)]
        return tuple(names[: self.learners])

    @property
    def ends_together(self) -> bool:
        """True unless evaders are learners: these leave when they are caught."""
        return self.sides == "pursuers"

    @functools.cached_property
    def scene(self) -> Scene:
        """A walled square, in which only the agents' own forces act."""
        return Scene(
            space=Box(size=(self.size, self.size)),
            groups=(
                Group(
                    count=self.pursuers,
                    radius=0.3,
                    max_speed=self.pursuer_speed,
                    max_force=self.pursuer_force,
                    role="pursuer",
                ),
                Group(
                    count=self.evaders,
                    radius=0.3,
                    max_speed=self.evader_speed,
                    max_force=self.evader_force,
                    role="evader",
                ),
            ),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def _slots(self) -> tuple[int, int]:
        """Number of opponents and of team mates in an observation, the same for both sides."""
        teams = (self.pursuers, self.evaders) if self.sides == "both" else (self.pursuers,)
        opponents = max(self.pursuers, self.evaders) if self.sides == "both" else self.evaders
        return min(opponents, 3), min(max(teams) - 1, 2)

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the numbers derived from them."""
        opponents, mates = self._slots
        fastest = max(self.pursuer_speed, self.evader_speed)
        return super().parameters() | {"opponent_slots": opponents, "mate_slots": mates, "speed_scale": fastest}

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; axes are the field's, and offsets are relative to the agent."""
        opponents, mates = self._slots
        fastest = max(self.pursuer_speed, self.evader_speed)
        near = "1 - distance / near; 0 for a distance above near, and for an empty slot"
        there = "1 for each one, 0 for an empty slot, whose other numbers are also 0"
        return Layout((
            Slot("velocity", (2,), fastest, "m/s", "own velocity (x, y)"),
            Slot("to_low", (2,), self.size, "m", "distance to the walls at x = 0 and y = 0", low=0.0),
            Slot("to_high", (2,), self.size, "m", "distance to the walls at x = size and y = size", low=0.0),
            *slots_of("opponents",
                Slot("opponents", (opponents, 2), self.size, "m", "offsets of the nearest opponents, nearest first"),
                Slot("opponent_velocity", (opponents, 2), fastest, "m/s", "their velocities"),
                Slot("opponent_present", (opponents,), 1.0, "1", there, low=0.0),
            ),
            *slots_of("mates",
                Slot("mates", (mates, 2), self.size, "m", "offsets of the nearest team mates, nearest first"),
                Slot("mate_velocity", (mates, 2), fastest, "m/s", "their velocities"),
                Slot("mate_present", (mates,), 1.0, "1", there, low=0.0),
            ),
            *slots_of("opponents",
                Slot("bearing", (opponents, 2), 1.0, "1", "unit vectors towards the opponents; zeros: empty slot"),
                Slot("closeness", (opponents,), 1.0, "1", near, low=0.0),
            ),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force along the field's axes."""
        meaning = "force (x, y) / own max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.pursuer_force, "N", meaning),))
