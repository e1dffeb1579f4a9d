"""Evade: an evader escapes a team of pursuers among cover, behind which they lose sight of it."""

from __future__ import annotations

import functools
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.engine import Look
from flockenv.geometry.shapes import ray_hit
from flockenv.geometry.space import Box
from flockenv.jit.decorators import Vec, kernel, like
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import add, norm, scale, unit
from flockenv.physics.effects import ObstacleContact
from flockenv.scene import Group, Scene
from flockenv.steering import arbitration
from flockenv.tasks.layout import Layout, Slot, slots_of
from flockenv.tasks.observations import clip, leaves_gap, ray_directions, shorten_free_paths, velocity_of
from flockenv.tasks.task import Frame, Task

__all__ = ["Evade"]

_TRIES = 64
_GAIN = 5.0  # kg/s: a pursuer reaches its desired velocity within 0.2 s, if its force limit allows
_SEARCH = 4.0  # s, after which a searching pursuer looks behind another cover


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place cover with gaps, the evader in the open, pursuers at least `start_distance` m from it; all at rest."""
    frame.vel[:, :] = 0.0
    for m in range(frame.rho.shape[0]):
        frame.rho[m] = 0.0
        for t in range(_TRIES):
            rho = p.least_radius + (p.greatest_radius - p.least_radius) * uniform(frame.key, t, 100 + m, 0)
            edge = rho + p.min_gap
            x = edge + (p.size - 2.0 * edge) * uniform(frame.key, t, 100 + m, 1)
            y = edge + (p.size - 2.0 * edge) * uniform(frame.key, t, 100 + m, 2)
            if leaves_gap(p, frame, m, x, y, rho):
                frame.centre[0, m], frame.centre[1, m], frame.rho[m] = x, y, rho
                break
    for i in range(frame.pos.shape[1]):
        for t in range(_TRIES):
            for k in range(2):
                frame.pos[k, i] = 1.0 + (p.size - 2.0) * uniform(frame.key, t, i, k)
            if _is_clear(p, frame, i):
                break
        frame.memory[:, i] = 0.0
        frame.memory[2, i] = p.patience  # it has not seen the evader yet


@kernel
def _is_clear(p: Any, frame: Frame, i: int) -> bool:
    """Return True if agent i is clear of cover, and far enough from the evader and from the pursuers before it."""
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0 and norm(_cover_offset(frame, i, m)) < frame.rho[m] + 2.0 * frame.radius[i]:
            return False
    for j in range(i):  # noqa: SIM110  # there are no generators in compiled code
        if norm(_offset_to(frame, i, j)) < (p.start_distance if j == 0 else 2.0):
            return False
    return True


@kernel
def _offset_to(frame: Frame, i: int, j: int) -> Vec:
    """Return the offset of agent j from agent i, m; subtracted in the precision of the scene, as in training."""
    return (np.float64(frame.pos[0, j] - frame.pos[0, i]), np.float64(frame.pos[1, j] - frame.pos[1, i]))


@kernel
def _cover_offset(frame: Frame, i: int, m: int) -> Vec:
    """Return the offset of the centre of cover m from agent i, m."""
    return (np.float64(frame.centre[0, m] - frame.pos[0, i]), np.float64(frame.centre[1, m] - frame.pos[1, i]))


@kernel
def _sees(p: Any, frame: Frame, i: int) -> bool:
    """Return True if pursuer i sees the evader: it is within sight, and no cover blocks the straight line to it."""
    to = _offset_to(frame, i, 0)
    distance, direction = norm(to), unit(to)
    if distance > p.sight:
        return False
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0 and ray_hit(_cover_offset(frame, i, m), direction, np.float64(frame.rho[m])) < distance:
            return False
    return True


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write the learner's action as a force along the field's axes; pursuers follow `_steer_pursuer`."""
    for k in range(2):
        force[k, 0] = action[0, k] * frame.max_force[0]
    for i in range(1, frame.pos.shape[1]):
        _steer_pursuer(p, frame, i, force)


@kernel
def _steer_pursuer(p: Any, frame: Frame, i: int, force: Any) -> None:
    """Write a pursuer's force; priorities: avoid cover, separate from mates, stay in the field, chase the evader."""
    velocity, top = velocity_of(frame, i), np.float64(frame.max_speed[i])
    margin = 0.5
    low = (frame.pos[0, i] - margin, frame.pos[1, i] - margin)
    high = (p.size - margin - frame.pos[0, i], p.size - margin - frame.pos[1, i])
    inside = steering.contain(
        (np.float64(low[0]), np.float64(low[1])), (np.float64(high[0]), np.float64(high[1])), velocity, top, 0.3
    )  # fmt: skip
    forces = (
        scale(_avoid_cover(frame, i, velocity, top), _GAIN), scale(_separation(frame, i), 2.0), scale(inside, _GAIN),
        scale(_chase(p, frame, i, velocity, top), _GAIN),
    )  # fmt: skip
    total = arbitration.allocate(forces, np.float64(frame.max_force[i]))
    force[0, i], force[1, i] = total[0], total[1]


