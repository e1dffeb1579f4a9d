"""Steering behaviours: Reynolds' and others, a family per file.

To add one: write its file here, and a row in tests/catalogue.py.

A behaviour is an effect (see physics/effects/effect.py for the forms of its laws) with `steering = True`: its laws
return a steering force, in newtons. Those in a scene's list of effects are summed, and the sum is cut to max_force;
under a `Steer` effect an arbitration combines them.
"""

from __future__ import annotations

from flockenv.jit.startup import import_all

import_all(__name__, __path__, but="steer")  # which needs all the others

from flockenv.behaviours.avoid import AvoidObstacles, ForceField, Whiskers  # noqa: E402
from flockenv.behaviours.crowd import Explore, Forage, Queue, UnalignedAvoidance  # noqa: E402
from flockenv.behaviours.driving import Driving, LineUp  # noqa: E402
from flockenv.behaviours.flock import Alignment, Cohesion, Separation  # noqa: E402
from flockenv.behaviours.follow_way import FollowWay  # noqa: E402
from flockenv.behaviours.formations import FollowLeader, Formation, Interpose  # noqa: E402
from flockenv.behaviours.goals import Arrive, Dock, Face, Flee, Seek, TargetSpeed  # noqa: E402
from flockenv.behaviours.groups import Friends, Interest, WalkingGroup  # noqa: E402
from flockenv.behaviours.heuristics import Heuristics  # noqa: E402
from flockenv.behaviours.hide import Hide  # noqa: E402
from flockenv.behaviours.obstacle_repulsion import ObstacleRepulsion  # noqa: E402
from flockenv.behaviours.orca import Orca  # noqa: E402
from flockenv.behaviours.paths import FollowFlow, FollowPath, StayOnPath  # noqa: E402
from flockenv.behaviours.pursue import Evade, MatchVelocity, OffsetPursue, Pursue, Shadow  # noqa: E402
from flockenv.behaviours.shepherd import Shepherd  # noqa: E402
from flockenv.behaviours.social import CircularRepulsion, EllipticalRepulsion, Sidestep  # noqa: E402
from flockenv.behaviours.walls import Contain, FollowWall  # noqa: E402
from flockenv.behaviours.wander import Wander  # noqa: E402
from flockenv.physics.effects.effect import EFFECTS, Effect  # noqa: E402  # after the folder has been walked

__all__ = [
    "BEHAVIOURS", "Alignment", "Arrive", "AvoidObstacles", "CircularRepulsion", "Cohesion", "Contain", "Dock",
    "Driving", "EllipticalRepulsion", "Evade", "Explore", "Face", "Flee", "FollowFlow", "FollowLeader", "FollowPath",
    "FollowWall", "FollowWay", "Forage", "ForceField", "Formation", "Friends", "Heuristics", "Hide", "Interest",
    "Interpose", "LineUp", "MatchVelocity", "ObstacleRepulsion", "OffsetPursue", "Orca", "Pursue", "Queue", "Seek",
    "Separation", "Shadow", "Shepherd", "Sidestep", "StayOnPath", "TargetSpeed", "UnalignedAvoidance", "WalkingGroup",
    "Wander", "Whiskers",
]  # fmt: skip

BEHAVIOURS: dict[str, type[Effect]] = {kind: effect for kind, effect in EFFECTS.items() if effect.steering}
"""Every behaviour by its kind."""
