"""PathFollow: run as far as possible along a narrow winding track."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.geometry.space import Box
from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.counter_rng import uniform
from flockenv.maths.vectors import dot, norm, sub
from flockenv.model.snapshot import Mark
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.tasks.layout import Layout, Slot
from flockenv.tasks.observations import clip
from flockenv.tasks.task import Frame, Task

__all__ = ["PathFollow"]

POINTS = 128
"""Corners of a track, evenly spread in angle about the middle of the field."""

HARMONICS = 7
"""Number of waves that make up a track; the first has two periods per lap."""

WINDOW = 16
"""Pieces on either side of the agent's angle among which the nearest point of the middle line is searched."""

# memory of a world: x and y of every corner, its arc length, the length of the track, metres gained, running direction
_Y, _S, _LENGTH, _GAINED, _TURN = POINTS, 2 * POINTS, 3 * POINTS, 3 * POINTS + 1, 3 * POINTS + 2
# position of the agent (x, y); its place on the track (piece, metres along it), now and before this step
_HERE, _NOW, _BEFORE = 3 * POINTS + 3, 3 * POINTS + 5, 3 * POINTS + 7


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Draw a closed track, r(a) = R (1 + sum of waves), run in either direction; place the agent on it, at rest."""
    m, turn = frame.memory, 1.0 if uniform(frame.key, 0, 0, 0) < 0.5 else -1.0
    for i in range(POINTS):
        m[i, 0] = 0.0
    for k in range(HARMONICS):
        high = p.winding * (0.4 + 0.6 * uniform(frame.key, 0, 1, k)) / HARMONICS
        phase = 2.0 * math.pi * uniform(frame.key, 0, 2, k)
        for i in range(POINTS):
            m[i, 0] += high * math.sin(2.0 * math.pi * (k + 2) * i / POINTS + phase)
    for i in range(POINTS):
        a, r = 2.0 * math.pi * i / POINTS, p.ring * (1.0 + m[i, 0])
        m[i, 0], m[_Y + i, 0] = p.middle + r * math.cos(a), p.middle + turn * r * math.sin(a)
    s = 0.0
    for i in range(POINTS):
        m[_S + i, 0] = s
        s += norm(sub(_corner(frame, i + 1), _corner(frame, i)))
    m[_LENGTH, 0], m[_GAINED, 0], m[_TURN, 0] = s, 0.0, turn
    begin = int(POINTS * uniform(frame.key, 0, 3, 0))
    frame.pos[0, 0], frame.pos[1, 0] = _corner(frame, begin)
    frame.vel[:, 0] = 0.0
    _store_place(p, frame)


@kernel
def _corner(frame: Frame, i: int) -> Vec:
    return (frame.memory[i % POINTS, 0], frame.memory[_Y + i % POINTS, 0])


@kernel
def _line(frame: Frame, i: int) -> tuple[Vec, Vec, float]:
    """Return the start of piece i, the offset to its end, and its length, m."""
    a = _corner(frame, i)
    u = sub(_corner(frame, i + 1), a)
    return a, u, norm(u)


@kernel
def _piece(frame: Frame, i: int) -> tuple[Vec, Vec, float]:
    """Return the start of piece i, its direction, and its length, m."""
    a, u, size = _line(frame, i)
    return a, (u[0] / size, u[1] / size), size


@kernel
def _direction(frame: Frame, i: int) -> Vec:
    _, u, _ = _piece(frame, i)
    return (np.float64(u[0]), np.float64(u[1]))


@kernel
def _nearest(p: Any, frame: Frame) -> tuple[int, float]:
    """Return the piece with the point nearest to the agent, and how far along the piece that point is, m.

    Only pieces near the agent's own angle are searched, so that another part of the track nearby is not mistaken for
    this one.
    """
    x, y = frame.pos[0, 0], frame.pos[1, 0]
    angle = math.atan2(frame.memory[_TURN, 0] * (y - p.middle), x - p.middle) / (2.0 * math.pi)
    here = math.floor(angle * POINTS) + POINTS
    best, piece, along = np.inf, 0, 0.0
    for k in range(-WINDOW, WINDOW + 1):
        i = (here + k) % POINTS
        a, u, size = _piece(frame, i)
        to = (x - a[0], y - a[1])
        s = min(max(dot(to, u), 0.0), size)
        off = (to[0] - s * u[0], to[1] - s * u[1])
        square = dot(off, off)
        if square < best:
            best, piece, along = square, i, s
    return piece, along


@kernel
def _store_place(p: Any, frame: Frame) -> None:
    """Store the agent's position, and its place on the track."""
    i, s = _nearest(p, frame)
    m = frame.memory
    m[_HERE, 0], m[_HERE + 1, 0], m[_NOW, 0], m[_NOW + 1, 0] = frame.pos[0, 0], frame.pos[1, 0], i, s


