"""CrowdNav: one robot crosses a crowd of pedestrians that swap places on a circle under social forces."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.behaviours.social import Social
from flockenv.behaviours.steer import Steer
from flockenv.engine import Look
from flockenv.geometry.space import Plane
from flockenv.jit.decorators import kernel, like
from flockenv.maths.counter_rng import uniform
from flockenv.model.snapshot import Mark
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects.aims import Antipode
from flockenv.scene import Group, Scene
from flockenv.scene.presets import PRESETS
from flockenv.steering.arbitration import Blend
from flockenv.tasks.layout import Layout, Slot
from flockenv.tasks.observations import local_components, neighbour_slots, write_crowding, write_neighbour, write_vector
from flockenv.tasks.price import price_field, price_numbers, price_slots, write_price
from flockenv.tasks.task import Frame, Task

__all__ = ["CrowdNav"]

Crowd = Literal[
    "moussaid_2009", "helbing_molnar_1995", "johansson_2007_circular", "johansson_2007_elliptical_1",
    "johansson_2007_elliptical_2",
]  # fmt: skip
"""The models of `flockenv.scene.presets` without stiff bodies."""

_RADIUS = 0.3  # m, of the robot, as in CrowdNav
_NO_GAP = 1e3  # m, gap to the nearest pedestrian if there is none


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place agents at rest, evenly around a circle with some jitter; the robot's goal is the opposite point."""
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
        frame.memory[4, i], frame.memory[5, i] = _NO_GAP, _NO_GAP


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write the robot's action as a force in the frame of its course; the scene steers the pedestrians."""
    hx, hy = frame.memory[2, 0], frame.memory[3, 0]
    along, left = action[0, 0] * frame.max_force[0], action[0, 1] * frame.max_force[0]
    force[0, 0], force[1, 0] = along * hx - left * hy, along * hy + left * hx
    for i in range(1, frame.pos.shape[1]):
        force[0, i], force[1, i] = 0.0, 0.0


@kernel
def keep(p: Any, before: Frame, after: Frame) -> None:
    """Store the least gap between surfaces along the path of this decision, and so far in the episode, m."""
    least = np.float64(_NO_GAP)
    for j in range(1, after.pos.shape[1]):
        x, y = np.float64(before.pos[0, j] - before.pos[0, 0]), np.float64(before.pos[1, j] - before.pos[1, 0])
        dx = np.float64(after.pos[0, j] - after.pos[0, 0]) - x
        dy = np.float64(after.pos[1, j] - after.pos[1, 0]) - y
        square = dx * dx + dy * dy
        share = min(max(-(x * dx + y * dy) / square, 0.0), 1.0) if square > 0.0 else 0.0
        distance = math.hypot(x + share * dx, y + share * dy)
        least = min(least, distance - np.float64(after.radius[0] + after.radius[j]))
    after.memory[4, 0] = least
    after.memory[5, 0] = min(least, np.float64(after.memory[5, 0]))


@kernel
def _goal_offset(frame: Frame) -> tuple[float, float]:
    """Return the offset from the robot to its goal, m."""
    return frame.memory[0, 0] - np.float64(frame.pos[0, 0]), frame.memory[1, 0] - np.float64(frame.pos[1, 0])


@kernel
def _goal_distance(frame: Frame) -> float:
    """Return the distance from the robot to its goal, m."""
    x, y = _goal_offset(frame)
    return math.sqrt(x * x + y * y)


@kernel
def _collides(after: Frame) -> bool:
    """Return True if the robot touched a pedestrian in this decision."""
    return bool(after.memory[4, 0] < 0.0)


