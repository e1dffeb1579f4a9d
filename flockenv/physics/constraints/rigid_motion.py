"""Rigid bodies as networks of particles: read from them, rotated freely, and written back.

A body that nothing touches keeps its angular momentum L and its energy to rounding. In its own axes L obeys
dm/dt = m x J m with J the inverse tensor of inertia; the implicit midpoint rule keeps |m| and m . J m, and turning the
axes by Cayley's map of the midpoint's J m keeps L = R m in space.
Source: Austin, Krishnaprasad and Wang 1993, J. Comput. Phys. 107, 105; Lewis and Simo 1994.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from flockenv.jit.decorators import Vec, finite, kernel, law, routine
from flockenv.maths.polar import nearest_rotation
from flockenv.maths.vectors import add, axis, cross, dot, norm, scale, sub

__all__ = ["Solids", "advance_axes", "first_not_finite", "load_bodies", "put", "row", "spin_of", "store_body"]

NEWTON = 20
"""Most iterations of the midpoint rule; beyond them the rotation is that of the start."""


class Solids(NamedTuple):
    """K bodies, then blocks that stand still, then the ground, to which all other obstacles belong; n in all.

    Motion in a plane has rows of three numbers too: blocks are thick along z, and do not turn about x and y.
    """

    first: Any  # (K,) a body's first particle: its corners, along the first axis first, then its centre
    corner: Any  # (8, 3) signs of the corners
    half: Any  # (n, 3) m, half edges
    reach: Any  # (n,) m, from the centre to a corner
    light: Any  # (n,) 1/kg; 0 = it stands still
    turning: Any  # (n, 3) 1/(kg m^2), inverse moments of inertia about its axes
    share: Any  # (2,) part of the mass of a corner, and of the centre
    centre: Any  # (n, 3) m, at the start of the step
    axes: Any  # (n, 3, 3) its axes as rows, at the start of the step
    before: Any  # (2, n, 3) m/s and rad/s, at the start of the step
    free: Any  # (2, n, 3) the same at the end of the step, without contacts
    speed: Any  # (2, n, 3) the same with contacts
    moved: Any  # (n, 3) m, displacement of the step without contacts
    turn: Any  # (n, 3) kg m^2/s, mean angular momentum of the step without contacts
    twist: Any  # (n, 3) kg m^2/s, angular momentum at its end without contacts
    shift: Any  # (2, n, 3) change of momentum, and of angular momentum, by contacts, for positions
    push: Any  # (2, n, 3) the same for velocities
    touched: Any  # (n,) 1 if contacts change its path


@law
def row(array: Any, i: int) -> Vec:
    """Return row i of an array (n, 3)."""
    return (array[i, 0], array[i, 1], array[i, 2])


@law
def put(array: Any, i: int, x: Vec) -> None:
    """Set row i of an array (n, 3)."""
    array[i, 0], array[i, 1], array[i, 2] = x[0], x[1], x[2]


@law
def _vector(array: Any, b: int, i: int, flat: bool) -> Vec:
    """Return the vector of agent i of world b in an array (D, B, N), with z = 0 in a plane."""
    if flat:
        return (array[0, b, i], array[1, b, i], 0.0)
    return (array[0, b, i], array[1, b, i], array[2, b, i])


@kernel
def spin_of(solids: Any, i: int, twist: Vec) -> Vec:
    """Return the angular velocity of a body with this angular momentum, rad/s."""
    out: Vec = (0.0, 0.0, 0.0)
    for k in range(3):
        along = row(solids.axes[i], k)
        out = add(out, scale(along, dot(along, twist) * solids.turning[i, k]))
    return out


@kernel
def _read_axes(solids: Any, x: Any, b: int, i: int, flat: bool) -> None:
    """Set the axes of a body to the rotation nearest to the mean directions of its edges."""
    corners = 4 if flat else 8
    one: Vec = (0.0, 0.0, 0.0)
    two: Vec = (0.0, 0.0, 0.0)
    three: Vec = (0.0, 0.0, 1.0 if flat else 0.0)
    for c in range(corners):
        at = scale(_vector(x, b, solids.first[i] + c, flat), 1.0 / corners)
        one = add(one, scale(at, solids.corner[c, 0] / solids.half[i, 0]))
        two = add(two, scale(at, solids.corner[c, 1] / solids.half[i, 1]))
        if not flat:
            three = add(three, scale(at, solids.corner[c, 2] / solids.half[i, 2]))
    columns = nearest_rotation((one, two, three))
    for k in range(3):
        put(solids.axes[i], k, columns[k])


@kernel
def _mean(solids: Any, array: Any, b: int, i: int, flat: bool) -> Vec:
    """Return the mean of a body's particles, weighted by mass."""
    corners = 4 if flat else 8
    total = scale(_vector(array, b, solids.first[i] + corners, flat), solids.share[1])
    for c in range(corners):
        total = add(total, scale(_vector(array, b, solids.first[i] + c, flat), solids.share[0]))
    return total