@kernel
def _place(p: Any, frame: Frame) -> tuple[int, float]:
    """Return the stored place on the track; if the agent was moved since it was stored, the result of `_nearest`."""
    m = frame.memory
    if frame.pos[0, 0] == m[_HERE, 0] and frame.pos[1, 0] == m[_HERE + 1, 0]:
        return int(m[_NOW, 0]), np.float64(m[_NOW + 1, 0])
    return _nearest(p, frame)


@kernel
def _signed_offset(p: Any, frame: Frame) -> float:
    """Return the agent's signed distance from the middle line, m; positive to the left."""
    i, s = _place(p, frame)
    a, u, _ = _piece(frame, i)
    to = (frame.pos[0, 0] - a[0], frame.pos[1, 0] - a[1])
    off = (to[0] - s * u[0], to[1] - s * u[1])
    away = math.sqrt(dot(off, off))
    return away if u[0] * to[1] - u[1] * to[0] > 0.0 else -away


@kernel
def _progress(after: Frame) -> float:
    """Return the progress along the track in this step, m."""
    m = after.memory
    i, a = int(m[_BEFORE, 0]), np.float64(m[_BEFORE + 1, 0])
    j, b = int(m[_NOW, 0]), np.float64(m[_NOW + 1, 0])
    gained, length = m[_S + j, 0] + b - m[_S + i, 0] - a, m[_LENGTH, 0]
    return gained - length * math.floor(gained / length + 0.5)  # type: ignore[no-any-return]


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write the learner's action as a force in the frame of the track beside it: (along, left)."""
    i, _ = _place(p, frame)
    direction, f = _direction(frame, i), frame.max_force[0]
    force[0, 0] = f * (action[0, 0] * direction[0] - action[0, 1] * direction[1])
    force[1, 0] = f * (action[0, 0] * direction[1] + action[0, 1] * direction[0])