@kernel
def _arrives(p: Any, after: Frame) -> bool:
    """Return True if the robot is at its goal and touched no pedestrian in this decision."""
    return bool(_goal_distance(after) <= p.goal_radius) and not _collides(after)


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms progress, success, collision, discomfort, time."""
    gap = np.float64(after.memory[4, 0])
    terms[0, at.progress] = p.progress_reward * (_goal_distance(before) - _goal_distance(after))
    terms[0, at.success] = p.success_reward if _arrives(p, after) else 0.0
    terms[0, at.collision] = -p.collision_cost * p.price if gap < 0.0 else 0.0
    near = p.comfort_distance - gap if gap >= 0.0 else 0.0
    terms[0, at.discomfort] = -p.discomfort_cost * max(near, 0.0) * p.control_dt
    terms[0, at.time] = -p.time_cost * p.control_dt


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the episode at a collision, or at the goal, which is success."""
    success = _arrives(p, after)
    over[0] = success or _collides(after)
    return success


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write collision (0 or 1); arrival (0 or 1); path, m; least gap so far, m; discomfort without collision, s."""
    gap = np.float64(after.memory[4, 0])
    numbers[at.touch] = 1.0 if gap < 0.0 else 0.0
    numbers[at.there] = 1.0 if _arrives(p, after) else 0.0
    numbers[at.walked] = math.hypot(after.pos[0, 0] - before.pos[0, 0], after.pos[1, 0] - before.pos[1, 0])
    numbers[at.gap] = after.memory[5, 0]
    numbers[at.near] = p.control_dt if 0.0 <= gap < p.comfort_distance else 0.0


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write collided (0 or 1); timed out (0 or 1); time to the goal, s, if the robot arrived; path, m;
    least gap, m; share of the time below the comfort distance.
    """  # fmt: skip
    time = steps * p.control_dt
    numbers[at.collided] = last.touch
    numbers[at.timed_out] = 1.0 - last.touch - last.there if steps > 0 else 0.0
    if last.there > 0:
        numbers[at.time_to_goal] = time
    numbers[at.path_length] = sums.walked
    if steps > 0:
        numbers[at.least_gap] = last.gap
    numbers[at.discomfort] = sums.near / max(time, p.control_dt)


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, offset of the goal, nearest pedestrians, in the frame of the course: (along, left)."""
    one = like(p.sight, 1.0)
    row, course = rows[0], (frame.memory[2, 0], frame.memory[3, 0])
    for c in range(rows.shape[1]):
        row[np.uint64(c)] = 0.0
    write_vector(row, at.velocity, local_components((frame.vel[0, 0], frame.vel[1, 0]), course, one / p.max_speed))
    write_vector(row, at.goal, local_components(_goal_offset(frame), course, one / (3.0 * p.circle)))
    for s in range(frame.near_count[0]):
        j = np.uint64(frame.near_index[s, 0])
        to = (frame.pos[0, j] - frame.pos[0, 0], frame.pos[1, j] - frame.pos[1, 0])
        relative = (frame.vel[0, j] - frame.vel[0, 0], frame.vel[1, j] - frame.vel[1, 0])
        distance = max(math.sqrt(to[0] * to[0] + to[1] * to[1]), 1e-9)
        gap = distance - frame.radius[0] - frame.radius[j]
        write_neighbour(row, at, s, to, relative, course, one / p.sight, 0.25 * one / p.max_speed)
        write_crowding(row, at, s, to, course, distance, gap, p.near)
    write_price(p, row)


class CrowdNav(Task):
    """One robot crosses a circle on which pedestrians swap places under a social force, and must touch none of them.

    The crowd follows Moussaid et al. 2009, with desired speeds N(1.29, 0.19) m/s, or another model of
    `flockenv.scene.presets`, as published. Pedestrians of the 2009 model, with bodies of 0.5 m, keep 0.4 m between
    centres in the middle of a circle of 12; those of the models of 1995 and 2007 walk into each other, with 0.1 m and
    less. By default the crowd does not see the robot (`visible`), as in the tests of CrowdNav (Chen et al. 2019,
    arXiv 1809.08835), so that the robot cannot rely on pedestrians to avoid it. Observations are relative to the robot,
    in the frame of its course, from start to goal.

    Rewards are those of Chen et al. times 20: success 1, collision -0.25, and -0.5 per s and per metre by which the
    nearest pedestrian is closer than 0.2 m. A progress reward and a time cost, which are not in the paper, replace its
    imitation learning and its discount. A collision ends the episode. Gaps are the least along the path of a decision,
    not only at its end.
    """

    name: ClassVar[str] = "crowd_nav"
    terms: ClassVar[tuple[str, ...]] = ("progress", "success", "collision", "discomfort", "time")
    metric_names: ClassVar[tuple[str, ...]] = (
        "collided", "timed_out", "time_to_goal", "path_length", "least_gap", "discomfort",
    )  # fmt: skip
    priced: ClassVar[tuple[str, ...]] = ("collision",)
    harm: ClassVar[str] = "collision"
    measures: ClassVar[tuple[str, ...]] = ("touch", "there", "walked", "gap", "near")
    memory: ClassVar[int] = 6
    keeps: ClassVar[bool] = True

    horizon: int = Field(default=250, ge=1, description="decisions until the time limit (truncation)")
    people: int = Field(default=10, ge=1, le=200, description="number of pedestrians")
    visible: bool = Field(default=False, description="True if the crowd sees the robot")
    crowd: Crowd = Field(default="moussaid_2009", description="the social force of the crowd, as published")
    circle: float = Field(default=6.0, gt=0, description="m, radius of the circle")
    jitter: float = Field(
        default=0.35, ge=0, lt=0.5, description="largest offset of a start, as a share of the gap between starts"
    )
    max_speed: float = Field(default=1.34, gt=0, description="m/s, of the robot")
    max_force: float = Field(default=5.0, gt=0, description="N, of the robot; its mass is 1 kg")
    goal_radius: float = Field(
        default=0.3, gt=0, description="m, the robot has arrived within this distance of its goal"
    )
    sight: float = Field(
        default=5.0, gt=0, description="m, range within which pedestrians are seen, also by each other"
    )
    neighbours: int = Field(default=6, ge=1, le=32, description="number of pedestrians seen, nearest first")
    near: float = Field(default=1.5, gt=0, description="m between bodies, below which `crowding` is not 0")
    comfort_distance: float = Field(
        default=0.2, gt=0, description="m between bodies, below which the discomfort cost applies"
    )
    progress_reward: float = Field(default=0.5, ge=0, description="per m nearer to the goal")
    success_reward: float = Field(default=20.0, ge=0, description="on arrival at the goal")
    collision_cost: float = Field(default=5.0, ge=0, description="for a collision")
    discomfort_cost: float = Field(default=10.0, ge=0, description="per s and m below the comfort distance")
    time_cost: float = Field(default=0.2, ge=0, description="per s")
    price: float | None = price_field("`collision`")

    @model_validator(mode="after")
    def _check_room(self) -> CrowdNav:
        """Raise ValueError for more people than fit on the circle."""
        n = self.people + 1
        room = 2 * math.pi * self.circle * (1 - 2 * self.jitter) / n
        if room < 0.8:
            least = 0.8 * n / (2 * math.pi * (1 - 2 * self.jitter))
            raise ValueError(f"circle = {self.circle:g} m has no room for {n} agents; at least {least:.3g}")
        return self

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the price."""
        return super().parameters() | price_numbers(self.price)

    @property
    def learners(self) -> int:
        """L: 1, the robot."""
        return 1

    @property
    def agents(self) -> int:
        """N: the robot and the crowd."""
        return 1 + self.people

    @property
    def agent_names(self) -> tuple[str, ...]:
        """robot_0."""
        return ("robot_0",)

    @functools.cached_property
    def scene(self) -> Scene:
        """A plane; pedestrians cross the circle and avoid each other, and also the robot if it is visible."""
        around = Spawn(low=(-self.circle, -self.circle), high=(self.circle, self.circle))  # before an episode begins
        robot = {"radius": _RADIUS, "max_speed": self.max_speed, "max_force": self.max_force, "role": "learner"}
        sight = {"radius": self.sight, "group": None if self.visible else 1}
        behaviours = tuple(  # there are no walls
            effect.model_copy(update=sight) if isinstance(effect, Social) else effect
            for effect in PRESETS[self.crowd].behaviours(False, 1)
            if effect.obstacle_law is None
        )
        return Scene(
            space=Plane(),
            groups=(
                Group(count=1, spawn=around, **robot),
                Group(count=self.people, spawn=around, **PRESETS[self.crowd].people),
            ),
            effects=(
                Antipode(centre=(0.0, 0.0), group=1),
                Steer(group=1, arbitration=Blend(), behaviours=behaviours),
            ),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    @property
    def look(self) -> Look:
        """The nearest pedestrians."""
        return Look(self.sight, self.neighbours)

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; every vector is (along the course, to its left)."""
        return Layout((
            Slot("velocity", (2,), self.max_speed, "m/s", "own velocity (along the course, to its left)"),
            Slot("goal", (2,), 3 * self.circle, "m", "offset of the goal"),
            *neighbour_slots(self.neighbours, self.sight, 4 * self.max_speed, "pedestrians", crowding=True),
            *price_slots(self.price),
        ))  # fmt: skip

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force in the frame of the course."""
        meaning = "force (along the course, to its left) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.max_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark at the robot's goal."""
        return (Mark("goal", memory[:2, world, 0], np.zeros(2), self.goal_radius),)

    def view(self, state: State, world: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the circle and a margin around it, m."""
        edge = 1.3 * self.circle
        return (-edge, -edge), (edge, edge)
