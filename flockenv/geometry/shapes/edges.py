"""Silhouette edges: the angle by which a body must turn to pass a shape ahead of it.

A law `edge_FORM(table, at, x, ray, side, room)` applies to a ray that hits the shape: `x` is the position of the body
relative to the anchor, `ray` its direction and `side` a direction across it, both unit vectors, `room` its radius plus
clearance. It returns the angle (rad, 0 to 2 pi and more) by which the ray must turn towards `side` until the body just
passes the shape, and the distance along the turned ray to the point of tangency (m). Both are infinite if the shape has
no edge, as a room; a half-space has its edge at infinity.

In 3-D, turned rays lie in the plane of `ray` and `side`. For a sphere the edge is exact; for a chain or block it is
that of the projection onto that plane, which has no edge for a body beside the shape but inside its projection.
Reynolds 1988, "Not Bumping Into Things".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.block import half_edges, to_block_frame
from flockenv.geometry.shapes.chain import segment_hit, vertex
from flockenv.geometry.shapes.field import hit_distance_field
from flockenv.geometry.shapes.inverted import hit_hollow_distance_field
from flockenv.geometry.shapes.row_header import body_of, bound_of, vector_at
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.approximations import atan2
from flockenv.maths.vectors import add, axis, dot, scale, sub

__all__ = [
    "edge_block", "edge_chain", "edge_distance_field", "edge_half_space", "edge_hollow_block",
    "edge_hollow_chain", "edge_hollow_distance_field", "near_path", "sphere_edge", "spine_block", "spine_chain",
]  # fmt: skip

FAN = 24
"""Rays per side, over half a turn, that search for the edge of a distance field."""


WIDER = 1 + 1e-5
"""Enlarges bounding circles used to reject distant shapes: a margin for rounding in single precision."""


@law
def _bearing(to: Vec, ray: Vec, side: Vec) -> float:
    """Return the angle from the ray to `to`, positive towards `side`, rad."""
    return atan2(dot(to, side), dot(to, ray))


@law
def _tangent(to: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the angle between the centre of a disc of radius `room` and its tangent, rad, and the tangent's length."""
    along, across, o = dot(to, ray), dot(to, side), like(room, 0.0)
    square = along * along + across * across - room * room
    if len(to) == 3 and square <= o and dot(to, to) > room * room:
        return like(room, np.inf), o  # inside its projection, but not inside the sphere
    reach = np.sqrt(square if square > o else o)
    return atan2(room, reach), reach


@law
def near_path(table: Any, at: int, x: Vec, ray: Vec, room: float, length: float) -> bool:
    """Return True if a body that moves `length` m along a ray intersects the bounding circle or sphere of a row."""
    middle, around = bound_of(table, at, x)
    to, o = sub(middle, x), like(room, 0.0)
    along = dot(to, ray)
    along = along if along < length else length
    off = sub(to, scale(ray, along if along > o else o))
    wide = (around + room) * like(room, WIDER)
    return dot(off, off) <= wide * wide


