"""Two rules instead of forces: select a free direction, and go no faster than is safe: Moussaid et al. 2011."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray
from pydantic import Field

from flockenv import steering
from flockenv.geometry.shapes.chain import segment_hit, segment_share
from flockenv.jit.decorators import OPTIONS, Law, Vec, law, like
from flockenv.jit.intrinsics import tuple_as_array
from flockenv.maths.approximations import round_half_even
from flockenv.maths.vectors import add, dot, norm, scale, select, sub, unit, zero
from flockenv.model.scene_view import SceneView
from flockenv.physics.effects.effect import Effect, Me, Other, Sight, all_masses, demand_group

__all__ = ["DIRECTIONS", "Heuristics"]

Floats = NDArray[np.float64]

DIRECTIONS = 31
"""Number of directions tested within the field of view, from the rightmost to the leftmost; the aim is one more."""

SIDES = ("wall", "capsule", "polygon", "block", "half_space")
"""Kinds of obstacles with straight sides."""

ENDLESS = 1e4
"""m, half the length of the line that stands for the surface of a half-space."""


@law
def turn_left(direction: Vec, cosine: float, sine: float) -> Vec:
    """Return the vector turned to the left."""
    return (direction[0] * cosine - direction[1] * sine, direction[0] * sine + direction[1] * cosine)


def reduce_distances(
    found: Vec, direction: Vec, aim: Vec, cosine: float, sine: float, offset: Vec, velocity: Vec, clearance: float,
    speed: float,
) -> Vec:  # fmt: skip
    """Return the free distances `found`, reduced by one more neighbour: at constant velocity, then as if at rest.

    found: DIRECTIONS distances and that along the aim, then as many for neighbours at rest. direction: the rightmost.
    """
    still, one, moving, standing = zero(velocity), like(speed, 1.0), [], []
    for k in range(DIRECTIONS + 1):
        ahead = direction if k < DIRECTIONS else aim
        moving.append(steering.collision_distance(ahead, offset, velocity, clearance, speed))
        standing.append(steering.collision_distance(ahead, offset, still, clearance, one))
        direction = turn_left(direction, cosine, sine)
    return tuple(map(min, (*moving, *standing), found))


@overload(reduce_distances, jit_options=OPTIONS)
def _reduce_distances(found, direction, aim, cosine, sine, offset, velocity, clearance, speed):  # type: ignore[no-untyped-def]
    """Return `reduce_distances` with its loop unrolled, for SIMD lanes."""
    count = DIRECTIONS + 1
    lines = [
        "def all_directions(found, direction, aim, cosine, sine, offset, velocity, clearance, speed):",
        "    still, one = zero(velocity), like(speed, 1.0)",
    ]
    for k in range(count):
        u = "direction" if k < DIRECTIONS else "aim"
        lines += [
            f"    m{k} = distance({u}, offset, velocity, clearance, speed)",
            f"    m{k} = m{k} if m{k} < found[{k}] else found[{k}]",
            f"    s{k} = distance({u}, offset, still, clearance, one)",
            f"    s{k} = s{k} if s{k} < found[{count + k}] else found[{count + k}]",
        ]
        if k < DIRECTIONS - 1:
            lines.append("    direction = turn_left(direction, cosine, sine)")
    lines.append(f"    return ({', '.join(f'{name}{k}' for name in 'ms' for k in range(count))})")
    namespace: dict[str, Any] = {
        "zero": zero, "like": like, "turn_left": turn_left, "distance": steering.collision_distance
    }  # fmt: skip
    exec("\n".join(lines), namespace)  # noqa: S102  # the number of directions is a constant
    return namespace["all_directions"]


def infinite_distances(far: float) -> Vec:
    """Return the initial distances, all infinite."""
    return (far,) * (2 * DIRECTIONS + 2)


@overload(infinite_distances, jit_options=OPTIONS)
def _infinite_distances(far):  # type: ignore[no-untyped-def]
    namespace: dict[str, Any] = {}
    exec(f"def none(far):\n    return ({'far, ' * (2 * DIRECTIONS + 2)})", namespace)  # noqa: S102
    return namespace["none"]


@law
def initial_distances(p: Any, me: Me) -> Vec:
    """Return the initial distances: all directions are free."""
    return infinite_distances(like(me.radius, np.inf))


@law
def _first_direction_and_aim(p: Any, me: Me) -> tuple[Vec, Vec]:
    """Return the rightmost direction of the agent's field of view, and its aim; at rest it faces its aim."""
    aim = unit(me.aim)
    moves = dot(me.heading, me.heading) > like(me.radius, 0.0)
    return turn_left(select(moves, me.heading, aim), p.edge_cosine, -p.edge_sine), aim