@kernel
def _chase(p: Any, frame: Frame, i: int, velocity: Vec, top: float) -> Vec:
    """Return the steering vector of the chase: pursue the evader if it is seen, else seek its last seen position.

    Once there, or after `patience` s, look behind random cover. Memory: where the evader was last seen, m, and how long
    ago, s.
    """
    if _sees(p, frame, i):
        to, theirs = _offset_to(frame, i, 0), velocity_of(frame, 0)
        frame.memory[0, i], frame.memory[1, i], frame.memory[2, i] = frame.pos[0, 0], frame.pos[1, 0], 0.0
        return steering.pursue(to, velocity, theirs, top, min(steering.interception_time(to, theirs, top), 1.0))
    frame.memory[2, i] += p.control_dt
    to_last = (np.float64(frame.memory[0, i] - frame.pos[0, i]), np.float64(frame.memory[1, i] - frame.pos[1, i]))
    if frame.memory[2, i] < p.patience and norm(to_last) > 0.5:
        return steering.seek(to_last, velocity, top)
    frame.memory[2, i] = p.patience
    covers = frame.rho.shape[0]
    middle = (p.size * 0.5 - frame.pos[0, i], p.size * 0.5 - frame.pos[1, i])
    target: Vec = (np.float64(middle[0]), np.float64(middle[1]))
    if covers > 0:
        turn = int(frame.step * p.control_dt / _SEARCH)
        m = min(int(covers * uniform(frame.key, turn, i, 7)), covers - 1)
        if frame.rho[m] > 0.0:
            target = steering.hiding_place(_cover_offset(frame, i, m), np.float64(frame.rho[m]), 1.0, (0.0, 0.0))
    return steering.arrive(target, velocity, top, 1.0)


@kernel
def _avoid_cover(frame: Frame, i: int, velocity: Vec, top: float) -> Vec:
    """Return the steering vector around the cover that would be hit first within 1 s."""
    forward = unit(velocity)
    position: Vec = (0.0, 0.0)
    nearest, least_clearance = np.inf, 0.0
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0:
            to, clearance = _cover_offset(frame, i, m), np.float64(frame.rho[m] + frame.radius[i]) + 0.1
            t = steering.threat(forward, to, clearance, norm(velocity))
            if t < nearest:
                nearest, position, least_clearance = t, to, clearance
    if nearest < np.inf:
        return steering.avoid(forward, position, least_clearance, top)
    else:
        return (0.0, 0.0)


@kernel
def _separation(frame: Frame, i: int) -> Vec:
    """Return the separation from pursuers within 2 m, so that they come from several sides."""
    push: Vec = (0.0, 0.0)
    for j in range(1, frame.pos.shape[1]):
        to = _offset_to(frame, i, j)
        if j != i and norm(to) < 2.0:
            push = add(push, steering.separate(to, (1.0, 0.0) if j < i else (-1.0, 0.0)))
    return push


