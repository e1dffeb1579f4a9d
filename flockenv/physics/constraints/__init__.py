"""Constraints at the end of every step, for any method; a new one needs a file, and a row in tests/catalogue.py."""

from __future__ import annotations

from flockenv.core.warnings import UnmetWarning
from flockenv.jit.startup import import_all

import_all(__name__, __path__)

from flockenv.physics.constraints.collisions import Collisions  # noqa: E402  # after the folder has been walked
from flockenv.physics.constraints.constraint import CONSTRAINTS, Constraint, Settler  # noqa: E402
from flockenv.physics.constraints.constraint_forces import CollisionForces, PinForces  # noqa: E402
from flockenv.physics.constraints.face_collisions import FaceCollisions  # noqa: E402
from flockenv.physics.constraints.rigid_bodies import BodyContacts, RigidBodies  # noqa: E402
from flockenv.physics.constraints.rods import RodForces, Rods  # noqa: E402
from flockenv.physics.constraints.slide import Slide  # noqa: E402

__all__ = [
    "CONSTRAINTS", "BodyContacts", "CollisionForces", "Collisions", "Constraint", "FaceCollisions", "PinForces",
    "RigidBodies", "RodForces", "Rods", "Settler", "Slide", "UnmetWarning",
]  # fmt: skip
