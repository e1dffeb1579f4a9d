"""What a step must end with, whichever method made it. To add one: write its file, and a row in tests/catalogue.py."""

from __future__ import annotations

import importlib
import pkgutil

from flockenv.constraints.base import CONSTRAINTS, Constraint, Settler

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

from flockenv.constraints.collisions import Collisions  # noqa: E402  # after the folder has been walked
from flockenv.constraints.rods import Rods, UnmetWarning  # noqa: E402

__all__ = ["CONSTRAINTS", "Collisions", "Constraint", "Rods", "Settler", "UnmetWarning"]