@kernel
def _nearest_distance(frame: Frame) -> float:
    """Return the distance of the nearest pursuer from the evader, m."""
    best = np.inf
    for j in range(1, frame.pos.shape[1]):
        best = min(best, norm(_offset_to(frame, 0, j)))
    return best


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms alive, caught, effort."""
    caught = _nearest_distance(after) <= p.capture_distance
    square = min(action[0, 0] * action[0, 0] + action[0, 1] * action[0, 1], 1.0)
    terms[0, at.alive] = 0.0 if caught else p.alive_reward * p.control_dt
    terms[0, at.caught] = -p.caught_cost if caught else 0.0
    terms[0, at.effort] = -p.effort_cost * square * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the episode at a capture; return True as long as the evader is not caught."""
    over[0] = _nearest_distance(after) <= p.capture_distance
    return not over[0]


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write time, s; time unseen by all pursuers, s; caught (0 or 1); distance of the nearest pursuer, m."""
    seen = False
    for i in range(1, after.pos.shape[1]):
        seen = seen or _sees(p, after, i)
    numbers[at.time] = p.control_dt
    numbers[at.hidden] = 0.0 if seen else p.control_dt
    numbers[at.distance] = _nearest_distance(after)
    numbers[at.caught] = 1.0 if numbers[at.distance] <= p.capture_distance else 0.0


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write survival time, s; survived (0 or 1); time unseen, s; distance of the nearest pursuer now, m."""
    numbers[at.survival_time], numbers[at.survived] = sums.time, 1.0 - last.caught
    numbers[at.time_hidden], numbers[at.least_distance] = sums.hidden, last.distance


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, walls, pursuers (nearest first), whether each sees it, nearest cover, free path lengths."""
    row = rows[0]
    for c in range(row.shape[0]):
        row[c] = 0.0
    for k in range(2):
        row[at.velocity + k] = clip(frame.vel[k, 0] / p.evader_speed)
        row[at.to_low + k] = clip(frame.pos[k, 0] / p.size)
        row[at.to_high + k] = clip((p.size - frame.pos[k, 0]) / p.size)
    _write_pursuers(p, at, frame, row)
    rays = int(p.rays)
    for s in range(frame.obstacle_count[0]):
        m = frame.obstacle_index[s, 0]
        for k in range(2):
            row[at.cover + 2 * s + k] = clip((frame.centre[k, m] - frame.pos[k, 0]) / p.size)
        row[at.cover_radius + s] = frame.rho[m] / p.greatest_radius
    for r in range(rays):
        row[at.free_way + r] = 1.0
    for m in range(frame.rho.shape[0]):
        if frame.rho[m] > 0.0:
            to = (frame.centre[0, m] - frame.pos[0, 0], frame.centre[1, m] - frame.pos[1, 0])
            ahead = (like(to[0], 1.0), like(to[0], 0.0))
            clearance = frame.rho[m] + frame.radius[0]
            shorten_free_paths(row, at.free_way, rays, frame.table, to, ahead, clearance, p.way_sight)


@kernel
def _write_pursuers(p: Any, at: Any, frame: Frame, row: Any) -> None:
    """Write the pursuers, nearest first."""
    count = frame.pos.shape[1] - 1
    previous, chosen = -1.0, 0
    for s in range(count):
        least, nearest = np.inf, 0
        for j in range(1, count + 1):
            distance = norm(_offset_to(frame, 0, j))
            later = distance > previous or (distance == previous and j > chosen)
            if later and distance < least:
                least, nearest = distance, j
        to, direction = _offset_to(frame, 0, nearest), unit(_offset_to(frame, 0, nearest))
        for k in range(2):
            row[at.pursuers + 2 * s + k] = clip(to[k] / p.size)
            row[at.pursuer_velocity + 2 * s + k] = clip(frame.vel[k, nearest] / p.pursuer_speed)
            row[at.bearing + 2 * s + k] = direction[k]
        row[at.closeness + s] = max(1.0 - least / p.near, 0.0)
        row[at.seen + s] = 1.0 if _sees(p, frame, nearest) else 0.0
        previous, chosen = least, nearest


class Evade(Task):
    """One learner escapes a team of scripted pursuers among round cover, in a walled field.

    Pursuers are slower and turn more slowly. They see the evader within `sight`, unless cover blocks the straight line
    to it, and head for its predicted position. A pursuer that has lost sight of the evader goes to where it last saw
    it, then looks behind one cover after another. Pursuers do not share what they see. Cover and walls are solid. A
    capture ends the episode. Success: the evader is not caught.
    """

    name: ClassVar[str] = "evade"
    terms: ClassVar[tuple[str, ...]] = ("alive", "caught", "effort")
    metric_names: ClassVar[tuple[str, ...]] = ("survival_time", "survived", "time_hidden", "least_distance")
    measures: ClassVar[tuple[str, ...]] = ("time", "hidden", "caught", "distance")
    memory: ClassVar[int] = 3

    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    pursuers: int = Field(default=3, ge=1, le=16, description="number of pursuers")
    size: float = Field(default=28.0, gt=10, description="m, edge of the field")
    cover: int = Field(default=10, ge=0, le=100, description="number of obstacles; those that do not fit are left out")
    least_radius: float = Field(default=0.8, gt=0, description="m, least radius of an obstacle")
    greatest_radius: float = Field(default=1.8, gt=0, description="m, greatest radius of an obstacle")
    min_gap: float = Field(default=1.5, ge=0, description="m between obstacles, and to walls; bodies are 0.6 m wide")
    start_distance: float = Field(
        default=8.0, ge=0, description="m, least distance between the evader and pursuers at the start"
    )
    evader_speed: float = Field(default=3.0, gt=0, description="m/s")
    evader_force: float = Field(default=8.0, gt=0, description="N; the mass is 1 kg")
    pursuer_speed: float = Field(default=2.2, gt=0, description="m/s")
    pursuer_force: float = Field(default=4.0, gt=0, description="N; the mass is 1 kg")
    sight: float = Field(
        default=10.0, gt=0, description="m, range within which pursuers see the evader unless cover is between"
    )
    patience: float = Field(default=4.0, ge=0, description="s, longest search at the evader's last seen position")
    capture_distance: float = Field(default=0.7, gt=0, description="m between centres, for a capture")
    near: float = Field(default=6.0, gt=0, description="m, range within which `closeness` is not 0")
    slots: int = Field(default=6, ge=1, le=32, description="number of obstacles seen, nearest surface first")
    rays: int = Field(default=16, ge=1, le=128, description="number of directions in which the free path is seen")
    way_sight: float = Field(default=8.0, gt=0, description="m, greatest free path that is seen")
    alive_reward: float = Field(default=1.0, ge=0, description="per s")
    caught_cost: float = Field(default=10.0, ge=0, description="once, when caught")
    effort_cost: float = Field(
        default=0.1, ge=0, description="per s at full force; proportional to the square of the force"
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Evade:
        """Raise ValueError for radii in the wrong order or too large, or a start distance above half the field."""
        widest = 2 * (self.greatest_radius + self.min_gap)
        if self.least_radius > self.greatest_radius or widest > self.size:
            raise ValueError(
                f"least_radius = {self.least_radius:g}, greatest_radius = {self.greatest_radius:g}: must be in "
                f"this order, and fit, with min_gap on each side, into a field of {self.size:g} m"
            )
        if self.start_distance > self.size / 2:
            raise ValueError(f"start_distance = {self.start_distance:g}: at most size / 2 = {self.size / 2:g} m")
        return self

    @property
    def learners(self) -> int:
        """L: 1, the evader."""
        return 1

    @property
    def agents(self) -> int:
        """N: the evader and its pursuers."""
        return 1 + self.pursuers

    @property
    def agent_names(self) -> tuple[str, ...]:
        """evader_0."""
        return ("evader_0",)

    @property
    def obstacle_slots(self) -> int:
        """M: the number of obstacles."""
        return self.cover

    @functools.cached_property
    def scene(self) -> Scene:
        """A walled square with solid obstacles."""
        limits = {"max_speed": self.pursuer_speed, "max_force": self.pursuer_force}
        return Scene(
            space=Box(size=(self.size, self.size)),
            groups=(
                Group(count=1, radius=0.3, max_speed=self.evader_speed, max_force=self.evader_force, role="evader"),
                Group(count=self.pursuers, radius=0.3, role="pursuer", **limits),
            ),
            effects=(ObstacleContact(stiffness=400.0, damping=20.0),),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def look(self) -> Look:
        """The nearest cover, in the whole field."""
        return Look(self.size, obstacles=self.slots)

    def table(self) -> tuple[float, ...]:
        """Return the directions of the rays."""
        return ray_directions(self.rays)

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; axes are the field's, and offsets are relative to the agent."""
        n, m = self.pursuers, self.slots
        paths = "free path length of the body to the nearest cover in each direction, anticlockwise from the x axis"
        seen = "offsets of the centres of the nearest obstacles, nearest surface first; zeros: empty slot"
        return Layout((
            Slot("velocity", (2,), self.evader_speed, "m/s", "own velocity (x, y)"),
            Slot("to_low", (2,), self.size, "m", "distance to the walls at x = 0 and y = 0", low=0.0),
            Slot("to_high", (2,), self.size, "m", "distance to the walls at x = size and y = size", low=0.0),
            Slot("pursuers", (n, 2), self.size, "m", "offsets of the pursuers, nearest first"),
            Slot("pursuer_velocity", (n, 2), self.pursuer_speed, "m/s", "their velocities"),
            Slot("bearing", (n, 2), 1.0, "1", "unit vectors towards them"),
            Slot("closeness", (n,), 1.0, "1", "1 - distance / near; 0 for a distance above near", low=0.0),
            Slot("seen", (n,), 1.0, "1", "1 if that pursuer sees the evader, else 0", low=0.0),
            *slots_of("obstacles",
                Slot("cover", (m, 2), self.size, "m", seen),
                Slot("cover_radius", (m,), self.greatest_radius, "m", "their radii; 0: empty slot", low=0.0),
            ),
            Slot("free_way", (self.rays,), self.way_sight, "m", paths, low=0.0),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force along the field's axes."""
        meaning = "force (x, y) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.evader_force, "N", meaning),))
