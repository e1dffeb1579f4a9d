"""Steering around obstacles of any shape: to avoid (Reynolds 1999), by whiskers, and by a force field, for contrast.

To avoid is zero unless something is really in the way; a force field also pushes those who fly past, and stops those
who come head-on (Reynolds 1988, "Not Bumping Into Things").
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
def nothing(p: Any, me: Me) -> Vec:
    """No threat yet: at infinity; no side."""
    o, far = like(me.who, 0.0), like(me.who, np.inf)
    return (far, o) + zero(me.pos) + zero(me.pos)  # noqa: RUF005  # numba joins tuples, but does not unpack them


@law
def _kept(acc: Vec) -> Vec:
    """Return all but the side, which is found when the obstacle is."""
    if len(acc) == 6:
        return (acc[0], acc[1], acc[2], acc[3])
    else:
        return (acc[0], acc[1], acc[2], acc[3], acc[4])


@law
def straight_on(p: Any, me: Me, k: int) -> tuple[Vec, float]:
    """Where it is heading."""
    return me.heading, p.margin


@law
def nearest_threat(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep the obstacle that the straight path touches first: (distance, clearance, offset, no side yet)."""
    far = like(me.who, np.inf)
    distance = other.hit if other.hit <= norm(me.vel) * p.horizon else far
    # who overlaps it already wants out, however the sum of the radii is rounded
    clearance = me.radius + other.radius + p.margin if other.hit > like(me.who, 0.0) else far
    return select(distance < acc[0], (distance, clearance) + other.offset, _kept(acc)) + zero(me.pos)  # noqa: RUF005


@law
def in_time(p: Any, me: Me) -> float:
    """As far as it comes within the horizon, and its size."""
    return norm(me.vel) * p.horizon + me.radius + p.margin  # type: ignore[no-any-return]


@law
def _sides(acc: Vec) -> tuple[Vec, Vec]:
    """Return the offset of the threat, and the side of its nearest edge."""
    if len(acc) == 6:
        return (acc[2], acc[3]), (acc[4], acc[5])
    else:
        return (acc[2], acc[3], acc[4]), (acc[5], acc[6], acc[7])


@law
def _turns_in_time(p: Any, me: Me, normal: Vec, aside: Vec, hit: float) -> bool:
    """Return whether it can turn aside before it comes to the surface, at the radius m v^2 / F of its turns.

    Along the normal's side it always tries; to the other it first turns towards the surface, which takes a depth of
    R (1 + sin a), where a is the angle between its heading and the normal.
    """
    o, e = like(hit, 0.0), like(hit, 1.0)
    force = p.weight if p.weight < me.max_force else me.max_force
    ahead = -dot(normal, me.heading)
    across = e - ahead * ahead
    depth = me.mass * dot(me.vel, me.vel) * (e + np.sqrt(across if across > o else o))
    in_time: bool = (dot(aside, normal) > like(hit, -1e-5)) | (hit * ahead * force > depth)
    return in_time


