"""Orientation of an agent: its heading f, its up vector in 3-D, and the limit on how fast it can turn.

The heading is the direction of the velocity; at standstill it keeps its last value. In 3-D an agent also has an up
vector; side = unit(f x up) points to its right and up = side x f, so that (side, f, up) is a right-handed basis (the
pseudo-code of Reynolds 1999 has up = f x side, which is upside down).

Source: Reynolds, "Steering Behaviors for Autonomous Characters" (GDC 1999), "simple vehicle model".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec, kernel, law, like
from flockenv.maths.vectors import add, axis, cross, dot, lateral, norm, perpendicular, scale, select, unit

__all__ = ["GRAVITY", "SLOWEST", "bank", "face", "heading_for", "limit_to_heading", "turn_towards", "up_for"]

SLOWEST = 1e-30
"""(m/s)^2: an agent slower than 1e-15 m/s is at standstill; in single precision this is far from underflow."""

GRAVITY = 9.81
"""m/s^2, against which an agent leans into its turns."""


@law
def heading_for(velocity: Vec, heading: Vec) -> Vec:
    """Return the heading for a velocity: its direction, or the previous heading at standstill."""
    return select(dot(velocity, velocity) > like(heading[0], SLOWEST), unit(velocity), heading)


@law
def turn_towards(direction: Vec, heading: Vec, angle: float) -> tuple[Vec, bool]:
    """Return the unit vector along `direction`, at most `angle` [rad] from `heading`, and True if the turn was limited.

    If it points exactly backwards, the turn is to the right (`perpendicular`). For a zero vector it is the heading.
    """
    along, sideways = dot(direction, heading), lateral(direction, heading)
    across, length = norm(sideways), norm(direction)
    # the angle, not its cosine, which is 1 for small angles in single precision, so that agents would turn too far
    over = (np.arctan2(across, along) > angle) & (length > like(length, 0.0))
    known = across > like(across, 1e-6) * length
    bent = scale(select(known, unit(sideways), perpendicular(heading)), np.sin(angle))
    bent = unit(add(scale(heading, np.cos(angle)), bent))
    return select(over, bent, heading_for(direction, heading)), over


@law
def limit_to_heading(direction: Vec, ahead: Vec, over: bool) -> Vec:
    """Return `direction` or, if the turn was limited (`over`), its component along `ahead`, at least 0."""
    along = dot(direction, ahead)
    onward = along if along > like(along, 0.0) else like(along, 0.0)
    return select(over, scale(ahead, onward), direction)


@law
def bank(heading: Vec, before: Vec, up: Vec, speed: float, seconds: float, memory: float) -> Vec:
    """Return the up vector of an agent that banks into a turn, in 3-D: it follows lateral acceleration + g upwards.

    The lateral acceleration is the component of s (f - f_before)/dt perpendicular to f. `memory` [s] is the time
    constant: up moves by the fraction 1 - exp(-dt/memory) per step, for any dt. An infinite one leaves up unchanged
    (Reynolds 1999).
    """
    share = like(speed, 1.0) - np.exp(-seconds / memory)
    toward = scale(lateral(before, heading), -speed / seconds)
    apparent = add(toward, (like(speed, 0.0), like(speed, 0.0), like(speed, GRAVITY)))
    return add(scale(up, like(speed, 1.0) - share), scale(unit(apparent), share))


@law
def up_for(heading: Vec, before: Vec, up: Vec) -> Vec:
    """Return the unit vector perpendicular to `heading` nearest to `up`; if they are parallel, keep side."""
    side, old = cross(heading, up), cross(before, up)
    side = select(dot(side, side) > like(up[0], 1e-8), side, old)
    side = select(dot(side, side) > like(up[0], 1e-8), unit(side), perpendicular(heading))
    return unit(cross(side, heading))


@kernel
def face_one(v: Any, frame: Any, b: int, i: int, anew: bool) -> None:
    """Write the heading and the up vector of agent i of world b; see `face`."""
    if anew:
        frame[:, b, i] = 0
    if v.shape[0] == 2:
        heading = heading_for((v[0, b, i], v[1, b, i]), (frame[0, b, i], frame[1, b, i]))
        heading = select(dot(heading, heading) > like(heading[0], 0.0), heading, axis(heading, 0))
        frame[0, b, i], frame[1, b, i] = heading
    else:
        old: Vec = (frame[0, b, i], frame[1, b, i], frame[2, b, i])
        ahead = heading_for((v[0, b, i], v[1, b, i], v[2, b, i]), old)
        ahead = select(dot(ahead, ahead) > like(ahead[0], 0.0), ahead, axis(ahead, 0))
        up: Vec = (frame[3, b, i], frame[4, b, i], frame[5, b, i])
        up = select(dot(up, up) > like(up[0], 0.0), up, axis(up, 2))
        up = up_for(ahead, axis(ahead, 1), up)
        frame[0, b, i], frame[1, b, i], frame[2, b, i] = ahead
        frame[3, b, i], frame[4, b, i], frame[5, b, i] = up


@kernel
def face(v: Any, frame: Any, b: int, anew: bool) -> None:
    """Write headings and up vectors of the agents of world b for their velocities; v (D, B, N), frame (F, B, N).

    At standstill an agent keeps its heading; without one, or with `anew`, its heading is the x axis and up the z axis.
    """
    for i in range(v.shape[2]):
        face_one(v, frame, b, i, anew)
