"""Shepherding: the direction of a sheep near a dog, and the place for the dog.

Source: Strombom et al., "Solving the shepherding problem" (J. R. Soc. Interface 11:20140719, 2014,
doi 10.1098/rsif.2014.0719), in continuous time: the laws return directions, and the caller chooses the speed.
"""

from __future__ import annotations

from flockenv.jit.decorators import Vec, law
from flockenv.maths.vectors import add, norm, scale, select, sub, unit

__all__ = ["herding_offset", "point_behind", "sheep_direction"]


@law
def sheep_direction(
    velocity: Vec, centre: Vec, crowd: Vec, away: Vec, noise: Vec,
    inertia: float, attraction: float, apart: float, fear: float, error: float,
) -> Vec:  # fmt: skip
    """Return the direction of a sheep, unit(h unit(v) + c unit(C) + rho_a unit(R_a) + rho_s unit(R_s) + e noise).

    velocity: v, m/s; centre: C, m; crowd: R_a; away: R_s; noise: a vector; inertia: h; attraction: c; apart: rho_a;
    fear: rho_s; error: e.

    C leads to the centre of the sheep around it, R_a and R_s are sums of unit vectors away from sheep that are too near
    and from dogs (Strombom et al. 2014, H'; there h = 0.5, c = 1.05, rho_a = 2, rho_s = 1, e = 0.3). 0 if all terms are
    0.
    """
    total = add(scale(unit(velocity), inertia), scale(unit(centre), attraction))
    total = add(total, add(scale(unit(crowd), apart), scale(unit(away), fear)))
    return unit(add(total, scale(noise, error)))


@law
def point_behind(offset: Vec, goal: Vec, distance: float) -> Vec:
    """Return the offset of the place `distance` m behind a target, as seen from the goal to drive it to."""
    return add(offset, scale(unit(sub(offset, goal)), distance))


@law
def herding_offset(
    centre: Vec, farthest: Vec, goal: Vec, together: float, collecting: float, driving: float
) -> Vec:  # fmt: skip
    """Return the offset of the place for a dog: behind a stray sheep, to collect it, or else behind the flock.

    It is `collecting` m behind the sheep farthest from the centre, seen from the centre, if that is more than
    `together` m away; else `driving` m behind the centre, seen from the goal (Strombom et al. 2014: r_a N^(2/3), r_a
    and r_a sqrt(N) for N sheep that keep r_a m apart).
    """
    strays = norm(sub(farthest, centre)) > together
    return select(strays, point_behind(farthest, centre, collecting), point_behind(centre, goal, driving))
