"""Steering around obstacles of any shape: avoidance (Reynolds 1999), whiskers, and a force field for comparison.

Avoidance is zero unless an obstacle blocks the path; a force field also pushes agents that fly past, and stops those
that come head-on (Reynolds 1988, "Not Bumping Into Things").
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flockenv import steering
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, cross, dot, lateral, norm, perpendicular, scale, select, sub, unit, zero
from flockenv.physics.effects.effect import Effect, Me, Obstacle

__all__ = ["AvoidObstacles", "ForceField", "Whiskers"]

AVOIDING = """
groups:
- count: 7
  radius: 0.2
  max_speed: 2
  max_force: 10
  spawn: {low: [0, 0.5], high: [1, 8.5], speed: [1.8, 1.8], heading: [1, 0]}
obstacles:
- {centre: [5, 3], radius: 1.2}
- {kind: polygon, vertices: [[4, 5.5], [6.5, 5], [7.5, 8], [5.5, 6.7]]}
- {kind: capsule, start: [9, 1.5], end: [10, 4], radius: 0.3}
effects:
- {kind: avoid_obstacles, weight: 8}
"""


@law
def no_threat(p: Any, me: Me) -> Vec:
    """Return the initial value: a threat at infinity, and no side."""
    o, far = like(me.who, 0.0), like(me.who, np.inf)
    return (far, o) + zero(me.pos) + zero(me.pos)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def _without_side(acc: Vec) -> Vec:
    """Return the running numbers without the side, which is found later."""
    if len(acc) == 6:
        return (acc[0], acc[1], acc[2], acc[3])
    else:
        return (acc[0], acc[1], acc[2], acc[3], acc[4])


@law
def ray_ahead(p: Any, me: Me, k: int) -> tuple[Vec, float]:
    """Return the heading of the agent, and the margin, m."""
    return me.heading, p.margin


@law
def nearest_threat(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep the obstacle that the straight path touches first: (distance, clearance, offset, no side yet)."""
    far = like(me.who, np.inf)
    distance = other.hit if other.hit <= norm(me.vel) * p.horizon else far
    # an agent that overlaps already must turn away, however the sum of the radii is rounded
    clearance = me.radius + other.radius + p.margin if other.hit > like(me.who, 0.0) else far
    return select(distance < acc[0], (distance, clearance) + other.offset, _without_side(acc)) + zero(me.pos)  # noqa: RUF005


@law
def horizon_reach(p: Any, me: Me) -> float:
    """Return the distance travelled within the horizon, plus radius and margin."""
    return norm(me.vel) * p.horizon + me.radius + p.margin  # type: ignore[no-any-return]


@law
def _offset_and_side(acc: Vec) -> tuple[Vec, Vec]:
    """Return the offset of the threat, and the side of its nearest edge."""
    if len(acc) == 6:
        return (acc[2], acc[3]), (acc[4], acc[5])
    else:
        return (acc[2], acc[3], acc[4]), (acc[5], acc[6], acc[7])


@law
def _can_turn(p: Any, me: Me, normal: Vec, aside: Vec, hit: float) -> bool:
    """Return True if the agent can turn to a side before it reaches the surface, with a turning radius R = m v^2 / F.

    Towards the normal's side the result is always True. To the other side the agent first turns towards the surface,
    which takes a depth of R (1 + sin a), a the angle between heading and normal.
    """
    o, e = like(hit, 0.0), like(hit, 1.0)
    force = p.weight if p.weight < me.max_force else me.max_force
    ahead = -dot(normal, me.heading)
    across = e - ahead * ahead
    depth = me.mass * dot(me.vel, me.vel) * (e + np.sqrt(across if across > o else o))
    in_time: bool = (dot(aside, normal) > like(hit, -1e-5)) | (hit * ahead * force > depth)
    return in_time