@law
def reduce_by_agent(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Reduce the free distances to those at which the agent would touch this neighbour."""
    direction, aim = _first_direction_and_aim(p, me)
    room = me.radius + other.radius
    return reduce_distances(acc, direction, aim, p.cosine, p.sine, other.offset, other.vel, room, me.desired_speed)


@law
def reduce_by_obstacle(p: Any, me: Me, other: Other, acc: Vec) -> Vec:
    """Reduce the free distances to those at which the agent would touch this round obstacle, which is at rest."""
    direction, aim = _first_direction_and_aim(p, me)
    room = me.radius + other.radius
    return reduce_distances(acc, direction, aim, p.cosine, p.sine, other.offset, zero(me.vel), room, me.desired_speed)


@law
def wall_distance(p: Any, me: Me, direction: Vec, reach: float) -> float:
    """Return how far the agent's body moves until it touches a straight side, m; inf if farther than `reach`.

    A side that it touches already does not block directions that lead off it.

    The table: the edges of a torus, 0 without one, then for each side its ends (4) and half its thickness, m.
    """
    o, half = like(reach, 0.0), like(reach, 0.5)
    best = like(reach, np.inf)
    for k in range((len(p.table) - 2) // 5):
        at = 2 + 5 * k
        a, b = (p.table[at], p.table[at + 1]), (p.table[at + 2], p.table[at + 3])
        wide, high = p.table[0], p.table[1]
        x, y = me.pos[0] - half * (a[0] + b[0]), me.pos[1] - half * (a[1] + b[1])
        x = wide * round_half_even(x / wide) if wide > o else o
        y = high * round_half_even(y / high) if high > o else o
        spot, room = sub(me.pos, (x, y)), me.radius + p.table[at + 4]
        off = sub(spot, add(a, scale(sub(b, a), segment_share(spot, a, b))))
        leaves = (dot(off, off) < room * room) & (dot(off, direction) >= o)
        here = segment_hit(spot, direction, a, b, room)
        best = here if (here < best) & (here < reach) & (not leaves) else best
    return best


@law
def heuristics_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = m (v_des e(alpha) - v) / tau, alpha that of least d(alpha); of two equal ones, the right one."""
    free = tuple_as_array(acc)
    count = DIRECTIONS + 1
    e, o = like(me.radius, 1.0), like(me.radius, 0.0)
    direction, aim = _first_direction_and_aim(p, me)
    eager = norm(me.aim)
    moves = dot(me.heading, me.heading) > o
    sees = (dot(me.heading, aim) >= p.edge_cosine) | (not moves)
    best, chosen, ahead = like(me.radius, np.inf), zero(me.vel), o
    for j in range(count):
        k = DIRECTIONS if j == 0 else j - 1  # the aim first: it wins against equal directions
        u = aim if j == 0 else direction
        if (k < DIRECTIONS) | sees:
            wall = wall_distance(p, me, u, p.radius)
            f = min(min(free[k], wall), p.radius)
            d = p.radius * p.radius + f * f - (f + f) * p.radius * dot(aim, u)
            better = d < best - like(d, 1e-6) * p.radius * p.radius  # a difference by rounding is a tie
            best, chosen = d if better else best, select(better, u, chosen)
            ahead = min(free[count + k], wall) if better else ahead
        if j > 0:
            direction = turn_left(direction, p.cosine, p.sine)
    speed = min(me.desired_speed * min(eager, e), ahead / p.tau)
    return scale(sub(scale(chosen, speed), me.vel), p.weight * me.mass / p.tau)


class Heuristics(Effect):
    """Take the most direct free direction, as fast as is safe: F = m (v_des e(alpha) - v) / tau, and no other force.

    Moussaid, Helbing and Theraulaz 2011. alpha lies within `view` to either side of the heading, and minimises
    d^2 = d_max^2 + f^2 - 2 d_max f cos(alpha_0 - alpha). f(alpha) is the distance travelled at desired speed until it
    touches an agent that keeps its velocity, or a wall; at most d_max. v_des = min(v0, d_h / tau), d_h the present
    distance to the first agent or obstacle in that direction. Contact forces are those of `contact` (k = 5e3 kg/s^2)
    and `obstacle_contact`.

    31 directions are tested, and that of the aim (me.aim): the paper's alpha is continuous, ours is within 2.5 degrees
    at 75. It replaces `driving`: use one or the other. In 2-D only, among walls that stand still.

    Limits: every step chooses anew, without memory, so the direction may jump from step to step, and a method of higher
    order gains little. All neighbours are assumed to keep their velocities.
    """

    kind: Literal["heuristics"] = "heuristics"
    weight: float = Field(default=1.0, ge=0, description="a factor, 1 as published")
    tau: float = Field(default=0.5, gt=0, description="s, relaxation time, and least time to collision")
    radius: float = Field(default=10.0, gt=0, description="d_max, m, range of sight")
    view: float = Field(default=75.0, gt=0, le=180, description="phi, degrees to either side")
    group: int | None = Field(default=None, ge=0, description="group that it sees (default: all)")
    steering: ClassVar[bool] = True
    tabled: ClassVar[bool] = True
    pair_start: ClassVar[Law | None] = initial_distances
    pair_law: ClassVar[Law | None] = reduce_by_agent
    obstacle_law: ClassVar[Law | None] = reduce_by_obstacle
    finish_law: ClassVar[Law | None] = heuristics_force
    demo: ClassVar[str | None] = """
dt: 0.005
groups:
  - {count: 4, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [-6, -1.5], high: [-3, 1.5]}}
  - {count: 4, mass: 80, radius: 0.25, desired_speed: 1.3, spawn: {low: [3, -1.5], high: [6, 1.5]}}
obstacles:
  - {kind: wall, vertices: [[-9, 2], [9, 2]]}
  - {kind: wall, vertices: [[-9, -2], [9, -2]]}
  - {centre: [0, 0], radius: 0.4}
effects:
  - {kind: course, group: 0, direction: [1, 0]}
  - {kind: course, group: 1, direction: [-1, 0]}
  - {kind: heuristics}
  - {kind: contact, stiffness: 5000, radius: 0.5}
  - {kind: obstacle_contact, stiffness: 5000}
"""

    @property
    def sight(self) -> Sight:
        """Its range, in all directions: agents from behind may also collide."""
        return Sight(self.radius, group=self.group)

    def parameters(self) -> dict[str, float | Vec]:
        """Return weight, tau, range, half angle of view, and the angle between directions."""
        edge = math.radians(self.view)
        step = 2 * edge / (DIRECTIONS - 1)
        return {
            "weight": self.weight, "tau": self.tau, "radius": self.radius,
            "edge_cosine": math.cos(edge), "edge_sine": math.sin(edge),
            "cosine": math.cos(step), "sine": math.sin(step),
        }  # fmt: skip

    def table(self, scene: SceneView) -> Floats:
        """Return the edges of a torus, and every straight side."""
        size = scene.space.extent(2) if scene.space.periodic else (0.0, 0.0)
        sides = [side for shape in scene.shapes for side in _straight_sides(shape)]
        return np.array([*size, *(number for side in sides for number in side)])

    def check(self, scene: SceneView) -> None:
        """Raise ValueError in 3-D, or if an obstacle moves or has sides that are not straight."""
        if scene.dimension != 2:
            raise ValueError(f"kind = heuristics: dimension = {scene.dimension}, must be 2")
        demand_group("group", self.group, scene.groups)
        for k, shape in enumerate(scene.obstacles):
            if shape.in_state:
                continue
            if shape.moves or shape.kind not in SIDES or (shape.kind == "capsule" and shape.is_hollow):
                what = "moves" if shape.moves else "is not namespace of straight sides"
                raise ValueError(
                    f"kind = heuristics: obstacles[{k}].kind = {shape.kind} {what}; only circles and "
                    f"{', '.join(SIDES)} that stand still are seen"
                )
        super().check(scene)

    def lookahead(self, speed: float) -> float:
        """Return the range of sight, m."""
        return self.radius

    def sums(self, dimension: int) -> int:
        """Return the number of free distances: of every direction and the aim, for moving and for resting agents."""
        return 2 * DIRECTIONS + 2

    def rates(self, groups: Sequence[Any], dimension: int) -> tuple[Floats, Floats]:
        """Return no oscillation, and a damping of weight / tau."""
        n = len(all_masses(groups, dimension))
        return np.zeros(n), np.full(n, self.weight / self.tau)


def _straight_sides(shape: Any) -> list[list[float]]:
    """Return the straight sides of an obstacle, (5,) m each: both ends, and half the thickness."""
    if shape.kind in ("wall", "capsule"):
        corners, around = shape.corners
        return [[*a, *b, around] for a, b in zip(corners[:-1].tolist(), corners[1:].tolist(), strict=True)]
    if shape.kind == "half_space":
        point, normal = np.array(shape.point), np.array(shape.direction) / math.hypot(*shape.direction)
        along = ENDLESS * np.array([-normal[1], normal[0]])
        return [[*(point - along), *(point + along), 0.0]]
    ring = shape.polygons(*shape.extremes[[0, 0]])[0]
    return [[*a, *b, 0.0] for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)]
