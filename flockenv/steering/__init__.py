"""Steering laws for one agent, one per behaviour of Reynolds; kernels, scripted agents and players call them.

A steering law returns the desired change of velocity, S = v_desired - v, in m/s; the caller turns it into a force
with a gain in kg/s (m/tau makes `seek` Helbing's driving force). `offset` is always other minus self. Laws take tuples
of D = 2 or 3 floats and are finite for every finite input, also at standstill and at zero distance.
`flockenv.steering.vectorize.rows(law)` applies one to arrays.

Sources: Reynolds, "Flocks, Herds, and Schools" (SIGGRAPH 1987); "Steering Behaviors for Autonomous Characters"
(GDC 1999). The sign of seek is that of the paper's figure; its pseudo-code flees.
"""

from __future__ import annotations

from flockenv.steering.around import avoid, contain, threat
from flockenv.steering.crowd import explore, give_way, queue, queue_gap, unaligned_threat
from flockenv.steering.goals import (
    arrive,
    dock,
    face,
    flee,
    match_velocity,
    seek,
    target_speed,
    to_world_axes,
    wander,
    wander_turn,
)
from flockenv.steering.herding import herding_offset, point_behind, sheep_direction
from flockenv.steering.others import (
    align,
    approach_time,
    cohere,
    distance_time,
    evade,
    follow_leader,
    hiding_place,
    interception_time,
    interpose,
    keep_station,
    offset_pursue,
    opensteer_time,
    passing_point,
    pursue,
    separate,
    shadow,
)
from flockenv.steering.paths import follow_flow, follow_path, stay_on_path
from flockenv.steering.social import (
    attraction,
    collision_distance,
    cone_weight,
    elliptical_repulsion,
    gaze_direction,
    gaze_turn,
    repulsion,
    sidestep,
    view_weight,
)

__all__ = [
    "align",
    "approach_time",
    "arrive",
    "attraction",
    "avoid",
    "cohere",
    "collision_distance",
    "cone_weight",
    "contain",
    "distance_time",
    "dock",
    "elliptical_repulsion",
    "evade",
    "explore",
    "face",
    "flee",
    "follow_flow",
    "follow_leader",
    "follow_path",
    "gaze_direction",
    "gaze_turn",
    "give_way",
    "herding_offset",
    "hiding_place",
    "interception_time",
    "interpose",
    "keep_station",
    "match_velocity",
    "offset_pursue",
    "opensteer_time",
    "passing_point",
    "point_behind",
    "pursue",
    "queue",
    "queue_gap",
    "repulsion",
    "seek",
    "separate",
    "shadow",
    "sheep_direction",
    "sidestep",
    "stay_on_path",
    "target_speed",
    "threat",
    "to_world_axes",
    "unaligned_threat",
    "view_weight",
    "wander",
    "wander_turn",
]
