"""The vehicle: where an agent faces and which way it holds its head up, and how fast it can turn.

A heading outlives standstill: it follows the velocity while there is one, and stays as it was when there is none. In
space an agent has an up vector too; side = unit(f x up) is its right hand and up = side x f, so that (side, f, up) is a
right-handed basis (the pseudo-code of Reynolds 1999 has up = f x side, which is upside down).

Source: Reynolds, "Steering Behaviors for Autonomous Characters" (GDC 1999), "simple vehicle model".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flockenv.jit.decorators import Vec, kernel, law, like
from flockenv.maths.vectors import add, axis, cross, dot, lateral, norm, perpendicular, scale, select, unit

__all__ = ["GRAVITY", "SLOWEST", "face", "faced", "held", "leant", "raised", "turned"]

SLOWEST = 1e-30
"""(m/s)^2: what is slower than 1e-15 m/s stands still; in single precision too, that is far from underflow."""

GRAVITY = 9.81
"""m/s^2, against which an agent leans into its turns."""


@law
def faced(velocity: Vec, heading: Vec) -> Vec:
    """Return where somebody faces who moves so: along the velocity, or as before if there is none."""
    return select(dot(velocity, velocity) > like(heading[0], SLOWEST), unit(velocity), heading)


@law
def turned(way: Vec, heading: Vec, angle: float) -> tuple[Vec, bool]:
    """Return the unit vector along `way`, but at most `angle` [rad] from `heading`; and whether it had to be less.

    Exactly behind, the shorter way around is over the right hand (`perpendicular`). Without a way it is the heading.
    """
    along, aside = dot(way, heading), lateral(way, heading)
    across, length = norm(aside), norm(way)
    # an angle and not its cosine: of a small one that is 1 in single precision, and everybody would turn too far
    over = (np.arctan2(across, along) > angle) & (length > like(length, 0.0))
    known = across > like(across, 1e-6) * length
    bent = scale(select(known, unit(aside), perpendicular(heading)), np.sin(angle))
    bent = unit(add(scale(heading, np.cos(angle)), bent))
    return select(over, bent, faced(way, heading)), over


@law
def held(way: Vec, ahead: Vec, over: bool) -> Vec:
    """Return what is left of `way` for somebody who had to turn less: its part along `ahead`, none backwards."""
    along = dot(way, ahead)
    onward = along if along > like(along, 0.0) else like(along, 0.0)
    return select(over, scale(ahead, onward), way)


@law
def leant(heading: Vec, before: Vec, up: Vec, speed: float, seconds: float, memory: float) -> Vec:
    """Return the up vector of somebody who leans into a turn: it follows lateral acceleration + g upwards, in space.

    The acceleration is s (f - f_before)/dt across f, that of the path; `memory` [s] is how long up takes to follow,
    with a share of 1 - exp(-dt/memory) per step, whatever dt is. An infinite one leaves up as it is (Reynolds 1999).
    """
    share = like(speed, 1.0) - np.exp(-seconds / memory)
    toward = scale(lateral(before, heading), -speed / seconds)
    apparent = add(toward, (like(speed, 0.0), like(speed, 0.0), like(speed, GRAVITY)))
    return add(scale(up, like(speed, 1.0) - share), scale(unit(apparent), share))


@law
def raised(heading: Vec, before: Vec, up: Vec) -> Vec:
    """Return the unit vector across `heading` that is nearest to `up`; where that is along it, side stays as it was."""
    side, old = cross(heading, up), cross(before, up)
    side = select(dot(side, side) > like(up[0], 1e-8), side, old)
    side = select(dot(side, side) > like(up[0], 1e-8), unit(side), perpendicular(heading))
    return unit(cross(side, heading))


@kernel
def face_one(v: Any, frame: Any, b: int, i: int, anew: bool) -> None:
    """Write where agent i of world b faces, and which way is up; see `face`."""
    if anew:
        frame[:, b, i] = 0
    if v.shape[0] == 2:
        heading = faced((v[0, b, i], v[1, b, i]), (frame[0, b, i], frame[1, b, i]))
        heading = select(dot(heading, heading) > like(heading[0], 0.0), heading, axis(heading, 0))
        frame[0, b, i], frame[1, b, i] = heading
    else:
        old: Vec = (frame[0, b, i], frame[1, b, i], frame[2, b, i])
        ahead = faced((v[0, b, i], v[1, b, i], v[2, b, i]), old)
        ahead = select(dot(ahead, ahead) > like(ahead[0], 0.0), ahead, axis(ahead, 0))
        up: Vec = (frame[3, b, i], frame[4, b, i], frame[5, b, i])
        up = select(dot(up, up) > like(up[0], 0.0), up, axis(up, 2))
        up = raised(ahead, axis(ahead, 1), up)
        frame[0, b, i], frame[1, b, i], frame[2, b, i] = ahead
        frame[3, b, i], frame[4, b, i], frame[5, b, i] = up


@kernel
def face(v: Any, frame: Any, b: int, anew: bool) -> None:
    """Write where the agents of world b face, and which way is up, for these velocities; v (D, B, N), frame (F, B, N).

    Who stands still faces as he did, or along the x axis if that was nowhere, or all is `anew`; up is the z axis then.
    """
    for i in range(v.shape[2]):
        face_one(v, frame, b, i, anew)
