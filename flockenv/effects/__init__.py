"""What acts on a body, a family per file. To add one: write its file here, and a row in tests/catalogue.py."""

from __future__ import annotations

import importlib
import pkgutil

from flockenv.effects.base import EFFECTS, Effect, Me, Other, Sight

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

from flockenv.effects.avoid import AvoidObstacles  # noqa: E402  # after the folder has been walked
from flockenv.effects.drag import Drag  # noqa: E402
from flockenv.effects.flock import Alignment, Cohesion, Separation  # noqa: E402
from flockenv.effects.tether import Swing, Tether  # noqa: E402

__all__ = [
    "EFFECTS", "Alignment", "AvoidObstacles", "Cohesion", "Drag", "Effect", "Me", "Other", "Separation", "Sight",
    "Swing", "Tether",
]  # fmt: skip
