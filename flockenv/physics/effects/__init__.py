"""Effects on agents, one family per file; a new one needs a file, and a row in tests/catalogue.py."""

from __future__ import annotations

from flockenv.jit.startup import import_all

import_all(__name__, __path__)

from flockenv.physics.effects.aims import Aim, Antipode, Course, Goal  # noqa: E402
from flockenv.physics.effects.altitude_springs import AltitudeSprings  # noqa: E402
from flockenv.physics.effects.angular_springs import AngularSprings  # noqa: E402
from flockenv.physics.effects.attraction import Attraction  # noqa: E402
from flockenv.physics.effects.contact import Contact, ObstacleContact  # noqa: E402
from flockenv.physics.effects.drag import Drag, QuadraticDrag  # noqa: E402
from flockenv.physics.effects.effect import EFFECTS, Effect, Far, Me, Other, Sight, Vector  # noqa: E402  # after the folder has been walked
from flockenv.physics.effects.elastic import Elastic  # noqa: E402
from flockenv.physics.effects.exit_choice import Door, Routes  # noqa: E402
from flockenv.physics.effects.fields import Carried, Sink, Source, Uniform, Vortex, Wind  # noqa: E402
from flockenv.physics.effects.floor_field import Way  # noqa: E402
from flockenv.physics.effects.fluctuation import Fluctuation  # noqa: E402
from flockenv.physics.effects.gravitation import Gravitation, InverseSquare  # noqa: E402
from flockenv.physics.effects.gravity import Gravity  # noqa: E402
from flockenv.physics.effects.liquid import SurfaceTension, Viscosity  # noqa: E402
from flockenv.physics.effects.membrane import Bending, Membrane  # noqa: E402
from flockenv.physics.effects.motivation import Fear, Grazing, Intention, Libido, Metabolism, Predation  # noqa: E402
from flockenv.physics.effects.pressure import Pressure  # noqa: E402
from flockenv.physics.effects.speed_limit import SpeedLimit  # noqa: E402
from flockenv.physics.effects.springs import Springs  # noqa: E402
from flockenv.physics.effects.tether import Swing, Tether  # noqa: E402
from flockenv.physics.effects.vicsek import Vicsek  # noqa: E402
from flockenv.physics.effects.wall import WallRepulsion  # noqa: E402
from flockenv.physics.effects.waypoints import Journey, Stage  # noqa: E402

__all__ = [
    "EFFECTS", "Aim", "AltitudeSprings", "AngularSprings", "Antipode", "Attraction", "Bending", "Carried", "Contact",
    "Course", "Door", "Drag", "Effect", "Elastic", "Far", "Fear", "Fluctuation", "Goal", "Gravitation", "Gravity",
    "Grazing", "Intention", "InverseSquare", "Journey", "Libido", "Me", "Membrane", "Metabolism", "ObstacleContact",
    "Other", "Predation", "Pressure", "QuadraticDrag", "Routes", "Sight", "Sink", "Source", "SpeedLimit", "Springs",
    "Stage", "SurfaceTension", "Swing", "Tether", "Uniform", "Vector", "Vicsek", "Viscosity", "Vortex", "WallRepulsion",
    "Way", "Wind",
]  # fmt: skip
