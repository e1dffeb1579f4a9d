"""How far a body must turn to pass a shape that is in its way: the edge of the silhouette, as it sees it.

A law `edge_FORM(table, at, x, ray, side, room)` is about a ray that touches the shape: `x` is where the body is,
relative to the anchor, `ray` where it goes and `side` across it, both unit vectors, `room` the body's radius and what
it keeps clear. It returns by what angle (rad, 0 to 2 pi and more) the ray must be turned towards `side` until the body
just passes the shape, and how far along the turned ray it is beside it then (m). Both are infinite if the shape has no
edge there: a half-space is passed at infinity, a room never.

In space, turned rays lie in the plane of `ray` and `side`. Of a sphere the edge is exact; of a chain or block it is the
shadow on that plane that is passed, which has no edge for a body that stands beside the shape and in its shadow.
Reynolds 1988, "Not Bumping Into Things".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.geometry.shapes.block import half_edges, turned
from flockenv.geometry.shapes.chain import segment_hit, vertex
from flockenv.geometry.shapes.field import hit_distance_field
from flockenv.geometry.shapes.inverted import hit_hollow_distance_field
from flockenv.geometry.shapes.row_header import body_of, bound_of, vector_at
from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.approximations import atan2
from flockenv.maths.vectors import add, axis, dot, scale, sub

__all__ = [
    "edge_block", "edge_chain", "edge_distance_field", "edge_half_space", "edge_hollow_block",
    "edge_hollow_chain", "edge_hollow_distance_field", "near_way", "sphere_edge", "spine_block", "spine_chain",
]  # fmt: skip

FAN = 24
"""Rays to a side, over half a turn, by which the edge of a grid of distances is looked for."""


WIDER = 1 + 1e-5
"""Factor of a circle that is only to rule out what is not near: single precision rounds."""


@law
def _bearing(to: Vec, ray: Vec, side: Vec) -> float:
    """Return by what angle `to` lies off the ray towards `side`, rad."""
    return atan2(dot(to, side), dot(to, ray))


@law
def _beside(to: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the angle between the middle of a disc of radius `room` and its tangent, rad, and how far that touches."""
    along, across, o = dot(to, ray), dot(to, side), like(room, 0.0)
    square = along * along + across * across - room * room
    if len(to) == 3 and square <= o and dot(to, to) > room * room:
        return like(room, np.inf), o  # in its shadow, but not in it
    reach = np.sqrt(square if square > o else o)
    return atan2(room, reach), reach


@law
def near_way(table: Any, at: int, x: Vec, ray: Vec, room: float, length: float) -> bool:
    """Return whether a body on its way, `length` m along a ray, comes into the circle or sphere that a row lies in."""
    middle, around = bound_of(table, at, x)
    to, o = sub(middle, x), like(room, 0.0)
    along = dot(to, ray)
    along = along if along < length else length
    off = sub(to, scale(ray, along if along > o else o))
    wide = (around + room) * like(room, WIDER)
    return dot(off, off) <= wide * wide


@law
def _disc_edge(to: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of the shadow of a circle or sphere whose centre is at `to`, m; room: as of a sphere's edge."""
    half, reach = _beside(to, ray, side, room)
    return _bearing(to, ray, side) + half, reach


@law
def sphere_edge(to: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of a circle or sphere whose centre is at `to`, m; room: both radii and what is kept clear.

    Of a sphere by the circle in which the plane of `ray` and `side` cuts it: tangents to both are equally long.
    """
    if len(to) == 2:
        return _disc_edge(to, ray, side, room)
    along, across, o = dot(to, ray), dot(to, side), like(room, 0.0)
    square, wide = dot(to, to) - room * room, room * room - dot(to, to) + along * along + across * across
    reach = np.sqrt(square if square > o else o)
    return _bearing(to, ray, side) + atan2(np.sqrt(wide if wide > o else o), reach), reach


@law
def edge_chain(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return the edge of a chain, followed from the piece that is touched; of a polygon, all around it.

    Bearings are followed from vertex to vertex, so that they may go beyond half a turn: out of a pocket, too.
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
        # the angle between two vectors of the plane of `ray` and `side`, from their products in it
        p, q, r, s = dot(last, ray), dot(last, side), dot(to, ray), dot(to, side)
        bearing += atan2(p * s - q * r, p * r + q * s)
        half, far = _beside(to, ray, side, room)
        turn, reach = (turn, reach) if turn >= bearing + half else (bearing + half, far)
        last = to
    return turn, reach


@law
def _touched_piece(table: Any, at: int, x: Vec, ray: Vec, room: float) -> int:
    """Return the piece of a chain that the ray touches first."""
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
    """Return the edge of a block: of its corners the one that is farthest to that side."""
    y, h = turned(table, at, x), half_edges(table, at, x)
    ahead, across = turned(table, at, ray), turned(table, at, side)
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
    """Return the angle at which a ray is along the plane; it is passed at infinity."""
    normal = vector_at(table, body_of(at, x), x)
    return atan2(-dot(normal, ray), dot(normal, side)), like(room, np.inf)


@law
def edge_hollow(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
    """Return that a room has no edge: it is all around."""
    return like(room, np.inf), like(room, np.inf)


edge_hollow_chain = edge_hollow_block = edge_hollow


def _edge_by_fan(hit: Any) -> Any:
    """Return the law of an edge of what can only be asked how far a ray goes: `hit(table, at, x, ray, room)`."""

    @law
    def edge(table: Any, at: int, x: Vec, ray: Vec, side: Vec, room: float) -> tuple[float, float]:
        """Return the first of a fan of rays that goes twice as far as the one before it, or for ever."""
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


# --- in which directions edges are looked for in space ----------------------------------------------------------------


@law
def spine_chain(table: Any, at: int, x: Vec, ray: Vec) -> Vec:
    """Return the way from the first to the last vertex of a chain, m."""
    count: Any = np.int64(table[body_of(at, x)])
    return sub(vertex(table, at, count - 1, x), vertex(table, at, 0, x))


@law
def spine_block(table: Any, at: int, x: Vec, ray: Vec) -> Vec:
    """Return the axis of a block that lies most across the ray."""
    body, d = body_of(at, x), len(x)
    best, least = axis(x, 0), like(x[0], np.inf)
    for k in range(d):
        own = vector_at(table, body + (k + 1) * d, x)
        along = abs(dot(own, ray))
        if along < least:
            best, least = own, along
    return best