@law
def _disc_edge(to: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of the projection of a circle or sphere centred at `to`, m; room: as for `sphere_edge`."""
    half, reach = _tangent(to, ray, side, room)
    return _bearing(to, ray, side) + half, reach


@law
def sphere_edge(to: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of a circle or sphere centred at `to`, m; room: both radii plus clearance.

    For a sphere it is the edge of the circle in which the plane of `ray` and `side` cuts it: tangents to both are
    equally long.
    """
    if len(to) == 2:
        return _disc_edge(to, ray, side, room)
    along, across, o = dot(to, ray), dot(to, side), like(room, 0.0)
    square, wide = dot(to, to) - room * room, room * room - dot(to, to) + along * along + across * across
    reach = np.sqrt(square if square > o else o)
    return _bearing(to, ray, side) + atan2(np.sqrt(wide if wide > o else o), reach), reach


@law
def edge_chain(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of a chain, traced from vertex to vertex from the piece that is hit; all around a polygon.

    Bearings are accumulated, so that they may exceed half a turn, for example out of a concave pocket.
    """
    body = body_of(at, x)
    count: Any = np.int64(table[body])
    room = room + table[body + 1]
    if count == 1:
        return sphere_edge(sub(vertex(table, at, 0, x), x), ray, side, room)
    closed = table[body + 2] > like(room, 0.0)
    j: Any = _touched_piece(table, at, x, ray, room)
    a, b = sub(vertex(table, at, j, x), x), sub(vertex(table, at, (j + 1) % count, x), x)
    turn, reach = _disc_edge(a, ray, side, room)
    other, far = _disc_edge(b, ray, side, room)
    turn, reach = (turn, reach) if turn >= other else (other, far)
    at_a, at_b = _bearing(a, ray, side), _bearing(b, ray, side)
    onward = closed | (at_b >= at_a)
    bearing, last, k = (at_b, b, (j + 1) % count) if onward else (at_a, a, j)
    left: Any = count - 2 if closed else (count - 1 - k if onward else k)
    for _ in range(left):
        k = (k + (1 if onward else count - 1)) % count
        to = sub(vertex(table, at, k, x), x)
        # the angle between two vectors projected onto the plane of `ray` and `side`
        p, q, r, s = dot(last, ray), dot(last, side), dot(to, ray), dot(to, side)
        bearing += atan2(p * s - q * r, p * r + q * s)
        half, far = _tangent(to, ray, side, room)
        turn, reach = (turn, reach) if turn >= bearing + half else (bearing + half, far)
        last = to
    return turn, reach


@law
def _touched_piece(table: Any, at: int, x: Vec, ray: Vec, room: float) -> int:
    """Return the piece of a chain that the ray hits first."""
    body = body_of(at, x)
    count: Any = np.int64(table[body])
    closed = table[body + 2] > like(room, 0.0)
    first, best = 0, like(room, np.inf)
    pieces: Any = count if closed else count - 1
    for j in range(pieces):
        here = segment_hit(x, ray, vertex(table, at, j, x), vertex(table, at, (j + 1) % count, x), room)
        first, best = (j, here) if here < best else (first, best)
    return first


@law
def edge_block(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of a block: that of the corner with the largest bearing."""
    y, h = to_block_frame(table, at, x), half_edges(table, at, x)
    ahead, across = to_block_frame(table, at, ray), to_block_frame(table, at, side)
    turn, reach = like(room, -np.inf), like(room, 0.0)
    for corner in range(2 ** len(x)):
        u, v = h[0] if corner & 1 else -h[0], h[1] if corner & 2 else -h[1]
        if len(x) == 2:
            angle, far = _disc_edge(sub((u, v), y), ahead, across, room)
        else:
            angle, far = _disc_edge(sub((u, v, h[2] if corner & 4 else -h[2]), y), ahead, across, room)
        turn, reach = (angle, far) if angle > turn else (turn, reach)
    return turn, reach


@law
def edge_half_space(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the angle at which the ray is parallel to the plane, and inf: it is passed at infinity."""
    normal = vector_at(table, body_of(at, x), x)
    return atan2(-dot(normal, ray), dot(normal, side)), like(room, np.inf)


@law
def edge_hollow(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return infinities, as a room surrounds the body and has no edge."""
    return like(room, np.inf), like(room, np.inf)


edge_hollow_chain = edge_hollow_block = edge_hollow


def _edge_by_fan(hit: Any) -> Any:
    """Return the edge law of a form that has only a ray cast `hit(table, at, x, ray, room)`."""

    @law
    def edge(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
        """Return the angle of the first ray of a fan that is twice as long as the one before, and that one's length."""
        turn, before = like(room, 0.0), hit(table, at, x, ray, room)
        step, two = like(room, np.pi / FAN), like(room, 2.0)
        for _ in range(FAN):
            turn += step
            here = hit(table, at, x, add(scale(ray, np.cos(turn)), scale(side, np.sin(turn))), room)
            if here > two * (before + room):
                return turn, before
            before = here
        return like(room, np.inf), like(room, np.inf)

    return edge


edge_distance_field = _edge_by_fan(hit_distance_field)
edge_hollow_distance_field = _edge_by_fan(hit_hollow_distance_field)


# --- axes of shapes, which give the directions of edges in 3-D ------------------------------------------------------


@law
def spine_chain(table: Any, at: int, x: Vec, ray: Vec) -> Vec:
    """Return the vector from the first to the last vertex of a chain, m."""
    count: Any = np.int64(table[body_of(at, x)])
    return sub(vertex(table, at, count - 1, x), vertex(table, at, 0, x))


@law
def spine_block(table: Any, at: int, x: Vec, ray: Vec) -> Vec:
    """Return the axis of a block that is most nearly perpendicular to the ray."""
    body, d = body_of(at, x), len(x)
    best, least = axis(x, 0), like(x[0], np.inf)
    for k in range(d):
        own = vector_at(table, body + (k + 1) * d, x)
        along = abs(dot(own, ray))
        if along < least:
            best, least = own, along
    return best
