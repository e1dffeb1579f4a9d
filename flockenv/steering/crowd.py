"""Laws among many agents with goals: unaligned collision avoidance, queues, and coverage of a region."""

from __future__ import annotations

import numpy as np

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import add, dot, perpendicular, planar, scale, select, sub, unit
from flockenv.steering.around import threat

__all__ = ["explore", "give_way", "queue", "queue_gap", "unaligned_threat"]


@law
def unaligned_threat(offset: Vec, velocity: Vec, other_velocity: Vec, clearance: float, horizon: float) -> float:
    """Return the time of closest approach to a neighbour, s; inf if it is past, too late, or not near enough.

    offset: to the neighbour, dx, m; velocity: of the agent, m/s; other_velocity: of the neighbour, m/s; horizon: s.

    t* = -dx . dv / |dv|^2, kept if 0 <= t* <= horizon and |dx + dv t*| < clearance, the sum of both radii and a margin
    (Reynolds 1999, unaligned collision avoidance; not twice the own radius). Both keep their velocities.
    """
    apart = sub(other_velocity, velocity)
    square, closing = dot(apart, apart), -dot(offset, apart)
    o = like(square, 0.0)
    time = closing / square if square > o else o
    miss = add(offset, scale(apart, time))
    meets = (closing > o) & (time <= horizon) & (dot(miss, miss) < clearance * clearance)
    return time if meets else like(time, np.inf)


@law
def give_way(offset: Vec, velocity: Vec, other_velocity: Vec, time: float, max_speed: float) -> Vec:
    """Steer away from the predicted offset p of a neighbour at the closest approach: S = -V unit(p), m/s.

    offset: to the neighbour, m; velocity: of the agent, m/s; other_velocity: its velocity, m/s; time: until the closest
    approach, s; max_speed: V, m/s.

    p is perpendicular to the relative motion. So an agent that meets another head-on steers aside, one that crosses
    behind also brakes, and one that crosses in front also speeds up; the changes of the two are opposite. If p = 0,
    both keep right of the relative motion: of two that cross, the one on the other's right goes first.
    """
    meeting = add(offset, scale(sub(other_velocity, velocity), time))
    noise = like(time, 1e-10) * dot(offset, offset)  # a residue of rounding has no side
    right = perpendicular(unit(sub(velocity, other_velocity)))
    away = select(dot(meeting, meeting) > noise, scale(unit(meeting), like(time, -1.0)), right)
    return scale(away, max_speed)


@law
def queue_gap(direction: Vec, offset: Vec, other_velocity: Vec, clearance: float, max_speed: float) -> float:
    """Return the gap along a unit vector to a neighbour slower than the desired speed, m; inf if there is none.

    direction: the unit vector; offset: to the neighbour, m; other_velocity: its velocity, m/s; clearance: the sum of
    both radii, m; max_speed: the desired speed, m/s.

    A neighbour behind, beside the path, or as fast as the desired speed does not count (Reynolds 1999: near, ahead and
    slower).
    """
    far = like(clearance, np.inf)
    holds_up = (dot(offset, direction) > like(clearance, 0.0)) & (dot(other_velocity, direction) < max_speed)
    gap = threat(direction, offset, clearance, far)
    return gap if holds_up else far


@law
def queue(direction: Vec, velocity: Vec, gap: float, max_speed: float, headway: float) -> Vec:
    """Move in a `direction` as fast as the gap allows: S = direction min(V, gap / T) - v, m/s; T = headway [s].

    velocity: of the agent, m/s; gap: to the agent ahead, m, or inf; max_speed: V, m/s.

    The brake of Reynolds 1999 in the form of Tordeux, Chraibi, Seyfried 2016 (doi 10.1007/978-3-319-33482-0_29): a gap
    closes as exp(-t / T), and 1 / (T + l / V) agents of length l pass per second. With a gain of k = 4 m / T or more no
    agent overshoots.
    """
    held = gap / headway
    return sub(scale(direction, held if held < max_speed else max_speed), velocity)


@law
def explore(to_low: Vec, to_high: Vec, velocity: Vec, max_speed: float, track: float) -> Vec:
    """Cover a rectangle endlessly along a closed comb of tracks, at most `track` [m] apart: S, m/s.

    velocity: of the agent, m/s; max_speed: V, m/s.

    The loop leads to and fro along an even number of rows from the lower wall to the upper, and back down beside the
    left wall; in 3-D each agent keeps its height. Direction is a function of position alone, so a displaced agent
    continues from there. `to_low` and `to_high` are distances to the walls per axis, m. Agents do not overshoot at
    turns if track > V^2 m / F_max. (Ours: the textbook's boustrophedon as a velocity field.)
    """
    e, half = like(track, 1.0), like(track, 0.5)
    x, y = to_low[0], to_low[1]
    width, height = x + to_high[0], max(y + to_high[1], track)
    rows = e + e
    rows = rows * max(np.ceil(height / (rows * track)), e)
    row = min(max(np.floor(y * rows / height), e - e), rows - e)
    middle = (row + half) * height / rows
    forth, last = row - (e + e) * np.floor(row * half) < half, row > rows - e - half  # an even row; the uppermost
    back = x < track
    down = planar(velocity, half * track - x, -track)
    along = planar(velocity, track if forth | back else -track, middle - y)
    up = planar(velocity, (width - half * track if forth else (e + half) * track) - x, track)
    at_end = (x > width - track) if forth else (x < track + track) & (not last)
    goal = select(back & (row > half), down, select(at_end & (not back), up, along))
    return sub(scale(unit(goal), max_speed), velocity)