@law
def sidestep_threat(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w (1 m/s) to the side of the nearest edge or, if none can be reached, of the surface normal."""
    e = like(me.who, 1.0)
    offset, aside = _offset_and_side(acc)
    away = steering.avoid(me.heading, offset, acc[1], e)
    has_edge = dot(aside, aside) > like(e, 0.0)
    normal = scale(sub(scale(me.heading, acc[0] if has_edge else like(e, 0.0)), offset), e / acc[1])
    # away from a circle's centre is towards its nearest edge: if the two differ by rounding only, `away` is kept
    other = has_edge & (dot(aside, away) < like(e, 1 - 1e-5)) & _can_turn(p, me, normal, aside, acc[0])
    direction = select(other, aside, away)
    return scale(select(acc[0] < like(me.who, np.inf), direction, zero(me.pos)), p.weight)


class AvoidObstacles(Effect):
    """Steer sideways around the obstacle that the straight path would touch first within `horizon` seconds.

    The force points towards the edge of the obstacle's silhouette that is nearest to the point of impact (Reynolds
    1988): away from a circle's centre; dead ahead of its middle, to the right. An edge is where the body passes with a
    radius to spare: walls that are joined, or leave a gap that is too narrow, are one obstacle. An obstacle that has no
    edge (a half-space, a room), or is too near for a turn to that edge at a radius of m v^2 / F, is avoided along the
    side of its normal. In 3-D the edges on five sides are compared: the side of the normal, and both directions along
    and across the obstacle's own axis. A sphere has no axis: its sides lie away from the obstacle that blocks the side
    of the normal, and across that. An obstacle that moves is treated as if it stood still at its current place.

    Limits: it looks straight ahead, over a distance proportional to the speed: at rest it sees only what it overlaps,
    it does not brake, and it knows no path out of a dead end. Only the first obstacle in the path counts. The force is
    w or 0, so it switches on and off beside an edge.
    """

    kind: Literal["avoid_obstacles"] = "avoid_obstacles"
    weight: float = Field(ge=0, description="N, steering force of an evasion")
    horizon: float = Field(default=2.0, gt=0, description="s, look-ahead time, at the present speed")
    margin: float = Field(default=0.0, ge=0, description="m, clearance beyond both radii")
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = no_threat
    obstacle_ray: ClassVar[Law | None] = ray_ahead
    obstacle_law: ClassVar[Law | None] = nearest_threat
    obstacle_finish: ClassVar[Law | None] = sidestep_threat
    obstacle_reach: ClassVar[Law | None] = horizon_reach
    obstacle_edges: ClassVar[bool] = True
    demo: ClassVar[str | None] = AVOIDING

    def lookahead(self, speed: float) -> float:
        """Return the distance travelled within the horizon, m."""
        return speed * self.horizon

    def fold_size(self, dimension: int) -> int:
        """Return the size of distance, clearance and offset of the nearest threat, and the side of its nearest edge."""
        return 2 + 2 * dimension


# --- whiskers ---------------------------------------------------------------------------------------------------------


@law
def whisker_ray(p: Any, me: Me, k: int) -> tuple[Vec, float]:
    """Return the direction of whisker k: straight ahead, then left and right, then (in 3-D) up and down."""
    o, e = like(me.who, 0.0), like(me.who, 1.0)
    right = perpendicular(me.heading)
    turn = p.angle * like(me.who, np.pi / 180)
    c, s = e if k == 0 else np.cos(turn), o if k == 0 else np.sin(turn)
    s = s if k % 2 == 0 else -s
    return add(scale(me.heading, c), scale(_whisker_side(me.heading, right, k), s)), o


@law
def _whisker_side(heading: Vec, right: Vec, k: int) -> Vec:
    if len(heading) == 2:
        return right
    else:
        return select(k > 2, cross(right, heading), right)


@law
def no_whisker(p: Any, me: Me) -> Vec:
    """Return the initial value: nothing touched."""
    o, far = like(me.who, 0.0), like(me.who, np.inf)
    return (far, o) + zero(me.pos) + zero(me.pos)  # noqa: RUF005


@law
def deepest_whisker(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep the obstacle that a whisker reaches into deepest.

    The running numbers: the distance if it is the middle whisker, else inf; the share of the whisker's length inside
    the obstacle; the normal at the point of entry; the side, which is found later, here 0.
    """
    o, e = like(me.who, 0.0), like(me.who, 1.0)
    length = norm(me.vel) * p.horizon
    share = e - other.hit / length if (other.hit < length) & (length > o) else o
    middle = dot(other.ray, me.heading) > like(e, 1 - 1e-6)
    ahead = other.hit if middle else like(e, np.inf)
    return select(share > acc[1], (ahead, share) + other.normal, _without_side(acc)) + zero(me.pos)  # noqa: RUF005


@law
def whisker_reach(p: Any, me: Me) -> float:
    """Return the length of a whisker plus the radius."""
    return norm(me.vel) * p.horizon + me.radius  # type: ignore[no-any-return]


