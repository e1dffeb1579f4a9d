"""Contacts of cuboids with each other, with planes and with balls: points, normals and gaps at the start of a step.

Two cuboids have the axis of largest gap among the normals of their faces and the products of their edges (Gottschalk,
Lin and Manocha 1996). If it is a normal, the opposite face is clipped at the sides of the first one, and its corners
are the points of contact; if it is a product, they touch where two edges come nearest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flockenv.jit.decorators import Vec, kernel, routine
from flockenv.maths.vectors import add, cross, dot, norm, opposite, scale, sub, unit
from flockenv.physics.constraints.rigid_motion import put, row, spin_of

__all__ = ["Contacts", "Past", "add_ball", "add_pair", "add_plane"]

PARALLEL = 1e-2
"""Sine of the angle of two edges below which their product is no axis."""

FACES_FIRST = 1e-2
"""Part of the smaller half edge by which the gap of two edges must exceed that of faces; 1 % of it for other faces."""


LITTLE = 1e-4
"""Part of a half edge by which a corner may be outside: blocks that are stacked have four points, not eight."""


class Past(NamedTuple):
    """What is kept of the last P sweeps over C contacts: see rigid_solver.py."""

    result: Any  # (C, 3) kg m/s, impulses after the sweep before
    step: Any  # (C, 3) kg m/s, their change in it
    results: Any  # (P, C, 3) differences of results between sweeps
    steps: Any  # (P, C, 3) differences of steps
    products: Any  # (P, P) J, products of those
    factor: Any  # (P, P) their Cholesky factor
    share: Any  # (P,) of each in the last step
    jump: Any  # (C, 3) kg m/s, extrapolation


class Contacts(NamedTuple):
    """Contacts; the length of the arrays is the capacity. Rows of three: along the normal and two tangents."""

    body: Any  # (C, 2) a body and another, a block that stands still, or the ground
    point: Any  # (C, 3) m
    way: Any  # (C, 3, 3) unit vectors, the first away from the second body
    arm: Any  # (2, C, 3, 3) offset of the point from each body, times those
    answer: Any  # (2, C, 3, 3) change of each body's spin by a unit impulse
    gap: Any  # (C,) m, at the start of the step
    bounce: Any  # (C,) restitution
    aim: Any  # (C,) m/s, least speed apart
    ease: Any  # (C, 2) kg, impulse per speed: along the normal, and of friction
    impulse: Any  # (2, C, 3) kg m/s, for positions and for velocities
    step: Any  # (C, 3) its change in the last sweep
    past: Past
    clip: Any  # (2, 16, 3) corners of a clipped face


@kernel
def _ease(solids: Any, contacts: Any, c: int, i: int, j: int, k: int, m: int) -> float:
    """Return the change of the speed along `way` k by a unit impulse along m, 1/kg."""
    total = (solids.light[i] + solids.light[j]) * (1.0 if k == m else 0.0)
    for side in range(2):
        total += dot(row(contacts.arm[side, c], k), row(contacts.answer[side, c], m))
    return float(total)


@routine
def _add(
    solids: Any, contacts: Any, count: int, i: int, j: int, normal: Vec, point: Vec, gap: float, bounce: float
) -> int:
    """Add a contact, whose normal points from j to i; return the number of contacts, also if there is no room."""
    if count >= contacts.gap.shape[0]:
        return count + 1
    c = count
    contacts.body[c, 0], contacts.body[c, 1], contacts.gap[c], contacts.bounce[c] = i, j, gap, bounce
    side = unit(cross(normal, (0.0, 0.0, 1.0) if abs(normal[2]) < 0.9 else (1.0, 0.0, 0.0)))
    put(contacts.point, c, point)
    put(contacts.way[c], 0, normal)
    put(contacts.way[c], 1, side)
    put(contacts.way[c], 2, cross(normal, side))
    for k in range(3):
        for s in range(2):
            who = i if s == 0 else j
            arm = cross(sub(point, row(solids.centre, who)), row(contacts.way[c], k))
            put(contacts.arm[s, c], k, arm)
            put(contacts.answer[s, c], k, spin_of(solids, who, arm))
            contacts.impulse[s, c, k] = 0.0
    a, b = _ease(solids, contacts, c, i, j, 1, 1), _ease(solids, contacts, c, i, j, 2, 2)
    mixed = _ease(solids, contacts, c, i, j, 1, 2)
    contacts.ease[c, 0] = 1.0 / _ease(solids, contacts, c, i, j, 0, 0)
    contacts.ease[c, 1] = 1.0 / (0.5 * (a + b) + np.sqrt(0.25 * (a - b) * (a - b) + mixed * mixed))
    return count + 1


@kernel
def _extent(solids: Any, i: int, n: Vec) -> float:
    """Return the half width of a block along a unit vector, m."""
    total = 0.0
    for k in range(3):
        total += solids.half[i, k] * abs(dot(row(solids.axes[i], k), n))
    return total


@kernel
def _corner(solids: Any, i: int, c: int) -> Vec:
    """Return a corner of a block, m."""
    at = row(solids.centre, i)
    for k in range(3):
        at = add(at, scale(row(solids.axes[i], k), solids.corner[c, k] * solids.half[i, k]))
    return at


@routine
def add_plane(
    solids: Any, contacts: Any, count: int, i: int, point: Vec, normal: Vec, bounce: float, margin: float, flat: bool
) -> int:
    """Add the corners of body i that are nearer than `margin` to a plane; return the number of contacts."""
    ground = solids.light.shape[0] - 1
    if dot(sub(row(solids.centre, i), point), normal) - _extent(solids, i, normal) > margin:
        return count
    for c in range(4 if flat else 8):
        at = _corner(solids, i, c)
        gap = dot(sub(at, point), normal)
        if gap <= margin:
            count = _add(solids, contacts, count, i, ground, normal, _in_plane(at, flat), gap, bounce)
    return count


@kernel
def _in_plane(at: Vec, flat: bool) -> Vec:
    """Return a point, with z = 0 in 2-D."""
    return (at[0], at[1], 0.0 if flat else at[2])


@routine
def add_ball(
    solids: Any, contacts: Any, count: int, i: int, middle: Vec, radius: float, bounce: float, margin: float
) -> int:
    """Add the contact of body i with a ball if it is nearer than `margin`; return the number of contacts."""
    off = sub(middle, row(solids.centre, i))
    nearest, inside, shallow = row(solids.centre, i), True, np.inf
    out: Vec = (0.0, 0.0, 0.0)
    for k in range(3):
        along = row(solids.axes[i], k)
        d, h = dot(off, along), solids.half[i, k]
        nearest = add(nearest, scale(along, min(max(d, -h), h)))
        inside = inside and abs(d) < h
        if h - abs(d) < shallow:
            shallow = h - abs(d)
            out = scale(along, -1.0 if d > 0.0 else 1.0)
    apart = sub(nearest, middle)
    far = norm(apart)
    gap = -shallow - radius if inside else far - radius
    if gap > margin:
        return count
    normal = unit(apart) if not inside and far > 0.0 else out
    return _add(solids, contacts, count, i, solids.light.shape[0] - 1, normal, nearest, gap, bounce)


@routine
def _clip(clip: Any, source: int, count: int, centre: Vec, n: Vec, far: float) -> int:
    """Clip a polygon, clip[source], to n . (x - centre) <= far, into the other one; return its number of corners."""
    kept, target, little = 0, 1 - source, LITTLE * far
    for c in range(count):
        here, then = row(clip[source], c), row(clip[source], (c + 1) % count)
        a, b = dot(sub(here, centre), n) - far, dot(sub(then, centre), n) - far
        if a <= little:
            put(clip[target], kept, here)
            kept += 1
        if (a < -little and b > little) or (b < -little and a > little):
            put(clip[target], kept, add(here, scale(sub(then, here), a / (a - b))))
            kept += 1
    return kept


@routine
def _add_face(
    solids: Any, contacts: Any, count: int, i: int, j: int, own: bool, k: int, bounce: float, margin: float, flat: bool
) -> int:
    """Add the contacts of a face of body i (`own`), or of j, normal to its axis k, with the opposite face of the other.

    Returns the number of contacts.
    """
    base, other = (i, j) if own else (j, i)
    n = row(solids.axes[base], k)
    n = n if dot(sub(row(solids.centre, other), row(solids.centre, base)), n) > 0.0 else opposite(n)
    most, facing = -1.0, 0
    for m in range(3):
        along = abs(dot(row(solids.axes[other], m), n))
        if along > most:
            most, facing = along, m
    out = row(solids.axes[other], facing)
    out = out if dot(out, n) < 0.0 else opposite(out)
    middle = add(row(solids.centre, other), scale(out, solids.half[other, facing]))
    p, q = (facing + 1) % 3, (facing + 2) % 3
    one = scale(row(solids.axes[other], p), solids.half[other, p])
    two = scale(row(solids.axes[other], q), solids.half[other, q])
    put(contacts.clip[0], 0, add(middle, add(one, two)))
    put(contacts.clip[0], 1, add(middle, sub(two, one)))
    put(contacts.clip[0], 2, sub(middle, add(one, two)))
    put(contacts.clip[0], 3, add(middle, sub(one, two)))
    corners, source, centre = 4, 0, row(solids.centre, base)
    for m in range(1, 3):
        side, far = row(solids.axes[base], (k + m) % 3), solids.half[base, (k + m) % 3]
        corners = _clip(contacts.clip, 0, corners, centre, side, far)
        corners = _clip(contacts.clip, 1, corners, centre, opposite(side), far)
    normal = opposite(n) if own else n
    for c in range(corners):
        at = row(contacts.clip[source], c)
        gap = dot(sub(at, centre), n) - solids.half[base, k]
        if gap <= margin and not (flat and at[2] < 0.0):
            count = _add(solids, contacts, count, i, j, normal, _in_plane(at, flat), gap, bounce)
    return count


@routine
def _add_edges(
    solids: Any, contacts: Any, count: int, i: int, j: int, a: int, b: int, n: Vec, gap: float, bounce: float,
    margin: float,
) -> int:  # fmt: skip
    """Add the contact of edges along axis a of body i and b of j, with n from i to j; return the number of contacts."""
    x, y = row(solids.centre, i), row(solids.centre, j)
    for k in range(3):
        if k != a:
            along = row(solids.axes[i], k)
            x = add(x, scale(along, solids.half[i, k] if dot(along, n) > 0.0 else -solids.half[i, k]))
        if k != b:
            along = row(solids.axes[j], k)
            y = add(y, scale(along, -solids.half[j, k] if dot(along, n) > 0.0 else solids.half[j, k]))
    u, v, apart = row(solids.axes[i], a), row(solids.axes[j], b), sub(y, x)
    mixed = dot(u, v)
    less = 1.0 - mixed * mixed
    s = (dot(apart, u) - mixed * dot(apart, v)) / less
    t = (mixed * dot(apart, u) - dot(apart, v)) / less
    if gap > 0.0 and (abs(s) > solids.half[i, a] + margin or abs(t) > solids.half[j, b] + margin):
        return count
    point = scale(add(add(x, scale(u, s)), add(y, scale(v, t))), 0.5)
    return _add(solids, contacts, count, i, j, opposite(n), point, gap, bounce)


@routine
def add_pair(
    solids: Any, contacts: Any, count: int, i: int, j: int, bounce: float, margin: float, flat: bool
) -> int:  # fmt: skip
    """Add the contacts of two blocks that are nearer than `margin`; return the number of contacts."""
    apart = sub(row(solids.centre, j), row(solids.centre, i))
    small = np.inf
    for k in range(2 if flat else 3):
        small = min(small, min(solids.half[i, k], solids.half[j, k]))
    best, face = -np.inf, 0
    for m in range(6):
        n = row(solids.axes[i if m < 3 else j], m % 3)
        gap = abs(dot(apart, n)) - _extent(solids, i, n) - _extent(solids, j, n)
        if gap > margin:
            return count
        if gap > best + 0.01 * FACES_FIRST * small:
            best, face = gap, m
    edges, found = -1, -np.inf
    normal: Vec = (0.0, 0.0, 0.0)
    for m in range(0 if flat else 9):
        n = cross(row(solids.axes[i], m // 3), row(solids.axes[j], m % 3))
        size = norm(n)
        if size < PARALLEL:
            continue
        n = scale(n, (1.0 if dot(apart, n) > 0.0 else -1.0) / size)
        gap = dot(apart, n) - _extent(solids, i, n) - _extent(solids, j, n)
        if gap > margin:
            return count
        if gap > found:
            edges, normal, found = m, n, gap
    if edges >= 0 and found > best + FACES_FIRST * small:
        return _add_edges(solids, contacts, count, i, j, edges // 3, edges % 3, normal, found, bounce, margin)
    return _add_face(solids, contacts, count, i, j, face < 3, face % 3, bounce, margin, flat)