@law
def around(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w (1 m/s) sideways, to the nearest edge; without one, or too near to turn there, along the normal's side."""
    e = like(me.who, 1.0)
    offset, aside = _sides(acc)
    away = steering.avoid(me.heading, offset, acc[1], e)
    some = dot(aside, aside) > like(e, 0.0)
    normal = scale(sub(scale(me.heading, acc[0] if some else like(e, 0.0)), offset), e / acc[1])
    # away from a circle's centre is to its nearest edge: where both are one but for rounding it stays what it was
    other = some & (dot(aside, away) < like(e, 1 - 1e-5)) & _turns_in_time(p, me, normal, aside, acc[0])
    wish = select(other, aside, away)
    return scale(select(acc[0] < like(me.who, np.inf), wish, zero(me.pos)), p.weight)


class AvoidObstacles(Effect):
    """Steer sideways around the obstacle that the straight path would touch first within `horizon` seconds.

    The force points towards the edge of the obstacle's silhouette that is nearest to the point of impact (Reynolds
    1988): away from a circle's centre; dead ahead of its middle, to the right. An edge is where the body passes with a
    radius to spare: walls that are joined, or leave a gap that is too narrow, are one obstacle. An obstacle that has no
    edge (a half-space, a room), or is too near for a turn to that edge at a radius of m v^2 / F, is avoided along the
    side of its normal. In space the edges on five sides are compared: the side of the normal, and both directions along
    and across the obstacle's own axis. A sphere has no axis; for it, they lie away from what blocks the side of the
    normal, and across that. An obstacle that moves is avoided where it is, as if it stood still.
    """

    kind: Literal["avoid_obstacles"] = "avoid_obstacles"
    weight: float = Field(ge=0, description="N, the force of an evasion")
    horizon: float = Field(default=2.0, gt=0, description="s, how far ahead it looks at the present speed")
    margin: float = Field(default=0.0, ge=0, description="m, clearance beyond both radii")
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = nothing
    obstacle_ray: ClassVar[Law | None] = straight_on
    obstacle_law: ClassVar[Law | None] = nearest_threat
    obstacle_finish: ClassVar[Law | None] = around
    obstacle_reach: ClassVar[Law | None] = in_time
    obstacle_edges: ClassVar[bool] = True
    demo: ClassVar[str | None] = AVOIDING

    def lookahead(self, speed: float) -> float:
        """As far as it comes within the horizon."""
        return speed * self.horizon

    def folded(self, dimension: int) -> int:
        """Distance, clearance and offset of the nearest threat, and the side of its nearest edge."""
        return 2 + 2 * dimension


# --- whiskers ---------------------------------------------------------------------------------------------------------


@law
def whisker(p: Any, me: Me, k: int) -> tuple[Vec, float]:
    """One straight ahead, then left and right, then (in 3-D) up and down."""
    o, e = like(me.who, 0.0), like(me.who, 1.0)
    right = perpendicular(me.heading)
    turn = p.angle * like(me.who, np.pi / 180)
    c, s = e if k == 0 else np.cos(turn), o if k == 0 else np.sin(turn)
    s = s if k % 2 == 0 else -s
    return add(scale(me.heading, c), scale(_across(me.heading, right, k), s)), o


@law
def _across(heading: Vec, right: Vec, k: int) -> Vec:
    if len(heading) == 2:
        return right
    else:
        return select(k > 2, cross(right, heading), right)


@law
def no_whisker(p: Any, me: Me) -> Vec:
    """Nothing touched."""
    o, far = like(me.who, 0.0), like(me.who, np.inf)
    return (far, o) + zero(me.pos) + zero(me.pos)  # noqa: RUF005


@law
def deepest_whisker(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """Keep what a whisker reaches into deepest.

    (How far ahead it is if that is the middle one, the share that is inside, the normal where it enters, no side yet.)
    """
    o, e = like(me.who, 0.0), like(me.who, 1.0)
    length = norm(me.vel) * p.horizon
    share = e - other.hit / length if (other.hit < length) & (length > o) else o
    middle = dot(other.ray, me.heading) > like(e, 1 - 1e-6)
    ahead = other.hit if middle else like(e, np.inf)
    return select(share > acc[1], (ahead, share) + other.normal, _kept(acc)) + zero(me.pos)  # noqa: RUF005


@law
def whiskers_end(p: Any, me: Me) -> float:
    """The length of a whisker, and its size."""
    return norm(me.vel) * p.horizon + me.radius  # type: ignore[no-any-return]


@law
def along_normal(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w (share inside) (n + side): n alone would mostly brake.

    The side is that of the nearest edge of what is ahead; without one unit(lateral n), and head-on the right.
    """
    normal, edge = _sides(acc)
    aside = lateral(normal, me.heading)
    headon = dot(aside, aside) < like(me.who, 1e-6)
    side = select(headon, perpendicular(me.heading), unit(aside))
    side = select(dot(edge, edge) > like(me.who, 0.0), edge, side)
    return scale(add(normal, side), p.weight * acc[1])


class Whiskers(Effect):
    """Feel ahead and to the sides; turn away from, and brake before, what a whisker reaches into, by how deep it does.

    If the middle one reaches in deepest, turn towards the nearest edge of the silhouette, as `avoid_obstacles` does.

    Three whiskers in the plane, five in space, `horizon` times the speed long. Buckland 2005, "wall avoidance": there a
    whisker has the length of a line and the body no size; here it is what the body would touch.
    """

    kind: Literal["whiskers"] = "whiskers"
    weight: float = Field(ge=0, description="N, where a whisker is inside whole")
    horizon: float = Field(default=1.5, gt=0, description="s, how far ahead it feels at the present speed")
    angle: float = Field(default=35.0, gt=0, lt=90, description="degrees between the middle and the other whiskers")
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = no_whisker
    obstacle_ray: ClassVar[Law | None] = whisker
    obstacle_law: ClassVar[Law | None] = deepest_whisker
    obstacle_finish: ClassVar[Law | None] = along_normal
    obstacle_reach: ClassVar[Law | None] = whiskers_end
    obstacle_edges: ClassVar[bool] = True
    demo: ClassVar[str | None] = AVOIDING.replace("avoid_obstacles, weight: 8", "whiskers, weight: 20")

    def rays(self, dimension: int) -> int:
        """Ahead, and two for each other axis."""
        return 2 * dimension - 1

    def folded(self, dimension: int) -> int:
        """How far ahead, a share, a normal and a side."""
        return 2 + 2 * dimension


# --- a force field ----------------------------------------------------------------------------------------------------


@law
def no_push(p: Any, me: Me) -> Vec:
    """Nothing pushes yet."""
    return zero(me.pos)


@law
def field_push(p: Any, me: Me, other: Obstacle, acc: Vec) -> Vec:
    """n / d^p, within range."""
    room = other.gap - me.radius
    near = room if room > p.nearest else p.nearest
    size = like(me.who, 1.0) / near**p.power
    return add(acc, select(room < p.range, scale(other.normal, size), zero(me.pos)))


@law
def field_end(p: Any, me: Me) -> float:
    """Its range, and its size."""
    return p.range + me.radius  # type: ignore[no-any-return]


@law
def field_force(p: Any, me: Me, acc: Vec) -> Vec:
    """F = w sum n / d^p."""
    return scale(acc, p.weight)


class ForceField(Effect):
    """Pushed away from every surface within range, whether it is in the way or not: F = w sum n / d^p.

    What Reynolds (1988) holds against it: head-on it only brakes; it is too strong near and too weak far away; and it
    pushes those who fly past. Here for contrast.
    """

    kind: Literal["force_field"] = "force_field"
    weight: float = Field(ge=0, description="N m^p, the force at 1 m")
    power: float = Field(default=2.0, ge=0, le=6, description="p, how steeply it falls")
    range: float = Field(default=3.0, gt=0, description="m between the surfaces, beyond which there is no force")
    nearest: float = Field(default=0.05, gt=0, description="m, nearer counts as this near")
    steering: ClassVar[bool] = True
    obstacle_start: ClassVar[Law | None] = no_push
    obstacle_law: ClassVar[Law | None] = field_push
    obstacle_finish: ClassVar[Law | None] = field_force
    obstacle_reach: ClassVar[Law | None] = field_end
    demo: ClassVar[str | None] = AVOIDING.replace("avoid_obstacles, weight: 8", "force_field, weight: 3")

    def folded(self, dimension: int) -> int:
        """A vector."""
        return dimension
