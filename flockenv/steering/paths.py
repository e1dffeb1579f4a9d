"""Laws to follow paths and flow fields, given the nearest point of the path, or the velocity of the flow.

`flockenv.geometry.polyline` computes the nearest point of a path, `flockenv.maths.grid` the value of a field.
"""

from __future__ import annotations

from flockenv.jit.decorators import Vec, law, like
from flockenv.maths.vectors import select, sub, zero
from flockenv.steering.goals import seek

__all__ = ["follow_flow", "follow_path", "stay_on_path"]


@law
def stay_on_path(beyond: float, to_spine: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Return zero if the predicted position is in the tube, else seek the spine's nearest point (Reynolds 1999).

    velocity: of the agent, m/s; max_speed: V, m/s.

    `beyond` is the distance of the predicted position from the tube, m, negative inside; `to_spine` leads to the spine.
    """
    return select(beyond > like(beyond, 0.0), seek(to_spine, velocity, max_speed), zero(velocity))


@law
def follow_path(beyond: float, gained: float, target: Vec, velocity: Vec, max_speed: float) -> Vec:
    """Return zero while the agent makes progress in the tube, else seek a point further along it (Reynolds 1999).

    target: offset to that point, m; velocity: of the agent, m/s; max_speed: V, m/s.

    `gained` is the progress of the predicted position along the path less the required one, m: it is negative if the
    agent has turned round or is too slow. `beyond` is the distance of that position from the tube, m, negative inside.
    """
    o = like(beyond, 0.0)
    good = (beyond <= o) & (gained > o)
    return select(good, zero(velocity), seek(target, velocity, max_speed))


@law
def follow_flow(flow: Vec, velocity: Vec) -> Vec:
    """Take on the velocity of a field: S = F - v, F at the predicted position (Reynolds 1999).

    flow: F, m/s; velocity: of the agent, m/s.
    """
    return sub(flow, velocity)