@kernel
def _moment(solids: Any, x: Any, centre: Vec, v: Any, other: Any, b: int, i: int, flat: bool) -> Vec:
    """Return the angular momentum about `centre` of a body's particles at x with velocities v - other, kg m^2/s."""
    corners = 4 if flat else 8
    total: Vec = (0.0, 0.0, 0.0)
    for c in range(corners + 1):
        p = solids.first[i] + c
        off, vel = sub(_vector(x, b, p, flat), centre), _vector(v, b, p, flat)
        if other is not None:
            vel = sub(vel, _vector(other, b, p, flat))
        total = add(total, scale(cross(off, vel), solids.share[0] if c < corners else solids.share[1]))
    return scale(total, 1.0 / solids.light[i])


@routine
def first_not_finite(x: Any, v: Any, b: int) -> int:
    """Return the first agent of world b whose position or velocity is not finite, or -1."""
    for p in range(x.shape[2]):
        for k in range(x.shape[0]):
            if not finite(x[k, b, p] + v[k, b, p]):
                return p
    return -1


@routine
def load_bodies(solids: Any, x0: Any, v0: Any, x: Any, v: Any, b: int, dt: float) -> int:
    """Read the step of all bodies of world b; return the first agent that is not finite, or -1."""
    flat, bad = x.shape[0] == 2, first_not_finite(x, v, b)
    if bad >= 0:
        return bad
    for i in range(solids.first.shape[0]):
        _read_axes(solids, x0, b, i, flat)
        centre, end = _mean(solids, x0, b, i, flat), _mean(solids, x, b, i, flat)
        twist = _moment(solids, x, end, v, None, b, i, flat)
        put(solids.centre, i, centre)
        put(solids.moved, i, sub(end, centre))
        put(solids.before[0], i, _mean(solids, v0, b, i, flat))
        put(solids.before[1], i, spin_of(solids, i, _moment(solids, x0, centre, v0, None, b, i, flat)))
        put(solids.free[0], i, _mean(solids, v, b, i, flat))
        put(solids.free[1], i, spin_of(solids, i, twist))
        put(solids.turn, i, scale(_moment(solids, x0, centre, x, x0, b, i, flat), 1.0 / dt))
        put(solids.twist, i, twist)
        solids.touched[i] = 0
    return -1


@kernel
def _solve(x: Vec, y: Vec, z: Vec, by: Vec) -> Vec:
    """Return the solution of the linear equations with columns x, y, z, by Cramer's rule."""
    volume = dot(x, cross(y, z))
    return (dot(by, cross(y, z)) / volume, dot(x, cross(by, z)) / volume, dot(x, cross(y, by)) / volume)


@kernel
def _midpoint(m: Vec, inverse: Vec, dt: float) -> Vec:
    """Return the angular velocity, in a body's axes, of the midpoint rule from angular momentum m, by Newton."""
    half, middle = 0.5 * dt, m
    spin: Vec = (m[0] * inverse[0], m[1] * inverse[1], m[2] * inverse[2])
    still = 1e-15 * norm(m)
    for _ in range(NEWTON):
        off = sub(sub(middle, m), scale(cross(middle, spin), half))
        columns = (
            sub(axis(m, 0), scale(add(cross(axis(m, 0), spin), scale(cross(middle, axis(m, 0)), inverse[0])), half)),
            sub(axis(m, 1), scale(add(cross(axis(m, 1), spin), scale(cross(middle, axis(m, 1)), inverse[1])), half)),
            sub(axis(m, 2), scale(add(cross(axis(m, 2), spin), scale(cross(middle, axis(m, 2)), inverse[2])), half)),
        )
        change = _solve(columns[0], columns[1], columns[2], off)
        middle = sub(middle, change)
        spin = (middle[0] * inverse[0], middle[1] * inverse[1], middle[2] * inverse[2])
        if not norm(change) > still:
            return spin
    return (m[0] * inverse[0], m[1] * inverse[1], m[2] * inverse[2])


@routine
def advance_axes(solids: Any, i: int, twist: Vec, dt: float) -> None:
    """Turn the axes of a body over a step with this angular momentum."""
    axes = solids.axes[i]
    x, y, z = row(axes, 0), row(axes, 1), row(axes, 2)
    spin = _midpoint((dot(x, twist), dot(y, twist), dot(z, twist)), row(solids.turning, i), dt)
    by = scale(add(add(scale(x, spin[0]), scale(y, spin[1])), scale(z, spin[2])), 0.5 * dt)
    share = 2.0 / (1.0 + dot(by, by))
    for k in range(3):
        once = cross(by, row(axes, k))
        put(axes, k, add(row(axes, k), scale(add(once, cross(by, once)), share)))


@routine
def store_body(solids: Any, x: Any, v: Any, b: int, i: int, centre: Vec, speed: Vec, spin: Vec) -> None:
    """Write the particles of a body with this centre and motion, and its axes as they are."""
    flat, corners = x.shape[0] == 2, 4 if x.shape[0] == 2 else 8
    for c in range(corners + 1):
        off: Vec = (0.0, 0.0, 0.0)
        for k in range(3):
            if c < corners and not (flat and k == 2):
                off = add(off, scale(row(solids.axes[i], k), solids.corner[c, k] * solids.half[i, k]))
        place, vel = add(centre, off), add(speed, cross(spin, off))
        for k in range(x.shape[0]):
            x[k, b, solids.first[i] + c], v[k, b, solids.first[i] + c] = place[k], vel[k]