@law
def whisker_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w (share inside) (n + side): n alone would mostly brake.

    The side is that of the nearest edge of the obstacle ahead; without one unit(lateral n), and head-on the right.
    """
    normal, edge = _offset_and_side(acc)
    aside = lateral(normal, me.heading)
    headon = dot(aside, aside) < like(me.who, 1e-6)
    side = select(headon, perpendicular(me.heading), unit(aside))
    side = select(dot(edge, edge) > like(me.who, 0.0), edge, side)
    return scale(add(normal, side), p.weight * acc[1])


class Whiskers(Effect):
    """Turn away from, and brake before, the obstacle that a whisker reaches into, in proportion to the depth.

    If the middle whisker reaches in deepest, turn towards the nearest edge of the silhouette, as in `avoid_obstacles`.

    Three whiskers in 2-D, five in 3-D, of length `horizon` times the speed. In Buckland 2005, "wall avoidance",
    whiskers have a fixed length and the body no size; here a whisker is swept by the whole body.

    Limits: at rest whiskers have no length. What is narrower than the gap between the ends of two whiskers is missed
    until it is nearer, and one obstacle at a time is avoided.
    """

    kind: Literal["whiskers"] = "whiskers"
    weight: float = Field(ge=0, description="N, steering force if a whisker is wholly inside")
    horizon: float = Field(default=1.5, gt=0, description="s, length of a whisker at the present speed")
    angle: float = Field(default=35.0, gt=0, lt=90, description="degrees between the middle and the other whiskers")
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = no_whisker
    obstacle_ray: ClassVar[Law | None] = whisker_ray
    obstacle_law: ClassVar[Law | None] = deepest_whisker
    obstacle_finish: ClassVar[Law | None] = whisker_force
    obstacle_reach: ClassVar[Law | None] = whisker_reach
    obstacle_edges: ClassVar[bool] = True
    demo: ClassVar[str | None] = AVOIDING.replace("avoid_obstacles, weight: 8", "whiskers, weight: 20")

    def rays(self, dimension: int) -> int:
        """Return the number of whiskers: one ahead, and two for each other axis."""
        return 2 * dimension - 1

    def fold_size(self, dimension: int) -> int:
        """Return the size of a distance, a share, a normal and a side."""
        return 2 + 2 * dimension


# --- a force field ----------------------------------------------------------------------------------------------------


@law
def zero_force(p: Any, me: Me) -> Vec:
    """Return the initial force, zero."""
    return zero(me.pos)


@law
def add_field(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Add n / d^p, within range."""
    room = other.gap - me.radius
    near = room if room > p.nearest else p.nearest
    size = like(me.who, 1.0) / near**p.power
    return add(acc, select(room < p.range, scale(other.normal, size), zero(me.pos)))


@law
def field_reach(p: Any, me: Me) -> float:
    """Return the range of the force plus the radius."""
    return p.range + me.radius  # type: ignore[no-any-return]


@law
def field_force(p: Any, me: Me, acc: Vec) -> Vec:
    """Return F = w sum n / d^p."""
    return scale(acc, p.weight)


class ForceField(Effect):
    """Repulsion from every surface within range, in the path or not: F = w sum n / d^p. Included for comparison.

    The drawbacks named by Reynolds (1988): head-on it only brakes; it is too strong near and too weak far away; and it
    pushes agents that fly past.

    Limits: the force jumps by w / range^p at the range, and distances below `nearest` count as `nearest`, so it is at
    most w / nearest^p per obstacle: a fast agent passes through a thin wall. Nothing damps it.
    """

    kind: Literal["force_field"] = "force_field"
    weight: float = Field(ge=0, description="N m^p, the force at 1 m")
    power: float = Field(default=2.0, ge=0, le=6, description="p, exponent of its decay")
    range: float = Field(default=3.0, gt=0, description="m between the surfaces, beyond which there is no force")
    nearest: float = Field(default=0.05, gt=0, description="m, smaller distances count as this one")
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = zero_force
    obstacle_law: ClassVar[Law | None] = add_field
    obstacle_finish: ClassVar[Law | None] = field_force
    obstacle_reach: ClassVar[Law | None] = field_reach
    demo: ClassVar[str | None] = AVOIDING.replace("avoid_obstacles, weight: 8", "force_field, weight: 3")

    def fold_size(self, dimension: int) -> int:
        """Return the size of a vector."""
        return dimension