@kernel
def keep(p: Any, before: Frame, after: Frame) -> None:
    """Store the place on the track before and after the step, searched only here, and the progress since the start."""
    i, s = _place(p, before)
    after.memory[_BEFORE, 0], after.memory[_BEFORE + 1, 0] = i, s
    _store_place(p, after)
    after.memory[_GAINED, 0] += _progress(after)


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, off_track, lost."""
    offset = _signed_offset(p, after)
    terms[0, at.progress] = p.progress_reward * _progress(after)
    terms[0, at.off_track] = -p.off_cost * p.control_dt if abs(offset) > p.half_width else 0.0
    terms[0, at.lost] = -p.lost_cost if abs(offset) > p.lost_distance else 0.0


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the episode if the agent is lost; return True once it has run a whole lap."""
    over[0] = abs(_signed_offset(p, after)) > p.lost_distance
    return not over[0] and after.memory[_GAINED, 0] >= after.memory[_LENGTH, 0]


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write progress, m; off the track (0 or 1); path, m."""
    numbers[at.gained] = _progress(after)
    numbers[at.off] = 1.0 if abs(_signed_offset(p, after)) > p.half_width else 0.0
    numbers[at.path] = math.hypot(after.pos[0, 0] - before.pos[0, 0], after.pos[1, 0] - before.pos[1, 0])


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write progress along the track, m; share of the time off it; mean speed, m/s."""
    count = max(steps, 1)
    numbers[at.progress], numbers[at.off_track] = sums.gained, sums.off / count
    numbers[at.mean_speed] = sums.path / (count * p.control_dt)


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, offset to the left, middle line ahead and its curvature, in the frame of the track here."""
    i, along = _place(p, frame)
    offset, direction = _signed_offset(p, frame), _direction(frame, i)
    row, count = rows[0], int(p.ahead)
    vx, vy = frame.vel[0, 0], frame.vel[1, 0]
    row[at.velocity] = clip((vx * direction[0] + vy * direction[1]) / p.max_speed)
    row[at.velocity + 1] = clip((vy * direction[0] - vx * direction[1]) / p.max_speed)
    row[at.left] = clip(offset / p.lost_distance)
    scale = p.spacing * p.ahead + p.lost_distance
    for k in range(count):
        along += p.spacing
        a, u, size = _line(frame, i)
        for _ in range(POINTS):
            if along <= size:
                break
            along -= size
            i += 1
            a, u, size = _line(frame, i)
        to = (a[0] + along / size * u[0] - frame.pos[0, 0], a[1] + along / size * u[1] - frame.pos[1, 0])
        row[at.points + 2 * k] = clip((to[0] * direction[0] + to[1] * direction[1]) / scale)
        row[at.points + 2 * k + 1] = clip((to[1] * direction[0] - to[0] * direction[1]) / scale)
        row[at.curvature + k] = clip(_curvature(frame, i, along / size) * p.half_width)


@kernel
def _curvature(frame: Frame, i: int, share: float) -> float:
    """Return the curvature at a share of piece i, 1/m, left positive, interpolated between its two corners."""
    return (1.0 - share) * _corner_curvature(frame, i) + share * _corner_curvature(frame, i + 1)


@kernel
def _corner_curvature(frame: Frame, i: int) -> float:
    """Return the curvature of the circle through a corner and its two neighbours, 1/m."""
    a, b, c = _corner(frame, i + POINTS - 1), _corner(frame, i), _corner(frame, i + 1)
    u, v, w = sub(b, a), sub(c, b), sub(c, a)
    return 2.0 * (u[0] * v[1] - u[1] * v[0]) / (norm(u) * norm(v) * norm(w))


class PathFollow(Task):
    """One learner runs as far as possible along a narrow winding closed track, a new one in each episode.

    The track is a circle with waves, run clockwise or anticlockwise. Observations and actions are in the frame of the
    track beside the learner: along it, and to its left. The episode ends if the learner is more than `lost_distance`
    from the middle line. Success: a whole lap.
    """

    name: ClassVar[str] = "path_follow"
    terms: ClassVar[tuple[str, ...]] = ("progress", "off_track", "lost")
    metric_names: ClassVar[tuple[str, ...]] = ("progress", "off_track", "mean_speed")
    measures: ClassVar[tuple[str, ...]] = ("gained", "off", "path")
    memory: ClassVar[int] = 3 * POINTS + 9
    keeps: ClassVar[bool] = True

    horizon: int = Field(default=300, ge=1, description="decisions until the time limit (truncation)")
    ring: float = Field(default=12.0, ge=5, le=50, description="m, mean radius of the track")
    winding: float = Field(
        default=0.55, ge=0, le=0.8, description="bound of the sum of all waves, as a share of the radius"
    )
    half_width: float = Field(default=0.7, gt=0, description="m, half the width of the track")
    lost_distance: float = Field(
        default=2.5, gt=0, description="m from the middle line, beyond which the learner is lost"
    )
    max_speed: float = Field(default=8.0, gt=0, description="m/s")
    max_force: float = Field(default=8.0, gt=0, description="N; the mass is 1 kg")
    ahead: int = Field(default=8, ge=1, le=64, description="number of points of the track seen")
    spacing: float = Field(default=1.2, gt=0, description="m along the track between these points")
    progress_reward: float = Field(default=0.2, ge=0, description="per m along the track")
    off_cost: float = Field(default=3.0, ge=0, description="per s off the track")
    lost_cost: float = Field(default=10.0, ge=0, description="once, when lost")

    @model_validator(mode="after")
    def _check_widths(self) -> PathFollow:
        """Raise ValueError unless half_width < lost_distance <= 0.3 ring and the points span at most half a ring."""
        if self.half_width >= self.lost_distance:
            raise ValueError(
                f"lost_distance = {self.lost_distance:g}: must be more than half_width = {self.half_width:g}"
            )
        if self.lost_distance > 0.3 * self.ring:
            raise ValueError(f"lost_distance = {self.lost_distance:g}: at most 0.3 of ring = {self.ring:g} is allowed")
        if self.ahead * self.spacing > math.pi * self.ring:
            raise ValueError(
                f"spacing = {self.spacing:g}: {self.ahead} points span {self.ahead * self.spacing:g} m; at most half a "
                f"ring, {math.pi * self.ring:g} m, is allowed"
            )
        return self

    @property
    def size(self) -> float:
        """Edge of the field, m; a learner is lost before it reaches the walls."""
        return 2 * (self.ring * (1 + self.winding) + self.lost_distance + 1)

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the middle of the field, m."""
        return super().parameters() | {"middle": self.size / 2}

    @property
    def learners(self) -> int:
        """L: 1, the runner."""
        return 1

    @property
    def agents(self) -> int:
        """N: 1."""
        return 1

    @property
    def agent_names(self) -> tuple[str, ...]:
        """runner_0."""
        return ("runner_0",)

    @functools.cached_property
    def scene(self) -> Scene:
        """A walled square around the track, in which only the agent's own force acts."""
        runner = Group(count=1, radius=0.2, max_speed=self.max_speed, max_force=self.max_force, role="learner")
        return Scene(
            space=Box(size=(self.size, self.size)),
            groups=(runner,),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; every vector is (along the track beside the learner, to its left)."""
        far = self.spacing * self.ahead + self.lost_distance
        points = f"offsets of {self.ahead} points of its middle line, every {self.spacing:g} m from that distance on"
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (along the track, to its left)"),
            Slot("left", (), self.lost_distance, "m", "offset from the middle line, positive to the left"),
            Slot("points", (self.ahead, 2), far, "m", points),
            Slot("curvature", (self.ahead,), 1.0 / self.half_width, "1/m", "curvature there, positive to the left"),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force in the frame of the track beside the learner."""
        meaning = "force (along the track, to its left) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return the track as marks: a disc of its width at every corner."""
        return _discs(np.asarray(memory[: 2 * POINTS, world, 0], np.float64).tobytes(), self.half_width)


@functools.lru_cache(maxsize=64)
def _discs(corners: bytes, radius: float) -> tuple[Mark, ...]:
    """Return the discs of a track, cached, since every picture of an episode needs the same ones."""
    return tuple(Mark("way", corner, np.zeros(2), radius) for corner in np.frombuffer(corners).reshape(2, -1).T)
